"""The interval of each input, and whether it respects the actuators (interval), (intervaly)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import inf

import casadi as ca

from pbcgen.control.amplitudes import blocking, largest_amplitudes, rooms
from pbcgen.errors import UnsupportedOperation
from pbcgen.law.compensation import compensated_force
from pbcgen.models.design import Design
from pbcgen.models.laws import Law, PotentialCompensation, amplitudes, base_law
from pbcgen.models.limits import row_text
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.region import Region, search
from pbcgen.proof.boxes import Box
from pbcgen.proof.branch import Budget
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.extrema import maximum, term_bounds
from pbcgen.proof.nonnegative import nonnegative
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import BITS, Real, midpoint, precision, rational, sign, text

#: Slightly more than pi: a box that covers a period of sine and cosine.
_PI = Fraction(355, 113)
#: A limit that is exceeded by less, relative to its size, is taken to be touched: no state is looked for.
_UNSEEN = 1e-9
#: Boxes for each limit that a force may touch.
_BOXES = 2000


@dataclass(frozen=True)
class Range:
    """Values of one input: the enclosure of its infimum and supremum over everything that can happen."""

    lo: Real
    hi: Real


@dataclass(frozen=True)
class Saturation:
    """The claim `saturation` and the input ranges, None where an input is unbounded."""

    claim: Claim
    ranges: tuple[Range | None, ...]

    def intervals(self, design: Design) -> tuple[tuple[Fraction, Fraction], ...] | None:
        """Rational intervals for the emitted clamp, inside the actuator intervals; None if some input is unbounded."""
        result = []
        for found, (lo, hi) in zip(self.ranges, design.input_set.intervals, strict=True):
            if found is None:
                return None
            low, high = midpoint(found.lo), midpoint(found.hi)
            result.append((low if lo is None else max(low, lo), high if hi is None else min(high, hi)))
        return tuple(result)


def saturation(
    plant: Plant, design: Design, law: Law, point: Point, equilibrium_inputs: Sequence[Range] | None = None
) -> Saturation:
    """Bound every input and compare with the actuator limits.

    ``equilibrium_inputs`` are ranges of u* to take instead of the entries of ``point.u``.
    """
    base = base_law(law)
    sizes = amplitudes(law)
    with precision(BITS):
        centres: list[Range | None]
        if isinstance(base, PotentialCompensation):
            centres = _potential_ranges(plant)
        else:
            centres = list(equilibrium_inputs or [Range(u, u) for u in point.u])
        ranges = tuple(
            None if c is None else Range(c.lo - rational(a), c.hi + rational(a))
            for c, a in zip(centres, sizes, strict=True)
        )
        claim = _compare(plant, design, ranges, centres, sizes)
    if claim.status is Status.UNDECIDED:
        kept = _respected(plant, design, ranges, sizes, claim)
        claim = kept or _exceeded(plant, design, ranges, sizes, claim) or claim
    return Saturation(claim, ranges)


def offsets(plant: Plant, law: Law, point: Point) -> list[tuple[Real, Real]] | None:
    """For each input the range of what the law adds its saturated terms to; None if one has no bound."""
    with precision(BITS):
        if not isinstance(base_law(law), PotentialCompensation):
            return [(u, u) for u in point.u]
        found = _potential_ranges(plant)
        return [(r.lo, r.hi) for r in found if r is not None] if all(r is not None for r in found) else None


def _potential_ranges(plant: Plant) -> list[Range | None]:
    """The range of each entry of grad V over all positions in the domain."""
    mechanics = plant.system.mechanical
    if mechanics is None:
        return [None] * plant.system.m
    return [_range(plant, entry) for entry in ca.vertsplit(ca.gradient(mechanics.V, mechanics.q))]


def _range(plant: Plant, entry: ca.SX) -> Range | None:
    """Bounds of a function of the positions: by terms, and by branch and bound over a period or the domain."""
    try:
        field, (values,) = plant.exact(entry)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    value = values.scalar(field.const(0))
    names = plant.system.state_names
    domain = {k: plant.system.domain.get(name, (None, None)) for k, name in enumerate(names)}
    bounds = term_bounds(value, domain)
    used = sorted(value.symbols())
    if len(value.numerator) <= 1 + (value.constant() is not None):
        return None if bounds.lo is None or bounds.hi is None else Range(rational(bounds.lo), rational(bounds.hi))
    box = _covering_box(value, used, domain)
    if box is None:
        return None if bounds.lo is None or bounds.hi is None else Range(rational(bounds.lo), rational(bounds.hi))
    highest = _best(plant, entry, used, box, bounds.hi)
    lowest = _best(plant, -entry, used, box, None if bounds.lo is None else -bounds.lo)
    if highest is None or lowest is None:
        return None
    return Range(rational(-lowest), rational(highest))


def _covering_box(
    value: Quotient, used: Sequence[int], domain: dict[int, tuple[Fraction | None, Fraction | None]]
) -> Box | None:
    """A box that contains a representative of every value: the domain, or one period of an angle."""
    intervals = []
    for k in used:
        lo, hi = domain[k]
        if lo is not None and hi is not None:
            intervals.append((lo, hi))
        elif _has_period_of_circle(value, k):
            intervals.append((-_PI, _PI))
        else:
            return None
    return tuple(intervals)


def _has_period_of_circle(value: Quotient, k: int) -> bool:
    """Whether 2 pi is a period in symbol k: it occurs only in sines and cosines of integer multiples."""
    if k in value.generators():
        return False
    for position in value.generators():
        atom = value.field.atoms.get(position)
        if atom is None or k not in atom.argument.symbols():
            continue
        terms = atom.argument.numerator.to_dict() if atom.argument.is_polynomial() else {}
        own = [(exponents, c) for exponents, c in terms.items() if exponents[k]]
        linear = len(own) == 1 and sum(own[0][0]) == 1 and own[0][1].q == 1
        inside_only = all(g < value.field.symbol_count for g in atom.argument.generators())
        if atom.kind not in ("sin", "cos") or not (linear and inside_only):
            return False
    return True


def _best(plant: Plant, entry: ca.SX, used: Sequence[int], box: Box, other: Fraction | None) -> Fraction | None:
    """The smaller of two upper bounds."""
    tape = plant.tape(entry)
    zeros: list[Real] = [rational(0)] * plant.system.n

    def function(values: Sequence[Real]) -> Real:
        x = list(zeros)
        for k, v in zip(used, values, strict=True):
            x[k] = v
        return plant.walk(tape, x, [rational(0)] * plant.system.m)[0][0][0]

    _, bound = maximum(function, box)
    found = [b for b in (bound, other) if b is not None]
    return min(found) if found else None


def _compare(
    plant: Plant,
    design: Design,
    ranges: Sequence[Range | None],
    centres: Sequence[Range | None],
    sizes: Sequence[Fraction],
) -> Claim:
    names = plant.system.input_names
    for name, found in zip(names, ranges, strict=True):
        if found is None:
            return Claim(
                "saturation",
                Status.UNDECIDED,
                "all inputs",
                "bounds of grad V",
                f"no bound of {name} was found: grad V is not bounded by its terms",
                "give the positions a bounded domain, or use dynamic-extension",
            )
    known = [found for found in ranges if found is not None]
    shown = ", ".join(f"{n} in [{text(r.lo, 9)}, {text(r.hi, 9)}]" for n, r in zip(names, known, strict=True))
    offsets = [(c.lo, c.hi) for c in centres if c is not None]
    problems = _interval_slacks(design, names, known) + _row_slacks(design, names, known)
    worst = next((p for p in problems if p[1] == -1), None) or next((p for p in problems if p[1] is None), None)
    if worst is None:
        limits = _least_slack(problems) if problems else "no limits given"
        evidence = f"{shown}; {limits}{_beyond_domain(plant, design)}"
        return Claim("saturation", Status.PROVED, "all inputs", "interval arithmetic over the rationals", evidence)
    label, certain, excess = worst
    status = Status.REFUTED if certain == -1 and _attained(centres) else Status.UNDECIDED
    hint = _hint(design, offsets, sizes)
    counterexample = {"limit": label, "excess": text(excess, 6)} if status is Status.REFUTED else None
    return Claim(
        "saturation",
        status,
        "all inputs",
        "interval arithmetic over the rationals",
        f"{shown}; {label} is exceeded by {text(excess, 6)}",
        hint,
        counterexample,
    )


def _exceeded(
    plant: Plant, design: Design, ranges: Sequence[Range | None], sizes: Sequence[Fraction], claim: Claim
) -> Claim | None:
    """REFUTED by positions at which grad V and the amplitudes together are beyond a limit, or None.

    The filter's state is free, so that every tanh comes as close to one as one likes there.
    """
    force, region = compensated_force(plant.system, design.law), Region.stated(plant)
    if force is None:
        return None
    for row, bound in design.input_set.rows():
        if _excess(row, bound, ranges) <= _UNSEEN * (1 + abs(bound)):
            continue
        pull = sum((abs(a) * size for a, size in zip(row, sizes, strict=True)), Fraction(0))
        held = ca.dot(ca.vertcat(*map(plant.number, row)), force)
        try:
            found = search(plant, region, plant.number(bound) - held - plant.number(pull), ca.SX(1))
        except (UnsupportedOperation, ZeroDivisionError):
            continue
        if found.point is None or found.value is None:
            continue
        names, count = plant.system.state_names, force.numel()
        place = {name: text(rational(v), 17) for name, v in zip(names[:count], found.point[:count], strict=True)}
        shown = ", ".join(f"{name} = {value}" for name, value in place.items())
        label = f"{row_text(row, plant.system.input_names)} <= {text(rational(bound))}"
        return replace(
            claim,
            status=Status.REFUTED,
            method="exact or ball arithmetic at a rational point",
            evidence=f"{label} is exceeded by {text(-found.value, 6)} at {shown}, with each tanh near its end",
            counterexample={"limit": label, "excess": text(-found.value, 6), "x": place},
        )
    return None


def _respected(
    plant: Plant, design: Design, ranges: Sequence[Range | None], sizes: Sequence[Fraction], claim: Claim
) -> Claim | None:
    """PROVED where the limits that the bounds leave open are kept as functions of the positions, or None.

    ``b - a^T u_c - sum |a_i| alpha_i >= 0`` is decided as it stands, so that the force may touch the limit exactly.
    """
    force, region = compensated_force(plant.system, design.law), Region.stated(plant)
    known = [found for found in ranges if found is not None]
    if force is None or len(known) < len(ranges):
        return None
    names, kept = plant.system.input_names, []
    for row, bound in design.input_set.rows():
        if sign(rational(bound) - _largest(row, known)) in (0, 1):
            continue
        pull = sum((abs(a) * size for a, size in zip(row, sizes, strict=True)), Fraction(0))
        held = ca.dot(ca.vertcat(*map(plant.number, row)), force)
        try:
            field, (values,) = plant.exact(plant.number(bound - pull) - held)
            slack = values.scalar(field.const(0))
            certain = nonnegative(slack) or region.prover(Budget(_BOXES)).nonnegative(slack)
        except (UnsupportedOperation, ZeroDivisionError):
            return None
        if not certain:
            return None
        kept.append(f"{row_text(row, names)} <= {text(rational(bound))}")
    shown = ", ".join(f"{n} in [{text(r.lo, 9)}, {text(r.hi, 9)}]" for n, r in zip(names, known, strict=True))
    return replace(
        claim,
        status=Status.PROVED,
        method="interval arithmetic over the rationals, and signs of exact functions of the positions",
        evidence=f"{shown}; {', '.join(kept)} as a function of the positions{_beyond_domain(plant, design)}",
        hint="",
        counterexample=None,
    )


def _excess(row: Sequence[Fraction], bound: Fraction, ranges: Sequence[Range | None]) -> float:
    """By how much ``row u`` may be beyond a bound; infinite where an input has no range."""
    total = -float(bound)
    for a, found in zip(row, ranges, strict=True):
        if a:
            total += inf if found is None else float(a * midpoint(found.hi if a > 0 else found.lo))
    return total


def _attained(centres: Sequence[Range | None]) -> bool:
    """Whether the ranges are approached: certain for a constant offset, not for a bound of grad V."""
    return all(c is not None and sign(c.hi - c.lo) in (0, None) for c in centres)


_Slack = tuple[str, int | None, Real]


def _sign_of_slack(slack: Real) -> int | None:
    certain = sign(slack)
    return 1 if certain in (0, 1) else certain


def _interval_slacks(design: Design, names: Sequence[str], ranges: Sequence[Range]) -> list[_Slack]:
    """For each bound: its name, the sign of what is left (touching counts as left), and by how much it is exceeded."""
    result: list[_Slack] = []
    for name, found, (lo, hi) in zip(names, ranges, design.input_set.intervals, strict=True):
        if hi is not None:
            slack = rational(hi) - found.hi
            result.append((f"{name} <= {text(rational(hi))}", _sign_of_slack(slack), -slack))
        if lo is not None:
            slack = found.lo - rational(lo)
            result.append((f"{name} >= {text(rational(lo))}", _sign_of_slack(slack), -slack))
    return result


def _row_slacks(design: Design, names: Sequence[str], ranges: Sequence[Range]) -> list[_Slack]:
    """Polyhedral limits: the largest ``A u`` over the box of input ranges against b."""
    result: list[_Slack] = []
    for row, bound in zip(design.input_set.A, design.input_set.b, strict=True):
        slack = rational(bound) - _largest(row, ranges)
        result.append((f"{row_text(row, names)} <= {text(rational(bound))}", _sign_of_slack(slack), -slack))
    return result


def _largest(row: Sequence[Fraction], ranges: Sequence[Range]) -> Real:
    """The largest ``row u`` over the box of input ranges."""
    largest: Real = rational(0)
    for a, found in zip(row, ranges, strict=True):
        if a != 0:
            largest = largest + rational(a) * (found.hi if a > 0 else found.lo)
    return largest


def _least_slack(slacks: Sequence[_Slack]) -> str:
    """The limit that is nearest, with what is left to it."""
    label, _, excess = max(slacks, key=lambda s: midpoint(s[2]))
    return f"limits respected, {text(-excess, 6) if sign(excess) else '0'} left to {label}"


def _beyond_domain(plant: Plant, design: Design) -> str:
    """What holds the bound where positions leave a declared domain, on which the range of grad V rests."""
    base = base_law(design.law)
    mechanics = plant.system.mechanical
    if not isinstance(base, PotentialCompensation) or mechanics is None:
        return ""
    declared = [name for name in plant.system.state_names[: mechanics.q.numel()] if name in plant.system.domain]
    if not declared:
        return ""
    return f"; the law itself stays within for {', '.join(declared)} in the domain, beyond it the C cuts it off there"


def _hint(design: Design, centres: Sequence[tuple[Real, Real]], sizes: Sequence[Fraction]) -> str:
    limits = rooms(design, centres)
    blocked = blocking(limits)
    if blocked is not None:
        return (
            f"no alpha can help: without it the input is already at or beyond {blocked.limit} "
            f"(by {float(-blocked.room):.6g}); choose another target or actuator"
        )
    fitting = largest_amplitudes(limits, sizes) or sizes
    names = design.system.input_names
    listed = ", ".join(f"{float(size):.6g} for {name}" for name, size in zip(names, fitting, strict=True))
    return f"reduce the amplitudes: these sums of alpha respect all limits: {listed}"
