import math
from decimal import Decimal
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pbcgen import ModelError, Parameters
from pbcgen.models.exact import decimal, exact


def test_values_are_the_decimals_that_were_written():
    p = Parameters(C="2.2e-4", R1=100, k=0.1, a=Decimal("0.25"), b=Fraction(1, 3), c="1/7", d=np.float64(0.3))
    assert p.values == {
        "C": Fraction(11, 50000),
        "R1": 100,
        "k": Fraction(1, 10),
        "a": Fraction(1, 4),
        "b": Fraction(1, 3),
        "c": Fraction(1, 7),
        "d": Fraction(3, 10),
    }
    np.testing.assert_array_equal(p.numeric, [2.2e-4, 100, 0.1, 0.25, 1 / 3, 1 / 7, 0.3])


def test_symbols_are_reached_by_attribute_and_by_key_in_the_order_of_declaration():
    p = Parameters(b=1, a=2)
    assert p.names == ("b", "a")
    assert ca.is_equal(p.b, p["b"])
    assert ca.is_equal(p.symbols, ca.vertcat(p.b, p.a))
    assert Parameters().symbols.shape == (0, 1)


@pytest.mark.parametrize(
    "value", [None, math.nan, math.inf, "nan", "inf", "ten", "", "1e999999999", "1e400", 1e300, "1e-300", True, [1]]
)
def test_a_value_that_is_no_number_names_the_parameter(value):
    with pytest.raises(ModelError, match="`R1`"):
        Parameters(R1=value)


@pytest.mark.parametrize("name", ["values", "symbols", "_x", "with_values"])
def test_a_reserved_name_is_refused(name):
    with pytest.raises(ModelError, match=f"`{name}`"):
        Parameters(**{name: 1})


def test_an_unknown_parameter_comes_with_a_suggestion():
    p = Parameters(R1=1)
    with pytest.raises(ModelError, match="`R11`: did you mean `R1`"):
        p["R11"]
    with pytest.raises(AttributeError, match="did you mean `R1`"):
        p.R11  # noqa: B018
    with pytest.raises(ModelError, match="`R11`"):
        p.with_values(R11=2)


def test_parameters_do_not_change():
    p = Parameters(R1=1)
    with pytest.raises(AttributeError, match="with_values"):
        p.R1 = 2
    p.values.get("R1")
    with pytest.raises(TypeError):
        p.values["R1"] = 2


def test_with_values_keeps_the_symbols():
    p = Parameters(R1=1, R2=2)
    q = p.with_values(R1="3.5")
    assert ca.is_equal(p.symbols, q.symbols)
    assert (p.values["R1"], q.values["R1"], q.values["R2"]) == (1, Fraction(7, 2), 2)


@given(st.floats(1e-100, 1e100) | st.floats(-1e100, -1e-100) | st.just(0.0))
def test_a_float_survives_the_way_through_the_exact_value(value):
    assert float(exact(value, "x")) == value
    assert exact(repr(value), "x") == exact(value, "x")


@given(st.fractions(min_value=-1000, max_value=1000))
def test_the_printed_form_denotes_the_number(value):
    assert exact(decimal(value), "x") == value
