"""Radial unboundedness: which storages grow in every direction, and which must not be called so."""

from fractions import Fraction

import casadi as ca
import pytest
from flint import fmpq

from pbcgen import AffineSystem, Circuit
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.unbounded import radially_unbounded

x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))


def _grows(S, gamma=x, alpha="3", kappa="1"):
    plant = Plant(AffineSystem([x, y], [u], [-x, -y], [1, 0], S))
    return radially_unbounded(plant, ca.SX(gamma), [Fraction(alpha)], [fmpq(1) * int(kappa)], False).proved


GROWING = {
    "definite form": (x**2 + x * y + y**2,),
    "bounded terms": (x**2 + y**2 + 5 * ca.cos(x * y) + 3 * ca.tanh(x),),
    "terms of linear growth beside a definite form": (x**2 + y**2 + 9 * x * ca.tanh(y) - 4 * y * ca.sin(x),),
    "the square of linear plus bounded": ((x + ca.tanh(x)) ** 2 + (y - x - 2 * ca.tanh(y)) ** 2,),
    "nonnegative terms": (x**2 + y**2 + y**4 + ca.exp(x),),
    "ln cosh where S does not grow": (y**2, x, "3", "1"),
}
FLAT = {
    "a direction without growth": (x**2,),
    "an indefinite form": (x**2 + 3 * x * y + y**2,),
    "growth of the bounded kind only": (ca.sin(x) + ca.tanh(y) ** 2,),
    "linear growth beside a semidefinite form": (y**2 + x * ca.tanh(x) - 9 * x * ca.tanh(y), x, "3", "1"),
    "a quadratic term with a bounded factor": (x**2 + y**2 - 5 * x**2 * ca.tanh(y),),
    "a cubic term": (x**2 + y**2 + x**3,),
    "alpha equal to kappa": (y**2, x, "1", "1"),
    "alpha below kappa": (y**2, x, "1", "2"),
    "alpha below the slope of S": (y**2 + 4 * x, x, "3", "0"),
    "an exponential term with a sign": (x**2 + y**2 - ca.exp(x),),
    "gamma not affine": (x**2 + y**2, x**3),
}


@pytest.mark.parametrize("name", GROWING)
def test_a_storage_that_grows_everywhere_is_proved(name):
    assert _grows(*GROWING[name])


@pytest.mark.parametrize("name", FLAT)
def test_a_storage_that_may_not_grow_is_not_proved(name):
    assert not _grows(*FLAT[name])


def _circuit(**changes):
    i, v = ca.SX.sym("i"), ca.SX.sym("v")
    parts = {"v_R": [2 * i], "i_G": [v + ca.tanh(v)], "Gamma": [[1]], **changes}
    return Plant(Circuit([i], [v], L=[1], C=[1], g_L=[-1], inputs=["e"], **parts).system), i, v


def test_a_circuit_grows_with_the_gamma_of_its_output_only():
    plant, i, _ = _circuit()
    circuit = plant.system.circuit
    gamma = -ca.mtimes(circuit.g_tilde.T, ca.mtimes(circuit.Xi, circuit.P_gradient))
    assert radially_unbounded(plant, gamma, [Fraction(1)], [fmpq(9)], False).proved
    assert not radially_unbounded(plant, gamma - ca.exp(i), [Fraction(1)], [fmpq(9)], False).proved
