"""Around a rest, a mechanical system is linearised without differentiating M^-1: the same numbers as from f and S."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen import Mechanical
from pbcgen.passivity.local import Local
from pbcgen.passivity.plant import Plant, Point
from pbcgen.symbolic.real import approximate, rational

Q = ca.SX.sym("q", 2)
P = ca.SX.sym("p", 2)


def arm(D: object) -> Mechanical:
    """Two joints with coupled inertia, gravity and an input that depends on the position."""
    M = ca.SX([[3, 0], [0, 1]]) + ca.cos(Q[0] - Q[1]) * ca.SX([[0, 1], [1, 0]])
    V = 9 * (1 - ca.cos(Q[0])) + 4 * (1 - ca.cos(Q[1]))
    return Mechanical(Q, P, M=M, V=V, D=D, G=ca.vertcat(1 + Q[1] ** 2, ca.sin(Q[0])))


def point(p: tuple[int, int]) -> Point:
    """A state with these momenta."""
    from fractions import Fraction

    x = (Fraction(3, 7), Fraction(-2, 9), *p)
    return Point(tuple(rational(Fraction(v)) for v in x), (rational(Fraction(5, 3)),))


@pytest.mark.parametrize("D", [[1, 2], [0, Q[0] ** 2 + P[1] ** 2], None])
@pytest.mark.parametrize("momenta", [(0, 0), (1, -2)])
def test_slope_and_hessian_are_those_of_the_system(D: object, momenta: tuple[int, int]) -> None:
    plant = Plant(arm(D).system)
    where = point(momenta)
    local = Local.of(plant, where)
    assert bool(local.values) == (momenta == (0, 0))
    x = plant.system.x
    wanted = plant.at(
        where, ca.jacobian(plant.system.xdot, x), ca.gradient(plant.system.S, x), ca.hessian(plant.system.S, x)[0]
    )
    found = local.at(ca.jacobian(local.xdot, x), ca.gradient(local.S, x), ca.hessian(local.S, x)[0])
    for a, b in zip(wanted, found, strict=True):
        for row, other in zip(a, b, strict=True):
            assert [approximate(v) for v in row] == pytest.approx([approximate(v) for v in other], abs=1e-25)
