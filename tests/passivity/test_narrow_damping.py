"""Damping that is negative only in a band of relative width 1e-4, or in a ball of relative volume 1e-9, anywhere."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

import casadi as ca
import pytest

from pbcgen import AffineSystem, Circuit, Mechanical
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.storage import assumption_1
from pbcgen.proof.claim import Status

#: Functions of scaled distances from the centre that are 1 there and almost 0 outside the unit ball or box.
SHAPES: dict[str, Callable[[Sequence[ca.SX]], ca.SX]] = {
    "bell": lambda z: ca.exp(-sum(v**2 for v in z)),
    "rational": lambda z: 1 / (1 + sum(v**2 for v in z)) ** 3,
    "hyperbolic": lambda z: 1 / ca.cosh(sum(v**2 for v in z)),
    "steps": lambda z: _product([(ca.tanh(6 * (v + 1)) - ca.tanh(6 * (v - 1))) / 2 for v in z]),
    "arctangents": lambda z: _product([(ca.atan(9 * (v + 1)) - ca.atan(9 * (v - 1))) / 2.9195 for v in z]),
}
#: Relative to the friction outside.
EXCESS = (0.01, 0.1, 0.5)


def _product(factors: Sequence[ca.SX]) -> ca.SX:
    result = ca.SX(1)
    for factor in factors:
        result = result * factor
    return result


def _logistic(v: ca.SX) -> ca.SX:
    return 1 / (1 + ca.exp(-8 * v))


#: Steps of other functions, of which most of a formula is flat.
STEPS = {
    "arctangents": SHAPES["arctangents"],
    "logistic": lambda z: _product([_logistic(v + 1) - _logistic(v - 1) for v in z]),
    "erf": lambda z: _product([(ca.erf(4 * (v + 1)) - ca.erf(4 * (v - 1))) / 2 for v in z]),
}


def _symbols(names: str) -> list[ca.SX]:
    return [ca.SX.sym(name) for name in names.split()]


def friction(draw: random.Random, shape: str, variables: Sequence[ca.SX], depth: float) -> ca.SX:
    """Positive but where the variables are close to a random centre: there -depth times the value elsewhere."""
    relative = 1e-4 if len(variables) == 1 else 1e-9 ** (1 / len(variables))
    scaled = []
    for v in variables:
        centre = draw.choice([-1, 1]) * 10 ** draw.uniform(-1.5, 1.5)
        scaled.append((v - centre) / (relative * abs(centre)))
    return draw.uniform(0.1, 2) * (1 - (1 + depth) * (SHAPES | STEPS)[shape](scaled))


def mechanical(draw: random.Random, shape: str, size: int, depth: float) -> Mechanical:
    """Two coupled coordinates, both driven; one of the frictions depends on positions and a momentum."""
    q1, q2, p1, p2 = _symbols("q1 q2 p1 p2")
    narrow = friction(draw, shape, [q1, q2, p1][:size], depth)
    D = [draw.uniform(0.1, 1), narrow] if draw.random() < 0.5 else [narrow, draw.uniform(0.1, 1)]
    M = [[1.3, 0.2 * ca.cos(q2)], [0.2 * ca.cos(q2), 0.9]]
    V = 2 * q1**2 + 1 - ca.cos(q2) + (q1 - q2) ** 2
    return Mechanical([q1, q2], [p1, p2], M=M, V=V, D=D, G=[[1, 0], [0, 1]])


def port_hamiltonian(draw: random.Random, shape: str, size: int, depth: float) -> AffineSystem:
    """f = (J - R(x)) grad S with a storage that is not quadratic; the dissipation elsewhere hides what is negative."""
    x = _symbols("x1 x2 x3")
    S = x[0] ** 2 + x[0] ** 4 / 4 + x[1] ** 2 + ca.cosh(x[2])
    slope = ca.gradient(S, ca.vertcat(*x))
    others = 0 if size == 3 else draw.uniform(0.1, 1)
    R = ca.diag(ca.vertcat(others, friction(draw, shape, [x[0], x[2], x[1]][:size], depth), others))
    J = ca.SX([[0, 1, 0], [-1, 0, 2], [0, -2, 0]])
    return AffineSystem(x, _symbols("u1 u2"), ca.mtimes(J - R, slope), [[0, 0], [1, 0], [0, 1]], S)


def circuit(draw: random.Random, shape: str, size: int, depth: float) -> Circuit:
    """Two sources on one capacitor with a resistor across it whose slope is negative in a band."""
    a, b, v = _symbols("a b v")
    i_G = v * friction(draw, shape, [v], depth)
    g_L = [[-1, 0], [0, -1]]
    return Circuit([a, b], [v], L=[1, 2], C=[0.5], Gamma=[[1], [1]], v_R=[0.2 * a, b + b**3], i_G=[i_G], g_L=g_L)


def chain(draw: random.Random, shape: str, size: int, depth: float) -> Mechanical:
    """Three masses, all driven, of which one has friction: the others are not there to hide it."""
    q, p = _symbols("q1 q2 q3"), _symbols("p1 p2 p3")
    variables = [*q, *p]
    draw.shuffle(variables)
    damping: list[ca.SX | float] = [0.0, 0.0, 0.0]
    damping[draw.randrange(3)] = friction(draw, shape, variables[:size], depth)
    V = q[0] ** 2 + ca.cosh(q[1] / 10) + 1 - ca.cos(q[2]) + (q[0] - q[1]) ** 2 + (q[1] - q[2]) ** 2
    return Mechanical(q, p, M=[1, 2, 0.5], V=V, D=damping, G=[[1, 0, 0], [0, 1, 0], [0, 0, 1]])


CASES = [
    (make, shape, size)
    for k, shape in enumerate(SHAPES)
    for make, size in ((mechanical, 1 + k % 3), (port_hamiltonian, 1 + (k + 1) % 3), (circuit, 1))
]


@pytest.mark.parametrize(("make", "shape", "size"), CASES)
def test_it_is_found(make, shape, size):
    draw = random.Random(f"{make.__name__} {shape} {size}")
    claim = assumption_1(Plant(make(draw, shape, size, draw.choice(EXCESS)).lower())).claim
    assert claim.status is Status.REFUTED


MANY = [("logistic", 4, 0), ("logistic", 5, 1), ("arctangents", 5, 0), ("erf", 5, 0)]


@pytest.mark.system
@pytest.mark.parametrize(("shape", "size", "seed"), MANY)
def test_it_is_found_between_steps_in_many_variables(shape, size, seed):
    draw = random.Random(f"{shape} {size} {seed}")
    claim = assumption_1(Plant(chain(draw, shape, size, 0.1).lower())).claim
    assert claim.status is Status.REFUTED


@pytest.mark.system
@pytest.mark.parametrize(("make", "shape", "size"), [case for case in CASES if case[0] is not circuit])
def test_what_only_comes_close_to_zero_is_not_refuted(make, shape, size):
    draw = random.Random(f"{make.__name__} {shape} {size}")
    claim = assumption_1(Plant(make(draw, shape, size, -1e-3).lower())).claim
    assert claim.status is not Status.REFUTED


def test_it_is_found_in_the_stated_box_and_not_outside():
    q, p = _symbols("q p")
    D = [1 - 1.2 * ca.exp(-(((q - 1.7) / 1e-4) ** 2))]
    for bounds, status in ((("1", "2"), Status.REFUTED), (("-1", "1.6"), Status.PROVED)):
        system = Mechanical([q], [p], M=[1], V=q**2, D=D, G=[1], domain={"q": bounds, "p": (-1, 1)})
        assert assumption_1(Plant(system.lower())).claim.status is status
