"""Starts for other rests where these are hidden: branch and bound in one or two coordinates.

Newton's method finds a rest in a narrow well only from a start inside the well. A part of a box of states is done with
when a rest equation has no zero there, by values or by a value and slopes. What is left after many cuts is small, and
rests may be there. Nothing is proved here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from flint import arb
from numpy.typing import NDArray

from pbcgen.control.landscape import Landscape
from pbcgen.control.situation import Situation
from pbcgen.errors import UnsupportedOperation
from pbcgen.models.laws import Integral
from pbcgen.passivity.region import Region
from pbcgen.proof.boxes import Box, halves, longest_side
from pbcgen.symbolic.real import BITS, Real, approximate, enclose, is_finite, precision, rational, sign

#: More coordinates are not searched.
_MOST = 2
#: Boxes that may be looked at, instructions that may be run for them, and starts that are handed on.
_BOXES, _WORK, _STARTS = 1000, 250_000, 24
#: Parts of so many halvings are handed on.
_CUTS = 14


def hidden_rests(situation: Situation, sizes: Sequence[float]) -> list[NDArray[np.float64]]:
    """States near which the loop may rest, those far from x* too; nothing for loops with more coordinates.

    Args:
        situation: the law at its target.
        sizes: how far to look from x*, for each state that need not be at rest.
    """
    if isinstance(situation.law, Integral) or len(sizes) > _MOST or not np.all(np.isfinite(sizes)):
        return []
    try:
        with precision(BITS):
            land = Landscape(situation)
            box = _around(situation, land, sizes)
            return [] if box is None else _left(land, box, min(_BOXES, _WORK // len(land.slope_tape.instructions)))
    except (UnsupportedOperation, ZeroDivisionError):
        return []


def _around(situation: Situation, land: Landscape, sizes: Sequence[float]) -> Box | None:
    """The box around x* in the stated domain, with momenta at zero; None where it is flat or the momenta are not."""
    sides = []
    bounds = Region.stated(situation.plant).bounds
    free = situation.plant.system.n - len(land.momenta)
    if free != len(sizes):
        return None
    for star, size, (lo, hi) in zip(situation.point.x, sizes, bounds, strict=False):
        centre = Fraction(approximate(star))
        a, b = centre - Fraction(size), centre + Fraction(size)
        sides.append((a if lo is None else max(a, lo), b if hi is None else min(b, hi)))
    if any(lo >= hi for lo, hi in sides):
        return None
    return (*sides, *[(Fraction(0), Fraction(0))] * len(land.momenta))


def _left(land: Landscape, box: Box, boxes: int) -> list[NDArray[np.float64]]:
    """The middles of small parts of the box that were not excluded, spread over it where there are many."""
    whole = [hi - lo for lo, hi in box]
    waiting, small = deque([(box, 0)]), []
    for _ in range(boxes):
        if not waiting:
            break
        part, cuts = waiting.popleft()
        if _excluded(land, part):
            continue
        if cuts == _CUTS * len([width for width in whole if width]):
            small.append(part)
        else:
            waiting.extend((half, cuts + 1) for half in halves(part, longest_side(part, whole)))
    found = small or [part for part, _ in waiting]
    return [np.array([float(lo + hi) / 2 for lo, hi in part]) for part in found[:: max(1, len(found) // _STARTS)]]


def _excluded(land: Landscape, part: Box) -> bool:
    """Whether a rest equation has no zero in the part: by its values, or by the value in the middle and the slopes."""
    x: list[Real] = [enclose(lo, hi) for lo, hi in part]
    if not land.can_rest(x):
        return True
    slopes = land.slopes(x)
    if slopes is None:
        return False
    reach = [arb(0, arb(rational((hi - lo) / 2))) for lo, hi in part if lo < hi]
    middle = land.rest_equations([rational((lo + hi) / 2) for lo, hi in part])
    for value, row in zip(middle, slopes.tolist(), strict=True):
        total = sum((a * r for a, r in zip(row, reach, strict=True)), value)
        if is_finite(total) and sign(total) in (1, -1):
            return True
    return False
