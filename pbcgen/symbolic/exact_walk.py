"""Tapes walked over exact rational functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.field import Field, Quotient, Restart
from pbcgen.symbolic.tape import Matrix, Tape

#: Terms that one evaluation of a tape may multiply, and as many more for each of its instructions. What is made of
#: its results may take as many again.
_BUDGET = 200_000
_BUDGET_PER_INSTRUCTION = 100


def evaluate(
    tape: Tape, names: Sequence[str], values: Mapping[str, Fraction] | None = None, signs: bool = False
) -> tuple[Field, list[Matrix[Quotient]]]:
    """Walk a tape over exact rational functions.

    Args:
        tape: the outputs wanted; its inputs, taken together, are the symbols ``names``.
        names: one name for each input of the tape, in order.
        values: symbols to replace by exact numbers.
        signs: whether sign(a) is read as |a| / a; the caller answers for the results being continuous.

    Returns:
        The field and the outputs as matrices of its elements.

    Raises:
        UnsupportedOperation: for operations that are not algebraic or analytic (if_else, fmin, ...).
        TooLarge: when the functions grow beyond a budget of terms, which is an UnsupportedOperation too.
        ZeroDivisionError: for a division by the zero function.
    """
    values = values or {}
    pool, scales, spent = 8, {}, 0  # type: int, dict[tuple[str, str], Fraction], int
    allowance = _BUDGET + _BUDGET_PER_INSTRUCTION * len(tape.instructions)
    for _ in range(200):
        field = Field(names, pool, scales, signs)
        field.spent, field.limit = spent, allowance
        symbols = [field.const(values[n]) if n in values else field.symbol(k) for k, n in enumerate(names)]
        try:
            outputs = tape.walk(field, _split(symbols, tape.input_sizes))
        except Restart:
            pool, scales, spent = field.pool, field.scales, field.spent
            continue
        field.spent = 0
        return field, outputs
    raise UnsupportedOperation("the model's transcendental terms have too many incommensurable arguments")


def _split(values: Sequence[Quotient], sizes: Sequence[int]) -> list[list[Quotient]]:
    """Cut a flat list into pieces of the given sizes."""
    pieces, start = [], 0
    for size in sizes:
        pieces.append(list(values[start : start + size]))
        start += size
    return pieces
