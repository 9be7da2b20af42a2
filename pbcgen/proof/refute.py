"""Looking for a counterexample of ``h(x) >= 0``, and confirming it in ball arithmetic at a rational point.

Random samples alone miss a function that is negative only in a narrow band or a small ball. The search therefore
combines, in this order and with a fixed seed:

* quasi-random states on many scales;
* probes: states where an inner quantity of the formula vanishes or is extremal, because ``exp(-((v - v0)/w)^2)`` or
  ``tanh((v - v0)/w)`` hides a narrow feature at ``v = v0``, and the inner quantity leads there whatever the width;
* dense scans along coordinates and along lines through what was found, refined where the values dip;
* local optimisation of ``h/scale`` from the best states.

Only the confirmation counts: a search that finds nothing proves nothing, but says how close it came.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.symbolic.real import BITS, Real, is_finite, precision, rational, sign

Interval = tuple[Fraction | None, Fraction | None]
Points = NDArray[np.float64]

#: Instructions that one search may execute (about a second), and what calling them costs for each state.
_BUDGET = 120_000_000
_CALL = 60
#: States are evaluated in batches of these sizes.
_BATCHES = (1, 48, 512, 8192)
_SAMPLES = 12_000
#: Relative distance of the points of a dense scan.
_DENSITY = 5e-5
_DECADES = (-3.0, 3.0)
_STARTS = 24
_CONFIRMATIONS = 24
_MOST_PROBES = 40
#: Operations whose operand is worth probing: steep, bounded or singular somewhere.
_NAMES = (
    "EXP LOG POW CONSTPOW SQRT SQ SIN COS TAN ASIN ACOS ATAN SINH COSH TANH ASINH ACOSH ATANH ERF INV DIV "
    "FABS SIGN LT LE FMIN FMAX LOG1P EXPM1"
)
_PROBED = frozenset(getattr(ca, f"OP_{name}") for name in _NAMES.split())


@dataclass(frozen=True, eq=False)
class Question:
    """Whether ``value >= 0`` on a box.

    Attributes:
        value: scalar SX of ``variables`` alone (parameters replaced by doubles).
        variables: n x 1 symbols.
        exact: the same function over exact numbers and balls, with the exact parameters.
        bounds: exact bounds of each variable; None is unbounded.
        scale: a nonnegative SX by which values are judged, or None for 1.
        seed: of the quasi-random states.
    """

    value: ca.SX
    variables: ca.SX
    exact: Callable[[Sequence[Real]], Real]
    bounds: tuple[Interval, ...]
    scale: ca.SX | None = None
    seed: int = 0


@dataclass(frozen=True)
class Search:
    """What was found.

    Attributes:
        point: a rational point at which the value is certainly negative, or None.
        value: its enclosure there, or None.
        worst: the smallest value of h/scale in double precision.
        where: the state at which it occurs.
        evaluations: how many states were evaluated.
    """

    point: tuple[Fraction, ...] | None
    value: Real | None
    worst: float
    where: tuple[float, ...]
    evaluations: int

    @property
    def summary(self) -> str:
        """For the evidence of a verdict."""
        return f"{self.evaluations} states searched with seed 0, worst relative margin {self.worst + 0.0:.3g}"


@dataclass(eq=False)
class _Seeker:
    """The compiled question and the best states so far."""

    question: Question
    lower: Points = field(init=False)
    upper: Points = field(init=False)
    evaluations: int = 0
    best: list[tuple[float, tuple[float, ...]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        q = self.question
        value = q.value if q.scale is None else q.value / q.scale
        self.relative = ca.Function("relative", [q.variables], [value])
        gradient = ca.gradient(value, q.variables)
        self.slope = ca.Function("slope", [q.variables], [value, gradient])
        self.cost = self.relative.n_instructions() + _CALL
        self.mapped = {size: self.relative.map(size) for size in _BATCHES}
        self.n = int(q.variables.numel())
        self.lower = np.array([-np.inf if lo is None else float(lo) for lo, _ in q.bounds])
        self.upper = np.array([np.inf if hi is None else float(hi) for _, hi in q.bounds])
        depends = ca.which_depends(value, q.variables, 1, False)
        self.active = [k for k in range(self.n) if depends[k]]

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
            raw[k : k + size] = np.asarray(self.mapped[size](batch.T)).reshape(-1)
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
        del self.best[600:]
        return found


def refute(question: Question) -> Search:
    """Search for a state with ``value < 0`` and confirm it; see the module for how."""
    seeker = _Seeker(question)
    if not seeker.active:
        seeker.offer(np.zeros((1, seeker.n)))
        return _confirmed(seeker)
    generator = np.random.default_rng(question.seed)
    for stage in (_sample, _probe, _scan_coordinates, _scan_lines, _descend):
        stage(seeker, generator)
        found = _confirmed(seeker)
        if found.point is not None:
            return found
    return found


def _confirmed(seeker: _Seeker) -> Search:
    """The first of the lowest states at which the value is certainly negative."""
    lowest = seeker.best[0] if seeker.best else (float("inf"), (0.0,) * seeker.n)
    with precision(BITS):
        for value, where in _distinct(seeker.best, _CONFIRMATIONS):
            if value >= 0:
                break
            point = tuple(_inside(v, bounds) for v, bounds in zip(where, seeker.question.bounds, strict=True))
            if _negative(seeker.question, point) is None:
                continue
            simple, exact = _shortest(seeker.question, point)
            return Search(simple, exact, lowest[0], lowest[1], seeker.evaluations)
    return Search(None, None, lowest[0], lowest[1], seeker.evaluations)


def _negative(question: Question, point: Sequence[Fraction]) -> Real | None:
    """The value at the point if it is certainly negative."""
    value = question.exact([rational(v) for v in point])
    return value if is_finite(value) and sign(value) == -1 else None


def _shortest(question: Question, point: tuple[Fraction, ...]) -> tuple[tuple[Fraction, ...], Real | None]:
    """The point with as few digits as show the same, so that it can be written down and checked again."""
    for digits in (1, 2, 3, 4, 6, 9, 12, 15, 17, 25):
        rounded = (Fraction(f"{Decimal(v.numerator) / Decimal(v.denominator):.{digits}g}") for v in point)
        simple = tuple(_clipped(v, bounds) for v, bounds in zip(rounded, question.bounds, strict=True))
        value = _negative(question, simple)
        if value is not None:
            return simple, value
    return point, _negative(question, point)


def _inside(value: float, bounds: Interval) -> Fraction:
    """The double as a rational, moved into its exact interval."""
    return _clipped(Fraction(value), bounds)


def _clipped(value: Fraction, bounds: Interval) -> Fraction:
    lo, hi = bounds
    if lo is not None and value < lo:
        return lo
    return hi if hi is not None and value > hi else value


def _distinct(best: Sequence[tuple[float, tuple[float, ...]]], count: int) -> Iterator[tuple[float, tuple[float, ...]]]:
    """The lowest states that are not close to each other."""
    chosen: list[Points] = []
    for value, where in best:
        point = np.array(where)
        if all(np.max(np.abs(point - other) / (1e-9 + np.abs(other))) > 1e-3 for other in chosen):
            chosen.append(point)
            yield value, where
            if len(chosen) >= count:
                return


# --- where to look ------------------------------------------------------------------------------------------------


def spread(lower: Points, upper: Points, count: int, generator: np.random.Generator) -> Points:
    """Quasi-random states: uniform in bounded intervals, on scales from 1e-4 to 1e4 about zero elsewhere; count x n."""
    from scipy.stats import qmc

    n = len(lower)
    seed = int(generator.integers(2**31))
    unit = qmc.Halton(2 * n + 1, seed=seed).random(count)
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


def _sample(seeker: _Seeker, generator: np.random.Generator) -> None:
    count = min(_SAMPLES, seeker.affordable(0.15))
    seeker.offer(np.vstack([np.zeros((1, seeker.n)), spread(seeker.lower, seeker.upper, count, generator)]), 60)


def _bases(seeker: _Seeker, generator: np.random.Generator, count: int) -> Points:
    """States to start probes and scans from: zero, random ones, and the lowest so far."""
    low = [np.array(where) for _, where in _distinct(seeker.best, 2)]
    random = spread(seeker.lower, seeker.upper, 16, generator)[[0, 5, 9][: max(0, count - 1 - len(low))]]
    return np.asarray(np.clip(np.vstack([np.zeros((1, seeker.n)), *low, random]), seeker.lower, seeker.upper))


# --- probes -------------------------------------------------------------------------------------------------------


def inner_quantities(value: ca.SX) -> list[ca.SX]:
    """The operands of steep, bounded or singular operations in the graph of a scalar, deepest last."""
    found: dict[int, ca.SX] = {}
    seen: set[int] = set()
    waiting = [ca.SX(value)]
    while waiting:
        node = waiting.pop()
        key = node.element_hash()
        if key in seen or node.is_constant():
            continue
        seen.add(key)
        operands = [node.dep(k) for k in range(node.n_dep())]
        if operands and node.op() in _PROBED:
            chosen = operands[-1:] if node.op() in (ca.OP_DIV, ca.OP_INV) else operands
            found |= {o.element_hash(): o for o in chosen if not (o.is_constant() or o.is_symbolic())}
        waiting.extend(operands)
    return list(found.values())


def _probe(seeker: _Seeker, generator: np.random.Generator) -> None:
    """Zeros and critical points of the inner quantities, one after the other, and the middle between them."""
    quantities = inner_quantities(seeker.question.value)[:_MOST_PROBES]
    if not quantities:
        return
    x = seeker.question.variables
    newton = [
        ca.Function("probe", [x], [ca.densify(q), ca.densify(ca.gradient(q, x)), ca.densify(ca.hessian(q, x)[0])])
        for q in quantities
    ]
    points: list[Points] = []
    for base in _bases(seeker, generator, 4):
        zeros = [p for f in newton if (p := _zero_of(f, base, seeker)) is not None]
        points += zeros + [(a + b) / 2 for i, a in enumerate(zeros) for b in zeros[:i]]
        points += [p for f in newton if (p := _critical(f, base, seeker)) is not None]
        for step in (_zero_of, _critical):
            at = base
            for f in newton:
                moved = step(f, at, seeker)
                at = at if moved is None else moved
                points.append(at)
    seeker.offer(np.array(points), 60)
    _surround(seeker, np.array(points), generator)


def _zero_of(function: ca.Function, start: Points, seeker: _Seeker) -> Points | None:
    """A state where the quantity vanishes, by Newton steps of least length."""
    at = start
    for _ in range(6):
        value, gradient, _ = (np.asarray(v, dtype=float).ravel() for v in function(at))
        length = float(gradient @ gradient)
        if not np.isfinite(value[0]) or not np.isfinite(length) or length == 0:
            return None
        at = np.clip(at - value[0] * gradient / length, seeker.lower, seeker.upper)
    return at


def _critical(function: ca.Function, start: Points, seeker: _Seeker) -> Points | None:
    """A state where the gradient of the quantity vanishes, by Newton's method."""
    at = start
    for _ in range(6):
        _, gradient, hessian = (np.asarray(v, dtype=float) for v in function(at))
        if not (np.all(np.isfinite(hessian)) and np.all(np.isfinite(gradient))) or not np.any(hessian):
            return None
        at = np.clip(at - np.linalg.lstsq(hessian, gradient.ravel(), rcond=1e-12)[0], seeker.lower, seeker.upper)
    return at


