"""Trial runs of the sampled closed loop with the gains as arguments, for the search of gains.

The plant is advanced by ROS2, a linearly implicit method of second order for any matrix in place of the Jacobian; here
that matrix is the Jacobian at the target, so the stiff part of a nearly linear plant is damped as it should. The law
is the discretised one. Of gains that are full matrices the diagonals are arguments, and the other entries follow them.
Runs are estimates: the gains that they lead to are checked separately.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.law.closed_loop import ROS2
from pbcgen.law.compensation import compensated_force
from pbcgen.law.graph import PSI_RANGE
from pbcgen.models.design import Design
from pbcgen.models.gains import Matrix, Vector, is_diagonal
from pbcgen.models.laws import Integral, Law, NaturalDamping, PassiveOutput, base_law, filters, gains
from pbcgen.passivity.plant import Plant, Point
from pbcgen.symbolic.real import approximate

Array = NDArray[np.float64]

#: Newton steps for ``s + mu tanh(s) = r`` in a trial.
_NEWTON = 7

#: Passes over the channels where a full K_c or R_c couples them.
_SWEEPS = 8


@dataclass(frozen=True)
class Run:
    """A trial: times (N,), the signals that have a target (N, k) as errors, states (N, n) and inputs (N - 1, m)."""

    times: Array
    errors: Array
    states: Array
    inputs: Array

    @property
    def finite(self) -> bool:
        """Whether the run stayed bounded."""
        return bool(np.all(np.isfinite(self.states)))


@dataclass(frozen=True)
class Response:
    """How a run settles.

    Attributes:
        settling: time after which every target signal stays within 2 % of its initial error, seconds; infinity if
            that does not happen within the run.
        rough: the same for twice the band: less abrupt in the gains.
        overshoot: the largest excursion beyond the target, as a share of the initial error.
        final: the largest error at the end, likewise.
        spread: integral of time times the relative error, seconds squared: smooth in the gains.
    """

    settling: float
    rough: float
    overshoot: float
    final: float
    spread: float


#: Share of the initial error within which a signal has settled.
BAND = 0.02


def response(run: Run) -> Response:
    """The figures of a run."""
    if not run.finite:
        return Response(float("inf"), float("inf"), float("inf"), float("inf"), 1e6)
    start = np.abs(run.errors[0])
    scale = np.where(start > 1e-12, start, np.maximum(np.max(np.abs(run.errors), axis=0), 1e-300))
    relative = run.errors / scale
    settling, rough = (_settled(run.times, relative, band) for band in (BAND, 2 * BAND))
    direction = np.where(run.errors[0] >= 0, -1.0, 1.0)
    beyond = np.max(relative * direction, axis=0)
    weight = np.trapezoid(run.times[:, None] * np.abs(relative), run.times, axis=0)
    beyond_target = max(0.0, float(np.max(beyond)))
    return Response(settling, rough, beyond_target, float(np.max(np.abs(relative[-1]))), float(np.max(weight)))


def _settled(times: Array, relative: Array, band: float) -> float:
    """The time after which all signals stay within the band; infinity if they do not within the run."""
    outside = np.any(np.abs(relative) > band, axis=1)
    last = int(np.max(np.nonzero(outside)[0], initial=-1))
    return float("inf") if last + 1 >= len(times) else float(times[last + 1])


@dataclass(frozen=True, eq=False)
class Trial:
    """The sampled loop of one design with free gains, matrices by their diagonals.

    Attributes:
        plant, point, gamma, eta: the system at its target.
        design: for law, target, initial state and sample period.
        law: the law with resolved gains; trials must be of its kind, with matrices like its (see :func:`like`).
        steps: plant steps in one sample period.
    """

    plant: Plant
    point: Point
    gamma: ca.SX
    eta: ca.SX | None
    design: Design
    law: Law
    steps: int = 1

    def run(self, law: Law, duration: float, push: Sequence[float] | None = None, most: int = 20000) -> Run:
        """The loop with another law of the same kind from the initial state, for so many seconds.

        ``push`` is a constant disturbance that is added to the inputs (m,).
        """
        h = float(self.design.sample_period)
        count = int(min(max(round(duration / h), 1), most))
        step, nx = self._step, self.plant.system.n
        start = np.concatenate([[float(v) for v in self.design.initial], np.zeros(self._xi.numel())])
        p = _flat(law)
        d = list(push) if push is not None else [0.0] * self.plant.system.m
        many = step.mapaccum(count)
        moved, inputs = (np.array(part) for part in many(start, p, d))
        states = np.hstack([start[:, None], moved])[:nx]
        errors = np.array(self._error.map(count + 1)(states)).T
        return Run(np.arange(count + 1, dtype=np.float64) * h, errors, states.T, inputs.T)

    @cached_property
    def _error(self) -> ca.Function:
        conditions = self.design.target.conditions
        gap = ca.vertcat(*[c.expression - float(c.value) for c in conditions])
        return ca.Function("error", [self.plant.system.x], [self._at_values(gap)])

    def _at_values(self, expression: ca.SX) -> ca.SX:
        parameters = self.plant.system.parameters
        if not len(parameters):
            return expression
        return ca.substitute(expression, ca.SX(parameters.symbols), ca.DM(parameters.numeric))

    @cached_property
    def _xi(self) -> ca.SX:
        return ca.SX.sym("xi", self.plant.system.m * filters(self.law))

    @cached_property
    def _step(self) -> ca.Function:
        """(z, gains, disturbance) -> z and u over one sample period."""
        system = self.plant.system
        p = ca.SX.sym("p", len(_flat(self.law)))
        h = float(self.design.sample_period)
        following, u = (self._at_values(part) for part in self._control(system.x, self._xi, _named(self.law, p), h))
        d = ca.SX.sym("d", system.m)
        after = self._plant_step(system.x, u + d, h)
        z = ca.vertcat(system.x, self._xi)
        return ca.Function("step", [z, p, d], [ca.vertcat(after, following), u])

    def _plant_step(self, x: ca.SX, u: ca.SX, h: float) -> ca.SX:
        system = self.plant.system
        values = self.plant.numeric(ca.jacobian(system.xdot, system.x))
        x_star = [approximate(v) for v in self.point.x]
        A = np.array(values(x_star, [approximate(v) for v in self.point.u]))
        dt = h / self.steps
        W = ca.sparsify(ca.DM(np.linalg.inv(np.eye(len(A)) - ROS2 * dt * A)))
        field = ca.Function("field", [system.x, system.u], [self._at_values(system.xdot)])
        for _ in range(self.steps):
            k1 = ca.mtimes(W, field(x, u))
            k2 = ca.mtimes(W, field(x + dt * k1, u) - 2 * k1)
            x = x + dt * (1.5 * k1 + 0.5 * k2)
        return x

    def _control(self, x: ca.SX, xi: ca.SX, g: Mapping[str, ca.SX], h: float) -> tuple[ca.SX, ca.SX]:
        """The discretised law: next xi and u."""
        m = self.plant.system.m
        base = base_law(self.law)
        star = [approximate(v) for v in self.point.x]
        u_star = ca.DM([approximate(v) for v in self.point.u])
        gamma = self.gamma - ca.substitute(self.gamma, self.plant.system.x, ca.DM(star))
        if isinstance(base, PassiveOutput):
            return xi, self._passive_output(g, gamma, u_star)
        parts = ca.vertsplit(xi, m)
        natural = isinstance(base, NaturalDamping)
        alpha, beta = (g["alpha_c"], g["beta_c"]) if natural else (g["alpha"], g["beta"])
        K_c, R_c = (_coupled(g[name], getattr(base, name)) for name in ("K_c", "R_c"))
        decay = ca.inv(ca.SX.eye(m) + h * ca.mtimes(R_c, K_c))
        push = ca.sparsify(ca.mtimes(h * ca.mtimes(decay, R_c), ca.diag(alpha)))
        eased = ca.mtimes(decay, parts[0])
        t = _saturated_together(ca.mtimes(ca.diag(beta), push), beta * (gamma + eased))
        following = [eased - ca.mtimes(push, t)]
        force = compensated_force(self.plant.system, base)
        offset = ca.SX(u_star) if force is None else force
        u = offset - alpha * t
        if natural and self.eta is not None:
            eta = self.eta - ca.substitute(self.eta, self.plant.system.x, ca.DM(star))
            drive = ca.mtimes(ca.DM([[float(v) for v in row] for row in base.Upsilon or ()]), eta)  # type: ignore[union-attr]
            push = h * g["R_l"] * g["alpha_l"]
            t = _saturated(g["beta_l"] * g["K_l"] * push, g["beta_l"] * (drive + g["K_l"] * parts[1]))
            following.append(parts[1] - push * t)
            u = u - g["alpha_l"] * t
        if isinstance(self.law, Integral):
            a, b = g["alpha_psi"], g["beta_psi"]
            moved = parts[-1] + h * a * b * gamma / ca.cosh(b * parts[-1])
            psi = ca.solve(ca.SX.eye(m) + h * _coupled(g["R_psi"], self.law.R_psi), moved)
            psi = ca.fmax(-PSI_RANGE / b, ca.fmin(PSI_RANGE / b, psi))
            following.append(psi)
            u = u - a * ca.tanh(b * psi)
        return ca.vertcat(*following), u

    def _passive_output(self, g: Mapping[str, ca.SX], gamma: ca.SX, u_star: ca.DM) -> ca.SX:
        system = self.plant.system
        slope = ca.jacobian(self.gamma, system.x)
        W = ca.mtimes(slope, system.g)
        shaped = u_star - g["alpha"] * ca.tanh(g["beta"] * gamma)
        y = ca.mtimes(slope, system.f) + ca.mtimes(W, shaped)
        s = y
        loop = ca.mtimes(W, ca.diag(g["k_p"]))
        if W.nnz():
            for _ in range(12):
                t = ca.tanh(s)
                matrix = ca.SX.eye(system.m) + ca.mtimes(loop, ca.diag(1 - t * t))
                s = s - ca.solve(matrix, s + ca.mtimes(loop, t) - y)
        return shaped - g["k_p"] * ca.tanh(s)


def _saturated(mu: ca.SX, r: ca.SX) -> ca.SX:
    """tanh(s) for the solution of ``s + mu tanh(s) = r``."""
    size = ca.fabs(r)
    s = ca.fmax(size / (1 + mu), size - mu)
    for _ in range(_NEWTON):
        t = ca.tanh(s)
        s = s - (s + mu * t - size) / (1 + mu * (1 - t * t))
    return ca.sign(r) * ca.tanh(s)


def _saturated_together(N: ca.SX, r: ca.SX) -> ca.SX:
    """tanh(s) for the solution of ``s + N tanh(s) = r``, channel by channel.

    N is a symmetric positive definite matrix between two diagonal ones, so this descends a convex function.
    """
    m = r.numel()
    if N.nnz() <= m:
        return _saturated(ca.diag(N), r)
    own = [N[i, i] for i in range(m)]
    t = [_saturated(own[i], r[i]) for i in range(m)]
    for _ in range(_SWEEPS):
        for i in range(m):
            t[i] = _saturated(own[i], r[i] - sum(N[i, j] * t[j] for j in range(m) if j != i))
    return ca.vertcat(*t)


def like(given: Matrix, diagonal: Sequence[Fraction]) -> Matrix:
    """A matrix with another diagonal, the other entries scaled with it, to four digits.

    ``K_ij sqrt(d_i d_j / (K_ii K_jj))``: but for the rounding it is positive definite like the given one.
    """
    factors = [float(d / given[i][i]) for i, d in enumerate(diagonal)]
    return tuple(
        tuple(
            diagonal[i] if i == j else Fraction(f"{float(v) * np.sqrt(factors[i] * factors[j]):.4g}")
            for j, v in enumerate(row)
        )
        for i, row in enumerate(given)
    )


def _coupled(diagonal: ca.SX, given: Matrix) -> ca.SX:
    """The same with symbols."""
    if is_diagonal(given):
        return ca.diag(diagonal)
    size = np.sqrt([float(row[i]) for i, row in enumerate(given)])
    pattern = ca.DM(np.array([[float(v) for v in row] for row in given]) / np.outer(size, size))
    root = ca.diag(ca.sqrt(diagonal))
    return ca.mtimes([root, pattern, root])


def entries(law: Law) -> dict[str, tuple[Fraction, ...]]:
    """The gains by name, matrices by their diagonals; Upsilon is not a gain to be chosen."""
    return {name: _diagonal(value) for name, value in gains(law).items() if name != "Upsilon"}


def _diagonal(value: Vector | Matrix) -> tuple[Fraction, ...]:
    listed: list[Any] = list(value)
    return tuple(Fraction(v[i] if isinstance(v, tuple) else v) for i, v in enumerate(listed))


def _flat(law: Law) -> list[float]:
    return [float(v) for values in entries(law).values() for v in values]


def _named(law: Law, p: ca.SX) -> dict[str, ca.SX]:
    result, start = {}, 0
    for name, values in entries(law).items():
        result[name] = p[start : start + len(values)]
        start += len(values)
    return result
