"""The power structure of a system: how its drift and the gradient of its storage are related.

Two forms: ``f = F(x) grad S - rho(x)`` (port-Hamiltonian, with a remainder of friction-like terms) and
``grad S = A(x) f`` (Brayton-Moser). In both, with v the vector that the dissipation is a quadratic form of,

    u^T y - dS/dt = v^T B v + rho^T grad S,   B = -sym F, v = grad S - (grad gamma) u   or   B = -sym A, v = x'.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.construction import drift_by_construction
from pbcgen.passivity.factor import Factor, find_factor, refine_symbolically
from pbcgen.passivity.least import constant_below
from pbcgen.passivity.plant import Plant, dot
from pbcgen.proof.elimination import semidefinite
from pbcgen.proof.nonnegative import Everywhere, Prover
from pbcgen.symbolic.coefficients import common_denominator
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.tape import Matrix as SparseMatrix

#: Common denominators with more terms are left where they are.
_MOST_IN_DENOMINATOR = 12


@dataclass(frozen=True, eq=False)
class PowerStructure:
    """One of the two forms, as SX expressions of the state and the parameters.

    Attributes:
        form: ``F`` for f = F grad S - rho, ``A`` for grad S = A f.
        matrix: F or A, n x n.
        remainder: rho, n x 1; zero for the form A.
        origin: where it comes from, for the evidence of verdicts.
        known: whether it is the front end's own.
    """

    form: Literal["F", "A"]
    matrix: ca.SX
    remainder: ca.SX
    origin: str
    known: bool = False

    def dissipation(self) -> ca.SX:
        """B, n x n symmetric."""
        return -(self.matrix + self.matrix.T) / 2


def candidates(plant: Plant) -> Iterator[PowerStructure]:
    """Structures to try: the model's own first, then what the search finds, simplest first."""
    system = plant.system
    zero = ca.SX(system.n, 1)
    known = system.structure
    if known is not None and known.F is not None:
        yield PowerStructure("F", ca.SX(known.F), zero, "the model's structure f = F grad S", known=True)
    if known is not None and known.A is not None:
        yield PowerStructure("A", ca.SX(known.A), zero, "the model's structure grad S = A f", known=True)
    try:
        yield from _searched(plant)
    except (UnsupportedOperation, ZeroDivisionError):
        return


def _searched(plant: Plant) -> Iterator[PowerStructure]:
    for form, affine in (("F", False), ("A", False), ("A", True), ("F", True)):
        found = _search(plant, form == "F", affine)
        if found is not None:
            wording = "affine in states and atoms" if affine else "constant"
            relation = "f = F grad S" if form == "F" else "grad S = A f"
            origin = f"{relation} found with {form} {wording}"
            yield PowerStructure("F" if form == "F" else "A", found[0], found[1], origin)


def _search(plant: Plant, drift_first: bool, affine: bool) -> tuple[ca.SX, ca.SX] | None:
    common, numbers = _sides(plant, drift_first, affine, symbolic=False)
    found = find_factor(*numbers, drift_first)
    if found is None:
        return None
    factor, pattern = found
    shared, sides = _sides(plant, drift_first, affine, symbolic=True)
    if len(sides[-1]) == len(numbers[-1]):
        refined = refine_symbolically(*sides, plant.parameter_positions(), pattern, remainder_allowed=drift_first)
        if refined is not None:
            return _as_expressions(plant, refined, shared)
    return _as_expressions(plant, factor, common)


def _sides(
    plant: Plant, drift_first: bool, affine: bool, symbolic: bool
) -> tuple[Quotient, tuple[Field, list[Quotient], list[Quotient], list[Quotient]]]:
    """A function that makes polynomials of f and grad S, which is 1 where they are such; then these, times it."""
    field, (drift, gradient) = plant.exact(plant.system.f, plant.gradient, symbolic=symbolic)
    zero = field.const(0)
    f, e = drift.column(zero), gradient.column(zero)
    multipliers = [field.const(1)]
    if affine:
        multipliers += [field.symbol(k) for k in range(plant.system.n)]
        parameters = plant.parameter_positions()
        multipliers += [
            field.symbol(k) for k, atom in sorted(field.atoms.items()) if not atom.argument.symbols() <= parameters
        ]
    by_state = (v for v in (*f, *e) if not field.polynomial(v.denominator).symbols() <= plant.parameter_positions())
    common = common_denominator(field, by_state)  # such as sinh makes
    if len(common.numerator) > _MOST_IN_DENOMINATOR:
        common = field.const(1)
    f, e = [v * common for v in f], [v * common for v in e]
    return common, (field, *((f, e) if drift_first else (e, f)), multipliers)


