"""Trees of boxes for certificates: a function is nonnegative on a box, written so that nothing is searched for again.

The leaves are decided by the very evaluation with which the checker reads them, see :mod:`pbcgen.symbolic.plain.boxes`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

from flint import arb

from pbcgen.symbolic.plain.boxes import LEAVES, Box, halves, leaf, shown
from pbcgen.symbolic.plain.values import partial, sign, variables
from pbcgen.symbolic.real import BITS, precision, rational

_SEARCH_BITS = 96
_DEEPEST = 60


def tree(
    function: Callable[[Sequence[Any]], Any],
    bounds: Sequence[tuple[Fraction, Fraction]],
    zeros: Mapping[int, Fraction],
    boxes: int = 3000,
) -> str | None:
    """The tree that shows ``function >= 0`` on the box, or None if so many boxes do not suffice.

    Args:
        function: of coordinates of any kind of value.
        bounds: of each coordinate.
        zeros: coordinates with values at which function and slopes vanish.
        boxes: how many may be looked at.
    """
    box = [(rational(lo), rational(hi)) for lo, hi in bounds]
    at = {k: rational(v) for k, v in zeros.items()}
    left = boxes
    written: list[str] = []
    with precision(_SEARCH_BITS):
        waiting: list[tuple[Box, int]] = [(box, 0)]
        while waiting:
            part, depth = waiting.pop()
            left -= 1
            kind = next((k for k in LEAVES if leaf(k, part, function, at)), None)
            if kind is not None:
                written.append(kind)
                continue
            middle = function([(lo + hi) / 2 for lo, hi in part])
            if left <= 0 or depth > _DEEPEST or sign(middle) == -1:
                return None
            k = _widest(function, part, box)
            lower, upper = halves(part, k)
            written.append(chr(ord("a") + k))
            waiting += [(upper, depth + 1), (lower, depth + 1)]
    with precision(BITS):
        return "".join(written) if shown("".join(written), box, function, at) else None


def cover(box: Box, holds: Callable[[str, Box], bool], kinds: str, boxes: int) -> str | None:
    """A tree whose leaves hold by one of these kinds, or None if so many boxes do not suffice."""
    written: list[str] = []
    waiting: list[tuple[Box, int]] = [(box, 0)]
    for _ in range(boxes):
        if not waiting:
            return "".join(written)
        part, depth = waiting.pop()
        kind = next((k for k in kinds if holds(k, part)), None)
        if kind is not None:
            written.append(kind)
            continue
        if depth > _DEEPEST:
            return None
        k = max(range(len(box)), key=lambda k: (part[k][1] - part[k][0]) / (box[k][1] - box[k][0]))
        lower, upper = halves(part, k)
        written.append(chr(ord("a") + k))
        waiting += [(upper, depth + 1), (lower, depth + 1)]
    return None if waiting else "".join(written)


def _widest(function: Callable[[Sequence[Any]], Any], part: Box, box: Box) -> int:
    """Where the function varies most."""
    value = function(variables([arb(lo).union(arb(hi)) for lo, hi in part]))

    def variation(k: int) -> float:
        lo, hi = part[k]
        whole = box[k][1] - box[k][0]
        relative = float(arb((hi - lo) / whole)) if whole else 0.0
        slope = arb(partial(value, k))
        return relative * (1e-9 + float(abs(slope).upper() * arb(whole))) if slope.is_finite() else relative * 1e9

    return max(range(len(part)), key=variation)
