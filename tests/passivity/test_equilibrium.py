"""x* from a target: completed and enclosed, refuted with the nearest point, or left to the user to choose."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from flint import fmpq

from pbcgen import AffineSystem, Circuit, Design, DynamicExtension, Mechanical, Parameters
from pbcgen.models.loader import load
from pbcgen.passivity.equilibrium import complete, input_rank
from pbcgen.passivity.plant import Plant
from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import approximate, lower, radius, upper

LAW = DynamicExtension(alpha=1, beta=1, K_c=1, R_c=1)


def _complete(system, target, **keywords):
    design = Design(system, target=target, law=LAW, sample_period="1e-3", name="d", **keywords)
    return complete(Plant(design.system), design)


def _plane(f, g=(0, 1), **keywords):
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    return AffineSystem([x, y], [u], f(x, y), list(g), x**2 / 2 + y**2 / 2, **keywords)


def _pendulum(**keywords):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    return Mechanical([q], [p], M=[1], V=-2 * ca.cos(q), D=[1], G=[1], inputs=["u"], **keywords)


def test_a_rational_equilibrium_is_exact():
    found = _complete(load("coupling_device").system, {"x3": "0.025"})
    assert found.claim.status is Status.PROVED
    assert found.claim.method == "linear elimination over the rationals"
    assert [radius(v) for v in found.point.x] == [0] * 5
    assert [lower(v) for v in found.point.x] == [0, Fraction(1, 40), Fraction(1, 40), 0, 0]


def test_an_irrational_equilibrium_is_enclosed():
    """20 mA through the load: x3* = b ln(i*/a + 1) = ln(200001)/4."""
    design = load("rlc")
    parameters = design.system.parameters
    x3 = design.system.x[2]
    load_current = parameters.a * (ca.exp(x3 / parameters.b) - 1)
    found = _complete(design.system, {"i_D": (load_current, "0.02")})
    assert found.claim.status is Status.PROVED
    values = [approximate(v) for v in found.point.x]
    np.testing.assert_allclose(values, [0.050515194, 0.030515194, 3.0515194], rtol=2e-8)
    assert values[2] == pytest.approx(np.log(200001) / 4, rel=1e-15)
    assert 0 < radius(found.point.x[2]) < Fraction(1, 10**80)
    assert lower(found.point.x[2]) < upper(found.point.x[2])


def test_a_partial_target_is_completed():
    found = _complete(_pendulum().lower(), {"q": "0.5"})
    assert approximate(found.point.u[0]) == pytest.approx(2 * np.sin(0.5), rel=1e-15)


def test_a_target_by_an_expression_of_several_states():
    x = [ca.SX.sym("q1"), ca.SX.sym("q2")]
    p = [ca.SX.sym("p1"), ca.SX.sym("p2")]
    chain = Mechanical(x, p, M=[1, 2], V=x[0] ** 2 + (x[1] - x[0]) ** 2, D=[1, 1], G=[1, 0])
    found = _complete(chain.lower(), {"sum": (x[0] + x[1], 3)})
    assert [approximate(v) for v in found.point.x] == [1.5, 1.5, 0, 0]
    assert [approximate(v) for v in found.point.u] == [3]


def test_every_completion_is_listed_and_the_user_chooses():
    """x' = y - x^3 + 4 x rests with y = 0 at x = -2, 0, 2."""
    system = _plane(lambda x, y: [y - x**3 + 4 * x, -x - y])
    found = _complete(system, {"y": 0})
    assert found.claim.status is Status.UNDECIDED
    assert found.point is None
    assert sorted(round(c["x"], 9) for c in found.completions) == [-2, 0, 2]
    assert "near" in found.claim.hint
    chosen = _complete(system, {"y": 0}, near={"x": "1.7"})
    assert chosen.claim.status is Status.PROVED
    assert approximate(chosen.point.x[0]) == pytest.approx(2, abs=1e-15)


def test_the_domain_chooses_among_completions():
    system = _plane(lambda x, y: [y - x**3 + 4 * x, -x - y], domain={"x": (1, None)})
    found = _complete(system, {"y": 0})
    assert found.claim.status is Status.PROVED
    assert approximate(found.point.x[0]) == pytest.approx(2, abs=1e-15)


