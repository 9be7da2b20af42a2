"""A proved bound for the error of the rational tanh on the whole line: python -m benchmarks.tanh_bound

The error has two parts. How far the rational function is from tanh is enclosed by Taylor polynomials in ball
arithmetic, on pieces of ``[0, END]``. What rounding adds follows from the standard model of floating-point arithmetic,
``fl(a op b) = (a op b)(1 + d)`` with ``abs(d) <= u``, carried through the Horner schemes piece by piece; all terms are
positive, and fused operations round less often. Beyond ``END`` the function is shown to exceed 1 by more than rounding
can take, so that the cut makes it 1. Below the pieces' resolution nothing is left out: the first piece starts at zero,
and where x^2 underflows P and Q round to P(0) = Q(0), a power of two.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from flint import arb, arb_series, ctx, fmpq, fmpq_poly

from pbcgen.law.arithmetic import Precision
from pbcgen.law.hyperbolic import DENOMINATOR, NUMERATOR
from pbcgen.law.rounding import nearest

ORDER: Final = 24
PIECE: Final = Fraction(1, 16)
#: Significand bits, and where the cut alone has taken over.
BITS: Final[dict[Precision, int]] = {"float": 24, "double": 53}
END: Final[dict[Precision, int]] = {"float": 11, "double": 20}


@dataclass(frozen=True)
class Bound:
    """The largest error: in units in the last place, and absolute."""

    ulp: float
    absolute: float


def proved(precision: Precision) -> Bound:
    """The bound for every argument. Raises ArithmeticError if the cut is not proved to take over at END."""
    old, ctx.prec = ctx.prec, 256
    cap, ctx.cap = ctx.cap, ORDER + 1
    try:
        P = _coefficients(NUMERATOR[precision], precision)
        Q = [*_coefficients(DENOMINATOR[precision], precision), Fraction(1)]
        end = Fraction(END[precision])
        largest = Bound(0.0, 0.0)
        at = Fraction(0)
        while at < end:
            found = _piece(P, Q, at, precision)
            largest = Bound(max(largest.ulp, found.ulp), max(largest.absolute, found.absolute))
            at += PIECE
        if not _cut_beyond(P, Q, end, _rounding(P, Q, None, precision)):
            raise ArithmeticError(f"beyond {end} the rational function may be below 1")
        return largest
    finally:
        ctx.prec, ctx.cap = old, cap


def _coefficients(values: tuple[float, ...], precision: Precision) -> list[Fraction]:
    return [Fraction(float(nearest(v, precision))) for v in values]


def _piece(P: list[Fraction], Q: list[Fraction], at: Fraction, precision: Precision) -> Bound:
    """The error on [at, at + PIECE]."""
    middle, r = _ball(at + PIECE / 2), _ball(PIECE / 2).upper()
    if at == 0:
        middle, r = arb(0), _ball(PIECE).upper()
    near, over = _error_series(P, Q, middle), _error_series(P, Q, middle + arb(0, r))
    low, top = _ball(at).tanh(), _ball(at + PIECE).tanh()
    if at == 0:  # the error is x^3 (...): its first coefficients are zero, so that it is divided by x term by term
        if near[0] != 0 or not abs(near[1]) < arb(2) ** -200:
            raise ArithmeticError("P(0) = Q(0) was expected")
        apart = sum((abs(near[k]) * r ** (k - 1) for k in range(2, ORDER)), arb(0)) + abs(over[ORDER]) * r ** (
            ORDER - 1
        )
        above = below = apart * _ball(PIECE) / top  # tanh(x) / x is at least what it is at the end
    else:
        swing = sum((abs(near[k]) * r**k for k in range(1, ORDER)), arb(0)) + abs(over[ORDER]) * r**ORDER
        above, below = (near[0] + swing) / low, (swing - near[0]) / low
    rounding = _rounding(P, Q, at, precision)
    # The cut leaves at most 1 - tanh above; below it takes nothing away.
    cut = (1 - low) / low if at else arb(1)
    high = min(_positive(above) * (1 + rounding) + rounding, cut.upper())
    total = max(high, _positive(below) + rounding).upper()
    unit = arb(1)  # of the largest power of two that tanh may just miss
    while at > 0 and top < unit / 2:
        unit = unit / 2
    own = arb(1) if at == 0 or low < unit / 2 else top / unit
    return Bound(float((total * own * arb(2) ** BITS[precision]).upper()), float((total * top).upper()))


def _error_series(P: list[Fraction], Q: list[Fraction], centre: arb) -> arb_series:
    """Taylor coefficients of ``x P(x^2) / Q(x^2) - tanh(x)``."""
    x = arb_series([centre, 1])
    y = x * x
    p, q = (_horner(c, y) for c in (P, Q))
    e = (x + x).exp()
    return x * p / q - (1 - 2 / (e + 1)) if centre != 0 else x * p / q - (e - 1) / (e + 1)


def _horner(coefficients: list[Fraction], y: arb_series) -> arb_series:
    total = arb_series([0])
    for c in reversed(coefficients):
        total = total * y + _ball(c)
    return total


def _positive(value: arb) -> arb:
    return max(value.upper(), arb(0))


def _rounding(P: list[Fraction], Q: list[Fraction], at: Fraction | None, precision: Precision) -> arb:
    """A bound of the relative rounding error of ``r * p / q`` on [at, at + PIECE]; for all r if at is None.

    In a Horner step ``w y + c`` the errors of w and of the product count as much as ``w y`` is of the sum, which is
    most at the largest y; then the sum is rounded. The error of y is common to P and Q: it counts with the slope of
    the logarithm of their quotient.
    """
    u = arb(2) ** -BITS[precision]
    y = None if at is None else (_ball(at + PIECE / 2) + arb(0, _ball(PIECE / 2).upper())) ** 2
    total, slope = arb(0), arb(0)
    for coefficients, sign in ((P, 1), (Q, -1)):
        w, e = _ball(coefficients[-1]), arb(0)
        for c in reversed(coefficients[:-1]):
            share = arb(1) if y is None else (w * y / (w * y + _ball(c))).upper()
            e = (share * ((1 + e) * (1 + u) - 1) + 1) * (1 + u) - 1
            w = w if y is None else w * y + _ball(c)
        total = (1 + total) * (1 + e) - 1
        degree = len(coefficients) - 1
        powers = [degree] if y is None else [k * _ball(c) * y**k / w for k, c in enumerate(coefficients)]
        slope = slope + abs(powers[0]) if y is None else slope + sign * sum(powers, arb(0))
    return (((1 + total) * (1 + u) ** 2 / (1 - total) * (1 + 2 * u * abs(slope))) - 1).upper()


def _cut_beyond(P: list[Fraction], Q: list[Fraction], end: Fraction, rounding: arb) -> bool:
    """Whether ``x P(x^2) > (1 + margin) Q(x^2)`` for all x >= end: all coefficients in x - end are positive."""
    margin = 2 * Fraction(float(rounding))
    odd, even = ([0] * (2 * len(P)) for _ in range(2))
    for k, (p, q) in enumerate(zip(P, Q, strict=True)):
        odd[2 * k + 1], even[2 * k] = p, q * (1 + margin)
    difference = fmpq_poly([fmpq(f.numerator, f.denominator) for f in map(Fraction, odd)]) - fmpq_poly(
        [fmpq(f.numerator, f.denominator) for f in map(Fraction, even)]
    )
    moved = difference(fmpq_poly([fmpq(end.numerator, end.denominator), 1]))
    return all(c > 0 for c in moved.coeffs())


def _ball(value: Fraction) -> arb:
    return arb(fmpq(value.numerator, value.denominator))


if __name__ == "__main__":
    for each in BITS:
        bound = proved(each)
        print(f"{each}: at most {bound.ulp:.2f} units in the last place, {bound.absolute:.3g} absolute")
