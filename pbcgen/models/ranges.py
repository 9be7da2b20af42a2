"""What may be set while the controller runs: targets in a box, and gains in ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from pbcgen.errors import ModelError
from pbcgen.models.exact import Number, exact
from pbcgen.models.expressions import by_name, suggestion
from pbcgen.models.gains import Vector, is_diagonal
from pbcgen.models.laws import Law, gains
from pbcgen.models.target import Target

#: The gains that a running controller cannot change, and why.
_FIXED_GAINS = {"Upsilon": "it mixes the channels of eta"}
#: Matrices that enter the step by one inverse: either changes only if both are diagonal.
_COUPLED = ("K_c", "R_c")
#: The gains that may be zero.
_MAY_VANISH = ("R_psi",)

#: A range for every channel, or one for each.
RangeLike = Sequence[Number] | Sequence[Sequence[Number]]


@dataclass(frozen=True)
class Range:
    """A closed interval with exact bounds, lo < hi."""

    lo: Fraction
    hi: Fraction


def target_box(given: Mapping[str, Sequence[Number]] | None, target: Target) -> dict[str, Range]:
    """The ranges of the adjustable conditions of a target, in the order of the target.

    Raises ModelError for a name that the target does not have, and for a range that does not hold the target's value.
    """
    given = by_name(given, "target_box")
    values = {c.name: c.value for c in target.conditions}
    for name in given:
        if name not in values:
            raise ModelError(
                f"target_box names `{name}`, which is no condition of the target: {suggestion(name, values)}"
            )
    return {
        name: _range(given[name], f"target_box `{name}`", value, "the target")
        for name, value in values.items()
        if name in given
    }


def gain_ranges(given: Mapping[str, RangeLike] | None, law: Law, m: int) -> dict[str, tuple[Range, ...]]:
    """The ranges of the adjustable gains, one for each input; of matrices that is the diagonal.

    Raises ModelError for a gain that the law does not have or that cannot change, and for a range without its value.
    """
    given = by_name(given, "gain_ranges")
    own = gains(law.resolve(m))
    free = [name for name in own if name not in _FIXED_GAINS]
    for name in given:
        if name in _FIXED_GAINS and name in own:
            why = _FIXED_GAINS[name]
            raise ModelError(f"gain_ranges names `{name}`: {why} and cannot change at run time; {', '.join(free)} can")
        if name not in free:
            raise ModelError(f"gain_ranges names `{name}`, which is no gain of the law: {suggestion(name, free)}")
    return {
        name: _ranges(given[name], _entries(name, own), f"gain_ranges `{name}`", zero=name in _MAY_VANISH)
        for name in free
        if name in given
    }


def _entries(name: str, own: Mapping[str, Any]) -> Vector:
    """The entries of a gain, one for each input. Raises ModelError where a full matrix stands in the way."""
    if not isinstance(own[name][0], tuple):
        return tuple(own[name])
    for other in _COUPLED if name in _COUPLED else (name,):
        if not is_diagonal(own[other]):
            raise ModelError(
                f"gain_ranges names `{name}`, but {other} is a full matrix: the step inverts I + h R_c K_c, so that "
                "these change at run time only where both are diagonal; give both as diagonals, or let alpha or beta "
                "change"
            )
    return tuple(row[i] for i, row in enumerate(own[name]))


def _ranges(given: Any, value: Vector, what: str, zero: bool) -> tuple[Range, ...]:
    rows = list(given) if _is_pairs(given) else [given] * len(value)
    if len(rows) != len(value):
        raise ModelError(f"{what} has {len(rows)} ranges: one, or {len(value)} (one for each input), were expected")
    ranges = tuple(_range(row, what, v, "the gain") for row, v in zip(rows, value, strict=True))
    if any(r.lo < 0 or (r.lo == 0 and not zero) for r in ranges):
        raise ModelError(
            f"{what} reaches below zero: this gain is not negative"
            if zero
            else f"{what} reaches to zero or below: gains are positive"
        )
    return ranges


def _is_pairs(given: Any) -> bool:
    return isinstance(given, list | tuple) and bool(given) and all(isinstance(row, list | tuple) for row in given)


def _range(given: Any, what: str, value: Fraction, of: str) -> Range:
    """A pair as a range that holds the value that ``of`` has; the messages call it ``what``."""
    if isinstance(given, str) or not isinstance(given, Sequence) or len(given) != 2:
        raise ModelError(f"{what} is {given!r}: a pair (lowest, highest) was expected")
    lo, hi = (exact(v, what) for v in given)
    if not lo < hi:
        raise ModelError(f"{what} is ({given[0]}, {given[1]}): the lowest value must be below the highest")
    if not lo <= value <= hi:
        raise ModelError(
            f"{what} is ({float(lo):g}, {float(hi):g}): it must hold the value that {of} has, {float(value):g}"
        )
    return Range(lo, hi)
