"""Exact functions as CasADi expressions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING

import casadi as ca
from flint import fmpq_mpoly

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.real import fraction
from pbcgen.symbolic.tape import exact_decimal
from pbcgen.symbolic.terms import terms

if TYPE_CHECKING:
    from pbcgen.symbolic.field import Field, Quotient


def as_expression(
    field: Field,
    element: Quotient,
    symbols: Sequence[ca.SX],
    number: Callable[[Fraction, bool], ca.SX] | None,
    alone: bool,
) -> ca.SX:
    """See :meth:`Field.to_sx`."""
    make = number or _decimal_number
    cache: dict[int, ca.SX] = {}

    def generator(k: int) -> ca.SX:
        if k < field.symbol_count:
            return symbols[k]
        if k not in cache:
            atom = field.atoms[k]
            cache[k] = getattr(ca, atom.kind)(expression(atom.argument, True))
        return cache[k]

    def polynomial(p: fmpq_mpoly) -> ca.SX:
        total = ca.SX(0)
        for powers, coefficient in terms(p):
            factors = [generator(k) if e == 1 else generator(k) ** e for k, e in powers]
            value = fraction(coefficient)
            if not factors:
                total = total + make(value, False)
                continue
            product = factors[0]
            for factor in factors[1:]:
                product = product * factor
            total = total + (product if value == 1 else -product if value == -1 else make(value, False) * product)
        return total

    def expression(q: Quotient, argument: bool) -> ca.SX:
        constant = q.constant() if argument else None
        if constant is not None:
            return make(fraction(constant), True)
        top = polynomial(q.numerator)
        return top if q.is_polynomial() else top / polynomial(q.denominator)

    return expression(element, alone)


def _decimal_number(value: Fraction, argument: bool) -> ca.SX:
    if argument or exact_decimal(float(value)) != value:
        raise UnsupportedOperation(f"the number {value} is no decimal of double length")
    return ca.SX(float(value))
