"""Where a verdict holds: on the whole space, or on the box that the system states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.exact import decimal
from pbcgen.passivity.construction import drift_by_construction
from pbcgen.passivity.inertia import is_definite_on
from pbcgen.passivity.plant import Plant
from pbcgen.proof.branch import Budget, OnBox
from pbcgen.proof.claim import EVERYWHERE
from pbcgen.proof.nonnegative import Everywhere, Prover
from pbcgen.proof.refute import Search, refute
from pbcgen.proof.seeker import Question
from pbcgen.symbolic.field import Field
from pbcgen.symbolic.real import BITS, ZERO, Real, precision

Interval = tuple[Fraction | None, Fraction | None]

#: Arguments of these must be positive for a smooth value.
_POSITIVE_ARGUMENT = frozenset({"log", "sqrt"})
#: Arguments of these must lie in (-1, 1).
_UNIT_ARGUMENT = frozenset({"asin", "acos", "atanh", "erfinv"})
#: Whether divisors of more terms vanish somewhere is not looked at.
_LARGEST_DIVISOR = 40


@dataclass(frozen=True)
class Region:
    """A box of states by name; an empty mapping of bounds is the whole space."""

    names: tuple[str, ...]
    bounds: tuple[Interval, ...]

    @staticmethod
    def whole(plant: Plant) -> Region:
        """All states."""
        return Region(plant.system.state_names, ((None, None),) * plant.system.n)

    @staticmethod
    def stated(plant: Plant) -> Region:
        """The box that the system states."""
        names, domain = plant.system.state_names, plant.system.domain
        return Region(names, tuple(domain.get(name, (None, None)) for name in names))

    @property
    def is_whole(self) -> bool:
        """Whether no state is bounded."""
        return all(interval == (None, None) for interval in self.bounds)

    @property
    def text(self) -> str:
        """For :attr:`Claim.domain`: ``x3 in [0, 4], x1 >= 0``."""
        parts = [_interval_text(name, *interval) for name, interval in zip(self.names, self.bounds, strict=True)]
        return ", ".join(part for part in parts if part) or EVERYWHERE

    def contains(self, x: Sequence[Fraction]) -> bool:
        """Whether a state is in the box; its edge is part of it."""
        sides = zip(x, self.bounds, strict=True)
        return all((lo is None or v >= lo) and (hi is None or v <= hi) for v, (lo, hi) in sides)

    def prover(self, budget: Budget) -> Prover:
        """What decides signs on the region; positions are those of the states among the plant's symbols."""
        if self.is_whole:
            return Everywhere()
        return OnBox(dict(enumerate(self.bounds)), budget)


def _interval_text(name: str, lo: Fraction | None, hi: Fraction | None) -> str:
    if lo is not None and hi is not None:
        return f"{name} in [{decimal(lo)}, {decimal(hi)}]"
    if lo is not None:
        return f"{name} >= {decimal(lo)}"
    return f"{name} <= {decimal(hi)}" if hi is not None else ""


def search(plant: Plant, region: Region, value: ca.SX, scale: ca.SX) -> Search:
    """Look for a state of the region with ``value < 0``; both are SX of the state and the parameters."""
    at_values = plant.numeric(value, scale)
    x, u = plant.system.x, ca.SX(plant.system.m, 1)
    numeric, size = at_values(x, u)
    tape = plant.tape(value)
    at_rest: list[Real] = [ZERO] * plant.system.m

    def exact(point: Sequence[Real]) -> Real:
        with precision(BITS):
            return plant.walk(tape, point, at_rest)[0][0][0]

    return refute(Question(numeric, x, exact, region.bounds, size))


def search_with_inputs(plant: Plant, region: Region, value: ca.SX, scale: ca.SX | None = None) -> Search:
    """Look for a state of the region and an input with ``value < 0``, judged by its scale (1 if not given)."""
    system = plant.system
    numeric, size = plant.numeric(value, ca.SX(1) if scale is None else scale)(system.x, system.u)
    tape = plant.tape(value)

    def exact(point: Sequence[Real]) -> Real:
        with precision(BITS):
            return plant.walk(tape, point[: system.n], point[system.n :])[0][0][0]

    bounds = (*region.bounds, *(((None, None),) * system.m))
    return refute(Question(numeric, ca.vertcat(system.x, system.u), exact, bounds, size))


def undefined(field: Field, prover: Prover, states: int) -> list[str]:
    """Conditions for the formulas of a field to be defined and smooth that were not proved: none if all were."""
    one = field.const(1)
    open_conditions = []
    for divisor in field.divisors.values():
        if not any(k < states for k in divisor.symbols()):
            continue
        long = len(divisor.numerator) > _LARGEST_DIVISOR
        if long or not (prover.positive(divisor) or prover.positive(-divisor)):
            open_conditions.append("a divisor")
    for atom in field.atoms.values():
        argument = atom.argument
        if not any(k < states for k in argument.symbols()):
            continue
        if atom.kind in _POSITIVE_ARGUMENT and not prover.positive(argument):
            open_conditions.append(f"the argument of {atom.kind}")
        if atom.kind in _UNIT_ARGUMENT and not prover.positive(one - argument * argument):
            open_conditions.append(f"the argument of {atom.kind}")
        if atom.kind == "acosh" and not prover.positive(argument - one):
            open_conditions.append("the argument of acosh")
    return open_conditions


def why_undefined(plant: Plant, region: Region, boxes: int, *others: ca.SX | None) -> str:
    """Why f, g, S and others are not shown to be defined and smooth on a region, apart from moduli; empty if they are.

    f, g and S of a mechanical system are so where M, V, D and G are, and M(q) > 0.
    """
    system, mechanics, prover = plant.system, plant.system.mechanical, region.prover(Budget(boxes))
    parts = [system.f, system.g, system.S]
    if mechanics is not None and plant.gradient_is_exact and drift_by_construction(system):
        if not is_definite_on(plant, prover):
            return f"M(q) > 0 was not proved on {'the whole space' if region.is_whole else 'the domain'}"
        parts = [mechanics.M, mechanics.V, mechanics.D, mechanics.G]
    parts += [part for part in others if part is not None]
    if plant.tape(*parts).is_entire():
        return ""
    if not plant.is_continuous:
        return "f jumps, or S has a kink"
    try:
        field, _ = plant.exact(*parts)
    except (UnsupportedOperation, ZeroDivisionError) as reason:
        return str(reason)
    missing = undefined(field, prover, system.n)
    return f"f, g or S is not defined everywhere: {missing[0]} has no sign" if missing else ""


def holding(plant: Plant, region: Region, boxes: int, *others: ca.SX | None) -> tuple[Region, str]:
    """Where a claim that is proved wherever the model is defined on a region certainly holds, and that in words.

    That is the region, or what the system states, if the model is shown to be defined there.
    """
    for where in dict.fromkeys((region, Region.stated(plant)) if region.is_whole else (region,)):
        if not why_undefined(plant, where, boxes, *others):
            return where, where.text
    return region, f"{region.text} where the model is defined"
