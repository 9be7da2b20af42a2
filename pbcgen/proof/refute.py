"""Looking for a counterexample of ``h(x) >= 0``, and confirming it in ball arithmetic at a rational point.

Random samples alone miss a function that is negative only in a narrow band or a small ball. The search therefore
combines, in this order and with a fixed seed:

* random states on many scales;
* probes: states where an inner quantity of the formula vanishes or is extremal (:mod:`pbcgen.proof.probes`);
* dense scans along coordinates and along lines through what was found, refined where the values dip;
* local optimisation of ``h/scale`` from the best states of each of these.

Only the confirmation counts: a search that finds nothing proves nothing, but says how close it came.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

import numpy as np

from pbcgen.proof.probes import probe
from pbcgen.proof.scans import descend, scan_coordinates, scan_lines
from pbcgen.proof.seeker import Interval, Question, Seeker, distinct, spread
from pbcgen.symbolic.real import BITS, Real, is_finite, precision, rational, sign

_SAMPLES = 12_000
_CONFIRMATIONS = 24


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


def refute(question: Question) -> Search:
    """Search for a state with ``value < 0`` and confirm it; see the module for how."""
    seeker = Seeker(question)
    if not seeker.active:
        seeker.offer(np.zeros((1, seeker.n)))
        return _confirmed(seeker)
    generator = np.random.default_rng(question.seed)
    for stage in (_sample, probe, scan_coordinates, scan_lines, descend):
        stage(seeker, generator)
        found = _confirmed(seeker)
        if found.point is not None:
            return found
    return found


def _sample(seeker: Seeker, generator: np.random.Generator) -> None:
    count = min(_SAMPLES, seeker.affordable(0.15))
    points = np.vstack([np.zeros((1, seeker.n)), spread(seeker.lower, seeker.upper, count, generator)])
    seeker.remember(points, seeker.offer(points, 60))


def _confirmed(seeker: Seeker) -> Search:
    """The first of the lowest states at which the value is certainly negative."""
    lowest = seeker.best[0] if seeker.best else (float("inf"), (0.0,) * seeker.n)
    with precision(BITS):
        lowest_states = [where for value, where in distinct(seeker.best, _CONFIRMATIONS) if value < 0]
        suspects, seeker.suspects = seeker.suspects, []
        for where in [*lowest_states, *suspects]:
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
    """The point with zeros and as few digits as show the same, so that it can be written down and checked again."""
    for k, bounds in enumerate(question.bounds):
        trial = tuple(_clipped(Fraction(0), bounds) if i == k else v for i, v in enumerate(point))
        if point[k] != 0 and _negative(question, trial) is not None:
            point = trial
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
