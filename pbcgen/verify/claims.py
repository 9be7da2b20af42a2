"""The verdict of the checker on every claim of a certificate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flint import ctx

from pbcgen.reading.overall import GLOBAL
from pbcgen.symbolic.plain.outcomes import Fails, Malformed, NotCheckable, require
from pbcgen.symbolic.plain.values import Grow
from pbcgen.verify.stability import Stability

#: Bits of the balls, and more for each state: a characteristic polynomial loses many. Where a large loop is shown to be
#: stable without one, none are needed.
BITS, BITS_PER_STATE, LARGEST_ROUTH = 333, 48, 20

#: Claims about the loop.
_LOOP = ("stable", "asymptotically-stable", GLOBAL, "sampled-stable", "adjustable")

_MISFITS = (ArithmeticError, LookupError, TypeError, ValueError, AttributeError)


@dataclass(frozen=True)
class Finding:
    """What became of one claim: ``checked``, ``fails``, ``recorded`` (not re-checkable) or ``open`` (UNDECIDED)."""

    claim: str
    status: str
    outcome: str
    reason: str = ""


def examine(document: Mapping[str, Any]) -> list[Finding]:
    """Check every claim of a certificate. Raises Malformed where it cannot be read as one."""
    bits = ctx.prec
    settings: tuple[Any, ...] = (16,)
    try:
        for _ in range(100):
            try:
                system = Stability(document, *settings)
                ctx.prec = bits_for(system.n, {"P", "Lambda"} & system.witness["sampled-stable"].keys())
                return [find(system, entry["claim"], entry["status"]) for entry in document["claims"]]
            except Grow as larger:
                settings = larger.args
    except _MISFITS as error:
        raise Malformed(f"the certificate has entries of another kind ({type(error).__name__}: {error})") from None
    finally:
        ctx.prec = bits
    return [Finding(entry["claim"], entry["status"], "recorded", "too many arguments") for entry in document["claims"]]


def bits_for(states: int, without: object = True) -> int:
    """The precision for a system of so many states; ``without`` a characteristic polynomial if its loops are large."""
    return BITS + BITS_PER_STATE * (0 if without and states > LARGEST_ROUTH else states)


def find(system: Stability, claim: str, status: str) -> Finding:
    """Check one claim."""
    check: Any = getattr(system, f"{status.lower()}_{claim.replace('-', '_')}", None)
    if status == "UNDECIDED":
        return Finding(claim, status, "open")
    try:
        require(check, "there is no such claim")
        require(system.reaches(claim), "the claim is not made for this domain")
        if claim in _LOOP:
            system.closes()
        system.once(check)
    except (NotCheckable, Fails) as reason:
        return Finding(claim, status, "fails" if isinstance(reason, Fails) else "recorded", str(reason))
    except _MISFITS as error:
        return Finding(claim, status, "fails", f"the data do not fit ({type(error).__name__}: {error})")
    return Finding(claim, status, "checked")
