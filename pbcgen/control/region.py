"""A region of attraction that is certified: where one quadratic storage decreases along the nonlinear loop.

With ``z' = F(z)``, ``F(0) = 0`` (z the deviation of plant and controller states) the mean value theorem gives
``z' = J(z) z``, J(z) an average of Jacobians on the segment from 0 to z. If ``P Q + Q^T P < 0`` for every Q of an
interval matrix that contains all Jacobians over a box, the storage ``z^T P z`` decreases in the box, and every
sublevel set inside the box is a region of attraction of the continuous loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.control.graph import LawGraph
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.shaping import add, multiply, transpose
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import RealMatrix, positive_definite
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, approximate, ball, precision, rational, reals
from pbcgen.symbolic.tape import Tape

_HALVINGS = 40


@dataclass(frozen=True)
class Region:
    """``{z : z^T P z <= level}``, z the deviation of (x, xi) from the target.

    Attributes:
        names: of the entries of z. P, level: the ellipsoid. reach: its half widths along each coordinate.
    """

    names: tuple[str, ...]
    P: NDArray[np.float64]
    level: float
    reach: tuple[float, ...]

    @property
    def sentence(self) -> str:
        """The region in words."""
        widths = ", ".join(f"{name} +- {width:.3g}" for name, width in zip(self.names, self.reach, strict=True))
        return f"certified region of attraction (continuous loop): an ellipsoid that reaches {widths}"


def certified_region(plant: Plant, point: Point, graph: LawGraph) -> Region | None:
    """The largest multiple of one ellipsoid, to a factor of two, on which the storage is proved to decrease."""
    tape = _jacobian(plant, graph)
    names = (*plant.system.state_names, *graph.names)
    centre = [*point.x, *[ZERO] * len(graph.names)]
    constants = [value for _, value in graph.constants]

    def slopes(widths: list[Fraction]) -> RealMatrix:
        box: list[Real] = [
            ball(c) + ball(rational(w)) * _unit() if w else c for c, w in zip(centre, widths, strict=True)
        ]
        parameters = reals([plant.values[name] for name in plant.system.parameters.names])
        n = plant.system.n
        (matrix,) = tape.walk(REAL, [box[:n], box[n:], parameters, constants])
        return matrix.dense(ZERO)

    with precision(BITS):
        J = slopes([Fraction(0)] * len(names))
        P = _storage(np.array([[approximate(v) for v in row] for row in J]))
        if P is None:
            return None
        exact = [[rational(Fraction(float(v))) for v in row] for row in P]
        if positive_definite(exact).status is not Status.PROVED:
            return None
        extent = np.sqrt(np.diag(np.linalg.inv(P)))
        scale = 1.0 / float(np.max(extent))
        scale *= max(1.0, *(abs(approximate(v)) for v in point.x))
        for _ in range(_HALVINGS):
            widths = [Fraction(float(e) * scale) for e in extent]
            if _decreases(exact, slopes(widths)):
                return Region(names, P, scale**2, tuple(float(w) for w in widths))
            scale /= 2
    return None


def _unit() -> Real:
    from flint import arb

    return arb(0, 1)


def _jacobian(plant: Plant, graph: LawGraph) -> Tape:
    """The Jacobian of (x, xi)' as a tape in (x, xi, parameters, constants of the law)."""
    system = plant.system
    rate, u = graph.continuous
    measured = system.measured_expressions
    law = [ca.substitute(e, graph.m, measured) if e.numel() else e for e in (rate, u)]
    xdot = ca.substitute(system.xdot, system.u, law[1])
    z = ca.vertcat(system.x, graph.xi)
    slope = ca.jacobian(ca.vertcat(xdot, law[0]), z)
    symbols = [symbol for symbol, _ in graph.constants]
    constants = ca.vertcat(*symbols) if symbols else ca.SX(0, 1)
    return Tape.of([system.x, graph.xi, ca.SX(system.parameters.symbols), constants], [ca.densify(slope)])


def _storage(J: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """P with ``P J + J^T P = -W``; W weighs the coordinates so that stiff ones do not rule."""
    from scipy.linalg import solve_continuous_lyapunov

    if J.size == 0:
        return None
    values, V = np.linalg.eig(J)
    if np.max(values.real) >= 0 or np.linalg.cond(V) > 1e14:
        return None
    inverse = np.linalg.inv(V)
    # z^T P z = |V^-1 z|^2 decays with each mode's own rate.
    P = np.real(inverse.conj().T @ inverse)
    weight = P @ J + J.T @ P
    if np.max(np.linalg.eigvalsh((weight + weight.T) / 2)) >= 0:
        P = solve_continuous_lyapunov(J.T, -np.real(inverse.conj().T @ np.diag(-2 * values.real) @ inverse))
    P = (P + P.T) / 2
    return P / np.max(np.abs(P)) if np.all(np.linalg.eigvalsh(P) > 0) else None


def _decreases(P: RealMatrix, J: RealMatrix) -> bool:
    PJ = multiply(P, J)
    total = add(PJ, transpose(PJ))
    size = range(len(P))
    negative = [[-total[max(i, j)][min(i, j)] for j in size] for i in size]
    return positive_definite(negative).status is Status.PROVED
