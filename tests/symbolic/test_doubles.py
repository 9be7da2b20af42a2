"""Functions of arrays give what CasADi gives, with structural zeros, at one point and at many."""

import casadi as ca
import numpy as np

from pbcgen.symbolic.doubles import Doubles


def _example():
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    outputs = [ca.sin(x[0]) * u[1], ca.diag(x), ca.jacobian(x * x[1], x), ca.SX(2, 0), ca.SX(1, 2)]
    return [x, u], outputs


def test_the_values_are_those_of_casadi_and_stay_when_it_is_called_again():
    inputs, outputs = _example()
    function, reference = Doubles(inputs, outputs), ca.Function("reference", inputs, outputs)
    at = [([1.0, -2.0, 0.5], [3.0, 4.0]), (np.array([0.0, np.nan, 1e300]), np.array([-1.0, np.inf]))]
    found = [function(*point) for point in at]
    for values, point in zip(found, at, strict=True):
        for value, expected in zip(values, reference(*point), strict=True):
            np.testing.assert_array_equal(value, np.array(ca.densify(expected)))


def test_many_points_give_what_each_of_them_gives():
    inputs, outputs = _example()
    function = Doubles(inputs, outputs)
    x, u = np.random.default_rng(0).normal(size=(7, 3)), np.random.default_rng(1).normal(size=(7, 2))
    for values, *each in zip(function.many(x, u), *(function(*pair) for pair in zip(x, u, strict=True)), strict=True):
        np.testing.assert_array_equal(values, np.array(each))


def test_a_function_of_nothing_may_have_inputs_without_entries():
    function = Doubles([ca.SX.sym("x", 0), ca.SX.sym("y")], [ca.SX(2)])
    assert function([], [1.0])[0].tolist() == [[2.0]]
