"""The gradient and Hessian conditions, and the bound on K_c, at the margin and with every term."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical, Parameters
from pbcgen.passivity.equilibrium import complete
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.shaping import gain_definiteness, gradient_condition, hessian_conditions, shape_at
from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import approximate, rational

PROVED, REFUTED = Status.PROVED, Status.REFUTED
MARGIN = Fraction(1, 10**6)


def _at_target(system, gamma, target):
    design = Design(
        system,
        target=target,
        law=DynamicExtension(alpha=1, beta=1, K_c=1, R_c=1),
        sample_period="1e-3",
        name="d",
    )
    plant = Plant(design.system)
    point = complete(plant, design).point
    return plant, point, shape_at(plant, point, gamma)


def _well(target):
    """Double well V = (q^2 - 1)^2 with V'' = 12 q^2 - 4 = -4 on the hill."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    arm = Mechanical([q], [p], M=[1], V=(q**2 - 1) ** 2, D=[1], G=[1])
    return _at_target(arm.lower(), arm.lower().x[0], {"q": target})


@pytest.mark.parametrize(("factor", "expected"), [(1 - MARGIN, REFUTED), (Fraction(1), REFUTED), (1 + MARGIN, PROVED)])
def test_the_hill_of_a_double_well_needs_a_stiffness_above_four(factor, expected):
    plant, _, shape = _well(0)
    verdict = hessian_conditions(plant, shape, (4 * factor,), ((Fraction(10**9),),))
    assert verdict.hessian.status is expected
    assert verdict.alpha_beta_min[0] == pytest.approx(4, rel=1e-11)


def test_where_the_storage_is_convex_every_gain_does():
    plant, _, shape = _well(1)
    verdict = hessian_conditions(plant, shape, (Fraction(1, 10**12),), ((Fraction(1, 10**12),),))
    assert verdict.hessian.status is PROVED
    assert verdict.kc.status is PROVED
    assert verdict.alpha_beta_min == (0.0,)
    assert verdict.kc_min == 0


@pytest.mark.parametrize(("factor", "expected"), [(1 - MARGIN, REFUTED), (1 + MARGIN, PROVED)])
def test_the_filter_must_be_stiff_enough_in_series(factor, expected):
    """On the hill with alpha beta = 5: 5 K_c / (5 + K_c) > 4 iff K_c > 20."""
    plant, _, shape = _well(0)
    verdict = hessian_conditions(plant, shape, (Fraction(5),), ((20 * factor,),))
    assert verdict.hessian.status is PROVED
    assert verdict.kc.status is expected
    assert verdict.kc_min == pytest.approx(20, rel=1e-12)


def test_a_direction_that_gamma_does_not_reach_is_beyond_every_gain():
    q = [ca.SX.sym("q1"), ca.SX.sym("q2")]
    p = [ca.SX.sym("p1"), ca.SX.sym("p2")]
    arm = Mechanical(q, p, M=[1, 1], V=q[0] ** 2 - q[1] ** 2, D=[1, 1], G=[1, 0]).lower()
    plant, _, shape = _at_target(arm, arm.x[0], {"q1": 0, "q2": 0})
    verdict = hessian_conditions(plant, shape, (Fraction(10**9),), ((Fraction(1),),))
    assert verdict.hessian.status is REFUTED
    assert verdict.alpha_beta_min is None
    assert "no alpha*beta helps" in verdict.hessian.hint


