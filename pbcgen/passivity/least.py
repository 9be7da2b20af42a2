"""A constant that a function never falls below, nearly the largest."""

from __future__ import annotations

from fractions import Fraction
from math import floor, isfinite, log10

from pbcgen.models.exact import rounded_down
from pbcgen.proof.nonnegative import nonnegative
from pbcgen.proof.spot import Spots
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import fraction


def constant_below(function: Quotient, weight: Quotient | None = None) -> Fraction:
    """A constant c that ``function >= c`` everywhere, as large as the provers show, or zero if none is positive.

    Tried are its least values at a few points, rounded down, and what other terms may leave of the largest.

    Args:
        function: a nonnegative function.
        weight: one that is nowhere negative, for functions with poles: ``weight (function - c) >= 0`` is shown.
    """

    def holds(c: Fraction) -> bool:
        rest = function - function.field.const(c)
        return nonnegative(rest if weight is None else weight * rest)

    return next((c for c in _lower_bounds(function) if c > 0 and holds(c)), Fraction(0))


def _lower_bounds(function: Quotient) -> list[Fraction]:
    """Candidates for the least value, largest first."""
    above, below = ([fraction(c) for c in p.to_dict().values()] for p in (function.numerator, function.denominator))
    scale = sum(map(abs, below), Fraction(0))
    found = {max(above) / scale, (2 * max(above) - sum(map(abs, above), Fraction(0))) / scale}
    least = Spots(function.field).least(function)
    if isfinite(least) and least > 0:
        exponent = floor(log10(least))
        found |= {rounded_down(Fraction(least), digits) for digits in range(1, 5)}
        found |= {Fraction(1, 10) ** k for k in (-exponent + 1, -exponent + 2)}
    return sorted(found, reverse=True)
