"""What gains are judged by: the design, the wish, the limits, and the conditions of the routes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import numpy as np

from pbcgen.control.amplitudes import Room, blocking, largest_amplitudes, rooms
from pbcgen.control.derive import Derivation, derive
from pbcgen.control.saturation import offsets
from pbcgen.errors import ModelError, NotProved
from pbcgen.law.closed_loop import until_settled
from pbcgen.models.design import Design
from pbcgen.models.gains import Vector
from pbcgen.models.laws import Integral, Law, NaturalDamping, amplitudes, shaping
from pbcgen.passivity.dissipation import port_damping
from pbcgen.passivity.shaping import Shape, shape_at
from pbcgen.passivity.storage import assumption_1
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.claim import NOT_REACHED, Claim, Status
from pbcgen.proof.definite import positive_definite
from pbcgen.sampling.family import LoopFamily
from pbcgen.sampling.linearisation import Figures, Spectrum
from pbcgen.sampling.lyapunov_period import LyapunovPeriods, lyapunov_periods
from pbcgen.symbolic.real import approximate, rational
from pbcgen.symbolic.real_matrices import add, diagonal, exact_matrix, inverse
from pbcgen.tuning.gain_scale import natural_scale
from pbcgen.tuning.gain_space import Space, rebuilt
from pbcgen.tuning.trial import Response, Trial, entries, response

Route = Literal["lyapunov", "linearisation"]

#: Theta and the Hessian thresholds are exceeded by this factor.
_CLEARANCE = Fraction(21, 20)

#: Size of that disturbance, as a share of the amplitudes.
PUSH = 0.1

#: What being faster than wished counts, as a share of what being slower does.
_ENOUGH = 0.1

#: Weight of the overshoot: one of 100 % costs as much as settling 1.5 times later.
_OVERSHOOT = 0.4

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


@dataclass(frozen=True, eq=False)
class Problem:
    """One design with everything that candidates are judged by.

    Attributes:
        design, wish, derivation, law: what was given, the law with resolved gains.
        origin: the gains around which others are sought: those of the law, or of the plant's own size where the loop
            with the given ones is not stable.
        trial, family, spectrum, shape, structure: what the candidates are tried and tested with.
        limits, amplitudes: the actuator limits, and the sums of the amplitudes that they leave.
        duration: of the trial runs of the search, seconds. horizon: within which a loop must settle.
    """

    design: Design
    wish: Wish
    derivation: Derivation
    law: Law
    origin: Law
    trial: Trial
    family: LoopFamily
    spectrum: Spectrum
    shape: Shape
    structure: PowerStructure | None
    limits: list[Room]
    amplitudes: Vector
    duration: float
    horizon: float

    @staticmethod
    def of(design: Design, wish: Wish) -> Problem:
        """Derive what does not depend on the gains. Raises NotProved where no gains can help."""
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
        given = amplitudes(law)
        storage = assumption_1(plant)
        trial = Trial(plant, point, found.gamma, found.eta, design, law)
        spectrum = Spectrum(family.A, design.delay)
        shape = shape_at(plant, point, found.gamma, law)
        structure = storage.structure if storage.proved else None
        length = found.loop.duration if found.loop is not None else until_settled(None, design.sample_period)
        duration = length if wish.settling is None else max(4 * wish.settling, 20 * float(design.sample_period))
        given_loop = spectrum.figures(family.loop(law), design.sample_period, wish.margin)
        holds = given_loop is not None and given_loop.radius < 1 and given_loop.abscissa < 0
        origin = law if holds else natural_scale(family, law, design.sample_period, length)
        duration = min(duration, 2 * length)
        return Problem(
            design=design,
            wish=wish,
            derivation=found,
            law=law,
            origin=origin,
            trial=trial,
            family=family,
            spectrum=spectrum,
            shape=shape,
            structure=structure,
            limits=limits,
            amplitudes=largest_amplitudes(limits, given) or given,
            duration=duration,
            horizon=max(duration, length),
        )

    @property
    def h(self) -> Fraction:
        """The sample period."""
        return self.design.sample_period

    @property
    def eta_size(self) -> int | None:
        """The number of coordinates eta, None without them."""
        eta = self.derivation.eta
        return None if eta is None else int(eta.numel())

    def space(self, common: bool) -> Space:
        """The box in which gains are sought."""
        return Space(self.origin, self.amplitudes, self.design.system.m, common)

    @property
    def push(self) -> tuple[float, ...] | None:
        """The constant input disturbance of the second trial run: an integral term has nothing else to do."""
        return tuple(PUSH * float(a) for a in self.amplitudes) if isinstance(self.law, Integral) else None

    def respond(self, law: Law, duration: float, push: tuple[float, ...] | None = None) -> Response:
        """How a trial run with a law settles, perhaps against a constant disturbance."""
        return response(self.trial.run(law, duration, push))

    def cost(self, law: Law, found: Response, abscissa: float, duration: float) -> float:
        """The merit of the run, and with an integral term that of a run against a disturbance too."""
        value = self.merit(found, abscissa)
        if self.push is None:
            return value
        return value + self.merit(self.respond(law, duration, self.push), abscissa) / 2

    def merit(self, found: Response, abscissa: float) -> float:
        """The cost of a response: the logarithm of its settling time, with penalties for what was not wished.

        A slow mode with a small amplitude passes the 2 % band unseen, so the distance between the settling time and
        the slowest time constant counts too. Faster than wished is worth little.
        """
        scale = self.wish.settling or self.duration
        urgency = 1.0 if self.wish.settling is None else 2.0
        enough = 1.0 if self.wish.settling is None else _ENOUGH

        def slowness(time: float) -> float:
            value = math.log(time / scale)
            return value if value > 0 else enough * value

        if math.isfinite(found.settling):
            settling, rough = (max(t, float(self.h)) for t in (found.settling, found.rough))
            late = (
                0.5 * slowness(settling) + 0.25 * slowness(rough) + 0.25 * slowness(math.sqrt(max(found.spread, 1e-12)))
            )
            late += urgency * max(0.0, math.log(settling / scale)) + 2.0 * found.final
        else:
            settling = self.duration
            late = (1 + urgency) * math.log(settling / scale) + 1.5 + min(found.final, 10.0)
            late += min(found.spread / settling**2, 10.0)
        tail = math.log(max(1.0, 4.0 / (settling * max(-abscissa, 1e-30))))
        beyond = 0.0 if self.wish.overshoot is None else max(0.0, min(found.overshoot, 10.0) - self.wish.overshoot)
        return late + _TAIL * min(tail, 30.0) + 10 * beyond + _OVERSHOOT * min(found.overshoot, 5.0)

    def lyapunov_periods(self, law: Law) -> LyapunovPeriods:
        """The sample periods that the storage of the continuous proof covers."""
        d = self.derivation
        assert d.gamma is not None
        return lyapunov_periods(d.plant, self.structure, d.gamma, d.eta, law, ())


def _stuck(claims: Sequence[Claim]) -> str:
    needed = ("equilibrium", "passive-output", "measurability", "assumption-3")
    decided = [c for c in claims if c.method != NOT_REACHED]
    blocking_claims = [c for c in decided if c.claim in needed and c.status is not Status.PROVED]
    lines = [
        f"{c.claim} is {c.status}: {c.evidence}" + (f" (hint: {c.hint})" if c.hint else "") for c in blocking_claims
    ]
    return "no gains can be chosen: " + "; ".join(lines or ["the law cannot be written"])


def shaped(problem: Problem, law: Law) -> bool:
    """The Hessian condition and the bound on K_c: ``H0 + N (A^-1 + K_c^-1)^-1 N^T > 0``, with clearance."""
    term = shaping(law)
    A = diagonal([rational(s / _CLEARANCE) for s in term.stiffness])
    if term.K_c is not None:
        K_c = exact_matrix(tuple(tuple(v / _CLEARANCE for v in row) for row in term.K_c))
        compliances = [inverse(A), inverse(K_c)]
        series = None if None in compliances else inverse(add(*compliances))  # type: ignore[arg-type]
        if series is None:
            return False
        A = series
    return positive_definite(problem.shape.hessian(A)).status is Status.PROVED


def meet_theta(problem: Problem, law: NaturalDamping) -> NaturalDamping | None:
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


def theta_bound(problem: Problem, law: NaturalDamping) -> float | None:
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


def unmet(wish: Wish, reached: Response, figures: Figures | None) -> list[str]:
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
