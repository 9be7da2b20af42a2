"""Certified regions of attraction: they hold what they promise, and are refused where the theory is not available."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from pbcgen import Design, DynamicExtension, Mechanical, check, load
from pbcgen.pipeline import region
from pbcgen.run.simulate import simulate_continuous


def _pendulum(law, **options):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[[1]], V=10 * (1 - ca.cos(q)), D=[1], G=[[1]], **options)
    return Design(system, {"q": 0}, law, sample_period="1e-3", name="pendulum", duration=30)


@pytest.fixture(scope="module")
def pendulum():
    report = check(_pendulum(DynamicExtension(2, 3, 5, 1)))
    return report, region(report, 6)


def test_the_level_is_above_the_minimum_and_below_the_saddle(pendulum):
    """The upright pendulum is a saddle of the storage: 20 from gravity and at most alpha pi from ln cosh."""
    _, found = pendulum
    assert found.status == "PROVED"
    assert 10 < found.level < 20 + 2 * np.pi


def test_the_region_holds_the_target_and_not_the_other_equilibrium(pendulum):
    report, found = pendulum
    second = next(c for c in report.claims if c.claim == "globally-asymptotically-stable").counterexample["x"]
    assert found.contains([0, 0])
    assert not found.contains([float(second["q"]), 0])


def test_trajectories_from_the_region_settle_at_the_target(pendulum):
    report, found = pendulum
    generator = np.random.default_rng(3)
    starts = [x for x in generator.uniform([-3, -8], [3, 8], size=(200, 2)) if found.contains(x)][:6]
    assert len(starts) == 6
    for start in starts:
        loop = report.loop.__class__(**{**report.loop.__dict__, "initial": start})
        end = simulate_continuous(loop, np.linspace(0, 30, 31)).x[-1]
        np.testing.assert_allclose(end, 0, atol=1e-4)


def test_the_region_stays_inside_the_domain():
    report = check(_pendulum(DynamicExtension(2, 3, 5, 1), domain={"q": (-1, 1)}))
    found = region(report, 3)
    assert found.status == "PROVED"
    assert found.box["q"][0] >= -1
    assert found.box["q"][1] <= 1


def test_a_globally_stable_design_has_the_whole_space():
    found = region(check(load("rlc")))
    assert (found.status, found.level, found.box) == ("PROVED", np.inf, {})
    assert found.contains([1e6, -1e6, 3])


def test_without_a_lyapunov_function_there_is_no_region():
    found = region(check(load("coupling_device")), 1)
    assert found.status == "UNDECIDED"
    assert not found.contains([0, 0.025, 0.025, 0, 0])
