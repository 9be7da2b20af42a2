"""The stages from a design to validated C, one function each.

    check     design  -> Report      verdicts, derived quantities, the discretised law
    generate  design  -> Package     the C files, when the claims allow it
    validate  design  -> Validation  the compiled C against the Python step and the continuous reference
    simulate  design  -> Simulation  the closed loop, continuous and sampled
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pbcgen.control.closed_loop import ClosedLoop
from pbcgen.control.law import ControlLaw
from pbcgen.models.design import Design
from pbcgen.proof.claim import EMISSION_CLAIMS, Claim, Status


@dataclass(frozen=True)
class Report:
    """What `check` found.

    Attributes:
        design: the design that was checked.
        claims: one verdict for each claim that concerns the law, in the order of CLAIMS.
        derived: the keys of the JSON document's ``derived`` (kappa, gamma, ...); formulas as strings.
        control: the discretised law, or None when the derivation stopped before it.
        loop: plant and continuous law for simulation, or None likewise.
        model_hash: SHA-256 of the canonical text of the design.
        timings: seconds of each stage.
    """

    design: Design
    claims: tuple[Claim, ...]
    derived: Mapping[str, Any]
    control: ControlLaw | None
    loop: ClosedLoop | None
    model_hash: str
    timings: Mapping[str, float]

    def blocking(self, allow: Sequence[str] = ()) -> tuple[Claim, ...]:
        """The claims that forbid code: not PROVED and not allowed by name."""
        return tuple(
            c
            for c in self.claims
            if c.claim in EMISSION_CLAIMS and c.status is not Status.PROVED and c.claim not in allow
        )

    @property
    def emittable(self) -> bool:
        """Whether code may be generated without ``--allow``."""
        return self.control is not None and not self.blocking()

    def as_json(self) -> dict[str, Any]:
        """The document of ``pbcgen check --json``."""
        return {
            "design": self.design.name,
            "law": self.design.law.name,
            "claims": [c.as_json() for c in self.claims],
            "derived": dict(self.derived),
            "emittable": self.emittable,
            "timings": dict(self.timings),
        }
