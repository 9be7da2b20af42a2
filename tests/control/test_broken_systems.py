"""Broken variants of provable systems, judged by numerics that know nothing of the provers."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from flint import fmpq

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical, check
from pbcgen.passivity.flow import flow
from pbcgen.passivity.lasalle import invariant_set
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.storage import assumption_1
from pbcgen.passivity.structure import power_structure
from pbcgen.pipeline import region
from pbcgen.proof.claim import Status
from pbcgen.proof.lyapunov import lyapunov
from pbcgen.proof.newton import krawczyk
from pbcgen.symbolic.real import BITS, fraction, precision, rational, sign

# --- assumption 1: structure, exact algebra and the refuter --------------------------------------------------------

#: Coefficients of two masses between springs; each occurrence has its own, so that any one may be wrong.
RIGHT = (1.0, 2.0, 3.0, 4.0, 0.5, 4.0, 0.25, 3.0, 4.0, 1.0, 2.0)


def masses(c: tuple[float, ...]) -> AffineSystem:
    """x = (q1, q2, p1, p2), the input pushes the second mass."""
    q1, q2, p1, p2 = x = [ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2")]
    f = [
        c[0] * p1,
        c[1] * p2,
        -c[2] * q1 + c[3] * (q2 - q1) - c[4] * p1,
        -c[5] * (q2 - q1) - c[6] * p2,
    ]
    S = (c[7] * q1**2 + c[8] * (q2 - q1) ** 2 + c[9] * p1**2 + c[10] * p2**2) / 2
    return AffineSystem(x, [ca.SX.sym("u")], f, [0, 0, 0, 1], S)


def grows(system: AffineSystem) -> float:
    """The largest eigenvalue of the quadratic form grad S^T f."""
    rate = ca.dot(ca.gradient(system.S, system.x), system.f)
    form = Plant(system).numeric(ca.hessian(rate, system.x)[0])
    return float(np.max(np.linalg.eigvalsh(np.array(form(np.zeros(4), np.zeros(1))))))


VARIANTS = [(k, factor) for k in range(len(RIGHT)) for factor in (-1.0, 0.0, 1.5, 1 + 1e-6)]


@pytest.mark.parametrize(("k", "factor"), VARIANTS)
def test_a_wrong_coefficient_is_not_proved_and_a_harmless_one_not_refuted(k: int, factor: float) -> None:
    system = masses(tuple(c * factor if i == k else c for i, c in enumerate(RIGHT)))
    status, growth = assumption_1(Plant(system)).claim.status, grows(system)
    if growth > 1e-13:  # what an error of 1e-6 beside a zero on the diagonal leaves is its square
        assert status is not Status.PROVED
    else:
        assert status is Status.PROVED


# --- LaSalle by elimination ----------------------------------------------------------------------------------------


def rests(K: np.ndarray, damped: np.ndarray, driven: np.ndarray) -> bool:
    """Whether no motion of ``q'' = -K q + constant`` leaves the damped and the driven coordinates at rest."""
    n = len(K)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K, np.zeros((n, n))]])
    output = np.zeros((n, 2 * n))
    output[:, n:] = np.diag((damped | driven).astype(float))
    rows = np.vstack([output @ np.linalg.matrix_power(A, k) for k in range(2 * n)])
    return bool(np.linalg.matrix_rank(rows) == 2 * n)


@pytest.mark.parametrize("seed", range(60))
def test_what_moves_without_being_seen_is_not_called_an_equilibrium(seed: int) -> None:
    """Chains with few different stiffnesses: symmetric ones hide modes from the masses in the middle."""
    generator = np.random.default_rng(seed)
    n = int(generator.integers(2, 5))
    springs = generator.integers(1, 3, size=n + 1)
    damped, driven = generator.random(n) < 0.3, np.arange(n) == generator.integers(n)
    K = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    q, p = ca.SX.sym("q", n), ca.SX.sym("p", n)
    force = ca.mtimes(ca.DM(K), q)
    S = (ca.dot(q, force) + ca.dot(p, p)) / 2
    g = ca.vertcat(ca.SX.zeros(n), ca.SX(ca.DM(driven.astype(float))))
    f = ca.vertcat(p, -force - ca.DM(damped.astype(float) / 2) * p)
    plant = Plant(AffineSystem(ca.vertcat(q, p), [ca.SX.sym("u")], f, g, S))
    found = power_structure(plant)
    assert found is not None
    assert found[1].complete
    gamma = ca.dot(ca.DM(driven.astype(float)), q)
    invariant = invariant_set(flow(plant, found[0], gamma, None))
    assert invariant.closed
    assert invariant.resting == rests(K, damped, driven)


# --- large matrices ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_a_large_matrix_with_one_eigenvalue_outside_is_not_proved(seed: int) -> None:
    """A reflection of a triangular matrix: rational, of known spectrum, and full."""
    generator = np.random.default_rng(seed)
    n = 52
    outside = seed % 2 == 0
    T = np.triu(generator.integers(-2, 3, size=(n, n)), 1).astype(object) / Fraction(8 * n)
    values = [Fraction(-int(v), 4) for v in generator.integers(1, 40, size=n)]
    if outside:
        values[int(generator.integers(n))] = Fraction(1, 10**6)
    for k, value in enumerate(values):
        T[k, k] = value
    v = generator.integers(-3, 4, size=n).astype(object)
    reflection = np.eye(n, dtype=object) - 2 * np.outer(v, v) / Fraction(int(v @ v))
    A = reflection @ T @ reflection
    proof = lyapunov([[rational(Fraction(entry)) for entry in row] for row in A], "hurwitz")
    assert proof.status is (Status.REFUTED if outside else Status.PROVED)


# --- enclosures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(100))
def test_a_map_without_zero_is_not_enclosed(seed: int) -> None:
    """(x - a)^2 + eps and a second equation through the same point: nearly a zero, and none for eps > 0."""
    generator = np.random.default_rng(seed)
    a, b = (rational(Fraction(int(v), 7)) for v in generator.integers(-20, 20, size=2))
    slope = rational(Fraction(int(generator.integers(1, 9))))
    eps = rational(Fraction(1, 10 ** int(generator.integers(3, 30))))

    def residual(x: list) -> tuple[list, list]:
        value = [(x[0] - a) * (x[0] - a) + eps, slope * (x[1] - b) + (x[0] - a)]
        return value, [[(x[0] - a) * 2, fmpq(0)], [fmpq(1), slope]]

    with precision(BITS):
        assert krawczyk(residual, [fraction(a + eps), fraction(b)]) is None


@pytest.mark.parametrize("seed", range(30))
def test_a_simple_zero_is_enclosed(seed: int) -> None:
    generator = np.random.default_rng(seed)
    a, b = (rational(Fraction(int(v), 7)) for v in generator.integers(-20, 20, size=2))

    def residual(x: list) -> tuple[list, list]:
        value = [(x[0] - a) * (x[0] - a + 3), (x[1] - b) * 5 + (x[0] - a)]
        return value, [[(x[0] - a) * 2 + 3, fmpq(0)], [fmpq(1), fmpq(5)]]

    with precision(BITS):
        found = krawczyk(residual, [fraction(a), fraction(b)])
        assert found is not None
        assert sign(found[0] - a) in (None, 0)


# --- regions of attraction -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_no_region_holds_another_equilibrium_or_reaches_above_a_saddle(seed: int) -> None:
    """Pendulums with a weak law: the region must end below the lowest saddle of the storage, found on a grid."""
    generator = np.random.default_rng(seed)
    weight, alpha = (Fraction(int(v), 10) for v in generator.integers(5, 30, size=2))
    alpha = min(alpha, weight * Fraction(3, 5))
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[[1]], V=float(weight) * (1 - ca.cos(q)), D=[1], G=[[1]])
    design = Design(system, {"q": 0}, DynamicExtension(alpha, 2, 4, 1), sample_period="1e-3")
    found = region(check(design), 250)
    assert found.status is Status.PROVED
    assert found.height is not None
    heights = np.array([found.height([x, 0.0]) for x in np.linspace(0, 6.2, 400)])
    saddle = next(heights[k] for k in range(1, 399) if heights[k] >= heights[k - 1] and heights[k] > heights[k + 1])
    assert 0 < found.level <= saddle + 1e-3
    assert not found.contains([2 * np.pi * 0.95, 0.0])
