"""Formulas as SymPy expressions agree with the graphs that they come from, and stay readable."""

import random

import casadi as ca
import numpy as np
import pytest
import sympy
from graphs import BINARY, POINTS, UNARY, graphs
from hypothesis import given, settings

from pbcgen.errors import UnsupportedOperation
from pbcgen.examples import names
from pbcgen.models.loader import load
from pbcgen.passivity.plant import Plant
from pbcgen.symbolic.sympy_form import TooLarge, from_function, from_sx, latex, name_as_latex


@pytest.mark.parametrize("name", names())
def test_the_storage_has_the_value_of_its_graph(name):
    plant = Plant(load(name).system)
    (row,) = from_sx(plant.system.S, plant.symbols, largest=1000)
    values = {n: random.Random(n).uniform(0.5, 1.5) for n in plant.names}
    found = float(row[0].subs({sympy.Symbol(n, real=True): v for n, v in values.items()}))
    function = ca.Function("S", list(plant.symbols), [plant.system.S])
    sizes = [s.numel() for s in plant.symbols]
    numbers = iter(values.values())
    expected = float(function(*[[next(numbers) for _ in range(size)] for size in sizes]))
    assert found == pytest.approx(expected, rel=1e-9)


def test_an_exact_function_groups_states_with_factored_coefficients():
    plant = Plant(load("coupling_device").system)
    p, x = plant.system.parameters, plant.system.x
    field, (value,) = plant.exact(p.R2 * x[0] / (p.R1 + p.R2), symbolic=True)
    shown = latex(from_function(value.scalar(field.const(0)), plant.parameter_positions()))
    assert shown == r"\frac{R_{2}\,x_{1}}{R_{1} + R_{2}}"


def test_a_formula_that_explodes_is_not_written_out():
    x = ca.SX.sym("x")
    y = x
    for _ in range(60):
        y = y * y + y  # 60 instructions, more than 2^60 operations as a tree
    ((found,),) = from_sx(y, [x])
    assert isinstance(found, TooLarge)
    assert found.operations > 2**60
    assert "more than 10^" in latex(found)


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("x1", "x_{1}"),
        ("alpha_c", r"\alpha_{c}"),
        ("u", "u"),
        ("link", r"\text{link}"),
        ("link_momentum", r"\text{link}_{\text{momentum}}"),
        ("m_3", "m_{3}"),
    ],
)
def test_names_read_as_in_a_paper(name, shown):
    assert name_as_latex(name) == shown


def test_decimals_stay_decimals_and_halves_stay_halves():
    x = ca.SX.sym("x")
    ((found,),) = from_sx(9.81 * x + x / 2, [x])
    assert "9.81" in latex(found) or "10.31" in latex(found)
    ((half,),) = from_sx(x**2 / 2, [x])
    assert latex(half) == r"\frac{x^{2}}{2}"


def _sympy_value(expression, symbols, point):
    """The value by SymPy in doubles; None where SymPy has no counterpart of an operation, or no real value."""
    try:
        ((formula,),) = from_sx(expression, [symbols])
    except UnsupportedOperation:
        return None
    assert not isinstance(formula, TooLarge)
    names = [sympy.Symbol(entry.name(), real=True) for entry in ca.vertsplit(symbols)]
    try:
        value = formula.subs(dict(zip(names, map(sympy.Rational, map(str, point)), strict=True)))
        value = sympy.Integer(int(value == sympy.true)) if value in (sympy.true, sympy.false) else sympy.N(value, 30)
    except (TypeError, ValueError):  # a comparison of what is not real, a function beyond its domain
        return None
    return float(value) if value.is_real else None


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_an_operation_has_the_value_of_casadi_or_is_named(name):
    x = ca.SX.sym("x", 2)
    expression = UNARY[name](x[0]) if name in UNARY else BINARY[name](x[0], x[1])
    for point in (("3/10", "2/5"), ("17/10", "-3/4"), ("-7/4", "-5/4")):
        values = [float(sympy.Rational(v)) for v in point]
        expected, found = float(ca.Function("f", [x], [expression])(values)), _sympy_value(expression, x, point)
        if found is not None and np.isfinite(expected):
            assert found == pytest.approx(expected, rel=1e-6 if name == "erfinv" else 1e-12)


def test_what_sympy_has_no_name_for_is_named():
    x = ca.SX.sym("x", 2)
    with pytest.raises(UnsupportedOperation, match=r"`copysign` has no meaning in SymPy"):
        from_sx(ca.copysign(x[0], x[1]), [x])


@settings(max_examples=25, deadline=None)
@given(graphs({k: v for k, v in UNARY.items() if k != "erfinv"}, BINARY, size=5))
def test_a_graph_has_the_value_of_casadi_in_sympy_too(case):
    symbols, expression = case
    for point in POINTS[:1]:
        expected = float(ca.Function("f", [symbols], [expression])([float(v) for v in point]))
        found = _sympy_value(expression, symbols, point)
        if found is not None and np.isfinite(expected):
            assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_symbol_that_stands_for_a_number_is_shown_as_the_number():
    c, x = ca.SX.sym("(1/100)"), ca.SX.sym("x")
    assert latex(from_sx(c * x, [c, x])[0][0]) == r"0.01\,x"