def _as_expressions(plant: Plant, factor: Factor, common: Quotient) -> tuple[ca.SX, ca.SX]:
    size = len(factor.matrix)
    matrix, remainder = ca.SX(size, size), ca.SX(size, 1)
    for i, row in enumerate(factor.matrix):
        for j, entry in sorted(row.items()):
            if not entry.is_zero():
                matrix[i, j] = plant.expression(entry)
    for i, entry in enumerate(factor.remainder):
        if not entry.is_zero():
            remainder[i] = plant.expression(entry / common)
    return matrix, remainder


@dataclass(frozen=True)
class StructureProof:
    """What the exact provers say of a structure: each must hold for Assumption 1 by this route."""

    identity: bool
    dissipation: bool
    remainder: bool

    @property
    def complete(self) -> bool:
        """Whether Assumption 1 follows."""
        return self.identity and self.dissipation and self.remainder


def prove(plant: Plant, structure: PowerStructure, prover: Prover | None = None) -> StructureProof:
    """Check ``f = F grad S - rho`` (or grad S = A f), ``B >= 0`` and ``rho^T grad S >= 0`` as exact functions.

    The signs are those that ``prover`` proves, by exact algebra on the whole space if it is not given.
    """
    prover = prover or Everywhere()
    if structure.known and plant.gradient_is_exact and drift_by_construction(plant.system):
        if not plant.is_continuous:
            return StructureProof(True, False, False)
        return _by_construction(plant, structure, prover)
    try:
        field, (f, e, matrix, remainder, dissipation) = plant.exact(
            plant.system.f, plant.gradient, structure.matrix, structure.remainder, structure.dissipation()
        )
        zero = field.const(0)
        drift, gradient, rho = f.column(zero), e.column(zero), remainder.column(zero)
        identity = _identity(structure, drift, gradient, rho, matrix)
        friction = dot(rho, gradient, zero)
    except (UnsupportedOperation, ZeroDivisionError):
        return StructureProof(False, False, False)
    if not identity:
        return StructureProof(False, False, False)
    sign = semidefinite(dissipation.rows(), prover=prover)
    return StructureProof(True, sign, prover.nonnegative(friction))


def _identity(
    structure: PowerStructure,
    drift: list[Quotient],
    gradient: list[Quotient],
    rho: list[Quotient],
    matrix: SparseMatrix[Quotient],
) -> bool:
    """``f = F grad S - rho``, or ``grad S = A f``."""
    left, right = (drift, gradient) if structure.form == "F" else (gradient, drift)
    excess = [value + rho[i] if structure.form == "F" else value for i, value in enumerate(left)]
    for (i, j), entry in matrix.entries.items():
        if not entry.is_zero():
            excess[i] = excess[i] - entry * right[j]
    return all(value.is_zero() for value in excess)


def _by_construction(plant: Plant, structure: PowerStructure, prover: Prover) -> StructureProof:
    """The dissipation alone: f is written as F grad S, without remainder."""
    try:
        _, (dissipation,) = plant.exact(structure.dissipation())
    except (UnsupportedOperation, ZeroDivisionError):
        return StructureProof(True, False, True)
    return StructureProof(True, semidefinite(dissipation.rows(), prover=prover), True)


def power_structure(plant: Plant) -> tuple[PowerStructure, StructureProof] | None:
    """The first structure that proves Assumption 1, else the first whose identity holds, else None."""
    fallback = None
    for structure in candidates(plant):
        proof = prove(plant, structure)
        if proof.complete:
            return with_linear_friction(plant, structure), proof
        if proof.identity and fallback is None:
            fallback = structure, proof
    return fallback


def with_linear_friction(plant: Plant, structure: PowerStructure) -> PowerStructure:
    """The same with linear friction in F: with ``rho_i = (r_i + c) e_i`` and ``r_i >= 0``, c goes there.

    The identity stays as it is, and so does the sign of each term of the friction; what all v lose grows.
    """
    if structure.form != "F" or not structure.remainder.nnz():
        return structure
    try:
        field, (e, rho) = plant.exact(plant.gradient, structure.remainder)
    except (UnsupportedOperation, ZeroDivisionError):
        return structure
    zero = field.const(0)
    matrix, remainder = ca.SX(structure.matrix), ca.SX(structure.remainder)
    for i, (slope, friction) in enumerate(zip(e.column(zero), rho.column(zero), strict=True)):
        if friction.is_zero() or slope.is_zero():
            continue
        c = plant.number(constant_below(friction / slope, slope * slope))
        matrix[i, i] -= c
        remainder[i] -= c * plant.gradient[i]
    return replace(structure, matrix=matrix, remainder=remainder)
