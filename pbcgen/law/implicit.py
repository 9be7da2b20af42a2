"""How many Newton steps the scalar loop ``s + mu tanh(s) = r`` needs.

For r > 0 Newton's method from ``max(r/(1 + mu), r - mu)`` increases to the root s*, because the left side is concave
there. Its error e obeys ``e+ = e - (F(s*) - F(s* - e)) / F'(s* - e)`` and ``e+ <= max|F''| e^2 / (2 F')``, and a larger
error stays larger. So bounds of the error over cells of s* that cover [0, inf) bound it for every r; they are computed
in ball arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import inf, nextafter

from flint import arb

from pbcgen.law.arithmetic import Precision
from pbcgen.symbolic.real import precision, rational

_EPSILON = {"float": Fraction(1, 2**24), "double": Fraction(1, 2**53)}
_MOST = 60
_NEGLIGIBLE = 1e-18


@dataclass(frozen=True)
class IterationBound:
    """``iterations`` steps leave an error of at most ``error`` in s, relative to max(1, s), for every r."""

    iterations: int
    error: float


@lru_cache(maxsize=256)
def scalar_iterations(mu: Fraction, working: Precision) -> IterationBound:
    """The iterations after which the error is below the unit roundoff of the precision, for every r.

    Raises ValueError if ``mu`` is negative.
    """
    if mu < 0:
        raise ValueError("mu must not be negative")
    tolerance = _EPSILON[working]
    with precision(96):
        worst = [0.0] * (_MOST + 1)
        m = arb(rational(mu))
        for left, right in _cells(mu):
            _follow(m, arb(rational(left)), arb(rational(right)), worst)
    for count, error in enumerate(worst):
        if error <= float(tolerance):
            return IterationBound(count, error)
    return IterationBound(_MOST, worst[-1])


def _cells(mu: Fraction) -> list[tuple[Fraction, Fraction]]:
    """Cells of s* that cover [0, S]; beyond S the start r - mu is exact to roundoff: mu (1 - tanh S) is negligible."""
    end = 24 + Fraction((1 + mu).__ceil__().bit_length(), 2)
    cells = []
    left = Fraction(0)
    width = Fraction(1, 256)
    while left < end:
        cells.append((left, left + width))
        left += width
        width = min(Fraction(1, 16), width * Fraction(9, 8))
    return cells


def _upper(value: arb) -> float:
    """A double that is not below the value; infinite when nothing is known."""
    return nextafter(float(value.upper()), inf) if value.is_finite() else inf


def _follow(mu: arb, left: arb, right: arb, worst: list[float]) -> None:
    """Raise the error bounds by what happens for roots in [left, right]."""
    error = min(_upper(mu * (1 - left.tanh())), _upper(mu * (right - right.tanh()) / (1 + mu)))
    root = left.union(right)
    tanh_root = left.tanh().union(right.tanh())
    slope_at_root = 1 + mu * right.sech() ** 2
    scale = max(1.0, float(left))
    for k in range(len(worst)):
        worst[k] = max(worst[k], error / scale)
        if error < _NEGLIGIBLE:
            return
        e = arb(error)
        point = root - e
        quadratic = _curvature(mu, left - e, right) * e * e / (2 * slope_at_root)
        exact = e - (e + mu * (tanh_root - point.tanh())) / (1 + mu * point.sech() ** 2)
        error = min(error, _upper(quadratic), max(0.0, _upper(exact)))


def _curvature(mu: arb, left: arb, right: arb) -> arb:
    """An upper bound of ``|F''| = 2 mu |tanh| sech^2`` on [left, right]; its maximum is where tanh^2 = 1/3."""
    peak = arb("0.65847894846240835431")
    if left < peak and right > peak:
        return mu * arb("0.76980035891950105")
    at_left = 2 * mu * abs(left.tanh()) * left.sech() ** 2
    at_right = 2 * mu * right.tanh() * right.sech() ** 2
    return at_left if at_left.upper() > at_right.upper() else at_right
