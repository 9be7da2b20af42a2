"""Random systems, most of them with something wrong: what is PROVED of them survives an attack by plain numerics."""

import json
import random
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pbcgen import AffineSystem, Circuit, Design, DynamicExtension, Mechanical, PassiveOutput, PotentialCompensation
from pbcgen.law.step import ReferenceStep
from pbcgen.pipeline import certificate, check
from pbcgen.verify.claims import examine

pytestmark = pytest.mark.system

#: Relative to the size of what is compared: above rounding and finite differences, below every real defect.
TOLERANCE = 1e-6


def _number(rng, low, high):
    return round(rng.uniform(low, high), 2)


def _mechanical(rng):
    n = rng.choice([1, 2])
    q, p = ([ca.SX.sym(f"{name}{k}") for k in range(n)] for name in "qp")
    wells = [
        lambda z, k: k * z**2 / 2,
        lambda z, k: -k * ca.cos(z),
        lambda z, k: abs(k) * z**4 / 4 - z**2 / 2,
        lambda z, k: k * z,
        lambda z, k: abs(k) * (ca.exp(z) - z),
    ]
    V = sum(rng.choice(wells)(z, _number(rng, -3, 6)) for z in q)
    V += sum(_number(rng, 0.5, 8) * (a - b) ** 2 / 2 for a, b in pairwise(q))
    M = [_number(rng, 0.3, 3) for _ in q]
    if n == 2 and rng.random() < 0.5:
        M = [[M[0] + 1, ca.cos(q[1]) / 2], [ca.cos(q[1]) / 2, M[1] + 0.5]]
    D = [rng.choice([0.0, 0.4, _number(rng, 0.1, 2), -0.1]) for _ in q]
    m = rng.choice([1, n])
    G = np.eye(n)[:, :m].tolist()
    system = Mechanical(q, p, M=M, V=V, D=D, G=G, measured=[f"q{k}" for k in range(n)])
    return system, {f"q{k}": _number(rng, -1, 1) for k in range(m)}, m, m == n


def _hamiltonian(rng):
    n, m = rng.choice([2, 3]), rng.choice([1, 2])
    x = ca.vertcat(*[ca.SX.sym(f"x{k}") for k in range(n)])
    energies = [lambda z: z**2 / 2, lambda z: z**2 / 2 + z**4 / 4, lambda z: 3 * z**2 / 2 - ca.cos(z)]
    S = sum(_number(rng, 0.3, 3) * rng.choice(energies)(x[k]) for k in range(n))
    J = np.zeros((n, n))
    for a in range(n):
        for b in range(a):
            J[a, b] = rng.choice([0.0, 1.0, _number(rng, -2, 2)])
    R = np.diag([rng.choice([0.0, 0.5, _number(rng, 0.1, 2), -0.2]) for _ in range(n)])
    f = ca.mtimes(ca.SX(J - J.T - R), ca.gradient(S, x))
    system = AffineSystem(x, [ca.SX.sym(f"u{k}") for k in range(m)], f, np.eye(n)[:, :m].tolist(), S)
    return system, {f"x{k}": _number(rng, -0.5, 0.5) for k in range(m)}, m, False


def _circuit(rng):
    i, v = [ca.SX.sym("i0"), ca.SX.sym("i1")], [ca.SX.sym("v0")]
    v_R = [_number(rng, -0.1, 2) * z + rng.choice([0, 0.5]) * z**3 for z in i]
    i_G = [_number(rng, 0, 2) * z + rng.choice([0, 1, -0.05]) * (ca.exp(z) - 1) for z in v]
    L, C = [_number(rng, 0.2, 2) for _ in i], [_number(rng, 0.2, 2) for _ in v]
    Gamma = [[rng.choice([-1, 1])], [rng.choice([0, 1])]]
    system = Circuit(i, v, L=L, C=C, Gamma=Gamma, v_R=v_R, i_G=i_G, g_L=[-1, 0], inputs=["u"])
    return system, {"v0": _number(rng, -0.5, 0.5)}, 1, False


def _arm(rng):
    """A planar arm of two to four links, with M from its factors or multiplied out."""
    n = rng.choice([2, 3, 3, 4])
    q, p = ([ca.SX.sym(f"{name}{k}") for k in range(n)] for name in "qp")
    angle, at, V, factors = 0, ca.SX.zeros(2), 0, [(ca.SX.eye(n), _number(rng, 0.05, 0.5))]
    for z in q:
        angle = angle + z
        at = at + _number(rng, 0.2, 1) * ca.vertcat(ca.cos(angle), ca.sin(angle))
        mass = _number(rng, 0.2, 2)
        factors.append((ca.jacobian(at, ca.vertcat(*q)), mass))
        V += mass * _number(rng, 0, 5) * at[1]
    D = [rng.choice([0.0, _number(rng, 0.1, 2), -0.1 if rng.random() < 0.2 else 0.5]) for _ in q]
    D[0] += rng.choice([0, 1]) * ca.tanh(p[0]) ** 2
    M = factors if rng.random() < 0.5 else sum(ca.mtimes(J.T, J) * W for J, W in factors)
    m = rng.choice([n, n, n - 1])
    system = Mechanical(q, p, M=M, V=V, D=D, G=np.eye(n)[:, :m].tolist(), measured=[f"q{k}" for k in range(n)])
    return system, {f"q{k}": _number(rng, -1, 1) for k in range(m)}, m, m == n


