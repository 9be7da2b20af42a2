"""Global stability of mechanical systems: fully actuated ones by structure, and what must not be proved."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import pytest

from pbcgen import Design, DynamicExtension, Limits, Mechanical, Parameters, PotentialCompensation, check
from pbcgen.models.laws import Law
from pbcgen.proof.claim import Claim

pytestmark = pytest.mark.system

X, A = ca.SX.sym("x"), ca.SX.sym("a")
COMPENSATION = PotentialCompensation(alpha=[20, 20], beta=1, K_c=1, R_c=1)
EXTENSION = DynamicExtension(alpha=[20, 20], beta=1, K_c=1, R_c=1)
CRANE = [[4, ca.cos(A)], [ca.cos(A), 1]]
ZERO = {"x": 0, "a": 0}
SOMEWHERE = {"x": "0.5", "a": "0.2"}


def verdict(
    V: ca.SX,
    M: object = CRANE,
    D: object = (1, 0),
    G: object = ((1, 0), (0, 1)),
    law: Law = COMPENSATION,
    target: dict[str, object] | None = None,
    parameters: Parameters | None = None,
) -> Claim:
    """The claim `globally-asymptotically-stable` of a mechanical system in (x, a)."""
    momenta = [ca.SX.sym("p_x"), ca.SX.sym("p_a")]
    rows = ca.vertcat(*[ca.horzcat(*row) for row in M])  # type: ignore[attr-defined]
    G = ca.vertcat(*[ca.horzcat(*row) for row in G])  # type: ignore[attr-defined]
    system = Mechanical([X, A], momenta, M=rows, V=V, D=list(D), G=G, parameters=parameters)  # type: ignore[call-overload]
    limits = Limits.symmetric(10**4)
    report = check(Design(system, target or SOMEWHERE, law, limits=limits, sample_period="1e-3"))
    return next(c for c in report.claims if c.claim == "globally-asymptotically-stable")


@pytest.mark.parametrize(
    ("V", "D"), [(5 * A**2, (1, 0)), (10 * ca.cos(A), (0, 0)), (10 * ca.cos(A), (0, A**2)), (ca.SX(0), (1, 1))]
)
def test_full_actuation_with_potential_compensation_is_global_whatever_the_damping(V: ca.SX, D: object) -> None:
    assert verdict(V, D=D).status == "PROVED"


def test_an_inertia_without_bound_is_bounded_where_the_positions_are() -> None:
    assert verdict(5 * A**2, M=[[4 + X**2, ca.cos(A)], [ca.cos(A), 1]]).status == "PROVED"


def test_a_target_that_is_no_decimal_is_proved_too() -> None:
    assert verdict(5 * A**2, target={"x": Fraction(1, 3), "a": Fraction(-2, 7)}).status == "PROVED"


def test_parameters_of_the_crane_may_be_named() -> None:
    p = Parameters(M="3.2", m="0.8", l="0.6", g="9.81")
    M = [[p.M + p.m, p.m * p.l * ca.cos(A)], [p.m * p.l * ca.cos(A), p.m * p.l**2]]
    assert verdict(-p.m * p.g * p.l * ca.cos(A), M=M, parameters=p).status == "PROVED"


def test_an_arm_with_three_joints_is_global_by_its_kinetic_energy() -> None:
    q, v = (ca.vertcat(*[ca.SX.sym(f"{name}{k}") for k in range(3)]) for name in ("q", "v"))
    p = Parameters(m="0.7", l="0.4", g="9.81", J="0.01")
    position, angle, T, V = ca.SX(2, 1), ca.SX(0), p.J * ca.dot(v, v) / 2, ca.SX(0)
    for k in range(3):
        angle = angle + q[k]
        position = position + p.l * ca.vertcat(ca.sin(angle), -ca.cos(angle))
        velocity = ca.mtimes(ca.jacobian(position, q), v)
        T, V = T + p.m * ca.dot(velocity, velocity) / 2, V + p.m * p.g * position[1]
    arm = Mechanical.from_lagrangian(q, v, T=T, V=V, G=ca.SX.eye(3), parameters=p)
    law = PotentialCompensation(alpha=10, beta=1, K_c=1, R_c=1)
    report = check(Design(arm, {"q0": "0.3", "q1": "-0.2", "q2": "0.1"}, law, sample_period="1e-3"))
    assert next(c for c in report.claims if c.claim == "globally-asymptotically-stable").status == "PROVED"


def test_full_damping_replaces_an_actuator_where_the_potential_is_convex() -> None:
    claim = verdict(5 * A**2, D=(1, 1), G=((1,), (0,)), law=DynamicExtension(20, 1, 1, 1), target={"x": "0.5", "a": 0})
    assert claim.status == "PROVED"


def test_a_hanging_load_has_a_second_equilibrium() -> None:
    claim = verdict(-10 * ca.cos(A), law=EXTENSION, target=ZERO)
    assert claim.status == "REFUTED"
    assert abs(float(claim.counterexample["a"] if "a" in claim.counterexample else claim.counterexample["x"]["a"])) > 3  # type: ignore[index]


def test_a_hanging_load_with_parameters_has_a_second_equilibrium() -> None:
    p = Parameters(m="0.8", l="0.6", g="9.81")
    V = -p.m * p.g * p.l * ca.cos(A)
    claim = verdict(V, G=((1,), (0,)), law=DynamicExtension(20, 1, 1, 1), target=ZERO, parameters=p)
    assert claim.status == "REFUTED"


@pytest.mark.parametrize(
    ("why", "arguments"),
    [
        ("alpha below |kappa|", {"V": 3 * ca.sin(X), "law": DynamicExtension([2, 2], 5, 1, 1), "target": ZERO}),
        (
            "M is indefinite at a = 0",
            {"V": 5 * A**2, "M": [[4, 3 * ca.cos(A)], [3 * ca.cos(A), 1]], "target": {"x": 0, "a": "1.5"}},
        ),
        ("M vanishes at x = 2", {"V": 5 * A**2, "M": [[(X - 2) ** 2, 0], [0, 1]]}),
        (
            "no actuator and no damping",
            {"V": 5 * A**2 - 5 * A**4 / 100, "G": ((1,), (0,)), "law": DynamicExtension(20, 1, 1, 1), "target": ZERO},
        ),
        ("negative damping", {"V": 5 * A**2, "D": (-1, 0)}),
        ("negative damping somewhere", {"V": 5 * A**2, "D": (A, 0)}),
        ("V is not defined everywhere", {"V": 1 / (1 - A) + A**2}),
    ],
)
def test_what_is_not_global_is_not_proved(why: str, arguments: dict[str, object]) -> None:
    assert verdict(**arguments).status != "PROVED", why  # type: ignore[arg-type]
