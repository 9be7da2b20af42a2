"""Functions that fix the state: they take the same values at no two states, or are bounded at bounded states only.

Both are shown in one of two ways. Either a Jacobian is positive definite everywhere, after rows were scaled: then
``(a - b)^T T (w(a) - w(b)) > 0``, and if it stays above a positive multiple of I, w grows at least linearly. Or
variables are found one after the other: a function that is affine in one of them, with a constant coefficient, gives
that one in terms of the others; one that is left with a single unknown must be monotone in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.equation import certainly_varies, is_entire, linear_in, never_zero
from pbcgen.passivity.plant import Plant
from pbcgen.proof.elimination import definite, semidefinite
from pbcgen.proof.nonnegative import nonnegative, positive
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.tape import Tape
from pbcgen.symbolic.to_sx import to_sx

#: Slopes are compared with these.
_LEAST_SLOPES = (Fraction(1, 100), Fraction(1, 10**5), Fraction(1, 10**9))
#: Sets of functions with more variables are not taken apart.
_MOST = 24


def injective(plant: Plant, functions: ca.SX, variables: Sequence[ca.SX], signs: Sequence[int] = ()) -> bool:
    """Whether it is proved that the functions take the same values at no two points of the whole space.

    Args:
        plant: gives the parameters their values.
        functions: a column; besides the variables only parameters may occur.
        variables: scalar symbols.
        signs: 1 or -1 for each function: the Jacobian with its rows so multiplied may be positive definite.
    """
    return _fixed(plant, functions, variables, signs, _increases, definite)


def proper(plant: Plant, functions: ca.SX, variables: Sequence[ca.SX], signs: Sequence[int] = ()) -> bool:
    """Whether it is proved that the variables are bounded wherever the functions are; see :func:`injective`."""
    return _fixed(plant, functions, variables, signs, _grows, _definite_by_a_margin)


_Judge = Callable[["_Chain", int, int, Quotient], bool]


def _fixed(
    plant: Plant,
    functions: ca.SX,
    variables: Sequence[ca.SX],
    signs: Sequence[int],
    judge: _Judge,
    fits: Callable[[list[list[Quotient]]], bool],
) -> bool:
    if len(variables) > _MOST:
        return False
    chain = _Chain(plant, list(variables), ca.vertsplit(functions))
    try:
        if functions.numel() == len(variables) and _by_jacobian(chain, signs, fits):
            return True
        return chain.run(judge)
    except (UnsupportedOperation, ZeroDivisionError):
        return False


def _by_jacobian(chain: _Chain, signs: Sequence[int], fits: Callable[[list[list[Quotient]]], bool]) -> bool:
    size = len(chain.variables)
    J = ca.jacobian(ca.vertcat(*chain.functions), ca.vertcat(*chain.variables))
    if signs:
        J = ca.mtimes(ca.diag(ca.SX(ca.DM(list(signs)))), J)
    entries = chain.exact(*ca.vertsplit(ca.vec(ca.densify(J + J.T))))
    return fits([[entries[j * size + i] for j in range(size)] for i in range(size)])


def _definite_by_a_margin(rows: list[list[Quotient]]) -> bool:
    for least in _LEAST_SLOPES:
        margin = [[v - v.field.const(least) if i == j else v for j, v in enumerate(row)] for i, row in enumerate(rows)]
        if semidefinite(margin):
            return True
    return False


@dataclass
class _Chain:
    """Functions of variables that are found one after the other.

    Attributes:
        held: symbols for values of functions that were used up.
    """

    plant: Plant
    variables: list[ca.SX]
    functions: list[ca.SX]
    held: list[ca.SX] = field(default_factory=list)

    def exact(self, *expressions: ca.SX) -> list[Quotient]:
        """Scalar expressions as functions of the variables and of what is held."""
        plant, symbols = self.plant, [*self.variables, *self.held]
        tape = Tape.of([ca.vertcat(*symbols), plant.parameter_symbols], [ca.vertcat(*expressions)])
        names = [*(f"y{k}" for k in range(len(symbols))), *plant.parameter_names]
        field_, (values,) = evaluate(tape, names, plant.values, plant.reads_signs(tape))
        return values.column(field_.const(0))

    def to_sx(self, element: Quotient) -> ca.SX:
        """A function as an expression."""
        symbols = [*self.variables, *self.held, *ca.vertsplit(self.plant.parameter_symbols)]
        return to_sx(element, symbols, self.plant.number)

    def run(self, judge: _Judge) -> bool:
        """Whether all variables are found."""
        left, open_ = set(range(len(self.variables))), set(range(len(self.functions)))
        while left and open_:
            order = sorted(open_)
            values = dict(zip(order, self.exact(*[self.functions[i] for i in order]), strict=True))
            alone = [(i, *v.symbols() & left) for i, v in values.items() if len(v.symbols() & left) == 1]
            found = next(((i, k) for i, k in alone if judge(self, i, k, values[i])), None)
            if found is None:
                found = self._eliminate(values, left)
            if found is None:
                return False
            open_.discard(found[0])
            left.discard(found[1])
        return not left

    def _eliminate(self, values: dict[int, Quotient], left: set[int]) -> tuple[int, int] | None:
        """Use a function that is affine in a variable for it; a variable that is affine everywhere is preferred."""
        count = len(self.variables) + len(self.held)
        choices = [
            (i, k, rest)
            for i, value in values.items()
            if value.is_polynomial()
            for k in sorted(value.symbols() & left)
            for rest in [linear_in(value, k, count)]
            if rest is not None
        ]
        if not choices:
            return None

        def curved(k: int) -> int:
            return sum(k in v.symbols() and linear_in(v, k, count) is None for v in values.values())

        i, k, rest = min(choices, key=lambda choice: (curved(choice[1]), len(choice[2].numerator), choice[:2]))
        value = self.to_sx(rest)
        self.held.append(ca.SX.sym(f"held_{len(self.held)}"))
        self.functions = [ca.substitute(f, self.variables[k], self.held[-1] - value) for f in self.functions]
        return i, k

    def varies(self, value: Quotient) -> bool:
        """Whether a function is certainly not zero everywhere."""
        return certainly_varies(self.plant, self.to_sx(value), ca.vertcat(*self.variables, *self.held))

    def slope(self, i: int, k: int) -> Quotient:
        """The derivative of a function by a variable."""
        return self.exact(ca.jacobian(self.functions[i], self.variables[k]))[0]


def _increases(chain: _Chain, i: int, k: int, value: Quotient) -> bool:
    """Whether function i is strictly monotone in variable k, whatever the others are.

    If it depends on that variable only, its slope may vanish: not on an interval, for the function is analytic.
    """
    slope = chain.slope(i, k)
    if positive(slope) or positive(-slope):
        return True
    alone = value.symbols() == {k} and is_entire(value)
    return alone and (nonnegative(slope) or nonnegative(-slope)) and chain.varies(slope)


def _grows(chain: _Chain, i: int, k: int, value: Quotient) -> bool:
    """Whether variable k is bounded where function i and the other variables in it are."""
    if _leads(value, k):
        return True
    slope = chain.slope(i, k)
    return any(nonnegative(s - s.field.const(least)) for least in _LEAST_SLOPES for s in (slope, -slope))


def _leads(value: Quotient, k: int) -> bool:
    """Whether this is a polynomial in the variable whose leading coefficient vanishes nowhere."""
    numerator, degree = value.numerator, int(value.numerator.degrees()[k])
    if not value.is_polynomial() or not degree:
        return False
    inside = {a for a, atom in value.field.atoms.items() if k in atom.argument.symbols()}
    terms = numerator.to_dict()
    if any(exponents[a] for exponents in terms for a in inside):
        return False
    leading = {
        tuple(0 if j == k else e for j, e in enumerate(exponents)): c
        for exponents, c in terms.items()
        if exponents[k] == degree
    }
    return never_zero(value.field.polynomial(value.field.context.from_dict(leading)))
