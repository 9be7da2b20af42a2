"""Symmetric matrices of exact functions: semidefinite and definite by elimination, with pivots proved positive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pbcgen.proof.nonnegative import Everywhere, Prover
from pbcgen.symbolic.field import Quotient, TooLarge


def _as_rows(matrix: Sequence[Sequence[Quotient]]) -> dict[int, dict[int, Quotient]]:
    """The nonzero entries by row and column."""
    return {i: {j: entry for j, entry in enumerate(row) if not entry.is_zero()} for i, row in enumerate(matrix)}


def _by_cost(rows: Mapping[int, Mapping[int, Quotient]]) -> list[int]:
    """Pivots that are numbers and have few neighbours first: the elimination then stays small."""

    def cost(k: int) -> tuple[bool, int, int]:
        entry = rows[k][k]
        return entry.constant() is None, len(rows[k]), len(entry.numerator)

    return sorted((k for k in rows if k in rows[k]), key=cost)


def _eliminate(rows: dict[int, dict[int, Quotient]], pivot: int) -> None:
    """One step of symmetric elimination; row and column ``pivot`` are removed."""
    row = rows.pop(pivot)
    head = row.pop(pivot)
    for i in row:
        del rows[i][pivot]
    for i, left in row.items():
        factor = left / head
        for j, right in row.items():
            before = rows[i].get(j)
            value = -(factor * right) if before is None else before - factor * right
            if value.is_zero():
                rows[i].pop(j, None)
            else:
                rows[i][j] = value


def semidefinite(
    matrix: Sequence[Sequence[Quotient]],
    positive_symbols: frozenset[int] = frozenset(),
    prover: Prover | None = None,
) -> bool:
    """Whether the symmetric matrix of functions is proved positive semidefinite wherever it is defined.

    Elimination with pivots that are proved positive. A diagonal entry that is the zero function needs a zero row.
    ``prover`` decides the signs, :class:`Everywhere` if not given.
    """
    prover = prover or Everywhere(positive_symbols)
    try:
        return _semidefinite(_as_rows(matrix), prover)
    except TooLarge:
        return False


def _semidefinite(rows: dict[int, dict[int, Quotient]], prover: Prover) -> bool:
    while rows:
        for k in [k for k, row in rows.items() if not row]:
            del rows[k]
        if not rows:
            return True
        if any(k not in row for k, row in rows.items()):
            return False
        isolated = [k for k, row in rows.items() if len(row) == 1]
        if isolated:
            if not all(prover.nonnegative(rows[k][k]) for k in isolated):
                return False
            for k in isolated:
                del rows[k]
            continue
        pivot = next((k for k in _by_cost(rows) if prover.positive(rows[k][k])), None)
        if pivot is None:
            return False
        _eliminate(rows, pivot)
    return True


def definite(
    matrix: Sequence[Sequence[Quotient]],
    positive_symbols: frozenset[int] = frozenset(),
    prover: Prover | None = None,
) -> bool:
    """Whether the symmetric matrix of functions is proved positive definite wherever it is defined."""
    prover = prover or Everywhere(positive_symbols)
    try:
        return _definite(_as_rows(matrix), prover)
    except TooLarge:
        return False


def _definite(rows: dict[int, dict[int, Quotient]], prover: Prover) -> bool:
    while rows:
        if any(k not in row for k, row in rows.items()):
            return False
        pivot = next((k for k in _by_cost(rows) if prover.positive(rows[k][k])), None)
        if pivot is None:
            return False
        _eliminate(rows, pivot)
    return True


def positivity_conditions(matrix: Sequence[Sequence[Quotient]], prover: Prover | None = None) -> list[Quotient]:
    """Functions that are all positive just where the symmetric matrix is positive definite: none if that is proved.

    Pivots that are proved positive are taken first; those that are left are the conditions (Sylvester). One that is
    the zero function says that the matrix is nowhere definite. Raises TooLarge.
    """
    prover = prover or Everywhere()
    rows = _as_rows(matrix)
    zero = matrix[0][0].field.const(0)
    left = []
    while rows:
        sure = next((k for k in _by_cost(rows) if prover.positive(rows[k][k])), None)
        pivot = next(iter(rows)) if sure is None else sure
        head = rows[pivot].get(pivot, zero)
        if sure is None:
            left.append(head)
        if head.is_zero():
            break
        _eliminate(rows, pivot)
    return left
