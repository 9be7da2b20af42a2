import math

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Mechanical, ModelError, Parameters


@pytest.fixture
def parts():
    """A spring with friction."""
    p = Parameters(k=2, d="0.5")
    x, v, u = ca.SX.sym("x"), ca.SX.sym("v"), ca.SX.sym("u")
    return {
        "x": [x, v],
        "u": [u],
        "f": [v, -p.k * x - p.d * v],
        "g": [0, 1],
        "S": p.k * x**2 / 2 + v**2 / 2,
        "parameters": p,
    }


def test_a_system_knows_its_sizes_names_and_derivative(parts):
    system = AffineSystem(**parts, units={"x": "m", "u": "N"}, domain={"v": (None, "1.5")}, name="spring")
    assert (system.n, system.m) == (2, 1)
    assert (system.state_names, system.input_names, system.measured_names) == (("x", "v"), ("u",), ("x", "v"))
    assert system.units == {"x": "m", "u": "N"}
    assert system.domain["v"][0] is None
    assert system.domain["v"][1] == 1.5
    assert system.lower() is system
    xdot = ca.Function("xdot", [system.x, system.u, system.parameters.symbols], [system.xdot])
    np.testing.assert_allclose(np.array(xdot([1, 2], 3, [2, 0.5])).ravel(), [2, 0.0])


def test_columns_and_lists_mean_the_same(parts):
    x = ca.vertcat(*parts["x"])
    system = AffineSystem(**{**parts, "x": x, "f": ca.vertcat(*parts["f"]), "g": ca.SX([[0], [1]])})
    assert system.state_names == ("x", "v")


def test_names_of_a_vector_symbol_are_numbered():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    assert AffineSystem(x, u, -x, [0, 1], ca.sumsqr(x)).state_names == ("x_0", "x_1")


def test_measured_names_and_expressions_mix(parts):
    x, v = parts["x"]
    system = AffineSystem(**parts, measured=["v", {"shifted": x + 1}])
    assert system.measured_names == ("v", "shifted")
    assert ca.is_equal(system.measured_expressions, ca.vertcat(v, x + 1), 2)
    assert AffineSystem(**parts, measured={"shifted": x + 1}).measured_names == ("shifted",)
    assert AffineSystem(**parts, measured="v").measured_names == ("v",)


