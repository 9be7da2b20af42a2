"""The closed loop linearised at x*: continuous, and sampled with a zero-order hold.

Everything is evaluated in exact or ball arithmetic on the enclosure of x*. At the target s = 0, so tanh(s) has slope
one and the implicit step gives ``(I + N) ds = dc``.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from pbcgen.control.graph import LawGraph
from pbcgen.control.scan import LinearLoop
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.shaping import add, inverse, multiply
from pbcgen.proof.definite import RealMatrix
from pbcgen.proof.spectrum import zero_order_hold
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, approximate, precision, rational
from pbcgen.symbolic.tape import Tape

#: How far the scan for the largest sample period goes, as multiples of the design's.
_SCAN = (1e-3, 1e4)
_SCAN_RATIO = 1.4


@dataclass(frozen=True)
class PlantSlope:
    """A = d(f + g u)/dx, B = g, H = dh/dx at (x*, u*)."""

    A: RealMatrix
    B: RealMatrix
    H: RealMatrix


@dataclass(frozen=True)
class StepSlope:
    """The linearised step: dxi+ = X_m dm + X_xi dxi, du = U_m dm + U_xi dxi."""

    X_m: RealMatrix
    X_xi: RealMatrix
    U_m: RealMatrix
    U_xi: RealMatrix


def plant_slope(plant: Plant, point: Point) -> PlantSlope:
    """Linearise the plant and the sensors."""
    system = plant.system
    A, B, H = plant.at(
        point,
        ca.densify(ca.jacobian(system.xdot, system.x)),
        ca.densify(system.g),
        ca.densify(ca.jacobian(system.measured_expressions, system.x)),
    )
    return PlantSlope(A, B, H)


@dataclass(frozen=True, eq=False)
class ClosedLoopSlope:
    """The law at the target together with the plant's slope."""

    plant: Plant
    point: Point
    graph: LawGraph
    slope: PlantSlope

    @staticmethod
    def of(plant: Plant, point: Point, graph: LawGraph) -> ClosedLoopSlope:
        """Prepare the linearisation of a law."""
        return ClosedLoopSlope(plant, point, graph, plant_slope(plant, point))

    def _at_target(self, *expressions: ca.SX) -> list[RealMatrix]:
        """SX in (m, xi, t) at the target."""
        system = self.plant.system
        (measured,) = self.plant.at(self.point, system.measured_expressions)
        symbols = [symbol for symbol, _ in self.graph.constants]
        tape = Tape.of(
            [self.graph.m, self.graph.xi, self.graph.t, ca.vertcat(*symbols) if symbols else ca.SX(0, 1)],
            [ca.densify(e) for e in expressions],
        )
        inputs: list[list[Real]] = [
            [row[0] for row in measured],
            [ZERO] * self.graph.xi.numel(),
            [ZERO] * self.graph.t.numel(),
            [value for _, value in self.graph.constants],
        ]
        return [matrix.dense(ZERO) for matrix in tape.walk(REAL, inputs)]

    def step(self, h: Fraction) -> StepSlope:
        """Linearise one step of the controller."""
        discrete, g = self.graph.discretise(h), self.graph
        parts = [discrete.c, discrete.next_state, discrete.output]
        jacobians = [ca.jacobian(part, symbol) for part in parts for symbol in (g.m, g.xi)]
        following_t, output_t = ca.jacobian(discrete.next_state, g.t), ca.jacobian(discrete.output, g.t)
        with precision(BITS):
            N, c_m, c_xi, x_m, x_xi, u_m, u_xi, x_t, u_t = self._at_target(
                discrete.N, *jacobians, following_t, output_t
            )
            identity = [[rational(int(i == j)) for j in range(len(N))] for i in range(len(N))]
            inverted = inverse(add(identity, N)) if N else []
            if inverted is None:
                raise ZeroDivisionError("the loop matrix I + N may be singular")
            s_m, s_xi = _product(inverted, c_m), _product(inverted, c_xi)
            return StepSlope(
                _sum(x_m, _product(x_t, s_m)),
                _sum(x_xi, _product(x_t, s_xi)),
                _sum(u_m, _product(u_t, s_m)),
                _sum(u_xi, _product(u_t, s_xi)),
            )

    def continuous(self) -> RealMatrix:
        """The Jacobian of the continuous closed loop in (x, xi)."""
        g, slope = self.graph, self.slope
        with precision(BITS):
            if g.xi.numel() == 0:
                u_m = self.step(Fraction(1)).U_m
                return add(slope.A, _product(slope.B, _product(u_m, slope.H)))
            rate, u = g.continuous
            r_m, r_xi, u_m, u_xi = self._at_target(
                *[ca.jacobian(part, symbol) for part in (rate, u) for symbol in (g.m, g.xi)]
            )
            top = _beside(add(slope.A, _product(slope.B, _product(u_m, slope.H))), _product(slope.B, u_xi))
            return [*top, *_beside(_product(r_m, slope.H), r_xi)]

    def linear(self) -> LinearLoop:
        """Plant and law apart, for scans over the sample period."""
        g, slope = self.graph, self.slope
        with precision(BITS):
            if g.xi.numel() == 0:
                u_m = self.step(Fraction(1)).U_m
                return LinearLoop(slope.A, slope.B, slope.H, [], [], u_m, [[] for _ in u_m])
            rate, u = g.continuous
            jacobians = [ca.jacobian(part, symbol) for part in (rate, u) for symbol in (g.m, g.xi)]
            return LinearLoop(slope.A, slope.B, slope.H, *self._at_target(*jacobians))

    def sampled(self, h: Fraction) -> RealMatrix:
        """The transition matrix over one sample period: exact zero-order hold and linearised step."""
        step = self.step(h)
        # Enclosures of the exponential lose about norm(A) h bits; the extra precision pays for them.
        norm = max((sum(abs(approximate(v)) for v in row) for row in self.slope.A), default=0.0)
        extra = min(4096, int(3 * norm * float(h)))
        with precision(BITS + extra):
            Ad, Bd = zero_order_hold(self.slope.A, self.slope.B, rational(h))
        with precision(BITS):
            top = _beside(add(Ad, _product(Bd, _product(step.U_m, self.slope.H))), _product(Bd, step.U_xi))
            bottom = _beside(_product(step.X_m, self.slope.H), step.X_xi)
            return [*top, *bottom]

    def scan(self, h: Fraction, start: float = 0.0) -> float | None:
        """The smallest sample period, in double precision, at which the sampled loop stops being stable.

        A scan upwards over a fine geometric grid, then bisection of the first bad step; None if all are stable, 0 if
        none is. It is an estimate: the claim `sampled-stable` is decided separately. Periods up to ``start`` are known
        to be stable and are left out.
        """
        A, B, H = (np.array([[approximate(v) for v in row] for row in m]) for m in _slope_parts(self.slope))

        def stable(period: float) -> bool:
            return _radius(
                A, B, H, self.step(Fraction(period).limit_denominator(10**12) or Fraction(1, 10**12)), period
            )

        good, period = start, max(float(h) * _SCAN[0], start * _SCAN_RATIO)
        while period < float(h) * _SCAN[1]:
            if not stable(period):
                return _bisect(stable, good, period) if good else 0.0
            good, period = period, period * _SCAN_RATIO
        return None


