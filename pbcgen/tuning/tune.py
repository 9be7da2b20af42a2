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
from dataclasses import dataclass
from fractions import Fraction

from pbcgen.control.amplitudes import Room
from pbcgen.control.attraction import attracted_level_set
from pbcgen.control.derive import Derivation, derive
from pbcgen.control.ellipsoid import Ellipsoid, certified_ellipsoid
from pbcgen.errors import NotProved
from pbcgen.models.design import Design
from pbcgen.models.gains import Matrix, Vector, is_diagonal
from pbcgen.models.laws import Integral, Law, NaturalDamping, amplitudes, base_law
from pbcgen.proof.claim import EMISSION_CLAIMS, Claim, Status
from pbcgen.sampling.linearisation import spectral
from pbcgen.tuning.gain_search import Judge, best_rounded, distinct, gentler, lowest_abscissa, search, wish_is_met
from pbcgen.tuning.gain_space import rebuilt
from pbcgen.tuning.trial import Response, entries
from pbcgen.tuning.tuning_problem import PUSH, Problem, Route, Wish, shaped, theta_bound, unmet

Progress = Callable[[str], None] | None

#: Premises that the Lyapunov route must keep beside those that code needs.
_LYAPUNOV_CLAIMS = (
    *("assumption-1", "passive-output", "gradient-condition", "hessian-condition"),
    *("gain-definiteness", "kc-bound", "assumption-3", "theta"),
)

#: A response must be better by this much (about 10 % of the settling time) to be preferred to a stronger proof.
_STRONGER = 0.1

#: Searches with other seeds while the wish is not met.
_ROUNDS = 3

#: Candidates that are rounded and compared over the whole run before the first is proved.
_SHORTLIST = 10

