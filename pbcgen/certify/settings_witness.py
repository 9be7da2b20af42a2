"""Witnesses of `adjustable` for certificates: x* and u* as formulas of the settings, and how their box is cut."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from itertools import islice, product
from typing import Any

import casadi as ca
import numpy as np
from flint import arb, arb_mat

from pbcgen.certify.attraction_witness import eliminate, read
from pbcgen.certify.limits_witness import what_is_left
from pbcgen.certify.writing import Writing
from pbcgen.control.derive import Derivation
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.lyapunov import Kind
from pbcgen.proof.modal import Varying, blurs
from pbcgen.proof.tree import tree
from pbcgen.symbolic.plain.boxes import Box, halves
from pbcgen.symbolic.plain.elimination import Elimination
from pbcgen.symbolic.plain.outcomes import Fails
from pbcgen.symbolic.plain.values import partial, plain
from pbcgen.symbolic.real import fraction
from pbcgen.symbolic.tape import Tape
from pbcgen.verify.stability import Stability

#: Cells of the settings, boxes for each limit, and corners of the settings.
_MOST_CELLS, _MOST_BOXES, _CORNERS = 300, 2000, 16
_MISFITS = (ArithmeticError, LookupError, TypeError, ValueError)


def adjustable(derivation: Derivation, system: Stability, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    """The witness, or None if one is not found."""
    if "reason" in (claim.counterexample or {}):
        return _dependent(system, terms)
    witness = _rest(derivation)
    if witness is None:
        return None
    system.witness = {**system.witness, "adjustable": witness}
    if not system.rests():
        return None
    return _point(system, claim, witness) if claim.status is Status.REFUTED else _cells(system, witness, terms)


def _rest(derivation: Derivation) -> dict[str, Any] | None:
    """x* and u* in the settings; empty where no target moves, None where they have no formula."""
    settings = None if derivation.graph is None else derivation.graph.settings
    if settings is None or settings.moving is None:
        return {} if settings is not None and not derivation.design.target_box else None
    moving = settings.moving
    writing, column = Writing(), ca.densify(ca.vertcat(moving.x, moving.u))
    numbers = {2: [*derivation.plant.parameter_values]}
    (places,) = writing.tape(moving.tape(column), ["setting", "solved", "parameter"], numbers)
    zero = writing.put("constant 0")
    writing.output(
        "rest", (column.numel(), 1), {(k, 0): places.entries.get((k, 0), zero) for k in range(column.numel())}
    )
    if moving.branch is not None:
        (start,) = writing.tape(Tape.of([moving.symbols], [ca.densify(moving.branch.start)]), ["setting"], {})
        writing.output("start", start.shape, start.entries)
    return {"rest": writing.lines()}


def _point(system: Stability, claim: Claim, witness: dict[str, Any]) -> dict[str, Any] | None:
    """The settings that fail, to the digits of the claim."""
    found = claim.counterexample or {}
    names = [*found]
    if len(names) != len(system.box):
        return None
    system.witness = {**system.witness, "adjustable": witness | {"at": [str(found[name]) for name in names]}}
    system.refuted_adjustable()
    return {**system.witness["adjustable"]}


def _dependent(system: Stability, terms: Writing) -> dict[str, Any] | None:
    """Settings that no equilibrium meets, among the ends of their ranges, by the steps that lead to a contradiction."""
    symbols = range(len(system.field.symbols))
    for values in islice(product(*system.box), _CORNERS):
        other = copy.copy(system)
        other.model = system.model.with_settings(values)
        chain = Elimination(system.field, [system.field.lift(0)] * len(symbols), other.equations({}))
        witness = {"at": [str(v) for v in values], "steps": eliminate(chain, terms, symbols)}
        system.witness = {**system.witness, "adjustable": witness}
        system.__dict__["placed"] = read(system, terms)
        try:
            system.refuted_adjustable()
        except Fails:
            continue
        return witness
    return None


def _cells(system: Stability, witness: dict[str, Any], terms: Writing) -> dict[str, Any] | None:
    if system.compensated:
        limits, cut = what_is_left(system.at([hi for _, hi in system.box]), terms), _cut(system)
        return None if limits is None or cut is None else witness | {"cells": cut, "limits": limits}
    trees: list[str] = []
    for k in range(len(system.model.limits)):
        found = tree(system.room(k), [(fraction(lo), fraction(hi)) for lo, hi in system.box], {}, _MOST_BOXES)
        if found is None:
            return None
        trees.append(found)
    cut = _cut(system)
    return None if cut is None else witness | {"cells": cut, "trees": trees}


def _cut(system: Stability) -> str | None:
    waiting, written = [system.box], []  # type: list[Box], list[str]
    for _ in range(_MOST_CELLS):
        if not waiting:
            return "".join(written)
        cell = waiting.pop()
        if _passes(system, cell):
            written.append(".")
            continue
        k = _best(system, cell)
        written.append(chr(ord("a") + k))
        waiting += reversed(halves(cell, k))
    return None


def _passes(system: Stability, cell: Box) -> bool:
    try:
        return system.passes(cell)
    except _MISFITS:
        return False


def _best(system: Stability, cell: Box) -> int:
    """The setting whose halving helps most where a loop is furthest from passing; the widest among equals."""
    shares = [float((hi - lo) / (b - a)) if b > a else 0.0 for (lo, hi), (a, b) in zip(cell, system.box, strict=True)]
    try:
        with np.errstate(all="ignore"):
            _, *after = max(blurs(varying, kind) for varying, kind in _loops(system, cell))
    except _MISFITS:
        after = [math.inf] * len(cell)
    return min(range(len(cell)), key=lambda k: (after[k] if shares[k] else math.inf, -shares[k]))


def _loops(system: Stability, cell: Box) -> Iterator[tuple[Varying, Kind]]:
    middle, over = system.spread(cell)
    widths = tuple(arb(0, arb((hi - lo) / 2)) for lo, hi in cell)
    kinds: tuple[tuple[str, Kind], ...] = (("continuous", "hurwitz"), ("sampled", "schur"))
    for name, kind in kinds:
        rows = getattr(over, name)
        slopes = tuple(arb_mat([[plain(partial(v, k)) for v in row] for row in rows]) for k in range(len(cell)))
        yield Varying(arb_mat(getattr(middle, name)), slopes, widths), kind
