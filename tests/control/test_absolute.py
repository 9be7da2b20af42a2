"""Global stability by sectors and the S-procedure: what it proves decreases, and what is not global is refused."""

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Integral, Mechanical, Parameters
from pbcgen.control.absolute import METHOD, storage_of
from pbcgen.control.derive import derive
from pbcgen.control.sectors import SectorLoop
from pbcgen.models.laws import base_law
from pbcgen.proof.claim import Status


def spacecraft(inertia=(1, 2, 3), drag=0.1, turns=(1, 1, 1), gamma=None, law=None):
    """A body that spins in thin air; gamma is what a wheel on each axis would have to store."""
    w, u = ca.SX.sym("w", 3), ca.SX.sym("u", 3)
    I1, I2, I3 = inertia
    turn = [(I2 - I3) * w[1] * w[2], (I3 - I1) * w[2] * w[0], (I1 - I2) * w[0] * w[1]]
    f = [(turns[k] * t - drag * w[k]) / inertia[k] for k, t in enumerate(turn)]
    S = sum(i * w[k] ** 2 for k, i in enumerate(inertia)) / 2
    g = ca.diag(ca.vertcat(*[1 / i for i in inertia]))
    gamma = [i * w[k] / 0.1 for k, i in enumerate(inertia)] if gamma is None else gamma(w)
    system = AffineSystem(w, u, f, g, S, gamma=gamma)
    law = law or DynamicExtension([1] * 3, [1] * 3, [1] * 3, [1] * 3)
    return Design(system, {f"w_{k}": 0 for k in range(3)}, law, sample_period="1e-2")


def motor(R="0.5", b="1e-3", coupling=1.5, flux="0.1"):
    """A synchronous motor in rotating coordinates at 50 rad/s."""
    p = Parameters(L="2e-3", R=R, psi=flux, P=3, J="1e-3", b=b)
    d, q, w = (ca.SX.sym(name) for name in ("id", "iq", "w"))
    f = [
        (-p.R * d + p.P * w * p.L * q) / p.L,
        (-p.R * q - p.P * w * (p.L * d + p.psi)) / p.L,
        (coupling * p.P * p.psi * q - p.b * w) / p.J,
    ]
    S = 3 * p.L * (d**2 + q**2) / 4 + p.J * w**2 / 2
    system = AffineSystem([d, q, w], ca.SX.sym("v", 2), f, [[1 / p.L, 0], [0, 1 / p.L], [0, 0]], S, parameters=p)
    law = DynamicExtension([5, 5], ["0.1"] * 2, [1, 1], [10, 10])
    return Design(system, {"id": 0, "w": 50}, law, sample_period="1e-4")


def _linear(A, B, gamma, K=1, R=1, stiff=1):
    A = np.array(A)
    x, u = ca.vertcat(*[ca.SX.sym(f"x_{k}") for k in range(len(A))]), ca.SX.sym("u")
    system = AffineSystem(x, u, ca.mtimes(ca.SX(ca.DM(A)), x), B, ca.dot(x, x), gamma=[ca.dot(ca.DM(gamma), x)])
    law = DynamicExtension(stiff, 1, K, R)
    return Design(system, {f"x_{k}": 0 for k in range(len(A))}, law, sample_period="1e-3")


def carts(R_psi="0.5", alpha_psi=1, beta_psi="0.3", springs=(3, 3, 1), friction=1):
    """Two carts between springs; an integral term pulls at the first."""
    q, p = ([ca.SX.sym(f"{letter}{k}") for k in (1, 2)] for letter in "qp")
    V = (springs[0] * q[0] ** 2 + springs[1] * (q[1] - q[0]) ** 2 + springs[2] * q[1] ** 2) / 2
    system = Mechanical(q, p, M=[1, 2], V=V, D=[friction, friction], G=[[1], [0]])
    law = Integral(DynamicExtension(3, 2, 20, "0.5"), alpha_psi=alpha_psi, beta_psi=beta_psi, R_psi=R_psi)
    return Design(system, {"q2": "0.5"}, law, sample_period="1e-3")


def _global(design):
    derivation = derive(design)
    return derivation, next(c for c in derivation.claims if c.claim == "globally-asymptotically-stable")


PROVED = {
    "spacecraft": spacecraft(),
    "turns that balance in another energy": spacecraft(turns=(1.5, 1, 1)),
    "spacecraft, unequal gains": spacecraft(law=DynamicExtension([1, 2, 3], [5, "0.1", 1], [1, 10, 1], [2, 1, "0.1"])),
    "motor": motor(),
    "an integral term": carts(),
    "an integral term that leaks little": carts(R_psi="0.1", alpha_psi="0.4"),
    "more than passive": _linear([[-1, 3], [-1, -1]], [1, 0], [1, 1]),
    "an integrator": _linear([[0, 1], [0, -1]], [0, 1], [1, 0]),
}


