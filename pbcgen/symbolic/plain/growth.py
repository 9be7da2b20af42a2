"""Functions that together are unbounded in every direction."""

from __future__ import annotations

from collections.abc import Iterable

from pbcgen.symbolic.plain.elimination import slopes
from pbcgen.symbolic.plain.values import Field, Function


def _used(field: Field, a: Function) -> set[int]:
    return {k for k, slope in enumerate(slopes(field, a)) if slope.top}


def spans(field: Field, states: int, coordinates: Iterable[tuple[Function, Function, int]]) -> bool:
    """Whether the states are bounded where every ``s t^2`` of the triples (s, t, k) is.

    One after the other they give one state more: s > 0 depends on the states before, and so does what t is affine in,
    ``t = a x_k + b`` with a nowhere zero.
    """
    known: set[int] = set()
    for s, t, k in coordinates:
        a = slopes(field, t)[k]
        affine = _used(field, t) <= known | {k} and k not in _used(field, a) and field.everywhere(a.top)
        positive = field.everywhere(s.top) * field.everywhere(s.bottom) == 1
        if not (affine and positive and _used(field, s) <= known):
            return False
        known.add(k)
    return known == {*range(states)}
