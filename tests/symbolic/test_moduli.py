"""Moduli in exact functions: |a|^2 = a^2, derivatives that are continuous, and nothing is divided by v + |v|."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.continued import continued
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.tape import Tape

V, W = ca.SX.sym("v"), ca.SX.sym("w")


def _is_zero(expression, signs=False):
    field, (values,) = evaluate(Tape.of([V, W], [expression]), ["v", "w"], None, signs)
    return values.scalar(field.const(0)).is_zero()


@pytest.mark.parametrize(
    "expression",
    [
        ca.fabs(V) ** 2 - V**2,
        ca.fabs(W - V) - ca.fabs(V - W),
        ca.fabs(-3 * V) - 3 * ca.fabs(V),
        ca.fabs(V / W) * ca.fabs(W) - ca.fabs(V),
        1 / ca.fabs(V) - ca.fabs(V) / V**2,
        ca.fabs(ca.SX(-2)) - 2,
    ],
)
def test_relations_of_moduli_hold(expression):
    assert _is_zero(expression)


@pytest.mark.parametrize("expression", [ca.fabs(V) - V, ca.fabs(V + W) - ca.fabs(V) - ca.fabs(W), ca.fabs(V) + V])
def test_what_holds_on_a_region_only_is_no_identity(expression):
    assert not _is_zero(expression)


@pytest.mark.parametrize(
    ("function", "slope"),
    [
        (V * ca.fabs(V), 2 * ca.fabs(V)),
        (ca.fabs(V) ** 3, 3 * V * ca.fabs(V)),
        ((V - W) * ca.fabs(W - V), 2 * ca.fabs(V - W)),
        (ca.sin(V) * ca.fabs(V), ca.cos(V) * ca.fabs(V) + ca.sin(V) * ca.fabs(V) / V),
    ],
)
def test_derivatives_are_read_with_the_sign_as_a_quotient(function, slope):
    assert _is_zero(ca.jacobian(function, V) - slope, signs=True)


def test_signs_are_read_where_that_is_asked_for_only():
    with pytest.raises(UnsupportedOperation, match="sign"):
        _is_zero(ca.jacobian(V * ca.fabs(V), V))


@pytest.mark.parametrize(
    "divisor",
    [
        V + ca.fabs(V),
        V - ca.fabs(V),
        ca.fabs(V + ca.fabs(W)) - V - W,
        (V + ca.fabs(V)) * W,
        ca.fabs(V + W) - ca.fabs(V) - ca.fabs(W),
    ],
)
def test_nothing_is_divided_by_a_function_that_vanishes_on_a_region(divisor):
    with pytest.raises(UnsupportedOperation, match="vanishes on a region"):
        _is_zero(W / divisor)


@pytest.mark.parametrize("divisor", [2 * V + ca.fabs(V), 1 + ca.fabs(V), ca.fabs(V) + ca.fabs(W), W + ca.fabs(V)])
def test_other_divisors_with_moduli_are_kept(divisor):
    assert _is_zero(W / divisor * divisor - W)


def test_a_derivative_is_written_without_signs_where_it_is_continuous():
    smooth, kinked = continued(
        [ca.jacobian(V * ca.fabs(V), V), ca.jacobian(ca.fabs(V), V)],
        [V, W],
        ["v", "w"],
        {},
        lambda c, _: ca.SX(float(c)),
    )
    values = ca.Function("f", [V], [smooth, kinked])
    assert float(values(-0.5)[0]) == 1
    assert not Tape.of([V], [smooth]).uses("sign")
    assert float(values(-0.5)[1]) == -1