#: Boxes for the search of a level set that is attracted to the target.
_REGION_BOXES = 1500


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
        region: a certified ellipsoid of attraction where no level set of the storage was found.
        unmet: what was wished and is not reached.
    """

    route: Route
    law: Law | None = None
    response: Response | None = None
    abscissa: float | None = None
    radius: float | None = None
    floor: float | None = None
    active: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    claims: tuple[Claim, ...] = ()
    region: Ellipsoid | None = None
    unmet: tuple[str, ...] = ()


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
    problem = Problem.of(design, wish)
    before = problem.respond(problem.law, problem.horizon)
    attempts: list[Attempt] = []
    for route in wish.routes:
        # What one route found may serve the other: the conditions of `linearisation` are the weaker ones.
        seeds = [a.law for a in attempts if a.law is not None]
        attempts.append(_attempt(problem, route, before, seeds, progress))
    passed = [a for a in attempts if a.law is not None and a.response is not None]
    if not passed:
        reasons = "; ".join(f"{a.route}: {', '.join(a.notes) or 'nothing passed'}" for a in attempts)
        raise NotProved(f"no gains were found for `{design.name}` that pass every claim: {reasons}")
    # Of two that are as good the one with the stronger proof.
    cost = {a.route: problem.merit(a.response or before, a.abscissa or 0.0) for a in passed}
    chosen = min(
        passed,
        key=lambda a: (len(a.unmet), cost[a.route] + (_STRONGER if a.route == "linearisation" else 0.0)),
    )
    assert chosen.law is not None
    return Tuning(
        design.with_(law=chosen.law, gain_ranges=None),
        before,
        chosen,
        tuple(attempts),
        problem.amplitudes,
        tuple(problem.limits),
        problem.horizon,
    )


def _attempt(problem: Problem, route: Route, before: Response, seeds: Sequence[Law], progress: Progress) -> Attempt:
    if route == "lyapunov" and isinstance(problem.law, Integral):
        note = "Prop. pro:int is a linearisation: there is no Lyapunov route for the law integral"
        return Attempt(route, notes=(note,))
    if progress:
        progress(f"lowest abscissa, {route}")
    limit = problem.duration if problem.wish.settling or not math.isfinite(before.settling) else before.settling * 1.5
    judge = Judge(problem, route, min(problem.duration, max(limit, 50 * float(problem.h))))
    for seed in seeds:
        judge.cost(seed.resolve(problem.design.system.m, problem.eta_size))
    lowest_abscissa(problem, judge)
    if progress:
        progress(f"search, {route}")
    for attempt in range(_ROUNDS):
        search(problem, judge, problem.wish.seed + attempt)
        if not judge.seen or wish_is_met(problem, judge):
            break
    floor = judge.lowest if math.isfinite(judge.lowest) else None
    ranked = distinct(sorted(judge.seen, key=lambda item: item[0]))
    reason = "no candidate met the conditions of the route"
    for candidate in best_rounded(problem, judge, ranked[:_SHORTLIST])[:6]:
        rounded = gentler(problem, judge, candidate)
        if not math.isfinite(problem.respond(rounded, problem.horizon).settling):
            reason = f"settling: the loop is not within 2 % of its target after {problem.horizon:.4g} s"
            continue
        if progress:
            progress(f"prove, {route}")
        derived = derive(problem.design.with_(law=rounded, gain_ranges=None))
        failed = _failed(problem, route, derived)
        if failed is None:
            return _described(problem, route, rounded, derived, floor)
        reason = failed
    notes = (f"the candidates failed at {reason}",) if judge.seen else (reason,)
    return Attempt(route, floor=floor, notes=notes)


def _failed(problem: Problem, route: Route, derived: Derivation) -> str | None:
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


def _described(problem: Problem, route: Route, law: Law, derived: Derivation, floor: float | None) -> Attempt:
    resolved = derived.law or law
    figures = problem.spectrum.figures(problem.family.loop(resolved), problem.h, Fraction(1))
    active: list[str] = _active(problem, route, resolved)
    notes: list[str] = []
    if route == "lyapunov" and floor is not None:
        notes.append(f"the search moved the spectral abscissa no lower than {floor:.4g} 1/s on this route")
        if isinstance(base_law(resolved), NaturalDamping):
            notes[-1] += (
                "; Theta makes K_l R_l so large that x_l adds little (u_l is about -eta'/(K_l R_l)): the natural"
                " damping sets this limit"
            )
    if isinstance(resolved, Integral):
        notes.append(
            f"a constant disturbance of {100 * PUSH:g} % of the amplitudes leaves an error of "
            f"{_left(problem, resolved)} of the initial one; {_left(problem, problem.law)} with the given gains"
        )
    region, sentence = _region(derived, route)
    notes.append(sentence)
    sampled = next(c for c in derived.claims if c.claim == "sampled-stable")
    where = "from everywhere" if "all x" in sampled.domain else "from nearby"
    notes.append(f"sampled loop with h = {float(problem.h):.4g} s: proved to settle {where}")
    if not _is_diagonal(problem.law):
        notes.append("full matrices keep the coupling of the given ones: entries beside the diagonal scale with it")
    reached = problem.respond(resolved, problem.horizon)
    open_wishes = tuple(unmet(problem.wish, reached, figures))
    binding = f"; what binds: {'; '.join(active)}" if active else ""
    notes = [line + binding for line in open_wishes] + notes
    periods = problem.lyapunov_periods(resolved)
    if periods.largest is not None:
        notes.append(f"the storage argument covers sample periods below {float(periods.largest):.4g} s")
    return Attempt(
        route,
        law=law,
        response=reached,
        abscissa=None if figures is None else figures.abscissa,
        radius=None if figures is None else figures.radius,
        floor=floor,
        active=tuple(active),
        notes=tuple(notes),
        claims=derived.claims,
        region=region,
        unmet=open_wishes,
    )


def _is_diagonal(law: Law) -> bool:
    matrices: list[Matrix] = [getattr(base_law(law), name, ()) for name in ("K_c", "R_c")]
    return all(is_diagonal(rows) for rows in [*matrices, getattr(law, "R_psi", ())])


def _left(problem: Problem, law: Law) -> str:
    """The error at the end of a run against the disturbance."""
    return f"{100 * problem.respond(law, problem.horizon, problem.push).final:.2g} %"


def _region(derived: Derivation, route: Route) -> tuple[Ellipsoid | None, str]:
    """The largest region that is certified: a level set of the storage, else an ellipsoid of the linearisation."""
    found = attracted_level_set(derived, _REGION_BOXES)
    if found is not None and found.status is Status.PROVED:
        return None, f"region of attraction (continuous loop): {found.evidence}"
    if route == "linearisation":
        ellipsoid = certified_ellipsoid(derived)
        if ellipsoid is not None:
            return ellipsoid, ellipsoid.sentence
    return None, "no region of attraction could be certified"


def _active(problem: Problem, route: Route, law: Law) -> list[str]:
    """The constraints that are met with little to spare."""
    sums = amplitudes(law)
    found = [
        f"limit {room.limit}: {float(room.slack(sums)):.3g} left"
        for room in problem.limits
        if room.slack(sums) <= room.room / 100
    ]
    base = base_law(law)
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


def _shaped_with(problem: Problem, law: Law, clearance: Fraction) -> bool:
    """Whether the gains meet the Hessian condition and the bound on K_c with so much to spare."""
    base = base_law(law)
    softened = {
        name: tuple(v / clearance for v in values) if name in ("beta", "beta_c", "K_c") else values
        for name, values in entries(base).items()
    }
    return shaped(problem, rebuilt(base, softened))
