"""Numbers that a user writes into expressions."""

from fractions import Fraction

import casadi as ca
import pytest

from pbcgen import AffineSystem, Circuit, Design, DynamicExtension, Mechanical, Parameters, check
from pbcgen.models.numbers import as_written, named_numbers


@pytest.mark.parametrize(
    ("number", "written"),
    [
        (0.1, "1/10"),
        (0.7 * 3, "21/10"),
        (0.1 + 0.2, "3/10"),
        (-2.43 * 3, "-729/100"),
        (0.37 * 1.23 * 1.1, "500610e-6"),
        (1e13, "1e13"),
        (2.2e-4, "11/50000"),
        (0.30000000000000054, "0.30000000000000054"),
        (0.1234567890123456, "0.1234567890123456"),
        (3.141592653589793, "3.141592653589793"),
        (0.7 / 3, "7/30"),
        (-2 / 3, "-2/3"),
        (1e-7 / 3, "1/30000000"),
        (1.3 * 1.7 * 0.9 / 11, "1989/11000"),
        (2**0.5, "1.4142135623730951"),
        (1e13 / 3, "3333333333333.3335"),
        (5e-324, "5e-324"),
        (0.0, "0"),
    ],
)
def test_a_product_of_short_numbers_is_read_as_it_was_written(number, written):
    assert as_written(number) == Fraction(written)


def test_expressions_share_parameters_and_keep_their_values():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    given = [0.7 * x + ca.cos(0.7 * y) - 3 * x**0.3, ca.SX(ca.DM([[0.7, 0], [0.25, -0.1]])) * y, ca.SX(2, 2)]
    found, parameters = named_numbers(given, "c", Parameters(c_1=5), taken=["c_2"])
    assert dict(parameters.values) == {
        "c_1": 5,
        "c_3": Fraction(7, 10),
        "c_4": Fraction(3, 10),
        "c_5": Fraction(1, 10),
    }
    assert [value.shape for value in found] == [value.shape for value in given]
    both = [ca.Function("f", [x, y, parameters.symbols], [v]) for v in (*given, *found)]
    values = [function(0.3, -0.4, parameters.numeric) for function in both]
    for before, after in zip(values[:3], values[3:], strict=True):
        assert float(ca.norm_fro(before - after)) < 1e-15
        assert before.sparsity() == after.sparsity()


def test_short_numbers_stay_numbers():
    x = ca.SX.sym("x")
    value = 3 * x**2 / 8 - 0.5 * x + 3 / x
    found, parameters = named_numbers([value], "c", Parameters())
    assert found[0] is value
    assert len(parameters) == 0


def test_what_is_divided_by_an_integer_keeps_it_as_a_parameter():
    """CasADi writes the slope of x^2/3 with the double next to 2/3."""
    x = ca.SX.sym("x")
    (found,), parameters = named_numbers([x**2 / 3 + x**2 / 4], "c", Parameters())
    assert dict(parameters.values) == {"c_1": 3}
    assert ca.depends_on(found, parameters.symbols)


def test_a_name_that_is_taken_is_not_used_twice():
    x, u = [ca.SX.sym("c_1"), ca.SX.sym("c_2")], ca.SX.sym("c_3")
    system = AffineSystem(x, [u], [x[1], -0.7 * x[1] - x[0]], [0, 1], x[0] ** 2 / 2 + x[1] ** 2 / 2)
    assert system.parameters.names == ("c_4",)


def test_every_front_end_names_its_numbers():
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    arm = Mechanical([q], [p], M=[[0.3 + 0.1 * ca.cos(q) ** 2]], V=0.7 * q**2, D=[0.2], G=[[0.9]], gamma=[0.9 * q])
    assert sorted(arm.system.parameters.values.values()) == [Fraction(k, 10) for k in (1, 2, 3, 7, 9, 9)]
    i, v = ca.SX.sym("i"), ca.SX.sym("v")
    circuit = Circuit([i], [v], L=[1.25], C=[0.1], Gamma=[[0.9]], v_R=[0.3 * i], i_G=[v / 20], g_L=[-1])
    assert {"L_1_1", "C_1_1", "Gamma_1", "v_R_1"} <= {*circuit.system.parameters}


def test_a_formula_shows_the_value_of_numbers_that_cancel():
    """S has 2/3 x^(3/2), and its slope 3/3 x^(1/2) in the symbols that keep the numbers."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    S = 2 * (x**2 + 1) ** 1.5 / 3
    system = AffineSystem([x], [u], [-2 * x * ca.sqrt(x**2 + 1)], [2], S)
    report = check(Design(system, {"x": 1}, DynamicExtension(1, 1, 1, 1), sample_period="1e-3"))
    assert report.derived["gamma"] == ["2*x"]
