"""Exact functions taken apart: power products of states and atoms, with functions of the parameters before them."""

from __future__ import annotations

from collections.abc import Iterable

from flint import fmpq

from pbcgen.symbolic.field import Field, Quotient

#: The exponents of all indeterminates, by position.
Monomial = tuple[int, ...]


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
