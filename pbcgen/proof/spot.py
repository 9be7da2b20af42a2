"""Values of exact functions at sample points, in doubles: a quick no before a long search for a proof.

A function that is clearly negative at a point has no proof of being nonnegative. This never says yes.
"""

from __future__ import annotations

from collections.abc import Callable
from math import erf

import numpy as np
from flint import fmpq_mpoly
from numpy.typing import NDArray

from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import approximate

_POINTS = 24
_SCALES = (0.3, 1.0, 4.0)
#: What rounding may make of a sum of terms, relative to the sum of their magnitudes.
_ROUNDING = 1e-9

_FUNCTIONS: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "sin": np.sin,
    "cos": np.cos,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "fabs": np.abs,
    "tanh": np.tanh,
    "atan": np.arctan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "erf": np.vectorize(erf, otypes=[float]),
}


class Spots:
    """The generators of a field at a few points; ``positive_symbols`` have positive values there."""

    def __init__(self, field: Field, positive_symbols: frozenset[int] = frozenset()) -> None:
        generator = np.random.default_rng(5)
        scales = np.resize(_SCALES, _POINTS)
        self._columns: list[NDArray[np.float64]] = []
        for k in range(field.symbol_count + field.pool):
            column = generator.standard_normal(_POINTS) * scales
            self._columns.append(np.abs(column) if k in positive_symbols else column)
        with np.errstate(all="ignore"):
            for k, atom in sorted(field.atoms.items()):
                argument = self._values(atom.argument.numerator)[0] / self._values(atom.argument.denominator)[0]
                self._columns[k] = _FUNCTIONS[atom.kind](argument)

    def shows_negative(self, polynomial: fmpq_mpoly) -> bool:
        """Whether the polynomial in the generators is negative at one of the points, beyond rounding."""
        with np.errstate(all="ignore"):
            total, size = self._values(polynomial)
            return bool(np.any(np.isfinite(size) & (total < -_ROUNDING * size)))

    def least(self, function: Quotient) -> float:
        """The least value of a function at the points where it is finite; infinite if there is none."""
        with np.errstate(all="ignore"):
            values = self._values(function.numerator)[0] / self._values(function.denominator)[0]
        return float(np.min(values, initial=np.inf, where=np.isfinite(values)))

    def _values(self, polynomial: fmpq_mpoly) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The values, and the sums of the magnitudes of the terms."""
        total, size = np.zeros(_POINTS), np.zeros(_POINTS)
        for exponents, coefficient in polynomial.to_dict().items():
            term = np.full(_POINTS, approximate(coefficient))
            for k, exponent in enumerate(exponents):
                if exponent:
                    term = term * self._columns[k] ** int(exponent)
            total, size = total + term, size + np.abs(term)
        return total, size