Y = ca.SX.sym("y")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (lambda s: {"f": [s["f"][0]]}, "drift f must be 2x1, it is 1x1"),
        (lambda s: {"g": [[0, 1]]}, "input matrix g must be 2x1, it is 1x2"),
        (lambda s: {"g": [[0, 1], [1]]}, "g has rows of different lengths"),
        (lambda s: {"S": s["f"]}, "storage S must be 1x1, it is 2x1"),
        (lambda s: {"S": s["S"] + s["u"][0]}, "storage S depends on the input `u`"),
        (lambda s: {"f": [s["u"][0], 0]}, "drift f depends on the input `u`"),
        (lambda s: {"g": [s["u"][0], 1]}, "input matrix g depends on the input `u`"),
        (lambda s: {"f": [Y, 0]}, "drift f contains the symbol `y`"),
        (lambda s: {"parameters": Parameters()}, "symbol `[kd]`, which is neither"),
        (lambda s: {"parameters": {"k": 1}}, "parameters is a dict"),
        (lambda s: {"S": None}, "storage S is missing"),
        (lambda s: {"S": "x"}, "storage S contains the text 'x'"),
        (lambda s: {"S": 0}, "storage S does not depend on the state"),
        (lambda s: {"S": s["S"] * math.nan}, "storage S contains a constant that is not a finite number"),
        (lambda s: {"f": [s["x"][1], s["x"][0] / 0]}, r"entry \(2, 1\) of the drift f"),
        (lambda s: {"f": ca.MX.sym("f", 2)}, "drift f is a casadi.MX"),
        (lambda s: {"x": ca.MX.sym("x", 2)}, "state x is a casadi.MX"),
        (lambda s: {"x": [s["x"][0], 2 * s["x"][1]]}, "every entry must be a symbol"),
        (lambda s: {"x": [s["x"][0], s["x"][0]]}, "state x contains the symbol `x` twice"),
        (lambda s: {"x": [ca.SX.sym("x"), ca.SX.sym("x")], "f": [0, 0], "S": 0}, "name `x` is used twice"),
        (lambda s: {"u": [ca.SX.sym("x")]}, "name `x` is used twice"),
        (lambda s: {"u": [ca.SX.sym("k")]}, "name `k` is used twice"),
        (lambda s: {"u": [ca.SX.sym("a b")]}, "name `a b` is no identifier"),
        (lambda s: {"u": []}, "input u is empty"),
        (lambda s: {"u": ca.SX.sym("u", 3)}, "3 inputs and only 2 states"),
        (lambda s: {"measured": ["w"]}, "signal `w` is not a state: known are `x`, `v`"),
        (lambda s: {"measured": ["vv"]}, "did you mean `v`"),
        (lambda s: {"measured": []}, "nothing is measured"),
        (lambda s: {"measured": ["x", "x"]}, "`x` is measured twice"),
        (lambda s: {"measured": [3]}, "contains 3"),
        (lambda s: {"measured": {"y": s["u"][0]}}, "signal `y` depends on the input `u`"),
        (lambda s: {"measured": {"x": s["x"][1]}}, "`x` has the name of a state"),
        (lambda s: {"measured": {"k": s["x"][1]}}, "name `k` is used twice"),
        (lambda s: {"domain": {"z": (0, 1)}}, "domain bounds `z`"),
        (lambda s: {"domain": {"x": (1, 1)}}, "domain of `x` is empty"),
        (lambda s: {"domain": {"x": (0, math.inf)}}, "upper bound of the domain of `x` is inf"),
        (lambda s: {"domain": {"x": 3}}, r"domain of `x` is 3: a pair"),
        (lambda s: {"measured": 3}, "`measured` is 3: names of states"),
        (lambda s: {"domain": [(0, 1)]}, r"domain is \[\(0, 1\)\]: a dict by name"),
        (lambda s: {"units": ["m"]}, r"units is \['m'\]: a dict by name"),
        (lambda s: {"units": {"w": "m"}}, "units names `w`"),
        (lambda s: {"units": {"x": 1}}, "unit of `x` is 1"),
        (lambda s: {"gamma": s["x"]}, "gamma must be 1x1, it is 2x1"),
        (lambda s: {"gamma": s["u"][0]}, "gamma depends on the input `u`"),
        (lambda s: {"eta": [[1, 2], [3, 4]]}, "eta must be 2x1, it is 2x2"),
    ],
)
def test_a_bad_system_is_refused_by_name(parts, changes, message):
    with pytest.raises(ModelError, match=message):
        AffineSystem(**{**parts, **changes(parts)})


def test_a_system_does_not_change(parts):
    system = AffineSystem(**parts)
    with pytest.raises(AttributeError):
        system.S = ca.SX(0)
    with pytest.raises(TypeError):
        system.measured["y"] = ca.SX(0)


def _stiff_energy(q, K, w):
    """Its Hessian has K - w, which is K in double precision for K = 1e13, w = 9e-4: a verdict on it would be wrong."""
    return K * (q[0] - q[1]) ** 2 / 2 - w * q[1] ** 2 / 2


def test_numbers_that_casadi_would_lose_in_a_sum_become_parameters():
    q, u = ca.SX.sym("q", 2), ca.SX.sym("u")
    system = AffineSystem(q, [u], -q, [1, 0], _stiff_energy(q, 1e13, 9e-4))
    assert sorted(map(float, system.parameters.values.values())) == [9e-4, 1e13]
    constants = Parameters(K="1e13", w="9e-4")
    energy = _stiff_energy(q, constants.K, constants.w)
    assert AffineSystem(q, [u], -q, [1, 0], energy, parameters=constants).parameters.names == ("K", "w")


def test_numbers_in_the_potential_energy_become_parameters():
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    V = _stiff_energy(q, 1e13, 9e-4) + ca.cos(q[0]) ** 0.3 + 3 * q[1] / 4
    system = Mechanical(q, p, M=ca.SX.eye(2), V=V, D=[1000, 1000], G=[[1], [0]]).system
    assert sorted(map(float, system.parameters.values.values())) == [9e-4, 0.3, 1e13]
    function = ca.Function("V", [q, ca.SX(system.parameters.symbols)], [system.mechanical.V])
    at = [0.25, -0.5]
    assert float(function(at, system.parameters.numeric)) == pytest.approx(float(ca.Function("V", [q], [V])(at)))
