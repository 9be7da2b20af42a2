"""Atoms that are numbers, such as cos(1/2): polynomials in them are bounded from below by polynomials without them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction

from flint import fmpq, fmpq_mpoly

from pbcgen.proof.known import Exponents, Known
from pbcgen.symbolic.field import Field
from pbcgen.symbolic.real import BITS, REAL, Real, approximate, ball, is_finite, lower, precision, rational

#: Values of other sizes, such as exp(-10000), are left alone.
_SMALLEST = 1e-100


def number_atoms(field: Field) -> dict[int, Real]:
    """The values of the atoms whose argument is a rational number, enclosed."""
    found: dict[int, Real] = {}
    with precision(BITS):
        for k, atom in field.atoms.items():
            argument = atom.argument.constant()
            if argument is not None:
                value = getattr(REAL, atom.kind)(argument)
                if is_finite(value) and _SMALLEST < abs(approximate(value)) < 1 / _SMALLEST:
                    found[k] = value
    return found


def below(field: Field, polynomial: fmpq_mpoly, known: Known) -> fmpq_mpoly | None:
    """A polynomial without number atoms that is nowhere above this one; None if there are none, or none was found."""
    numbers = number_atoms(field)
    degrees = polynomial.degrees()
    if not any(degrees[k] for k in numbers):
        return None
    groups: dict[Exponents, list[tuple[fmpq, Exponents]]] = {}
    for raw, coefficient in polynomial.to_dict().items():
        exponents = tuple(map(int, raw))
        rest = tuple(0 if k in numbers else e for k, e in enumerate(exponents))
        groups.setdefault(rest, []).append((coefficient, exponents))
    terms: dict[Exponents, fmpq] = {}
    for rest, parts in groups.items():
        if not any(exponents[k] for _, exponents in parts for k in numbers):
            terms[rest] = sum((c for c, _ in parts), fmpq(0))
            continue
        if any(e % 2 and k not in known.positive for k, e in enumerate(rest)):
            return None
        terms[rest] = _least(parts, numbers)
    return field.context.from_dict(terms)


def _least(parts: list[tuple[fmpq, Exponents]], numbers: Mapping[int, Real]) -> fmpq:
    """A rational number below ``sum c product of numbers``, of moderate length."""
    with precision(BITS):
        total = ball(fmpq(0))
        for coefficient, exponents in parts:
            term = ball(coefficient)
            for k, value in numbers.items():
                term = term * ball(value) ** exponents[k]
            total = total + term
    least = lower(total)
    try:
        return rational(Fraction(math.nextafter(float(least), -math.inf)))
    except OverflowError:
        return rational(least)
