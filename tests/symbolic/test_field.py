"""Exact functions agree with balls and with CasADi, and know the identities that proofs need."""

import math
from fractions import Fraction

import casadi as ca
import pytest
from flint import arb
from graphs import ANALYTIC_BINARY, ANALYTIC_UNARY, OTHER_BINARY, OTHER_UNARY, POINTS, graphs, value
from hypothesis import given, settings
from hypothesis import strategies as st

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.real import BITS, REAL, approximate, is_finite, precision, rational
from pbcgen.symbolic.tape import Tape
from pbcgen.symbolic.to_sx import to_sx

NAMES = ("a", "b", "c")


def _exact(x, expression, values=None):
    field, (result,) = evaluate(Tape.of([x], [expression]), NAMES[: x.numel()], values)
    return result.scalar(field.const(0))


def _is_identity(make, count=2):
    x = ca.SX.sym("x", count)
    return _exact(x, make(*ca.vertsplit(x))).is_zero()


def _is_undefined_nearby(tape, reals):
    """Whether the value is isolated, as that of b^c is at (-1, 2): around it nothing is defined."""
    nudges = [
        [v + rational(Fraction(d, 10**9)) if k == j else v for k, v in enumerate(reals)]
        for j in range(3)
        for d in (-1, 1)
    ]
    return not all(is_finite(tape.walk(REAL, [near])[0].scalar(rational(0))) for near in nudges)


@settings(max_examples=250, deadline=None)
@given(graphs(ANALYTIC_UNARY, ANALYTIC_BINARY, size=6))
def test_an_exact_function_a_ball_and_casadi_agree(case):
    x, expression = case
    tape = Tape.of([x], [expression])
    try:
        exact = _exact(x, expression)
    except (ZeroDivisionError, UnsupportedOperation):
        return
    if max(len(exact.numerator), len(exact.denominator)) > 300:
        return
    function = ca.Function("f", [x], [expression])
    for point in POINTS:
        with precision(BITS):
            reals = [rational(v) for v in point]
            ball = tape.walk(REAL, [reals])[0].scalar(rational(0))
            if not is_finite(ball):
                continue
            there = value(exact, reals)
            if not is_finite(there):
                assert _is_undefined_nearby(tape, reals)
                continue
        with precision(BITS):
            assert arb(there).overlaps(arb(ball))
        expected = float(function([float(v) for v in point]))
        if math.isfinite(expected) and abs(expected) < 1e8:
            assert approximate(there) == pytest.approx(expected, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("name", [*ANALYTIC_UNARY])
def test_every_analytic_operation_has_its_value(name):
    x = ca.SX.sym("x")
    exact = _exact(x, ANALYTIC_UNARY[name](x))
    for at in (Fraction(1, 4), Fraction(7, 4), Fraction(-1, 3)):
        expected = float(ca.Function("f", [x], [ANALYTIC_UNARY[name](x)])(float(at)))
        if math.isfinite(expected):
            with precision(BITS):
                assert approximate(value(exact, [rational(at)])) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("name", [*OTHER_UNARY, *OTHER_BINARY])
def test_an_operation_that_is_not_analytic_is_refused(name):
    x = ca.SX.sym("x", 2)
    expression = OTHER_UNARY[name](x[0]) if name in OTHER_UNARY else OTHER_BINARY[name](x[0], x[1])
    with pytest.raises(UnsupportedOperation):
        _exact(x, expression)


IDENTITIES = {
    "pythagoras": lambda a, b: ca.sin(a) ** 2 + ca.cos(a) ** 2 - 1,
    "pythagoras of a sum": lambda a, b: ca.sin(a + b) ** 2 + ca.cos(a + b) ** 2 - 1,
    "addition of cosines": lambda a, b: ca.cos(a + b) - ca.cos(a) * ca.cos(b) + ca.sin(a) * ca.sin(b),
    "addition of sines": lambda a, b: ca.sin(a - b) - ca.sin(a) * ca.cos(b) + ca.cos(a) * ca.sin(b),
    "double angle": lambda a, b: ca.sin(2 * a) - 2 * ca.sin(a) * ca.cos(a),
    "half angle": lambda a, b: ca.cos(a) - 1 + 2 * ca.sin(a / 2) ** 2,
    "seven angles": lambda a, b: ca.cos(7 * a + b) ** 2 + ca.sin(b + 7 * a) ** 2 - 1,
    "incommensurable decimals": lambda a, b: ca.cos(0.3 * a + 0.7 * a) - ca.cos(a),
    "tangent": lambda a, b: ca.tan(a) * ca.cos(a) - ca.sin(a),
    "exponentials": lambda a, b: ca.exp(a + 2 * b) - ca.exp(a) * ca.exp(b) ** 2,
    "inverse exponential": lambda a, b: ca.exp(-a) * ca.exp(a) - 1,
    "hyperbolic": lambda a, b: ca.cosh(a) ** 2 - ca.sinh(a) ** 2 - 1,
    "logarithm": lambda a, b: ca.exp(ca.log(a)) - a,
    "powers": lambda a, b: a**2.5 - a**2 * ca.sqrt(a),
    "root": lambda a, b: ca.sqrt(1 + a**2) ** 2 - 1 - a**2,
    "root of a quotient": lambda a, b: ca.hypot(a, b) ** 2 - a**2 - b**2,
    "odd": lambda a, b: ca.tanh(-a * b) + ca.tanh(a * b) + ca.atan(b - a) + ca.atan(a - b),
    "fraction": lambda a, b: 1 / (a - b) - (a + b) / (a**2 - b**2),
    "at zero": lambda a, b: ca.sin(a - a) + ca.tanh(0 * a) + ca.exp(a - a) - 1 + ca.log(1 + a - a),
}


@pytest.mark.parametrize("name", IDENTITIES)
def test_an_identity_is_zero(name):
    assert _is_identity(IDENTITIES[name])


@pytest.mark.parametrize("name", IDENTITIES)
def test_an_identity_that_is_disturbed_is_not_zero(name):
    make = IDENTITIES[name]
    assert not _is_identity(lambda a, b: make(a, b) + 1e-12 * a)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(-9, 9), min_size=3, max_size=3), st.integers(1, 30))
