"""The scalar loop ``s + mu tanh(s) = r`` with a single evaluation of tanh.

For a fixed mu a start s_0(r) that is off by e is turned into the result t = tanh(s) by one Taylor step of the inverse
function. With ``t_0 = tanh(s_0)``, ``d = 1 - t_0^2``, the residual ``F = (s_0 - r) + mu t_0``, ``w = 1 / (1 + mu d)``
and ``q = F w``, the Newton step,

    order 1:  t = t_0 - d F
    order 2:  t = t_0 - d q
    order 3:  t = t_0 - d q (1 + w q t_0)
    order 4:  t = t_0 - d q (1 + w q (t_0 - q (1/3 + t_0^2 (1 - 2 w))))

is off by a multiple of e^order that is small when mu is large: w is then small, and an error of s hardly moves t.
(Order 1 takes w for 1, which is good for a small mu.)

The start is a piecewise polynomial. Near zero it is odd, so that small r are solved with a small relative error; in
the end it is the asymptote r - mu. :func:`taylor_solve` tries the forms below, the cheapest first, and takes the first
whose error is below the tolerance for every r. That bound is computed in ball arithmetic, over cells of the root s that
cover all r. Everything is computed in exact or ball arithmetic or with single IEEE operations, so it is the same on
every machine.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from math import cos, inf, log, pi
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from flint import arb, arb_series, ctx
from numpy.typing import NDArray

from pbcgen.control.hyperbolic import fast_tanh_of_magnitude
from pbcgen.control.law import Start, Taylor
from pbcgen.control.rounding import nearest
from pbcgen.errors import EmitError
from pbcgen.symbolic.real import precision, rational

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence


Array = NDArray[Any]

#: The largest error of t, in exact arithmetic; about that of the fast tanh itself.
TOLERANCE: Final = 3e-7

#: (odd coefficients, degree of the middle piece or None, whether the asymptote is a piece, order), cheapest first.
_FORMS: Final = (
    (1, None, False, 1),
    (1, None, False, 2),
    (1, None, False, 3),
    (1, None, True, 2),
    (1, None, True, 3),
    (2, None, True, 3),
    (2, None, True, 4),
    (3, None, True, 4),
    (2, 2, True, 4),
    (3, 2, True, 4),
    (3, 3, True, 4),
    (4, 3, True, 4),
    (4, 4, True, 4),
)

#: Beyond this mu none of the forms is good enough.
_LARGEST: Final = 2000

#: A start without the asymptote as a piece drifts away from the root; harmless for small mu only.
_LARGEST_WITHOUT_ASYMPTOTE: Final = Fraction(1, 5)

#: Cells of s in the certificate are halved until they prove the bound, down to the narrowest.
_WIDEST: Final = Fraction(1, 16)
_NARROWEST: Final = Fraction(1, 4096)

#: Terms of the Taylor series over a cell.
_TERMS: Final = 4

#: Number of points on which candidates are compared.
_GRID: Final = 400


@lru_cache(maxsize=64)
def taylor_solve(mu: Fraction) -> Taylor | None:
    """The cheapest start and order that meet TOLERANCE for every r, in float; None if none of the forms does."""
    if not 0 < mu <= _LARGEST:
        return None
    with precision(96):
        for form in _FORMS:
            solve = _best(mu, *form)
            if solve is not None:
                return solve
    return None


def _best(mu: Fraction, odd: int, middle: int | None, asymptote: bool, order: int) -> Taylor | None:
    """The best start of one form, if its certified error is below the tolerance."""
    if not asymptote and mu > _LARGEST_WITHOUT_ASYMPTOTE:
        return None
    curve = _Curve(mu)
    starts = list(_starts(curve, odd, middle, asymptote))
    errors = [_estimate(curve, start, order) for start in starts]
    if not errors or not min(errors) <= TOLERANCE:
        return None
    start = starts[errors.index(min(errors))]
    bound = certified_error(mu, start, order)
    return Taylor(start, order, bound) if bound <= TOLERANCE else None


class _Curve:
    """Points (r, s, t) of the solution on a grid, as doubles, and the root for any r."""

    def __init__(self, mu: Fraction) -> None:
        self.exact = mu
        self.mu = float(mu)
        self.ball = arb(rational(mu))
        self.end = _end(mu)
        s = [arb(rational(self.end * k / _GRID)) for k in range(1, _GRID + 1)]
        self.t: Array = np.array([float(v.tanh()) for v in s])
        self.r: Array = np.array([float(v + self.ball * v.tanh()) for v in s])

    def r_of(self, s: float) -> float:
        """The r whose root is s."""
        return float(arb(s) + self.ball * arb(s).tanh())

    def root(self, r: float) -> float:
        """The root for r > 0, by Newton's method from the left."""
        target = arb(r)
        s = max(r / (1 + self.mu), r - self.mu)
        for _ in range(100):
            point = arb(s)
            following = float(point - (point + self.ball * point.tanh() - target) / (1 + self.ball * point.sech() ** 2))
            if abs(following - s) <= 1e-15 * s:
                return following
            s = following
        return s