def _surround(seeker: _Seeker, points: Points, generator: np.random.Generator) -> None:
    """States at many small distances of the probes."""
    count = min(len(points), max(1, seeker.affordable(0.1) // 12))
    chosen = points[np.linspace(0, len(points) - 1, count).astype(int)]
    sizes = 10.0 ** generator.uniform(-7, 0, (12, count, 1))
    offsets = generator.normal(size=(12, count, seeker.n)) * sizes * (1e-3 + np.abs(chosen))
    seeker.offer((chosen + offsets).reshape(-1, seeker.n), 60)


# --- scans --------------------------------------------------------------------------------------------------------


def _grid(lo: float, hi: float, density: float) -> Points:
    """Positions in [lo, hi] that are ``density`` apart, relatively to their distance from zero or to the width."""
    decades = _DECADES[1] - _DECADES[0]
    magnitudes = 10.0 ** np.arange(_DECADES[0], _DECADES[1], density / np.log(10))
    both = np.concatenate([-magnitudes[::-1], [0.0], magnitudes])
    if np.isfinite(lo) and np.isfinite(hi):
        even = np.linspace(lo, hi, int(decades / density / 4))
        both = np.concatenate([even, both * max(abs(lo), abs(hi)) * 10.0 ** -_DECADES[1]])
    return np.unique(both[(both >= lo) & (both <= hi)])


def _scan_coordinates(seeker: _Seeker, generator: np.random.Generator) -> None:
    """Dense scans along each coordinate through a few states."""
    bases = _bases(seeker, generator, 4)
    count = len(bases) * len(seeker.active)
    wanted = 2 * (_DECADES[1] - _DECADES[0]) * np.log(10) / _DENSITY
    density = _DENSITY * max(1.0, wanted / seeker.affordable(0.6 / count))
    grids = {k: _grid(seeker.lower[k], seeker.upper[k], density) for k in seeker.active}
    for base in bases:
        for k in seeker.active:
            direction = np.zeros(seeker.n)
            direction[k] = 1.0
            origin = base.copy()
            origin[k] = 0.0
            _scan(seeker, origin, direction, grids[k])


def _scan_lines(seeker: _Seeker, generator: np.random.Generator) -> None:
    """Scans along lines through pairs of the lowest states and random ones."""
    low = [np.array(where) for _, where in _distinct(seeker.best, 6)]
    others = list(spread(seeker.lower, seeker.upper, 6, generator))
    pairs = [(a, b) for i, a in enumerate(low) for b in [*low[:i], *others[:2]]][:16]
    steps = min(8000, seeker.affordable(0.15 / max(1, len(pairs))))
    for a, b in pairs:
        _scan(seeker, a, b - a, np.linspace(-1.0, 2.0, steps))


def _scan(seeker: _Seeker, origin: Points, direction: Points, grid: Points) -> None:
    """Evaluate along a line and look closer where the values dip."""
    if len(grid) < 3:
        return
    values = seeker.offer(origin + grid[:, None] * direction, 6)
    finite = np.where(np.isfinite(values), values, np.nanmax(np.where(np.isfinite(values), values, -np.inf)))
    if not np.all(np.isfinite(finite)):
        return
    with np.errstate(all="ignore"):
        bend = np.nan_to_num(finite[:-2] + finite[2:] - 2 * finite[1:-1])
    dips = np.flatnonzero((finite[1:-1] < finite[:-2]) & (finite[1:-1] <= finite[2:]))
    sharpest = dips[np.argsort(-bend[dips], kind="stable")[:6]]
    lowest = dips[np.argsort(finite[1:-1][dips], kind="stable")[:4]]
    for k in sorted({*sharpest.tolist(), *lowest.tolist()}):
        lo, hi = grid[k], grid[k + 2]
        for _ in range(4):
            fine = np.linspace(lo, hi, 41)
            j = int(np.argmin(seeker.offer(origin + fine[:, None] * direction, 2)))
            lo, hi = fine[max(j - 1, 0)], fine[min(j + 1, 40)]


# --- descent ------------------------------------------------------------------------------------------------------


def _descend(seeker: _Seeker, generator: np.random.Generator) -> None:
    """Local optimisation of h/scale from the lowest states, in variables scaled by the start."""
    from scipy.optimize import minimize

    del generator
    for start in [np.array(where) for _, where in _distinct(seeker.best, _STARTS)]:
        size = np.where(start != 0, np.abs(start), 1e-2)

        def objective(z: Points, size: Points = size) -> tuple[float, Points]:
            value, gradient = seeker.slope(z * size)
            seeker.evaluations += 1
            flat = np.asarray(gradient, dtype=float).ravel() * size
            result = float(value)
            return (result, flat) if np.isfinite(result) and np.all(np.isfinite(flat)) else (1e300, np.zeros_like(z))

        limits: Any = list(zip(seeker.lower / size, seeker.upper / size, strict=True))
        with np.errstate(all="ignore"):
            result = minimize(
                objective, start / size, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 60}
            )
        seeker.offer((result.x * size)[None, :])