def test_sines_of_commensurable_sums_keep_their_identities(weights, divisor):
    assert _is_identity(
        lambda a, b: (
            ca.sin((weights[0] * a + weights[1] * b) / divisor) ** 2
            + ca.cos((weights[1] * b + weights[0] * a) / divisor) ** 2
            - 1
        )
    )


def test_parameters_take_their_exact_values():
    x = ca.SX.sym("x", 2)
    exact = _exact(x, x[0] * x[1] + ca.sin(x[1] - 2), {"b": Fraction(2)})
    assert exact.constant() is None
    assert exact.symbols() == {0}
    assert _exact(x, x[1] * 3 - 6 + x[0] * 0, {"b": Fraction(2)}).is_zero()


def test_a_division_by_the_zero_function_is_an_error():
    x = ca.SX.sym("x", 2)
    with pytest.raises(ZeroDivisionError):
        _exact(x, x[0] / (ca.sin(2 * x[1]) - 2 * ca.sin(x[1]) * ca.cos(x[1])))


def test_an_exact_function_goes_back_to_casadi():
    x = ca.SX.sym("x", 2)
    expression = ca.sin(2 * x[0]) * x[1] / (1 + x[0] ** 2) + ca.exp(x[0] / 4) - 0.7 * ca.tanh(5 * x[1])
    field, (result,) = evaluate(Tape.of([x], [expression]), NAMES[:2])
    back = to_sx(result.scalar(field.const(0)), ca.vertsplit(x))
    difference = ca.Function("d", [x], [back - expression])
    for point in POINTS:
        assert abs(float(difference([float(v) for v in point[:2]]))) < 1e-13


def test_a_coefficient_that_casadi_would_round_does_not_go_back_unnoticed():
    x = ca.SX.sym("x", 2)
    field, (result,) = evaluate(Tape.of([x], [x[0] / 3]), NAMES[:2])
    third = result.scalar(field.const(0))
    with pytest.raises(UnsupportedOperation, match="1/3"):
        to_sx(third, ca.vertsplit(x))
    kept = []

    def number(value, inside):
        kept.append((value, inside))
        return ca.SX.sym("c")

    to_sx(third, ca.vertsplit(x), number)
    assert kept == [(Fraction(1, 3), False)]


def test_a_function_of_a_number_is_not_computed_by_casadi():
    """exp(2) is no double; neither is sin(2) if 2 is put in for x of sin(x) later."""
    x = ca.SX.sym("x", 2)
    field, (result,) = evaluate(Tape.of([x], [ca.exp(x[1]) * x[0]]), NAMES[:2], {NAMES[1]: Fraction(2)})
    value = result.scalar(field.const(0))
    with pytest.raises(UnsupportedOperation, match="number 2"):
        to_sx(value, ca.vertsplit(x))
    made = []

    def number(value, inside):
        made.append((value, inside))
        return ca.SX.sym("c") if inside else ca.SX(float(value))

    to_sx(value, ca.vertsplit(x), number)
    assert made == [(Fraction(2), True)]
    assert to_sx(field.const(2), ca.vertsplit(x), number, alone=True).is_symbolic()


def test_numbers_know_that_they_are_constant():
    x = ca.SX.sym("x", 2)
    assert _exact(x, (x[0] + 1) ** 2 - x[0] ** 2 - 2 * x[0]).constant() == 1
    assert _exact(x, x[0] - x[0]).constant() == 0
    assert _exact(x, x[0] / x[1]).constant() is None
    assert not _exact(x, x[0] / x[1]).is_polynomial()
