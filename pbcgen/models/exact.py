"""Numbers as the user wrote them: exact rationals, never the nearest double."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Any

from pbcgen.errors import ModelError

#: What a user may write for a number: ``"2.2e-4"``, ``"11/50000"``, ``100``, ``0.1`` (read as 1/10), ...
Number = str | int | float | Fraction | Decimal

_LONGEST_NUMBER = 400
#: Products of a few numbers of such sizes are doubles.
_SMALLEST, _LARGEST = Fraction(1, 10**100), Fraction(10**100)


def exact(value: Number, what: str) -> Fraction:
    """The number ``value`` as a fraction; a float is read as the shortest decimal that denotes it.

    Args:
        value: a string, int, float, Fraction, Decimal or NumPy scalar.
        what: how the message calls the number, for example "the parameter `R1`".

    Raises:
        ModelError: if the value is missing, not a number, not finite, or of a size beyond doubles.
    """
    if value is None:
        raise ModelError(f"{what} has no value: give it a number")
    number = _fraction(value)
    if number is None:
        raise ModelError(f"{what} is {value!r}: a finite number was expected, such as 100 or '2.2e-4'")
    if number and not _SMALLEST <= abs(number) <= _LARGEST:
        raise ModelError(f"{what} is {value!r}: its size must lie between 1e-100 and 1e100; check the unit")
    return number


def positive(value: Number, what: str) -> Fraction:
    """:func:`exact`, and ModelError unless the number is positive."""
    number = exact(value, what)
    if number <= 0:
        raise ModelError(f"{what} is {value}: it must be positive")
    return number


def decimal(value: Fraction) -> str:
    """The number as a user would write it: a terminating decimal where there is a short one, else ``p/q``."""
    shortest = Fraction(repr(float(value)))
    return repr(float(value)) if shortest == value and value.denominator != 1 else str(value)


def rounded_down(value: Fraction, digits: int) -> Fraction:
    """The largest number of so many significant decimals that is not above a positive value."""
    if value <= 0:
        return Fraction(0)
    exponent = 0
    while value * Fraction(10) ** exponent >= 10**digits:
        exponent -= 1
    while value * Fraction(10) ** exponent < 10 ** (digits - 1):
        exponent += 1
    unit = Fraction(10) ** -exponent
    # A proposal of floating point a hair below a short decimal means that decimal.
    near = round(value / unit) * unit
    return near if abs(near - value) <= value / 10**11 else (value // unit) * unit


def plain(value: Any) -> Any:
    """The value with types that JSON knows: fractions as exact text, numbers that are not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # NumPy
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, Fraction):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _fraction(value: Any) -> Fraction | None:
    if getattr(value, "ndim", None) == 0:  # a NumPy array of one number
        value = value.item()
    match value:
        case bool():
            return None
        case str():
            return _parsed(value)
        case Decimal():
            return _parsed(str(value))
        case numbers.Rational():
            return Fraction(int(value.numerator), int(value.denominator))
        case numbers.Real():
            return Fraction(repr(float(value))) if math.isfinite(value) else None
        case _:
            return None


def _parsed(text: str) -> Fraction | None:
    """The number that a text denotes. An absurd exponent is refused before it fills the memory."""
    _, e, exponent = text.lower().partition("e")
    if len(text) > _LONGEST_NUMBER or (e and len(exponent.strip().lstrip("+-0")) > 3):
        return None
    try:
        return Fraction(text.strip())
    except (ValueError, ZeroDivisionError):
        return None