def test_a_domain_far_from_zero_is_searched():
    system = _plane(lambda x, y: [y - ca.sin(x), -x - y], domain={"x": (5, 7)})
    found = _complete(system, {"y": "0.5"})
    assert approximate(found.point.x[0]) == pytest.approx(2 * np.pi + np.pi / 6, rel=1e-14)


def test_a_full_target_that_is_rounded_is_refuted_with_the_polished_point():
    """x1* = x3/r + a (exp(x3/b) - 1) is irrational, so a full decimal target cannot be an equilibrium."""
    design = load("rlc")
    found = _complete(design.system, ["0.0505134471", "0.030515", "3.0515"])
    assert found.claim.status is Status.REFUTED
    assert found.claim.counterexample["nearest"]["x1"] == pytest.approx(0.0505134471, rel=1e-8)
    assert max(abs(float(Fraction(r))) for r in found.claim.counterexample["residual"]) > 1e-12


def test_a_point_that_is_not_assignable_is_refuted_with_residual_and_nearest_point():
    """The momentum of a resting pendulum is zero: (q, p) = (0.5, 0.1) gives q' = 0.1."""
    found = _complete(_plane(lambda x, y: [y, -ca.sin(x) - y]), ["0.5", "0.1"])
    assert found.claim.status is Status.REFUTED
    assert "0.1" in found.claim.counterexample["residual"]
    assert found.claim.counterexample["nearest"]["y"] == pytest.approx(0, abs=1e-9)
    assert "e-" not in found.claim.hint  # what is rounding is shown as zero


def test_a_target_outside_the_domain_is_refuted():
    found = _complete(_pendulum(domain={"q": (-1, 1)}).lower(), {"q": 2})
    assert found.claim.status is Status.REFUTED
    assert "outside the domain" in found.claim.evidence


def test_a_target_that_leaves_a_family_of_equilibria_is_left_open():
    """The masses are free: q1 is not determined by p1 = 0."""
    x = [ca.SX.sym("q1"), ca.SX.sym("q2")]
    p = [ca.SX.sym("p1"), ca.SX.sym("p2")]
    chain = Mechanical(x, p, M=[1, 2], V=(x[1] - x[0]) ** 2, D=[1, 1], G=[1, 0])
    found = _complete(chain.lower(), {"p1": 0})
    assert found.claim.status is Status.UNDECIDED
    assert "family" in found.claim.evidence


def test_a_double_zero_is_not_enclosed_and_not_proved():
    """y = x^2 with y = 0 has the double zero x = 0, where Newton's method is singular."""
    found = _complete(_plane(lambda x, y: [ca.cosh(x) - 1 - y, -x - y]), {"y": 0})
    assert found.claim.status is Status.UNDECIDED


@pytest.mark.parametrize("power", [2, 3, 7])
def test_a_power_of_a_linear_function_is_zero_where_the_function_is(power):
    """(x - y)^k = 0 means x = y, which Newton's method cannot show."""
    found = _complete(_plane(lambda x, y: [(x - y) ** power, -x - y]), {"y": "0.3"})
    assert found.claim.status is Status.PROVED
    assert [str(v) for v in found.point.x] == ["3/10", "3/10"]


def test_a_product_of_different_factors_has_several_zeros():
    found = _complete(_plane(lambda x, y: [(x - y) ** 2 * (x + 1) ** 3, -x - y]), {"y": "0.3"})
    assert found.claim.status is Status.UNDECIDED


@pytest.mark.parametrize(("bounds", "status"), [((0, 1), "UNDECIDED"), ((-1, 0), "UNDECIDED"), ((-1, 1), "PROVED")])
def test_a_target_on_the_edge_of_the_domain_has_no_neighbourhood(bounds, status):
    found = _complete(_plane(lambda x, y: [y - x, -x - y], domain={"x": bounds}), {"y": 0})
    assert found.claim.status.name == status


@pytest.mark.parametrize(("switch", "status"), [(0, "UNDECIDED"), (1, "PROVED")])
def test_a_storage_that_switches_at_the_target_is_no_storage_there(switch, status):
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    S = x**2 / 2 + y**2 / 2 + ca.if_else(x > switch, 5, 0)
    found = _complete(AffineSystem([x, y], [u], [y - x, -x - y], [0, 1], S), {"y": 0})
    assert found.claim.status.name == status


