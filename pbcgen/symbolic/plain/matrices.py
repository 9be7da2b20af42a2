"""Matrices of numbers or functions as lists of rows, and where the eigenvalues of a matrix of numbers lie."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import comb
from typing import Any

from flint import acb_mat, arb, arb_mat, ctx, fmpq

from pbcgen.symbolic.plain.values import partial, sign, times, variables

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


def inverse(a: Matrix) -> Matrix:
    """The inverse in balls. Raises ZeroDivisionError if there may be none."""
    result: Matrix = arb_mat(a).inv().tolist()
    return result


def is_definite(a: Matrix, semi: bool = False) -> bool:
    """Whether a symmetric matrix is certainly positive (semi)definite: by elimination, every pivot is."""
    if not a:
        return True
    (pivot, *row), *rest = a
    if semi and all(sign(v) == 0 for v in (pivot, *row)):
        return is_definite([line[1:] for line in rest], semi)
    return sign(pivot) == 1 and is_definite(
        [[v - line[0] * h / pivot for v, h in zip(line[1:], row, strict=True)] for line in rest], semi
    )


def krawczyk(
    function: Callable[[Sequence[Any]], Sequence[Any]], centre: Sequence[fmpq], radius: fmpq
) -> list[arb] | None:
    """Balls that hold the one zero in the box of half-width ``radius (1 + abs(centre))``, or None if the test fails.

    ``m - Y F(m) + (I - Y F'(box)) (box - m)`` must lie in the interior of the box (Krawczyk 1969).
    """
    size, half = range(len(centre)), [[arb(0, arb(radius * (1 + abs(c))))] for c in centre]
    box = [c + h[0] for c, h in zip(centre, half, strict=True)]
    value, near, over = function(centre), function(variables(centre)), function(variables(box))
    Y = [[v.mid() for v in row] for row in inverse([[partial(f, k) for k in size] for f in near])]
    defect = plus(diagonal([arb(1)] * len(box)), product(Y, [[partial(f, k) for k in size] for f in over]), -1)
    image = plus(product(defect, half), product(Y, [[v] for v in value]), -1)
    found = [c + row[0] for c, row in zip(centre, image, strict=True)]
    return found if all(b.contains_interior(k) for b, k in zip(box, found, strict=True)) else None


def zero_order_hold(A: Matrix, B: Matrix, h: fmpq) -> tuple[Matrix, Matrix]:
    """``x' = A x + B u`` with u constant over h: (e^{Ah}, int_0^h e^{As} ds B)."""
    n, m = len(A), len(B[0])
    rows = [[v * h for v in (*a, *b)] for a, b in zip(A, B, strict=True)] + [[fmpq(0)] * (n + m)] * m
    bits = ctx.prec
    # The exponential loses bits in proportion to the norm; these pay for them.
    ctx.prec += min(4096, 3 * max(int(sum(abs(float(arb(v))) for v in row)) for row in rows))
    held = arb_mat(rows).exp().tolist()[:n]
    ctx.prec = bits
    return [row[:n] for row in held], [row[n:] for row in held]


def stable(a: Matrix, discrete: bool, storage: Matrix | None = None) -> bool | None:
    """Whether all eigenvalues lie in the open left half-plane (unit disc); False when one is certainly beyond.

    Given a symmetric storage P, this is True when ``P > 0`` and P decreases, ``-(A^T P + P A) > 0`` (or
    ``P - A^T P A > 0``), and nothing else is tried.
    """
    matrix, size = arb_mat(a), len(a)
    if storage is not None:
        P = arb_mat(storage)
        fall = P - matrix.transpose() * P * matrix if discrete else -(matrix.transpose() * P + P * matrix)
        return (is_definite(storage) and is_definite(fall.tolist())) or None
    polynomial = matrix.charpoly()
    coefficients = [polynomial[k] for k in range(size + 1)]
    if discrete:
        coefficients = product([coefficients], [_moebius(power, size) for power in range(size + 1)])[0]
    signs = _routh(coefficients[::-1])
    if not {None, 0} & {*signs}:
        return len({*signs}) == 1
    values = acb_mat(matrix).eig(multiple=True)
    return False if any((abs(z) > 1) if discrete else (z.real > 0) for z in values) else None


def _moebius(power: int, size: int) -> list[fmpq]:
    """Coefficients of ``(1 + w)^power (1 - w)^(size - power)``: z = (1 + w)/(1 - w) maps left half-plane to disc."""
    result = [fmpq(0)] * (size + 1)
    for i in range(power + 1):
        for j in range(size - power + 1):
            result[i + j] += comb(power, i) * comb(size - power, j) * (-1) ** j
    return result


def _routh(descending: list[arb]) -> list[int | None]:
    """Signs of the first column of the Routh array; all are equal and nonzero iff every root has Re < 0."""
    upper, lower = descending[0::2], descending[1::2]
    column = [upper[0]]
    while lower:
        column.append(lower[0])
        padded = lower + [arb(0)] * (len(upper) - len(lower))
        upper, lower = lower, [a - upper[0] / lower[0] * b for a, b in zip(upper[1:], padded[1:], strict=True)]
    return [sign(entry) for entry in column]
