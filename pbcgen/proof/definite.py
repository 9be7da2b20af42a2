"""Definiteness of symmetric matrices of exact numbers or balls, by LDL^T elimination.

The elimination needs no scaling: over the rationals it is exact, and over balls a pivot is accepted only when its
sign is certain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from flint import arb_mat, fmpq

from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import ONE, ZERO, Real, approximate, ball, in_high_precision, midpoint, rational, sign

RealMatrix = list[list[Real]]


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


def _unit_lower(matrix: RealMatrix) -> tuple[list[Real], RealMatrix, int | None]:
    """Pivots and multipliers of A = L D L^T, and the row at which the pivot is not certainly positive."""
    size = len(matrix)
    work = [list(row) for row in matrix]
    multipliers: RealMatrix = [[ZERO] * size for _ in range(size)]
    pivots: list[Real] = []
    for k in range(size):
        pivot = work[k][k]
        pivots.append(pivot)
        if sign(pivot) != 1:
            return pivots, multipliers, k
        for i in range(k + 1, size):
            if isinstance(work[i][k], fmpq) and work[i][k] == 0:
                continue
            factor = work[i][k] / pivot
            multipliers[i][k] = factor
            for j in range(k + 1, i + 1):
                work[i][j] = work[i][j] - factor * work[j][k]
                work[j][i] = work[i][j]
    return pivots, multipliers, None


def _direction(multipliers: RealMatrix, stop: int) -> tuple[Fraction, ...]:
    """The vector v with ``v^T A v`` equal to pivot number ``stop``: solves L^T v = e_stop, rounded to rationals."""
    size = len(multipliers)
    v = [ZERO] * size
    v[stop] = ONE
    for k in range(stop - 1, -1, -1):
        total: Real = ZERO
        for i in range(k + 1, stop + 1):
            total = total + multipliers[i][k] * v[i]
        v[k] = -total
    return tuple(midpoint(entry) for entry in v)


@in_high_precision
def positive_definite(matrix: RealMatrix) -> Definiteness:
    """Whether the symmetric matrix is positive definite. A singular one is REFUTED: semidefinite is not definite."""
    pivots, multipliers, stop = _unit_lower(matrix)
    if stop is None:
        return Definiteness(Status.PROVED, tuple(pivots))
    if sign(pivots[stop]) is None:
        return Definiteness(Status.UNDECIDED, tuple(pivots))
    witness = _direction(multipliers, stop)
    value = quadratic_form(matrix, witness)
    refuted = sign(value) in (0, -1)
    return Definiteness(Status.REFUTED if refuted else Status.UNDECIDED, tuple(pivots), witness, value)


@in_high_precision
def positive_semidefinite(matrix: RealMatrix) -> Definiteness:
    """Whether the symmetric matrix is positive semidefinite; touching zero counts when it is exact.

    Pivots are taken from the diagonal, largest first; when all that are left are exactly zero, so must their rows be.
    """
    size = len(matrix)
    work = [list(row) for row in matrix]
    order = list(range(size))
    pivots: list[Real] = []
    combination: RealMatrix = [[ONE if i == j else ZERO for j in range(size)] for i in range(size)]

    def verdict_against(vector: Sequence[Real]) -> Definiteness:
        witness = tuple(midpoint(c) for c in vector)
        value = quadratic_form(matrix, witness)
        status = Status.REFUTED if sign(value) == -1 else Status.UNDECIDED
        return Definiteness(status, tuple(pivots), witness, value)

    while order:
        signs = {k: sign(work[k][k]) for k in order}
        negative = next((k for k in order if signs[k] == -1), None)
        if negative is not None:
            return verdict_against(combination[negative])
        positive = [k for k in order if signs[k] == 1]
        if not positive:
            return _all_pivots_vanish(matrix, work, order, pivots, combination)
        k = max(positive, key=lambda i: approximate(work[i][i]))
        pivot = work[k][k]
        pivots.append(pivot)
        order.remove(k)
        for i in order:
            if isinstance(work[i][k], fmpq) and work[i][k] == 0:
                continue
            factor = work[i][k] / pivot
            combination[i] = [a - factor * b for a, b in zip(combination[i], combination[k], strict=True)]
            for j in order:
                work[i][j] = work[i][j] - factor * work[k][j]
    return Definiteness(Status.PROVED, tuple(pivots))


def _all_pivots_vanish(
    matrix: RealMatrix, work: RealMatrix, order: list[int], pivots: list[Real], combination: RealMatrix
) -> Definiteness:
    """The last stage: no certainly positive diagonal is left."""
    if any(sign(work[i][i]) is None for i in order):
        return Definiteness(Status.UNDECIDED, tuple(pivots))
    for i in order:
        for j in order:
            if i < j and sign(work[i][j]) in (1, -1):
                s = fmpq(-1 if sign(work[i][j]) == 1 else 1)
                vector = [a + s * b for a, b in zip(combination[i], combination[j], strict=True)]
                witness = tuple(midpoint(c) for c in vector)
                value = quadratic_form(matrix, witness)
                status = Status.REFUTED if sign(value) == -1 else Status.UNDECIDED
                return Definiteness(status, tuple(pivots), witness, value)
            if sign(work[i][j]) is None:
                return Definiteness(Status.UNDECIDED, tuple(pivots))
    return Definiteness(Status.PROVED, tuple(pivots))


@in_high_precision
def eigenvalues(matrix: RealMatrix) -> list[float]:
    """Eigenvalues of a symmetric matrix in ascending order, for display (computed with the working precision)."""
    from flint import acb_mat

    if not matrix:
        return []
    middle = acb_mat([[ball(rational(midpoint(entry))) for entry in row] for row in matrix])
    return sorted(float(midpoint(v.real)) for v in middle.eig(algorithm="approx"))


def as_balls(matrix: RealMatrix) -> arb_mat:
    """The matrix as balls of the current precision."""
    return arb_mat([[ball(entry) for entry in row] for row in matrix])
