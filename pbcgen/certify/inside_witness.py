"""Witnesses for certificates of global claims on a domain: that it is kept, or that the storage grows towards its ends.

They are looked for with the checker's own reading of the model, so that what is found here is what is checked there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice, product
from typing import Any

from flint import fmpq, fmpq_mpoly

from pbcgen.certify.attraction_witness import in_squares, read
from pbcgen.certify.growth_witness import convex_growth, decimal, growth
from pbcgen.certify.writing import Writing
from pbcgen.proof.tree import tree
from pbcgen.reading.overall import GLOBAL
from pbcgen.symbolic.plain.formulas import Formulas, rational
from pbcgen.symbolic.plain.values import NONNEGATIVE, Field, Function
from pbcgen.symbolic.real import fraction
from pbcgen.verify.stability import Stability

#: Boxes for each end, and ways to write what is between two ends.
_MOST_BOXES, _MOST_WAYS = 3000, 256

Witness = dict[str, Any] | None
Squares = list[list[Any]]


def on_domain(system: Stability, terms: Writing) -> Stability:
    """The design on its domain, with what is written so far."""
    loop = system.on_domain(is_closed(system))
    loop.witness = system.witness
    loop.__dict__["placed"] = read(loop, terms)
    return loop


def is_closed(system: Stability) -> bool:
    """Whether the ends belong to the domain of the claim."""
    return "=" in system.domain[GLOBAL] or "[" in system.domain[GLOBAL]


def rising(loop: Stability) -> Witness:
    """Why the storage grows in coordinates with which the ends are infinitely far."""
    terms, z = Writing(), loop.logarithmic([])
    grown = terms.first([lambda w: growth(z, w), lambda w: convex_growth(z, w)])
    return None if grown is None else {"growth": grown | {"terms": terms.lines()}}


def kept(loop: Stability, terms: Writing) -> Witness:
    """Why the rates do not point outside at the ends of the domain."""
    reach = [[decimal(u - s, -1), decimal(u + s, 1)] for u, s in zip(loop.resting_input, loop.pull, strict=True)]
    loop.reach = [(rational(lo), rational(hi)) for lo, hi in reach]
    ends = []
    for rate in loop.inwards:
        squares = _nonnegative(loop, rate, terms)
        if squares is None:
            return None
        ends.append(squares)
    return {"kept": {"inputs": reach, "ends": ends}}


def _nonnegative(loop: Stability, value: Function, terms: Writing) -> Squares | None:
    """By what is nonnegative between the ends, by boxes, or everywhere."""
    side = loop.field.everywhere(value.bottom)
    found = _by_ends(loop, value.top * side, value.bottom * side, terms) if side else None
    found = _by_boxes(loop, value, terms) if found is None else found
    return in_squares(loop.field, [[value]], terms) if found is None else found


def _by_ends(loop: Stability, top: fmpq_mpoly, bottom: fmpq_mpoly, terms: Writing) -> Squares | None:
    """Products of distances to ends with positive weights: which end of each it is, is tried."""
    field, ends = loop.field, loop.ends
    one = field.quotient(field.one, bottom)
    below = [] if one.number() else [["positive", terms.function(one), None, True]]
    present = [k for k, pair in enumerate(ends) if top.degrees()[field.pool + k] and pair != (None, None)]
    choices = ([side for side in (0, 1) if ends[k][side] is not None] for k in present)
    for sides in islice(product(*choices), _MOST_WAYS):
        shifted, kinds = [*field.generators], {}
        for k, side in zip(present, sides, strict=True):
            shifted[field.pool + k] = ends[k][side] + shifted[field.pool + k] * (-1 if side else 1)
            kinds[field.pool + k] = ["below" if side else "above", k, None, True]
        terms_ = top.compose(*shifted).to_dict().items()
        found = [_term(field, e, c * (one.number() or 1), kinds, terms) for e, c in terms_]
        if None not in found:
            return [[weight, [*below, *factors], places] for weight, factors, places in filter(None, found)]
    return None


def _term(
    field: Field, exponents: Sequence[int], weight: fmpq, kinds: Mapping[int, list[Any]], terms: Writing
) -> list[Any] | None:
    """One of these products, or None if it may be negative."""
    factors = []
    even = [0 if k in kinds else int(e) // 2 for k, e in enumerate(exponents)]
    for k, e in enumerate(exponents):
        if k in kinds:
            factors += [kinds[k]] * int(e)
        elif e % 2:
            (kind, _, _), a = [*field.atoms.items()][field.pool - 1 - k] if k < field.pool else (("", "", ""), None)
            if kind not in NONNEGATIVE or a is None:
                return None
            factors.append([kind, terms.function(a), None, True])
    half = field.quotient(field.ctx.from_dict({tuple(even): fmpq(1)}), field.one)
    return [str(weight), factors, [terms.function(half)]] if weight > 0 else None


def _by_boxes(loop: Stability, value: Function, terms: Writing) -> Squares | None:
    """A tree of boxes, where all that occurs has two ends."""
    used, place, one = sorted(value.used), terms.function(value), terms.put("constant 1")
    part, ends = Formulas.parse(terms.lines()), [loop.ends[k] for k in used]
    box = [(fraction(lo), fraction(hi)) for lo, hi in ends if lo is not None and hi is not None]

    def at(x: Sequence[Any]) -> Any:
        return part.walk(fmpq, {"state": dict(zip(used, x, strict=True))}, None, [place])[place]

    found = tree(at, box, {}, _MOST_BOXES) if len(box) == len(used) else None
    return None if found is None else [["1", [["box", place, [found, used, {}], True]], [one]]]
