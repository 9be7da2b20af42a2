"""Functions with moduli |a|: which of them vanish on regions, and derivatives that are continuous where a = 0.

CasADi writes the derivative of |a| as sign(a). In a derivative of a Lipschitz function it is read as ``|a| / a`` here
and what can be cancelled is cancelled, as in ``(v |v|)' = |v| + v sign(v) = 2 |v|``. Where the denominator of the
result vanishes nowhere near a point, the derivative continues continuously there, and is the derivative there too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING

import casadi as ca
from flint import fmpq_mpoly

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.tape import Tape

if TYPE_CHECKING:
    from pbcgen.symbolic.field import Field

#: Functions with as many moduli are taken to vanish on a region.
_MOST = 7


def vanishes_on_region(field: Field, polynomial: fmpq_mpoly) -> bool:
    """Whether a polynomial, as v + |v| does, may vanish on a region.

    It does where its product with itself for the other sign of a modulus does, which is free of that modulus; a modulus
    inside of another one comes before it.
    """
    norm, generators = polynomial, field.context.gens()
    for _ in range(_MOST):
        degrees = norm.degrees()
        inside = [k for k in field.moduli if degrees[k]]
        if not inside:
            return bool(norm.is_zero())
        last = max(inside)
        flipped = [-g if k == last else g for k, g in enumerate(generators)]
        norm = field.reduced(norm * norm.compose(*flipped, ctx=field.context))
    return True


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
    from pbcgen.symbolic.field import evaluate

    result = []
    symbols = [s for column in inputs if column.numel() for s in ca.vertsplit(ca.SX(column))]
    for output in map(ca.SX, outputs):
        tape = Tape.of(inputs, [output])
        found = output
        if tape.uses("sign"):
            try:
                field, (matrix,) = evaluate(tape, names, values, signs=True)
                found = ca.SX(*output.shape)
                for (i, j), entry in matrix.entries.items():
                    found[i, j] = field.to_sx(entry, symbols, number)
            except (UnsupportedOperation, ZeroDivisionError):
                found = output
        result.append(found)
    return result
