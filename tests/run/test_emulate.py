"""The C on emulated processors: the same bits as on the host, counted and measured."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from pbcgen import pipeline
from pbcgen.errors import ToolchainError
from pbcgen.law.step import ReferenceStep
from pbcgen.models.loader import load
from pbcgen.run.emulate import Emulated, measure, missing_tools
from pbcgen.run.targets import TARGETS, target
from pbcgen.run.wrapper import Controller

pytestmark = [pytest.mark.system, pytest.mark.skipif(bool(missing_tools()), reason=missing_tools())]

#: Mean and worst instructions of a step on Cortex-M4F, bytes of code, bytes of stack: none may grow unnoticed. With
#: clang and no contraction, and with GCC as firmware uses it (12.2 gave 121, 135, 900, 0 and 83, 84, 488, 0).
LIMITS = {"coupling_device": (190, 195, 960, 64), "rlc": (100, 105, 560, 64)}
GCC_LIMITS = {"coupling_device": (140, 150, 930, 64), "rlc": (90, 92, 510, 64)}
GCC_SMALL = {"coupling_device": 720, "rlc": 470}  # bytes of code at -Os (700 and 444)


@pytest.fixture(scope="module", params=LIMITS)
def checked(request):
    report = pipeline.check(load(request.param))
    allowed = tuple(claim.claim for claim in report.blocking())
    return request.param, report, pipeline.package(report, allow=allowed)


def measurements(report, count: int = 150):
    """A walk around the equilibrium, and special values."""
    law, loop = report.control, report.loop
    rng = np.random.default_rng(8)
    m = (
        np.array(loop.measure(loop.x_star)).ravel()
        + np.cumsum(rng.normal(size=(count, len(law.inputs))), axis=0) * 1e-3
    )
    m[::17] = rng.choice([np.nan, np.inf, -np.inf, 3e38, 1e-45, 0.0], size=m[::17].shape)
    return m.astype(np.float32)


@pytest.mark.parametrize("name", TARGETS)
def test_a_trajectory_has_the_same_bits_on_target_host_and_in_python(checked, name):
    _, report, package = checked
    m = measurements(report)
    u, status, _ = Emulated(package.files, target(name)).run(m)
    with Controller.of_package(package) as controller:
        _, host_u, host_status = controller.trace(m)
    np.testing.assert_array_equal(u, host_u)
    np.testing.assert_array_equal(status, host_status)
    reference, state = ReferenceStep(report.control), np.zeros(len(report.control.states))
    for row, found in zip(m, u, strict=True):
        state, expected, _ = reference(row, state)
        np.testing.assert_array_equal(found, expected)


def test_with_contraction_the_target_stays_within_a_few_ulp(checked):
    _, report, package = checked
    m = measurements(report)
    m[~np.isfinite(m)] = 0
    exact = Emulated(package.files, target("cortex-m4f"))
    fused = Emulated(package.files, target("cortex-m4f"), ("-O2", "-ffp-contract=fast"))
    for row in m:
        fused.state = exact.state
        u, fused_u = exact.step(row)[0], fused.step(row)[0]
        assert np.max(np.abs(u - fused_u)) <= 32 * np.finfo(np.float32).eps * np.max(np.abs(u), initial=1)


def test_the_figures_on_cortex_m4f_are_within_their_limits(checked):
    name, report, package = checked
    figures = measure(report.control, package.files, report.loop, target("cortex-m4f"), steps=150)
    mean, worst, text, stack = LIMITS[name]
    assert figures.mean <= mean
    assert figures.worst <= worst
    assert figures.text <= text
    assert figures.stack <= stack
    assert figures.static == 0
    assert figures.state == json.loads(package.files["manifest.json"])["memory"]["state_bytes"]


@pytest.mark.skipif(not shutil.which(target("cortex-m4f").gcc[0]), reason="gcc-arm-none-eabi is missing")
def test_the_figures_with_gcc_are_within_their_limits(checked):
    name, report, package = checked

    def figures(level):
        options = {"steps": 150, "flags": ("-std=gnu17", level), "compiler": "gcc"}
        return measure(report.control, package.files, report.loop, target("cortex-m4f"), **options)

    fast, small = figures("-O2"), figures("-Os")
    mean, worst, text, stack = GCC_LIMITS[name]
    assert fast.mean <= mean
    assert fast.worst <= worst
    assert fast.text <= text
    assert small.text <= GCC_SMALL[name]
    assert max(fast.stack, small.stack) <= stack
    assert fast.static == small.static == 0


def test_counts_do_not_depend_on_chance(checked):
    _, report, package = checked
    m = measurements(report, 30)
    first, second = (Emulated(package.files, target("cortex-m4f")).run(m)[2] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_figures_reach_readme_and_manifest(checked):
    _, report, package = checked
    figures = measure(report.control, package.files, report.loop, target("cortex-m4f"), steps=5)
    allowed = tuple(claim.claim for claim in report.blocking())
    files = pipeline.package(report, allow=allowed, costs=[figures]).files
    assert f"| {round(figures.mean)} | {figures.worst} | {figures.text} |" in files["README.md"]
    assert json.loads(files["manifest.json"])["figures"] == [figures.as_json()]


def test_an_unknown_target_is_refused_by_name():
    with pytest.raises(ToolchainError, match=r"no target `z80`: .*cortex-m4f"):
        target("z80")


@pytest.mark.parametrize("name", TARGETS)
def test_a_target_is_set_on_the_processor_as_on_the_host(name):
    design = load("rlc").with_(target_box={"x3": ("2.9", "3.0515")}, gain_ranges={"alpha": ("0.04", "0.0485")})
    report = pipeline.check(design)
    package = pipeline.package(report)
    board = Emulated(package.files, target(name))
    m = measurements(report, 40)
    with Controller.of_package(package) as host:
        for given in (2.93, 3.05, 3.2, np.nan):
            status, count = board.set("target", [given])
            assert host.set_target(x3=given) == host.status_name(status)
            assert count < 400  # comparisons are calls without a floating-point unit
        status, _ = board.set("gains", [0.045])
        assert host.set_gains(alpha=0.045) == host.status_name(status) == "RLC_OK"
        found = board.run(m)
        _, u, expected = host.trace(m)
    np.testing.assert_array_equal(found[0], u)
    np.testing.assert_array_equal(found[1], expected)


@pytest.mark.parametrize("name", TARGETS)
def test_the_example_program_compiles_and_links_for_every_target(checked, name, tmp_path):
    prefix, _, package = checked
    for file in (f"{prefix}.h", f"{prefix}.c", f"{prefix}_example.c"):
        (tmp_path / file).write_text(package.files[file])
    (tmp_path / "math.h").write_text("float fabsf(float);\n")  # all that these need; not every target has a C library
    flags = [*target(name).zig, "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-I.", "-Wl,-e,main"]
    command = [sys.executable, "-m", "ziglang", "cc", *flags, f"{prefix}_example.c", f"{prefix}.c", "-o", "image"]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr[-2000:]
    assert (tmp_path / "image").read_bytes()[:4] == b"\x7fELF"
