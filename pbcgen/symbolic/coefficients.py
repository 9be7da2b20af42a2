"""Exact functions taken apart: power products of states and atoms, with functions of the parameters before them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from flint import fmpq, fmpq_mpoly

from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.terms import Powers, exponents, terms

#: The exponents of all indeterminates, by position.
Monomial = tuple[int, ...]


def common_denominator(field: Field, values: Iterable[Quotient]) -> Quotient:
    """The polynomial of least degree that makes polynomials of all values, times it."""
    return field.polynomial(_least_multiple(field, values))


def cleared(field: Field, values: Sequence[Quotient]) -> list[fmpq_mpoly]:
    """The values times their common denominator, with the relations between atoms applied."""
    common = _least_multiple(field, values)
    return [field.reduced(value.numerator * (common / value.denominator)) for value in values]


def _least_multiple(field: Field, values: Iterable[Quotient]) -> fmpq_mpoly:
    common = field.const(1).numerator
    for value in values:
        common = common * (value.denominator / common.gcd(value.denominator))
    return common


class Coefficients:
    """Functions as polynomials in states and atoms, with coefficients that are functions of the parameters.

    Attributes:
        parameters: positions of the parameters, and of the atoms of parameters alone.
    """

    def __init__(self, field: Field, parameters: Iterable[int] = ()) -> None:
        self.field = field
        own = frozenset(parameters)
        self.parameters = own | {k for k, atom in field.atoms.items() if atom.argument.symbols() <= own}

    def split(self, function: Quotient) -> dict[Monomial, Quotient] | None:
        """Coefficient by monomial, or None when the denominator depends on the state."""
        found = self.split_sparsely(function)
        if found is None:
            return None
        size = self.field.context.nvars()
        return {exponents(powers, size): coefficient for powers, coefficient in found.items()}

    def split_sparsely(self, function: Quotient) -> dict[Powers, Quotient] | None:
        """Coefficient by the powers of a monomial, or None when the denominator depends on the state."""
        below = function.denominator
        if not below.is_constant() and any(e and k not in self.parameters for k, e in enumerate(below.degrees())):
            return None
        groups: dict[Powers, dict[Powers, fmpq]] = {}
        for powers, coefficient in terms(function.numerator):
            state = tuple(power for power in powers if power[0] not in self.parameters)
            rest = tuple(power for power in powers if power[0] in self.parameters)
            groups.setdefault(state, {})[rest] = coefficient
        return {state: self._function(group, below) for state, group in groups.items()}

    def _function(self, group: dict[Powers, fmpq], denominator: fmpq_mpoly) -> Quotient:
        context = self.field.context
        if group.keys() == {()}:
            return self.field.quotient(context.constant(group[()]), denominator)
        monomials = {exponents(powers, context.nvars()): coefficient for powers, coefficient in group.items()}
        return self.field.quotient(context.from_dict(monomials), denominator)
