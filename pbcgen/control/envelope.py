"""The ln cosh terms of the Lyapunov function, minimised over the filter states.

With ``Phi(z) = sum_i (alpha_i/beta_i) ln cosh(beta_i z_i)`` the least value of ``Phi(s + x_c) + x_c^T K_c x_c / 2`` is
the Moreau envelope ``e(s)``. It is attained where ``z + K_c^{-1} f = s``, ``f_i = alpha_i tanh(beta_i z_i)``, and f is
its gradient. Its conjugate is known, so every z gives a lower bound:

    e(s) >= f^T (s - z) + Phi(z) - f^T K_c^{-1} f / 2,      with equality where z solves the equation for s.

Without a filter (`passive-output`) ``K_c^{-1} = 0``, and e = Phi.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from flint import arb, arb_mat
from numpy.typing import NDArray

from pbcgen.law.gain_matrices import exact_inverse
from pbcgen.models.gains import Matrix, Vector
from pbcgen.symbolic.real import Real, ball, is_finite, lower, rational, sign, upper

#: Rounds in which the channels' forces narrow each other.
_ROUNDS = 12
#: The rounds end when the forces' radii shrink by less than this.
_PROGRESS = 0.7
#: Relative distances at which a rounded root is on the wanted side.
_MARGINS = (1e-15, 1e-12, 1e-9, 1e-6)


class _Channel:
    """``z + slack tanh(beta z) = s`` for one channel, slack = alpha times its entry of K_c^{-1}."""

    def __init__(self, alpha: Fraction, beta: Fraction, compliance: Fraction) -> None:
        self.alpha, self.beta = rational(alpha), rational(beta)
        self.slack = rational(alpha * compliance)
        self._numbers = float(beta), float(alpha * compliance)

    def _root(self, s: float) -> float:
        """z for s >= 0 in double precision."""
        beta, slack = self._numbers
        z = max(s / (1 + slack * beta), s - slack)
        for _ in range(60):
            t = np.tanh(beta * z)
            step = (z + slack * t - s) / (1 + slack * beta * (1 - t * t))
            z -= step
            if abs(step) <= 1e-15 * (1 + abs(z)):
                break
        return float(max(z, 0.0))

    def _below(self, s: Fraction) -> Fraction:
        """A z with z + slack tanh(beta z) <= s, for s >= 0."""
        z = Fraction(self._root(float(s)))
        for margin in _MARGINS:
            candidate = max(z - Fraction(margin) * (1 + z), Fraction(0))
            if upper(self._argument(candidate)) <= s:
                return candidate
        return Fraction(0)

    def _above(self, s: Fraction) -> Fraction:
        """A z with z + slack tanh(beta z) >= s, for s >= 0."""
        z = Fraction(self._root(float(s)))
        for margin in _MARGINS:
            candidate = z + Fraction(margin) * (1 + z)
            if lower(self._argument(candidate)) >= s:
                return candidate
        return s

    def _argument(self, z: Fraction) -> arb:
        value = ball(rational(z))
        return value + ball(self.slack) * (ball(self.beta) * value).tanh()

    def force(self, s: Real) -> arb:
        """An enclosure of alpha tanh(beta z) for s in an enclosure; it increases with s."""
        if not is_finite(s):
            return ball(self.alpha) * arb(0, 1)
        ends = []
        for end, low in ((lower(s), True), (upper(s), False)):
            find = self._below if (end >= 0) == low else self._above
            z = find(abs(end)) * (1 if end >= 0 else -1)
            ends.append(ball(self.alpha) * (ball(self.beta) * rational(z)).tanh())
        return ends[0].union(ends[1])


class Envelope:
    """e(s) for all channels of a law together."""

    def __init__(self, alpha: Vector, beta: Vector, K_c: Matrix | None) -> None:
        size = range(len(alpha))
        compliance = [[Fraction(0)] * len(alpha) for _ in size] if K_c is None else exact_inverse(K_c)
        self.compliance = [[rational(v) for v in row] for row in compliance]
        self.channels = [_Channel(a, b, compliance[i][i]) for i, (a, b) in enumerate(zip(alpha, beta, strict=True))]
        self.coupled = any(compliance[i][j] for i in size for j in size if i != j)
        self._alpha = np.array([float(v) for v in alpha])
        self._beta = np.array([float(v) for v in beta])
        self._compliance = np.array([[float(v) for v in row] for row in compliance])

    def forces(self, s: Sequence[Real]) -> list[arb]:
        """Enclosures of f, the gradient of e: each channel alone, then in view of the others."""
        if not self.coupled:
            return [channel.force(v) for channel, v in zip(self.channels, s, strict=True)]
        f = [ball(channel.alpha) * arb(0, 1) for channel in self.channels]
        for _ in range(_ROUNDS):
            before = sum(float(v.rad()) for v in f)
            for i, channel in enumerate(self.channels):
                others = sum((ball(c) * f[j] for j, c in enumerate(self.compliance[i]) if j != i), arb(0))
                f[i] = f[i].intersection(channel.force(ball(s[i]) - others))
            if sum(float(v.rad()) for v in f) > _PROGRESS * before:
                break
        return f

    def least(self, s: Sequence[Real]) -> arb:
        """A ball that is not above e anywhere on the enclosure s: the supporting plane near its least point."""
        if not all(is_finite(v) for v in s):
            return arb(0)
        nearest = [0.0 if sign(v) in (None, 0) else float(min(lower(v), upper(v), key=abs)) for v in s]
        z = [rational(Fraction(float(v))) for v in self._solve(np.array(nearest))]
        f = [ball(c.alpha) * (ball(c.beta) * v).tanh() for c, v in zip(self.channels, z, strict=True)]
        total = arb(0)
        for i, channel in enumerate(self.channels):
            energy = (ball(channel.beta) * z[i]).cosh().log() * ball(channel.alpha) / ball(channel.beta)
            spring = sum((ball(c) * f[j] for j, c in enumerate(self.compliance[i])), arb(0)) * f[i] / 2
            total = total + f[i] * (ball(s[i]) - z[i]) + energy - spring
        return total if lower(total) > 0 else arb(0)

    def stiffness(self, s: Sequence[Real]) -> list[list[arb]]:
        """Enclosures of the Hessian ``(D^{-1} + K_c^{-1})^{-1}``, D = diag(alpha beta sech^2(beta z))."""
        size = range(len(self.channels))
        slopes = []
        for channel, f in zip(self.channels, self.forces(s), strict=True):
            t = f / ball(channel.alpha)
            sech = (1 - t * t).nonnegative_part()
            slopes.append([max(lower(sech), Fraction(0)), upper(sech)])
        if not self.coupled:
            return [[self._series(i, slopes[i]) if i == j else arb(0) for j in size] for i in size]
        roots = []
        for channel, (lo, hi) in zip(self.channels, slopes, strict=True):
            ends = [(ball(channel.alpha) * ball(channel.beta) * rational(v)).sqrt() for v in (lo, hi)]
            roots.append(ends[0].union(ends[1]))
        middle = arb_mat([[roots[i] * ball(self.compliance[i][j]) * roots[j] + (i == j) for j in size] for i in size])
        try:
            inverse = middle.inv()
        except ZeroDivisionError:
            return [[arb.nan() for _ in size] for _ in size]
        return [[roots[i] * inverse[i, j] * roots[j] for j in size] for i in size]

    def _series(self, i: int, slopes: Sequence[Fraction]) -> arb:
        """One channel's spring and the slope of its tanh in series; it increases with the slope."""
        channel = self.channels[i]
        ends = [ball(channel.beta) * rational(v) for v in slopes]
        values = [ball(channel.alpha) * v / (1 + ball(channel.slack) * v) for v in ends]
        return values[0].union(values[1])

    def series_at_target(self) -> NDArray[np.float64]:
        """The Hessian of e at s = 0, in double precision."""
        return np.asarray(np.linalg.inv(np.diag(1 / (self._alpha * self._beta)) + self._compliance))

    def _solve(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """z in double precision, by damped Newton on ``z + K_c^{-1} alpha tanh(beta z) = s``."""
        if not self.coupled:
            return np.array([np.sign(v) * c._root(abs(v)) for c, v in zip(self.channels, s, strict=True)])
        z = s / (1 + np.diag(self._compliance) * self._alpha * self._beta)
        for _ in range(80):
            t = np.tanh(self._beta * z)
            residual = z + self._compliance @ (self._alpha * t) - s
            slope = np.eye(len(s)) + self._compliance * (self._alpha * self._beta * (1 - t * t))
            step = np.linalg.solve(slope, residual)
            damping = 1.0
            while damping > 1e-3:
                trial = z - damping * step
                after = trial + self._compliance @ (self._alpha * np.tanh(self._beta * trial)) - s
                if np.linalg.norm(after) <= np.linalg.norm(residual):
                    break
                damping /= 2
            z = z - damping * step
            if np.linalg.norm(step) <= 1e-14 * (1 + np.linalg.norm(z)):
                break
        return np.asarray(z)

    def value(self, s: Sequence[float]) -> float:
        """e(s) in double precision."""
        z = self._solve(np.array(s, dtype=float))
        f = self._alpha * np.tanh(self._beta * z)
        return self.spring(z) + float(f @ self._compliance @ f / 2)

    def spring(self, z: NDArray[np.float64]) -> float:
        """Phi(z) in double precision."""
        return float(np.sum(self._alpha / self._beta * log_cosh(self._beta * z)))


def log_cosh(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """ln cosh(x) in double precision, elementwise, without overflow."""
    size = np.abs(x)
    return np.asarray(size + np.log1p(np.exp(-2 * size)) - np.log(2))
