"""Krawczyk's test encloses true zeros only; bounds by branch and bound are bounds."""

from fractions import Fraction

import numpy as np
import pytest
from flint import arb, fmpq
from hypothesis import given, settings
from hypothesis import strategies as st

from pbcgen.proof.extrema import maximum
from pbcgen.proof.newton import Search, find_zeros, float_newton, krawczyk, polish
from pbcgen.symbolic.real import BITS, ball, midpoint, precision, radius, rational, upper


def _square_root(c):
    def system(z):
        return [z[0] * z[0] - rational(Fraction(c))], [[z[0] * 2]]

    return system


def test_the_square_root_of_two_is_enclosed():
    with precision(BITS):
        centre = polish(_square_root(2), [1.4])
        (enclosure,) = krawczyk(_square_root(2), centre)
        assert enclosure.contains(arb(2).sqrt())
    assert radius(enclosure) < Fraction(1, 10**70)


def test_a_point_that_is_no_zero_is_not_enclosed():
    with precision(BITS):
        assert krawczyk(_square_root(2), [Fraction(14142135, 10**7)]) is None
        assert krawczyk(_square_root(-1), [Fraction(0)]) is None


def test_a_double_zero_is_not_enclosed():
    def system(z):
        return [z[0] * z[0]], [[z[0] * 2]]

    with precision(BITS):
        assert krawczyk(system, [Fraction(0)]) is None
        assert krawczyk(system, [Fraction(1, 10**75)]) is None


def test_a_zero_beside_the_box_is_not_enclosed():
    """The zero of x - 1e-60 lies outside the box of half-width 1e-70 around 0."""

    def system(z):
        return [z[0] - rational(Fraction(1, 10**60))], [[fmpq(1)]]

    with precision(BITS):
        found = krawczyk(system, [Fraction(0)])
    assert found is None


def test_two_zeros_within_one_box_are_not_called_one():
    """x (x - 1e-80) has two zeros in the box around 0."""
    gap = rational(Fraction(1, 10**80))

    def system(z):
        return [z[0] * (z[0] - gap)], [[z[0] * 2 - gap]]

    with precision(BITS):
        assert krawczyk(system, [Fraction(0)]) is None


def test_an_undefined_function_is_not_enclosed():
    def system(z):
        return [arb.nan()], [[fmpq(1)]]

    with precision(BITS):
        assert krawczyk(system, [Fraction(0)]) is None
        assert polish(system, [0.0]) is None


def test_a_step_too_small_to_be_written_down_is_none():
    """exp(-exp(20)) is below 2^-10^6."""

    def system(z):
        small = (-((ball(z[0]) + 20).exp())).exp()
        return [small], [[fmpq(1)]]

    with precision(BITS):
        assert polish(system, [0.0]) is None


@pytest.mark.parametrize("start", [1.0, 0.3, -7.0])
def test_what_newton_in_doubles_takes_for_a_zero_is_not_enclosed_unless_it_is_one(start):
    """x^2 + 1 has no real zero; in doubles the search may stop where the slope vanishes."""

    def system(z):
        return np.array([z[0] ** 2 + 1]), np.array([[2 * z[0]]])

    zero = float_newton(system, np.array([start]))
    with precision(BITS):
        centre = None if zero is None else polish(_square_root(-1), zero.tolist())
        assert centre is None or krawczyk(_square_root(-1), centre) is None


def test_the_search_finds_every_zero_of_a_cubic_once():
    def system(z):
        return np.array([z[0] ** 3 - z[0]]), np.array([[3 * z[0] ** 2 - 1]])

    zeros = find_zeros(system, Search(np.array([-np.inf]), np.array([np.inf])))
    np.testing.assert_allclose(np.array(zeros).ravel(), [-1, 0, 1], atol=1e-9)
    inside = find_zeros(system, Search(np.array([0.5]), np.array([7.0])))
    np.testing.assert_allclose(np.array(inside).ravel(), [1], atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(-4, 4), min_size=2, max_size=4))
def test_the_bound_of_a_trigonometric_sum_is_a_bound_and_nearly_attained(weights):
    def function(x):
        value = ball(x[0])
        return sum(((value * (k + 1)).sin() * w for k, w in enumerate(weights)), arb(0))

    box = ((Fraction(-4), Fraction(4)),)
    with precision(64):
        attained, bound = maximum(function, box, budget=400)
    points = np.linspace(-4, 4, 4001)
    sampled = max(sum(w * np.sin((k + 1) * p) for k, w in enumerate(weights)) for p in points)
    assert bound >= Fraction(sampled) - Fraction(1, 10**12)
    assert attained <= bound
    assert float(bound - attained) < 0.05


def test_a_bound_is_exact_where_the_boxes_differ_by_less_than_a_double():
    """On [0, 1] the maximum of x + 2^-80 step is above every double that rounds it."""

    def function(x):
        return ball(x[0]) + rational(Fraction(1, 2**80))

    with precision(200):
        _, bound = maximum(function, ((Fraction(0), Fraction(1)),), budget=200)
    assert bound >= 1 + Fraction(1, 2**80)


def test_a_function_with_a_pole_has_no_bound():
    with precision(64):
        assert maximum(lambda x: 1 / ball(x[0]), ((Fraction(-1), Fraction(1)),))[1] is None


def test_an_interrupted_search_still_bounds():
    with precision(64):
        attained, bound = maximum(lambda x: (ball(x[0]) * 50).sin(), ((Fraction(0), Fraction(1)),), budget=3)
    assert bound >= 1 - Fraction(1, 10**9)
    assert attained is None or attained <= bound


def test_a_midpoint_lies_inside():
    with precision(100):
        value = arb(2).sqrt()
    assert abs(midpoint(value) ** 2 - 2) < Fraction(1, 2**90)
    assert upper(value) >= midpoint(value)


@pytest.mark.parametrize("start", [1e308, float("nan"), float("inf")])
def test_a_start_beyond_reach_gives_no_zero(start):
    def system(z):
        return np.array([np.exp(z[0]) - 1]), np.array([[np.exp(z[0])]])

    assert float_newton(system, np.array([start])) is None


def test_a_start_where_the_slope_is_infinite_is_given_up_at_once():
    """sqrt(x) at 0; a least-squares solver may never return from an infinite entry."""

    def system(z):
        with np.errstate(all="ignore"):
            root = np.sqrt(z)
            return np.array([root[0] - root[1], root[1] - 1]), np.array([0.5 / root, [0, 0.5 / root[1]]]) * [[1], [-1]]

    assert float_newton(system, np.array([0.0, 0.0])) is None
