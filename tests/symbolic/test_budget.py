"""Exact functions that grow too large are given up, always at the same place."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.field import TooLarge
from pbcgen.symbolic.tape import Tape


def power_of_a_sum(exponent: int) -> Tape:
    """(x_0 + ... + x_9)^exponent by repeated multiplication."""
    x = ca.SX.sym("x", 10)
    total = ca.sum1(x)
    product = total
    for _ in range(exponent - 1):
        product = product * total
    return Tape.of([x], [product])


NAMES = [f"x{k}" for k in range(10)]


def test_swelling_expressions_are_too_large() -> None:
    with pytest.raises(TooLarge):
        evaluate(power_of_a_sum(40), NAMES)


def test_small_powers_are_expanded() -> None:
    _, (value,) = evaluate(power_of_a_sum(3), NAMES)
    assert len(value.entries[0, 0].numerator) == 220


def test_too_large_is_an_unsupported_operation() -> None:
    assert issubclass(TooLarge, UnsupportedOperation)


def test_what_is_made_of_the_results_is_counted_too() -> None:
    field, (value,) = evaluate(power_of_a_sum(3), NAMES)
    element = value.entries[0, 0]
    square = element * element
    with pytest.raises(TooLarge):
        square * square
    assert field.limit is not None
    assert field.spent > field.limit
