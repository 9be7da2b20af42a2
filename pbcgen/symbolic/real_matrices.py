"""Matrices of numbers that are exact or enclosed, by rows."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from flint import arb_mat, fmpq, fmpq_mat
from numpy.typing import NDArray

from pbcgen.symbolic.real import ZERO, Real, approximate, ball, rational

RealMatrix = list[list[Real]]
#: The entries of a row that are not exactly zero, by column.
SparseRow = dict[int, Real]
#: A matrix by rows, each with all entries or with those that are not exactly zero.
Rows = Sequence[list[Real]] | Sequence[SparseRow]


def nonzeros(matrix: Rows) -> list[SparseRow]:
    """The entries by row and column that are not exactly zero."""
    return [
        {j: e for j, e in (row.items() if isinstance(row, dict) else enumerate(row)) if not _vanishes(e)}
        for row in matrix
    ]


def _vanishes(entry: Real) -> bool:
    return isinstance(entry, fmpq) and entry == 0


def dense(rows: Sequence[SparseRow], columns: int) -> RealMatrix:
    """The rows with all their entries."""
    return [[row.get(j, ZERO) for j in range(columns)] for row in rows]


def transpose(a: RealMatrix) -> RealMatrix:
    """The transpose."""
    return [list(row) for row in zip(*a, strict=True)]


def diagonal(entries: list[Real]) -> RealMatrix:
    """A diagonal matrix."""
    return [[entry if i == j else ZERO for j in range(len(entries))] for i, entry in enumerate(entries)]


def exact_matrix(rows: tuple[tuple[Fraction, ...], ...]) -> RealMatrix:
    """Exact gains as a matrix of reals."""
    return [[rational(entry) for entry in row] for row in rows]


def add(a: RealMatrix, b: RealMatrix) -> RealMatrix:
    """The entrywise sum."""
    return [[x + y for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]


def multiply(a: RealMatrix, b: RealMatrix) -> RealMatrix:
    """The matrix product; exact zeros stay exact."""
    transposed = list(zip(*b, strict=True))
    return [[_dot(row, column) for column in transposed] for row in a]


def _dot(a: Sequence[Real], b: Sequence[Real]) -> Real:
    total: Real = ZERO
    for x, y in zip(a, b, strict=True):
        if not (_vanishes(x) or _vanishes(y)):
            total = total + x * y
    return total


def weighted_sum(weights: Sequence[Real], matrices: Sequence[RealMatrix]) -> RealMatrix:
    """``sum w_k M_k`` of at least one matrix."""
    rows = zip(*matrices, strict=True)
    return [[_dot(weights, entries) for entries in zip(*row, strict=True)] for row in rows]


def congruence(n: RealMatrix, a: RealMatrix) -> RealMatrix:
    """``N A N^T``."""
    return multiply(multiply(n, a), transpose(n))


def quadratic_form(matrix: Rows, vector: Sequence[Fraction]) -> Real:
    """``v^T A v``."""
    v = [rational(c) for c in vector]
    total: Real = ZERO
    for i, row in enumerate(nonzeros(matrix)):
        for j, entry in row.items():
            if v[i] != 0 and v[j] != 0:
                total = total + entry * (v[i] * v[j])
    return total


def as_balls(matrix: RealMatrix) -> arb_mat:
    """The matrix as balls of the current precision."""
    return arb_mat([[ball(entry) for entry in row] for row in matrix])


def as_floats(matrix: RealMatrix) -> NDArray[np.float64]:
    """The matrix rounded."""
    return np.array([[approximate(entry) for entry in row] for row in matrix], dtype=float)


def inverse(matrix: RealMatrix) -> RealMatrix | None:
    """The inverse, exact or enclosed; None if it may be singular."""
    try:
        if all(isinstance(entry, fmpq) for row in matrix for entry in row):
            return [list(row) for row in fmpq_mat(matrix).inv().tolist()]
        return [list(row) for row in as_balls(matrix).inv().tolist()]
    except ZeroDivisionError:
        return None


def approximate_inverse(matrix: RealMatrix) -> arb_mat | None:
    """An exact matrix close to the inverse, or None if there may be none: the preconditioner of interval methods."""
    size = range(len(matrix))
    try:
        found = as_balls(matrix).inv()
    except ZeroDivisionError:
        return None
    return arb_mat([[found[i, j].mid() for j in size] for i in size])
