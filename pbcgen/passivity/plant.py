"""A system seen as formulas to be evaluated: exactly as functions, or in balls at a point."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.affine import AffineSystem
from pbcgen.models.exact import Number
from pbcgen.models.numbers import is_short
from pbcgen.passivity.construction import gradient_by_construction
from pbcgen.proof.nonnegative import positive
from pbcgen.symbolic.continued import continued
from pbcgen.symbolic.doubles import Doubles
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, precision, reals
from pbcgen.symbolic.tape import Matrix, Tape
from pbcgen.symbolic.to_sx import to_sx


@dataclass(frozen=True)
class Point:
    """A state and an input, each entry exact or enclosed."""

    x: tuple[Real, ...]
    u: tuple[Real, ...]


@dataclass(frozen=True, eq=False)
class Plant:
    """The system with the derivatives that the theory needs.

    ``exact`` treats formulas as functions of (x, u, parameters), ``at`` evaluates them at one point.
    """

    system: AffineSystem
    _constants: dict[Fraction, ca.SX] = field(default_factory=dict, repr=False)

    @cached_property
    def gradient(self) -> ca.SX:
        """grad S, n x 1. A front end's own expression of it is used where it is proved to be the same function."""
        mechanics = self.system.mechanical
        if mechanics is not None and self.gradient_is_exact:
            return mechanics.energy_gradient
        return ca.gradient(self.system.S, self.system.x)

    @cached_property
    def gradient_is_exact(self) -> bool:
        """Whether the front end's expression of grad S, if it has one, is the derivative of S.

        By the way it is written, else as an exact identity. It rests on M being symmetric, which front ends only check
        at samples.
        """
        mechanics = self.system.mechanical
        if mechanics is None or gradient_by_construction(self.system):
            return True
        try:
            field, (difference,) = self.exact(mechanics.energy_gradient - ca.gradient(self.system.S, self.system.x))
        except (UnsupportedOperation, ZeroDivisionError):
            return False
        return all(entry.is_zero() for entry in difference.column(field.const(0)))

    @property
    def names(self) -> tuple[str, ...]:
        """The symbols: states, inputs, parameters, and the constants made by :meth:`number`."""
        return (*self.system.state_names, *self.system.input_names, *self.parameter_names)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The names of the parameters and of the constants made by :meth:`number`."""
        return (*self.system.parameters.names, *(_constant_name(value) for value in self._constants))

    @property
    def parameter_symbols(self) -> ca.SX:
        """The symbols of :attr:`parameter_names`, a column."""
        return ca.vertcat(ca.SX(self.system.parameters.symbols), *self._constants.values())

    @cached_property
    def _fixed(self) -> tuple[list[ca.SX], list[ca.SX]]:
        """The states and inputs, and the parameters, one by one."""
        system = self.system
        columns = (system.x, system.u), (ca.SX(system.parameters.symbols),)
        first, second = ([s for c in pair if c.numel() for s in ca.vertsplit(c)] for pair in columns)
        return first, second

    @property
    def parameter_list(self) -> list[ca.SX]:
        """The entries of :attr:`parameter_symbols`."""
        return [*self._fixed[1], *self._constants.values()]

    @property
    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """(x, u, parameters), the inputs of every tape."""
        return self.system.x, self.system.u, self.parameter_symbols

    @property
    def values(self) -> Mapping[str, Fraction]:
        """The exact values of :attr:`parameter_names`."""
        constants = {_constant_name(value): value for value in self._constants}
        return {**self.system.parameters.values, **constants}

    @property
    def parameter_values(self) -> tuple[Fraction, ...]:
        """The exact values of :attr:`parameter_names`, in their order."""
        values = self.values
        return tuple(values[name] for name in self.parameter_names)

    def number(self, value: Fraction, alone: bool = False) -> ca.SX:
        """An exact number for use in expressions.

        CasADi adds and multiplies constants in doubles: 0.7 + 0.1 is not 0.8 then. So only fractions
        of few bits, with which this is exact, stay numbers; others become symbols with this value. So do those
        ``alone``, which may be put into a function: sin(2) would be a double too.
        """
        if value == 0 or (is_short(value) and not alone):
            return ca.SX(float(value))
        if value < 0:
            return -self.number(-value, alone)
        if value not in self._constants:
            self._constants[value] = ca.SX.sym(_constant_name(value))
        return self._constants[value]

    def numbers_of(self, other: Plant, expression: ca.SX) -> ca.SX:
        """An expression of another plant with this plant's symbols for the constants that the other has made."""
        old, new = ca.vertcat(ca.SX(0, 1), *other._constants.values()), map(self.number, other._constants)
        return ca.substitute(expression, old, ca.vertcat(ca.SX(0, 1), *new)) if old.numel() else expression

    def with_values(self, values: Mapping[str, Number]) -> Plant:
        """The formulas f, g and S with other values of some parameters; it knows the constants of :meth:`number`."""
        system = self.system
        parameters = system.parameters.with_values(**values)
        moved = AffineSystem(system.x, system.u, system.f, system.g, system.S, parameters=parameters)
        return Plant(moved, dict(self._constants))

    def symbolic(self, system: AffineSystem) -> SymbolicPlant:
        """Another system, whose parameters stay symbols; it knows the constants made by :meth:`number` so far."""
        return SymbolicPlant(system, dict(self._constants))

    def expression(self, element: Quotient, alone: bool = False) -> ca.SX:
        """An exact function of this plant's symbols as an SX expression; ``alone``: to be put in for a variable."""
        return to_sx(element, [*self._fixed[0], *self.parameter_list], self.number, alone)

    @cached_property
    def is_continuous(self) -> bool:
        """Whether f and g are Lipschitz functions and S is differentiable, as far as moduli go.

        What the user wrote must be free of sign(a); f, g and grad S, where they are derivatives of that, must be free
        of it when they are simplified, see :mod:`pbcgen.symbolic.continued`.
        """
        system, mechanics = self.system, self.system.mechanical
        parts = [system.f, system.g, system.S]
        if mechanics is not None:
            parts = [mechanics.M, mechanics.V, mechanics.D, mechanics.G]
        tapes = [Tape.of(self.symbols, [part]) for part in parts]
        if any(tape.uses("sign") for tape in tapes):
            return False
        if not any(tape.uses("fabs") for tape in tapes):
            return True
        gradient = ca.gradient(system.S, system.x) if mechanics is None else mechanics.energy_gradient
        return self._is_continued(ca.vertcat(system.f, ca.vec(ca.densify(system.g)), gradient))

    def reads_signs(self, tape: Tape) -> bool:
        """Whether derivatives of this system may be read with sign(a) as |a| / a, and there is one."""
        return tape.uses("sign") and self.is_continuous

    def jumps(self, *expressions: ca.SX) -> str:
        """An operation in functions of the state by which they may jump, or the empty text."""
        return Tape.of(self.symbols, expressions).jumps()

    def is_differentiable(self, expression: ca.SX) -> bool:
        """Whether a column of functions of the state has no jumps, and moduli leave it a continuous derivative."""
        if self.jumps(expression):
            return False
        if not Tape.of(self.symbols, [expression]).uses("fabs"):
            return True
        return self._is_continued(ca.vec(ca.densify(ca.jacobian(expression, self.system.x))))

    def _is_continued(self, derivative: ca.SX) -> bool:
        tape = Tape.of(self.symbols, [derivative])
        if not tape.uses("sign"):
            return True
        try:
            field, (values,) = evaluate(tape, self.names, self.values, signs=True)
        except (UnsupportedOperation, ZeroDivisionError):
            return False
        bottoms = [field.polynomial(value.denominator) for value in values.entries.values()]
        return all(positive(bottom) or positive(-bottom) for bottom in bottoms)

    def tape(self, *outputs: ca.SX) -> Tape:
        """The tape of outputs that depend on (x, u, parameters)."""
        tape = Tape.of(self.symbols, outputs)
        if not self.reads_signs(tape):
            return tape
        # The constants that are made on the way belong to the symbols.
        whole = continued(outputs, self.symbols, self.names, self.values, self.number)
        return Tape.of(self.symbols, whole)

    def exact(
        self, *outputs: ca.SX, symbolic: bool = False, known: Mapping[str, Fraction] | None = None
    ) -> tuple[Field, list[Matrix[Quotient]]]:
        """The outputs as exact functions of x and u; of the parameters too if ``symbolic``.

        Raises UnsupportedOperation for operations that are not analytic.
        """
        parameters = self.system.parameters.names if symbolic else ()
        values = {name: value for name, value in self.values.items() if name not in parameters}
        tape = Tape.of(self.symbols, outputs)
        return evaluate(tape, self.names, {**values, **(known or {})}, self.reads_signs(tape))

    def parameter_positions(self) -> frozenset[int]:
        """Positions of the parameters among :attr:`names`."""
        count = self.system.n + self.system.m
        return frozenset(range(count, count + len(self.system.parameters.names)))

    @property
    def numbers(self) -> dict[str, Fraction]:
        """The values of the parameters that stand for numbers in the model's expressions: formulas show these."""
        return {name: self.values[name] for name in self.system.parameters.numbers}

    def at(self, point: Point, *outputs: ca.SX) -> list[list[list[Real]]]:
        """The outputs at a point as dense matrices of exact numbers or balls."""
        with precision(BITS):
            return self.walk(self.tape(*outputs), point.x, point.u)

    def walk(self, tape: Tape, x: Sequence[Real], u: Sequence[Real]) -> list[list[list[Real]]]:
        """The outputs of a tape of (x, u, parameters) at the current precision."""
        parameters = reals(self.parameter_values)
        return [matrix.dense(ZERO) for matrix in tape.walk(REAL, [list(x), list(u), parameters])]

    def numeric(self, *outputs: ca.SX) -> ca.Function:
        """A floating-point function (x, u) -> outputs at the parameter values."""
        return ca.Function("numeric", [self.system.x, self.system.u], self._at_values(outputs))

    def doubles(self, *outputs: ca.SX) -> Doubles:
        """The same for NumPy arrays."""
        return Doubles([self.system.x, self.system.u], self._at_values(outputs))

    def _at_values(self, outputs: Sequence[ca.SX]) -> list[ca.SX]:
        values = ca.DM([float(v) for v in self.parameter_values])
        return [
            ca.substitute(ca.SX(o), self.parameter_symbols, values) if values.numel() else ca.SX(o) for o in outputs
        ]


