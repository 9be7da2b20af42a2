"""Claims on generated designs, beside what NumPy says of them: on the wrong side of a margin nothing is PROVED."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen import (
    AffineSystem,
    Design,
    DynamicExtension,
    Limits,
    Mechanical,
    NaturalDamping,
    PotentialCompensation,
)
from pbcgen.control.derive import derive
from pbcgen.symbolic.real import approximate, fraction

MARGIN = Fraction(1, 10**6)


def _claims(design):
    return {c.claim: str(c.status) for c in derive(design).claims}


def _symbols(label, n):
    return [ca.SX.sym(f"{label}{k}") for k in range(n)]


# --- assumption 3 and theta ----------------------------------------------------------------------------------------


def _damped_pair(seed, product):
    """Two masses, the first one driven, with a full damping matrix and K_l R_l as given."""
    generator = np.random.default_rng(seed)
    a, b = (Fraction(int(v), 10) for v in generator.integers(2, 30, size=2))
    c = Fraction(int(generator.integers(-9, 10)), 10) * min(a, b) * Fraction(9, 10)
    q, p = _symbols("q", 2), _symbols("p", 2)
    a_, b_, c_ = (ca.SX(float(v)) for v in (a, b, c))
    force = [2 * q[0] + (q[0] - q[1]), 3 * q[1] - (q[0] - q[1])]
    f = [*p, -force[0] - a_ * p[0] - c_ * p[1], -force[1] - c_ * p[0] - b_ * p[1]]
    S = q[0] ** 2 + (q[0] - q[1]) ** 2 / 2 + 3 * q[1] ** 2 / 2 + (p[0] ** 2 + p[1] ** 2) / 2
    system = AffineSystem([*q, *p], _symbols("u", 1), f, [0, 0, 1, 0], S, eta=[q[1]], measured=["q0", "q1"])
    law = NaturalDamping(1, 1, 1, "1/10", alpha_l=1, beta_l=1, K_l=product, R_l=1)
    return Design(system, {"q0": 0}, law, sample_period="1e-3", name="pair"), np.array([[a, c], [c, b]], dtype=float)


@pytest.mark.parametrize("seed", range(8))
def test_lambda_is_below_the_damping_and_theta_is_decided_at_its_margin(seed):
    """(y, eta') = (p0, p1): Lambda <= D; and D - w w^T / (4 K_l R_l) >= 0 is needed, with w = (1, -Upsilon)."""
    design, D = _damped_pair(seed, 1)
    derivation = derive(design)
    found = {c.claim: str(c.status) for c in derivation.claims}
    assert found["assumption-3"] == "PROVED"
    bounds = derivation.bounds
    Lambda = np.diag([approximate(bounds.Lambda_c[0]), approximate(bounds.Lambda_l[0])])
    assert np.min(np.linalg.eigvalsh(D - Lambda)) > -1e-12
    w = np.array([1, -float(derivation.law.Upsilon[0][0])])
    needed = Fraction(float(w @ np.linalg.solve(D, w)) / 4).limit_denominator(10**12)
    assert _claims(_damped_pair(seed, needed * (1 - MARGIN))[0])["theta"] != "PROVED"
    enough = sum(1 / fraction(v) for v in (*bounds.Lambda_c, *bounds.Lambda_l)) / 4
    assert _claims(_damped_pair(seed, enough * (1 + MARGIN))[0])["theta"] == "PROVED"


# --- measurability -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(24))
def test_gamma_is_measured_where_it_is_a_combination_of_what_is_measured(seed):
    """f = F x, S = |x|^2 / 2 and g = -F psi, so that gamma = psi^T x; sensors read combinations of x."""
    generator = np.random.default_rng(seed)
    n = int(generator.integers(2, 5))
    x = ca.SX.sym("x", n)
    skew = np.triu(generator.integers(-2, 3, size=(n, n)), 1)
    F = skew - skew.T - np.diag(generator.integers(1, 4, size=n))
    psi = generator.integers(-2, 3, size=n)
    if not psi.any():
        psi[0] = 1
    sensors = generator.integers(-2, 3, size=(int(generator.integers(1, n + 1)), n))
    if seed % 2:
        sensors[0] = 3 * psi - (sensors[1] if len(sensors) > 1 else 0)
    sensors = sensors[np.any(sensors != 0, axis=1)]
    if not len(sensors):
        sensors = psi[None, :]
    seen = np.linalg.matrix_rank(np.vstack([sensors, psi])) == np.linalg.matrix_rank(sensors)
    measured = {f"y{k}": ca.dot(ca.DM(row.astype(float)), x) for k, row in enumerate(sensors)}
    g = (-F @ psi).astype(float)
    f = ca.mtimes(ca.DM(F.astype(float)), x)
    system = AffineSystem(x, _symbols("u", 1), f, ca.DM(g), ca.dot(x, x) / 2, measured=measured)
    target = {f"x_{k}": 0 for k in range(n)}
    found = _claims(Design(system, target, DynamicExtension(1, 1, 1, 1), sample_period="1e-3", name="seen"))
    assert found["passive-output"] == "PROVED"
    assert found["measurability"] == ("PROVED" if seen else "REFUTED")


# --- saturation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("side", [-1, 0, 1])
def test_limits_are_decided_at_their_margin(seed, side):
    """u lies in k q* + [-alpha, alpha] and comes as close to the ends as one likes."""
    generator = np.random.default_rng(seed)
    k, target, alpha = (Fraction(int(v), 10) for v in generator.integers(1, 40, size=3))
    q, p = _symbols("q", 1), _symbols("p", 1)
    system = Mechanical(q, p, M=[1], V=ca.SX(float(k)) * q[0] ** 2 / 2, D=[1], G=[1])
    limit = (k * target + alpha) * (1 + side * MARGIN)
    law = DynamicExtension(alpha, 1, 1, 1)
    design = Design(system, {"q0": target}, law, limits=Limits.symmetric(limit), sample_period="1e-3", name="s")
    assert (_claims(design)["saturation"] == "PROVED") is (side >= 0)


@pytest.mark.parametrize("seed", range(6))
def test_a_compensated_gradient_is_within_its_limits_only(seed):
    """grad V = sum c_k sin(k q): its greatest magnitude is seen on a fine grid, to 1e-5."""
    generator = np.random.default_rng(seed)
    weights = generator.integers(-5, 6, size=3)
    weights[0] = 1 + abs(weights[0])
    q, p = _symbols("q", 1), _symbols("p", 1)
    V = -sum(float(c) * ca.cos((k + 1) * q[0]) / (k + 1) for k, c in enumerate(weights))
    grid = np.linspace(0, 2 * np.pi, 20001)
    largest = float(np.max(np.abs(sum(c * np.sin((k + 1) * grid) for k, c in enumerate(weights)))))
    law = PotentialCompensation(alpha=1, beta=1, K_c=1, R_c=1)
    system = Mechanical(q, p, M=[1], V=V, D=[1], G=[1])

    def saturation(factor):
        limits = Limits.symmetric(Fraction((largest + 1) * factor).limit_denominator(10**9))
        return _claims(Design(system, {"q0": 0}, law, limits=limits, sample_period="1e-3", name="s"))["saturation"]

    assert saturation(0.9999) != "PROVED"
    assert saturation(1.01) == "PROVED"


# --- global claims -------------------------------------------------------------------------------------------------


def _rests(force, alpha, beta, stiffness, target):
    """How often the closed loop of one mass rests, by a scan over the argument z of tanh."""
    z = np.linspace(-60, 60, 240_000)  # zero lies between two of them
    pull = alpha * np.tanh(beta * z)
    position = target + z + pull / stiffness  # K_c x_c = -pull, and z = q - q* + x_c
    balance = force(position) - force(target) + pull
    return int(np.sum(np.diff(np.sign(balance)) != 0))


@pytest.mark.parametrize("seed", range(9))
def test_no_loop_with_several_rests_is_called_global(seed):
    generator = np.random.default_rng(seed)
    a, b, c = float(generator.integers(0, 4)) / 2, float(generator.integers(-4, 5)) / 2, float(generator.integers(1, 4))
    target, alpha = float(generator.integers(-6, 7)) / 4, float(generator.integers(1, 6))
    q, p = _symbols("q", 1), _symbols("p", 1)
    system = Mechanical(q, p, M=[1], V=a * q[0] ** 2 / 2 - b * ca.cos(c * q[0]) / c, D=[1], G=[1])
    design = Design(system, {"q0": target}, DynamicExtension(alpha, 2, 4, 1), sample_period="1e-3", name="g")
    found = _claims(design)["globally-asymptotically-stable"]
    rests = _rests(lambda q: a * q + b * np.sin(c * q), alpha, 2.0, 4.0, target)
    assert rests == 1 or found != "PROVED"
    assert rests > 1 or found != "REFUTED"
