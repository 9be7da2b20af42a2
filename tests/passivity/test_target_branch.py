"""Equilibria without a formula: what is enclosed, and which proposals must be refused."""

from __future__ import annotations

import re
from dataclasses import replace
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.target_branch import Branch, find_branch
from pbcgen.symbolic.real import BITS, approximate, ball, enclose, precision, rational

P, Z = ca.SX.sym("p", 1), ca.SX.sym("z", 1)
P2, Z2 = ca.SX.sym("p", 2), ca.SX.sym("z", 2)


def plant() -> Plant:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    return Plant(AffineSystem(x=[x], u=[u], f=[-x], g=[1], S=x**2 / 2, measured=["x"]))


def cubic() -> Branch:
    found = find_branch(plant(), P, Z, Z**3 + Z - P, [(Fraction(-1), Fraction(3))], ([0.0], [0.0]))
    assert isinstance(found, Branch)
    return found


def coupled() -> Branch:
    """Two unknowns that hold each other: z1 + z2^3/4 = p1, z2 + sin(z1)/2 = p2."""
    equations = ca.vertcat(Z2[0] + Z2[1] ** 3 / 4 - P2[0], Z2[1] + ca.sin(Z2[0]) / 2 - P2[1])
    box = [(Fraction(0), Fraction(1)), (Fraction(-1, 2), Fraction(1, 2))]
    found = find_branch(plant(), P2, Z2, equations, box, ([0.0, 0.0], [0.0, 0.0]))
    assert isinstance(found, Branch)
    return found


@pytest.mark.parametrize(("branch", "p"), [(cubic, [1.3]), (cubic, [-0.9]), (coupled, [0.7, -0.4])])
def test_the_ball_of_a_cell_holds_every_solution_and_its_slope(branch, p: list[float]) -> None:
    rng, own = np.random.default_rng(0), branch()
    with precision(BITS):
        over = own.enclose([enclose(Fraction(v - 0.01), Fraction(v + 0.01)) for v in p])
        assert over is not None
        for _ in range(20):
            here = own.enclose([rational(Fraction(v + rng.uniform(-0.01, 0.01))) for v in p])
            assert here is not None
            assert all(ball(a).contains(ball(b)) for a, b in zip(over.z, here.z, strict=True))
            for a, b in zip(over.rates, here.rates, strict=True):
                assert all(ball(v).contains(ball(w)) for v, w in zip(a, b, strict=True))


@pytest.mark.parametrize("branch", [cubic, coupled])
def test_the_written_steps_reach_the_solution(branch) -> None:
    own = branch()
    formula = ca.Function("z", [own.p], [own.formula])
    rng = np.random.default_rng(1)
    for _ in range(50):
        p = rng.uniform(0, 0.5, own.p.numel())
        found = own.enclose([rational(Fraction(v)) for v in p])
        assert found is not None
        np.testing.assert_allclose(np.array(formula(p)).ravel(), [approximate(v) for v in found.z], atol=1e-14)


def test_the_coefficients_are_short_so_that_every_machine_writes_the_same() -> None:
    numbers = [float(word) for word in re.findall(r"\d+\.?\d*(?:e[-+]?\d+)?", str(cubic().start))]
    assert numbers
    assert all(float(f"{v:.6g}") == v for v in numbers)


def test_a_cell_that_is_too_wide_is_refused() -> None:
    with precision(BITS):
        assert cubic().enclose([enclose(Fraction(-1), Fraction(3))]) is None


def test_the_steps_are_proved_on_the_whole_box_and_not_beyond_a_turning_point() -> None:
    assert cubic().holds([(Fraction(-1), Fraction(3))])
    bent = replace(cubic(), equations=Z**3 - Z - P)
    assert not bent.holds([(Fraction(-1), Fraction(1))])


def test_steps_that_do_not_reach_the_solution_are_refused() -> None:
    branch, at = cubic(), [rational(Fraction(-9, 10))]
    assert branch.enclose(at) is not None
    assert replace(branch, steps=0).enclose(at) is None
    assert replace(branch, steps=1, start=branch.start + 0.1).enclose(at) is None
    assert replace(branch, start=branch.start + 1).enclose(at) is None


def test_each_of_three_solutions_keeps_its_own_branch() -> None:
    for root in (-1.0, 0.0, 1.0):
        found = find_branch(plant(), P, Z, Z**3 - Z - P, [(Fraction(-1, 5), Fraction(1, 5))], ([0.0], [root]))
        assert isinstance(found, Branch)
        enclosed = found.enclose([rational(Fraction(0))])
        assert enclosed is not None
        assert approximate(enclosed.z[0]) == pytest.approx(root, abs=1e-12)


def test_a_solution_that_ends_inside_the_box_is_not_followed() -> None:
    found = find_branch(plant(), P, Z, Z**3 - Z - P, [(Fraction(-1, 2), Fraction(1, 2))], ([0.0], [1.0]))
    assert isinstance(found, str)
    assert "followed" in found
