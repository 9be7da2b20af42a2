"""A known zero of a function is the only one in a box: branch and bound in balls.

A part of the box is done with when an entry of the function has no zero there; or when the Jacobian is regular on a box
that holds the part and the known zero. For then the function takes no value twice on that box: the difference of two
values is a matrix of mean slopes, each within its ball, times the difference of the points.
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb, arb_mat

from pbcgen.proof.boxes import Box, halves, longest_side
from pbcgen.proof.newton import System
from pbcgen.symbolic.real import Real, ball, enclose, is_finite, midpoint, rational, sign
from pbcgen.symbolic.real_matrices import RealMatrix, approximate_inverse, as_balls


def only_zero(system: System, zero: Sequence[Real], box: Box, boxes: int = 4000) -> bool:
    """Whether the box is proved to hold no zero but the known one.

    Args:
        system: as many functions as variables.
        zero: the known zero, exact or enclosed.
        box: rational intervals.
        boxes: how many parts may be looked at.
    """
    whole = [hi - lo for lo, hi in box]
    inverse = _inverse(system([rational(midpoint(z)) for z in zero])[1])
    waiting = [box]
    for _ in range(boxes):
        if not waiting:
            return True
        part = waiting.pop()
        value, _ = system([enclose(lo, hi) for lo, hi in part])
        if any(is_finite(v) and sign(v) in (1, -1) for v in value):
            continue
        joined: list[Real] = [enclose(lo, hi).union(ball(z)) for (lo, hi), z in zip(part, zero, strict=True)]
        if inverse is not None and _regular(system(joined)[1], inverse):
            continue
        waiting += halves(part, longest_side(part, whole))
    return not waiting


def _inverse(slopes: RealMatrix) -> arb_mat | None:
    return approximate_inverse(slopes) if all(is_finite(v) for row in slopes for v in row) else None


def _regular(slopes: RealMatrix, inverse: arb_mat) -> bool:
    """Whether every matrix within the balls is regular: after multiplication with an inverse it is close to I."""
    if not all(is_finite(v) for row in slopes for v in row):
        return False
    return all(_dominant(row, i) for i, row in enumerate((inverse * as_balls(slopes)).tolist()))


def _dominant(row: Sequence[arb], i: int) -> bool:
    beside = sum((abs(v).upper() for j, v in enumerate(row) if j != i), arb(0))
    return sign(abs(row[i]).lower() - beside) == 1
