"""Formulas as SymPy expressions agree with the graphs that they come from, and stay readable."""

import random

import casadi as ca
import pytest
import sympy

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
    assert shown == r"\frac{R_{2} x_{1}}{R_{1} + R_{2}}"


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