class SymbolicPlant(Plant):
    """A system whose parameters have no values: formulas are functions of them too. It has no numbers at a point."""

    @property
    def values(self) -> Mapping[str, Fraction]:
        """The exact values of the numbers in the model's expressions and of the constants made by :meth:`number`."""
        parameters = self.system.parameters
        own = {name: parameters.values[name] for name in sorted(parameters.numbers)}
        return {**own, **{_constant_name(value): value for value in self._constants}}

    def number(self, value: Fraction, alone: bool = False) -> ca.SX:
        """An exact number: a symbol in any case, so that CasADi computes no sums, sines or roots of it in doubles."""
        del alone
        if value == 0:
            return ca.SX(0)
        if value not in self._constants:
            self._constants[value] = ca.SX.sym(_constant_name(value))
        return self._constants[value]


def _constant_name(value: Fraction) -> str:
    return f"({value})"


def columns(matrix: Matrix[Quotient], zero: Quotient) -> list[list[Quotient]]:
    """The columns of a matrix of functions."""
    dense = matrix.dense(zero)
    return [[row[j] for row in dense] for j in range(matrix.shape[1])]


def sparse_dot(left: Mapping[int, Quotient], right: Mapping[int, Quotient], zero: Quotient) -> Quotient:
    """The sum of products of the entries that both have."""
    both = sorted(left.keys() & right.keys())
    return dot((left[k] for k in both), (right[k] for k in both), zero)


def dot(left: Iterable[Quotient], right: Iterable[Quotient], zero: Quotient) -> Quotient:
    """The sum of products."""
    total = zero
    for a, b in zip(left, right, strict=True):
        if not (a.is_zero() or b.is_zero()):
            total = total + a * b
    return total
