"""Polynomials read term by term."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import TypeAlias

from flint import fmpq, fmpq_mpoly

#: The indeterminates of a term with their exponents, by position; those with exponent zero are left out.
Powers: TypeAlias = tuple[tuple[int, int], ...]

#: After the indeterminates of a term: later than any of them.
_END = (sys.maxsize, 0)


def terms(polynomial: fmpq_mpoly) -> Iterator[tuple[Powers, fmpq]]:
    """The terms one after the other.

    ``to_dict`` holds an exponent for every indeterminate in every term, all at the same time: a form in n states would
    take memory like n^2.
    """
    for i in range(len(polynomial)):
        exponents = polynomial.monomial(i)
        yield tuple((k, int(e)) for k, e in enumerate(exponents) if e), polynomial.coefficient(i)


def exponents(powers: Powers, size: int) -> tuple[int, ...]:
    """The exponents of ``size`` indeterminates."""
    found = [0] * size
    for k, e in powers:
        found[k] = e
    return tuple(found)


def descending(powers: Powers) -> tuple[tuple[int, int], ...]:
    """A key that sorts as the vectors of all exponents do, the greatest first."""
    return (*((k, -e) for k, e in powers), _END)
