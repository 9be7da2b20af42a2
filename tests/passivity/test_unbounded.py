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
    "two wells": (x**4 - 3 * x**2 + y**2,),
    "a product that a fourth power outgrows": (x**4 + y**2 - 5 * x * y - 7 * x,),
    "a stiffening coupling": ((x - y) ** 4 + (x - y) ** 2 + y**2,),
    "a stiffening coupling, and ln cosh": ((x - y) ** 4 - (x - y) ** 2, x, "3", "1"),
    "a sixth power with a bounded factor below it": (x**6 + y**2 + 9 * x**3 * ca.tanh(y),),
    "a cubic gamma with enough alpha": (x**2 + y**2, x**3),
    "a cubic gamma where S does not grow": (y**2, x + x**3, "3", "1"),
    "a gamma that tilts": (y**2, x + y + ca.sin(x) / 2, "3", "1"),
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
    "a cubic gamma with too little alpha": (x**2 + y**2, x**3, "1", "2"),
    "a cubic gamma, and alpha equal to kappa where S does not grow": (y**2, x + x**3, "1", "1"),
    "a bounded gamma": (y**2, ca.tanh(x), "3", "1"),
    "a gamma that grows on one side": (y**2, ca.exp(x), "3", "1"),
    "a gamma that turns": (y**2, x * y + x, "3", "1"),
    "a linear term that a cubic gamma may not outgrow": (y**2 + 4 * x, x + x**3, "3", "1"),
    "a valley along an axis": (x**2 * y**2 + x**2,),
    "a bent valley": ((x * y - 1) ** 2 + x**2,),
    "a fourth power with a sign": (x**4 - 3 * x**2 * y**2 + y**4,),
    "a fourth power of a difference": ((x - y) ** 4, x - y, "3", "1"),
    "an exponential on one side": (ca.exp(x) + y**2, x, "3", "4"),
    "a quotient that levels off": (x**2 + y**2 / (1 + y**2),),
    "a quotient that falls off": (x**2 + y**2 + x**4 / (1 + y**2) - x**4,),
    "a product that outgrows the square": (x**4 + y**2 - 5 * x**2 * y,),
}


@pytest.mark.parametrize("name", GROWING)
def test_a_storage_that_grows_everywhere_is_proved(name):
    assert _grows(*GROWING[name])


@pytest.mark.parametrize("name", FLAT)
def test_a_storage_that_may_not_grow_is_not_proved(name):
    assert not _grows(*FLAT[name])


@pytest.mark.parametrize(("first", "proved"), [("6", True), ("1", False)])
def test_an_affine_gamma_that_kappa_outgrows_is_not_made_up_for_by_another(first, proved):
    """On y = 0 there is ``alpha_1 |x| - 5 x`` and a second gamma that grows a thousand times slower."""
    plant = Plant(AffineSystem([x, y], [u, ca.SX.sym("v")], [-x, -y], [[1, 0], [0, 1]], y**2))
    gamma = ca.vertcat(x, x / 1000 + ca.sin(x) / 10000)
    grown = radially_unbounded(plant, gamma, [Fraction(first), Fraction(3)], [fmpq(5), fmpq(0)], False)
    assert grown.proved == proved


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
