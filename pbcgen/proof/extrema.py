"""Rigorous bounds of functions: over all arguments when only bounded functions occur, else over a box."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from pbcgen.proof.boxes import Box, halves
from pbcgen.proof.harmonics import harmonic_bounds
from pbcgen.proof.known import BOUNDED_KINDS
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import Real, enclose, fraction, is_finite, lower, rational, upper


@dataclass(frozen=True)
class Bounds:
    """``lo <= function <= hi``; ``None`` where no bound is known."""

    lo: Fraction | None
    hi: Fraction | None


def term_bounds(function: Quotient, symbols: Mapping[int, tuple[Fraction | None, Fraction | None]]) -> Bounds:
    """Bounds from the sum over terms, each a coefficient times bounded atoms and bounded symbols; exact rationals.

    Of a polynomial in sines and cosines alone the bounds by its harmonics, if these are closer.
    """
    if not function.is_polynomial():
        return Bounds(None, None)
    several = len(function.numerator) > 1 or function.numerator.total_degree() > 1
    series = harmonic_bounds(function) if several else None
    if series is not None:
        mean, reach = series
        return Bounds(mean - reach, mean + reach)
    lo, hi = Fraction(0), Fraction(0)
    for exponents, coefficient in function.numerator.to_dict().items():
        size = abs(fraction(coefficient))
        constant = True
        for k, exponent in enumerate(exponents):
            if not exponent:
                continue
            constant = False
            magnitude = _magnitude(function, k, symbols)
            if magnitude is None:
                return Bounds(None, None)
            size *= magnitude ** int(exponent)
        lo += fraction(coefficient) if constant else -size
        hi += fraction(coefficient) if constant else size
    return Bounds(lo, hi)


def _magnitude(
    function: Quotient, k: int, symbols: Mapping[int, tuple[Fraction | None, Fraction | None]]
) -> Fraction | None:
    if k >= function.field.symbol_count:
        return Fraction(1) if function.field.atoms[k].kind in BOUNDED_KINDS else None
    lo, hi = symbols.get(k, (None, None))
    return None if lo is None or hi is None else max(abs(lo), abs(hi))


def maximum(
    function: Callable[[Sequence[Real]], Real], box: Box, budget: int = 1500, tolerance: float = 1e-7
) -> tuple[Fraction | None, Fraction | None]:
    """(a value that is attained, an upper bound) of the function on the box, by branch and bound in balls.

    ``None`` stands for "nothing known": the function is not finite somewhere, or the budget ended before.
    """
    attained: Fraction | None = None
    heap: list[tuple[float, int, Box, Fraction]] = []
    count = 0

    def push(part: Box) -> bool:
        nonlocal count
        value = function([enclose(lo, hi) for lo, hi in part])
        if not is_finite(value):
            return False
        count += 1
        heapq.heappush(heap, (-float(upper(value)), count, part, upper(value)))
        return True

    if not push(box):
        return None, None
    while heap and count < budget:
        bound, _, part, _ = heap[0]
        centre = function([rational((lo + hi) / 2) for lo, hi in part])
        if is_finite(centre):
            value = lower(centre)
            attained = value if attained is None else max(attained, value)
        if attained is not None and -bound - float(attained) <= tolerance * (1 + abs(bound)):
            break
        heapq.heappop(heap)
        widest = max(range(len(part)), key=lambda k: part[k][1] - part[k][0])
        for half in halves(part, widest):
            if not push(half):
                return attained, None
    return attained, max(bound for *_, bound in heap)
