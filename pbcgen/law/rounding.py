"""Exact rationals in the arithmetic of the generated code.

The one place where a rational becomes a machine number: the C printer and the reference step both call it, so both
compute with the same constants.
"""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING, Final

import numpy as np

from pbcgen.errors import EmitError

if TYPE_CHECKING:
    from pbcgen.law.arithmetic import Precision

#: The NumPy type of each precision.
DTYPES: Final[dict[Precision, type[np.float32] | type[np.float64]]] = {"float": np.float32, "double": np.float64}

#: A controller state beyond this magnitude is treated as corrupted. It is far from overflow, so that the products of
#: a valid state with ordinary gains stay finite, and far above any state that a bounded law can reach.
STATE_LIMIT: Final[dict[Precision, Fraction]] = {"float": Fraction(2**63), "double": Fraction(2**511)}

Real = np.float32 | np.float64


def nearest(value: Fraction, precision: Precision, what: str = "the constant") -> Real:
    """The number of ``precision`` nearest to ``value``, ties to even.

    Raises EmitError, naming ``what``, if the value overflows, or is nonzero and becomes zero or denormal.
    """
    dtype = DTYPES[precision]
    limits = np.finfo(dtype)
    # One rounding more could be an overflow to infinity; Fraction comparisons are exact.
    if abs(value) > Fraction(float(limits.max)):
        raise EmitError(f"{what} {_decimal(value)} does not fit a {precision}: choose double precision or other units")
    if value != 0 and abs(value) < Fraction(float(limits.tiny)):
        raise EmitError(f"{what} {_decimal(value)} vanishes as a {precision}: choose double precision or other units")
    guess = dtype(float(value))
    with np.errstate(over="ignore"):
        around = (np.nextafter(guess, dtype(-np.inf)), guess, np.nextafter(guess, dtype(np.inf)))
    finite = [candidate for candidate in around if np.isfinite(candidate)]
    best = min(abs(Fraction(float(candidate)) - value) for candidate in finite)
    ties = [candidate for candidate in finite if abs(Fraction(float(candidate)) - value) == best]
    return ties[0] if len(ties) == 1 else next(c for c in ties if _is_even(c))


def inward(interval: tuple[Fraction, Fraction], precision: Precision, what: str) -> tuple[Real, Real]:
    """The largest interval with bounds of ``precision`` inside the exact ``interval``.

    Raises EmitError, naming ``what``, if there is none.
    """
    lo, hi = interval
    dtype = DTYPES[precision]
    low, high = nearest(lo, precision, what), nearest(hi, precision, what)
    if Fraction(float(low)) < lo:
        low = np.nextafter(low, dtype(np.inf))
    if Fraction(float(high)) > hi:
        high = np.nextafter(high, dtype(-np.inf))
    if low > high:
        raise EmitError(f"{what} [{_decimal(lo)}, {_decimal(hi)}] contains no {precision}: widen it")
    return low, high


def _is_even(value: Real) -> bool:
    """Whether the last bit of the significand is zero."""
    return int(np.asarray(value).view(np.uint32 if value.dtype == np.float32 else np.uint64)) % 2 == 0


def _decimal(value: Fraction) -> str:
    """A readable approximation, for messages; also where a float would overflow or vanish."""
    if value == 0:
        return "0"
    try:
        approximation = float(value)
    except OverflowError:
        approximation = 0.0
    if approximation != 0.0:
        return repr(approximation)
    exponent = len(str(abs(value.numerator))) - len(str(value.denominator))
    return f"of order 1e{exponent}"
