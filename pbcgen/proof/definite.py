"""Definiteness of symmetric matrices of exact numbers or balls, by LDL^T elimination of sparse rows.

The elimination needs no scaling: over the rationals it is exact, and over balls a pivot is accepted only when its
sign is certain.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from heapq import heapify, heappop, heappush

import numpy as np
from flint import fmpq

from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import (
    ONE,
    ZERO,
    Real,
    approximate,
    ball,
    in_high_precision,
    is_finite,
    midpoint,
    near_eigenvalues,
    rational,
    sign,
)
from pbcgen.symbolic.real_matrices import (
    RealMatrix,
    Rows,
    SparseRow,
    as_balls,
    dense,
    nonzeros,
    quadratic_form,
)

#: Eigenvalues of larger matrices are computed in double precision where that shows all of them.
_LARGEST_PRECISE = 40
#: Of larger positive definite matrices only the smallest one is computed, with a sparse factorisation.
_LARGEST_DENSE = 150
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


def _symmetric_part(matrix: Rows) -> dict[int, SparseRow]:
    """The rows of the symmetric part without exact zeros; of two balls that mirror each other the lower one."""
    rows = nonzeros(matrix)
    work: dict[int, SparseRow] = {i: {} for i in range(len(rows))}
    for i, j in sorted({(max(i, j), min(i, j)) for i, row in enumerate(rows) for j in row}):
        entry, mirrored = rows[i].get(j, ZERO), rows[j].get(i, ZERO)
        if isinstance(entry, fmpq) and isinstance(mirrored, fmpq) and entry != mirrored:
            entry = (entry + mirrored) / 2
            if entry == 0:
                continue
        work[i][j] = work[j][i] = entry
    return work


class _Shortest:
    """The rows that are left, the shortest one first: the elimination then stays sparse."""

    def __init__(self, work: dict[int, SparseRow]) -> None:
        self.work = work
        self.heap = [(len(row), k) for k, row in work.items()]
        heapify(self.heap)

    def changed(self, rows: Iterable[int]) -> None:
        """The lengths of these rows may have changed."""
        for k in rows:
            heappush(self.heap, (len(self.work[k]), k))

    def take(self) -> int | None:
        """The shortest row, or None; it is not offered again until it has changed."""
        while self.heap:
            length, k = heappop(self.heap)
            if k in self.work and len(self.work[k]) == length:
                return k
        return None


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
def positive_definite(matrix: Rows) -> Definiteness:
    """Whether the symmetric matrix is positive definite. A singular one is REFUTED: semidefinite is not definite."""
    work = _symmetric_part(matrix)
    queue = _Shortest(work)
    pivots: list[Real] = []
    multipliers: list[tuple[int, SparseRow]] = []
    while (k := queue.take()) is not None:
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
        queue.changed(multipliers[-1][1])
    return Definiteness(Status.UNDECIDED if work else Status.PROVED, tuple(pivots))


@in_high_precision
def positive_semidefinite(matrix: Rows) -> Definiteness:
    """Whether the symmetric matrix is positive semidefinite; touching zero counts when it is exact.

    Pivots are taken from the diagonal, those of short rows first if exact, else the largest; when all that are left are
    exactly zero, so must their rows be.
    """
    work = _symmetric_part(matrix)
    exact = all(isinstance(entry, fmpq) for row in work.values() for entry in row.values())
    queue = _Shortest(work)
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

    changed: Iterable[int] = list(work)
    while work:
        negative = min((k for k in changed if sign(work[k].get(k, ZERO)) == -1), default=None)
        if negative is not None:
            return verdict_against((negative, Fraction(1)))
        k = _next_pivot(work, queue if exact else None)
        if k is None:
            against = _all_pivots_vanish(work)
            if against is None:
                return Definiteness(Status.UNDECIDED, tuple(pivots))
            return verdict_against(*against) if against else Definiteness(Status.PROVED, tuple(pivots))
        pivots.append(work[k][k])
        multipliers.append((k, _eliminate(work, k)))
        changed = multipliers[-1][1]
        queue.changed(changed)
    return Definiteness(Status.PROVED, tuple(pivots))


def _next_pivot(work: dict[int, SparseRow], queue: _Shortest | None) -> int | None:
    """A row with a certainly positive diagonal entry: the shortest one from the queue, else that of the largest."""
    if queue is None:
        positive = [k for k, row in work.items() if sign(row.get(k, ZERO)) == 1]
        return max(positive, key=lambda i: approximate(work[i][i]), default=None)
    while (k := queue.take()) is not None:
        if sign(work[k].get(k, ZERO)) == 1:
            return k
    return None


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
def eigenvalues(matrix: Rows) -> list[float]:
    """Eigenvalues of a symmetric matrix in ascending order, for display (computed with the working precision)."""
    from flint import acb_mat

    if not matrix:
        return []
    rows = nonzeros(matrix)
    if not all(is_finite(entry) for row in rows for entry in row.values()):
        return [float("nan")] * len(rows)
    if len(rows) > _LARGEST_PRECISE:
        places, values = _doubles(rows)
        middle = np.zeros((len(rows), len(rows)))
        middle[places] = values
        doubles = np.linalg.eigvalsh(middle)
        if np.all(np.isfinite(doubles)) and np.min(np.abs(doubles)) > _SHOWN_BY_DOUBLES * np.max(np.abs(doubles)):
            return [float(v) for v in doubles]
    centre = acb_mat([[ball(rational(midpoint(entry))) for entry in row] for row in dense(rows, len(rows))])
    return sorted(float(midpoint(v.real)) for v in near_eigenvalues(centre))


def smallest_eigenvalue(matrix: Rows, positive: bool) -> float:
    """The smallest eigenvalue of a symmetric matrix, for display; ``positive`` says that it is positive definite."""
    rows = nonzeros(matrix)
    if positive and len(rows) > _LARGEST_DENSE:
        from scipy.sparse import csc_array
        from scipy.sparse.linalg import ArpackError, eigsh

        places, values = _doubles(rows)
        start = np.random.default_rng(0).uniform(-1, 1, len(rows))
        with suppress(ArpackError, RuntimeError):
            found = eigsh(csc_array((values, places)), 1, sigma=0, v0=start, return_eigenvectors=False)
            if found[0] > 0:
                return float(found[0])
    return eigenvalues(rows)[0]


def _doubles(rows: Sequence[SparseRow]) -> tuple[tuple[list[int], list[int]], list[float]]:
    """Rows, columns and values of the entries, rounded."""
    places = [i for i, row in enumerate(rows) for _ in row], [j for row in rows for j in row]
    return places, [approximate(entry) for row in rows for entry in row.values()]


def solve_positive(matrix: Rows, right: RealMatrix) -> RealMatrix | None:
    """``matrix^-1 right`` for a positive definite matrix, exact or enclosed; None if it may be singular."""
    work = _symmetric_part(matrix)
    if not all(isinstance(entry, fmpq) for row in work.values() for entry in row.values()):
        try:
            rows = [work[i] for i in range(len(work))]
            return [list(row) for row in as_balls(dense(rows, len(rows))).solve(as_balls(right)).tolist()]
        except ZeroDivisionError:
            return None
    queue = _Shortest(work)
    result = [list(row) for row in right]
    steps: list[tuple[int, Real, SparseRow]] = []
    while (k := queue.take()) is not None:
        pivot = work[k].get(k, ZERO)
        if pivot == 0:
            return None
        factors = _eliminate(work, k)
        queue.changed(factors)
        steps.append((k, pivot, factors))
        for i, factor in factors.items():
            result[i] = [a - factor * b for a, b in zip(result[i], result[k], strict=True)]
    for k, pivot, factors in reversed(steps):
        result[k] = [entry / pivot for entry in result[k]]
        for i, factor in factors.items():
            result[k] = [a - factor * b for a, b in zip(result[k], result[i], strict=True)]
    return result
