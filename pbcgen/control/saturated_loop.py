"""The closed loop as ``z' = F(z, t)``: the saturations t_i = tanh(beta_i z_i) apart from everything else.

z is the deviation of the plant's state followed by the arguments of the saturations, ``z_c = gamma~ + x_c``,
``z_l = Upsilon eta~ + K_l x_l`` and psi, so that each saturation depends on one coordinate. Gains enter exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from flint import arb, arb_mat

from pbcgen.control.derive import Derivation
from pbcgen.law.compensation import compensated_force
from pbcgen.models.gains import Matrix, Vector
from pbcgen.models.laws import Integral, NaturalDamping, PassiveOutput, base_law, shaping
from pbcgen.sampling.common_storage import Array
from pbcgen.symbolic.real import REAL, ZERO, Real, approximate, ball, lower, rational, reals, upper
from pbcgen.symbolic.tape import Tape

#: F_z and F_t at one point, and deviations from the target.
Slope = tuple[Array, Array]
Box = Sequence[tuple[float, float]]


@dataclass(frozen=True, eq=False)
class SaturatedLoop:
    """The loop as ``z' = F(z, t)``.

    Attributes:
        names: of z. tape: F_z and F_t in (x, zeta, t, parameters, numbers).
        numbers: exact or enclosed values of gains and target. centre: z at the target, enclosed.
        parameters: of the plant. beta, row: slope and coordinate of each tanh.
        start: z of the initial state. lift: dz/dx with the filters at rest, where that is constant.
        room: how far each coordinate may go before the plant leaves its declared domain.
    """

    names: tuple[str, ...]
    tape: Tape
    numbers: list[Real]
    centre: list[Real]
    parameters: list[Real]
    n: int
    beta: Vector
    row: tuple[int, ...]
    start: Array
    lift: Array | None
    room: Array

    @property
    def slope_of_tanh(self) -> Array:
        """beta in double precision."""
        return np.array([float(b) for b in self.beta])

    @cached_property
    def bending(self) -> tuple[int, ...]:
        """The coordinates on which the derivatives depend."""
        none, t = [(0.0, 0.0)] * len(self.names), [arb(1)] * len(self.beta)
        fixed = [v.rad() for part in self.slopes(none, t) for v in part.entries()]
        found = []
        for j in range(len(self.names)):
            moved = self.slopes([*none[:j], (-0.01, 0.01), *none[j + 1 :]], t)
            radii = [v.rad() for part in moved for v in part.entries()]
            if any(not a <= b * 2 + 1e-30 for a, b in zip(radii, fixed, strict=True)):
                found.append(j)
        return tuple(found)

    def cut(self, factor: Array) -> Array:
        """Half widths of ``|F z| <= 1`` along the plant's states, with the filters at rest where that is a plane."""
        if self.lift is None:
            return np.asarray(np.linalg.norm(np.linalg.inv(factor), axis=1)[: self.n])
        seen = factor @ self.lift
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(seen.T @ seen))))

    def size_of(self, factor: Array) -> float:
        """The geometric mean of these half widths."""
        return float(np.exp(np.mean(np.log(self.cut(factor)))))

    @property
    def bends(self) -> bool:
        """Whether more than the saturations is nonlinear."""
        return bool(self.bending)

    def at(self, z: Array) -> Slope:
        """F_z and F_t at a deviation from the target, in double precision."""
        box = [ball(c) + arb(float(d)) for c, d in zip(self.centre, z, strict=True)]
        t = [arb(float(v)) for v in np.tanh(self.slope_of_tanh * z[list(self.row)])]
        return tuple(floats(part) for part in self._walk(box, t))  # type: ignore[return-value]

    def matrix(self, slope: Slope, k: Array) -> Array:
        """``F_z + F_t diag(k beta)`` with the columns of the coordinates that the saturations depend on."""
        total = slope[0].copy()
        total[:, list(self.row)] += slope[1] * (k * self.slope_of_tanh)
        return total

    def _walk(self, box: Sequence[Real], t: Sequence[Real]) -> tuple[arb_mat, arb_mat]:
        found = self.tape.walk(REAL, [list(box[: self.n]), list(box[self.n :]), list(t), self.parameters, self.numbers])
        F_z, F_t = ([[ball(v) for v in row] for row in matrix.dense(ZERO)] for matrix in found)
        return arb_mat(F_z), arb_mat(F_t)

    def slopes(self, part: Box, limits: Sequence[arb]) -> tuple[arb_mat, arb_mat]:
        """Enclosures of F_z and F_t for all deviations in a box and t within the limits."""
        box = [
            c if lo == hi == 0 else ball(c) + arb(lo).union(arb(hi))
            for c, (lo, hi) in zip(self.centre, part, strict=True)
        ]
        return self._walk(box, [limit * arb(0, 1) for limit in limits])


