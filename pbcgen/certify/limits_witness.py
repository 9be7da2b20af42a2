"""Witnesses of limits for certificates: what a force that is compensated leaves to each has no negative values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from flint import fmpq

from pbcgen.certify.attraction_witness import in_squares, read
from pbcgen.certify.writing import Writing
from pbcgen.proof.tree import tree
from pbcgen.symbolic.plain.formulas import Formulas
from pbcgen.symbolic.plain.values import Function
from pbcgen.symbolic.real import fraction
from pbcgen.verify.stability import Stability

#: Boxes for each limit.
_MOST_BOXES = 3000


def what_is_left(system: Stability, terms: Writing) -> list[list[Any]] | None:
    """What is left to each limit, in squares; by boxes over the domain or a period where there are no others."""
    found: list[list[Any]] = []
    for room in system.rooms:
        squares = in_squares(system.field, [[room]], terms)
        squares = _by_boxes(system, room, terms) if squares is None else squares
        if squares is None:
            return None
        found.append(squares)
    return found


def _by_boxes(system: Stability, room: Function, terms: Writing) -> list[Any] | None:
    used, place, one = sorted(room.used), terms.function(room), terms.put("constant 1")
    part = Formulas.parse(terms.lines())
    written = read(system, terms)[place]
    ends = [system.extent("saturation", written, k) for k in used]

    def value(x: Sequence[Any]) -> Any:
        return part.walk(fmpq, {"state": dict(zip(used, x, strict=True))}, None, [place])[place]

    found = tree(value, [(fraction(lo), fraction(hi)) for lo, hi in ends], {}, _MOST_BOXES)
    return None if found is None else [["1", [["box", place, [found, used, {}], True]], [one]]]
