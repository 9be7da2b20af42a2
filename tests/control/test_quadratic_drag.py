"""Drag like v |v| and springs like x |x|: proved where the functions are continuous, refused where they jump."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical, Parameters, check

NAMES = ("assumption-1", "asymptotically-stable", "globally-asymptotically-stable")
LAW = DynamicExtension(2, 3, 5, 1)


def _statuses(system, target, near=None):
    claims = {
        c.claim: str(c.status) for c in check(Design(system, target, LAW, sample_period="1e-3", near=near or {})).claims
    }
    return tuple(claims[name] for name in NAMES)


def _oscillator(friction, spring=lambda x: x, energy=lambda x: x**2 / 2):
    x, v, u = (ca.SX.sym(name) for name in "xvu")
    return AffineSystem([x, v], [u], [v, -spring(x) - friction(v)], [0, 1], energy(x) + v**2 / 2)


@pytest.mark.parametrize(
    "friction",
    [
        lambda v: v * ca.fabs(v),
        lambda v: v / 5 + v * ca.fabs(v) / 3,
        lambda v: v * ca.sqrt(v**2),
        lambda v: v * ca.fabs(v) * (1 + ca.fabs(v)),
        lambda v: v * (v + ca.fabs(v)),
        lambda v: 2 * v + ca.fabs(v),
    ],
)
def test_drag_with_a_modulus_is_global(friction):
    assert _statuses(_oscillator(friction), {"x": "0.5"}) == ("PROVED",) * 3


@pytest.mark.parametrize(
    "friction",
    [
        lambda v: -v * ca.fabs(v),
        lambda v: v * ca.fabs(v) - v / 100,
        lambda v: v * v,
        lambda v: v * (ca.fabs(v) - 1),
        lambda v: v / 2 + ca.fabs(v),
        lambda v: ca.fabs(v) * ca.sin(v),
    ],
)
def test_friction_that_drives_somewhere_is_not_passive(friction):
    assert _statuses(_oscillator(friction), {"x": "0.5"})[0] == "REFUTED"


@pytest.mark.parametrize("friction", [ca.sign, lambda v: ca.fabs(v) / v, lambda v: ca.sign(v) + v * ca.fabs(v)])
def test_dry_friction_is_not_taken_for_a_function(friction):
    """Without input it holds the mass anywhere within its force: x* does not attract."""
    assert "PROVED" not in _statuses(_oscillator(friction), {"x": "0.5"})[1:]


def test_a_spring_with_a_modulus_is_global_and_one_that_jumps_is_refused():
    smooth = _oscillator(lambda v: v, lambda x: x + x * ca.fabs(x), lambda x: x**2 / 2 + ca.fabs(x) ** 3 / 3)
    assert _statuses(smooth, {"x": "0.5"}) == ("PROVED",) * 3
    jumping = _oscillator(lambda v: v, lambda x: x + ca.sign(x), lambda x: x**2 / 2 + ca.fabs(x))
    assert "PROVED" not in _statuses(jumping, {"x": "0"})


def test_a_potential_with_a_kink_is_refused():
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    smooth, kinked = (Mechanical([q], [p], M=[[1]], V=V, D=[1], G=[[1]]) for V in (ca.fabs(q) ** 3, ca.fabs(q) + q**2))
    assert _statuses(smooth, {"q": "0.5"}) == ("PROVED",) * 3
    assert "PROVED" not in _statuses(kinked, {"q": 0})


@pytest.mark.parametrize(("side", "expected"), [(1, "PROVED"), (-1, "REFUTED")])
def test_drag_between_two_masses(side, expected):
    q, p, u = ca.SX.sym("q", 2), ca.SX.sym("p", 2), ca.SX.sym("u")
    slip = p[0] - p[1]
    force = q[0] - q[1] + side * slip * ca.fabs(slip)
    energy = (ca.dot(p, p) + (q[0] - q[1]) ** 2 + q[1] ** 2) / 2
    system = AffineSystem(ca.vertcat(q, p), [u], ca.vertcat(p, -force, force - q[1]), [0, 0, 1, 0], energy)
    found = _statuses(system, {"q_0": "0.5"}, {"q_1": 0})
    assert found[0] == expected
    assert found[2] == expected or side < 0


def test_drag_in_the_momenta_of_a_vehicle():
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    D = [20 + 2 * ca.fabs(p[0]), 30 + 3 * ca.fabs(p[1])]
    system = Mechanical(q, p, M=[200, 150], V=q[1], D=D, G=ca.SX.eye(2))
    assert _statuses(system, {"q_0": 1, "q_1": "0.5"}) == ("PROVED",) * 3


def test_a_gamma_with_a_kink_is_not_proved():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = AffineSystem([x], [u], [-x], [1], x**2 / 2, gamma=[ca.fabs(x)])
    claims = {c.claim: c for c in check(Design(system, {"x": 0}, LAW, sample_period="1e-3")).claims}
    assert claims["passive-output"].status != "PROVED"


@pytest.mark.parametrize("slope", ["0.4", "1.6"])
def test_a_spring_with_a_bend_at_its_rest_has_no_hessian_there(slope):
    """With 1.6 the storage has no minimum: it falls where q < 0."""
    p = Parameters(m=1, k=1, c=slope, d="0.5")
    q, momentum = ca.SX.sym("q"), ca.SX.sym("p")
    V = p.k * q**2 / 2 + p.c * q * ca.fabs(q) / 2
    spring = Mechanical([q], [momentum], V=V, G=[1], M=[p.m], D=[p.d], parameters=p)
    claims = {c.claim: c for c in check(Design(spring, {"q": 0}, LAW, sample_period="1e-3")).claims}
    assert str(claims["hessian-condition"].status) == "UNDECIDED"
    assert "not defined at x*" in claims["hessian-condition"].evidence
    assert "PROVED" not in {str(claims[name].status) for name in ("stable", "sampled-stable")}
