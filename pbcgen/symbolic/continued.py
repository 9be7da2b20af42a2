"""Derivatives of functions with moduli |a| that are continuous where a = 0.

CasADi writes the derivative of |a| as sign(a). In a derivative of a Lipschitz function it is read as ``|a| / a`` here
and what can be cancelled is cancelled, as in ``(v |v|)' = |v| + v sign(v) = 2 |v|``. Where the denominator of the
result vanishes nowhere near a point, the derivative continues continuously there, and is the derivative there too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.tape import Tape
from pbcgen.symbolic.to_sx import to_sx


def continued(
    outputs: Sequence[ca.SX],
    inputs: Sequence[ca.SX],
    names: Sequence[str],
    values: Mapping[str, Fraction],
    number: Callable[[Fraction, bool], ca.SX],
) -> list[ca.SX]:
    """Derivatives with every sign(a) read as |a| / a and cancelled; those that cannot be expanded stay as they are.

    Args:
        outputs: derivatives of Lipschitz functions.
        inputs: columns of symbols.
        names: of the symbols, in order.
        values: exact values of some of them.
        number: makes an expression of an exact number.
    """
    symbols = [s for column in inputs if column.numel() for s in ca.vertsplit(ca.SX(column))]

    def cancelled(output: ca.SX) -> ca.SX:
        tape = Tape.of(inputs, [output])
        if not tape.uses("sign"):
            return output
        try:
            _, (matrix,) = evaluate(tape, names, values, signs=True)
            found = ca.SX(*output.shape)
            for (i, j), entry in matrix.entries.items():
                found[i, j] = to_sx(entry, symbols, number)
        except (UnsupportedOperation, ZeroDivisionError):
            return output
        return found

    return [cancelled(ca.SX(output)) for output in outputs]
