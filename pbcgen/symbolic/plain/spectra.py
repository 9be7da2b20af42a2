"""Inverses and zeros in balls, motions of linear systems, and where the eigenvalues of a matrix of numbers lie."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from flint import acb, acb_mat, arb, arb_mat, fmpq

from pbcgen.symbolic.plain.matrices import Matrix, blocks, diagonal, dot, is_definite, plus, product, transpose
from pbcgen.symbolic.plain.values import Dual, partial, plain, sign, variables

#: Functions of several variables, for any kind of values.
Map = Callable[[Sequence[Any]], Sequence[Any]]


def inverse(a: Matrix) -> Matrix:
    """The inverse in balls, with slopes if there are. Raises ZeroDivisionError if there may be none."""
    value, slopes = _apart(a)
    found = value.inv()
    return _together(found, {k: -(found * s * found) for k, s in slopes.items()})


def _apart(a: Matrix) -> tuple[arb_mat, dict[int, arb_mat]]:
    """A matrix of duals as matrices: the values, and the slopes by variable."""
    keys = {k for row in a for v in row if isinstance(v, Dual) for k in v.slope}
    slopes = {k: arb_mat([[plain(partial(v, k)) for v in row] for row in a]) for k in sorted(keys)}
    return arb_mat([[plain(v) for v in row] for row in a]), slopes


def _together(value: arb_mat, slopes: dict[int, arb_mat]) -> Matrix:
    if not slopes:
        return [[*row] for row in value.tolist()]
    places = [[(i, j) for j in range(value.ncols())] for i in range(value.nrows())]
    return [[Dual(value[at], {k: s[at] for k, s in slopes.items()}) for at in row] for row in places]


def preconditioned(function: Map, centre: Sequence[Any], box: Sequence[Any]) -> tuple[Matrix, Matrix]:
    """Y near the inverse of ``F'(centre)``, and ``I - Y F'(box)``. Raises ZeroDivisionError."""
    size, near, over = range(len(box)), function(variables(centre)), function(variables(box))
    Y = [[arb(v).mid() for v in row] for row in inverse([[partial(f, k) for k in size] for f in near])]
    return Y, plus(diagonal([arb(1)] * len(box)), product(Y, [[partial(f, k) for k in size] for f in over]), -1)


def krawczyk(function: Map, centre: Sequence[fmpq], radius: fmpq) -> list[arb] | None:
    """Balls that hold the one zero in the box of half-width ``radius (1 + abs(centre))``, or None if the test fails.

    ``m - Y F(m) + (I - Y F'(box)) (box - m)`` must lie in the interior of the box (Krawczyk 1969).
    """
    box = [c + arb(0, arb(radius * (1 + abs(c)))) for c in centre]
    Y, defect = preconditioned(function, centre, box)
    offsets = [[b - c] for b, c in zip(box, centre, strict=True)]
    image = plus(product(defect, offsets), product(Y, [[v] for v in function(centre)]), -1)
    found = [c + row[0] for c, row in zip(centre, image, strict=True)]
    return found if all(b.contains_interior(k) for b, k in zip(box, found, strict=True)) else None


def zero_order_hold(A: Matrix, B: Matrix, h: Any) -> tuple[Matrix, Matrix]:
    """``x' = A x + B u`` with u constant over h: (e^{Ah}, int_0^h e^{As} ds B), blocks of ``exp([[A, B], [0, 0]] h)``.

    A time in a ball is its middle t, after which fast modes are gone, and what is left, s: with X this matrix,
    ``exp(X (t + s)) = exp(X t) + X exp(X t) s Y``, where Y is a mean of ``exp(X r)`` with r from 0 to s.
    """
    n, time = len(A), plain(h)
    X = [[*a, *b] for a, b in zip(A, B, strict=True)] + [[fmpq(0)] * (n + len(B[0]))] * len(B[0])
    middle = arb(time).mid() if isinstance(time, arb) else time
    held = _exponential(X, middle)
    if isinstance(h, arb | Dual):
        mean, rate = _exponential(X, time - middle), product(X, held)
        held, rate = (plus(part, product(X, part, mean), time - middle) for part in (held, rate))
        held = plus(held, rate, Dual(fmpq(0), h.slope)) if isinstance(h, Dual) else held
    return [row[:n] for row in held[:n]], [row[n:] for row in held[:n]]


def _exponential(a: Matrix, h: Any) -> Matrix:
    value, slopes = _apart([[v * h for v in row] for row in a])
    return _together(value.exp(), {k: _slope_of_exp(value, s) for k, s in slopes.items()})


def _slope_of_exp(a: arb_mat, slope: arb_mat) -> arb_mat:
    """The derivative of the exponential: a block of that of ``[[a, slope], [0, a]]``."""
    size, zero = a.nrows(), arb_mat(a.nrows(), a.nrows()).tolist()
    whole = arb_mat(blocks([[a.tolist(), slope.tolist()], [zero, a.tolist()]])).exp().tolist()
    return arb_mat([row[size:] for row in whole[:size]])


def all_stable(family: Sequence[tuple[Matrix, Matrix, Sequence[fmpq]]], discrete: bool) -> bool:
    """Whether all products of matrices of a family decay, or if it is not discrete the motion of each.

    A member (centre, over, widths) is all ``centre + sum_k t_k S_k`` with ``abs(t_k) <= widths[k]``, S_k the slopes in
    ``over``. In the eigenvectors of the first centre, with positive weights common to all: by the discs about the
    entries on the diagonal. Where some eigenvalues nearly meet, their eigenvectors nearly do: then an orthogonal basis
    of their span serves too.
    """
    members = [(acb_mat(arb_mat(centre)), _apart(over)[1], widths) for centre, over, widths in family]
    for apart in (fmpq(0), fmpq(1, 3)):
        V = _eigenvectors(arb_mat(family[0][0]), apart)
        back, modal = V.inv(), []  # type: acb_mat, list[acb_mat]
        for centre, slopes, widths in members:
            moves = (back * acb_mat(s) * V * acb(arb(0, arb(widths[k]))) for k, s in slopes.items())
            modal.append(sum(moves, back * centre * V))
        if _in_discs(modal, discrete):
            return True
    return False


def _eigenvectors(a: arb_mat, apart: fmpq) -> acb_mat:
    """Columns near the eigenvectors; orthogonal where eigenvalues are nearer than this share of the larger one.

    Lengths are measured with every coordinate relative to its largest entry.
    """
    values, V = acb_mat(a.mid()).eig(right=True, algorithm="approx")
    columns = [[v.mid() for v in column] for column in V.transpose().tolist()]
    sizes = [max(abs(v).mid() for v in row) ** 2 for row in zip(*columns, strict=True)]
    group = [*range(len(columns))]
    for j, b in enumerate(values):
        linked = {group[i] for i, a in enumerate(values[:j]) if abs(a - b) < max(abs(a).mid(), abs(b).mid()) * apart}
        group = [j if g in linked else g for g in group]
    for j, column in enumerate(columns):
        for i, other in enumerate(columns[:j]):
            if group[i] == group[j]:
                turned = [v.conjugate() / s for v, s in zip(other, sizes, strict=True)]
                share = dot(turned, column) / dot(turned, other)
                column[:] = [(v - w * share).mid() for v, w in zip(column, other, strict=True)]
        length = max(abs(v).mid() ** 2 / s for v, s in zip(column, sizes, strict=True)).sqrt().mid()
        column[:] = [(v / length).mid() for v in column]
    return acb_mat(transpose(columns))


def _in_discs(family: Sequence[acb_mat], discrete: bool) -> bool:
    """Whether with common weights all discs about entries on the diagonal are in the unit disc, or left half-plane."""
    size, shares = range(family[0].nrows()), []
    for modal in family:
        margins = [1 - abs(modal[i, i]) if discrete else -modal[i, i].real for i in size]
        if not all(m > 0 for m in margins):
            return False
        shares.append([[abs(modal[i, j]) / margins[i] * int(i != j) for j in size] for i in size])
    worst = [[max(rows[i][j].abs_upper() for rows in shares) for j in size] for i in size]
    weights = [
        d.mid()
        for (d,) in arb_mat(plus(diagonal([arb(1)] * len(size)), worst, -1)).solve(arb_mat([[1]] * len(size))).tolist()
    ]
    return all(d > 0 and dot(row, weights) < d for rows in shares for d, row in zip(weights, rows, strict=True))


def stable(a: Matrix, discrete: bool, storage: Matrix | None = None) -> bool | None:
    """Whether all eigenvalues lie in the open left half-plane (unit disc); False when one is certainly beyond.

    Given a symmetric storage P that decreases, ``-(A^T P + P A) > 0`` (or ``P - A^T P A > 0``), no eigenvalue is on the
    boundary, and all are inside if and only if ``P > 0``; nothing else is tried.
    """
    matrix, size = arb_mat(a), len(a)
    if storage is not None:
        P = arb_mat(storage)
        fall = P - matrix.transpose() * P * matrix if discrete else -(matrix.transpose() * P + P * matrix)
        return is_definite(P.tolist()) if is_definite(fall.tolist()) else None
    if discrete:  # (z - 1) / (z + 1) maps the disc to the left half-plane
        one = arb_mat(diagonal([fmpq(1)] * size))
        matrix = (matrix - one) * (matrix + one).inv()
    polynomial = matrix.charpoly()
    signs = _routh([polynomial[k] for k in range(size, -1, -1)])
    if not {None, 0} & {*signs}:
        return len({*signs}) == 1
    return False if any(z.real > 0 for z in acb_mat(matrix).eig(multiple=True, nonstop=True)) else None


def _routh(descending: list[arb]) -> list[int | None]:
    """Signs of the first column of the Routh array; all are equal and nonzero iff every root has Re < 0."""
    upper, lower = descending[0::2], descending[1::2]
    column = [upper[0]]
    while lower:
        column.append(lower[0])
        padded = lower + [arb(0)] * (len(upper) - len(lower))
        upper, lower = lower, [a - upper[0] / lower[0] * b for a, b in zip(upper[1:], padded[1:], strict=True)]
    return [sign(entry) for entry in column]
