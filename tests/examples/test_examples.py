"""The reference designs say what the paper says, and the tutorial's threshold is that of its comment."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen import ModelError, examples
from pbcgen.models.loader import load


def _value(expression, system, x, u=()):
    function = ca.Function("e", [system.x, system.u, system.parameters.symbols], [ca.densify(expression)])
    return np.array(function(x, u if len(u) else np.zeros(system.m), system.parameters.numeric))


@pytest.mark.parametrize("name", examples.names())
def test_every_example_is_described_in_one_line(name):
    assert 20 < len(examples.description(name)) < 120
    assert examples.path(name).read_text(encoding="utf-8").startswith('"""')


@pytest.mark.parametrize("name", examples.names())
def test_every_example_says_units_limits_and_a_sentence(name):
    design = load(name)
    assert set(design.system.units) == {*design.system.state_names, *design.system.input_names}
    assert design.limits is not None
    assert design.description


def test_an_unknown_example_comes_with_a_suggestion():
    with pytest.raises(ModelError, match="did you mean `pera`"):
        examples.path("perra")


def test_the_coupling_device_dissipates_as_printed():
    """(dSe1), with x' taken along the trajectories for random x and u."""
    system = load("coupling_device").system
    R1, R2, a0, a1, a2, a3, m2 = 100, 100, 0.005, 6e-4, 8e-5, 40, 0.015
    generator = np.random.default_rng(1)
    for _ in range(5):
        x, u = generator.normal(size=5) * 1e-2, generator.normal(size=1)
        xdot = _value(system.xdot, system, x, u).ravel()
        power = float(np.dot(_value(ca.gradient(system.S, system.x), system, x).ravel(), xdot))
        y = R2 / (R1 + R2) * xdot[0] + xdot[1] / (a0 * (R1 + R2))
        friction = (a1 * xdot[2] + a2 * np.tanh(m2 * a3 * xdot[2])) * xdot[2]
        expected = -R1 * R2 / (R1 + R2) * xdot[0] ** 2 - xdot[1] ** 2 / (a0**2 * (R1 + R2)) - friction + y * u[0]
        np.testing.assert_allclose(power, expected, rtol=1e-9)


def test_the_coupling_device_has_the_gains_of_the_paper():
    design = load("coupling_device")
    law = design.law.resolve(1, 1)
    assert (law.alpha_c, law.beta_c, law.K_c, law.R_c) == ((2.5,), (450,), ((10**6,),), ((Fraction(3, 10),),))
    assert (law.alpha_l, law.beta_l, law.R_l, law.Upsilon) == ((2.5,), (2 * 10**6,), ((33,),), ((1,),))
    assert law.K_l == ((Fraction(55, 100000),),)
    assert design.input_set.intervals == ((-5, 5),)
    assert design.system.measured_names == ("x1", "x2", "x3")


def test_the_rlc_rests_where_its_source_touches_the_limit():
    design = load("rlc")
    assert design.target.conditions[0].value + design.law.alpha[0] == Fraction("3.1")
    assert design.input_set.intervals == ((0, Fraction("3.1")),)
    x3 = 3.0515
    x2 = x3 / 100
    rest = [x2 + 1e-7 * (np.exp(x3 / 0.25) - 1), x2, x3]
    np.testing.assert_allclose(_value(design.system.xdot, design.system, rest, [x3]), 0, atol=1e-9)


@pytest.mark.parametrize("name", ["pera", "pera_integral"])
def test_the_robot_arm_is_the_printed_one(name):
    design = load(name)
    parts = design.system.mechanical
    q = np.array([0.3, 1.1, -0.4])
    M = _value(parts.M, design.system, [*q, 0, 0, 0])
    first = 0.0054 + 0.0768 + 0.00211 + 0.16**2 * np.sin(1.1) ** 2
    pitch = 0.0768 + 0.00211 + 0.16**2
    cross = 0.00211 * np.cos(1.1)
    np.testing.assert_allclose(M, [[first, 0, cross], [0, pitch, 0], [cross, 0, 0.00211]])
    gradient = _value(ca.gradient(parts.V, parts.q), design.system, [*q, 0, 0, 0])
    np.testing.assert_allclose(gradient.ravel(), [0, 9.81 * 0.16 * np.sin(1.1), 0])
    assert design.target.full is not None
    assert [float(value) for value in design.target.full] == [-1.81, np.pi / 2, 0.78, 0, 0, 0]
    limits = design.input_set
    assert (len(limits.A), set(limits.b)) == (6, {Fraction("17.1007"), Fraction("7.901")})
    assert design.system.measured_names == ("q1", "q2", "q3")


@pytest.mark.parametrize("name", ["pera", "pera_integral"])
def test_the_arm_has_the_friction_that_its_comment_states(name):
    design = load(name)
    D = _value(design.system.mechanical.D, design.system, np.zeros(6))
    np.testing.assert_allclose(D, np.diag([5, 1, 0.2]))


@pytest.mark.parametrize(("factor", "stands"), [(0.999, False), (1.001, True)])
def test_the_pendulum_stands_above_the_threshold_of_its_comment(factor, stands):
    """alpha beta > k m g l / (k - m g l), from the stiffness matrix at the upright rest."""
    system = load("elastic_pendulum").system
    gravity, k = 0.5 * 9.81 * 0.3, 6.0
    threshold = k * gravity / (k - gravity)
    assert threshold == pytest.approx(1.9497, abs=1e-4)
    parts = system.mechanical
    stiffness = _value(ca.hessian(parts.V, parts.q)[0], system, [0, 0, 0, 0]) + np.diag([0, factor * threshold])
    assert bool(np.linalg.eigvalsh(stiffness).min() > 0) is stands


def test_the_pendulum_design_is_above_the_threshold_with_its_filter():
    law = load("elastic_pendulum").law.resolve(1)
    shaped = law.alpha[0] * law.beta[0]
    assert shaped * law.K_c[0][0] / (shaped + law.K_c[0][0]) > Fraction("1.95")
