"""Verdicts: what a check says of one claim."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


class Status(StrEnum):
    """PROVED: holds in exact or certified arithmetic. REFUTED: a checked counterexample. UNDECIDED: neither."""

    PROVED = "PROVED"
    REFUTED = "REFUTED"
    UNDECIDED = "UNDECIDED"


#: Every claim, in the order of the verdict table.
CLAIMS = (
    "input-rank",
    "equilibrium",
    "assumption-1",
    "passive-output",
    "gradient-condition",
    "hessian-condition",
    "gain-definiteness",
    "kc-bound",
    "assumption-3",
    "theta",
    "measurability",
    "saturation",
    "stable",
    "asymptotically-stable",
    "globally-asymptotically-stable",
    "sampled-stable",
    "adjustable",
)

#: Code is emitted when these are PROVED (or allowed by name); `adjustable` concerns designs with settings only.
EMISSION_CLAIMS = (
    "equilibrium",
    "measurability",
    "saturation",
    "asymptotically-stable",
    "sampled-stable",
    "adjustable",
)

#: Hints that begin so send the reader to other claims.
ELSEWHERE = ("mend", "satisfy")

#: The method of a claim that an earlier one kept from being looked at.
NOT_REACHED = "not reached"


#: The domain of claims that hold on the whole space.
EVERYWHERE = "all x"


@dataclass(frozen=True)
class Claim:
    """One claim with its verdict.

    Attributes:
        claim: a name of :data:`CLAIMS`.
        status: the verdict.
        domain: where it holds: ``all x``, a box, ``at x*``, ``sampled loop``.
        method: how it was decided.
        evidence: what was computed, in words and numbers.
        hint: how to mend it; empty when PROVED.
        counterexample: for REFUTED, the point or numbers that were checked.
        certificate: data from which the verdict can be checked again without searching.
    """

    claim: str
    status: Status
    domain: str
    method: str
    evidence: str
    hint: str = ""
    counterexample: Mapping[str, Any] | None = None
    certificate: Mapping[str, Any] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        if self.claim not in CLAIMS:
            raise ValueError(f"unknown claim `{self.claim}`")
        if self.status is Status.REFUTED and self.counterexample is None:
            raise ValueError(f"`{self.claim}` is REFUTED without a counterexample")

    @property
    def holds_everywhere(self) -> bool:
        """Whether it is PROVED on the whole space."""
        return self.status is Status.PROVED and self.domain == EVERYWHERE

    def as_json(self) -> dict[str, Any]:
        """The entry of this claim in ``pbcgen check --json``."""
        return {
            "claim": self.claim,
            "status": str(self.status),
            "domain": self.domain,
            "method": self.method,
            "evidence": self.evidence,
            "hint": self.hint,
            "counterexample": None if self.counterexample is None else dict(self.counterexample),
        }