@dataclass
class _Numbers:
    """Symbols that stand for exact or enclosed numbers, so that no product of them is rounded."""

    symbols: list[ca.SX]
    values: list[Real]

    def column(self, values: Sequence[Real]) -> ca.SX:
        own = [ca.SX.sym(f"number_{len(self.values) + k}") for k in range(len(values))]
        self.symbols += own
        self.values += values
        return ca.vertcat(*own) if own else ca.SX(0, 1)

    def floats(self) -> list[float]:
        """The numbers in double precision."""
        return [approximate(v) for v in self.values]

    def vector(self, values: Vector) -> ca.SX:
        return self.column([rational(v) for v in values])

    def matrix(self, rows: Matrix) -> ca.SX:
        """Zero entries stay structural."""
        result = ca.SX(len(rows), len(rows[0]))
        for i, row in enumerate(rows):
            for j, v in enumerate(row):
                if v:
                    result[i, j] = self.vector((v,))
        return result


def saturated_loop(found: Derivation) -> SaturatedLoop | None:
    """The loop in (x, zeta, t).

    None where the derivation stopped before the law, for `passive-output`, and where a function may jump.
    """
    law = found.law
    base = base_law(law)
    if found.point is None or found.graph is None or found.gamma is None:
        return None
    if law is None or isinstance(base, PassiveOutput):
        return None
    plant, point, system = found.plant, found.point, found.plant.system
    parts = [system.f, system.g, found.gamma, *([] if found.eta is None else [found.eta])]
    if system.mechanical is not None:
        parts += [system.mechanical.M, system.mechanical.V]
    if plant.jumps(*parts):
        return None
    numbers = _Numbers([], [])
    m = system.m
    term = shaping(law)
    beta = term.beta
    z_c, t_c = ca.SX.sym("z_c", m), ca.SX.sym("t_c", m)
    (star,) = plant.at(point, found.gamma)
    gamma = found.gamma - numbers.column([row[0] for row in star])
    force = compensated_force(system, base)
    a = numbers.vector(term.alpha)
    u = (numbers.column(list(point.u)) if force is None else force) - a * t_c
    K_c, R_c = numbers.matrix(term.K_c or ()), numbers.matrix(term.R_c or ())
    own = [-ca.mtimes(R_c, a * t_c + ca.mtimes(K_c, z_c - gamma))]
    moved, zeta, t = [found.gamma], [z_c], [t_c]
    if isinstance(base, NaturalDamping):
        if found.eta is None:
            return None
        z_l, t_l = ca.SX.sym("z_l", m), ca.SX.sym("t_l", m)
        a_l = numbers.vector(base.alpha_l)
        u = u - a_l * t_l
        rate = numbers.vector(tuple(base.K_l[i][i] * base.R_l[i][i] for i in range(m)))
        own.append(-rate * a_l * t_l)
        moved.append(ca.mtimes(numbers.matrix(base.Upsilon or ()), found.eta))
        beta, zeta, t = (*beta, *base.beta_l), [*zeta, z_l], [*t, t_l]
    if isinstance(law, Integral):
        psi, t_psi = ca.SX.sym("psi", m), ca.SX.sym("t_psi", m)
        a_psi, b_psi = numbers.vector(law.alpha_psi), numbers.vector(law.beta_psi)
        u = u - a_psi * t_psi
        own.append(-ca.mtimes(numbers.matrix(law.R_psi), psi) + a_psi * b_psi * gamma / ca.cosh(b_psi * psi))
        moved.append(ca.SX.zeros(m))
        beta, zeta, t = (*beta, *law.beta_psi), [*zeta, psi], [*t, t_psi]
    xdot = ca.substitute(system.xdot, system.u, u)
    drift = ca.mtimes(ca.jacobian(ca.vertcat(*moved), system.x), xdot) + ca.vertcat(*own)
    z, all_t = ca.vertcat(system.x, *zeta), ca.vertcat(*t)
    F = ca.vertcat(xdot, drift)
    symbols = ca.vertcat(*numbers.symbols)
    tape = Tape.of(
        [system.x, ca.vertcat(*zeta), all_t, found.plant.parameter_symbols, symbols],
        [ca.densify(ca.jacobian(F, z)), ca.densify(ca.jacobian(F, all_t))],
    )
    names = (*system.state_names, *(name.replace("x_", "z_") for name in found.graph.names))
    n = system.n
    return SaturatedLoop(
        names,
        tape,
        numbers.values,
        [*point.x, *[ZERO] * (len(names) - n)],
        reals(plant.parameter_values),
        n,
        beta,
        tuple(range(n, len(names))),
        _start(found, ca.vertcat(*moved), numbers),
        _lift(found, ca.vertcat(*moved), numbers),
        _room(found, len(names)),
    )


