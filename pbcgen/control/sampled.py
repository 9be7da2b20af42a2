"""The claim `sampled-stable`: which sample periods keep the proof, by which route, and what to change when none does.

Two routes. The *Lyapunov route* takes the storage of the continuous proof at the samples (`lyapunov_period`). The
*spectral route* linearises and is local: the exact zero-order hold of the plant and the implicit step of the controller
have all eigenvalues inside the unit circle, at the period of the design (`linearisation`) and, with proof, for every
shorter one (`scan`). Varying periods need one storage for all of them (`jitter`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from pbcgen.control.situation import Situation
from pbcgen.models.laws import Law
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.spectrum import Stability, hurwitz
from pbcgen.sampling.common_storage import solver_available
from pbcgen.sampling.family import LoopFamily
from pbcgen.sampling.gain_change import FACTORS, GainChange, gain_change
from pbcgen.sampling.jitter import Jitter, jitter
from pbcgen.sampling.linearisation import Examined, estimate, examine, spectral
from pbcgen.sampling.lyapunov_period import LyapunovPeriods, lyapunov_periods
from pbcgen.sampling.scan import Scan, scan
from pbcgen.sampling.transition import LinearLoop
from pbcgen.symbolic.real import midpoint

#: How far the scan goes, as a multiple of the design's period.
_REACH = 10**4
#: Cells that the scan in `check` may try: at most so many, fewer for larger loops (work: cube of the order).
_TRIES = 1500
_WORK = 400_000
#: Loops beyond this order get fewer cells still: their cells are narrower, so that they reach no further.
_SMALL = 12
#: For larger loops the scan is not finished for a refusal, and single periods are examined instead.
_LARGEST_SEARCH = 20
#: All periods around the design's are examined for loops of at most so many states, unless it is asked for.
_LARGEST_SCAN = 24

_SPECTRAL = "exact zero-order hold, linearised implicit step, Routh array after a Moebius map, in ball arithmetic"
_SPECTRAL_LARGE = "exact zero-order hold, linearised implicit step, Lyapunov matrix verified in ball arithmetic"
_LYAPUNOV = "storage at the samples, Loewner order over the rationals"


@dataclass(frozen=True)
class Sampling:
    """How the firmware samples, beside its period, and how much to prove of it; see :class:`Design`.

    Attributes:
        delay: from measurement to actuation, in samples.
        jitter: the share of h by which periods vary.
        scan: prove the range of all stable periods to its end, however many cells it takes.
    """

    delay: Fraction = Fraction(0)
    jitter: Fraction = Fraction(0)
    scan: bool = False


@dataclass(frozen=True)
class Routes:
    """The two routes for one sample period.

    Attributes:
        h: seconds. longest: the longest period that may occur; h without jitter.
        lyapunov: of the continuous storage. spectral: of the linearised sampled loop, or None: it is large, and the
            storage decides.
        scan: what is proved of the linearised loop with shorter and longer periods.
        estimate: of the end of the stable periods, where the scan did not reach it.
        examined: single periods instead of a scan, for the refusal of large loops.
        jitter: the common storage for varying periods, where the Lyapunov route does not cover them.
    """

    h: Fraction
    longest: Fraction
    lyapunov: LyapunovPeriods
    spectral: Stability | None
    scan: Scan
    estimate: Fraction | None
    jitter: Jitter | None = None
    examined: Examined | None = None

    @property
    def by_lyapunov(self) -> bool:
        """Whether the storage argument covers h, with damping to spare."""
        if self.lyapunov.largest is None or (self.longest != self.h and not self.lyapunov.any_sequence):
            return False
        return self.longest < self.lyapunov.largest

    @property
    def by_spectrum(self) -> bool:
        """Whether the linearised loop is proved stable, with jitter by a common storage."""
        varied = self.longest == self.h or (self.jitter is not None and self.jitter.status is Status.PROVED)
        return varied and self.spectral is not None and self.spectral.status is Status.PROVED

    @property
    def largest(self) -> float | None:
        """The smallest period at which the linearised loop fails: proved, or estimated where the scan was cut short.

        None if no period fails, if even the shortest ones do, or if the loop was too large to scan: single periods say
        nothing of those between, and stable periods have windows.
        """
        if self.scan.complete or self.proved_to == 0:
            return None
        if self.scan.exhausted:
            return None if self.estimate is None else max(float(self.estimate), self.proved_to)
        return self.proved_to

    @property
    def figures(self) -> dict[str, object]:
        """For JSON: seconds, null where a route gives nothing."""
        found, storage = self.scan, self.lyapunov.largest
        single = self.examined.stable if self.examined is not None else None
        return ({} if single is None else {"spectral_stable_at": float(single)}) | {
            "spectral_stable_to": None if self.spectral is None else float(self._scanned_to),
            "spectral_unstable_at": None if found.unstable_at is None else float(found.unstable_at),
            "spectral_scan_complete": not found.exhausted,
            "lyapunov_stable_to": None if storage is None else float(storage),
        }

    @property
    def proved_to(self) -> float:
        """Every period below it (with a delay: from ``scan.start`` on) is proved by one of the routes; 0 if none is."""
        return float(max(self._scanned_to, self.lyapunov.largest or 0))

    @property
    def _scanned_to(self) -> Fraction:
        return self.scan.stable_to if self.scan.stable_to > self.scan.start or not self.scan.delay else Fraction(0)


def verdict(
    routes: Routes, asymptotic: Claim, overall: Claim, change: GainChange | None, unseen: Claim | None = None
) -> Claim:
    """The verdict `sampled-stable`.

    Args:
        routes: what each route says.
        asymptotic: the verdict on the continuous loop.
        overall: the verdict `globally-asymptotically-stable`, for the domain of the Lyapunov route.
        change: gains that would allow the period, for the hint.
        unseen: what refutes attraction of the sampled loop as of the continuous one, or None.
    """
    spectral = routes.by_spectrum
    here = routes.spectral
    by_spectrum = _SPECTRAL_LARGE if here is not None and here.lyapunov is not None else _SPECTRAL
    lyapunov = routes.by_lyapunov and asymptotic.status is Status.PROVED
    whole = lyapunov and overall.holds_everywhere
    domain = "sampled loop, all x" if whole else "sampled loop"
    evidence = "; ".join(_evidence(routes))
    if spectral or lyapunov:
        methods = ([_LYAPUNOV] if lyapunov else []) + ([by_spectrum] if spectral else [])
        return Claim(
            "sampled-stable", Status.PROVED, domain, " and ".join(methods), evidence, certificate=_certificate(routes)
        )
    if unseen is not None:
        evidence = f"{unseen.evidence}; the sampled controller reads nothing of it and holds u*, whatever h is"
        return replace(unseen, claim="sampled-stable", domain="sampled loop", evidence=evidence)
    refuted = here is not None and here.status is Status.REFUTED
    status = Status.REFUTED if refuted else Status.UNDECIDED
    counterexample = {"spectral_radius": radius_text(here.extreme)} if here is not None and refuted else None
    return Claim(
        "sampled-stable", status, domain, by_spectrum, evidence, _hint(routes, asymptotic, change), counterexample
    )


def radius_text(radius: float) -> str:
    """A spectral radius with digits enough to see on which side of 1 it lies."""
    if math.isnan(radius):
        return "unknown (the state changes by factors beyond all numbers within a period)"
    distance = radius - 1
    if 0 < abs(distance) < 1e-6:
        return f"1 {'+' if distance > 0 else '-'} {abs(distance):.2g}"
    return f"{radius:.9g}" if distance else "1 to 16 digits"


def _evidence(routes: Routes) -> list[str]:
    h = float(routes.h)
    delayed = f" and a delay of {float(routes.scan.delay):g} samples" if routes.scan.delay else ""
    lines = [f"h = {h:.6g} s{delayed}"]
    if routes.spectral is not None:
        lines[0] += f": spectral radius {radius_text(routes.spectral.extreme)} (local)"
    if routes.jitter is not None:
        varied = routes.jitter
        serves = "one quadratic storage serves" if varied.status is Status.PROVED else "no common storage was found for"
        most = (
            f"the largest jitter with one is {100 * float(varied.share):.3g} % of h" if varied.share else "none found"
        )
        lines.append(f"{serves} all h in [{float(varied.shortest):.6g}, {float(varied.longest):.6g}] s; {most}")
    if routes.lyapunov.largest is not None:
        verdict = "holds" if routes.by_lyapunov else "does not hold"
        ordered = ", in any sequence" if routes.by_lyapunov and routes.longest != routes.h else ""
        lines.append(f"the Lyapunov route {verdict}: it needs h < {float(routes.lyapunov.largest):.4g} s{ordered}")
    else:
        lines.append(f"no Lyapunov route: {routes.lyapunov.reason}")
    return [*lines, *_extent(routes)]


def _extent(routes: Routes) -> list[str]:
    """What is proved of other periods."""
    if routes.spectral is None:
        return ["the loop was not linearised: it is large, and the storage decides (--sampled-scan does it)"]
    found = routes.scan
    at = None if found.unstable_at is None else f"{float(found.unstable_at):.9g} s"
    if found.stable_to == found.start:
        least = f" above {float(found.start):.3g} s" if found.start else ""
        unstable = f": it is unstable at {at}" if at else ""
        if found.exhausted and not at:
            return [_examined(routes.examined, routes.h)]
        return [f"no range of short periods{least} was proved for the linearised loop{unstable}"]
    since = f"from {float(found.start):.3g} s " if found.start else ""
    end = f", proved unstable at {at}" if at else ""
    lines = [f"the linearised loop is stable for every h {since}up to {float(found.stable_to):.9g} s{end}"]
    if routes.largest is not None and found.exhausted:
        lines.append(f"about {routes.largest:.4g} s is the limit (estimate; --sampled-scan proves it)")
    if routes.by_spectrum and found.unstable_at is not None and found.unstable_at < routes.h:
        lines.append("this h lies in a window of stability beyond periods that are unstable")
    return lines


def _examined(found: Examined | None, h: Fraction) -> str:
    """What single periods say; none of those between was decided."""
    rest = "the others were not examined (--sampled-scan does it)"
    if found is None or (found.stable == h and found.next is None):
        return f"this sample period alone was examined: {rest}"
    if found.stable is None:
        return f"single periods down to {float(found.next or h):.3g} s were examined, and none was proved: {rest}"
    end = "" if found.next is None else f", h = {float(found.next):.4g} s is not proved"
    return f"of single periods h = {float(found.stable):.4g} s is the longest proved{end}: {rest}"


def _certificate(routes: Routes) -> dict[str, object]:
    column = () if routes.spectral is None else routes.spectral.routh
    result: dict[str, object] = {"routh": [f"{float(midpoint(v)):.17g}" for v in column]}
    if routes.lyapunov.largest is not None:
        result["lyapunov_period"] = str(routes.lyapunov.largest)
    result["cells"] = [[str(a), str(b)] for a, b in routes.scan.cells]
    if routes.jitter is not None and routes.jitter.storage is not None:
        result["storage"] = routes.jitter.storage.tolist()
    return result


def _hint(routes: Routes, asymptotic: Claim, change: GainChange | None) -> str:
    if asymptotic.status is not Status.PROVED:
        return "satisfy asymptotically-stable first"
    if routes.jitter is not None and routes.spectral is not None and routes.spectral.status is Status.PROVED:
        share = float(routes.jitter.share)
        more = "" if solver_available() else "; the extra `sos` (a solver) proves more"
        return (
            f"keep the periods within {100 * share:.3g} % of h, which is proved" if share else "sample evenly"
        ) + more
    largest = routes.proved_to
    faster = f"down to {float(routes.scan.start):.3g} s" if routes.scan.delay else "or faster"
    parts = [f"sample at h = {_below(largest)} s {faster}, which is proved"] if largest else []
    single = routes.examined.stable if routes.examined is not None else None
    if single is not None and single > largest:
        parts.insert(0, f"sample at h = {float(single):.4g} s, which is proved (local; that period alone)")
    if change is not None:
        parts.append(f"multiply {change}, which is proved to allow this h (local)")
    else:
        parts.append(
            f"choose other gains: no common factor of alpha*beta, K_c and R_c down to 1/{FACTORS[-1].denominator} "
            "was proved to allow this h"
        )
    parts.append("model the friction that the plant has")
    return ", or ".join(parts)


def _below(value: float) -> str:
    """The value rounded down to three digits."""
    exponent = math.floor(math.log10(value)) - 2
    return f"{math.floor(value / 10.0**exponent) * 10.0**exponent:.3g}"


def decide(
    situation: Situation,
    h: Fraction,
    missing: Sequence[str],
    spare: bool,
    asymptotic: Claim,
    overall: Claim,
    sampling: Sampling,
) -> tuple[Claim, Routes]:
    """The verdict `sampled-stable` on a law at its target, with what it rests on.

    Args:
        situation: plant, target, law and the claims so far.
        h: sample period, seconds.
        missing: premises of the continuous Lyapunov proof that are not proved.
        spare: leave the linearised loop out where the storage covers h: it is large.
        asymptotic: the local verdict on the continuous loop.
        overall: the global one.
        sampling: delay and jitter, and how much to prove.
    """
    delay = sampling.delay
    if delay:
        storage = LyapunovPeriods(None, "the input is delayed")
    else:
        storage = lyapunov_periods(
            situation.plant, situation.structure, situation.gamma, situation.eta, situation.law, missing
        )
    if spare and not sampling.scan:
        unscanned = Scan(Fraction(0), Fraction(0), None, (), delay, complete=False, exhausted=True)
        routes = Routes(h, h * (1 + sampling.jitter), storage, None, unscanned, None)
        if routes.by_lyapunov and asymptotic.status is Status.PROVED:
            return verdict(routes, asymptotic, overall, None), routes
    loop, continuous = situation.loop, situation.linearised
    here = spectral(loop, h, delay)
    size = sum(loop.sizes[:2])
    small = size <= _LARGEST_SEARCH
    refused = here.status is not Status.PROVED
    hurwitz_at_target = continuous.status is Status.PROVED
    found = _scanned(loop, h, storage, hurwitz_at_target, sampling, refused and small)
    about, singles = None, None
    if found.exhausted and not delay and small and found.stable_to > 0:
        about = estimate(loop, found.stable_to, h * _REACH)
    else:
        open_end = found.exhausted and not small
        none = delay > 0 and found.stable_to == found.start
        if refused and hurwitz_at_target and (open_end or none):
            singles = examine(loop, h, h * _REACH, here, delay)
    routes = Routes(h, h * (1 + sampling.jitter), storage, here, found, about, examined=singles)
    unseen = _unseen(situation, asymptotic)
    if sampling.jitter and not (routes.by_lyapunov and asymptotic.status is Status.PROVED):
        routes = replace(routes, jitter=jitter(loop, h, sampling.jitter, delay))
    change = None
    if refused and asymptotic.status is Status.PROVED:
        family = situation.family
        change = gain_change(family, situation.law, h, lambda law: _hurwitz(family, law), delay)
    return verdict(routes, asymptotic, overall, change, unseen), routes


def _unseen(situation: Situation, asymptotic: Claim) -> Claim | None:
    """The refutation of attraction that holds for the sampled loop too, or None.

    A conserved function is one whatever the input. Motions with u = u* along which the controller reads what it reads
    at x* stay motions when it samples; a force that it compensates would change between the samples.
    """
    shown = asymptotic.counterexample or {}
    held = "relations" in shown and situation.compensation is None
    return asymptotic if asymptotic.status is Status.REFUTED and ("conserved" in shown or held) else None


def _scanned(
    loop: LinearLoop, h: Fraction, storage: LyapunovPeriods, continuous: bool, sampling: Sampling, refused: bool
) -> Scan:
    """All periods that are proved for the linearised loop.

    Where the Lyapunov route holds and the continuous loop is Hurwitz, the storage's quadratic part proves the periods
    below its bound, so the scan begins there; for larger loops it ends there too, if that covers h.
    """
    end, delay = h * _REACH, sampling.delay
    covered = storage.largest if continuous and storage.largest is not None else Fraction(0)
    if covered >= end:
        return Scan(Fraction(0), covered, None, (), delay, True)
    start = h / 1000 if delay else covered
    size = sum(loop.sizes[:2])
    if size > _LARGEST_SCAN and not sampling.scan:
        return Scan(start, start, None, (), delay, complete=False, exhausted=True)
    if size > _LARGEST_SEARCH and covered > h and not sampling.scan:
        return Scan(Fraction(0), covered, None, (), delay, complete=False, exhausted=True)
    tries = max(1, min(_TRIES, _WORK // size**3, _WORK * _SMALL**2 // size**5))
    found = scan(loop, end, delay=delay, start=start, tries=None if sampling.scan else tries)
    if found.exhausted and refused:
        found = scan(loop, h, delay=delay, start=start)  # a refusal names the largest period that is proved
    return found if delay else replace(found, start=Fraction(0))


def _hurwitz(family: LoopFamily, law: Law) -> bool:
    return hurwitz(family.loop(law).continuous()).status is Status.PROVED
