"""The search of gains: differential evolution and simplexes on trial runs, judged route by route."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from pbcgen.models.laws import Integral, Law, NaturalDamping, base_law
from pbcgen.sampling.linearisation import Figures
from pbcgen.tuning.gain_space import DIGITS, Space, rebuilt
from pbcgen.tuning.trial import Response, entries
from pbcgen.tuning.tuning_problem import Problem, Route, meet_theta, shaped, unmet

#: A response that is worse by no more than this (about 3 % of the settling time) is as good.
_GENTLE = 0.03
#: Slopes of saturations, and the factors by which flatter ones are tried.
_SLOPES = ("beta", "beta_c")
_FLATTER = tuple(Fraction(f) for f in ("0.8", "0.6", "0.45", "0.3", "0.2", "0.15", "0.1", "0.06", "0.03", "0.01"))


@dataclass(eq=False)
class Judge:
    """Cost of a candidate on one route; remembers what it saw."""

    problem: Problem
    route: Route
    duration: float
    seen: list[tuple[float, Law]] = field(default_factory=list)
    lowest: float = math.inf
    best: float = math.inf
    ranked: list[tuple[float, NDArray[np.float64]]] = field(default_factory=list)

    def admissible(self, law: Law) -> Law | None:
        """The law, moved onto the conditions of the route where that is easy, or None if it breaks one."""
        if self.route == "linearisation":
            return law
        base = base_law(law)
        if isinstance(law, Integral):
            return None
        if isinstance(base, NaturalDamping):
            moved = meet_theta(self.problem, base)
            if moved is None:
                return None
            law = moved
        return law if shaped(self.problem, law) else None

    def cost(self, law: Law) -> float:
        """What the search minimises; 100 and more for laws that are not admissible."""
        candidate = self.admissible(law)
        if candidate is None:
            return 200.0
        figures = self.problem.spectrum.figures(
            self.problem.family.loop(candidate), self.problem.h, self.problem.wish.margin
        )
        if figures is None:
            return 180.0
        if figures.radius >= 1 or figures.abscissa >= 0:
            return 100.0 + min(50.0, 1e3 * max(figures.radius - 1, 0) + max(figures.abscissa, 0))
        self.lowest = min(self.lowest, figures.abscissa)
        found, value = self._run(candidate, figures, self.duration)
        if value < self.best and self.duration < self.problem.horizon:
            # A short run does not show what leaves the band again later: the best so far must settle for good.
            found, value = self._run(candidate, figures, self.problem.horizon)
        self.best = min(self.best, value)
        if math.isfinite(found.settling):
            # Slower candidates lose anyway: shorter runs decide that sooner.
            self.duration = min(self.duration, max(2.5 * found.settling, 50 * float(self.problem.h)))
        self.seen.append((value, candidate))
        return value

    def _run(self, candidate: Law, figures: Figures, duration: float) -> tuple[Response, float]:
        """A trial run and its cost."""
        found = self.problem.respond(candidate, duration)
        wished = self.problem.wish.damping
        penalty = 0.0 if wished is None else 5 * max(0.0, wished - figures.damping)
        return found, self.problem.cost(candidate, found, figures.abscissa, duration) + penalty

    def abscissa(self, space: Space, x: NDArray[np.float64]) -> float:
        """The abscissa alone, for the floor of the route; points that are stable are remembered."""
        candidate = self.admissible(space.law(x))
        if candidate is None:
            return 1e3
        loop = self.problem.family.loop(candidate)
        figures = self.problem.spectrum.figures(loop, self.problem.h, self.problem.wish.margin)
        if figures is None:
            return 1e3
        if figures.radius >= 1:
            return 1e2 * figures.radius
        self.lowest = min(self.lowest, figures.abscissa)
        self.ranked.append((figures.abscissa, np.array(x)))
        return figures.abscissa


def best_rounded(problem: Problem, judge: Judge, laws: Sequence[Law]) -> list[Law]:
    """The laws with rounded gains, those that meet the wish first, then by their cost over the whole run."""
    judge.duration = problem.duration
    ranked = []
    for law in laws:
        rounded = rounded_law(problem, judge.route, law)
        figures = problem.spectrum.figures(problem.family.loop(rounded), problem.h, Fraction(1))
        open_wishes = unmet(problem.wish, problem.respond(rounded, problem.duration), figures)
        judge.duration = problem.duration
        ranked.append((len(open_wishes), judge.cost(rounded), rounded))
    return [law for _, _, law in sorted(ranked, key=lambda item: item[:2])]


def gentler(problem: Problem, judge: Judge, law: Law) -> Law:
    """The law with the flattest saturations, all beta multiplied by one factor, that is about as good.

    A steep saturation switches: it passes the noise of the sensors on. The search itself does not see that.
    """

    def open_wishes(candidate: Law) -> int:
        figures = problem.spectrum.figures(problem.family.loop(candidate), problem.h, Fraction(1))
        return len(unmet(problem.wish, problem.respond(candidate, problem.duration), figures))

    def cost(candidate: Law) -> float:
        judge.duration = problem.duration
        return judge.cost(candidate)

    seen = list(judge.seen)
    most, wishes, chosen = cost(law) + _GENTLE, open_wishes(law), law
    for factor in _FLATTER:
        given = entries(law)
        steep = {name: tuple(v * factor for v in values) for name, values in given.items() if name in _SLOPES}
        candidate = rounded_law(problem, judge.route, rebuilt(law, {**given, **steep}))
        if cost(candidate) > most or open_wishes(candidate) > wishes:
            break
        chosen = candidate
    judge.seen[:] = seen
    return chosen


def wish_is_met(problem: Problem, judge: Judge) -> bool:
    """Whether some candidate does what was wished, with rounded gains; true without a wish."""
    ranked = distinct(sorted(judge.seen, key=lambda item: item[0]))
    seen = list(judge.seen)
    best = best_rounded(problem, judge, ranked[:3])[0]
    judge.seen[:] = seen
    figures = problem.spectrum.figures(problem.family.loop(best), problem.h, Fraction(1))
    return not unmet(problem.wish, problem.respond(best, problem.duration), figures)


def search(problem: Problem, judge: Judge, seed: int) -> None:
    """Differential evolution on numbers common to all channels, then simplexes on each channel's own.

    The evolution starts from the given gains, the loops with the fastest slowest mode, and a sample of the box.
    """
    from scipy.optimize import differential_evolution, minimize
    from scipy.stats import qmc

    space = problem.space(common=True)
    lower, upper = np.array(space.bounds).T
    size = 5 * len(lower)
    sample = qmc.scale(qmc.LatinHypercube(len(lower), rng=seed).random(size), lower, upper)
    fastest = [x for _, x in sorted(judge.ranked, key=lambda item: item[0])][: size // 2]
    population = np.array([space.start(), *fastest, *sample])[:size]
    differential_evolution(
        lambda x: judge.cost(space.law(x)),
        space.bounds,
        maxiter=max(2, round(problem.wish.effort * 0.6 / size)),
        init=np.clip(population, lower, upper),
        rng=seed,
        polish=False,
        tol=1e-3,
    )
    if not judge.seen:
        return
    own = problem.space(common=False)
    least, most = np.array(own.bounds).T
    for rank, edge in ((0, 0.3), (1, 0.3), (0, 0.1)):
        ranked = distinct(sorted(judge.seen, key=lambda item: item[0]))
        start = own.point(ranked[min(rank * 3, len(ranked) - 1)])
        simplex = [start, *(start + edge * np.eye(len(start)))]
        minimize(
            lambda x: judge.cost(own.law(np.clip(x, least, most))),
            start,
            method="Nelder-Mead",
            options={
                "maxfev": round(problem.wish.effort / 5),
                "initial_simplex": simplex,
                "xatol": 1e-3,
                "fatol": 1e-4,
            },
        )


def lowest_abscissa(problem: Problem, judge: Judge) -> None:
    """Look for the lowest spectral abscissa that the route allows, whatever the response."""
    from scipy.optimize import differential_evolution

    space = problem.space(common=True)
    differential_evolution(
        lambda x: judge.abscissa(space, x),
        space.bounds,
        maxiter=max(3, round(problem.wish.effort / (8 * len(space.bounds)))),
        popsize=5,
        init="sobol",
        x0=space.start(),
        rng=problem.wish.seed + 1,
        polish=False,
    )


def distinct(ranked: list[tuple[float, Law]]) -> list[Law]:
    """The laws of a ranking without near copies: each costs somewhat more than the one before."""
    chosen: list[tuple[float, Law]] = []
    for value, law in ranked:
        if not chosen or value > chosen[-1][0] + 0.01:
            chosen.append((value, law))
    return [law for _, law in chosen]


def rounded_law(problem: Problem, route: Route, law: Law) -> Law:
    """Gains of a few digits; on the Lyapunov route R_l is raised where rounding took it below its bound."""
    space = problem.space(common=False)
    rounded = space.law(list(space.point(law)), DIGITS)
    if route == "lyapunov" and isinstance(rounded, NaturalDamping):
        return meet_theta(problem, rounded) or rounded
    return rounded
