"""x* and u* as functions of the parameters, by solving one equation after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
from flint import fmpq

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.plant import SymbolicPlant
from pbcgen.passivity.region import undefined
from pbcgen.proof.nonnegative import Everywhere, positive
from pbcgen.symbolic.field import Field, Quotient


@dataclass(frozen=True, eq=False)
class RestingPoint:
    """The one solution.

    Attributes:
        unknowns: (x, u), a column of symbols.
        solution: expressions of the parameters, in this order.
        values: the same as exact functions.
    """

    unknowns: ca.SX
    solution: ca.SX
    values: tuple[Quotient, ...]

    def put_in(self, expression: ca.SX) -> ca.SX:
        """The expression at x* and u*."""
        return ca.substitute(expression, self.unknowns, self.solution)


def resting_point(plant: SymbolicPlant, equations: ca.SX) -> RestingPoint | None:
    """The solution of the equations in (x, u), each solved in its turn; None if that does not lead to the end.

    An equation gives an unknown when it is linear in it, with a coefficient of the parameters alone that vanishes for
    no positive ones.
    """
    system = plant.system
    unknowns = ca.vertcat(system.x, system.u)
    symbols = ca.vertsplit(unknowns)
    solved: dict[int, ca.SX] = {}
    try:
        while len(solved) < len(symbols):
            field, (column,) = plant.exact(_put_in(equations, symbols, solved))
            found = _next(field, column.column(field.const(0)), len(symbols))
            if found is None:
                return None
            k, value = found
            expression = plant.expression(value, alone=True)
            solved = {j: ca.substitute(e, symbols[k], expression) for j, e in solved.items()} | {k: expression}
        solution = ca.vertcat(*[solved[k] for k in range(len(symbols))])
        field, (rest, values) = plant.exact(_put_in(equations, symbols, solved), solution)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    zero = field.const(0)
    if undefined(field, Everywhere(), len(field.names)) or not all(v.is_zero() for v in rest.column(zero)):
        return None
    return RestingPoint(unknowns, solution, tuple(values.column(zero)))


def _put_in(expression: ca.SX, symbols: Sequence[ca.SX], solved: dict[int, ca.SX]) -> ca.SX:
    if not solved:
        return expression
    return ca.substitute(expression, ca.vertcat(*[symbols[k] for k in solved]), ca.vertcat(*solved.values()))


def _next(field: Field, equations: Sequence[Quotient], unknowns: int) -> tuple[int, Quotient] | None:
    """An unknown and its value; equations in few unknowns first."""
    for equation in sorted(equations, key=lambda e: sum(k < unknowns for k in e.symbols())):
        for k in sorted(j for j in equation.generators() if j < unknowns):
            inside = [a for a, atom in field.atoms.items() if k in atom.argument.symbols()]
            degrees = equation.numerator.degrees()
            if degrees[k] != 1 or any(degrees[a] for a in inside):
                continue
            parts: tuple[dict[tuple[int, ...], fmpq], dict[tuple[int, ...], fmpq]] = ({}, {})
            for exponents, c in equation.numerator.to_dict().items():
                parts[int(exponents[k])][tuple(0 if j == k else int(e) for j, e in enumerate(exponents))] = c
            rest, slope = (field.polynomial(field.context.from_dict(part)) for part in parts)
            if not any(j < unknowns for j in slope.symbols()) and (positive(slope) or positive(-slope)):
                return k, -rest / slope
    return None
