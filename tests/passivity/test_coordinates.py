"""Functions that fix the state: which are one-to-one or bound it, and which must not be called so."""

import casadi as ca
import pytest

from pbcgen import AffineSystem
from pbcgen.passivity.coordinates import injective, proper
from pbcgen.passivity.plant import Plant

x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
PLANT = Plant(AffineSystem([x, y], [u], [-x, -y], [1, 0], x**2 + y**2))

#: Functions, whether they are one-to-one, whether they are proper.
CASES = {
    "coordinates": ((x, y), True, True),
    "affine and singular": ((x + y, 2 * x + 2 * y), False, False),
    "one for two": ((x + y,), False, False),
    "a cubic of one variable": ((x**3, y - x**2), True, True),
    "a cubic that turns": ((x**3 - x, y), False, True),
    "a parabola": ((x**2, y), False, True),
    "a shear by a nonlinear function": ((x + ca.sin(y), y + y**3), True, True),
    "two equations that mix": ((x + 2 * y, x - y - y**5), True, True),
    "two equations that mix and cancel": ((x + y**3, x + y**3), False, False),
    "the wrong sign in a mixture": ((x + 2 * y, x + 2 * y - y**3 + y), False, True),
    "bounded on one side": ((ca.exp(x), y), True, False),
    "bounded on both sides": ((ca.atan(x), y), True, False),
    "a hyperbolic sine": ((ca.sinh(x) + y, y - x), True, True),
    "monotone without order": ((x + x**3 + y + y**3 / 3, y + y**3 - x - x**3 / 3), False, False),
    "a rotation with resistance": ((x + x**3 + 5 * y, y + ca.tanh(y) - 5 * x), True, True),
    "a product": ((x * y, y), False, False),
    "a factor that vanishes": ((x * (1 + y), y), False, False),
    "a factor that does not": ((x * (1 + y**2), y), True, True),
    "flat on one side": ((ca.sqrt(x**2) + x, y), False, False),
    "waves": ((ca.sin(x) + x / 2, y), False, False),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_one_to_one_and_what_is_proper(name):
    functions, one_to_one, bounds = CASES[name]
    column = ca.vertcat(*functions)
    assert injective(PLANT, column, [x, y]) == one_to_one
    assert proper(PLANT, column, [x, y]) == bounds


def test_signs_of_rows_make_the_jacobian_of_a_circuit_definite():
    mixed = ca.vertcat(x + x**3 + 3 * y, 3 * x - y - y**3)
    assert injective(PLANT, mixed, [x, y], [1, -1])
    assert proper(PLANT, mixed, [x, y], [1, -1])
