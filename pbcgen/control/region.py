"""A region of attraction that is certified: where one quadratic storage decreases along the nonlinear loop.

With ``z' = F(z)``, ``F(0) = 0`` (z the deviation of plant and controller) the mean value theorem gives
``z' = J(z) z``, J(z) an average of Jacobians on the segment from 0 to z. If ``P Q + Q^T P < 0`` for every Q of an
interval matrix that contains all Jacobians over a box, the storage ``z^T P z`` decreases in the box, and every
sublevel set inside the box is a region of attraction of the continuous loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np
from flint import arb
from numpy.typing import NDArray

from pbcgen.control.derive import Derivation
from pbcgen.control.settings import matrix
from pbcgen.models.laws import Integral, NaturalDamping, PassiveOutput
from pbcgen.passivity.shaping import add, multiply, transpose
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import RealMatrix, positive_definite
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, approximate, ball, precision, rational, reals
from pbcgen.symbolic.tape import Tape

_HALVINGS = 60


@dataclass(frozen=True)
class Region:
    """``{z : z^T P z <= level}``, z the deviation of the plant and the arguments of the law's tanh terms.

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


def certified_region(found: Derivation) -> Region | None:
    """The largest multiple of one ellipsoid, to a few percent, on which the storage is proved to decrease.

    The coordinates are x, ``z_c = gamma~ + x_c``, ``z_l = Upsilon eta~ + K_l x_l`` and psi: each saturation depends
    on one coordinate, which keeps the interval matrix of the slopes tight.
    """
    if found.point is None or found.graph is None or found.gamma is None:
        return None
    plant, point, graph = found.plant, found.point, found.graph
    tape = _jacobian(found)
    names = (*plant.system.state_names, *(name.replace("x_", "z_") for name in graph.names))
    centre = [*point.x, *[ZERO] * len(graph.names)]
    constants = [value for _, value in graph.constants]
    offsets = [row[0] for row in plant.at(point, _signals(found))[0]]

    def slopes(widths: Sequence[Fraction]) -> RealMatrix:
        box: list[Real] = [
            ball(c) + ball(rational(w)) * arb(0, 1) if w else c for c, w in zip(centre, widths, strict=True)
        ]
        parameters = reals([plant.values[name] for name in plant.system.parameters.names])
        n = plant.system.n
        (matrix,) = tape.walk(REAL, [box[:n], box[n:], parameters, constants, offsets])
        return matrix.dense(ZERO)

    with precision(BITS):
        J = slopes([Fraction(0)] * len(names))
        P = _storage(np.array([[approximate(v) for v in row] for row in J]))
        if P is None:
            return None
        exact = [[rational(Fraction(float(v))) for v in row] for row in P]
        if positive_definite(exact).status is not Status.PROVED:
            return None
        return _grown(exact, P, names, slopes)


def _grown(
    exact: RealMatrix,
    P: NDArray[np.float64],
    names: tuple[str, ...],
    slopes: Callable[[Sequence[Fraction]], RealMatrix],
) -> Region | None:
    """The largest scale of the ellipsoid that passes: halving from a large one, then refined."""
    extent = np.sqrt(np.diag(np.linalg.inv(P)))

    def holds(scale: float) -> bool:
        return _decreases(exact, slopes([Fraction(float(e) * scale) for e in extent]))

    scale = 100.0 / float(np.max(extent))
    for _ in range(_HALVINGS):
        if holds(scale):
            break
        scale /= 2
    else:
        return None
    for factor in (1.4, 1.2, 1.1):
        if holds(scale * factor):
            scale *= factor
    return Region(names, P, scale**2, tuple(float(e) * scale for e in extent))


def _signals(found: Derivation) -> ca.SX:
    """What the filter coordinates are shifted by: gamma for x_c, Upsilon eta for x_l, nothing for psi."""
    assert found.gamma is not None
    base = found.law.base if isinstance(found.law, Integral) else found.law
    if isinstance(base, PassiveOutput):
        return ca.SX(0, 1)
    parts = [found.gamma]
    if isinstance(base, NaturalDamping) and found.eta is not None:
        parts.append(ca.mtimes(matrix(base.Upsilon or ()), found.eta))
    if isinstance(found.law, Integral):
        parts.append(ca.SX.zeros(found.plant.system.m))
    return ca.densify(ca.vertcat(*parts))


def _jacobian(found: Derivation) -> Tape:
    """The Jacobian of (x, zeta)' as a tape in (x, zeta, parameters, constants of the law, signals at the target)."""
    system, graph = found.plant.system, found.graph
    assert graph is not None
    base = found.law.base if isinstance(found.law, Integral) else found.law
    stretch = ca.SX.ones(graph.xi.numel())
    if isinstance(base, NaturalDamping):
        m = system.m
        stretch[m : 2 * m] = ca.DM([float(base.K_l[i][i]) for i in range(m)])
    signals, zeta = _signals(found), ca.SX.sym("zeta", graph.xi.numel())
    at_target = ca.SX.sym("signal", signals.numel())
    xi = (zeta - (signals - at_target)) / stretch if signals.numel() else zeta
    rate, u = (
        ca.substitute(ca.substitute(e, graph.m, system.measured_expressions), graph.xi, xi) if e.numel() else e
        for e in graph.continuous
    )
    xdot = ca.substitute(system.xdot, system.u, u)
    drift = ca.mtimes(ca.jacobian(signals, system.x), xdot) + stretch * rate if rate.numel() else rate
    slope = ca.jacobian(ca.vertcat(xdot, drift), ca.vertcat(system.x, zeta))
    symbols = [symbol for symbol, _ in graph.constants]
    constants = ca.vertcat(*symbols) if symbols else ca.SX(0, 1)
    return Tape.of([system.x, zeta, ca.SX(system.parameters.symbols), constants, at_target], [ca.densify(slope)])


def _storage(J: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """P = sum of the squares of the modal coordinates: each decays with its own rate. Zero where V is too ill."""
    if J.size == 0:
        return None
    values, V = np.linalg.eig(J)
    if np.max(values.real) >= 0 or np.linalg.cond(V) > 1e14:
        return None
    inverse = np.linalg.inv(V)
    P = np.real(inverse.conj().T @ inverse)
    P = (P + P.T) / 2
    return np.asarray(P / np.max(np.abs(P))) if np.all(np.linalg.eigvalsh(P) > 0) else None


def _decreases(P: RealMatrix, J: RealMatrix) -> bool:
    PJ = multiply(P, J)
    total = add(PJ, transpose(PJ))
    size = range(len(P))
    negative = [[-total[max(i, j)][min(i, j)] for j in size] for i in size]
    return positive_definite(negative).status is Status.PROVED