def test_the_curvature_of_gamma_counts():
    """G(q) = cos q1 gives gamma = sin q1; kappa gamma'' = V' tan q1 is added to V'' (third term of hesscond)."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[1], V=q**2 / 2, D=[1], G=[ca.cos(q)]).lower()
    _, _, shape = _at_target(system, ca.sin(system.x[0]), {"q": "0.6"})
    kappa = approximate(shape.kappa[0])
    assert kappa == pytest.approx(-0.6 / np.cos(0.6), rel=1e-14)
    assert approximate(shape.H0[0][0]) == pytest.approx(1 - kappa * np.sin(0.6), rel=1e-14)
    assert abs(approximate(shape.gradient[0])) < 1e-80


def test_the_third_term_changes_the_verdict():
    """gamma = sin q far from 0 with a pushing input: V'' + kappa gamma'' = 1 + 2 tan 2 < 0 although V'' = 1."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[1], V=q**2 / 2, D=[1], G=[ca.cos(q)]).lower()
    plant, _, shape = _at_target(system, ca.sin(system.x[0]), {"q": 2})
    bare = 1 + 2 / np.cos(2) * np.sin(2)
    assert approximate(shape.H0[0][0]) == pytest.approx(bare, rel=1e-12)
    assert bare < 0
    needed = -bare / np.cos(2) ** 2
    for factor, expected in ((1 - 1e-6, REFUTED), (1 + 1e-6, PROVED)):
        gain = Fraction(needed * factor)
        assert hessian_conditions(plant, shape, (gain,), ((Fraction(10**9),),)).hessian.status is expected


@pytest.mark.parametrize(("margin", "expected"), [(MARGIN, PROVED), (-MARGIN, REFUTED)])
def test_badly_scaled_hessians_are_decided(margin, expected):
    """Springs of 1e13 and -1e-3 in series with the filter: 1e13 - 1e-3 has no double, so the values are parameters."""
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    p = Parameters(stiff="1e13", soft="1e-3")
    storage = p.stiff * (x - y) ** 2 / 2 - p.soft * y**2 / 2
    plant = Plant(AffineSystem([x, y], [u], [y, -x - y], [0, 1], storage, gamma=[x], parameters=p))
    zero = rational(0)
    shape = shape_at(plant, Point((zero, zero), (zero,)), x)
    stiff, soft = Fraction(10) ** 13, Fraction(1, 10**3)
    needed = stiff * soft / (stiff - soft)
    verdict = hessian_conditions(plant, shape, (needed * (1 + margin),), ((Fraction(10) ** 20,),))
    assert verdict.hessian.status is expected


def test_a_gradient_that_does_not_vanish_is_refuted():
    plant, point, shape = _well("0.5")
    assert gradient_condition(plant, point, shape, None).status is PROVED
    wrong = shape_at(plant, point, 2 * plant.system.x[0])
    claim = gradient_condition(plant, point, wrong, None)
    assert claim.status is REFUTED
    assert claim.counterexample["entry"] == "q"


def test_a_gain_that_is_not_definite_is_refuted_with_a_vector():
    good = ((Fraction(2), Fraction(1)), (Fraction(1), Fraction(2)))
    bad = ((Fraction(1), Fraction(1)), (Fraction(1), Fraction(1)))
    assert gain_definiteness({"K_c": good}).status is PROVED
    claim = gain_definiteness({"K_c": good, "R_c": bad})
    assert claim.status is REFUTED
    assert claim.counterexample["gain"] == "R_c"


def test_a_full_k_c_is_compared_as_a_matrix():
    """Two hills with stiffness -4 and alpha beta = 5: K_c > 20 I in the Loewner order, not entry by entry."""
    q = [ca.SX.sym("q1"), ca.SX.sym("q2")]
    p = [ca.SX.sym("p1"), ca.SX.sym("p2")]
    V = (q[0] ** 2 - 1) ** 2 + (q[1] ** 2 - 1) ** 2
    arm = Mechanical(q, p, M=[1, 1], V=V, D=[1, 1], G=[[1, 0], [0, 1]]).lower()
    plant, _, shape = _at_target(arm, arm.x[:2], {"q1": 0, "q2": 0})
    ab = (Fraction(5), Fraction(5))
    for off, expected in ((Fraction(9), PROVED), (Fraction(11), REFUTED)):
        K_c = ((Fraction(30), off), (off, Fraction(30)))
        assert hessian_conditions(plant, shape, ab, K_c).kc.status is expected
