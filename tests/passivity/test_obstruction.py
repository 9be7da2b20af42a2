"""Where no gamma exists, from derivatives at equilibria; and systems that have one, which must never be refuted."""

from __future__ import annotations

import random

import casadi as ca
import pytest

from pbcgen import AffineSystem, Mechanical
from pbcgen.passivity.obstruction import obstruction
from pbcgen.passivity.passive_output import PassiveOutput, find, prove
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.storage import assumption_1
from pbcgen.proof.claim import Claim, Status


def _symbols(names: str) -> list[ca.SX]:
    return [ca.SX.sym(name) for name in names.split()]


def _two_masses(G, V=lambda a, b: a**2 + 2 * b**2, D=(0, 0), domain=None) -> Plant:
    q, p = _symbols("q1 q2"), _symbols("p1 p2")
    return Plant(Mechanical(q, p, M=[1, 1], V=V(*q), D=list(D), G=G(*q), domain=domain).lower())


def _output(plant: Plant) -> Claim:
    storage = assumption_1(plant)
    found = find(plant, storage.structure, storage.proved, storage.by_structure, storage.region)
    return found.claim if isinstance(found, PassiveOutput) else found


def test_without_friction_second_derivatives_refute_an_output_with_a_curl():
    """At an isolated equilibrium, where the gradient of gamma is known at one point only."""
    claim = _output(_two_masses(lambda a, b: [[1], [ca.sin(a) / 2]]))
    assert claim.status is Status.REFUTED
    assert "Hessian" in claim.evidence
    assert claim.counterexample is not None


@pytest.mark.parametrize(
    "G",
    [
        lambda a, b: [[1], [ca.sin(b) / 2]],
        lambda a, b: [[ca.cos(b)], [-a * ca.sin(b)]],
        lambda a, b: [[1 + b], [a]],
    ],
)
def test_the_gradient_of_a_function_is_integrated(G):
    plant = _two_masses(G)
    assert _output(plant).status is Status.PROVED
    assert obstruction(plant) is None


def test_friction_may_make_another_output_passive_although_the_natural_one_has_a_curl():
    """G stays in a half space, so that gamma = k (q1 + p1) with a large k, and w, is passive."""
    pytest.importorskip("clarabel")
    still = lambda a, b: ca.SX(0)  # noqa: E731
    plant = _two_masses(lambda a, b: [[1], [ca.sin(a) / 2]], V=still, D=(1, 1))
    assert obstruction(plant) is None
    assert _output(plant).status is Status.PROVED


def test_an_equilibrium_outside_the_domain_refutes_nothing():
    G = lambda a, b: [[1], [ca.sin(a) / 2]]  # noqa: E731
    inside, outside = {"q1": (-1, 1)}, {"q1": (1, 2)}
    assert obstruction(_two_masses(G, domain=inside)) is not None
    assert obstruction(_two_masses(G, domain=outside)) is None


def _bent(z: ca.SX, draw: random.Random) -> ca.SX:
    """A change of coordinates that keeps the origin: triangular, with a polynomial above the diagonal."""
    rows = []
    for k in range(z.numel()):
        later = [z[j] for j in range(k + 1, z.numel())]
        bend = sum((draw.choice([-1, 1]) * a * b for a in later for b in [*later, z[k]][:2]), ca.SX(0))
        rows.append(z[k] + (bend if k else bend / 2))
    return ca.vertcat(*rows)


def _with_gamma(seed: int) -> Plant:
    """A linear passive system with a gamma, in bent coordinates; some directions have no dissipation."""
    draw = random.Random(seed)
    n = draw.choice((2, 3))
    m = draw.choice((1, 2))
    x = ca.SX.sym("x", n)
    F = ca.SX(n, n)
    for i in range(n):
        F[i, i] = -draw.choice((0, 0, 1, 2))
        for j in range(i):
            F[i, j] = draw.choice((-2, -1, 1, 2))
            F[j, i] = -F[i, j]
    weights = [draw.choice((1, 2, 3)) for _ in range(n)]
    storage = sum((weights[k] * x[k] ** 2 / 2 for k in range(n)), ca.SX(0))
    slope = ca.gradient(storage, x)
    psi = ca.SX([[draw.choice((-1, 0, 1, 2)) for _ in range(m)] for _ in range(n)])
    g = -ca.mtimes(F, psi)
    z = ca.SX.sym("z", n)
    new = _bent(z, draw)
    turn = ca.solve(ca.jacobian(new, z), ca.horzcat(*ca.substitute([ca.mtimes(F, slope), g], [x], [new])))
    states = [ca.SX.sym(f"z{k}") for k in range(n)]
    f, g, S = ca.substitute([turn[:, 0], turn[:, 1:], ca.substitute(storage, x, new)], [z], [ca.vertcat(*states)])
    return Plant(AffineSystem(states, [ca.SX.sym(f"u{k}") for k in range(m)], f, g, S))


@pytest.mark.parametrize("seed", range(24))
def test_a_system_with_a_gamma_has_no_obstruction_in_any_coordinates(seed):
    assert obstruction(_with_gamma(seed)) is None


def _car(V, D=(1, 2), inputs=2, domain=None) -> Plant:
    """A car that rolls but does not slip, driven and turned; V(x, y) are springs at its middle."""
    x, y, angle, v, w = states = _symbols("x y angle v w")
    c, s = ca.cos(angle), ca.sin(angle)
    energy = ca.SX(V(x, y))
    pull, twist = c * ca.jacobian(energy, x) + s * ca.jacobian(energy, y), ca.jacobian(energy, angle)
    f = [v * c, v * s, w, -pull - D[0] * v, -twist - D[1] * w]
    g = [[0, 0]] * 3 + [[1, 0], [0, 1]]
    u = _symbols("u1 u2")[:inputs]
    return Plant(AffineSystem(states, u, f, [row[:inputs] for row in g], energy + (v**2 + w**2) / 2, domain=domain))


@pytest.mark.parametrize(
    ("V", "D"),
    [
        (lambda x, y: (x**2 + y**2) / 2, (1, 2)),
        (lambda x, y: x**2 / 2 + y**4 / 4, (1, 2)),
        (lambda x, y: 1 - ca.cos(x), ("0.5", 1)),
        (lambda x, y: (x**2 + y**2) / 2, (0, 0)),
    ],
)
def test_a_car_with_springs_has_no_output_although_it_has_friction(V, D):
    claim = _output(_car(V, [float(d) for d in D]))
    assert claim.status is Status.REFUTED
    assert "nothing is lost" in claim.evidence
    assert claim.counterexample is not None


def test_a_car_without_springs_has_an_output_by_its_friction():
    """gamma = (v / d1, w / d2): ``u^T gamma' - S' = |u / sqrt(d) - sqrt(d) v|^2``."""
    plant = _car(lambda x, y: 0)
    v, w = plant.system.x[3], plant.system.x[4]
    assert obstruction(plant) is None
    assert prove(plant, None, ca.vertcat(v, w / 2), True, False) is not None


def test_a_car_with_springs_outside_its_domain_is_left_open():
    assert obstruction(_car(lambda x, y: (x**2 + y**2) / 2, domain={"v": (1, 2)})) is None


def test_a_car_that_is_driven_only_is_left_open():
    """The equations for one input do not contradict each other."""
    assert obstruction(_car(lambda x, y: (x**2 + y**2) / 2, inputs=1)) is None
