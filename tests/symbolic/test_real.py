"""Exact numbers and balls: a ball contains the true value, and what jumps is never given a finite value there."""

import math
from fractions import Fraction

import casadi as ca
import pytest
from flint import arb, fmpq
from graphs import BINARY, POINTS, UNARY, graphs
from hypothesis import given, settings

from pbcgen.symbolic.real import (
    BITS,
    REAL,
    ball,
    enclose,
    is_finite,
    lower,
    midpoint,
    precision,
    radius,
    rational,
    sign,
    text,
    upper,
)
from pbcgen.symbolic.tape import Tape

#: CasADi's own erfinv has seven digits only.
ACCURATE = {name: function for name, function in UNARY.items() if name != "erfinv"}


def _evaluate(x, outputs, point, wide=None):
    """Dense outputs at a point; with ``wide`` every input is a ball of this radius."""
    with precision(BITS):
        inputs = [rational(v) for v in point]
        if wide:
            inputs = [enclose(v - wide, v + wide) for v in point]
        return [m.dense(fmpq(0)) for m in Tape.of([x], outputs).walk(REAL, [inputs])]


def _casadi(x, expression, point):
    return float(ca.Function("f", [x], [expression])([float(v) for v in point]))


@pytest.mark.parametrize("name", UNARY)
@pytest.mark.parametrize("at", ["-7/4", "-3/10", "2/5", "17/10"])
def test_a_unary_operation_encloses_the_value_of_casadi(name, at):
    x = ca.SX.sym("x")
    ((value,),) = _evaluate(x, [UNARY[name](x)], [Fraction(at)])[0]
    expected = _casadi(x, UNARY[name](x), [Fraction(at)])
    assert is_finite(value) == math.isfinite(expected)
    if is_finite(value):
        assert float(midpoint(value)) == pytest.approx(expected, rel=1e-14 if name in ACCURATE else 1e-6)
        assert radius(value) < Fraction(1, 10**90)


@pytest.mark.parametrize("name", BINARY)
@pytest.mark.parametrize("at", [("3/2", "2/5"), ("-3/2", "2/5"), ("3/2", "-2/5"), ("-9/4", "-1/3")])
def test_a_binary_operation_encloses_the_value_of_casadi(name, at):
    x = ca.SX.sym("x", 2)
    point = [Fraction(v) for v in at]
    ((value,),) = _evaluate(x, [BINARY[name](x[0], x[1])], point)[0]
    expected = _casadi(x, BINARY[name](x[0], x[1]), point)
    assert is_finite(value) == math.isfinite(expected)
    if is_finite(value):
        assert float(midpoint(value)) == pytest.approx(expected, rel=1e-14)


@settings(max_examples=150, deadline=None)
@given(graphs(ACCURATE, BINARY))
def test_a_graph_encloses_the_value_of_casadi(case):
    x, expression = case
    for point in POINTS:
        ((value,),) = _evaluate(x, [expression], point)[0]
        expected = _casadi(x, expression, point)
        if is_finite(value) and math.isfinite(expected) and abs(expected) < 1e6:
            assert float(midpoint(value)) == pytest.approx(expected, rel=1e-8, abs=1e-8)


@settings(max_examples=100, deadline=None)
@given(graphs(UNARY, BINARY))
def test_a_wide_ball_contains_the_values_of_its_points(case):
    x, expression = case
    for point in POINTS:
        wide = Fraction(1, 20)
        ((outer,),) = _evaluate(x, [expression], point, wide)[0]
        if not is_finite(outer):
            continue
        for shift in (-wide, Fraction(0), wide * Fraction(3, 7)):
            ((inner,),) = _evaluate(x, [expression], [v + shift for v in point])[0]
            assert is_finite(inner)
            assert lower(outer) <= upper(inner)
            assert upper(outer) >= lower(inner)


