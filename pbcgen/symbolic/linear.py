"""Linear equations over any exact field: rationals or rational functions.

An equation is a sparse row ``{unknown: coefficient, CONSTANT: c}`` that stands for ``sum coefficient*unknown + c = 0``.
"""

from __future__ import annotations

from collections.abc import Container, Hashable, Iterable, Mapping
from heapq import heapify, heappop, heappush
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


def _without_zeros(row: Mapping[Any, Any]) -> Row:
    return {key: value for key, value in row.items() if not is_zero(value)}


def _cost(value: Any) -> int:
    """How unwieldy a pivot is: numbers before polynomials before fractions."""
    if isinstance(value, Quotient):
        return len(value.numerator) + 2 * len(value.denominator)
    return int(value.p.height_bits() + value.q.height_bits()) if isinstance(value, fmpq) else 1


class _Rows:
    """Sparse rows by number, with an index from each unknown to the rows that hold it."""

    def __init__(self, rows: Iterable[Mapping[Any, Any]]) -> None:
        self.rows: dict[int, Row] = {}
        self.holders: dict[Hashable, set[int]] = {}
        for number, row in enumerate(rows):
            self.put(number, _without_zeros(row))

    def put(self, number: int, row: Row) -> None:
        self.rows[number] = row
        for key in row:
            self.holders.setdefault(key, set()).add(number)

    def take(self, number: int) -> Row:
        row = self.rows.pop(number)
        for key in row:
            self.holders[key].discard(number)
        return row

    def eliminate(self, unknown: Hashable, pivot_row: Row) -> list[int]:
        """Free every row of the unknown; the numbers of the rows that changed."""
        changed = sorted(self.holders.get(unknown, ()))
        for number in changed:
            row = self.take(number)
            factor = row.pop(unknown)
            for key, value in pivot_row.items():
                if key == unknown:
                    continue
                entry = row[key] - factor * value if key in row else -(factor * value)
                if is_zero(entry):
                    row.pop(key, None)
                else:
                    row[key] = entry
            self.put(number, row)
        return changed


def reduce_rows(rows: Iterable[Mapping[Any, Any]], known: Container[Hashable] = frozenset()) -> dict[Hashable, Row]:
    """Reduced row echelon form, shortest rows first.

    Args:
        rows: the equations.
        known: keys that are no unknowns but, like the constant term, parts of the right-hand side.

    Returns:
        For each pivot unknown its row with pivot coefficient one, free of the other pivots: the unknown equals minus
        the rest of the row.

    Raises:
        Inconsistent: when there is no solution.
    """
    waiting, solved = _Rows(rows), _Rows(())
    pivots: dict[int, Hashable] = {}
    queue = [(len(row), -number) for number, row in waiting.rows.items()]
    heapify(queue)
    while queue:
        length, minus = heappop(queue)
        if -minus not in waiting.rows or len(waiting.rows[-minus]) != length:
            continue
        row = waiting.take(-minus)
        unknowns = [key for key in row if key != CONSTANT and key not in known]
        if not unknowns:
            if row:
                raise Inconsistent(next(iter(row.values())))
            continue
        pivot = min(unknowns, key=lambda key: (_cost(row[key]), str(key)))
        scale = row[pivot]
        pivot_row = {key: value / scale for key, value in row.items()}
        for number in waiting.eliminate(pivot, pivot_row):
            heappush(queue, (len(waiting.rows[number]), -number))
        solved.eliminate(pivot, pivot_row)
        solved.put(-minus, pivot_row)
        pivots[-minus] = pivot
    return {pivot: solved.rows[number] for number, pivot in pivots.items()}


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


def sparse_kernel(rows: Iterable[Mapping[Any, Any]], size: int, one: Any) -> list[dict[int, Any]]:
    """A basis of the vectors of ``size`` unknowns, called 0, 1, ..., on which all rows vanish: the nonzero entries."""
    solved = reduce_rows(rows)
    basis: dict[Hashable, dict[int, Any]] = {free: {free: one} for free in range(size) if free not in solved}
    for pivot in range(size):
        for free, value in solved.get(pivot, {}).items():
            if free in basis:
                basis[free][pivot] = -value
    return list(basis.values())


def kernel(rows: Iterable[Mapping[Any, Any]], size: int, zero: Any, one: Any) -> list[list[Any]]:
    """:func:`sparse_kernel` with all entries."""
    return [[vector.get(k, zero) for k in range(size)] for vector in sparse_kernel(rows, size, one)]


def solve(rows: Iterable[Mapping[Any, Any]], right: Iterable[Any], size: int, zero: Any) -> list[Any] | None:
    """A solution of ``rows x = right`` over the field, x of this size and free unknowns zero; None if there is none."""
    equations: list[Row] = [{**row, CONSTANT: -value} for row, value in zip(rows, right, strict=True)]
    try:
        values = particular_solution(reduce_rows(equations), zero)
    except Inconsistent:
        return None
    return [values.get(k, zero) for k in range(size)]
