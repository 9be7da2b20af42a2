"""Gains from limits, sample period and a wish: a search whose result is proved, not assumed.

The amplitudes come from the actuator limits by a linear program. The other gains are sought by differential evolution
and a simplex search on trial runs of the nonlinear sampled loop; eigenvalues that rank or reject candidates are
computed with 40 digits, because those of stiff loops in double precision can be far off. The gains are rounded to a
few digits, and the rounded gains must pass the claims of a full derivation and the margin of the sample period;
otherwise the next best candidate is taken.

Two routes: ``lyapunov`` admits only gains that meet every condition of the propositions, ``linearisation`` those whose
linearised loops, continuous and sampled, are stable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pbcgen.control.amplitudes import Room, blocking, largest_amplitudes, rooms
from pbcgen.control.attraction import region_of_attraction
from pbcgen.control.closed_loop import until_settled
from pbcgen.control.derive import Derivation, derive
from pbcgen.control.family import LoopFamily
from pbcgen.control.linearisation import Figures, Spectrum, spectral
from pbcgen.control.lyapunov_period import LyapunovPeriods, lyapunov_periods
from pbcgen.control.region import Region, certified_region
from pbcgen.control.sampled import Sampling
from pbcgen.control.saturation import offsets
from pbcgen.control.stability import LYAPUNOV
from pbcgen.control.trial import Response, Trial, entries, response
from pbcgen.errors import ModelError, NotProved
from pbcgen.models.design import Design
from pbcgen.models.exact import decimal
from pbcgen.models.gains import Vector
from pbcgen.models.laws import Integral, Law, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.passivity.dissipation import port_damping
from pbcgen.passivity.shaping import Shape, diagonal, shape_at
from pbcgen.passivity.storage import assumption_1
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.claim import EMISSION_CLAIMS, Claim, Status
from pbcgen.proof.definite import positive_definite
from pbcgen.symbolic.real import approximate, rational

Route = Literal["lyapunov", "linearisation"]
Progress = Callable[[str], None] | None

#: Premises that the Lyapunov route must keep beside those that code needs.
_LYAPUNOV_CLAIMS = ("assumption-1", "passive-output", "gradient-condition", "hessian-condition", "gain-definiteness",
                    "kc-bound", "assumption-3", "theta")  # fmt: skip

#: How far gains may move from those of the design, in decades.
_DECADES = {"beta": 3.0, "beta_c": 3.0, "R_c": 4.0, "beta_l": 5.0, "R_l": 5.0}
_USUAL_DECADES = 4.0

#: Theta and the Hessian thresholds are exceeded by this factor.
_CLEARANCE = Fraction(21, 20)

_DIGITS = 3

#: Searches with other seeds while the wish is not met.
_ROUNDS = 3

#: Candidates that are rounded and compared over the whole run before the first is proved.
_SHORTLIST = 10

#: Boxes for the search of a level set that is attracted to the target.
_REGION_BOXES = 5000

#: Weight of a slow tail against the settling time: a mode ten times slower costs as much as settling 1.8 times later.
_TAIL = 0.25


@dataclass(frozen=True)
class Wish:
    """What the loop should do.

    Attributes:
        routes: which routes to try.
        settling: time in seconds after which the target signals shall stay within 2 % of their initial error.
        overshoot: largest excursion beyond the target, as a share of the initial error.
        damping: least damping ratio of the modes of the sampled loop.
        margin: the loop must be proved stable with ``margin`` times the sample period too.
        seed: of the search. effort: about how many trial runs for each route and round; up to three rounds while the
            wish is not met.
    """

    routes: tuple[Route, ...] = ("lyapunov", "linearisation")
    settling: float | None = None
    overshoot: float | None = None
    damping: float | None = None
    margin: Fraction = Fraction(3, 2)
    seed: int = 0
    effort: int = 600

    def __post_init__(self) -> None:
        """Raise ModelError for a wish that is no wish."""
        for name, value in (("settling", self.settling), ("damping", self.damping)):
            if value is not None and not value > 0:
                raise ModelError(f"the wished {name} is {value:g}: a positive number was expected")
        if self.overshoot is not None and self.overshoot < 0:
            raise ModelError(f"the wished overshoot is {self.overshoot:g}: a share such as 0.05 was expected")
        if self.margin < 1:
            raise ModelError(f"the margin is {float(self.margin):g}: a factor of at least 1 on the sample period")


@dataclass(frozen=True)
class Attempt:
    """What one route found.

    Attributes:
        route: its name.
        law: the gains, or None when no gains passed.
        response: of the trial run with them.
        abscissa: the largest real part of the continuous linearised loop, 1/s. radius: of the sampled one.
        floor: the lowest abscissa that the search reached on this route, whatever the response.
        active: the constraints that stop the gains from going further.
        notes: what the route can say about its limits.
        claims: of the derivation with these gains.
        region: a certified ellipsoid of attraction where no level set of the storage was found, or None.
    """

    route: Route
    law: Law | None
    response: Response | None
    abscissa: float | None
    radius: float | None
    floor: float | None
    active: tuple[str, ...]
    notes: tuple[str, ...]
    claims: tuple[Claim, ...] = ()
    region: Region | None = None


@dataclass(frozen=True)
class Tuning:
    """The result: the best attempt and what it is compared with.

    Attributes:
        design: the design with the chosen law.
        before: the response with the gains of the given design.
        chosen: the attempt that ``design`` uses.
        attempts: all routes.
        amplitudes: the sum of the amplitudes of each input, from the limits.
        limits: the limits with what they leave.
        duration: of the trial runs, seconds.
    """

    design: Design
    before: Response
    chosen: Attempt
    attempts: tuple[Attempt, ...]
    amplitudes: Vector
    limits: tuple[Room, ...]
    duration: float


def tune(design: Design, wish: Wish | None = None, progress: Progress = None) -> Tuning:
    """Choose all gains of the design's law.

    Args:
        design: the system, its target, limits and sample period; its gains are where the search starts.
        wish: what the loop should do; settling as fast as possible by default.
        progress: told what is being done.

    Raises:
        NotProved: the target lies beyond a limit, something that no gains mend is not proved, or no gains passed.
    """
    wish = wish or Wish()
    if progress:
        progress("derive")
    problem = _Problem.of(design, wish)
    before = problem.respond(problem.law, problem.duration)
    attempts = tuple(_attempt(problem, route, before, progress) for route in wish.routes)
    passed = [a for a in attempts if a.law is not None and a.response is not None]
    if not passed:
        reasons = "; ".join(f"{a.route}: {', '.join(a.notes) or 'nothing passed'}" for a in attempts)
        raise NotProved(f"no gains were found for `{design.name}` that pass every claim: {reasons}")
    chosen = min(passed, key=lambda a: problem.merit(a.response or before, a.abscissa or 0.0))
    assert chosen.law is not None
    return Tuning(
        design.with_(law=chosen.law),
        before,
        chosen,
        attempts,
        problem.amplitudes,
        tuple(problem.limits),
        problem.duration,
    )


# --- the problem -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Problem:
    """One design with everything that candidates are judged by."""

    design: Design
    wish: Wish
    derivation: Derivation
    law: Law
    trial: Trial
    family: LoopFamily
    spectrum: Spectrum
    shape: Shape
    structure: PowerStructure | None
    limits: list[Room]
    amplitudes: Vector
    duration: float

    @staticmethod
    def of(design: Design, wish: Wish) -> _Problem:
        found = derive(design)
        if found.point is None or found.gamma is None or found.law is None or found.graph is None:
            raise NotProved(_stuck(found.claims))
        law, plant, point = found.law, found.plant, found.point
        family = LoopFamily.of(plant, point, found.gamma, found.eta)
        centres = offsets(plant, law, point)
        if centres is None:
            raise NotProved("the input has no bounded range: give the positions a bounded domain")
        limits = rooms(design, centres)
        closed = blocking(limits)
        if closed is not None:
            raise NotProved(
                f"the target is infeasible: without any feedback the input is at or beyond {closed.limit} "
                f"(by {float(-closed.room):.6g}); choose another target or actuator"
            )
        totals = _totals(law)
        amplitudes = largest_amplitudes(limits, totals) or totals
        storage = assumption_1(plant)
        compensated = isinstance(_base(law), PotentialCompensation)
        trial = Trial(plant, point, found.gamma, found.eta, design, law)
        spectrum = Spectrum(family.A)
        shape = shape_at(plant, point, found.gamma, compensated)
        structure = storage.structure if storage.proved else None
        length = found.loop.duration if found.loop is not None else until_settled(None, design.sample_period)
        duration = length if wish.settling is None else max(4 * wish.settling, 20 * _h(design))
        return _Problem(
            design, wish, found, law, trial, family, spectrum, shape, structure, limits, amplitudes,
            min(duration, length * 2),
        )  # fmt: skip

    @property
    def h(self) -> Fraction:
        return self.design.sample_period

    def respond(self, law: Law, duration: float) -> Response:
        return response(self.trial.run(law, duration))

    def merit(self, found: Response, abscissa: float) -> float:
        """The cost of a response: the logarithm of its settling time, with penalties for what was not wished.

        A slow mode with a small amplitude passes the 2 % band unseen, so the distance between the settling time and
        the slowest time constant counts too.
        """
        scale = self.wish.settling or self.duration
        urgency = 1.0 if self.wish.settling is None else 2.0
        if math.isfinite(found.settling):
            settling, rough = (max(t, float(self.h)) for t in (found.settling, found.rough))
            smooth = 0.5 * math.log(max(found.spread, 1e-12) / scale**2)
            late = 0.5 * math.log(settling / scale) + 0.25 * math.log(rough / scale) + 0.25 * smooth
            late += urgency * max(0.0, math.log(settling / scale)) + 2.0 * found.final
        else:
            settling = self.duration
            late = (1 + urgency) * math.log(settling / scale) + 1.5 + min(found.final, 10.0)
            late += min(found.spread / settling**2, 10.0)
        tail = math.log(max(1.0, 4.0 / (settling * max(-abscissa, 1e-30))))
        beyond = 0.0 if self.wish.overshoot is None else max(0.0, min(found.overshoot, 10.0) - self.wish.overshoot)
        return late + _TAIL * min(tail, 30.0) + 10 * beyond + 0.2 * min(found.overshoot, 5.0)

    def lyapunov_periods(self, law: Law) -> LyapunovPeriods:
        d = self.derivation
        assert d.gamma is not None
        return lyapunov_periods(d.plant, self.structure, d.gamma, d.eta, law, ())


def _h(design: Design) -> float:
    return float(design.sample_period)


def _base(law: Law) -> Law:
    return law.base if isinstance(law, Integral) else law


def _stuck(claims: Sequence[Claim]) -> str:
    needed = ("equilibrium", "passive-output", "measurability", "assumption-3")
    blocking_claims = [c for c in claims if c.claim in needed and c.status is not Status.PROVED]
    lines = [
        f"{c.claim} is {c.status}: {c.evidence}" + (f" (hint: {c.hint})" if c.hint else "") for c in blocking_claims
    ]
    return "no gains can be chosen: " + "; ".join(lines or ["the law cannot be written"])


def _totals(law: Law) -> Vector:
    groups = [values for name, values in entries(law).items() if _is_amplitude(name)]
    return tuple(sum(column, Fraction(0)) for column in zip(*groups, strict=True))


def _is_amplitude(name: str) -> bool:
    return name.startswith("alpha") or name == "k_p"


# --- candidates --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Space:
    """Gains as points of a box: shares of the amplitudes, and decades of the other gains around the given ones.

    ``common``: one number for each gain, the same for all channels; else one for each channel.
    """

    problem: _Problem
    common: bool

    @property
    def shares(self) -> list[str]:
        names = [name for name in entries(self.problem.law) if _is_amplitude(name) and name != "alpha_psi"]
        return names[:-1]

    @property
    def logs(self) -> list[str]:
        """The gains that are sought.

        K_l stays: with K_l x_l as the state only the product K_l R_l matters. So does the filter psi: what it is for,
        constant disturbances, does not occur in the trial runs.
        """
        found = entries(self.problem.law)
        return [
            name
            for name, values in found.items()
            if not _is_amplitude(name) and name != "K_l" and not name.endswith("_psi") and all(v > 0 for v in values)
        ]

    @property
    def bounds(self) -> list[tuple[float, float]]:
        m = 1 if self.common else self.problem.design.system.m
        box = [(0.03, 0.97)] * (len(self.shares) * m)
        for name in self.logs:
            reach = _DECADES.get(name, _USUAL_DECADES)
            box += [(-reach, reach)] * m
        return box

    def start(self) -> NDArray[np.float64]:
        """The given gains."""
        m = self.problem.design.system.m
        found = entries(self.problem.law)
        totals = _totals(self.problem.law)
        point: list[float] = []
        for name in self.shares:
            shares = [float(found[name][i] / totals[i]) for i in range(m)]
            point += [float(np.mean(shares))] if self.common else shares
        point += [0.0] * (len(self.logs) * (1 if self.common else m))
        return np.array(point)

    def per_channel(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """A point of the common space in the space with one number for each channel."""
        return np.repeat(x, self.problem.design.system.m)

    def law(self, x: Sequence[float] | NDArray[np.float64], digits: int | None = None) -> Law:
        """The law at a point; with ``digits`` rounded, amplitudes so that the limits still hold."""
        m = self.problem.design.system.m
        width = 1 if self.common else m
        values = iter([list(x[k : k + width]) * (m // width) for k in range(0, len(x), width)])
        found = entries(self.problem.law)
        chosen: dict[str, tuple[Fraction, ...]] = dict(found)
        left = list(self.problem.amplitudes)
        if "alpha_psi" in found:
            own = [a * b / c for a, b, c in zip(left, found["alpha_psi"], _totals(self.problem.law), strict=True)]
            chosen["alpha_psi"] = tuple(_round(v, digits) for v in own)
            left = [a - b for a, b in zip(left, chosen["alpha_psi"], strict=True)]
        for name in self.shares:
            shares = next(values)
            own = [
                Fraction(s).limit_denominator(10**6) * a for s, a in zip(shares, self.problem.amplitudes, strict=True)
            ]
            chosen[name] = tuple(_round(v, digits) for v in own)
            left = [a - b for a, b in zip(left, chosen[name], strict=True)]
        last = [name for name in found if _is_amplitude(name) and name != "alpha_psi"][-1]
        chosen[last] = tuple(left)
        for name in self.logs:
            factors = next(values)
            chosen[name] = tuple(
                _round(v * Fraction(10.0**f), digits) for v, f in zip(found[name], factors, strict=True)
            )
        return rebuilt(self.problem.law, chosen)


def _round(value: Fraction, digits: int | None) -> Fraction:
    return Fraction(f"{float(value):.{digits}g}") if digits is not None else Fraction(float(value))


def rebuilt(law: Law, chosen: dict[str, tuple[Fraction, ...]]) -> Law:
    """The law with other gains; matrices are given by their diagonals."""
    if isinstance(law, Integral):
        base = rebuilt(law.base, chosen)
        return Integral(base, chosen["alpha_psi"], chosen["beta_psi"], chosen["R_psi"])  # type: ignore[arg-type]
    names = entries(law)
    arguments: dict[str, Any] = {name: list(chosen[name]) for name in names}
    if isinstance(law, NaturalDamping):
        arguments["Upsilon"] = law.Upsilon
    made: Law = type(law)(**arguments)
    return made


# --- conditions --------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Judge:
    """Cost of a candidate on one route; remembers what it saw."""

    problem: _Problem
    route: Route
    duration: float
    seen: list[tuple[float, Law]] = field(default_factory=list)
    lowest: float = math.inf
    ranked: list[tuple[float, NDArray[np.float64]]] = field(default_factory=list)

    def admissible(self, law: Law) -> Law | None:
        """The law, moved onto the conditions of the route where that is easy, or None if it breaks one."""
        if self.route == "linearisation":
            return law
        base = _base(law)
        if isinstance(law, Integral):
            return None
        if isinstance(base, NaturalDamping):
            moved = meet_theta(self.problem, base)
            if moved is None:
                return None
            law = moved
        return law if _shaped(self.problem, law) else None

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
        found = self.problem.respond(candidate, self.duration)
        wished = self.problem.wish.damping
        penalty = 0.0 if wished is None else 5 * max(0.0, wished - figures.damping)
        value = self.problem.merit(found, figures.abscissa) + penalty
        if math.isfinite(found.settling):
            # Slower candidates lose anyway: shorter runs decide that sooner.
            self.duration = min(self.duration, max(2.5 * found.settling, 50 * float(self.problem.h)))
        self.seen.append((value, candidate))
        return value

    def abscissa(self, space: _Space, x: NDArray[np.float64]) -> float:
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


def _shaped(problem: _Problem, law: Law) -> bool:
    """The Hessian condition and the bound on K_c: ``H0 + N (A^-1 + K_c^-1)^-1 N^T > 0``, with clearance."""
    base = _base(law)
    found = entries(base)
    alpha = found.get("alpha", found.get("alpha_c", ()))
    beta = found.get("beta", found.get("beta_c", ()))
    stiffness = [a * b for a, b in zip(alpha, beta, strict=True)]
    if not isinstance(base, PassiveOutput):
        stiffness = [1 / (1 / s + 1 / k) for s, k in zip(stiffness, found["K_c"], strict=True)]
    A = diagonal([rational(s / _CLEARANCE) for s in stiffness])
    return positive_definite(problem.shape.hessian(A)).status is Status.PROVED


def meet_theta(problem: _Problem, law: NaturalDamping) -> NaturalDamping | None:
    """The law with R_l raised until Theta >= 0 at ``margin`` times the sample period, or None if no R_l does it."""
    bound = theta_bound(problem, law)
    if bound is None:
        return None
    R_l = []
    for i, row in enumerate(law.R_l):
        least = Fraction(bound) * _CLEARANCE / law.K_l[i][i]
        R_l.append(row[i] if row[i] >= least else Fraction(f"{float(least * Fraction(1003, 1000)):.4g}"))
    chosen = {**entries(law), "R_l": tuple(R_l)}
    made = rebuilt(law, chosen)
    assert isinstance(made, NaturalDamping)
    return made


def theta_bound(problem: _Problem, law: NaturalDamping) -> float | None:
    """What K_l R_l must exceed with the damping that ``margin`` sample periods leave, or None without such damping."""
    d = problem.derivation
    if problem.structure is None or d.gamma is None or d.eta is None:
        return None
    Lambda = port_damping(d.plant, problem.structure, d.gamma, d.eta)
    if Lambda is None:
        return None
    m, s = problem.design.system.m, int(d.eta.numel())
    half = problem.h * problem.wish.margin / 2
    rest = np.array([[approximate(v) for v in row] for row in Lambda])
    for i in range(m):
        spent = law.alpha_c[i] * law.beta_c[i] + law.alpha_l[i] * law.beta_l[i]
        rest[s + i, s + i] -= float(half * spent)
    if np.linalg.eigvalsh(rest)[0] <= 0:
        return None
    C = np.hstack([np.array([[float(v) for v in row] for row in law.Upsilon or ()]), -np.eye(m)])
    return float(np.linalg.eigvalsh(C @ np.linalg.solve(rest, C.T) / 4)[-1])


# --- the search --------------------------------------------------------------------------------------------------


def _attempt(problem: _Problem, route: Route, before: Response, progress: Progress) -> Attempt:
    if route == "lyapunov" and isinstance(problem.law, Integral):
        note = "Prop. pro:int is a linearisation: there is no Lyapunov route for the law integral"
        return Attempt(route, None, None, None, None, None, (), (note,))
    if progress:
        progress(f"lowest abscissa, {route}")
    limit = problem.duration if problem.wish.settling or not math.isfinite(before.settling) else before.settling * 1.5
    judge = _Judge(problem, route, min(problem.duration, max(limit, 50 * float(problem.h))))
    _floor(problem, judge)
    if progress:
        progress(f"search, {route}")
    for attempt in range(_ROUNDS):
        _search(problem, judge, problem.wish.seed + attempt)
        if not judge.seen or _wish_is_met(problem, judge):
            break
    floor = judge.lowest if math.isfinite(judge.lowest) else None
    ranked = _distinct(sorted(judge.seen, key=lambda item: item[0]))
    reason = "no candidate met the conditions of the route"
    for rounded in _best_rounded(problem, judge, ranked[:_SHORTLIST])[:6]:
        if progress:
            progress(f"prove, {route}")
        derived = derive(problem.design.with_(law=rounded), None, Sampling())
        failed = _failed(problem, route, derived)
        if failed is None:
            return _described(problem, route, rounded, derived, floor)
        reason = failed
    notes = (f"the candidates failed at {reason}",) if judge.seen else (reason,)
    return Attempt(route, None, None, None, None, floor, (), notes)


def _best_rounded(problem: _Problem, judge: _Judge, laws: Sequence[Law]) -> list[Law]:
    """The laws with rounded gains, those that meet the wish first, then by their cost over the whole run."""
    judge.duration = problem.duration
    ranked = []
    for law in laws:
        rounded = _rounded(problem, judge.route, law)
        figures = problem.spectrum.figures(problem.family.loop(rounded), problem.h, Fraction(1))
        unmet = _unmet(problem.wish, problem.respond(rounded, problem.duration), figures)
        judge.duration = problem.duration
        ranked.append((len(unmet), judge.cost(rounded), rounded))
    return [law for _, _, law in sorted(ranked, key=lambda item: item[:2])]


def _wish_is_met(problem: _Problem, judge: _Judge) -> bool:
    """Whether some candidate does what was wished, with rounded gains; true without a wish."""
    ranked = _distinct(sorted(judge.seen, key=lambda item: item[0]))
    seen = list(judge.seen)
    best = _best_rounded(problem, judge, ranked[:3])[0]
    judge.seen[:] = seen
    figures = problem.spectrum.figures(problem.family.loop(best), problem.h, Fraction(1))
    return not _unmet(problem.wish, problem.respond(best, problem.duration), figures)


def _search(problem: _Problem, judge: _Judge, seed: int) -> None:
    """Differential evolution on numbers common to all channels, then simplexes on each channel's own.

    The evolution starts from the given gains, the loops with the fastest slowest mode, and a sample of the box.
    """
    from scipy.optimize import differential_evolution, minimize
    from scipy.stats import qmc

    space = _Space(problem, common=True)
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
    own = _Space(problem, common=False)
    least, most = np.array(own.bounds).T
    for rank, edge in ((0, 0.3), (1, 0.3), (0, 0.1)):
        ranked = _distinct(sorted(judge.seen, key=lambda item: item[0]))
        start = _point_of(own, ranked[min(rank * 3, len(ranked) - 1)])
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


def _point_of(space: _Space, law: Law) -> NDArray[np.float64]:
    found, origin = entries(law), entries(space.problem.law)
    totals = space.problem.amplitudes
    point = [float(v / t) for name in space.shares for v, t in zip(found[name], totals, strict=True)]
    for name in space.logs:
        point += [math.log10(float(v / o)) for v, o in zip(found[name], origin[name], strict=True)]
    return np.array(point)


def _floor(problem: _Problem, judge: _Judge) -> None:
    """Look for the lowest spectral abscissa that the route allows, whatever the response."""
    from scipy.optimize import differential_evolution

    space = _Space(problem, common=True)
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


def _distinct(ranked: list[tuple[float, Law]]) -> list[Law]:
    """The laws of a ranking without near copies: each costs somewhat more than the one before."""
    chosen: list[tuple[float, Law]] = []
    for value, law in ranked:
        if not chosen or value > chosen[-1][0] + 0.01:
            chosen.append((value, law))
    return [law for _, law in chosen]


def _rounded(problem: _Problem, route: Route, law: Law) -> Law:
    """Gains of a few digits; on the Lyapunov route R_l is raised where rounding took it below its bound."""
    space = _Space(problem, common=False)
    rounded = space.law(list(_point_of(space, law)), _DIGITS)
    if route == "lyapunov" and isinstance(rounded, NaturalDamping):
        return meet_theta(problem, rounded) or rounded
    return rounded


def _failed(problem: _Problem, route: Route, derived: Derivation) -> str | None:
    """The first claim that the gains do not pass, or None."""
    needed = set(EMISSION_CLAIMS) | (set(_LYAPUNOV_CLAIMS) if route == "lyapunov" else set())
    for claim in derived.claims:
        if claim.claim in needed and claim.status is not Status.PROVED:
            return f"{claim.claim}: {claim.evidence}"
    assert derived.law is not None
    longer = problem.h * problem.wish.margin
    periods = problem.lyapunov_periods(derived.law)
    if route == "lyapunov" and periods.largest is not None and longer < periods.largest:
        return None
    if spectral(problem.family.loop(derived.law), longer).status is not Status.PROVED:
        return f"the margin: stability at {float(longer):.4g} s is not proved"
    return None


# --- saying why --------------------------------------------------------------------------------------------------


def _described(problem: _Problem, route: Route, law: Law, derived: Derivation, floor: float | None) -> Attempt:
    resolved = derived.law or law
    figures = problem.spectrum.figures(problem.family.loop(resolved), problem.h, Fraction(1))
    active: list[str] = _active(problem, route, resolved)
    notes: list[str] = []
    if route == "lyapunov" and floor is not None:
        notes.append(f"the search moved the spectral abscissa no lower than {floor:.4g} 1/s on this route")
        if isinstance(_base(resolved), NaturalDamping):
            notes[-1] += (
                "; Theta makes K_l R_l so large that x_l adds little (u_l is about -eta'/(K_l R_l)): the natural"
                " damping sets this limit"
            )
    if isinstance(resolved, Integral):
        notes.append(
            "beta_psi and R_psi are kept: the trial runs hold no disturbance that could tell what they should be"
        )
    region, sentence = _region(derived, route)
    notes.append(sentence)
    reached = problem.respond(resolved, problem.duration)
    notes += _unmet(problem.wish, reached, figures)
    periods = problem.lyapunov_periods(resolved)
    if periods.largest is not None:
        notes.append(f"the storage argument covers sample periods below {float(periods.largest):.4g} s")
    return Attempt(
        route,
        law,
        reached,
        None if figures is None else figures.abscissa,
        None if figures is None else figures.radius,
        floor,
        tuple(active),
        tuple(notes),
        derived.claims,
        region,
    )


def _unmet(wish: Wish, reached: Response, figures: Figures | None) -> list[str]:
    """What was wished and is not reached."""
    damping = math.inf if figures is None else figures.damping
    lines = []
    if wish.settling is not None and reached.settling > wish.settling:
        lines.append(f"the wished settling time of {wish.settling:g} s is not reached: {reached.settling:.4g} s")
    if wish.overshoot is not None and reached.overshoot > wish.overshoot:
        lines.append(f"the wished overshoot of {wish.overshoot:g} is not reached: {reached.overshoot:.4g}")
    if wish.damping is not None and damping < wish.damping:
        lines.append(f"the wished damping ratio of {wish.damping:g} is not reached: {damping:.4g}")
    return lines


def _region(derived: Derivation, route: Route) -> tuple[Region | None, str]:
    """The largest region that is certified: a level set of the storage, else an ellipsoid of the linearisation."""
    claims = {c.claim: c for c in derived.claims}
    if derived.situation is not None:
        everywhere = claims["globally-asymptotically-stable"].status is Status.PROVED
        by_storage = claims["stable"].method == LYAPUNOV
        found = region_of_attraction(derived.situation, by_storage, everywhere, _REGION_BOXES)
        if found.status is Status.PROVED:
            return None, f"region of attraction: {found.evidence}"
    if route == "linearisation":
        ellipsoid = certified_region(derived)
        if ellipsoid is not None:
            return ellipsoid, ellipsoid.sentence
    return None, "no region of attraction could be certified"


def _active(problem: _Problem, route: Route, law: Law) -> list[str]:
    """The constraints that are met with little to spare."""
    totals = _totals(law)
    found = [
        f"limit {room.limit}: {float(room.slack(totals)):.3g} left"
        for room in problem.limits
        if room.slack(totals) <= room.room / 100
    ]
    base = _base(law)
    if route == "lyapunov" and isinstance(base, NaturalDamping):
        bound = theta_bound(problem, base)
        product = min(float(base.K_l[i][i] * base.R_l[i][i]) for i in range(len(base.K_l)))
        if bound is not None and product < 2 * bound:
            found.append(f"theta: K_l R_l = {product:.5g}, needed {bound:.5g}")
    if not _shaped_with(problem, law, Fraction(5, 4)):
        found.append("hessian-condition: alpha beta and K_c are within 25 % of their thresholds")
    longer = problem.h * problem.wish.margin * Fraction(5, 4)
    figures = problem.spectrum.figures(problem.family.loop(law), longer, Fraction(1))
    if figures is None or figures.radius >= 1:
        found.append(f"sampled-stable: with {float(longer):.3g} s the loop is no longer stable")
    return found


def _shaped_with(problem: _Problem, law: Law, clearance: Fraction) -> bool:
    factors = {name: tuple(v / clearance for v in values) for name, values in entries(_base(law)).items()
               if name in ("beta", "beta_c", "K_c")}  # fmt: skip
    return _shaped(problem, rebuilt(_base(law), {**entries(_base(law)), **factors}))


def expression(law: Law) -> str:
    """The law as Python, to be pasted into a design file."""
    if isinstance(law, Integral):
        own = {name: value for name, value in entries(law).items() if name.endswith("_psi")}
        base = expression(law.base).replace("\n", "\n    ")
        return f"Integral(\n    {base},\n{_arguments(own)})"
    return f"{type(law).__name__}(\n{_arguments(entries(law))}{_upsilon(law)})"


def _arguments(values: dict[str, tuple[Fraction, ...]]) -> str:
    lines = []
    for name, entry in values.items():
        texts = [f'"{decimal(v)}"' for v in entry]
        lines.append(f"    {name}={texts[0] if len(texts) == 1 else '[' + ', '.join(texts) + ']'},\n")
    return "".join(lines)


def _upsilon(law: Law) -> str:
    given = getattr(law, "Upsilon", None)
    if given is None or all(v == int(i == j) for i, row in enumerate(given) for j, v in enumerate(row)):
        return ""
    rows = ", ".join("[" + ", ".join(f'"{decimal(v)}"' for v in row) + "]" for row in given)
    return f"    Upsilon=[{rows}],\n"
