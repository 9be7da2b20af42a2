"""Claims about robustness runs."""

import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from pbcgen import ModelError, pipeline
from pbcgen.cli import execute
from pbcgen.models.loader import load
from pbcgen.run.robust import Disturbances, dask_executor, local_executor, loops_of, robust
from pbcgen.run.simulate import simulate_sampled
from pbcgen.run.trajectories import run_loops, trace
from pbcgen.run.wrapper import Controller


def prepared(name, disturbances=None, **options):
    design = load(name)
    report = pipeline.check(design)
    package = pipeline.package(report)
    return design, report, package, loops_of(design, report.loop, package, disturbances, **options)


@pytest.fixture(scope="module")
def rlc():
    return prepared("rlc", Disturbances(spread=0.1, noise={"x3": 1e-3}, delay=0.5), duration=0.02)


@pytest.mark.parametrize("name", ["rlc", "elastic_pendulum"])
def test_the_integrator_agrees_with_cvodes(name):
    design, report, package, loops = prepared(name)
    steps = min(loops.steps, 3000)
    ours = trace(replace(loops, steps=steps), 0, steps)
    with Controller.of_package(package) as controller:
        reference = simulate_sampled(report.loop, controller, design.sample_period, steps * loops.h)
    error = np.abs(ours[:, 1 : 1 + loops.n] - reference.x) / np.max(np.abs(reference.x), axis=0)
    assert np.max(error) < 2e-3


@pytest.mark.system
def test_coupling_device_runs_200_trajectories_a_second():
    *_, loops = prepared("coupling_device", Disturbances(spread=0.1))
    assert loops.steps == 20_000
    run_loops(loops, [0])
    start = time.process_time()
    outcomes = run_loops(loops, range(200))
    assert 200 / (time.process_time() - start) > 200
    assert outcomes[0, 0] == pytest.approx(10.8, abs=0.1)


def test_runs_do_not_depend_on_who_runs_them(rlc):
    loops = rlc[3]
    alone = robust(loops, 30)
    with ThreadPoolExecutor(3) as executor:
        shared = robust(loops, 30, executor=executor, chunk=4)
    assert np.array_equal(alone.outcomes, shared.outcomes)
    assert not np.array_equal(alone.outcomes, robust(replace(loops, seed=1), 30).outcomes)


def test_local_processes_give_the_same(rlc):
    with local_executor(2) as executor:
        shared = robust(rlc[3], 20, executor=executor, chunk=5)
    assert np.array_equal(shared.outcomes, robust(rlc[3], 20).outcomes)


@pytest.mark.system
def test_a_dask_cluster_gives_the_same(rlc):
    pytest.importorskip("distributed")
    executor, close = dask_executor()
    try:
        shared = robust(rlc[3], 20, executor=executor, chunk=5)
    finally:
        close()
    assert np.array_equal(shared.outcomes, robust(rlc[3], 20).outcomes)


def test_an_interrupted_series_is_resumed(rlc, tmp_path):
    loops, file, told = rlc[3], tmp_path / "runs.npz", []

    def interrupt(done, total):
        told.append(done)
        if done >= 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        robust(loops, 30, output=file, chunk=4, progress=interrupt)
    rest = []
    resumed = robust(loops, 30, output=file, chunk=4, progress=lambda done, total: rest.append(done))
    assert told == [4, 8, 12]
    assert rest[0] == 16
    assert np.array_equal(resumed.outcomes, robust(loops, 30).outcomes)


def test_results_of_other_loops_are_refused(rlc, tmp_path):
    file = tmp_path / "runs.npz"
    robust(rlc[3], 3, output=file)
    with pytest.raises(ModelError, match="another"):
        robust(replace(rlc[3], seed=9), 3, output=file)
    file.write_text("no results")
    with pytest.raises(ModelError, match="holds no results"):
        robust(rlc[3], 3, output=file)


def test_disturbances_are_checked():
    with pytest.raises(ModelError, match="x9"):
        prepared("rlc", Disturbances(noise={"x9": 1.0}))
    with pytest.raises(ModelError, match="delay"):
        prepared("rlc", Disturbances(delay=3))


def test_coarse_sensors_and_dead_zones_leave_an_error():
    clean = robust(prepared("elastic_pendulum", duration=10)[3], 1)
    given = Disturbances(dead_zone={"torque": 0.1}, quantum={"motor": 0.02})
    rough = robust(prepared("elastic_pendulum", given, duration=10)[3], 1)
    assert abs(clean.final[0, 0]) < 1e-3 < abs(rough.final[0, 0])


@pytest.mark.system
def test_coulomb_friction_leaves_an_error_that_the_integral_law_removes():
    friction = Disturbances(friction={"p1": 0.8, "p2": 0.3, "p3": 0.1})
    # The ideal arm creeps to its target through the slow mode R_c K_c: 60 s are enough for joint 1.
    ideal = robust(prepared("pera", duration=60)[3], 1).final[0]
    stuck = robust(prepared("pera", friction, duration=60)[3], 1).final[0]
    integral = robust(prepared("pera_integral", friction, duration=60)[3], 1).final[0]
    assert abs(stuck[0]) > 0.1 > 3 * abs(ideal[0])
    assert np.all(np.abs(integral) < np.abs(stuck) / 5)


def test_command_reports_share_and_worst_case(capsys, tmp_path):
    picture, results = tmp_path / "runs.png", tmp_path / "runs.npz"
    options = ["--runs", "25", "--executor", "here", "--noise", "x3=1e-3", "-o", str(results), "--plot", str(picture)]
    assert execute(["robust", "rlc", "--json", *options]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["runs"] == 25
    assert 0 <= document["converged"] <= 1
    assert 0 <= document["worst"]["run"] < 25
    assert picture.stat().st_size > 10_000
    assert execute(["robust", "rlc", "--noise", "x3"]) == 1
    assert execute(["robust", "rlc", "--runs", "3", "-o", str(tmp_path / "runs.txt")]) == 1
