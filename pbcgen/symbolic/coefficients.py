"""Exact functions taken apart: power products of states and atoms, with functions of the parameters before them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from flint import fmpq, fmpq_mpoly

from pbcgen.symbolic.field import Field, Quotient

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
        if any(degree and k not in self.parameters for k, degree in enumerate(function.denominator.degrees())):
            return None
        groups: dict[Monomial, dict[Monomial, fmpq]] = {}
        for raw, coefficient in function.numerator.to_dict().items():
            exponents = tuple(int(e) for e in raw)
            state = tuple(0 if k in self.parameters else e for k, e in enumerate(exponents))
            rest = tuple(e if k in self.parameters else 0 for k, e in enumerate(exponents))
            groups.setdefault(state, {})[rest] = coefficient
        return {
            state: self.field.quotient(self.field.context.from_dict(terms), function.denominator)
            for state, terms in groups.items()
        }
