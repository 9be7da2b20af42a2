"""The stability claims: by the Lyapunov function of the paper, by linearisation, and for the sampled loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from pbcgen.control.absolute import METHOD as ABSOLUTE
from pbcgen.control.attractivity import beyond_linearisation, drift, locally_by_storage
from pbcgen.control.global_attraction import by_storage, globally
from pbcgen.control.leaves import stable_on_leaves
from pbcgen.control.sampled import Sampling, decide
from pbcgen.control.situation import LARGEST_LINEARISED, Situation
from pbcgen.models.laws import Integral, Law, NaturalDamping, PassiveOutput, base_law
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.spectrum import Stability
from pbcgen.symbolic.real import approximate

#: The method of `stable` when the premises of Prop. pro1, pro2 or pro4 are proved.
LYAPUNOV = "Lyapunov function"
_LINEARISATION = "linearisation: characteristic polynomial and Routh array in exact or ball arithmetic"
_LINEARISATION_LARGE = "linearisation: Lyapunov matrix proposed in floating point, verified in ball arithmetic"


@dataclass(frozen=True)
class StabilityVerdicts:
    """The claims, and the spectral figures for display, None where the loop was not linearised."""

    claims: tuple[Claim, ...]
    spectral_abscissa: float | None
    spectral_radius: float | None
    max_sample_period: float | None
    sampled: Mapping[str, object]


def lyapunov_premises(law: Law) -> tuple[str, ...]:
    """The claims that together make x* stable by Prop. pro1, pro2 or pro4; none for laws without such a proof."""
    if isinstance(law, Integral):
        return ()
    common = ("assumption-1", "passive-output", "gradient-condition", "hessian-condition")
    if isinstance(law, PassiveOutput):
        return common
    filtered = (*common, "gain-definiteness", "kc-bound")
    return (*filtered, "assumption-3", "theta") if isinstance(law, NaturalDamping) else filtered


def stability(situation: Situation, h: Fraction, sampling: Sampling) -> StabilityVerdicts:
    """Decide `stable`, `asymptotically-stable`, `globally-asymptotically-stable` and `sampled-stable`."""
    law, found = situation.law, situation.found
    premises = lyapunov_premises(law)
    missing = [name for name in premises if found[name].status is not Status.PROVED]
    by_lyapunov = bool(premises) and not missing
    attraction = _by_storage(situation) if by_lyapunov and situation.order > LARGEST_LINEARISED else None
    spared = attraction is not None
    asymptotic, overall = attraction or _by_linearisation(situation, by_lyapunov, missing)
    sampled, routes = decide(
        situation,
        h,
        missing if premises else ["the whole route"],
        spared,
        asymptotic,
        overall if overall.method != ABSOLUTE else replace(overall, status=Status.UNDECIDED),  # it is not the storage's
        sampling,
    )
    if by_lyapunov:
        evidence = "follows from " + ", ".join(premises)
        stable = Claim("stable", Status.PROVED, "near x*", LYAPUNOV, evidence)
    else:
        stable = _stable(situation.linearised, missing, situation)
    return StabilityVerdicts(
        (stable, asymptotic, overall, sampled),
        None if spared else situation.linearised.extreme,
        None if routes.spectral is None else routes.spectral.extreme,
        routes.largest,
        routes.figures,
    )


def _by_storage(situation: Situation) -> tuple[Claim, Claim] | None:
    """`asymptotically-stable` and `globally-asymptotically-stable` where the storage decides: no linearisation."""
    overall = by_storage(situation, by_lyapunov=True)
    if overall.status is Status.PROVED:
        return replace(overall, claim="asymptotically-stable", domain="near x*"), overall
    asymptotic = locally_by_storage(situation)
    return None if asymptotic is None else (asymptotic, globally(situation, True, asymptotic, overall))


def _by_linearisation(situation: Situation, by_lyapunov: bool, missing: Sequence[str]) -> tuple[Claim, Claim]:
    """The same two claims from the linearised loop, and from the storage where that does not decide."""
    asymptotic = _asymptotic(situation.linearised, by_lyapunov, missing, situation)
    overall = globally(situation, by_lyapunov, asymptotic)
    if overall.status is Status.PROVED and asymptotic.status is Status.UNDECIDED:
        asymptotic = replace(overall, claim="asymptotically-stable", domain="near x*")
    return asymptotic, overall


def _method(verdict: Stability) -> str:
    return _LINEARISATION if verdict.lyapunov is None else _LINEARISATION_LARGE


def _certificate(verdict: Stability) -> dict[str, object]:
    return {"routh": [f"{approximate(v):.17g}" for v in verdict.routh]}


def _stable(continuous: Stability, missing: Sequence[str], situation: Situation) -> Claim:
    if continuous.status is Status.PROVED:
        evidence = f"spectral abscissa {continuous.extreme:.6g}; the Lyapunov route is {_why_not(missing)}"
        method = _method(continuous)
        return Claim("stable", Status.PROVED, "near x*", method, evidence, certificate=_certificate(continuous))
    if continuous.status is Status.REFUTED:
        return _unstable("stable", continuous, situation)
    decided = stable_on_leaves(situation, missing) or drift(situation)
    if decided is not None:
        return decided
    return Claim(
        "stable",
        Status.UNDECIDED,
        "near x*",
        "Lyapunov function and linearisation",
        f"an eigenvalue lies on the imaginary axis or too close to it; the Lyapunov route is {_why_not(missing)}",
        _first_hint(missing),
    )


def _why_not(missing: Sequence[str]) -> str:
    return "open for " + ", ".join(missing) if missing else "not available for this law"


def _first_hint(missing: Sequence[str]) -> str:
    return f"satisfy {missing[0]}" if missing else "add damping to the mode on the imaginary axis"


def _asymptotic(continuous: Stability, by_lyapunov: bool, missing: Sequence[str], situation: Situation) -> Claim:
    if continuous.status is Status.PROVED:
        route = "the Lyapunov route holds too" if by_lyapunov else f"the Lyapunov route is {_why_not(missing)}"
        return Claim(
            "asymptotically-stable",
            Status.PROVED,
            "near x*",
            _method(continuous),
            f"spectral abscissa {continuous.extreme:.6g}; {route}",
            certificate=_certificate(continuous),
        )
    if continuous.status is Status.REFUTED:
        return _unstable("asymptotically-stable", continuous, situation)
    decided = beyond_linearisation(situation, by_lyapunov)
    if decided is not None:
        return decided
    tried = situation.unreduced if by_lyapunov else f"the Lyapunov route is {_why_not(missing)}"
    return Claim(
        "asymptotically-stable",
        Status.UNDECIDED,
        "near x*",
        f"{_LINEARISATION}; LaSalle's invariant set by elimination" if by_lyapunov else _LINEARISATION,
        f"the linearisation does not decide: spectral abscissa {continuous.extreme:.6g}{tried and '; '}{tried}",
        "add damping that reaches the slow mode, or choose another target",
    )


def _unstable(claim: str, continuous: Stability, situation: Situation) -> Claim:
    return Claim(
        claim,
        Status.REFUTED,
        "near x*",
        _method(continuous),
        f"the linearised closed loop has an eigenvalue with real part {continuous.extreme:.6g} > 0",
        _remedy(situation),
        {"spectral_abscissa": f"{continuous.extreme:.9g}"},
    )


def _remedy(situation: Situation) -> str:
    """What would make x* stable: the premises that fail, or less of the only filter that has none."""
    law = situation.law
    base = base_law(law)
    missing = [name for name in lyapunov_premises(base) if situation.found[name].status is not Status.PROVED]
    if missing:
        return "satisfy " + ", ".join(missing)
    return "lower alpha_psi*beta_psi or raise R_psi: without the filter psi the loop is stable"
