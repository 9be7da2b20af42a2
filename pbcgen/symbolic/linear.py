"""Linear equations over any exact field: rationals or rational functions.

An equation is a sparse row ``{unknown: coefficient, CONSTANT: c}`` that stands for ``sum coefficient*unknown + c = 0``.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from typing import Any

from flint import fmpq

from pbcgen.symbolic.field import Quotient

#: The key of the constant term of a row.
CONSTANT = "constant term"

Row = dict[Hashable, Any]


class Inconsistent(Exception):
    """The equations contradict each other; ``residual`` is the nonzero constant that should be zero."""

    def __init__(self, residual: Any) -> None:
        super().__init__("the equations have no solution")
        self.residual = residual


def is_zero(value: Any) -> bool:
    """Whether an element of the field is zero."""
    return bool(value.is_zero()) if isinstance(value, Quotient) else bool(value == 0)


def _without_zeros(row: Mapping[Hashable, Any]) -> Row:
    return {key: value for key, value in row.items() if not is_zero(value)}


def _cost(value: Any) -> int:
    """How unwieldy a pivot is: numbers before polynomials before fractions."""
    if isinstance(value, Quotient):
        return len(value.numerator) + 2 * len(value.denominator)
    return int(value.p.height_bits() + value.q.height_bits()) if isinstance(value, fmpq) else 1


def _eliminate(row: Row, unknown: Hashable, pivot_row: Row) -> Row:
    factor = row.pop(unknown)
    for key, value in pivot_row.items():
        if key != unknown:
            row[key] = row[key] - factor * value if key in row else -(factor * value)
    return _without_zeros(row)


def reduce_rows(rows: Iterable[Mapping[Hashable, Any]]) -> dict[Hashable, Row]:
    """Reduced row echelon form.

    Returns:
        For each pivot unknown its row with pivot coefficient one, free of the other pivots: the unknown equals minus
        the rest of the row.

    Raises:
        Inconsistent: when there is no solution.
    """
    waiting = [_without_zeros(row) for row in rows]
    solved: dict[Hashable, Row] = {}
    while waiting:
        waiting.sort(key=len, reverse=True)
        row = waiting.pop()
        unknowns = [key for key in row if key != CONSTANT]
        if not unknowns:
            if row:
                raise Inconsistent(row[CONSTANT])
            continue
        pivot = min(unknowns, key=lambda key: (_cost(row[key]), str(key)))
        scale = row[pivot]
        pivot_row = {key: value / scale for key, value in row.items()}
        waiting = [_eliminate(dict(r), pivot, pivot_row) if pivot in r else r for r in waiting]
        solved = {k: _eliminate(dict(r), pivot, pivot_row) if pivot in r else r for k, r in solved.items()}
        solved[pivot] = pivot_row
    return solved


def particular_solution(solved: Mapping[Hashable, Row], zero: Any) -> dict[Hashable, Any]:
    """The solution in which every free unknown is zero."""
    return {pivot: -row[CONSTANT] if CONSTANT in row else zero for pivot, row in solved.items()}


def determined(solved: Mapping[Hashable, Row], zero: Any) -> dict[Hashable, Any]:
    """The unknowns that have the same value in every solution."""
    return {
        pivot: -row[CONSTANT] if CONSTANT in row else zero
        for pivot, row in solved.items()
        if not (set(row) - {pivot, CONSTANT})
    }


def solve(matrix: list[list[Any]], right: list[Any], zero: Any) -> list[Any] | None:
    """A solution of ``matrix x = right`` over the field (free unknowns zero), or None if there is none."""
    rows: list[Row] = [{**dict(enumerate(row)), CONSTANT: -value} for row, value in zip(matrix, right, strict=True)]
    try:
        values = particular_solution(reduce_rows(rows), zero)
    except Inconsistent:
        return None
    return [values.get(k, zero) for k in range(len(matrix[0]))]
