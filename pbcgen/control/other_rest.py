"""Equilibria of the closed loop besides x*: a search from many starts, confirmed by Krawczyk's test.

Only those count at which the model is stated and its storage defined: formulas have zeros beyond both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.control.rest_search import hidden_rests
from pbcgen.control.situation import Situation
from pbcgen.models.gains import Vector
from pbcgen.models.laws import Integral
from pbcgen.passivity.region import Region
from pbcgen.proof.newton import Search, find_zeros, float_newton, krawczyk, polish, sizes_of
from pbcgen.symbolic.doubles import Doubles
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, approximate, ball, is_finite, precision, rational, sign
from pbcgen.symbolic.tape import Tape

#: Starts of the search for other equilibria.
_STARTS = 30
#: How far they are, as shares of what is looked at, in turn.
_SHARES = (1.0, 0.5, 0.25, 0.02)
#: More of them, where the units of the unknowns are far from one.
_FAR = 15
#: Other equilibria are not searched for in systems with more states; of mechanical systems the positions count.
_LARGEST_SEARCH = 12


def other_rest(situation: Situation) -> list[Real] | None:
    """An equilibrium of the closed loop that is certainly not x*, in balls: x, then psi of `integral`; or None.

    A mechanical system rests with p = 0, so its momenta are no unknowns.
    """
    plant, point = situation.plant, situation.point
    system, n = plant.system, plant.system.n
    still = n // 2 if system.mechanical is not None else 0
    free = n - still
    if free > _LARGEST_SEARCH:
        return None
    at_star = ca.SX.sym("at_star", 2 * system.m)
    psi = ca.SX.sym("psi", system.m if isinstance(situation.law, Integral) else 0)
    try:
        residual = _rest_equations(situation, at_star[: system.m], at_star[system.m :], psi)
    except ZeroDivisionError:
        return None  # K_c is singular: the inputs do not say where the filters rest
    if still:
        residual = ca.substitute(residual[still:], system.x[free:], ca.SX.zeros(still))
    jacobian = ca.jacobian(residual, ca.vertcat(system.x[:free], system.u, psi))
    with precision(BITS):
        (gamma_star,) = plant.at(point, situation.gamma)
        constants = [*point.u, *[row[0] for row in gamma_star]]
    rounded = ca.DM([approximate(v) for v in constants])
    held, filters = free + system.m, psi.numel()
    values = ca.vertcat(rounded, ca.DM([float(v) for v in plant.parameter_values]))
    function = Doubles(
        [system.x, system.u, psi],
        [ca.substitute(e, ca.vertcat(at_star, plant.parameter_symbols), values) for e in (residual, jacobian)],
    )

    def evaluate(z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        value, slope = function(np.concatenate([z[:free], np.zeros(still)]), z[free:held], z[held:])
        return value.ravel(), slope

    def settled(z: NDArray[np.float64]) -> NDArray[np.float64]:
        """z with what the controller holds where the plant is at z, if that is found."""

        def law(w: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            value, slope = evaluate(np.concatenate([z[:free], w]))
            return value[free:], slope[free:, free:]

        found = float_newton(law, z[free:])
        return z if found is None else np.concatenate([z[:free], found])

    star = np.array([approximate(v) for v in (*point.x[:free], *point.u, *[ZERO] * filters)])
    spread = np.full(len(star), 10.0)
    if isinstance(situation.law, Integral):
        spread[held:] /= [float(b) for b in situation.law.beta_psi]  # tanh is flat beyond
    wide = _in_units(situation, star, sizes_of(evaluate(star)[1])[1], free)

    def around(size: NDArray[np.float64], reach: float, count: int, also: Sequence[NDArray[np.float64]] = ()) -> Search:
        generator = np.random.default_rng(1)
        offsets = [generator.uniform(-1.0, 1.0, len(star)) * size * _SHARES[k % len(_SHARES)] for k in range(count)]
        starts = tuple(settled(start) for start in (*also, *(star + offset for offset in offsets)))
        return Search(star - reach * size, star + reach * size, starts, 0)

    def searches() -> Iterator[Search]:
        if still:
            yield around(spread, 1.0, 0, tuple(star + np.pi * np.eye(len(star))[:free]))  # one link upside down
        yield around(spread, 1.0, _STARTS, _with_gamma_kept(situation, star, free))
        if not 1e-3 < np.max((wide / spread)[:free]) < 10:  # the starts around x* are of sizes between
            yield around(wide, 100.0, _FAR)
        far = 10 * np.maximum(wide, spread)[:free]
        hidden = [np.concatenate([x[:free], star[free:]]) for x in hidden_rests(situation, far)]
        everywhere = np.full(len(star), np.inf)
        yield Search(-everywhere, everywhere, tuple(chain.from_iterable((z, settled(z)) for z in hidden)), 0)

    tape = Tape.of([*plant.symbols, at_star, psi], [residual, jacobian])
    parameters: list[Real] = [rational(v) for v in plant.parameter_values]

    def whole(z: list[Real]) -> tuple[list[Real], list[Real]]:
        return [*z[:free], *[ZERO] * still], z[free:held]

    def in_balls(z: list[Real]) -> tuple[list[Real], list[list[Real]]]:
        value, slope = (v.dense(ZERO) for v in tape.walk(REAL, [*whole(z), parameters, constants, z[held:]]))
        return [row[0] for row in value], slope

    def zeros(search: Search) -> list[NDArray[np.float64]]:
        return sorted(find_zeros(evaluate, search), key=lambda z: float(np.linalg.norm(z - star)))

    with precision(BITS):
        for zero in chain.from_iterable(map(zeros, searches())):
            if np.max(np.abs(zero - star)[:free] / np.minimum(wide, spread)[:free]) < 1e-7:
                continue
            centre = polish(in_balls, list(zero))
            balls = None if centre is None else krawczyk(in_balls, centre)
            if balls is None:
                continue
            x, u = whole([*balls])
            if any(sign(ball(b) - ball(s)) in (1, -1) for b, s in zip(x, point.x, strict=True)) and _is_state(
                situation, x, u
            ):
                return [*x, *balls[held:]]
    return None


def _is_state(situation: Situation, x: list[Real], u: list[Real]) -> bool:
    """Whether (x, u) in balls lies in the stated domain for sure, and the storage is defined there."""
    plant = situation.plant
    bounds = Region.stated(plant).bounds
    below = all(lo is None or sign(v - rational(lo)) in (0, 1) for v, (lo, _) in zip(x, bounds, strict=True))
    above = all(hi is None or sign(rational(hi) - v) in (0, 1) for v, (_, hi) in zip(x, bounds, strict=True))
    return below and above and is_finite(plant.walk(plant.tape(plant.system.S), x, u)[0][0][0])


def _in_units(
    situation: Situation, star: NDArray[np.float64], columns: NDArray[np.float64], free: int
) -> NDArray[np.float64]:
    """How far to look, in the units of each unknown: some lengths over which a tanh saturates, and x* itself.

    ``columns`` say how large changes of the unknowns are beside each other.
    """
    plant, (_, beta, _) = situation.plant, situation.gains
    (slope,) = plant.at(situation.point, ca.densify(ca.jacobian(situation.gamma, plant.system.x[:free])))
    N = np.array([[approximate(v) for v in row] for row in slope])
    steep = np.max(np.abs(N) * np.array([[float(b)] for b in beta]), axis=0, initial=0.0)
    reached = [columns[j] / steep[j] for j in range(free) if np.isfinite(steep[j]) and steep[j] > 0]
    sizes = [*reached, *(float(v) for v in (np.abs(star) * columns)[:free] if np.isfinite(v) and v > 0)]
    return np.asarray(10.0 * max(sizes, default=1.0) / columns)


def _with_gamma_kept(situation: Situation, star: NDArray[np.float64], free: int) -> tuple[NDArray[np.float64], ...]:
    """Starts along which gamma stays near gamma*: elsewhere the saturated law is flat, and Newton's method lost."""
    plant, n = situation.plant, situation.plant.system.n
    at = np.concatenate([star[:free], np.zeros(n - free)])
    slope = plant.doubles(ca.jacobian(situation.gamma, plant.system.x[:free]))
    (N,) = slope(at, star[free : free + plant.system.m])
    if not np.all(np.isfinite(N)):
        return ()
    keep = np.eye(free) - np.linalg.pinv(N) @ N
    if np.max(np.abs(keep)) < 1e-9:
        return ()
    generator = np.random.default_rng(0)
    moves = generator.uniform(-7.0, 7.0, (_STARTS, free)) @ keep
    return tuple(star + np.concatenate([move, np.zeros(len(star) - free)]) for move in moves)


