"""Certified regions of attraction: they hold what they promise, and are refused where the theory is not available."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from pbcgen import Design, DynamicExtension, Mechanical, check, load
from pbcgen.pipeline import region
from pbcgen.run.simulate import simulate_continuous

pytestmark = pytest.mark.system


def _pendulum(law, **options):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[[1]], V=10 * (1 - ca.cos(q)), D=[1], G=[[1]], **options)
    return Design(system, {"q": 0}, law, sample_period="1e-3", name="pendulum", duration=30)


@pytest.fixture(scope="module")
def pendulum():
    report = check(_pendulum(DynamicExtension(2, 3, 5, 1)))
    return report, region(report, 5000)


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
    found = region(report, 2500)
    assert found.status == "PROVED"
    assert found.box["q"][0] >= -1
    assert found.box["q"][1] <= 1


def test_a_globally_stable_design_has_the_whole_space():
    found = region(check(load("rlc")))
    assert (found.status, found.level, found.box) == ("PROVED", np.inf, {})
    assert found.contains([1e6, -1e6, 3])


def test_without_a_lyapunov_function_there_is_no_region():
    found = region(check(load("coupling_device")), 1000)
    assert found.status == "UNDECIDED"
    assert not found.contains([0, 0.025, 0.025, 0, 0])


def _coupled(K_c, boxes, told=None):
    """Two pendulums with an actuator each, and filters that share their springs."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    V = 3 * (1 - ca.cos(q[0])) + 2 * (1 - ca.cos(q[1]))
    system = Mechanical(q, p, M=[[2, 0], [0, 1]], V=V, D=[1, 1], G=ca.SX.eye(2))
    law = DynamicExtension([2, 1], 3, K_c, [[1, "0.1"], ["0.1", 1]])
    report = check(Design(system, {"q_0": 0, "q_1": 0}, law, sample_period="1e-3"))
    return region(report, boxes, told)


def test_filters_may_be_coupled():
    found = _coupled([[5, 1], [1, 4]], 600)
    assert found.status == "PROVED"
    assert found.level > 0.05
    assert found.contains([0.05, -0.05, 0, 0])


def test_coupling_of_filters_makes_the_region_no_larger_than_stiffer_ones():
    """K_c = diag(6, 5) is above the coupled matrix in the Loewner order, so its storage is the higher one."""
    coupled, stiff = _coupled([[5, 1], [1, 4]], 120), _coupled([[6, 0], [0, 5]], 120)
    x = [0.2, -0.1, 0.05, 0.05]
    assert coupled.height(x) <= stiff.height(x) + 1e-12


def test_the_same_budget_gives_the_same_region():
    first, second = (_coupled([[5, 1], [1, 4]], 120) for _ in range(2))
    assert first.as_json() == second.as_json()


def test_a_budget_that_is_too_small_proves_nothing_and_progress_is_told():
    told = []
    assert _coupled([[5, 1], [1, 4]], 1).status == "UNDECIDED"
    _coupled([[5, 1], [1, 4]], 520, told.append)
    assert told[0] == "region of attraction, 500 boxes"


def _two_link_arm(law, **options):
    """A planar arm in gravity whose inertia depends on the elbow."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    coupling = 0.5 + 0.3 * ca.cos(q[1])
    M = [[1.2 + 0.6 * ca.cos(q[1]), coupling], [coupling, 0.5]]
    V = -4 * ca.cos(q[0]) - 1.5 * ca.cos(q[0] + q[1])
    system = Mechanical(q, p, M=M, V=V, D=[0.4, 0.2], G=ca.SX.eye(2), **options)
    return Design(system, {"q_0": "0.8", "q_1": "-0.5"}, law, sample_period="2e-3", duration=60)


def test_the_region_of_an_arm_is_sought_over_its_positions():
    report = check(_two_link_arm(DynamicExtension([3, "1.5"], [5, 5], [20, 10], 1)))
    found = region(report, 1500)
    assert found.level > 5
    assert found.contains([0, 0, 0, 0], at_zero=True)
    loop = report.loop.__class__(**{**report.loop.__dict__, "initial": np.array([1.8, -1.2, 0.3, -0.1])})
    assert found.contains(loop.initial.tolist())
    end = simulate_continuous(loop, np.linspace(0, 120, 61)).x[-1]
    np.testing.assert_allclose(end, report.loop.x_star, atol=1e-4)


def test_bounded_momenta_are_part_of_the_box():
    law = DynamicExtension([3, "1.5"], [5, 5], [20, 10], 1)
    found = region(check(_two_link_arm(law, domain={"p_0": ("-0.5", "0.5"), "p_1": ("-0.5", "0.5")})), 1500)
    assert found.box["p_0"][1] <= 0.5


@pytest.mark.parametrize("inertia", ["M", "M_inv"])
def test_the_region_ends_where_the_inertia_does(inertia):
    """1 - q^2 is positive only for ``|q| < 1``: beyond, the kinetic energy has no lower bound."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], **{inertia: [[1 - q**2]]}, V=q**2, D=[1], G=[[1]], domain={"q": (-2, 2)})
    found = region(check(Design(system, {"q": 0}, DynamicExtension(2, 3, 5, 1), sample_period="1e-3")), 1500)
    assert found.status == "UNDECIDED" or found.box["q"][1] < 1


def test_filters_at_zero_take_some_of_the_region(pendulum):
    _, found = pendulum
    x = [2.5, 0]
    assert found.height_at_zero(x) > found.height(x)
    assert found.height_at_zero([0, 0]) == pytest.approx(found.height([0, 0]), abs=1e-12)
