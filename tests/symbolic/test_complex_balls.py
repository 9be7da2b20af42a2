"""Complex balls hold the values of functions, and nothing is known at poles and cuts."""

import cmath

import numpy as np
import pytest
from flint import acb, arb

from pbcgen.symbolic.complex_balls import COMPLEX

#: Operations, Python's own function, and operands at which nothing may be known.
FUNCTIONS = {
    "exp": (cmath.exp, []),
    "log": (cmath.log, [0, -1]),
    "sqrt": (cmath.sqrt, [0, -1]),
    "sin": (cmath.sin, []),
    "cos": (cmath.cos, []),
    "tan": (cmath.tan, [cmath.pi / 2]),
    "sinh": (cmath.sinh, []),
    "cosh": (cmath.cosh, []),
    "tanh": (cmath.tanh, [1j * cmath.pi / 2]),
    "atan": (cmath.atan, [1j, -2j]),
    "asinh": (cmath.asinh, [1j, -2j]),
    "asin": (cmath.asin, [1, -2]),
    "acos": (cmath.acos, [1, -2]),
    "atanh": (cmath.atanh, [1, -2]),
    "expm1": (lambda z: cmath.exp(z) - 1, []),
    "log1p": (lambda z: cmath.log(1 + z), [-1, -2]),
    "inv": (lambda z: 1 / z, [0]),
    "sq": (lambda z: z * z, []),
    "twice": (lambda z: 2 * z, []),
    "neg": (lambda z: -z, []),
}


def ball(centre, radius):
    return acb(arb(centre.real, radius), arb(centre.imag, radius))


def holds(found, value):
    return bool(abs(found - acb(value.real, value.imag)) < 1e-9) or found.contains(acb(value.real, value.imag))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_balls_hold_the_values(name):
    function, _ = FUNCTIONS[name]
    generator, known = np.random.default_rng(1), 0
    for _ in range(300):
        centre = complex(*generator.uniform(-2, 2, 2))
        radius = float(10 ** generator.uniform(-6, -0.5))
        found = getattr(COMPLEX, name)(ball(centre, radius))
        if not found.is_finite():
            continue
        known += 1
        for _ in range(5):
            place = centre + complex(*generator.uniform(-radius, radius, 2))
            assert holds(found, function(place))
    assert known > 30


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if FUNCTIONS[name][1]])
@pytest.mark.parametrize("radius", [1e-6, 0.3])
def test_nothing_is_known_at_poles_and_cuts(name, radius):
    for place in FUNCTIONS[name][1]:
        assert not getattr(COMPLEX, name)(ball(complex(place), radius)).is_finite()


def test_powers():
    z = ball(0.5 + 0.25j, 1e-9)
    assert holds(COMPLEX.pow(z, acb(3)), (0.5 + 0.25j) ** 3)
    assert holds(COMPLEX.pow(z, acb(-2)), (0.5 + 0.25j) ** -2)
    assert holds(COMPLEX.pow(z, acb(1.5)), (0.5 + 0.25j) ** 1.5)
    assert holds(COMPLEX.pow(ball(-1 + 0j, 0.1), acb(2)), 1 + 0j)
    assert not COMPLEX.pow(ball(-1 + 0j, 0.1), acb(0.5)).is_finite()
    assert not COMPLEX.pow(ball(-1 + 0j, 0.1), ball(2 + 0j, 0.1)).is_finite()
    assert not COMPLEX.pow(ball(0j, 0.1), acb(-1)).is_finite()


def test_a_far_saturation_is_known_in_wide_balls():
    found = COMPLEX.tanh(acb(arb(1e5, 5e4), arb(0, 5e4)))
    assert abs(found - 1) < 1e-9
