"""The matrices of a filter's implicit step: exact, or formulas where a diagonal gain may change at run time."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from flint import fmpq, fmpq_mat

from pbcgen.errors import EmitError
from pbcgen.law.settings import GainMatrix, times
from pbcgen.models.gains import Matrix, diagonal
from pbcgen.symbolic.real import fraction, rational


@dataclass(frozen=True, eq=False)
class Implicit:
    """Backward Euler for ``x' = -R (K x + v)``: ``growth x+ = x - h R v``.

    Attributes:
        growth: I + h R K.
        decay: its inverse E.
        push: E h R.
    """

    growth: GainMatrix
    decay: GainMatrix
    push: GainMatrix

    @staticmethod
    def of(R: GainMatrix, K: GainMatrix, h: Fraction) -> Implicit:
        """The step with sample period h. Gains that are symbols stand in diagonal matrices, and K beside them too.

        Raises EmitError where it has no solution, which gains that are not positive definite can bring about.
        """
        exact_R, exact_K = _numbers(R), _numbers(K)
        if exact_R is not None and exact_K is not None:
            identity = _flint(diagonal([Fraction(1)] * len(R)))
            growth = identity + _flint(exact_R) * _flint(exact_K) * rational(h)
            try:
                decay = growth.inv()
            except ZeroDivisionError:
                raise EmitError(
                    f"I + h R K of a filter is singular at h = {float(h):g} s: its gains must be positive definite"
                ) from None
            return Implicit(_fractions(growth), _fractions(decay), _fractions(decay * _flint(exact_R) * rational(h)))
        entries = range(len(R))
        sums = [1 + times(h, R[i][i], K[i][i]) for i in entries]
        decays = [1 / v for v in sums]
        pushes = [times(h, R[i][i], decays[i]) for i in entries]
        return Implicit(diagonal(sums), diagonal(decays), diagonal(pushes))


def exact_inverse(rows: Matrix) -> Matrix:
    """The inverse of a regular matrix of fractions."""
    return _fractions(_flint(rows).inv())


def _numbers(rows: GainMatrix) -> Matrix | None:
    """The matrix, if all its entries are numbers."""
    found = tuple(tuple(v for v in row if isinstance(v, Fraction)) for row in rows)
    return found if all(len(a) == len(b) for a, b in zip(found, rows, strict=True)) else None


def _flint(rows: Matrix) -> fmpq_mat:
    return fmpq_mat([[rational(v) for v in row] for row in rows])


def _fractions(matrix: fmpq_mat) -> Matrix:
    return tuple(tuple(fraction(fmpq(v)) for v in row) for row in matrix.tolist())
