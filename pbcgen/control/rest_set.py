"""The equilibria on the invariant set, by coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from pbcgen.control.situation import Situation
from pbcgen.passivity.lasalle import InvariantSet
from pbcgen.passivity.plant import Plant
from pbcgen.symbolic.field import Quotient


@dataclass(frozen=True, eq=False)
class RestSet:
    """An invariant set that consists of equilibria, by its free coordinates z.

    Attributes:
        z: the states, and entries of u that stand for the constant inputs, that are left.
        inputs: all constant inputs as functions of z, m x 1.
        outputs: gamma there, plus ``K_c^{-1}`` times the inputs, m x 1.
        zero: functions that vanish on the set, a column.
    """

    z: list[ca.SX]
    inputs: ca.SX
    outputs: ca.SX
    zero: ca.SX

    @staticmethod
    def of(situation: Situation, found: InvariantSet) -> RestSet:
        """What elimination left of the invariant set."""
        system, start = situation.plant.system, situation.flow
        assert start is not None
        constant = ca.vertsplit(start.constant)
        replaced = [system.x[k] for k in found.solved] + [constant[j] for j in found.inputs]
        values = [*found.solved.values(), *found.inputs.values()]
        expressions = [
            start.constant,
            situation.gamma + ca.mtimes(situation.compliance, start.constant),
            ca.vertcat(ca.SX(0, 1), *found.pending),
        ]
        if replaced:
            old, new = ca.vertcat(*replaced), ca.densify(ca.vertcat(*values))
            expressions = [ca.substitute(e, old, new) for e in expressions]
        expressions = [ca.substitute(e, start.constant, system.u) for e in expressions]
        z = [system.x[k] for k in found.free] + [system.u[j] for j in range(system.m) if j not in found.inputs]
        return RestSet(z, *expressions)

    def shorter(self, plant: Plant) -> RestSet:
        """The same set, with multiples of what vanishes on it taken from inputs and outputs so that fewer terms grow.

        Raises UnsupportedOperation for operations that are not those of exact arithmetic.
        """
        field, columns = plant.exact(self.inputs, self.outputs, self.zero)
        zero = field.const(0)
        vanishing = columns[2].column(zero)
        found = []
        for expression, column in zip((self.inputs, self.outputs), columns, strict=False):
            entries = zip(ca.vertsplit(expression), column.column(zero), strict=True)
            less = [(old, value, _shorter(value, vanishing)) for old, value in entries]
            found.append(ca.vertcat(*[old if new is value else plant.expression(new) for old, value, new in less]))
        return RestSet(self.z, found[0], found[1], self.zero)


def _shorter(function: Quotient, vanishing: Sequence[Quotient]) -> Quotient:
    """The function less a multiple of one that vanishes, if fewer of its terms then grow."""
    best = function
    for value in vanishing:
        if not (function.is_polynomial() and value.is_polynomial()):
            continue
        own, other = function.numerator.to_dict(), value.numerator.to_dict()
        for exponents in sorted(own.keys() & other.keys()):
            factor = function.field.context.constant(own[exponents] / other[exponents])
            less = function - value * function.field.polynomial(factor)
            best = less if _growing(less) < _growing(best) else best
    return best


def _growing(function: Quotient) -> int:
    """How many terms hold a coordinate outside of functions."""
    states = function.field.symbol_count
    return sum(any(exponents[:states]) for exponents in function.numerator.to_dict())
