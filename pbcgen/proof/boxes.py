"""Boxes of rational intervals, and how branch and bound cuts them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import TypeAlias

#: A closed interval for each variable.
Box: TypeAlias = tuple[tuple[Fraction, Fraction], ...]


def lengths(box: Box) -> list[Fraction]:
    """The length of each interval."""
    return [hi - lo for lo, hi in box]


def longest_side(box: Box, whole: Sequence[Fraction]) -> int:
    """The variable whose interval is the largest share of its width in ``whole``; the first one of several."""
    return max(range(len(box)), key=lambda k: (box[k][1] - box[k][0]) / whole[k] if whole[k] else 0)


def halves(box: Box, k: int) -> tuple[Box, Box]:
    """The lower and the upper half of the box, cut in the middle of variable k."""
    lo, hi = box[k]
    middle = (lo + hi) / 2
    return (*box[:k], (lo, middle), *box[k + 1 :]), (*box[:k], (middle, hi), *box[k + 1 :])
