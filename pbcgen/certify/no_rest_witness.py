"""Witnesses that no real state meets a target: what the equations of a rest give one after the other, and contradict.

The equations are those of the checker, and so is the last word on what was found.
"""

from __future__ import annotations

import copy
from functools import partial
from typing import Any

from flint import fmpq

from pbcgen.certify.attraction_witness import as_quotients, combined, eliminate, open_product, read
from pbcgen.certify.writing import Writing
from pbcgen.passivity.unreachable import multipliers
from pbcgen.proof.sos import available, find
from pbcgen.proof.squares import of_programme
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.plain.elimination import Elimination
from pbcgen.symbolic.plain.outcomes import Fails
from pbcgen.symbolic.plain.values import Function
from pbcgen.symbolic.real import fraction
from pbcgen.verify.stability import Stability

#: How many products may be followed one inside the other, and the terms of equations that are added up.
_DEEPEST, _MOST_TERMS = 3, 30

Witness = dict[str, Any] | None


def nowhere(system: Stability, terms: Writing) -> Witness:
    """The data for `equilibrium` REFUTED, or None if they are not found."""
    found = terms.first([partial(_shown, system, _equations(system), _DEEPEST)])
    if found is None:
        return None
    system.__dict__["placed"] = read(system, terms)
    return found if _holds(system, Elimination(system.field, [], system.equations({})), found) else None


def _equations(system: Stability) -> Elimination:
    return Elimination(system.field, [system.field.lift(0)] * len(system.field.symbols), system.equations({}))


def _holds(system: Stability, chain: Elimination, witness: dict[str, Any]) -> bool:
    try:
        system.nowhere(chain, witness)
    except (Fails, ArithmeticError):
        return False
    return True


def _shown(system: Stability, chain: Elimination, depth: int, terms: Writing) -> Witness:
    """First with what is a number, which says more; then with functions, inputs first; then in cases."""
    symbols, steps = range(len(system.field.symbols)), []  # type: range, list[Any]
    order = [*symbols[system.n :], *symbols[: system.n]]
    for accept in (_is_number, _is_any):
        steps += eliminate(chain, terms, order, accept=accept)
        if _holds(system, chain, {"steps": []}):
            return {"steps": steps}
        weights = combined(system.field.lift(1), [chain.reduced(e) for e in chain.equations])
        if weights is not None:
            return {"steps": [*steps, [None, {str(k): terms.put(f"constant {c}") for k, c in weights.items()}]]}
    by_squares = _by_squares(system, chain, terms)
    if by_squares is not None:
        weights_, squares = by_squares
        return {"steps": [*steps, [None, weights_]], "squares": squares}
    product = open_product(chain) if depth else None
    cases: list[Any] = []
    for factor in product[1] if product else []:
        other = copy.copy(chain)
        other.equations = [*chain.equations, factor]
        case = _shown(system, other, depth - 1, terms)
        if case is None:
            return None
        cases.append([terms.function(factor), case])
    return {"steps": steps, "cases": [product[0], *cases]} if product else None


def _is_number(value: Function) -> bool:
    return value.number() is not None


def _is_any(value: Function) -> bool:
    return True


def _by_squares(system: Stability, chain: Elimination, terms: Writing) -> tuple[dict[str, int], list[Any]] | None:
    """Multiples of the equations that add up to one and squares, and these."""
    reduced = {k: chain.reduced(e) for k, e in enumerate(chain.equations)}
    left = {k: e for k, e in reduced.items() if e.top and e.bottom.is_constant() and len(e.top) <= _MOST_TERMS}
    if not left or not available():
        return None
    (functions,) = as_quotients(system.field, [[*left.values()]], [])
    field, bounds = functions[0].field, {}  # type: Any, dict[int, Any]
    for name, (lo, hi) in system.model.domain.items():
        bounds[system.states.index(name)] = tuple(None if v is None else fraction(v) for v in (lo, hi))
    for weights in multipliers(field, functions, bounds):
        total = sum((m * e for m, e in zip(weights, functions, strict=True)), field.const(fmpq(-1)))
        found = find(field, total.numerator, bounds) if total.is_polynomial() else None
        squares = None if found is None else of_programme(field, found, bounds)
        if squares is not None:
            return _written(weights, [*left], terms), terms.squares(squares)
    return None


def _written(weights: list[Quotient], places: list[int], terms: Writing) -> dict[str, int]:
    return {str(k): terms.quotient(m) for k, m in zip(places, weights, strict=True) if not m.is_zero()}
