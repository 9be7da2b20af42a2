"""Numbers that a user writes into expressions: they become parameters, so that CasADi does not round them.

CasADi computes with the doubles that it is given: it multiplies numbers while it differentiates, and the derivative of
``0.7 * (3 * x**2)`` has a factor 4.199999999999999. Parameters stay symbols, and nothing is rounded.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from fractions import Fraction

import casadi as ca

from pbcgen.models.parameters import Parameters

#: Numbers with numerator and denominator of so many bits may be multiplied a few times in doubles without rounding.
_SHORT_BITS = 12

#: A number is read as a decimal of so many digits, or as a fraction whose numerator times denominator is at most this,
#: if that is only a few roundings away: Python makes 2.0999999999999996 of ``0.7 * 3`` and 0.6666666666666666 of
#: ``2 / 3``. One double in 10000 or fewer has such a neighbour by chance.
_DIGITS, _LARGEST_FRACTION, _ROUNDINGS = 10, 10**10, 4

#: A number of so many digits or more looks like the result of a computation in doubles.
_LONG = 15

#: Below it a double has fewer digits.
_SMALLEST = 2.3e-308


def as_written(number: float) -> Fraction:
    """The number that a double stands for: the shortest decimal, or a simpler number a few roundings away."""
    shortest = Fraction(repr(number))
    if abs(number) < _SMALLEST:
        return shortest
    near = _ROUNDINGS * Fraction(math.ulp(number))
    most = 1 + math.isqrt(int(_LARGEST_FRACTION / abs(shortest)))
    simpler = Fraction(f"{number:.{_DIGITS}g}"), shortest.limit_denominator(most)
    return next((value for value in simpler if value and abs(value - shortest) <= near), shortest)


def named_numbers(
    values: Sequence[ca.SX], label: str, parameters: Parameters, taken: Collection[str] = ()
) -> tuple[list[ca.SX], Parameters]:
    """Expressions with their numbers as parameters, unless products of them are exact in doubles.

    Integers and binary fractions of moderate length stay numbers. A number and its negative share a parameter, in all
    of the expressions; so does an exponent, from which a derivative takes one.

    Args:
        values: the expressions.
        label: how the parameters are called, followed by a count.
        parameters: the model's own.
        taken: names that no parameter may have, beside those that occur.

    Returns:
        The expressions, and the parameters with those that were added.
    """
    variables = ca.vertcat(ca.SX(0, 1), *ca.symvar(ca.vertcat(*[ca.vec(ca.densify(value)) for value in values])))
    function = ca.Function("f", [variables], list(values))
    work: dict[int, ca.SX | float] = {}
    results = [ca.SX(value) for value in values]
    numbers = _Numbers(label, parameters, {*taken, *(entry.name() for entry in ca.symvar(variables))})
    for k in range(function.n_instructions()):
        operation, inputs = function.instruction_id(k), function.instruction_input(k)
        place, *position = function.instruction_output(k)
        operands = [] if operation in (ca.OP_INPUT, ca.OP_CONST) else [work[place] for place in inputs[:2]]
        if operation == ca.OP_OUTPUT:
            results[place].nz[position[0]] = numbers.operand(work[inputs[0]])
        elif operation == ca.OP_INPUT:
            work[place] = variables[inputs[1]]
        elif operation == ca.OP_CONST:
            work[place] = function.instruction_constant(k)
        elif len(operands) == 1:
            work[place] = ca.SX.unary(operation, numbers.operand(operands[0]))
        else:
            operation = ca.OP_POW if operation == ca.OP_CONSTPOW else operation
            below = operation == ca.OP_DIV and isinstance(operands[0], ca.SX)
            base = operation == ca.OP_POW  # the logarithm of a base is in the derivative
            left = numbers.operand(operands[0], always=base)
            work[place] = ca.SX.binary(operation, left, numbers.operand(operands[1], below))
    return (results, numbers.parameters) if numbers.changed else (list(values), parameters)


def is_long(value: Fraction) -> bool:
    """Whether a number has as many digits as a double: it may be the result of a rounded computation."""
    return value == Fraction(repr(float(value))) != Fraction(f"{float(value):.{_LONG - 1}g}")


def named(value: ca.SX, label: str, parameters: Parameters, taken: Collection[str] = ()) -> tuple[ca.SX, Parameters]:
    """:func:`named_numbers` of one matrix."""
    (result,), parameters = named_numbers([value], label, parameters, taken)
    return result, parameters


class _Numbers:
    """The parameters for the numbers met so far."""

    def __init__(self, label: str, parameters: Parameters, taken: Collection[str]) -> None:
        self.label, self.parameters, self.taken, self.changed = label, parameters, taken, False
        self._named: dict[Fraction, ca.SX] = {}

    def operand(self, entry: ca.SX | float, below: bool = False, always: bool = False) -> ca.SX:
        """An expression, or what stands for a number; ``below`` a fraction line a third is one, which is not short."""
        if isinstance(entry, ca.SX) or not math.isfinite(entry):
            return ca.SX(entry)
        value = as_written(entry)
        if not always and is_short(value) and not (below and value and not is_short(1 / value)):
            self.changed |= float(value) != entry
            return ca.SX(float(value))
        if abs(value) not in self._named:
            self._named[abs(value)] = self._added(abs(value))
        return self._named[abs(value)] if value > 0 else -self._named[abs(value)]

    def _added(self, value: Fraction) -> ca.SX:
        self.changed, count = True, len(self._named) + 1
        while (name := f"{self.label}_{count}") in (*self.parameters, *self.taken):
            count += 1
        self.parameters = self.parameters.joined(**{name: value})
        return self.parameters[name]


def is_short(value: Fraction) -> bool:
    """Whether the number is a fraction of few bits, so that products of several of them are not rounded."""
    binary = value.denominator & (value.denominator - 1) == 0
    return binary and max(abs(value.numerator).bit_length(), value.denominator.bit_length()) <= _SHORT_BITS
