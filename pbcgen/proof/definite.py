"""Definiteness of symmetric matrices of exact numbers or balls, by LDL^T elimination of sparse rows.

The elimination needs no scaling: over the rationals it is exact, and over balls a pivot is accepted only when its
sign is certain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from flint import arb_mat, fmpq, fmpq_mat

from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import ONE, ZERO, Real, approximate, ball, in_high_precision, midpoint, rational, sign

RealMatrix = list[list[Real]]
SparseRow = dict[int, Real]

#: Eigenvalues of larger matrices are computed in double precision where that shows all of them.
_LARGEST_PRECISE = 40
_SHOWN_BY_DOUBLES = 1e-9


@dataclass(frozen=True)
class Definiteness:
    """The verdict on ``A > 0`` or ``A >= 0``.

    Attributes:
        status: PROVED, REFUTED or UNDECIDED.
        pivots: the pivots D of the elimination as far as it went.
        witness: for REFUTED a rational vector v with ``v^T A v <= 0`` (``< 0`` for semidefiniteness).
        value: ``v^T A v``, evaluated again from A.
    """

    status: Status
    pivots: tuple[Real, ...]
    witness: tuple[Fraction, ...] | None = None
    value: Real | None = None


def quadratic_form(matrix: RealMatrix, vector: Sequence[Fraction]) -> Real:
    """``v^T A v``."""
    v = [rational(c) for c in vector]
    total: Real = ZERO
    for i, row in enumerate(matrix):
        for j, entry in enumerate(row):
            if v[i] != 0 and v[j] != 0:
                total = total + entry * (v[i] * v[j])
    return total


def _sparse(matrix: RealMatrix) -> dict[int, SparseRow]:
    """The rows of the symmetric part without exact zeros."""
    work: dict[int, SparseRow] = {i: {} for i in range(len(matrix))}
    for i, row in enumerate(matrix):
        for j in range(i + 1):
            entry, mirrored = row[j], matrix[j][i]
            if isinstance(entry, fmpq) and isinstance(mirrored, fmpq):
                if entry != mirrored:
                    entry = (entry + mirrored) / 2
                if entry == 0:
                    continue
            work[i][j] = work[j][i] = entry
    return work


def _eliminate(work: dict[int, SparseRow], k: int) -> SparseRow:
    """Remove row and column k of a symmetric matrix; the multipliers of the other rows are returned."""
    row = work.pop(k)
    pivot = row.pop(k)
    factors = {i: work[i].pop(k) / pivot for i in row}
    for i, factor in factors.items():
        target = work[i]
        for j, entry in row.items():
            value = target.get(j, ZERO) - factor * entry
            if isinstance(value, fmpq) and value == 0:
                target.pop(j, None)
            else:
                target[j] = value
    return factors


def _direction(multipliers: list[tuple[int, SparseRow]], stop: int, size: int) -> tuple[Fraction, ...]:
    """The vector v with ``v^T A v`` equal to the pivot of row ``stop``: solves L^T v = e_stop, rounded to rationals."""
    v: list[Real] = [ZERO] * size
    v[stop] = ONE
    for k, factors in reversed(multipliers):
        total: Real = ZERO
        for i, factor in factors.items():
            total = total + factor * v[i]
        v[k] = -total
    return tuple(midpoint(entry) for entry in v)


@in_high_precision
def positive_definite(matrix: RealMatrix) -> Definiteness:
    """Whether the symmetric matrix is positive definite. A singular one is REFUTED: semidefinite is not definite."""
    work = _sparse(matrix)
    pivots: list[Real] = []
    multipliers: list[tuple[int, SparseRow]] = []
    while work:
        k = min(work, key=lambda i: (len(work[i]), i))
        pivot = work[k].get(k, ZERO)
        pivots.append(pivot)
        if sign(pivot) is None:
            return Definiteness(Status.UNDECIDED, tuple(pivots))
        if sign(pivot) != 1:
            witness = _direction(multipliers, k, len(matrix))
            value = quadratic_form(matrix, witness)
            refuted = sign(value) in (0, -1)
            return Definiteness(Status.REFUTED if refuted else Status.UNDECIDED, tuple(pivots), witness, value)
        multipliers.append((k, _eliminate(work, k)))
    return Definiteness(Status.PROVED, tuple(pivots))


@in_high_precision
def positive_semidefinite(matrix: RealMatrix) -> Definiteness:
    """Whether the symmetric matrix is positive semidefinite; touching zero counts when it is exact.

    Pivots are taken from the diagonal, those of short rows first if exact, else the largest; when all that are left are
    exactly zero, so must their rows be.
    """
    work = _sparse(matrix)
    exact = all(isinstance(entry, fmpq) for row in matrix for entry in row)
    pivots: list[Real] = []
    multipliers: list[tuple[int, SparseRow]] = []

    def verdict_against(*directions: tuple[int, Fraction]) -> Definiteness:
        witness = [Fraction(0)] * len(matrix)
        for k, weight in directions:
            v = _direction(multipliers, k, len(matrix))
            witness = [a + weight * b for a, b in zip(witness, v, strict=True)]
        value = quadratic_form(matrix, witness)
        status = Status.REFUTED if sign(value) == -1 else Status.UNDECIDED
        return Definiteness(status, tuple(pivots), tuple(witness), value)

    while work:
        signs = {k: sign(row.get(k, ZERO)) for k, row in work.items()}
        negative = next((k for k in signs if signs[k] == -1), None)
        if negative is not None:
            return verdict_against((negative, Fraction(1)))
        positive = [k for k in signs if signs[k] == 1]
        if not positive:
            against = _all_pivots_vanish(work)
            if against is None:
                return Definiteness(Status.UNDECIDED, tuple(pivots))
            return verdict_against(*against) if against else Definiteness(Status.PROVED, tuple(pivots))
        if exact:
            k = min(positive, key=lambda i: (len(work[i]), i))
        else:
            k = max(positive, key=lambda i: approximate(work[i][i]))
        pivots.append(work[k][k])
        multipliers.append((k, _eliminate(work, k)))
    return Definiteness(Status.PROVED, tuple(pivots))


def _all_pivots_vanish(work: dict[int, SparseRow]) -> list[tuple[int, Fraction]] | None:
    """No positive diagonal is left: a combination of two rows that refutes, none if all is zero, None if uncertain."""
    if any(sign(row.get(i, ZERO)) is None for i, row in work.items()):
        return None
    for i, row in work.items():
        for j, entry in row.items():
            if sign(entry) is None:
                return None
            if i < j and sign(entry) in (1, -1):
                return [(i, Fraction(1)), (j, Fraction(-1 if sign(entry) == 1 else 1))]
    return []


@in_high_precision
def eigenvalues(matrix: RealMatrix) -> list[float]:
    """Eigenvalues of a symmetric matrix in ascending order, for display (computed with the working precision)."""
    from flint import acb_mat

    if not matrix:
        return []
    if len(matrix) > _LARGEST_PRECISE:
        doubles = np.linalg.eigvalsh(np.array([[approximate(entry) for entry in row] for row in matrix]))
        if np.all(np.isfinite(doubles)) and np.min(np.abs(doubles)) > _SHOWN_BY_DOUBLES * np.max(np.abs(doubles)):
            return [float(v) for v in doubles]
    middle = acb_mat([[ball(rational(midpoint(entry))) for entry in row] for row in matrix])
    return sorted(approximate(v.real) for v in middle.eig(algorithm="approx"))


def as_balls(matrix: RealMatrix) -> arb_mat:
    """The matrix as balls of the current precision."""
    return arb_mat([[ball(entry) for entry in row] for row in matrix])


def inverse(matrix: RealMatrix) -> RealMatrix | None:
    """The inverse, exact or enclosed; None if it may be singular."""
    try:
        if all(isinstance(entry, fmpq) for row in matrix for entry in row):
            return [list(row) for row in fmpq_mat(matrix).inv().tolist()]
        return [list(row) for row in as_balls(matrix).inv().tolist()]
    except ZeroDivisionError:
        return None
