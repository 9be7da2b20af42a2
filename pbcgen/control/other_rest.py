"""Equilibria of the closed loop besides x*: a search from many starts, confirmed by Krawczyk's test.

Only those count at which the model is stated and its storage defined: formulas have zeros beyond both.
"""

from __future__ import annotations

from itertools import chain

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.control.situation import Situation
from pbcgen.models.laws import Integral
from pbcgen.passivity.region import Region
from pbcgen.proof.newton import Search, find_zeros, krawczyk, polish
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, approximate, ball, is_finite, precision, rational, sign
from pbcgen.symbolic.tape import Tape

#: Starts of the search for other equilibria.
_STARTS = 30
#: Other equilibria are not searched for in systems with more states; of mechanical systems the positions count.
_LARGEST_SEARCH = 12


def other_rest(situation: Situation) -> list[Real] | None:
    """The state, in balls, of an equilibrium of the closed loop that is certainly not x*; or None.

    A mechanical system rests with p = 0, so its momenta are no unknowns.
    """
    plant, point = situation.plant, situation.point
    system, n = plant.system, plant.system.n
    still = n // 2 if system.mechanical is not None else 0
    free = n - still
    if isinstance(situation.law, Integral) or free > _LARGEST_SEARCH:
        return None
    at_star = ca.SX.sym("at_star", 2 * system.m)
    residual = _rest_equations(situation, at_star[: system.m], at_star[system.m :])
    if still:
        residual = ca.substitute(residual[still:], system.x[free:], ca.SX.zeros(still))
    jacobian = ca.jacobian(residual, ca.vertcat(system.x[:free], system.u))
    with precision(BITS):
        (gamma_star,) = plant.at(point, situation.gamma)
        constants = [*point.u, *[row[0] for row in gamma_star]]
    rounded = ca.DM([approximate(v) for v in constants])
    function = plant.numeric(*[ca.substitute(e, at_star, ca.SX(rounded)) for e in (residual, jacobian)])

    def evaluate(z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        value, slope = function(np.concatenate([z[:free], np.zeros(still)]), z[free:])
        return np.array(value).ravel(), np.array(ca.densify(slope))

    star = np.array([approximate(v) for v in (*point.x[:free], *point.u)])
    spread = np.full(len(star), 10.0)
    turned = star + np.pi * np.eye(len(star))[: free if still else 0]  # an arm with one link upside down
    likely = Search(star - spread, star + spread, tuple(turned), 0)
    around = Search(star - spread, star + spread, _with_gamma_kept(situation, star, free), _STARTS)
    tape = Tape.of([*plant.symbols, at_star], [residual, jacobian])
    parameters: list[Real] = [rational(v) for v in plant.parameter_values]

    def whole(z: list[Real]) -> tuple[list[Real], list[Real]]:
        return [*z[:free], *[ZERO] * still], z[free:]

    def in_balls(z: list[Real]) -> tuple[list[Real], list[list[Real]]]:
        value, slope = (v.dense(ZERO) for v in tape.walk(REAL, [*whole(z), parameters, constants]))
        return [row[0] for row in value], slope

    def zeros(search: Search) -> list[NDArray[np.float64]]:
        return sorted(find_zeros(evaluate, search), key=lambda z: float(np.linalg.norm(z - star)))

    with precision(BITS):
        for zero in chain.from_iterable(map(zeros, (likely, around) if still else (around,))):
            if np.max(np.abs(zero[:free] - star[:free])) < 1e-6 * (1 + np.max(np.abs(star[:free]))):
                continue
            centre = polish(in_balls, list(zero))
            balls = None if centre is None else krawczyk(in_balls, centre)
            if balls is None:
                continue
            x, u = whole([*balls])
            if any(sign(ball(b) - ball(s)) in (1, -1) for b, s in zip(x, point.x, strict=True)) and _is_state(
                situation, x, u
            ):
                return x
    return None


def _is_state(situation: Situation, x: list[Real], u: list[Real]) -> bool:
    """Whether (x, u) in balls lies in the stated domain for sure, and the storage is defined there."""
    plant = situation.plant
    bounds = Region.stated(plant).bounds
    below = all(lo is None or sign(v - rational(lo)) in (0, 1) for v, (lo, _) in zip(x, bounds, strict=True))
    above = all(hi is None or sign(rational(hi) - v) in (0, 1) for v, (_, hi) in zip(x, bounds, strict=True))
    return below and above and is_finite(plant.walk(plant.tape(plant.system.S), x, u)[0][0][0])


def _with_gamma_kept(situation: Situation, star: NDArray[np.float64], free: int) -> tuple[NDArray[np.float64], ...]:
    """Starts along which gamma stays near gamma*: elsewhere the saturated law is flat, and Newton's method lost."""
    plant, n = situation.plant, situation.plant.system.n
    at = np.concatenate([star[:free], np.zeros(n - free)])
    N = np.array(ca.densify(plant.numeric(ca.jacobian(situation.gamma, plant.system.x[:free]))(at, star[free:])))
    if not np.all(np.isfinite(N)):
        return ()
    keep = np.eye(free) - np.linalg.pinv(N) @ N
    if np.max(np.abs(keep)) < 1e-9:
        return ()
    generator = np.random.default_rng(0)
    moves = generator.uniform(-7.0, 7.0, (_STARTS, free)) @ keep
    return tuple(star + np.concatenate([move, np.zeros(len(star) - free)]) for move in moves)


def _rest_equations(situation: Situation, u_star: ca.SX, gamma_star: ca.SX) -> ca.SX:
    """Equilibria of the closed loop in (x, u): ``f + g (u_c + u) = 0``, and (rest) in the form with tanh."""
    plant, system = situation.plant, situation.plant.system
    alpha, beta, _ = situation.gains
    comp = situation.compensation
    u = system.u if comp is None else comp + system.u
    w = system.u if comp is not None else system.u - u_star
    inside = situation.gamma - gamma_star + ca.mtimes(situation.compliance, w)
    alpha_, beta_ = (ca.vertcat(*map(plant.number, gain)) for gain in (alpha, beta))
    return ca.vertcat(system.f + ca.mtimes(system.g, u), w + alpha_ * ca.tanh(beta_ * inside))
