"""Trajectories of ``x' = F(x)`` in doubles as polynomials in pieces, with the motion of what starts nearby.

Collocation at Radau's points, which stiff decay does not disturb: what is slow is followed with large steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.polynomial import chebyshev, legendre
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

#: States, N x n, to F (N x n) and dF/dx (N x n x n).
Field: TypeAlias = Callable[[Array], tuple[Array, Array]]

_NEWTON_STEPS = 10
#: Steps that are tried along one trajectory, and the largest ratio of consecutive ones.
_MOST_STEPS, _FASTER = 300, 2.5
#: The share of the whole that is tried first.
_FIRST = 0.02
#: Steps of a smaller share are not taken.
_LEAST = 1e-12


@dataclass(frozen=True, eq=False)
class Rule:
    """Radau's points of a degree on [-1, 1] behind the start at -1, and what they make of values there.

    Attributes:
        points: (d + 1,), the start and the points.
        slope: (d + 1, d + 1), from values to derivatives.
        series: likewise, from values to Chebyshev coefficients.
    """

    points: Array
    slope: Array
    series: Array

    @staticmethod
    @lru_cache(8)
    def of(degree: int) -> Rule:
        """The rule of a degree."""
        radau = np.sort(legendre.legroots([0.0] * (degree - 1) + [-1.0, 1.0]).real)
        points = np.concatenate([[-1.0], radau[:-1], [1.0]])
        values = chebyshev.chebvander(points, degree)
        series = np.linalg.inv(values)
        derivative = np.zeros((degree + 1, degree + 1))
        derivative[:-1] = chebyshev.chebder(np.eye(degree + 1), axis=0)
        return Rule(points, values @ derivative @ series, series)


@dataclass(frozen=True, eq=False)
class Arc:
    """A piece of a trajectory.

    Attributes:
        rule: its points.
        duration: in seconds.
        states: (d + 1, n) at the points, the start first.
        linear: factors of the linear equations of the points, and the order of their rows.
    """

    rule: Rule
    duration: float
    states: Array
    linear: Any

    @cached_property
    def series(self) -> Array:
        """Chebyshev coefficients, (d + 1, n)."""
        return np.asarray(self.rule.series @ self.states)

    @cached_property
    def spread(self) -> Array:
        """The derivatives of the states at the points by the start, (d + 1, n, n)."""
        from scipy.linalg.lapack import dgetrs

        n = self.states.shape[1]
        pull = -self.rule.slope[1:, :1] * (2 / self.duration)
        moved, _ = dgetrs(*self.linear, np.kron(pull, np.eye(n)))
        return np.concatenate([np.eye(n)[None], moved.reshape(-1, n, n)])


def arc(field: Field, rule: Rule, start: Array, duration: float, guess: Array | None = None) -> Arc | None:
    """The trajectory from a start over some time, if Newton's method finds it; ``guess`` is (d + 1, n)."""
    from scipy.linalg.lapack import dgetrf, dgetrs  # without the checks around them, which take longer

    n, d = len(start), len(rule.points) - 1
    inner, pull = rule.slope[1:, 1:] * (2 / duration), rule.slope[1:, :1] * (2 / duration)
    states, fixed, last = np.tile(start, (d, 1)) if guess is None else guess[1:], np.kron(inner, np.eye(n)), np.inf
    for _ in range(_NEWTON_STEPS):
        rates, slopes = field(states)
        if not (np.all(np.isfinite(rates)) and np.all(np.isfinite(slopes))):
            return None
        matrix = fixed.copy()
        for k in range(d):
            matrix[k * n : k * n + n, k * n : k * n + n] -= slopes[k]
        *linear, singular = dgetrf(matrix)
        if singular:
            return None
        left = inner @ states + pull * start - rates
        move = dgetrs(*linear, left.ravel())[0].reshape(d, n)
        states, size = states - move, float(np.max(np.abs(move)))
        if not np.isfinite(size):
            return None
        if size < 1e-13 or 0.3 * last <= size < 1e-11:
            return Arc(rule, duration, np.concatenate([start[None], states]), linear)
        last = size
    return None


def arcs(
    field: Field,
    rule: Rule,
    start: Array,
    duration: float,
    tolerance: float,
    fits: Callable[[Arc], float] | None = None,
) -> Iterator[Arc]:
    """Pieces of a trajectory whose last coefficients are below a tolerance; they end early where none is found.

    Args:
        field: F.
        start: where the trajectory begins, (n,).
        rule: of all pieces.
        duration: of the whole.
        tolerance: in the units of the states.
        fits: how much longer a piece may be; those are taken for which that is at least 1.
    """
    degree, time, h = len(rule.points) - 1, 0.0, duration * _FIRST
    for _ in range(_MOST_STEPS):
        if h < _LEAST * duration:
            return
        left = duration - time
        h = left if h > left * (1 - 1e-9) else min(h, left / 2) if h > left * 0.75 else h
        found = arc(field, rule, start, h)
        if found is None:
            h /= 3
            continue
        tail = float(np.max(np.abs(found.series[-2:])))
        change = 0.8 * (tolerance / max(tail, 1e-300)) ** (1 / degree)
        share = max(0.2, change) if tail > tolerance else _FASTER if fits is None else fits(found)
        if share < 1:
            h *= share
            continue
        yield found
        if h == left:
            return
        time, start = time + h, found.states[-1]
        h *= min(_FASTER, share, max(0.5, change))
