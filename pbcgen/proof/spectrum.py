"""Hurwitz and Schur stability of matrices of exact numbers or balls.

Up to a size the characteristic polynomial is computed exactly (or in balls) and decided by the Routh array; beyond, or
where that does not decide, a Lyapunov matrix is verified in balls. Nothing depends on floating-point eigenvalues; those
are computed for display only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from flint import acb, acb_mat, ctx, fmpq, fmpq_mat
from numpy.typing import NDArray

from pbcgen.proof.claim import Status
from pbcgen.proof.lyapunov import Kind, LyapunovProof, lyapunov
from pbcgen.symbolic.real import (
    ZERO,
    Real,
    ball,
    in_high_precision,
    is_finite,
    midpoint,
    near_eigenvalues,
    precision,
    rational,
    sign,
)
from pbcgen.symbolic.real_matrices import RealMatrix, as_balls, as_floats

#: Matrices up to this size are decided by the Routh array first, larger ones by a Lyapunov matrix.
_LARGEST_ROUTH = 20
#: Beyond this size the Routh array is not tried at all.
_LARGEST_CHARACTERISTIC = 50
#: Sizes up to which eigenvalues for display are computed with the working precision, and with fewer bits.
_PRECISE, _LESS_PRECISE, _DISPLAY_BITS = 12, 24, 128


@dataclass(frozen=True)
class Stability:
    """The verdict on a matrix being Hurwitz (all Re < 0) or Schur (all abs < 1).

    Attributes:
        status: PROVED, REFUTED (some eigenvalue is certainly beyond the boundary), or UNDECIDED.
        extreme: the largest real part (Hurwitz) or modulus (Schur), rounded, for display.
        routh: the first column of the Routh array, the certificate of PROVED; empty if a Lyapunov matrix decided.
        lyapunov: that matrix.
    """

    status: Status
    extreme: float
    routh: tuple[Real, ...]
    lyapunov: LyapunovProof | None = None


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
    """Eigenvalues for display: with the working precision, fewer bits for larger matrices, doubles for large ones."""
    if not matrix:
        return []
    if len(matrix) > _LESS_PRECISE:
        return eigenvalues_in_doubles(as_floats(matrix))
    with precision(ctx.prec if len(matrix) <= _PRECISE else _DISPLAY_BITS):
        middle = acb_mat([[ball(rational(midpoint(entry))) for entry in row] for row in matrix])
        values = near_eigenvalues(middle)
    return sorted((complex(float(midpoint(v.real)), float(midpoint(v.imag))) for v in values), key=lambda z: -z.real)


def eigenvalues_in_doubles(matrix: NDArray[np.float64]) -> list[complex]:
    """Eigenvalues of the balanced matrix in double precision, the rightmost first. Raises ValueError on overflow."""
    from scipy.linalg import matrix_balance

    balanced, _ = matrix_balance(matrix)
    return sorted((complex(z) for z in np.linalg.eigvals(balanced)), key=lambda z: -z.real)


def _decide(matrix: RealMatrix, kind: Kind, extreme: float, outside: Callable[[acb], bool]) -> Stability:
    """The Routh array and the Lyapunov matrix, in the order of their cost for this size.

    A leading coefficient without a certain sign (the Moebius image of an eigenvalue -1) decides nothing.
    """
    size = len(matrix)
    if size > _LARGEST_ROUTH:
        proof = lyapunov(matrix, kind)
        if proof.status is not Status.UNDECIDED:
            return Stability(proof.status, extreme, (), proof)
    if size <= _LARGEST_CHARACTERISTIC:
        column = routh_column(_routh_polynomial(matrix, kind))
        if column is not None and sign(column[0]) in (1, -1):
            same = len({sign(entry) for entry in column}) == 1
            return Stability(Status.PROVED if same else Status.REFUTED, extreme, tuple(column))
    if size <= _LARGEST_ROUTH:
        proof = lyapunov(matrix, kind)
        if proof.status is not Status.UNDECIDED:
            return Stability(proof.status, extreme, (), proof)
        if _certified(matrix, outside):
            return Stability(Status.REFUTED, extreme, ())
    return Stability(Status.UNDECIDED, extreme, ())


def _routh_polynomial(matrix: RealMatrix, kind: Kind) -> list[Real]:
    """A polynomial with all zeros in the left half-plane iff the matrix is Hurwitz or Schur.

    For Schur the substitution z = (1 + w)/(1 - w) maps the unit disc to the left half-plane.
    """
    coefficients = characteristic_polynomial(matrix)
    if kind == "hurwitz":
        return coefficients
    size = len(matrix)
    mapped: list[Real] = [ZERO] * (size + 1)
    for power, coefficient in enumerate(coefficients):
        for k, weight in enumerate(_moebius_term(power, size)):
            mapped[k] = mapped[k] + coefficient * weight
    return mapped


@in_high_precision
def hurwitz(matrix: RealMatrix) -> Stability:
    """Whether every eigenvalue has a negative real part; REFUTED when one is certainly positive."""
    if not all(is_finite(entry) for row in matrix for entry in row):
        return Stability(Status.UNDECIDED, float("nan"), ())
    extreme = max((z.real for z in approximate_eigenvalues(matrix)), default=float("-inf"))
    return _decide(matrix, "hurwitz", extreme, lambda z: z.real > 0)


@in_high_precision
def schur(matrix: RealMatrix) -> Stability:
    """Whether every eigenvalue has modulus below one; REFUTED when one is certainly above."""
    if not all(is_finite(entry) for row in matrix for entry in row):
        return Stability(Status.UNDECIDED, float("nan"), ())
    extreme = max((abs(z) for z in approximate_eigenvalues(matrix)), default=0.0)
    return _decide(matrix, "schur", extreme, lambda z: abs(z) > 1)


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
