"""Hurwitz and Schur stability of matrices of exact numbers or balls.

The characteristic polynomial is computed exactly (or in balls) and decided by the Routh array; nothing depends on
floating-point eigenvalues. Those are computed with the working precision for display only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import comb

from flint import acb, acb_mat, fmpq, fmpq_mat

from pbcgen.proof.claim import Status
from pbcgen.proof.definite import RealMatrix, as_balls
from pbcgen.symbolic.real import ZERO, Real, ball, in_high_precision, is_finite, midpoint, rational, sign


@dataclass(frozen=True)
class Stability:
    """The verdict on a matrix being Hurwitz (all Re < 0) or Schur (all abs < 1).

    Attributes:
        status: PROVED, REFUTED (some eigenvalue is certainly beyond the boundary), or UNDECIDED.
        extreme: the largest real part (Hurwitz) or modulus (Schur), rounded, for display.
        routh: the first column of the Routh array, the certificate of PROVED.
    """

    status: Status
    extreme: float
    routh: tuple[Real, ...]


def _is_exact(matrix: RealMatrix) -> bool:
    return all(isinstance(entry, fmpq) for row in matrix for entry in row)


def characteristic_polynomial(matrix: RealMatrix) -> list[Real]:
    """Coefficients of det(s I - A), constant term first."""
    if not matrix:
        return [fmpq(1)]
    if _is_exact(matrix):
        return [fmpq(c) for c in fmpq_mat(matrix).charpoly().coeffs()]
    polynomial = as_balls(matrix).charpoly()
    return [polynomial[k] for k in range(len(matrix) + 1)]


def routh_column(coefficients: Sequence[Real]) -> list[Real] | None:
    """The first column of the Routh array of a polynomial (constant term first), None if a pivot may be zero."""
    descending = list(reversed(coefficients))
    upper, lower = descending[0::2], descending[1::2]
    column: list[Real] = [upper[0]]
    while lower:
        if sign(lower[0]) in (None, 0):
            return None
        column.append(lower[0])
        factor = upper[0] / lower[0]
        padded = [*lower, *([ZERO] * (len(upper) - len(lower)))]
        following = [a - factor * b for a, b in zip(upper[1:], padded[1:], strict=True)]
        upper, lower = lower, following
    return column


@in_high_precision
def approximate_eigenvalues(matrix: RealMatrix) -> list[complex]:
    """Eigenvalues for display, computed with the working precision and rounded."""
    if not matrix:
        return []
    middle = acb_mat([[ball(rational(midpoint(entry))) for entry in row] for row in matrix])
    values = middle.eig(algorithm="approx")
    return sorted((complex(float(midpoint(v.real)), float(midpoint(v.imag))) for v in values), key=lambda z: -z.real)


def _decide(matrix: RealMatrix, coefficients: list[Real], extreme: float, beyond: bool) -> Stability:
    """Routh's criterion for ``coefficients``; ``beyond``: an eigenvalue was certified outside.

    A leading coefficient without a certain sign (the Moebius image of an eigenvalue -1) decides nothing.
    """
    column = routh_column(coefficients)
    if column is not None and sign(column[0]) in (1, -1):
        signs = {sign(entry) for entry in column}
        if len(signs) == 1:
            return Stability(Status.PROVED, extreme, tuple(column))
        return Stability(Status.REFUTED, extreme, tuple(column))
    return Stability(Status.REFUTED if beyond else Status.UNDECIDED, extreme, ())


@in_high_precision
def hurwitz(matrix: RealMatrix) -> Stability:
    """Whether every eigenvalue has a negative real part; REFUTED when one is certainly positive."""
    if not all(is_finite(entry) for row in matrix for entry in row):
        return Stability(Status.UNDECIDED, float("nan"), ())
    extreme = max((z.real for z in approximate_eigenvalues(matrix)), default=float("-inf"))
    return _decide(matrix, characteristic_polynomial(matrix), extreme, _certified(matrix, lambda z: z.real > 0))


@in_high_precision
def schur(matrix: RealMatrix) -> Stability:
    """Whether every eigenvalue has modulus below one; REFUTED when one is certainly above.

    The substitution z = (1 + w)/(1 - w) maps the unit disc to the left half-plane.
    """
    if not all(is_finite(entry) for row in matrix for entry in row):
        return Stability(Status.UNDECIDED, float("nan"), ())
    extreme = max((abs(z) for z in approximate_eigenvalues(matrix)), default=0.0)
    size = len(matrix)
    mapped: list[Real] = [ZERO] * (size + 1)
    for power, coefficient in enumerate(characteristic_polynomial(matrix)):
        for k, weight in enumerate(_moebius_term(power, size)):
            mapped[k] = mapped[k] + coefficient * weight
    return _decide(matrix, mapped, extreme, _certified(matrix, lambda z: abs(z) > 1))


def _moebius_term(power: int, size: int) -> list[fmpq]:
    """Coefficients of (1 + w)^power (1 - w)^(size - power)."""
    result = [0] * (size + 1)
    for i in range(power + 1):
        for j in range(size - power + 1):
            result[i + j] += comb(power, i) * comb(size - power, j) * (-1) ** j
    return [fmpq(c) for c in result]


def _certified(matrix: RealMatrix, outside: Callable[[acb], bool]) -> bool:
    """Whether certified eigenvalue enclosures exist and one of them lies outside for sure."""
    if not matrix:
        return False
    try:
        enclosures = acb_mat(as_balls(matrix)).eig(multiple=True)
    except (ValueError, ZeroDivisionError):
        return False
    return any(outside(z) for z in enclosures)


def zero_order_hold(A: RealMatrix, B: RealMatrix, h: Real) -> tuple[RealMatrix, RealMatrix]:
    """Exact discretisation of x' = A x + B u with u constant over h: enclosures of (e^{Ah}, int_0^h e^{As} ds B)."""
    n, m = len(A), len(B[0])
    rows = [[entry * h for entry in (*A[i], *B[i])] for i in range(n)] + [[ZERO] * (n + m)] * m
    exponential = as_balls(rows).exp().tolist()
    return [row[:n] for row in exponential[:n]], [row[n:] for row in exponential[:n]]
