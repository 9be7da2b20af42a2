"""Mechanical systems in positions and velocities: with ``p = M(q) v`` no inverse of M is written out."""

from __future__ import annotations

from collections.abc import Sequence

from pbcgen.symbolic.plain.formulas import Formulas
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, dot, product, transpose
from pbcgen.symbolic.plain.values import Field, Function, Grow, NotCheckable

#: The place of each entry of M among the instructions, None for a zero.
Places = Sequence[Sequence[int | None]]


def solves(formulas: Formulas, M: Places, velocity: Sequence[int]) -> bool | None:
    """Whether the instructions ``velocity`` are defined wherever M > 0; None if they are not shown to be M^-1 p.

    M is symmetric, though the two instructions of an entry may differ.

    With p = M v they must give v, whatever the entries of M are. M is put in as L D L^T with symbols in L and D, where
    its zeros and equal entries allow that: then a division by entries of D is defined. Else each entry is a symbol.
    """
    half = len(M)
    for factored in (True, False):
        field = Field(2 * half + half * (half + 1) // 2, 1)
        values = _factored(field, M) if factored else _single(field, M)
        known = {place: a for row, own in zip(M, values, strict=True) for place, a in zip(row, own, strict=True)}
        known[None] = field.lift(0)
        pairs = [
            (known[place], a) for row, own in zip(M, values, strict=True) for place, a in zip(row, own, strict=True)
        ]
        if any((a - b).top for a, b in pairs):
            continue  # entries are equal or zero that would not be
        v = field.symbols[:half]
        p = [field.lift(dot(row, v)) for row in values]
        given = {place: a for place, a in known.items() if place is not None}
        try:
            found = formulas.walk(field.lift, {"state": [None] * half + p}, given, velocity)
        except (Grow, NotCheckable, TypeError):  # other functions, or a position beside M
            return None
        if any((found[k] - a).top for k, a in zip(velocity, v, strict=True)):
            return None
        pivots = {field.pool + half + k for k in range(half)}
        used = [k for d in field.divisors.values() for k, degree in enumerate(d.degrees()) if degree]
        return factored and all(len(d) == 1 for d in field.divisors.values()) and pivots >= {*used}
    return None


def _single(field: Field, M: Places) -> Matrix:
    """A symbol for each entry beside or below the diagonal, the same for those with the same place."""
    own = iter(field.symbols[len(M) :])
    known: dict[int | None, Function] = {None: field.lift(0)}
    for i, row in enumerate(M):
        for j in range(i + 1):
            a = known.get(row[j], known.get(M[j][i])) or next(own)
            known |= {row[j]: a, M[j][i]: a}
    return [[known[place] for place in row] for row in M]


def _factored(field: Field, M: Places) -> Matrix:
    """L D L^T, L without what is zero in M; rows with nothing beside the diagonal share what is equal in M."""
    size, half = range(len(M)), len(M)
    alone = {M[k][k]: k for k in size if not any(M[k][j] is not None for j in size if j != k)}
    pivots = [field.symbols[half + alone.get(M[k][k], k)] for k in size]
    symbols = iter(field.symbols[2 * half :])
    L = [[next(symbols) if i > j and M[i][j] is not None else field.lift(int(i == j)) for j in size] for i in size]
    return product(L, diagonal(pivots), transpose(L))