def _slope_parts(slope: PlantSlope) -> tuple[RealMatrix, RealMatrix, RealMatrix]:
    return slope.A, slope.B, slope.H


def _radius(A: NDArray[np.float64], B: NDArray[np.float64], H: NDArray[np.float64], step: StepSlope, h: float) -> bool:
    n, m = B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A * h, B * h
    if not np.all(np.isfinite(block)):
        return False
    with np.errstate(all="ignore"):
        exponential = expm(block)
    Ad, Bd = exponential[:n, :n], exponential[:n, n:]
    X_m, X_xi, U_m, U_xi = (
        np.array([[approximate(v) for v in row] for row in part]).reshape(len(part), len(part[0]) if part else 0)
        for part in (step.X_m, step.X_xi, step.U_m, step.U_xi)
    )
    plant = Ad + Bd @ U_m @ H
    loop = plant if X_xi.size == 0 else np.block([[plant, Bd @ U_xi], [X_m @ H, X_xi]])
    if not np.all(np.isfinite(loop)):
        return False
    return bool(np.max(np.abs(np.linalg.eigvals(loop))) < 1)


def _bisect(stable: object, good: float, bad: float) -> float:
    for _ in range(14):
        middle = (good + bad) / 2
        good, bad = (middle, bad) if stable(middle) else (good, middle)  # type: ignore[operator]
    return good


def _product(a: RealMatrix, b: RealMatrix) -> RealMatrix:
    """The product; an empty inner dimension gives no contribution (None-like empty rows)."""
    if not a or not b or not a[0]:
        return [[] for _ in a] if not b or not b[0] else [[ZERO] * len(b[0]) for _ in a]
    return multiply(a, b) if b[0] else [[] for _ in a]


def _sum(a: RealMatrix, b: RealMatrix) -> RealMatrix:
    return add(a, b) if b and b[0] else a


def _beside(a: RealMatrix, b: RealMatrix) -> RealMatrix:
    return [[*x, *y] for x, y in zip(a, b, strict=True)]