def _room(found: Derivation, size: int) -> Array:
    """The distance of x* from the ends of the domain, rounded down; infinite for the other coordinates."""
    assert found.point is not None
    room = np.full(size, np.inf)
    for k, (name, star) in enumerate(zip(found.plant.system.state_names, found.point.x, strict=True)):
        lo, hi = found.plant.system.domain.get(name, (None, None))
        ends = [*([] if lo is None else [lower(star) - lo]), *([] if hi is None else [hi - upper(star)])]
        room[k] = min((float(end) * (1 - 1e-12) for end in ends), default=np.inf)
    return room


def _lift(found: Derivation, moved: ca.SX, numbers: _Numbers) -> Array | None:
    """dz/dx of ``z = (x~, gamma~, Upsilon eta~, 0)``; None where it is not constant."""
    system = found.plant.system
    slope = ca.jacobian(moved, system.x)
    if ca.depends_on(ca.vec(slope), system.x):
        return None
    inputs = [found.plant.parameter_symbols, ca.vertcat(*numbers.symbols)]
    values = [[float(v) for v in found.plant.parameter_values], numbers.floats()]
    return np.vstack([np.eye(system.n), np.array(ca.Function("slope", inputs, [ca.densify(slope)])(*values))])


def _start(found: Derivation, moved: ca.SX, numbers: _Numbers) -> Array:
    """z of the initial state, the controller's states being zero."""
    assert found.point is not None
    system = found.plant.system
    parameters = found.plant.parameter_symbols
    signals = ca.Function("signals", [system.x, parameters, ca.vertcat(*numbers.symbols)], [moved])
    values = [
        [float(v) for v in found.plant.parameter_values],
        numbers.floats(),
    ]
    start, star = [float(v) for v in found.design.initial], [approximate(v) for v in found.point.x]
    away = np.array(signals(start, *values)).ravel() - np.array(signals(star, *values)).ravel()
    return np.concatenate([np.array(start) - np.array(star), away])


def floats(matrix: arb_mat) -> Array:
    """The centres of the balls."""
    return np.array([[float(matrix[i, j].mid()) for j in range(matrix.ncols())] for i in range(matrix.nrows())])