def test_conditions_that_contradict_each_other_are_named():
    system = _plane(lambda x, y: [y - x, -x - y])
    found = _complete(system, {"y": 5, "twice": (2 * system.x[1], 11)})
    assert found.claim.status is Status.REFUTED
    assert "contradict each other" in found.claim.evidence
    assert "y = 5, twice = 11" in found.claim.evidence


def test_the_nearest_assignable_point_moves_only_what_the_target_names():
    """50 q1 - 80 q2 + 30 q3 = 0 at rest: the multiplier of the relative least-squares problem is 2/362."""
    x, u = [ca.SX.sym(name) for name in "abcd"], ca.SX.sym("u")
    f = [x[3], 50 * x[0] - 80 * x[1] + 30 * x[2], 0, -x[3]]
    system = AffineSystem(x, [u], f, [0, 0, 0, 1], ca.sumsqr(ca.vertcat(*x)))
    found = _complete(system, {"a": "0.1", "b": "0.2", "c": "0.3"})
    nearest = found.claim.counterexample["nearest"]
    scales, normal = (0.1, 0.2, 0.3), (50, -80, 30)
    gap = sum(n * v for n, v in zip(normal, (0.1, 0.2, 0.3), strict=True))
    size = sum((n * s) ** 2 for n, s in zip(normal, scales, strict=True))
    expected = [v - gap / size * n * s * s for v, n, s in zip((0.1, 0.2, 0.3), normal, scales, strict=True)]
    assert [nearest[k] for k in "abc"] == pytest.approx(expected, rel=1e-5)


def test_an_equilibrium_that_does_not_exist_is_not_proved():
    assert _complete(_plane(lambda x, y: [y + ca.exp(x), -x - y]), {"y": 1}).claim.status is not Status.PROVED


def test_a_division_by_zero_at_the_target_is_no_equilibrium():
    assert _complete(_plane(lambda x, y: [y - 1 / x, -x - y]), {"x": 0}).claim.status is not Status.PROVED


@pytest.mark.parametrize("power", [1.5, 2.5, 3.7])
def test_the_end_of_the_range_of_definition_is_no_equilibrium(power):
    """x^power has no value for x < 0, so nothing can be said near x = 0."""
    found = _complete(_plane(lambda x, y: [y - x**power, -x - y]), {"x": 0})
    assert found.claim.status is Status.UNDECIDED
    assert "undefined" in found.claim.evidence or "not differentiable" in found.claim.evidence


def test_a_jump_at_the_target_is_no_equilibrium():
    assert _complete(_plane(lambda x, y: [y, -x - ca.sign(y)]), {"x": 0}).claim.status is not Status.PROVED
    assert _complete(_plane(lambda x, y: [y, -x - ca.if_else(y > 0, 1, -1)]), {"x": 0}).claim.status is not (
        Status.PROVED
    )


def test_inputs_that_duplicate_each_other_are_refuted():
    x, y, u, v = (ca.SX.sym(name) for name in ("x", "y", "u", "v"))
    system = AffineSystem([x, y], [u, v], [-x, -y], [[1, 2], [2, 4]], x**2 + y**2)
    plant = Plant(system)
    design = Design(load("coupling_device").system, target={"x3": 0}, law=LAW, sample_period=1, name="d")
    assert input_rank(Plant(design.system), complete(Plant(design.system), design).point).status is Status.PROVED
    from pbcgen.passivity.plant import Point
    from pbcgen.symbolic.real import rational

    zero = rational(0)
    claim = input_rank(plant, Point((zero, zero), (zero, zero)))
    assert claim.status is Status.REFUTED
    assert claim.counterexample["v"]


def test_parameters_with_irrational_functions_are_enclosed():
    k = Parameters(k=2)
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    w = ca.sqrt(k.k)
    system = AffineSystem([x, y], [u], [y, -w * x - y], [0, 1], w * x**2 / 2 + y**2 / 2, parameters=k)
    found = _complete(system, {"x": 1})
    assert found.claim.status is Status.PROVED
    assert approximate(found.point.u[0]) == pytest.approx(2**0.5, rel=1e-15)


