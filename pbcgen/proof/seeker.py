"""A question ``h(x) >= 0`` compiled for many states at once, and the lowest states found so far."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.symbolic.doubles import Doubles
from pbcgen.symbolic.real import Real

Interval = tuple[Fraction | None, Fraction | None]
Points = NDArray[np.float64]
State = tuple[float, ...]

#: Instructions that one search may execute (about a second), and what calling them costs for each state.
_BUDGET = 120_000_000
_CALL = 60
#: States are evaluated in batches of these sizes.
_BATCHES = (1, 48, 512, 8192)
_KEPT = 600
_STARTS = 8


@dataclass(frozen=True, eq=False)
class Question:
    """Whether ``value >= 0`` on a box.

    Attributes:
        value: scalar SX of ``variables`` alone (parameters replaced by doubles).
        variables: n x 1 symbols.
        exact: the same function over exact numbers and balls, with the exact parameters.
        bounds: exact bounds of each variable; None is unbounded.
        scale: a nonnegative SX by which values are judged, or None for 1.
        seed: of the random states.
    """

    value: ca.SX
    variables: ca.SX
    exact: Callable[[Sequence[Real]], Real]
    bounds: tuple[Interval, ...]
    scale: ca.SX | None = None
    seed: int = 0


@dataclass(eq=False)
class Seeker:
    """The compiled question, the lowest states so far, and states from which a descent may lead lower.

    Suspects are states to be looked at exactly: where a damping changes its sign, rounding may hide it.
    """

    question: Question
    lower: Points = field(init=False)
    upper: Points = field(init=False)
    evaluations: int = 0
    best: list[tuple[float, State]] = field(default_factory=list)
    starts: list[Points] = field(default_factory=list)
    suspects: list[Points] = field(default_factory=list)

    def __post_init__(self) -> None:
        q = self.question
        value = q.value if q.scale is None else q.value / q.scale
        self.relative = Doubles([q.variables], [value])
        self.slope = Doubles([q.variables], [value, ca.gradient(value, q.variables)])
        self.cost = self.relative.function.n_instructions() + _CALL
        self.n = int(q.variables.numel())
        self.lower = np.array([-np.inf if lo is None else float(lo) for lo, _ in q.bounds])
        self.upper = np.array([np.inf if hi is None else float(hi) for _, hi in q.bounds])
        depends = [ca.which_depends(e, q.variables, 1, False) for e in (value, q.value)]  # h/scale may be constant
        self.active = [k for k in range(self.n) if any(d[k] for d in depends)]

    def affordable(self, share: float) -> int:
        """How many states may be evaluated with a share of the budget."""
        return max(200, int(share * _BUDGET / self.cost))

    def values(self, points: Points) -> Points:
        """h/scale at each row; infinite where it is undefined."""
        inside = np.clip(points, self.lower, self.upper)
        self.evaluations += len(inside)
        size = next((size for size in _BATCHES if size >= len(inside)), _BATCHES[-1])
        raw = np.empty(-(-len(inside) // size) * size)
        for k in range(0, len(inside), size):
            batch = inside[k : k + size]
            if len(batch) < size:
                batch = np.vstack([batch, np.broadcast_to(batch[-1], (size - len(batch), self.n))])
            raw[k : k + size] = self.relative.many(batch)[0].reshape(-1)
        raw = raw[: len(inside)]
        return np.asarray(np.where(np.isfinite(raw), raw, np.inf))

    def offer(self, points: Points, keep: int = 12) -> Points:
        """Evaluate states and remember the lowest."""
        if len(points) == 0:
            return np.zeros(0)
        inside = np.clip(points, self.lower, self.upper)
        found = self.values(inside)
        for k in np.argsort(found, kind="stable")[:keep]:
            if np.isfinite(found[k]):
                self.best.append((float(found[k]), tuple(float(v) for v in inside[k])))
        self.best.sort()
        del self.best[_KEPT:]
        return found

    def remember(self, points: Points, found: Points) -> None:
        """Keep the lowest of the states as starts of descents, whatever else was lower elsewhere."""
        order = np.argsort(found, kind="stable")
        self.starts += [points[k] for k in order[:_STARTS] if np.isfinite(found[k])]


def distinct(best: Sequence[tuple[float, State]], count: int) -> Iterator[tuple[float, State]]:
    """The lowest states that are not close to each other."""
    chosen: list[Points] = []
    for value, where in best:
        point = np.array(where)
        if all(np.max(np.abs(point - other) / (1e-9 + np.abs(other))) > 1e-3 for other in chosen):
            chosen.append(point)
            yield value, where
            if len(chosen) >= count:
                return


def spread(lower: Points, upper: Points, count: int, generator: np.random.Generator) -> Points:
    """Random states: uniform in bounded intervals, on scales from 1e-4 to 1e4 about zero elsewhere; count x n."""
    n = len(lower)
    unit = even(count, 2 * n + 1, generator)
    position, size, common = unit[:, :n], unit[:, n : 2 * n], unit[:, 2 * n :]
    exponents = np.where(np.arange(count)[:, None] % 2 == 0, common, size) * 8 - 4
    points = np.sign(position - 0.5) * 10.0**exponents
    whole = np.isfinite(lower) & np.isfinite(upper)
    low, high = np.where(whole, lower, 0), np.where(whole, upper, 0)
    uniform = low + position * (high - low)
    near = np.clip(points * (high - low) / 1e4, low, high)
    third = np.arange(count)[:, None] % 3 == 2
    points = np.where(whole, np.where(third, near, uniform), points)
    return np.asarray(np.clip(points, lower, upper))


def some_states(seeker: Seeker, generator: np.random.Generator, count: int) -> Points:
    """Zero, the two lowest states so far, and random ones; count x n."""
    low = [np.array(where) for _, where in distinct(seeker.best, 2)]
    random = spread(seeker.lower, seeker.upper, count - 1 - len(low), generator)
    return np.asarray(np.clip(np.vstack([np.zeros((1, seeker.n)), *low, random]), seeker.lower, seeker.upper))


def even(count: int, size: int, generator: np.random.Generator) -> Points:
    """Random points of the unit cube, one in each of ``count`` slices of every coordinate; count x size."""
    slices = generator.permuted(np.tile(np.arange(count), (size, 1)), axis=1).T
    return np.asarray((slices + generator.random((count, size))) / count)
