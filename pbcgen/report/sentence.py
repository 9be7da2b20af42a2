"""The verdicts in one sentence, for the terminal, the page and notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbcgen.proof.claim import EVERYWHERE, NOT_REACHED, Claim, Status

if TYPE_CHECKING:
    from pbcgen.pipeline import Report

#: What it means that a claim is UNDECIDED, or REFUTED.
WITHOUT = {
    "equilibrium": ("it is open where the system rests", "no input holds the system at the target"),
    "measurability": ("the law may need what is not measured", "the law needs what is not measured"),
    "saturation": ("the inputs may leave their limits", "the inputs can leave their limits"),
    "asymptotically-stable": ("it is open whether the loop settles at x*", "the loop does not settle at x*"),
    "sampled-stable": (
        "it is open whether the sampled loop settles",
        "the loop does not settle at this sample period",
    ),
    "adjustable": (
        "it is open whether the loop settles for every setting",
        "the loop does not settle for every setting",
    ),
}


def meaning(report: Report) -> str:
    """The verdicts in one sentence."""
    if report.emittable and "globally-asymptotically-stable" in _proved(report):
        domains = {c.claim: c.domain for c in report.claims}
        whole = domains["globally-asymptotically-stable"]
        start = "everywhere" if whole == EVERYWHERE else f"every state with {whole}"
        sampled = "sampled too" if EVERYWHERE in domains["sampled-stable"] else "sampled from nearby"
        return f"Proved: the loop settles at x* from {start}, {sampled}, within its limits."
    if report.emittable:
        return "Proved: from nearby the loop settles at x*, sampled too, within its limits."
    if report.unwritable:
        return f"No code: {report.unwritable}."
    if not report.blocking():
        return "No code: the derivation stopped before it had a controller."
    return f"No code: {open_points(report)}."


def open_points(report: Report) -> str:
    """What keeps the design from having code, in words: what is REFUTED, or else what is open."""
    blocking = report.blocking()
    refuted = [c for c in blocking if c.status is Status.REFUTED]
    shown = refuted or [c for c in blocking if not not_reached(c)] or blocking
    if any(c.claim == "asymptotically-stable" for c in shown):  # then the sampled loop does not settle either
        shown = [c for c in shown if c.claim != "sampled-stable"]
    return "; ".join(f"{WITHOUT[c.claim][c.status is Status.REFUTED]} ({c.claim} {c.status})" for c in shown)


def _proved(report: Report) -> set[str]:
    return {claim.claim for claim in report.claims if claim.status is Status.PROVED}


def not_reached(claim: Claim) -> bool:
    """Whether an earlier claim kept this one from being looked at."""
    return claim.method == NOT_REACHED
