"""Where no gamma exists, from derivatives at equilibria; and systems that have one, which must never be refuted."""

from __future__ import annotations

import random

import casadi as ca
import pytest

from pbcgen import AffineSystem, Mechanical
from pbcgen.passivity.obstruction import obstruction
from pbcgen.passivity.passive_output import PassiveOutput, find
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
