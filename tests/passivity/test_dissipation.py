"""Assumption 3 and Theta: natural damping, its largest constants, and the bound on K_l R_l."""

import casadi as ca
import pytest

from pbcgen import AffineSystem, Circuit, Design, Mechanical, NaturalDamping
from pbcgen.control.derive import derive
from pbcgen.proof.claim import Status


def _claims(design):
    return {c.claim: c for c in derive(design).claims}


def test_constants_below_the_dissipation_are_not_taken_from_an_indefinite_matrix():
    """D > 0 with a determinant of at least 3/100, but with its diagonal lowered to constants it is indefinite."""
    x = [ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2")]
    q1, q2, p1, p2 = x
    less, more = 1 - 0.9 * ca.sin(q1), 1 + 0.9 * ca.sin(q1)
    f = [p1, p2, -2 * q1 - more * p1 - 0.4 * p2, -2 * q2 - 0.4 * p1 - less * p2]
    S = q1**2 + q2**2 + (p1**2 + p2**2) / 2
    system = AffineSystem(x, [ca.SX.sym("u")], f, [0, 0, 1, 0], S, eta=[q2])
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=1, R_l=1)
    claims = _claims(Design(system, target={"q1": 0, "q2": 0}, law=law, sample_period="1e-3", name="d"))
    assert claims["assumption-1"].status is Status.PROVED
    assert claims["assumption-3"].status is Status.UNDECIDED
    assert claims["theta"].status is not Status.PROVED


def test_a_constant_below_a_rational_friction_is_found():
    """B = [[1 + 1/(1 + i1^2), 1/2], [1/2, 3/10]] >= [[1, 1/2], [1/2, 3/10]] > 0."""
    i1, i2, v = (ca.SX.sym(name) for name in ("i1", "i2", "v"))
    drops = [i1 + ca.atan(i1) + 0.5 * i2, 0.5 * i1 + 0.3 * i2]
    eta = [0.3 * i1 - 0.5 * i2]
    circuit = Circuit([i1, i2], [v], L=[1, 1], C=[1], Gamma=[[1], [0]], v_R=drops, i_G=[v], g_L=[[0], [-1]], eta=eta)
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=1, R_l=1)
    claims = _claims(Design(circuit, target={"i1": 0, "i2": 0, "v": 0}, law=law, sample_period="1e-3", name="d"))
    assert claims["assumption-3"].status is Status.PROVED


def _bell(z, width=1e-4):
    return ca.exp(-(((z - 1.7) / width) ** 2))


#: The friction of q2 and q1, K_l = R_l, and the verdicts on assumption-3 and theta.
FRICTION = {
    "constant": (lambda a, b, v: (1, 1), 5, "PROVED", "PROVED"),
    "above a constant": (lambda a, b, v: (1 + ca.sin(b) / 2, 1 + 0.3 * ca.cos(a)), 5, "PROVED", "PROVED"),
    "weak in a band": (lambda a, b, v: (1 - 0.999 * _bell(b), 1), 5, "PROVED", "REFUTED"),
    "weak in a band, gains for it": (lambda a, b, v: (1 - 0.999 * _bell(b), 1), 50, "PROVED", "PROVED"),
    "touching zero in a band": (lambda a, b, v: (1 - _bell(b), 1), 5, "REFUTED", "REFUTED"),
    "touching zero in a ball": (lambda a, b, v: (1 - _bell(b, 1e-3) * _bell(v, 1e-3), 1), 5, "REFUTED", "REFUTED"),
    "touching zero at a point": (lambda a, b, v: ((b - 1.7) ** 2, 1), 5, "REFUTED", "REFUTED"),
    "negative in a band": (lambda a, b, v: (1 - 1.001 * _bell(b), 1), 5, "REFUTED", "REFUTED"),
    "vanishing far away": (lambda a, b, v: (1 / (1 + b**2), 1), 5, "UNDECIDED", "REFUTED"),
    "none": (lambda a, b, v: (0, 1), 5, "REFUTED", "REFUTED"),
    "none at the port": (lambda a, b, v: (1, 0), 5, "REFUTED", "REFUTED"),
}


@pytest.mark.parametrize("case", FRICTION)
def test_missing_and_weak_damping_is_found_wherever_it_is(case):
    friction, gain, damped, strong = FRICTION[case]
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    V = q1**2 + q2**2 + (q1 - q2) ** 2
    own, driven = friction(q1, q2, p2)
    system = Mechanical([q1, q2], [p1, p2], M=[1, 2], V=V, D=[driven, own], G=[1, 0], eta=[q2])
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=gain, R_l=gain)
    claims = _claims(Design(system, target={"q1": 0, "q2": 0}, law=law, sample_period="1e-3"))
    assert (claims["assumption-3"].status, claims["theta"].status) == (damped, strong)
    for name in ("assumption-3", "theta"):
        assert (claims[name].counterexample is not None) == (claims[name].status is Status.REFUTED)
