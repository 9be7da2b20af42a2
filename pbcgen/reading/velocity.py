"""Mechanical systems in positions and velocities: with ``p = M(q) v`` no inverse of M is written out."""

from __future__ import annotations

from collections.abc import Sequence

from pbcgen.symbolic.plain.formulas import Formulas
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, dot, product, transpose
from pbcgen.symbolic.plain.outcomes import NotCheckable
from pbcgen.symbolic.plain.values import Field, Grow

#: The place of each entry of M among the instructions, None for a zero.
Places = Sequence[Sequence[int | None]]


def solves(formulas: Formulas, M: Places, velocity: Sequence[int]) -> bool:
    """Whether the instructions ``velocity`` are shown to be M^-1 p, and to be defined wherever M > 0.

    M is symmetric, though the two instructions of an entry may differ. With p = M v they must give v, whatever the
    entries of M are. M is put in as L D L^T with symbols in L and D, where its zeros and equal entries allow that: then
    a division by entries of D is defined.
    """
    half = len(M)
    field = Field(2 * half + half * (half + 1) // 2, 1)
    values, v = _factored(field, M), field.symbols[:half]
    pairs = [both for row, own in zip(M, values, strict=True) for both in zip(row, own, strict=True)]
    known = dict(pairs) | {None: field.lift(0)}
    p = [field.lift(dot(row, v)) for row in values]
    given = {place: a for place, a in known.items() if place is not None}
    try:
        found = formulas.walk(field.lift, {"state": [None] * half + p}, given, velocity)
    except (Grow, NotCheckable, TypeError):  # other functions, or a position beside M
        return False
    pivots = {field.pool + half + k for k in range(half)}
    used = [k for d in field.divisors.values() for k, degree in enumerate(d.degrees()) if degree]
    return (
        not any((known[place] - a).top for place, a in pairs)  # no entries are equal or zero that would not be
        and not any((found[k] - a).top for k, a in zip(velocity, v, strict=True))
        and all(len(d) == 1 for d in field.divisors.values())
        and pivots >= {*used}
    )


def _factored(field: Field, M: Places) -> Matrix:
    """L D L^T, L without what is zero in M; rows with nothing beside the diagonal share what is equal in M."""
    size, half = range(len(M)), len(M)
    alone = {M[k][k]: k for k in size if not any(M[k][j] is not None for j in size if j != k)}
    pivots = [field.symbols[half + alone.get(M[k][k], k)] for k in size]
    symbols = iter(field.symbols[2 * half :])
    L = [[next(symbols) if i > j and M[i][j] is not None else field.lift(int(i == j)) for j in size] for i in size]
    return product(L, diagonal(pivots), transpose(L))
