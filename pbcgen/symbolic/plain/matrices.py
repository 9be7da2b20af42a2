"""Matrices of numbers or functions as lists of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from flint import fmpq

from pbcgen.symbolic.plain.values import sign, times

Matrix = list[list[Any]]


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """The sum of products."""
    return sum((times(x, y) for x, y in zip(a, b, strict=True)), fmpq(0))


def transpose(a: Matrix) -> Matrix:
    """The transpose."""
    return [list(row) for row in zip(*a, strict=True)]


def product(*factors: Matrix) -> Matrix:
    """The product."""
    result, *rest = factors
    for factor in rest:
        result = [[dot(row, column) for column in zip(*factor, strict=True)] for row in result]
    return result


def plus(a: Matrix, b: Matrix, scale: Any = 1) -> Matrix:
    """``a + scale b``."""
    return [[x + y * scale for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]


def symmetric(a: Matrix) -> Matrix:
    """``(a + a^T) / 2``."""
    return [[(x + y) / 2 for x, y in zip(*rows, strict=True)] for rows in zip(a, transpose(a), strict=True)]


def negative(a: Matrix) -> Matrix:
    """``-a``."""
    return [[-v for v in row] for row in a]


def diagonal(entries: Sequence[Any], columns: int | None = None) -> Matrix:
    """A matrix with these entries on its diagonal."""
    width = len(entries) if columns is None else columns
    return [[entry if i == j else fmpq(0) for j in range(width)] for i, entry in enumerate(entries)]


def blocks(rows: Sequence[Sequence[Matrix]]) -> Matrix:
    """A matrix from its blocks."""
    return [[v for block in row for v in block[i]] for row in rows for i in range(len(row[0]))]


def is_definite(a: Matrix, semi: bool = False) -> bool | None:
    """Whether a symmetric matrix is positive (semi)definite, by elimination; None if that is not certain.

    Rows with few entries come first: a large system stays sparse.
    """
    rows = {i: {k: v for k, v in enumerate(row) if sign(v) != 0} for i, row in enumerate(a)}
    while rows:
        i = min(rows, key=lambda i: len(rows[i]))
        row = rows.pop(i)
        pivot = row.pop(i, fmpq(0))
        if sign(pivot) != 1 and not (semi and all(sign(v) == 0 for v in (pivot, *row.values()))):
            return False if sign(pivot) == -1 or (sign(pivot) == 0 and not semi) else None
        for k in row:
            below = rows[k].pop(i, fmpq(0))
            rows[k] |= {j: rows[k].get(j, fmpq(0)) - v * below / pivot for j, v in row.items() if pivot != 0}
    return True
