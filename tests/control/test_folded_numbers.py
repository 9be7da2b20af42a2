"""Functions of exact numbers stay exact: CasADi would compute exp(2) as a double, which is another number."""

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical, Parameters
from pbcgen.control.derive import derive
from pbcgen.proof.claim import Status

LAW = DynamicExtension(alpha=3, beta=2, K_c=20, R_c=1)


def _statuses(system, target):
    near = dict.fromkeys(system.lower().state_names, 0)
    derivation = derive(Design(system, target=target, law=LAW, sample_period="1e-2", near=near, name="d"))
    return {c.claim: c.status for c in derivation.claims}


def _symbols(names):
    return [ca.SX.sym(name) for name in names.split()]


@pytest.mark.parametrize(("function", "argument"), [("exp", 2), ("sqrt", 2), ("cos", "1/2"), ("log", 3)])
def test_an_undamped_mode_with_an_irrational_shape_is_not_asymptotically_stable(function, argument):
    """Two equal oscillators pull at the damped one as E r + s does: the motion with E r + s = 0 is not seen."""
    q, r, s, p1, p2, p3 = _symbols("q r s p1 p2 p3")
    P = Parameters(a=argument)
    E = getattr(ca, function)(P.a)
    V = 10 * q**2 + r**2 / 2 + s**2 / 2 + q * (E * r + s) / 4
    system = Mechanical([q, r, s], [p1, p2, p3], M=[1, 1, 1], V=V, D=[0.5, 0, 0], G=[1, 0, 0], parameters=P)
    statuses = _statuses(system, {"q": 0})
    assert statuses["stable"] is Status.PROVED
    for claim in ("asymptotically-stable", "globally-asymptotically-stable", "sampled-stable"):
        assert statuses[claim] is not Status.PROVED


@pytest.mark.parametrize("level", [2, "1/2", "1/3"])
def test_a_state_that_rests_at_a_number_is_put_into_functions_exactly(level):
    """The same oscillators, with the ratio exp(r) of a state that settles at a number."""
    q, p, a, b, c, d, r, u = _symbols("q p a b c d r u")
    P = Parameters(level=level)
    x = ca.vertcat(q, p, a, b, c, d, r)
    S = (10 * q**2 + p**2 + a**2 + b**2 + c**2 + d**2 + (r - P.level) ** 2) / 2
    J = ca.SX(7, 7)
    for (i, j), value in {(0, 1): 1, (1, 2): ca.exp(r), (1, 4): 1, (2, 3): 1, (4, 5): 1}.items():
        J[i, j], J[j, i] = value, -value
    R = ca.diag(ca.SX([0, 1, 0, 0, 0, 0, 1]))
    system = AffineSystem(x, [u], ca.mtimes(J - R, ca.gradient(S, x)), [0, 1, 0, 0, 0, 0, 0], S, parameters=P)
    statuses = _statuses(system, {"q": 0})
    assert statuses["stable"] is Status.PROVED
    for claim in ("asymptotically-stable", "globally-asymptotically-stable", "sampled-stable"):
        assert statuses[claim] is not Status.PROVED


def test_a_narrow_well_far_from_the_target_is_no_overflow():
    """exp(-(r - 40)^2) has the factor exp(-1600), whose inverse is no double."""
    q, r, p1, p2 = _symbols("q r p1 p2")
    V = (q - r) ** 2 / 2 + r**2 / 200 - 4 * ca.exp(-((r - 40) ** 2))
    statuses = _statuses(Mechanical([q, r], [p1, p2], M=[1, 1], V=V, D=[0.5, 0.5], G=[1, 0]), {"q": 0})
    assert statuses["asymptotically-stable"] is Status.PROVED
    assert statuses["globally-asymptotically-stable"] is not Status.PROVED
