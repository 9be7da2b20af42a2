"""Exact functions as CasADi expressions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction

import casadi as ca
from flint import fmpq_mpoly

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import fraction
from pbcgen.symbolic.tape import exact_decimal
from pbcgen.symbolic.terms import terms


def to_sx(
    function: Quotient,
    symbols: Sequence[ca.SX],
    number: Callable[[Fraction, bool], ca.SX] | None = None,
    alone: bool = False,
) -> ca.SX:
    """An exact function as an SX expression of ``symbols``, which stand for the symbols of its field in order.

    Args:
        function: element of a field.
        symbols: at least one for each symbol of the field.
        number: makes an SX of a coefficient, or (True) of a number that a function is taken of, which CasADi must not
            compute. By default a coefficient must be a decimal of double length, because CasADi would round another
            one, and functions of numbers must not occur; else UnsupportedOperation is raised.
        alone: whether the result may be put in for a variable, and so become the argument of a function.
    """
    make = number or _decimal_number
    field = function.field
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

    return expression(function, alone)


def _decimal_number(value: Fraction, argument: bool) -> ca.SX:
    if argument or exact_decimal(float(value)) != value:
        raise UnsupportedOperation(f"the number {value} is no decimal of double length")
    return ca.SX(float(value))