def _end(mu: Fraction) -> Fraction:
    """Beyond this s the error is below 1e-9: tanh is 1 to within exp(-2 s)."""
    return Fraction(16) + Fraction((1 + mu).__ceil__().bit_length())


def _starts(curve: _Curve, odd: int, middle: int | None, asymptote: bool) -> Iterator[Start]:
    """Candidates of one form, with different knots."""
    if not asymptote:
        yield Start((_float(1 / (1 + curve.mu)),))
        return
    reach = 3 + log(1 + curve.mu) / 2
    eighths = range(2, int(8 * reach))
    if middle is None:
        for k in eighths:
            knot = curve.r_of(k / 8)
            yield from _rounded(_odd_piece(curve, knot, odd), (), (knot,))
        return
    for a in eighths[2::2]:
        first = curve.r_of(a / 8)
        low = _odd_piece(curve, first, odd)
        for b in eighths[a + 4 :: 2]:
            second = curve.r_of(b / 8)
            nodes = _chebyshev(first, second, middle + 1)
            shifted = [r - first for r in nodes]
            yield from _rounded(low, _interpolant(shifted, [curve.root(r) for r in nodes]), (first, second))


def _rounded(low: Sequence[float], middle: Sequence[float], knots: Sequence[float]) -> Iterator[Start]:
    """The start in float; nothing if a coefficient vanishes there."""
    try:
        yield Start(tuple(map(_float, low)), tuple(map(_float, middle)), tuple(map(_float, knots)))
    except EmitError:
        return


def _float(value: float) -> float:
    return float(nearest(Fraction(value), "float"))


def _odd_piece(curve: _Curve, knot: float, count: int) -> list[float]:
    """Coefficients of ``s = r (a_0 + a_1 r^2 + ...)`` on [0, knot], by interpolation."""
    squares = _chebyshev(0.0, knot * knot, count)
    return _interpolant(squares, [curve.root(y**0.5) / y**0.5 for y in squares])


def _chebyshev(low: float, high: float, count: int) -> list[float]:
    """Chebyshev's points of an interval, to 12 digits so that every machine has the same."""
    points = (round(cos(pi * (k + 0.5) / count), 12) for k in range(count))
    return [(low + high) / 2 + (high - low) / 2 * point for point in points]


def _interpolant(x: Sequence[float], y: Sequence[float]) -> list[float]:
    """The polynomial through the points, coefficients from the constant up, computed exactly."""
    nodes = [Fraction(v) for v in x]
    divided = [Fraction(v) for v in y]
    for k in range(1, len(nodes)):
        for i in range(len(nodes) - 1, k - 1, -1):
            divided[i] = (divided[i] - divided[i - 1]) / (nodes[i] - nodes[i - k])
    result = [divided[-1]]
    for node, value in zip(reversed(nodes[:-1]), reversed(divided[:-1]), strict=True):
        shifted = [Fraction(0), *result]
        result = [a - node * b for a, b in zip(shifted, [*result, Fraction(0)], strict=True)]
        result[0] += value
    return [float(v) for v in result]


def _estimate(curve: _Curve, start: Start, order: int) -> float:
    """The error of t on the grid, roughly; it only ranks candidates."""
    s = start_at(start, curve.r, curve.mu)
    if not np.all(s > 0):
        return inf
    t = fast_tanh_of_magnitude(s)
    return float(np.max(np.abs(taylor_step(t, s, curve.r, np.float64(curve.mu), order) - curve.t)))


def start_at(start: Start, r: Array, mu: Array | np.floating[Any] | float) -> Array:
    """s_0(r) for r >= 0, elementwise, in the arithmetic of r and with the operations of the C in their order."""
    real = r.dtype.type
    result: Array = r * _horner(start.low, r * r)
    if start.middle:
        result = np.where(r < real(start.knots[0]), result, _horner(start.middle, r - real(start.knots[0])))
    if start.knots:
        result = np.where(r < real(start.knots[-1]), result, r - mu)
    return result