def _adjusted(seed):
    """A random design whose target and gains may be set in ranges around those it has."""
    rng = random.Random(f"adjusted {seed}")
    design = _design([_mechanical, _hamiltonian, _circuit][seed % 3], seed)
    share = rng.choice([0.01, 0.1, 0.5])
    name = next(c.name for c in design.target.conditions)
    value = next(float(c.value) for c in design.target.conditions)
    around = (round(value - share, 6), round(value + share, 6))
    gains = {"beta": [(float(v) * (1 - share), float(v) * (1 + share)) for v in design.law.beta]}
    return design.with_(target_box={name: around}, gain_ranges=rng.choice([{}, gains]))


def _design(kind, seed):
    rng = random.Random(f"{kind.__name__} {seed}")
    system, target, m, full = kind(rng)
    gains = {
        "alpha": [_number(rng, 0.5, 20) for _ in range(m)],
        "beta": [_number(rng, 0.3, 10) for _ in range(m)],
        "K_c": [_number(rng, 1, 60) for _ in range(m)],
        "R_c": [_number(rng, 0.02, 2) for _ in range(m)],
    }
    law = DynamicExtension(**gains)
    if full and rng.random() < 0.5:
        law = PotentialCompensation(**gains)
    if kind is not _mechanical and rng.random() < 0.3:
        law = PassiveOutput(alpha=gains["alpha"], beta=gains["beta"], k_p=[_number(rng, 0.01, 2) for _ in range(m)])
    near = dict.fromkeys(system.lower().state_names, 0)
    h = rng.choice(["1e-3", "1e-2", "5e-2"])
    return Design(system, target, law, sample_period=h, near=near, name="random")


def _slope(function, at, step):
    columns = [(function(at + e) - function(at - e)) / (2 * step) for e in step * np.eye(len(at))]
    return np.array(columns).T


_GLOBAL = "globally-asymptotically-stable"


@pytest.mark.parametrize("seed", range(14))
@pytest.mark.parametrize("kind", [_mechanical, _hamiltonian, _circuit])
def test_every_verdict_on_a_random_system_is_checked_again(kind, seed):
    """The generator writes numbers into its models, which CasADi rounds while it differentiates them."""
    assert _unchecked(_design(kind, seed)) == {}


def _unchecked(design):
    document = json.loads(certificate(check(design)))
    found = {f.claim: (f.outcome, f.reason) for f in examine(document) if f.outcome not in ("checked", "open")}
    if found.get(_GLOBAL, ("",))[0] == "recorded":  # by growth or uniqueness that the checker has no means for
        rests_on_it = {_GLOBAL, "sampled-stable"}
        found = {name: f for name, f in found.items() if name not in rests_on_it or f[0] != "recorded"}
    return found


@pytest.mark.parametrize("seed", range(5))
def test_every_verdict_on_a_random_arm_is_checked_again(seed):
    assert _unchecked(_design(_arm, seed)) == {}


@pytest.mark.parametrize("seed", range(9))
def test_every_verdict_on_random_settings_is_checked_again(seed):
    assert _unchecked(_adjusted(seed)) == {}


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("kind", [_mechanical, _hamiltonian, _circuit])
def test_what_is_proved_of_a_random_system_survives_numerics(kind, seed):
    design = _design(kind, seed)
    report = check(design)
    claims = {c.claim: c for c in report.claims}
    plant, generator = report.derivation.plant, np.random.default_rng(seed)
    system = plant.system

    def proved(name):
        return claims[name].status.name == "PROVED"

    def least(expression):
        function = plant.numeric(expression, ca.sumsqr(ca.gradient(system.S, system.x)))
        points = [(generator.normal(size=system.n) * s, generator.normal(size=system.m) * s) for s in (0.1, 1, 3) * 40]
        return min(float(value) / (1 + float(size)) for value, size in (function(*p) for p in points))

    supplied = -ca.dot(ca.gradient(system.S, system.x), system.f)
    if proved("assumption-1") and claims["assumption-1"].domain == "all x":
        assert least(supplied) > -TOLERANCE
    if proved("passive-output") and claims["passive-output"].domain == "all x":
        rate = ca.mtimes(ca.jacobian(report.derivation.gamma, system.x), system.xdot)
        balance = ca.dot(system.u, rate) - ca.dot(ca.gradient(system.S, system.x), system.xdot)
        assert least(balance) > -TOLERANCE
    loop = report.loop
    if loop is None or report.control is None:
        return

    def motion(z):
        rate, u = loop.controller(z[: system.n], z[system.n :])
        return np.concatenate([np.array(loop.plant(z[: system.n], u)).ravel(), np.array(rate).ravel()])

    rest = np.concatenate([loop.x_star, np.zeros(loop.controller.size1_in(1))])
    assert np.max(np.abs(motion(rest))) < TOLERANCE
    abscissa = float(np.max(np.linalg.eigvals(_slope(motion, rest, 1e-6)).real))
    scale = 1 + float(np.max(np.abs(_slope(motion, rest, 1e-6))))
    if proved("stable") or proved("asymptotically-stable"):
        assert abscissa < TOLERANCE * scale
    if claims["asymptotically-stable"].status.name == "REFUTED":
        assert abscissa > -TOLERANCE * scale

    def radius(h):
        step = ReferenceStep(report.derivation.relaw(h))

        def sample(z):
            x, xi = z[: system.n], z[system.n :]
            following, u, _ = step(np.array(loop.measure(x)).ravel(), xi)
            flow = solve_ivp(
                lambda _, y: np.array(loop.plant(y, u)).ravel(), (0, float(h)), x, "DOP853", rtol=1e-11, atol=1e-13
            )
            return np.concatenate([flow.y[:, -1], following])

        return float(np.max(np.abs(np.linalg.eigvals(_slope(sample, rest, 1e-5)))))

    if proved("sampled-stable"):
        assert radius(design.sample_period) < 1 + TOLERANCE
    if claims["sampled-stable"].status.name == "REFUTED":
        assert radius(design.sample_period) > 1 - TOLERANCE
