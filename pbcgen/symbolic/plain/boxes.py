"""A function is nonnegative on a box: shown by a tree of halvings, whose leaves are evaluated in balls.

A tree is text: a letter names the coordinate that is halved (a is the first), and the trees of its lower and its upper
half follow. A leaf says by what the function is nonnegative there:

    .   its enclosure
    ,   the mean value form: the value at the centre, and the enclosed slopes
    ;   the enclosure on the face that the signs of the slopes point to
    :   the second derivatives in the coordinates of ``zeros``, which are positive definite from the box to where these
        coordinates have the values given; the caller has shown that function and slopes vanish there
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from flint import arb, fmpq

from pbcgen.symbolic.plain.matrices import Matrix, dot, is_definite
from pbcgen.symbolic.plain.outcomes import require
from pbcgen.symbolic.plain.values import partial, plain, variables

Box = list[tuple[Any, Any]]
LEAVES = ".,;:"


def shown(tree: str, box: Box, function: Callable[[Sequence[Any]], Any], zeros: Mapping[int, fmpq]) -> bool:
    """Whether the tree shows that the function is nonnegative on the box."""
    return covered(tree, box, lambda kind, part: leaf(kind, part, function, zeros))


def covered(tree: str, box: Box, holds: Callable[[str, Box], bool]) -> bool:
    """Whether the tree cuts the box into parts, and what its leaf says holds on each."""
    letters = iter(tree)

    def look(part: Box) -> bool:
        letter = next(letters, "")
        if letter and letter in LEAVES:
            return holds(letter, part)
        return bool(letter) and all(look(half) for half in halves(part, ord(letter) - ord("a")))

    return look(box) and not [*letters]


def halves(box: Box, k: int) -> tuple[Box, Box]:
    """The box cut in the middle of coordinate k. Raises IndexError."""
    require(0 <= k < len(box), "the tree cuts a coordinate that the box does not have", IndexError)
    lo, hi = box[k]
    middle = (lo + hi) / 2
    return [*box[:k], (lo, middle), *box[k + 1 :]], [*box[:k], (middle, hi), *box[k + 1 :]]


def leaf(kind: str, box: Box, function: Callable[[Sequence[Any]], Any], zeros: Mapping[int, fmpq]) -> bool:
    """Whether the function is nonnegative on the box by one of the kinds of evidence."""
    if kind == ".":
        return bool(function([ball(lo, hi) for lo, hi in box]) >= 0)
    if kind == ":":
        hull = [(min(lo, zeros.get(k, lo)), max(hi, zeros.get(k, hi))) for k, (lo, hi) in enumerate(box)]
        return bool(zeros and is_definite(_hessian(function, hull, [*zeros])))
    value = function(variables([ball(lo, hi) for lo, hi in box]))
    slopes = [partial(value, k) for k in range(len(box))]
    if not all(arb(v).is_finite() for v in (plain(value), *slopes)):
        return False  # a jump has slope zero on both sides
    if kind == ",":
        centre = [(lo + hi) / 2 for lo, hi in box]
        steps = [ball(lo - c, hi - c) for (lo, hi), c in zip(box, centre, strict=True)]
        return bool(function(centre) + dot(slopes, steps) >= 0)
    sides = zip(box, slopes, strict=True)
    face = [lo if slope >= 0 else hi if slope <= 0 else ball(lo, hi) for (lo, hi), slope in sides]
    return bool(function(face) >= 0)


def _hessian(function: Callable[[Sequence[Any]], Any], box: Box, chosen: Sequence[int]) -> Matrix:
    """Second derivatives in the chosen coordinates over the box."""
    value = function(variables([ball(lo, hi) for lo, hi in box], 2))
    return [[plain(partial(partial(value, i), k)) for k in chosen] for i in chosen]


def ball(lo: fmpq, hi: fmpq) -> Any:
    """All numbers between two rationals."""
    return lo if lo == hi else arb(lo).union(arb(hi))
