from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pbcgen.errors import EmitError
from pbcgen.law.rounding import inward, nearest

ORDINARY = st.fractions(min_value=-(10**30), max_value=10**30).filter(lambda v: v == 0 or abs(v) > Fraction(1, 10**30))


@given(ORDINARY, st.sampled_from(["float", "double"]))
def test_no_neighbour_is_nearer(value, precision):
    found = nearest(value, precision)
    error = abs(Fraction(float(found)) - value)
    for direction in (-np.inf, np.inf):
        neighbour = np.nextafter(found, found.dtype.type(direction))
        assert error <= abs(Fraction(float(neighbour)) - value)


def test_a_decimal_is_not_rounded_twice():
    just_above_half = 1 + Fraction(1, 2**24) + Fraction(1, 2**70)
    assert nearest(just_above_half, "float") == np.float32(1 + 2**-23)
    assert np.float32(float(just_above_half)) == 1  # what rounding to double first gives


def test_ties_go_to_even():
    assert nearest(1 + Fraction(1, 2**24), "float") == 1
    assert nearest(1 + Fraction(3, 2**24), "float") == np.float32(1 + 2**-22)


@pytest.mark.parametrize(
    "value", [Fraction(10) ** 39, -(Fraction(10) ** 400), Fraction(1, 10**39), Fraction(1, 10**400)]
)
def test_what_overflows_or_vanishes_is_refused(value):
    with pytest.raises(EmitError, match=r"the gain .* choose double precision or other units"):
        nearest(value, "float", "the gain")


@given(ORDINARY, ORDINARY, st.sampled_from(["float", "double"]))
def test_inward_bounds_are_inside_and_tight(a, b, precision):
    lo, hi = min(a, b), max(a, b)
    try:
        low, high = inward((lo, hi), precision, "it")
    except EmitError:
        assert hi - lo < Fraction(1, 10**6) * max(1, abs(lo))
        return
    assert lo <= Fraction(float(low)) <= Fraction(float(high)) <= hi
    assert Fraction(float(np.nextafter(low, low.dtype.type(-np.inf)))) < lo
    assert Fraction(float(np.nextafter(high, high.dtype.type(np.inf)))) > hi
