"""Symmetric matrices of exact functions: semidefinite and definite by elimination, with pivots proved positive."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from heapq import heapify, heappop, heappush

from pbcgen.proof.extrema import Bounds, term_bounds
from pbcgen.proof.nonnegative import Everywhere, Prover, positive
from pbcgen.symbolic.field import Quotient, TooLarge

#: The rows of a matrix, each with all entries or with some, by column; the others are zero.
Rows = Sequence[Sequence[Quotient]] | Sequence[Mapping[int, Quotient]]

#: Conditions are not looked for beyond so many terms.
_MOST_TERMS = 100


def _as_rows(matrix: Rows) -> dict[int, dict[int, Quotient]]:
    """The nonzero entries by row and column."""
    rows = [row.items() if isinstance(row, Mapping) else enumerate(row) for row in matrix]
    return {i: {j: entry for j, entry in row if not entry.is_zero()} for i, row in enumerate(rows)}


class _Pivots:
    """Pivots that are proved positive: those that are numbers and have few neighbours first, which stays sparse."""

    def __init__(self, rows: Mapping[int, Mapping[int, Quotient]], prover: Prover) -> None:
        self.rows, self.prover = rows, prover
        self.heap: list[tuple[tuple[bool, int, int], int]] = []
        self.changed(rows)

    def _cost(self, k: int) -> tuple[bool, int, int]:
        entry = self.rows[k][k]
        return entry.constant() is None, len(self.rows[k]), len(entry.numerator)

    def changed(self, positions: Iterable[int]) -> None:
        """These rows are other ones now."""
        for k in positions:
            if k in self.rows.get(k, {}):
                heappush(self.heap, (self._cost(k), k))

    def take(self) -> int | None:
        """The next pivot, or None; a row whose pivot is not proved is not offered again until it has changed."""
        while self.heap:
            cost, k = heappop(self.heap)
            if k in self.rows.get(k, {}) and self._cost(k) == cost and self.prover.positive(self.rows[k][k]):
                return k
        return None


def _eliminate(rows: dict[int, dict[int, Quotient]], pivot: int) -> list[int]:
    """One step of symmetric elimination; row and column ``pivot`` are removed. The rows that changed are returned."""
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
    return list(row)


def semidefinite(
    matrix: Rows,
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
    pivots = _Pivots(rows, prover)
    changed: Iterable[int] = list(rows)
    while rows:
        for k in changed:
            if not rows[k]:
                del rows[k]
            elif k not in rows[k]:
                return False
            elif len(rows[k]) == 1:
                if not prover.nonnegative(rows[k][k]):
                    return False
                del rows[k]
        if not rows:
            return True
        pivot = pivots.take()
        if pivot is None:
            return False
        changed = _eliminate(rows, pivot)
        pivots.changed(changed)
    return True


def definite(
    matrix: Rows,
    positive_symbols: frozenset[int] = frozenset(),
    prover: Prover | None = None,
) -> bool:
    """Whether the symmetric matrix of functions is proved positive definite wherever it is defined."""
    prover = prover or Everywhere(positive_symbols)
    try:
        return _definite(_as_rows(matrix), prover)
    except TooLarge:
        return False


def _dominant(rows: Mapping[int, Mapping[int, Quotient]]) -> bool:
    """Whether every diagonal entry exceeds the others of its row together, by bounds of their terms (Gershgorin)."""
    for i, row in rows.items():
        left = term_bounds(row[i], {}).lo if i in row else None
        for j, entry in row.items():
            if left is None or left <= 0:
                return False
            bounds = term_bounds(entry, {}) if j != i else Bounds(Fraction(0), Fraction(0))
            left = None if bounds.lo is None or bounds.hi is None else left - max(bounds.hi, -bounds.lo)
        if left is None or left <= 0:
            return False
    return True


def _definite(rows: dict[int, dict[int, Quotient]], prover: Prover) -> bool:
    if _dominant(rows):
        return True
    pivots = _Pivots(rows, prover)
    while rows:
        pivot = pivots.take()
        if pivot is None:
            return False
        pivots.changed(_eliminate(rows, pivot))
    return True


def is_regular(matrix: Rows) -> bool:
    """Whether a square matrix of functions has an inverse everywhere: by pivots that are proved to vanish nowhere.

    Rows with few entries are taken first, and in them columns with few, which stays sparse.
    """
    rows = _as_rows(matrix)
    columns: dict[int, set[int]] = {}
    for i, row in rows.items():
        for j in row:
            columns.setdefault(j, set()).add(i)
    heap = [(len(row), i) for i, row in rows.items()]
    heapify(heap)
    while heap:
        size, i = heappop(heap)
        if i not in rows or size != len(rows[i]):
            continue
        row = rows[i]
        usable = (j for j, entry in row.items() if has_one_sign(entry))
        pivot = min(usable, key=lambda j: (row[j].constant() is None, len(columns[j])), default=None)
        if pivot is None:
            continue
        del rows[i]
        for j in row:
            columns[j].discard(i)
        for k in columns.pop(pivot):
            factor = rows[k].pop(pivot) / row[pivot]
            for j, entry in row.items():
                if j == pivot:
                    continue
                value = rows[k][j] - factor * entry if j in rows[k] else -factor * entry
                if value.is_zero():
                    rows[k].pop(j, None)
                    columns[j].discard(k)
                else:
                    rows[k][j] = value
                    columns[j].add(k)
            heappush(heap, (len(rows[k]), k))
    return not rows


def has_one_sign(function: Quotient) -> bool:
    """Whether a function is proved to be positive everywhere, or negative everywhere."""
    return positive(function) or positive(-function)


def positivity_conditions(matrix: Sequence[Sequence[Quotient]], prover: Prover | None = None) -> list[Quotient]:
    """Functions that are all positive just where the symmetric matrix is positive definite: none if that is proved.

    Pivots that are proved positive are taken first; those that are left are the conditions (Sylvester). One that is
    the zero function says that the matrix is nowhere definite. Raises TooLarge for what nobody could read.
    """
    prover = prover or Everywhere()
    rows = _as_rows(matrix)
    pivots = _Pivots(rows, prover)
    zero = matrix[0][0].field.const(0)
    left = []
    while rows:
        if any(len(row[k].numerator) > _MOST_TERMS for k, row in rows.items() if k in row):
            raise TooLarge("the conditions for the matrix to be definite grow too long")
        sure = pivots.take()
        pivot = next(iter(rows)) if sure is None else sure
        head = rows[pivot].get(pivot, zero)
        if sure is None:
            left.append(head)
        if head.is_zero():
            break
        pivots.changed(_eliminate(rows, pivot))
    return left
