"""The scalar loop ``s + mu tanh(s) = c`` for a constant mu, with its result t = tanh(s) fitted as a function of c.

Nothing is iterated; there are two forms.

**Correction**, for a small mu. With ``T = tanh(c)``, which the code evaluates anyway, t is a smooth function of T:

    t = T - T (1 - T^2) p(T^2)

with a polynomial p of a few coefficients; T = -1, 0, 1 stay as they are. Its singularities are those of the loop, where
cosh^2(s) = -mu, and the nearest one moves in from infinity as mu grows.

**Pieces**, for a large mu: near zero odd and rational, ``t = c P(y)/Q(y)`` with ``y = c^2`` or ``y = length - c^2``
(where singularities lie just beyond, P and Q have positive terms in the latter, and nothing cancels); beyond a knot
rational in the distance to it, ``t = sign(c) P(v)/Q(v)``, ``v = abs(c) - knot``. In the last piece v is cut at its
length, where t is almost 1. P and Q have the degree of the fast tanh, and the magnitude of t is cut at 1 likewise.

:func:`fitted_solve` takes the first form and size whose error is below the tolerance for every c. That bound is
computed in ball arithmetic with the rounded coefficients, over cells of the root s that cover all c.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import chain, pairwise
from math import inf
from typing import Any, Final

import numpy as np
from flint import arb, arb_series, ctx
from numpy.typing import NDArray

from pbcgen.errors import EmitError
from pbcgen.law.hyperbolic import cut_ratio, fast_tanh, polynomial
from pbcgen.law.law import Fit, Piece
from pbcgen.law.minimax import chebyshev, horner
from pbcgen.law.minimax import rational as best_rational
from pbcgen.law.rounding import nearest
from pbcgen.symbolic.real import precision, rational

Array = NDArray[Any]

#: The largest error of t, in exact arithmetic: that of the fast tanh itself.
TOLERANCE: Final = 3.5e-7

#: Degree of P and Q: that of the fast tanh in float, so that both can share a function.
DEGREE: Final = 4

#: Corrections have at most so many coefficients; more cost more than pieces do.
_MOST_COEFFICIENTS: Final = 3

#: Beyond this mu, or with more pieces, Newton's method is the better one.
_LARGEST: Final = 2000
_MOST_PIECES: Final = 4

#: The fit of a piece may be off by this before its coefficients are rounded.
_AIM: Final = 2e-7

#: Beyond this s, tanh(s) is taken for 1: it is off by 8e-8.
_END: Final = Fraction(17, 2)

#: Points of a fit, and bits of its arithmetic.
_POINTS: Final = 48
_BITS: Final = 192

#: A piece ends a multiple of this behind its beginning, in s; and how many are tried.
_STRIDE: Final = Fraction(1, 4)
_STRIDES: Final = 16

#: The terms of P and Q may be so many times larger than their sum.
_LARGEST_CANCELLATION: Final = 4.0

#: Cells of s in the certificate are halved until their bound is near the largest error seen, down to the narrowest.
_WIDEST: Final = Fraction(1, 16)
_NARROWEST: Final = Fraction(1, 4096)
_NEAR: Final = 1.05

#: Terms of the Taylor series over a cell.
_TERMS: Final = 4


@lru_cache(maxsize=64)
def fitted_solve(mu: Fraction) -> Fit | None:
    """The cheapest fit that meets TOLERANCE for every c, in float; None if none of the forms does."""
    if not 0 < mu <= _LARGEST:
        return None
    with precision(_BITS):
        for fit in chain(_corrections(mu), _piecewise(mu)):
            bound = certified_error(mu, fit)
            if bound <= TOLERANCE:
                return Fit(fit.correction, fit.pieces, bound)
    return None


# --- finding a fit -------------------------------------------------------------------------------------------------


def _corrections(mu: Fraction) -> Iterator[Fit]:
    """Corrections with more and more coefficients, until the fit is good enough."""
    m = arb(rational(mu))
    s = chebyshev(0, float(_END), _POINTS)
    T = [(v + m * v.tanh()).tanh() for v in s]
    weights = [v * (1 - v * v) for v in T]
    values = [(a - v.tanh()) / w for a, v, w in zip(T, s, weights, strict=True)]
    for count in range(1, _MOST_COEFFICIENTS + 1):
        error, P, _ = best_rational([v * v for v in T], values, weights, (count - 1, 0))
        if error <= TOLERANCE:
            rounded = _floats(P)
            if rounded:
                yield Fit(rounded, (), inf)


def _piecewise(mu: Fraction) -> Iterator[Fit]:
    """Pieces from zero outwards, each as long as its fit is good enough."""
    curve = _Curve(mu)
    low = Fraction(0)
    pieces: list[Piece] = []
    while low < _END and len(pieces) < _MOST_PIECES:
        ends = [_END, *(low + k * _STRIDE for k in range(_STRIDES, 0, -1) if low + k * _STRIDE < _END)]
        longest = next(((piece, high) for high in ends for piece in curve.pieces(low, high)), None)
        if longest is None:
            return
        pieces.append(longest[0])
        low = longest[1]
    if low >= _END:
        yield Fit((), tuple(pieces), inf)


class _Curve:
    """Fits on parts of the curve (c, t), which are given by their roots s."""

    def __init__(self, mu: Fraction) -> None:
        self.mu = arb(rational(mu))

    def c_of(self, s: arb) -> arb:
        return s + self.mu * s.tanh()

    def pieces(self, low: Fraction, high: Fraction) -> Iterator[Piece]:
        """The forms of the piece between two roots that are good enough."""
        s = chebyshev(float(low), float(high), _POINTS)  # dense in s, where c is steep
        c = [self.c_of(v) for v in s]
        t = [v.tanh() for v in s]
        knot = _float(self.c_of(arb(rational(low)))) if low else 0.0
        far = self.c_of(arb(rational(high)))
        if low:
            piece = _piece(knot, _float(far - knot), [v - knot for v in c], t, [arb(1)] * _POINTS)
            forms = [piece]
        else:
            values = [a / v for a, v in zip(t, c, strict=True)]
            weights = [1 / v for v in values]
            forms = [
                _piece(0.0, origin, [abs(arb(origin) - v * v) for v in c], values, weights)
                for origin in (0.0, _float(far * far))
            ]
        return (piece for piece in forms if piece is not None)


def _piece(knot: float, length: float, x: Sequence[arb], values: Sequence[arb], weights: Sequence[arb]) -> Piece | None:
    """The best piece on the points x, or None if it is too far off, or would lose digits when it is evaluated."""
    scale = max(x)
    scaled = [v / scale for v in x]
    error, P, Q = best_rational(scaled, values, weights, (DEGREE, DEGREE))
    if not error <= _AIM or max(_cancellation(f, v) for f in (P, Q) for v in scaled) > _LARGEST_CANCELLATION:
        return None
    highest = Q[-1] / scale**DEGREE
    numerator = _floats([v / scale**i / highest for i, v in enumerate(P)])
    denominator = _floats([v / scale**i / highest for i, v in enumerate(Q)])
    return Piece(knot, length, numerator, denominator[:-1]) if numerator and denominator else None


def _cancellation(polynomial: Sequence[arb], x: arb) -> float:
    """How many times larger the terms of the polynomial are than its value."""
    return float(horner([abs(v) for v in polynomial], x) / abs(horner(polynomial, x)))


def _float(value: arb) -> float:
    return float(nearest(Fraction(float(value.mid())), "float"))


def _floats(values: Sequence[arb]) -> tuple[float, ...]:
    """The coefficients in float; none if one of them vanishes there."""
    try:
        return tuple(_float(value) for value in values)
    except EmitError:
        return ()


# --- evaluating it -------------------------------------------------------------------------------------------------


def fitted(fit: Fit, c: Array) -> Array:
    """t(c), elementwise, with the operations of the C in their order."""
    real = c.dtype.type
    if fit.correction:
        T = fast_tanh(c)
        square = T * T
        result: Array = T - T * (real(1) - square) * polynomial(fit.correction, square)
        return result
    r = np.abs(c)
    sign = c / r
    first, *others = fit.pieces
    y = c * c
    result = cut_ratio(first.numerator, first.denominator, c, real(first.length) - y if first.length else y)
    for k, piece in enumerate(others):
        v = r - real(piece.knot)
        if k == len(others) - 1:
            v = np.where(v < real(piece.length), v, real(piece.length))
        result = np.where(r >= real(piece.knot), cut_ratio(piece.numerator, piece.denominator, sign, v), result)
    return result


# --- the certificate -----------------------------------------------------------------------------------------------


def certified_error(mu: Fraction, fit: Fit) -> float:
    """A bound of the error of t over all c, in exact arithmetic but with the rounded coefficients of the fit.

    Cells are halved until their bounds are near the largest error seen; the search ends where the error is certainly
    above TOLERANCE.
    """
    with precision(96):
        m = arb(rational(mu))
        last = _last_root(mu, fit)
        worst = _error_beyond(m, arb(rational(last)), fit)
        count = int(last / _WIDEST) + 1
        edges = [last * k / count for k in range(count + 1)]
        seen = max(_form_error(m, v, v, fit) for v in map(arb, map(rational, edges)))
        if seen > TOLERANCE:
            return seen
        cells = list(pairwise(edges))
        while cells and worst <= TOLERANCE:
            left, right = cells.pop()
            error = _form_error(m, arb(rational(left)), arb(rational(right)), fit)
            if error > _NEAR * seen and right - left > _NARROWEST:
                middle = (left + right) / 2
                cells += [(left, middle), (middle, right)]
                continue
            worst = max(worst, error)
    return worst


def _last_root(mu: Fraction, fit: Fit) -> Fraction:
    """A root beyond which the fit is constant (pieces) or tanh(c) is almost 1 (correction)."""
    if fit.correction:
        return Fraction(12)
    end = Fraction(fit.pieces[-1].knot) + Fraction(fit.pieces[-1].length)
    return max(end - mu, Fraction(0)) + Fraction(1, 16)


def _error_beyond(mu: arb, s: arb, fit: Fit) -> float:
    """The error where the root is beyond s."""
    t = s.tanh()
    if fit.correction:
        total = sum((abs(arb(k)) for k in fit.correction), arb(0))
        return _upper((1 - t) + (1 - t * t) * total)
    piece = fit.pieces[-1]
    end = arb(piece.knot) + arb(piece.length)
    if not s + mu * t >= end:
        return inf
    value = _ratio(piece, arb(piece.length))
    return max(_upper(abs(value - 1)), _upper(abs(value - t)))


def _form_error(mu: arb, a: arb, b: arb, fit: Fit) -> float:
    """The largest error for roots in [a, b], over the pieces that c may lie in."""
    if fit.correction:
        return _error(mu, a, b, lambda c: _corrected(fit.correction, c))
    low, high = a + mu * a.tanh(), b + mu * b.tanh()
    end = arb(fit.pieces[-1].knot) + arb(fit.pieces[-1].length)
    edges = [arb(0), *(arb(piece.knot) for piece in fit.pieces[1:]), end]
    worst = 0.0
    for k, (start, stop) in enumerate(pairwise(edges)):
        if not (high < start or low > stop):
            worst = max(worst, _error(mu, a, b, _form(fit, k)))
    if not high < end:
        value = _ratio(fit.pieces[-1], arb(fit.pieces[-1].length))
        worst = max(worst, _upper(abs(value - a.union(b).tanh())))
    return worst


def _form(fit: Fit, k: int) -> Callable[[arb_series], arb_series]:
    piece = fit.pieces[k]
    if k == 0:
        return lambda c: c * _ratio(piece, arb(piece.length) - c * c if piece.length else c * c)
    return lambda c: _ratio(piece, c - arb(piece.knot))


def _ratio(piece: Piece, x: Any) -> Any:
    """P/Q for a ball or a series; undefined where Q may be zero."""
    Q = horner([arb(v) for v in (*piece.denominator, 1)], x)
    constant = Q[0] if isinstance(Q, arb_series) else Q
    P = horner([arb(v) for v in piece.numerator], x)
    return P / Q if constant > 0 or constant < 0 else P * arb.nan()


def _corrected(correction: Sequence[float], c: arb_series) -> arb_series:
    T = _tanh(c)
    square = T * T
    return T - T * (1 - square) * horner([arb_series([arb(k)]) for k in correction], square)


def _error(mu: arb, a: arb, b: arb, form: Callable[[arb_series], arb_series]) -> float:
    """The largest error for roots in [a, b]: Taylor's formula at the middle, with the last derivative over the cell."""
    before, ctx.cap = ctx.cap, _TERMS
    try:
        at_middle = _error_series(mu, ((a + b) / 2).mid(), form)
        over_cell = _error_series(mu, a.union(b), form)
        half = abs((b - a) / 2).upper()
        bound = abs(over_cell[_TERMS - 1]) * half ** (_TERMS - 1)
        for k in range(_TERMS - 1):
            bound += abs(at_middle[k]) * half**k
    finally:
        ctx.cap = before
    return _upper(bound)


def _error_series(mu: arb, root: arb, form: Callable[[arb_series], arb_series]) -> arb_series:
    """The error of t as a series in the root s."""
    s = arb_series([root, 1])
    exact = _tanh(s)
    return form(s + mu * exact) - exact


def _upper(value: arb) -> float:
    return float(value.upper()) * (1 + 1e-15) if value.is_finite() else inf


def _tanh(x: arb_series) -> arb_series:
    return 1 - 2 / ((2 * x).exp() + 1)
