"""Targets that no real state meets are refuted with the equation; targets that one meets never are."""

from __future__ import annotations

import random
from fractions import Fraction

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical
from pbcgen.passivity.equilibrium import complete
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.unreachable import contradiction
from pbcgen.proof.claim import Claim, Status

LAW = DynamicExtension(alpha=1, beta=1, K_c=1, R_c=1)


def _left(*equations, domain=None, names="y z"):
    """What is found of equations ``e(y, z) = 0``."""
    symbols = [ca.SX.sym(name) for name in names.split()]
    u = ca.SX.sym("u")
    first = [1, *[0] * (len(symbols) - 1)]
    system = AffineSystem(symbols, [u], [-s for s in symbols], first, ca.sumsqr(ca.vertcat(*symbols)), domain=domain)
    return contradiction(Plant(system), ca.vertcat(*[ca.SX(e(*symbols)) for e in equations]), {})


def _plane(rest, target, domain=None) -> Claim:
    """x' = -x - y + u and 0 = y' = x - rest(y), with x asked for."""
    x, y, u = (ca.SX.sym(name) for name in "xyu")
    system = AffineSystem([x, y], [u], [-x - y, x - rest(y)], [1, 0], x**2 / 2 + y**2 / 2, domain=domain)
    design = Design(system, target={"x": target}, law=LAW, sample_period=1, name="d")
    return complete(Plant(system), design).claim


def test_a_cosine_that_would_have_to_be_larger_than_one_is_refuted_with_the_equation():
    q, p = [ca.SX.sym("q1"), ca.SX.sym("q2")], [ca.SX.sym("p1"), ca.SX.sym("p2")]
    V = 5 * ca.sin(q[1]) - 6 * q[0] * q[1]
    arm = Mechanical(q, p, M=[1, 1], V=V, D=[1, 1], G=[[1], [0]]).lower()
    claim = complete(Plant(arm), Design(arm, target={"q1": 1}, law=LAW, sample_period=1, name="d")).claim
    assert claim.status is Status.REFUTED
    assert claim.counterexample["equation"] == "cos(q2) = 1.2"
    assert "nearest assignable point" in claim.hint


@pytest.mark.parametrize(
    ("rest", "target", "equation"),
    [
        (lambda y: -(y**2), 1, "y^2 + 1 = 0"),
        (ca.tanh, "1.000001", "tanh(y) = 1.000001"),
        (ca.exp, 0, "exp(y) = 0"),
        (lambda y: ca.sin(y) + ca.cos(y), "1.4143", "cos(y) + "),
        (lambda y: y / (1 + y**2), "0.500001", "y^2"),
        (lambda y: 3 + ca.sqrt(1 + y**4), 2, "sqrt(y^4 + 1) = -1"),
    ],
)
def test_an_equation_without_a_real_solution_is_refuted(rest, target, equation):
    claim = _plane(rest, target)
    assert claim.status is Status.REFUTED
    assert equation in claim.counterexample["equation"]


@pytest.mark.parametrize(
    ("rest", "target"),
    [
        (lambda y: -(y**2), "-1e-6"),
        (lambda y: -(y**2), 0),
        (ca.tanh, "0.999999"),
        (ca.exp, "1e-9"),
        (lambda y: ca.sin(y) + ca.cos(y), "1.4142"),
        (ca.sin, 1),
        (lambda y: y / (1 + y**2), "0.5"),
        (lambda y: 3 + ca.sqrt(1 + y**4), 4),
    ],
)
def test_a_target_on_the_margin_or_inside_is_not_refuted(rest, target):
    assert _plane(rest, target).status is not Status.REFUTED


@pytest.mark.parametrize(("bound", "status"), [("1.44", "REFUTED"), ("1.45", "PROVED")])
def test_a_root_outside_of_the_domain_is_none(bound, status):
    """y^3 = 3 at 1.44225."""
    assert _plane(lambda y: y**3, 3, {"y": (-1, bound)}).status.name == status


def test_several_equations_contradict_each_other_by_a_sum_of_multiples():
    """A circle of radius one and a hyperbola that is sqrt(2) away."""
    pytest.importorskip("clarabel")
    found = _left(lambda y, z: y**2 + z**2 - 1, lambda y, z: y * z - 1)
    assert found is not None
    assert "sum of squares" in found.why


def test_a_circle_that_meets_the_hyperbola_is_left_open():
    assert _left(lambda y, z: y**2 + z**2 - 2, lambda y, z: y * z - 1) is None


def test_each_factor_of_a_product_needs_a_contradiction():
    """y is 0 or 1, and exp(z) is neither 0 nor -1 - z^2; but it may be 1."""
    either = lambda y, z: y * (y - 1)  # noqa: E731
    found = _left(either, lambda y, z: ca.exp(z) + y**3 + y**2 * z**2)
    assert found is not None
    assert "where y = 0" in found.why
    assert _left(either, lambda y, z: ca.exp(z) - y**3 - y**2 * z**2) is None


def test_a_state_that_is_always_outside_its_domain_is_named():
    found = _left(lambda y, z: y - ca.exp(z), domain={"y": (None, 0)})
    assert found is not None
    assert "above" in found.why or "domain" in found.why
    assert _left(lambda y, z: y - ca.exp(z), domain={"y": (None, 1)}) is None


def _drawn(seed: int):
    """Two equations with a common zero at a rational point, and a domain that holds it."""
    draw = random.Random(seed)
    y0, z0 = (Fraction(draw.randint(-4, 4), 2) for _ in range(2))

    def equation(y, z):
        kinds = [lambda a: a, lambda a: a**2, lambda a: a**3, ca.sin, ca.exp, ca.tanh, lambda a: ca.sqrt(1 + a**2)]
        total = ca.SX(0)
        for _ in range(draw.randint(1, 3)):
            kind, weight = draw.choice(kinds), draw.choice((-3, -1, 1, 2))
            slopes = draw.choice(((1, 0), (0, 1), (1, 1), (1, -2)))
            apart = slopes[0] * (y - float(y0)) + slopes[1] * (z - float(z0))
            total += weight * (kind(apart) - kind(ca.SX(0))) * draw.choice((1, 1, y + 5, z**2 + 1))
        return total

    domain = {"y": (y0 - draw.choice((0, 1)), y0 + 2), "z": (None, z0)} if draw.random() < 0.5 else None
    return equation, domain


@pytest.mark.parametrize("seed", range(30))
def test_equations_with_a_common_zero_are_never_refuted(seed):
    equation, domain = _drawn(seed)
    assert _left(equation, equation, domain=domain) is None


@pytest.mark.parametrize("root", ["1/2", "2", "-7/3"])
def test_rational_roots_are_roots(root):
    """(y - root) (y^4 + y + 1) vanishes at the root, which is the edge of the domain or outside of it."""
    edge = Fraction(root)
    cubic = lambda y, z: (edge.denominator * y - edge.numerator) * (y**4 + y + 1) + 0 * z  # noqa: E731
    assert _left(cubic, domain={"y": (edge, None)}) is None
    assert _left(cubic, domain={"y": (edge + Fraction(1, 10**9), None)}) is not None
