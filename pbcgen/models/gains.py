"""Exact gain vectors and matrices, and the scalars that stand for them until the number of inputs is known."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any, TypeVar

import numpy as np
from flint import fmpq, fmpq_mat

from pbcgen.errors import ModelError
from pbcgen.models.exact import Number, decimal, exact

T = TypeVar("T")

#: A gain per channel.
Vector = tuple[Fraction, ...]
#: Rows of a gain matrix.
Matrix = tuple[tuple[Fraction, ...], ...]

#: What a user may write: a number for all channels, or one number per channel.
VectorLike = Number | Sequence[Number]
#: What a user may write: k for k I, a list for a diagonal matrix, a list of rows.
MatrixLike = Number | Sequence[Number] | Sequence[Sequence[Number]]


class Broadcast(tuple[T, ...]):
    """A gain of one number: it takes the size that the system asks for."""

    __slots__ = ()


def vector(value: VectorLike, what: str) -> Vector:
    """A vector of positive gains; a single number broadcasts.

    Raises:
        ModelError: naming the gain, if an entry is not a finite positive number.
    """
    if isinstance(value, Broadcast):
        return value
    if not is_sequence(value):
        return Broadcast((_positive(value, what),))
    return tuple(_positive(entry, _entry(what, i)) for i, entry in enumerate(_nonempty(value, what)))


def matrix(value: MatrixLike, what: str) -> Matrix:
    """A square gain matrix: a number k is k I (of any size), a list its diagonal, a list of rows the matrix.

    Raises:
        ModelError: naming the gain, if it is not square or an entry is not a finite number.
    """
    if isinstance(value, Broadcast):
        return value
    if not is_sequence(value):
        number: Any = value
        return Broadcast(((exact(number, f"the gain {what}"),),))
    rows = _nonempty(value, what)
    if not any(is_sequence(row) for row in rows):
        return diagonal([exact(row, f"the gain {_entry(what, i)}") for i, row in enumerate(rows)])
    result = rectangle(rows, what)
    if len(result) != len(result[0]):
        raise ModelError(f"the gain {what} is {len(result)}x{len(result[0])}: a square matrix was expected")
    return result


def symmetric(value: MatrixLike, what: str) -> Matrix:
    """A symmetric matrix with a positive diagonal: necessary for it to be positive definite."""
    result = matrix(value, what)
    for i, row in enumerate(result):
        for j, entry in enumerate(row[:i]):
            if entry != result[j][i]:
                raise ModelError(
                    f"the gain {what} is not symmetric: entry ({i + 1}, {j + 1}) is {decimal(entry)}, "
                    f"entry ({j + 1}, {i + 1}) is {decimal(result[j][i])}"
                )
    _check_diagonal(result, what, allow_zero=False)
    return result


def diagonal_matrix(value: MatrixLike, what: str, *, allow_zero: bool = False) -> Matrix:
    """A diagonal matrix with positive (or nonnegative) entries."""
    result = matrix(value, what)
    if not is_diagonal(result):
        raise ModelError(f"the gain {what} must be diagonal: give a number or the list of its diagonal")
    _check_diagonal(result, what, allow_zero=allow_zero)
    return result


def rectangle(rows: Sequence[Any], what: str) -> Matrix:
    """A matrix of any shape from its rows."""
    if not all(is_sequence(row) for row in rows):
        raise ModelError(f"the gain {what} mixes numbers and rows: give all its rows")
    result = tuple(
        tuple(exact(entry, f"entry ({i + 1}, {j + 1}) of {what}") for j, entry in enumerate(row))
        for i, row in enumerate(rows)
    )
    if len({len(row) for row in result}) != 1 or not result[0]:
        raise ModelError(f"the gain {what} has rows of different lengths, or empty ones")
    return result


def diagonal(entries: Sequence[T | Fraction]) -> tuple[tuple[T | Fraction, ...], ...]:
    """The diagonal matrix of these entries, numbers or expressions."""
    size = range(len(entries))
    return tuple(tuple(entries[i] if i == j else Fraction(0) for j in size) for i in size)


def is_diagonal(value: Matrix) -> bool:
    """Whether all entries beside the diagonal are zero."""
    return not any(entry for i, row in enumerate(value) for j, entry in enumerate(row) if i != j)


def sized_vector(value: Vector, m: int, what: str) -> Vector:
    """The vector with m entries. Raises ModelError if it was given with another number of them."""
    if isinstance(value, Broadcast):
        return tuple(value) * m
    if len(value) != m:
        raise ModelError(f"the gain {what} has {_entries(len(value))}, the system has {_inputs(m)}")
    return value


def sized_matrix(value: Matrix, m: int, what: str) -> Matrix:
    """The m x m matrix. Raises ModelError if it was given with another size."""
    if isinstance(value, Broadcast):
        return diagonal([value[0][0]] * m)
    if len(value) != m:
        raise ModelError(f"the gain {what} is {len(value)}x{len(value)}, the system has {_inputs(m)}")
    return value


def rank(value: Matrix) -> int:
    """The rank, exactly."""
    return int(fmpq_mat([[fmpq(v.numerator, v.denominator) for v in row] for row in value]).rank())


def is_sequence(value: object) -> bool:
    """Whether a gain was given as several numbers."""
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return isinstance(value, Sequence) and not isinstance(value, str)


def _nonempty(value: Any, what: str) -> list[Any]:
    entries = list(value)
    if not entries:
        raise ModelError(f"the gain {what} is empty")
    return entries


def _positive(value: Any, what: str) -> Fraction:
    number = exact(value, f"the gain {what}")
    if number <= 0:
        raise ModelError(f"the gain {what} is {decimal(number)}: it must be positive")
    return number


def _check_diagonal(value: Matrix, what: str, *, allow_zero: bool) -> None:
    for i, row in enumerate(value):
        if row[i] < 0 or (row[i] == 0 and not allow_zero):
            named = what if len(value) == 1 else f"{what}[{i + 1},{i + 1}]"
            raise ModelError(
                f"the gain {named} is {decimal(row[i])}: it must be {'nonnegative' if allow_zero else 'positive'}"
            )


def _entry(what: str, index: int) -> str:
    return f"{what}[{index + 1}]"


def _entries(count: int) -> str:
    return f"{count} entr{'y' if count == 1 else 'ies'}"


def _inputs(count: int) -> str:
    return f"{count} input{'' if count == 1 else 's'}"