def _rest_equations(situation: Situation, u_star: ca.SX, gamma_star: ca.SX, psi: ca.SX) -> ca.SX:
    """Equilibria of the closed loop in (x, u, psi): ``f + g (u_c + u) = 0``, and (rest) in the form with tanh.

    The integral term adds ``-alpha_psi tanh(beta_psi psi)`` to u, and rests where ``R_psi psi cosh(beta_psi psi)`` is
    ``alpha_psi beta_psi (gamma - gamma*)``.
    """
    plant, system, law = situation.plant, situation.plant.system, situation.law
    alpha, beta, _ = situation.gains
    comp = situation.compensation
    u = system.u if comp is None else comp + system.u
    w = system.u if comp is not None else system.u - u_star
    own = ca.SX(0, 1)

    def column(gain: Vector) -> ca.SX:
        return ca.vertcat(*map(plant.number, gain))

    if isinstance(law, Integral):
        alpha_psi, beta_psi = column(law.alpha_psi), column(law.beta_psi)
        w = w + alpha_psi * ca.tanh(beta_psi * psi)
        leak = ca.vertcat(*[ca.horzcat(*map(plant.number, row)) for row in law.R_psi])
        own = ca.mtimes(leak, psi) - alpha_psi * beta_psi * (situation.gamma - gamma_star) / ca.cosh(beta_psi * psi)
    inside = situation.gamma - gamma_star + ca.mtimes(situation.compliance, w)
    return ca.vertcat(system.f + ca.mtimes(system.g, u), w + column(alpha) * ca.tanh(column(beta) * inside), own)