def _horner(coefficients: Sequence[float], y: Array) -> Array:
    real = y.dtype.type
    result: Array = np.full_like(y, real(coefficients[-1]))
    for coefficient in reversed(coefficients[:-1]):
        result = result * y + real(coefficient)
    return result


def taylor_step(t: Array, s: Array, r: Array, mu: Array | np.floating[Any], order: int) -> Array:
    """The result from t = tanh(s) at the start s, with the operations of the C in their order."""
    one = t.dtype.type(1)
    square = t * t
    d = one - square
    w = one / (one + mu * d) if order > 1 else one
    q = ((s - r) + mu * t) * w
    factor: Any = one
    if order == 3:
        factor = one + w * q * t
    elif order == 4:
        third = t.dtype.type(1 / 3)
        factor = one + w * q * (t - q * (third + square * (one - (w + w))))
    result: Array = t - d * q * factor
    return result


# --- the certificate -----------------------------------------------------------------------------------------------


def certified_error(mu: Fraction, start: Start, order: int) -> float:
    """A bound of the error of t over all r, in exact arithmetic but with the rounded coefficients of the start.

    The search ends where a cell shows that the bound will be above TOLERANCE.
    """
    with precision(96):
        m = arb(rational(mu))
        worst = 1e-9  # beyond the last cell
        cells = [(k * _WIDEST, (k + 1) * _WIDEST) for k in range(int(_end(mu) / _WIDEST))]
        while cells:
            left, right = cells.pop()
            error = _cell_error(m, left, right, start, order)
            if error > TOLERANCE and right - left > _NARROWEST:
                middle = (left + right) / 2
                cells += [(left, middle), (middle, right)]
                continue
            worst = max(worst, error)
            if worst > TOLERANCE:
                break
    return worst


def _cell_error(mu: arb, left: Fraction, right: Fraction, start: Start, order: int) -> float:
    """The largest error for roots in [left, right], over the pieces of the start that r may lie in."""
    a, b = arb(rational(left)), arb(rational(right))
    r_low, r_high = a + mu * a.tanh(), b + mu * b.tanh()
    edges = [arb(0), *(arb(knot) for knot in start.knots), arb(inf)]
    worst = 0.0
    for k, (low, high) in enumerate(pairwise(edges)):
        if not (r_high < low or r_low > high):
            worst = max(worst, _piece_error(mu, a, b, _piece(start, k, mu), order))
    return worst


def _piece(start: Start, k: int, mu: arb) -> Callable[[arb_series], arb_series]:
    """The polynomial of piece k."""
    if k == 0:
        return lambda r: r * _polynomial(start.low, r * r)
    if k == 1 and start.middle:
        return lambda r: _polynomial(start.middle, r - arb(start.knots[0]))
    return lambda r: r - mu


def _polynomial(coefficients: Sequence[float], variable: arb_series) -> arb_series:
    result = arb_series([arb(coefficients[-1])])
    for coefficient in reversed(coefficients[:-1]):
        result = result * variable + arb(coefficient)
    return result


def _piece_error(mu: arb, a: arb, b: arb, piece: Callable[[arb_series], arb_series], order: int) -> float:
    """The largest error for roots in [a, b]: Taylor's formula at the middle, with the last derivative over the cell."""
    before, ctx.cap = ctx.cap, _TERMS
    try:
        at_middle = _error(mu, ((a + b) / 2).mid(), piece, order)
        over_cell = _error(mu, a.union(b), piece, order)
        half = (b - a) / 2
        bound = abs(over_cell[_TERMS - 1]) * half ** (_TERMS - 1)
        for k in range(_TERMS - 1):
            bound += abs(at_middle[k]) * half**k
    finally:
        ctx.cap = before
    return float(bound.upper()) * (1 + 1e-15) if bound.is_finite() else inf


def _error(mu: arb, root: arb, piece: Callable[[arb_series], arb_series], order: int) -> arb_series:
    """The error of t as a series in the root s."""
    s = arb_series([root, 1])
    exact = _tanh(s)
    r = s + mu * exact
    at = piece(r)
    t = _tanh(at)
    d = 1 - t * t
    w = 1 / (1 + mu * d) if order > 1 else arb_series([1])
    q = ((at - r) + mu * t) * w
    factor = arb_series([1])
    if order == 3:
        factor = 1 + w * q * t
    elif order == 4:
        factor = 1 + w * q * (t - q * (arb(1) / 3 + t * t * (1 - 2 * w)))
    return t - d * q * factor - exact


def _tanh(x: arb_series) -> arb_series:
    return 1 - 2 / ((2 * x).exp() + 1)