@pytest.mark.parametrize("name", PROVED)
def test_it_is_proved_and_the_function_decreases_along_the_loop(name):
    design = PROVED[name]
    derivation, claim = _global(design)
    assert (claim.status, claim.method) == (Status.PROVED, METHOD)
    law = derivation.law
    base = base_law(law)
    found = storage_of(SectorLoop.of(derivation.situation))
    P = np.array([[float(v) for v in row] for row in found.P])
    weights, filters = (np.array([float(v) for v in part]) for part in (found.popov, found.integral))
    system, rng = derivation.plant.system, np.random.default_rng(1)
    star, u_star = (np.array([float(v) for v in part]) for part in (derivation.point.x, derivation.point.u))
    rate = derivation.plant.numeric(system.xdot)
    gamma = derivation.plant.numeric(derivation.gamma)
    alpha, beta = (np.array([float(v) for v in part]) for part in (base.alpha, base.beta))
    K, R = (np.array([[float(v) for v in row] for row in part]) for part in (base.K_c, base.R_c))
    at_star = np.array(gamma(star, u_star)).ravel()
    for scale in (1e-3, 0.1, 1.0, 30.0, 1e3):
        for _ in range(40):
            x, x_c = star + scale * rng.normal(size=system.n), scale * rng.normal(size=system.m)
            phi = alpha * np.tanh(beta * (np.array(gamma(x, u_star)).ravel() - at_star + x_c))
            theta, stored = _integral(law, np.array(gamma(x, u_star)).ravel() - at_star, scale, rng)
            xdot = np.array(rate(x, u_star - phi - theta)).ravel()
            c_dot = -R @ (phi + K @ x_c)
            z_dot = np.array(gamma(xdot + star, u_star)).ravel() - at_star + c_dot  # gamma is affine
            zeta, slope = np.concatenate([x - star, x_c]), np.concatenate([xdot, c_dot])
            assert zeta @ P @ slope + weights @ (phi * z_dot) + filters @ stored < 0


def _integral(law, away, scale, rng):
    """What an integral term adds to the force at some psi, and the rate of ``(cosh(beta psi) - 1) / beta^2``."""
    if not isinstance(law, Integral):
        return 0.0, np.zeros(0)
    a, b = (np.array([float(v) for v in part]) for part in (law.alpha_psi, law.beta_psi))
    psi = rng.normal(size=len(a)) * min(scale, 10) / b
    psi_dot = -np.array([[float(v) for v in row] for row in law.R_psi]) @ psi + a * b * away / np.cosh(b * psi)
    return a * np.tanh(b * psi), np.sinh(b * psi) / b * psi_dot


def _given(k):
    return lambda w: [10 * w[0], 20 * w[1], 30 * w[2] * k]


REFUSED = {
    "turns that feed each other": spacecraft(turns=(-1, 1, -1)),
    "turns that feed each other the other way": spacecraft(turns=(1, -1, 1)),
    "a turn that nothing balances": spacecraft(turns=(1, 0, 0)),
    "a little drive": spacecraft(drag=-1e-6),
    "an output of the wrong sign": spacecraft(gamma=_given(-1), law=DynamicExtension([9] * 3, 1, [9] * 3, [9] * 3)),
    "a motor that runs away": motor(coupling=-1.5),
    "a motor that is driven": motor(b="-1e-3"),
    "a coil that is driven": motor(R="-1e-3"),
    "a filter without leak": carts(R_psi=0),
    "an integral term that drives": carts(R_psi="0.1", alpha_psi=9, beta_psi=1),
    "an integral term that is all there is for a place": carts(springs=(0, 3, 0), R_psi=0),
    "an integral term without springs, driven": carts(springs=(0, 3, 0), friction=-1),
    "an integral term between springs that push": carts(springs=(0, 3, -1)),
    "an integral term and no friction": carts(friction=0),
    "an integrator that is driven": _linear([[0, 1], [0, 1]], [0, 1], [1, 0]),
    "an integrator that the law does not read": _linear([[0, 1], [0, -1]], [0, 1], [0, 1]),
    "an integrator, pushed away": _linear([[0, 1], [0, -1]], [0, 1], [-1, 0]),
    "two integrators": _linear([[0, 1], [0, 0]], [0, 1], [1, 0]),
    "an oscillator without friction": _linear([[0, 1], [-1, 0]], [0, 1], [1, 0]),
    "an unstable plant": _linear([[0.5, 1], [-1, -0.4]], [1, 0], [1, 0], stiff=5, K=20),
    "an unstable plant that its law holds": _linear([[0.1]], [1], [1], stiff=5, K=20),
    "positive feedback": _linear([[-1]], [1], [-1], stiff=5, K=20),
    "three lags, stiff": _linear(
        [[-1, 0, 0], [1, -1, 0], [0, 1, -1]], [1, 0, 0], [0, 0, 1], stiff=500, K=5000, R="0.01"
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_may_not_be_global_is_refused(name):
    derivation, claim = _global(REFUSED[name])
    assert claim.method != METHOD
    situation = derivation.situation
    loop = None if situation is None else SectorLoop.of(situation)
    assert loop is None or storage_of(loop) is None


def test_a_second_rest_is_shown_instead():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = AffineSystem([x], [u], [-x + x**2 / 2], [1], x**2, gamma=[x])
    _, claim = _global(Design(system, {"x": 0}, DynamicExtension("0.1", 1, 1, 1), sample_period="1e-2"))
    assert claim.status is Status.REFUTED


def test_the_sampled_loop_is_not_called_global_for_it():
    derivation, claim = _global(PROVED["spacecraft"])
    assert claim.holds_everywhere
    assert "all x" not in next(c for c in derivation.claims if c.claim == "sampled-stable").domain


def test_carts_that_stand_anywhere_without_the_law_are_brought_back():
    _, claim = _global(carts(springs=(0, 3, 0)))
    assert (claim.status, claim.method) == (Status.PROVED, METHOD)
