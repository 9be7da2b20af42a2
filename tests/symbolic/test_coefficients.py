"""Functions brought to one denominator: polynomials in the same proportion, with the relations between atoms."""

import casadi as ca
import pytest

from pbcgen.symbolic.coefficients import cleared, common_denominator
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.tape import Tape

X, Y = ca.SX.sym("x"), ca.SX.sym("y")


@pytest.mark.parametrize(
    "functions",
    [
        [X, Y, X * Y + 1],
        [1 / X, 1 / X**2, Y / (X * (1 + Y**2))],
        [1 / ca.cosh(X), ca.tanh(X), ca.exp(-X) * Y],
        [ca.sin(X) / ca.cos(X), ca.sin(X) * ca.cos(X), 1 / ca.cos(X) ** 2],
        [0 * X, 1 / (X + Y), 0 * X],
    ],
)
def test_cleared_functions_keep_their_proportion(functions):
    field, (values,) = evaluate(Tape.of([X, Y], [ca.vertcat(*functions)]), ["x", "y"])
    column = values.column(field.const(0))
    common, polynomials = common_denominator(field, column), cleared(field, column)
    assert not common.is_zero()
    assert all(
        (value * common - field.polynomial(entry)).is_zero() for value, entry in zip(column, polynomials, strict=True)
    )


def test_relations_between_atoms_are_applied():
    """(sin^2 + cos^2) (1 + x) / (1 + x) is one, whatever the common denominator was multiplied with."""
    functions = ca.vertcat(ca.sin(X) ** 2 / (1 + X**2), ca.cos(X) ** 2 / (1 + X**2), 1 / (1 + X**2))
    field, (values,) = evaluate(Tape.of([X, Y], [functions]), ["x", "y"])
    first, second, third = cleared(field, values.column(field.const(0)))
    assert first + second == third
