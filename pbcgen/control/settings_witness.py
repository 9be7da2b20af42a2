"""Witnesses of `adjustable` for certificates: x* and u* as formulas of the settings, and how their box is cut."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
from flint import fmpq

from pbcgen.control.derive import Derivation
from pbcgen.control.writing import Writing
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.tree import tree
from pbcgen.symbolic.plain.boxes import Box, halves
from pbcgen.symbolic.real import fraction
from pbcgen.verify.stability import Stability

#: Cells of the settings, and boxes for each limit.
_MOST_CELLS, _MOST_BOXES = 500, 2000
_MISFITS = (ArithmeticError, LookupError, TypeError, ValueError)


def adjustable(derivation: Derivation, system: Stability, claim: Claim) -> dict[str, Any] | None:
    """The witness, or None if one is not found."""
    witness = _rest(derivation)
    if witness is None:
        return None
    system.witness = {**system.witness, "adjustable": witness}
    if not system.rests():
        return None
    return _point(system, claim, witness) if claim.status is Status.REFUTED else _cells(system, witness)


def _rest(derivation: Derivation) -> dict[str, Any] | None:
    """x* and u* in the settings; empty where no target moves, None where they have no formula."""
    settings = None if derivation.graph is None else derivation.graph.settings
    if settings is None or settings.moving is None:
        return {} if settings is not None and not derivation.design.target_box else None
    moving = settings.moving
    if moving.branch is not None:
        return None
    writing, column = Writing(), ca.densify(ca.vertcat(moving.x, moving.u))
    numbers = {2: [*derivation.plant.parameter_values]}
    (places,) = writing.tape(moving.tape(column), ["setting", "solved", "parameter"], numbers)
    zero = writing.put("constant 0")
    writing.output(
        "rest", (column.numel(), 1), {(k, 0): places.entries.get((k, 0), zero) for k in range(column.numel())}
    )
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


def _cells(system: Stability, witness: dict[str, Any]) -> dict[str, Any] | None:
    trees: list[str] = []
    for k in range(0 if system.compensated else len(system.model.limits)):
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
        k = _widest(cell, system.box)
        written.append(chr(ord("a") + k))
        waiting += reversed(halves(cell, k))
    return None


def _passes(system: Stability, cell: Box) -> bool:
    try:
        return system.passes(cell)
    except _MISFITS:
        return False


def _widest(cell: Box, whole: Sequence[tuple[fmpq, fmpq]]) -> int:
    """The setting with the largest part of its range left."""
    shares = [(hi - lo) / (b - a) if b > a else fmpq(0) for (lo, hi), (a, b) in zip(cell, whole, strict=True)]
    return max(range(len(cell)), key=lambda k: shares[k])
