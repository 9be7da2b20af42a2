"""Formulas as text: what a reader sees of a function."""

import math

import casadi as ca
import numpy as np
import pytest

from pbcgen.symbolic.display import formula
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.tape import Tape

X, A, B = ca.SX.sym("x"), ca.SX.sym("a"), ca.SX.sym("b")


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (X / 2, "0.5*x"),
        (A * X + B, "a*x + b"),
        ((A / 2) / (B / 2) * X, "a/b*x"),
        (A / (2 * B) * X, "0.5*a/b*x"),
        ((A + B) / (4 * A) * 2 * X, "0.5*(a + b)/a*x"),
        (-3 * A / (6 * B), "-0.5*a/b"),
        (A * X / (2 * X + 2), "0.5*a*x/(x + 1)"),
        (1234567 * A / (8 * B), "154320.875*a/b"),
        (0 * X, "0"),
        ((A + B) * X, "(a + b)*x"),
        (-(A + B) * X, "-(a + b)*x"),
        ((A + B) / 3 * X, "1/3*(a + b)*x"),
        (X / A, "x/a"),
        (A * X / (1 + X), "a*x/(x + 1)"),
    ],
)
def test_formulas_are_what_they_show(expression, text):
    field, (value,) = evaluate(Tape.of([ca.vertcat(X, A, B)], [ca.SX(expression)]), ["x", "a", "b"])
    assert formula(value.column(field.const(0))[0], parameters=[1, 2]) == text


def _random(generator, depth):
    if depth == 0:
        return [X, A, B, ca.SX(generator.integers(1, 9) / 2)][generator.integers(4)]
    one, two = _random(generator, depth - 1), _random(generator, generator.integers(depth))
    return [one + two, one - two, one * two, one / (two + 1 + A**2), -one, one**2, ca.sin(one)][generator.integers(7)]


@pytest.mark.parametrize("seed", range(150))
def test_a_formula_read_as_python_has_the_value_of_its_function(seed):
    generator = np.random.default_rng(seed)
    expression = ca.SX(_random(generator, 3))
    field, (value,) = evaluate(Tape.of([ca.vertcat(X, A, B)], [expression]), ["x", "a", "b"])
    text = formula(value.column(field.const(0))[0], parameters=[1, 2])
    point = generator.uniform(0.3, 1.7, 3)
    expected = float(ca.Function("f", [ca.vertcat(X, A, B)], [expression])(point))
    names = dict(zip("xab", point, strict=True))
    shown = eval(text.replace("^", "**"), {**vars(math), **names})
    assert shown == pytest.approx(expected, rel=1e-6, abs=1e-6), text