#: Functions at a point where they, or their derivative, jump or end; and whether the value alone is certain.
BREAKS = {
    "sign": (ca.sign, 0),
    "sign squared": (lambda x: ca.sign(x) ** 2, 0),
    "fabs": (ca.fabs, 0),
    "fabs times sine": (lambda x: ca.fabs(x) + ca.sin(x), 0),
    "square root of a square": (lambda x: ca.sqrt(x**2), 0),
    "square root": (ca.sqrt, 0),
    "power 1.5": (lambda x: x**1.5, 0),
    "power 2.5": (lambda x: x**2.5, 0),
    "power 1/3": (lambda x: x ** (1 / 3), 0),
    "power of itself": (lambda x: x**x, 0),
    "logarithm": (ca.log, 0),
    "reciprocal": (lambda x: 1 / x, 0),
    "removable": (lambda x: ca.sin(x) / x, 0),
    "oscillation": (lambda x: x**2 * ca.sin(1 / x), 0),
    "floor": (ca.floor, 2),
    "ceil": (ca.ceil, -1),
    "fmod": (lambda x: ca.fmod(x, 1), 3),
    "remainder": (lambda x: ca.remainder(x, 1), Fraction(1, 2)),
    "copysign": (lambda x: ca.copysign(1, x), 0),
    "copysign of itself": (lambda x: ca.copysign(x + 1, x), 0),
    "fmin": (lambda x: ca.fmin(x, 2 * x), 0),
    "fmax": (lambda x: ca.fmax(x, x**2), 1),
    "saturation": (lambda x: ca.fmax(-1, ca.fmin(1, x)), 1),
    "if_else": (lambda x: ca.if_else(x > 0, x, 2 * x), 0),
    "if_else with a jump": (lambda x: ca.if_else(x >= 1, x, 2 * x), 1),
    "if_else with a hole": (lambda x: ca.if_else(x == 0, 1, x), 0),
    "less": (lambda x: x < 1, 1),
    "less or equal": (lambda x: x <= 1, 1),
    "equal": (lambda x: x == 1, 1),
    "not equal": (lambda x: x != 1, 1),
    "not": (lambda x: ca.logic_not(x > 1), 1),
    "and": (lambda x: ca.logic_and(x > 1, x < 2), 1),
    "or": (lambda x: ca.logic_or(x > 1, x > 2), 1),
    "if_else without a comparison": (lambda x: ca.if_else(x, 1, 2), 0),
    "not of a number": (ca.logic_not, 0),
    "and of a number": (lambda x: ca.logic_and(x, 1), 0),
    "or of a number": (lambda x: ca.logic_or(x, 0), 0),
    "atan2": (lambda x: ca.atan2(x, -1), 0),
    "asin": (ca.asin, 1),
    "acosh": (ca.acosh, 1),
    "hypot": (lambda x: ca.hypot(x, x), 0),
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_break_never_has_a_certain_value_and_derivative(name):
    """Whoever asks for f and f' there, as every check at x* does, gets one that is not finite."""
    function, at = BREAKS[name]
    x = ca.SX.sym("x")
    entries = _evaluate(x, [function(x), ca.jacobian(function(x), x)], [Fraction(at)])
    assert not all(is_finite(v) for matrix in entries for row in matrix for v in row)


@pytest.mark.parametrize("name", BREAKS)
def test_a_ball_around_a_break_never_has_a_certain_value_and_derivative(name):
    function, at = BREAKS[name]
    x = ca.SX.sym("x")
    entries = _evaluate(x, [function(x), ca.jacobian(function(x), x)], [Fraction(at)], wide=Fraction(1, 10**60))
    assert not all(is_finite(v) for matrix in entries for row in matrix for v in row)


@pytest.mark.parametrize(
    "function",
    [ca.fabs, lambda x: ca.fmax(x, 0), lambda x: ca.if_else(x > 0, x**2, -x), lambda x: x**2.5],
)
def test_beside_a_break_value_and_derivative_are_certain_and_right(function):
    x = ca.SX.sym("x")
    for at in (Fraction(1, 7), Fraction(3)):
        (value,), (slope,) = (m[0] for m in _evaluate(x, [function(x), ca.jacobian(function(x), x)], [at]))
        step = 1e-6
        expected = (_casadi(x, function(x), [at + Fraction(step)]) - _casadi(x, function(x), [at - Fraction(step)])) / (
            2 * step
        )
        assert float(midpoint(slope)) == pytest.approx(expected, rel=1e-5)
        assert is_finite(value)


def test_rationals_stay_exact_as_long_as_they_can():
    x = ca.SX.sym("x")
    exact = (x**2 + 1) / (x - 3) + ca.sqrt(x) + ca.fabs(-x) + ca.fmin(x, 7) + ca.sin(x - 4) + ca.exp(x - 4)
    ((value,),) = _evaluate(x, [exact], [Fraction(4)])[0]
    assert value == fmpq(17 + 2 + 4 + 4 + 0 + 1)
    assert isinstance(value, fmpq)


def test_a_product_with_an_exact_zero_hides_nothing_undefined():
    assert not is_finite(REAL.mul(fmpq(0), arb.nan()))
    assert REAL.mul(fmpq(0), arb(2).sqrt()) == 0


def test_an_exact_zero_stays_exact_in_quotients():
    """The velocity M(q)^-1 p of a system at rest, where M(q) is only enclosed."""
    with precision(BITS):
        assert isinstance(REAL.div(fmpq(0), arb(2).sqrt()), fmpq)
        assert not is_finite(REAL.div(fmpq(0), arb(0, 1)))
        assert not is_finite(REAL.div(fmpq(0), arb.nan()))
        assert not is_finite(REAL.div(fmpq(0), fmpq(0)))


def test_a_square_is_not_negative():
    with precision(64):
        wide = enclose(Fraction(-1), Fraction(2))
    assert lower(REAL.sq(wide)) >= 0
    assert lower(REAL.mul(wide, wide)) >= 0
    assert lower(REAL.pow(wide, fmpq(4))) >= 0
    assert lower(REAL.fabs(wide)) >= 0


@pytest.mark.parametrize("name", ["tanh", "exp", "atan", "asinh", "erf", "sinh", "cosh"])
def test_wide_balls_of_monotone_functions_are_tight(name):
    with precision(64):
        value = getattr(REAL, name)(enclose(Fraction(1), Fraction(3)))
    ends = [getattr(math, name)(1.0), getattr(math, name)(3.0)]
    assert float(upper(value)) == pytest.approx(ends[1], rel=1e-6)
    assert float(lower(value)) == pytest.approx(ends[0], rel=1e-6)


def test_signs_are_certain_or_unknown():
    assert [sign(fmpq(v)) for v in (-2, 0, 3)] == [-1, 0, 1]
    with precision(64):
        assert sign(arb(1, 2)) is None
        assert sign(arb.nan()) is None
        assert sign(arb(0)) == 0
        assert sign(arb(-1, "0.5")) == -1


def test_a_ball_says_its_bounds():
    with precision(100):
        third = ball(fmpq(1, 3))
    assert lower(third) <= Fraction(1, 3) <= upper(third)
    assert lower(third) == midpoint(third) - radius(third)
    assert text(fmpq(1, 8)) == "0.125"
    assert text(arb.nan()) == "undefined"
    with pytest.raises(ValueError, match="finite"):
        midpoint(arb.nan())