def test_a_circuit_with_a_current_source_rests_where_the_currents_balance():
    i, v = ca.SX.sym("i"), ca.SX.sym("v")
    circuit = Circuit([i], [v], L=[0.1], C=[0.01], Gamma=[[1]], v_R=[2 * i], i_G=[v**3], g_C=[1], inputs=["I"])
    found = _complete(circuit.lower(), {"v": 2})
    assert [approximate(x) for x in found.point.x] == [-1, 2]
    assert approximate(found.point.u[0]) == pytest.approx(8 + 1, rel=1e-15)


def test_a_rational_posture_is_exact_although_the_inertia_is_not():
    """M = cos q + 1/2 is irrational at q = 1/10, but at rest the velocity M^-1 p is exactly zero."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    arm = Mechanical([q], [p], M=[ca.cos(q) + 0.5], V=q**2 / 2, D=[1], G=[1])
    found = _complete(arm.lower(), {"q": "0.1"})
    assert found.claim.status is Status.PROVED
    assert lower(found.point.u[0]) == upper(found.point.u[0]) == Fraction(1, 10)


def test_an_equation_beyond_the_unknowns_must_hold_exactly():
    """x1 = log 2 solves both equations of the target only to rounding when the second constant is a rounded one."""
    x1, x2, u = (ca.SX.sym(name) for name in ("x1", "x2", "u"))
    system = AffineSystem([x1, x2], [u], [x2, -x1 - x2], [0, 1], x1**2 / 2 + x2**2 / 2)
    exponential = {"e": (ca.exp(x1), 2)}
    rounded = {**exponential, "again": (ca.exp(2 * x1) + x1, "4.693147180559945309417232121458176568")}
    design = Design(system, rounded, DynamicExtension(1, 1, 1, 1), sample_period="1e-3", name="rounded")
    assert complete(Plant(system), design).claim.status != "PROVED"
    doubled = {**exponential, "again": (3 * ca.exp(x1), 6)}
    design = Design(system, doubled, DynamicExtension(1, 1, 1, 1), sample_period="1e-3", name="doubled")
    assert complete(Plant(system), design).claim.status == "PROVED"


def _cubic(e):
    """At x = 5/8 it is ``y + y^3 = 5/8 + e``, and z follows from an exponential of x."""
    x, y, z, u = (ca.SX.sym(name) for name in "xyzu")
    p = Parameters(e=e)
    f = [-x, x + p.e - y - y**3, ca.exp(x) - z - z**3]
    system = AffineSystem([x, y, z], [u], f, [1, 0, 0], (x**2 + y**2 + z**2) / 2, parameters=p)
    return _complete(system, {"x": "0.625"}).point


def test_short_rationals_that_solve_the_nonlinear_equations_are_exact():
    _, y, z = _cubic("0").x
    assert y == fmpq(1, 2)
    assert radius(z) > 0


def test_a_short_rational_beside_the_zero_is_not_taken_for_it():
    """1/2 is nearer to the zero than the balls are wide."""
    assert radius(_cubic("1e-80").x[1]) > 0


@pytest.mark.parametrize("damping", [lambda q, p: 1 / p, lambda q, p: 1 / p**2, lambda q, p: ca.sqrt(p)])
def test_friction_that_is_not_defined_around_the_rest_leaves_it_open(damping):
    """f is undefined at p = 0, or beside it, although p = 0 and u = grad V solve the equations of a rest."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    found = _complete(Mechanical([q], [p], M=[1], V=q**2, D=[damping(q, p)], G=[1]).lower(), {"q": "0.1"})
    assert found.claim.status is Status.UNDECIDED
    assert "D has no certain value" in found.claim.evidence


def test_friction_that_is_defined_around_the_rest_is_no_matter():
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    for friction in (ca.fabs(p), ca.sqrt(p**2 + 1), 1 / (1 + q)):
        found = _complete(Mechanical([q], [p], M=[1], V=q**2, D=[friction], G=[1]).lower(), {"q": "0.1"})
        assert found.claim.status is Status.PROVED


def test_tiny_forces_have_long_denominators():
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    V = q**2 - 6000 * ca.exp(-((q - 100) ** 2))
    assert _complete(Mechanical([q], [p], M=[1], V=V, D=[1], G=[1]).lower(), {"q": 0}).claim.status is Status.PROVED
