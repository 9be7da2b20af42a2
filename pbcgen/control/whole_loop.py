"""Plant and law in continuous time as one vector field in (x, xi), with its saturations kept apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca

from pbcgen.control.situation import Situation
from pbcgen.models.gains import Matrix, Vector
from pbcgen.models.laws import Integral, NaturalDamping, PassiveOutput
from pbcgen.passivity.plant import Plant
from pbcgen.symbolic.real import ZERO, Real, reals


@dataclass(frozen=True, eq=False)
class WholeLoop:
    """The closed loop ``z' = rate(z, t)`` with ``t = tanh(arguments(z))``.

    Attributes:
        z: x, x_c, and x_l and psi where the law has them. t: one symbol for each saturation of x_c and x_l.
        rate, arguments: SX in z, t, the constants and the parameters.
        names: of z.
        star: z at the target.
        symbols: constants and parameters, columns. values: theirs, exact or in balls.
    """

    z: ca.SX
    t: ca.SX
    rate: ca.SX
    arguments: ca.SX
    names: tuple[str, ...]
    star: tuple[Real, ...]
    symbols: tuple[ca.SX, ...]
    values: tuple[tuple[Real, ...], ...]

    @property
    def closed(self) -> ca.SX:
        """The rate as a function of z alone."""
        return ca.substitute(self.rate, self.t, ca.tanh(self.arguments))

    @staticmethod
    def of(situation: Situation) -> WholeLoop | None:
        """None for `passive-output`, and where what the formulas are derived from may jump."""
        base, plant, system, m = situation.base, situation.plant, situation.plant.system, situation.plant.system.m
        mechanics = system.mechanical
        if isinstance(base, PassiveOutput):
            return None
        if mechanics is not None and plant.jumps(mechanics.M, mechanics.V, mechanics.D, mechanics.G):
            return None
        read = situation.gamma
        if isinstance(base, NaturalDamping) and situation.eta is not None:
            read = ca.vertcat(read, situation.eta)
        read_star, u_star = ca.SX.sym("read_star", read.numel()), ca.SX.sym("u_star", m)
        away = read - read_star
        alpha, beta, K_c = situation.gains
        x_c, t_c = ca.SX.sym("x_c", m), ca.SX.sym("t_c", m)
        states, terms, names = [x_c], [t_c], _numbered("x_c", m)
        arguments = [_column(plant, beta) * (away[:m] + x_c)]
        pull = _column(plant, alpha) * t_c
        u = (u_star if situation.compensation is None else situation.compensation) - pull
        rates = [-_matrix(plant, base.R_c) @ (pull + _matrix(plant, K_c or ()) @ x_c)]
        if isinstance(base, NaturalDamping):
            x_l, t_l = ca.SX.sym("x_l", m), ca.SX.sym("t_l", m)
            states.append(x_l)
            terms.append(t_l)
            names += _numbered("x_l", m)
            driven = _matrix(plant, base.Upsilon or ()) @ away[m:] + _matrix(plant, base.K_l) @ x_l
            arguments.append(_column(plant, base.beta_l) * driven)
            pull = _column(plant, base.alpha_l) * t_l
            u = u - pull
            rates.append(-_matrix(plant, base.R_l) @ pull)
        if isinstance(situation.law, Integral):
            law, psi = situation.law, ca.SX.sym("psi", m)
            states.append(psi)
            names += _numbered("psi", m)
            height, steepness = _column(plant, law.alpha_psi), _column(plant, law.beta_psi)
            u = u - height * ca.tanh(steepness * psi)
            driven = height * steepness * away[:m] / ca.cosh(steepness * psi)
            rates.append(driven - _matrix(plant, law.R_psi) @ psi)
        held = [row[0] for row in plant.at(situation.point, read)[0]]
        z = ca.vertcat(system.x, *states)
        moved = ca.vertcat(system.f + system.g @ u, *rates)
        star = (*situation.point.x, *[ZERO] * (z.numel() - system.n))
        symbols = (ca.vertcat(read_star, u_star), plant.parameter_symbols)
        values = ((*held, *situation.point.u), tuple(reals(plant.parameter_values)))
        all_names = (*system.state_names, *names)
        return WholeLoop(z, ca.vertcat(*terms), moved, ca.vertcat(*arguments), all_names, star, symbols, values)


def _numbered(name: str, m: int) -> list[str]:
    return [name] if m == 1 else [f"{name}_{i + 1}" for i in range(m)]


def _column(plant: Plant, gain: Vector) -> ca.SX:
    return ca.vertcat(*map(plant.number, gain))


def _matrix(plant: Plant, gain: Matrix | Sequence[Sequence[Fraction]]) -> ca.SX:
    return ca.vertcat(*[ca.horzcat(*map(plant.number, row)) for row in gain])
