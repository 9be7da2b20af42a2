"""What a running controller may be told: another target of its box, other gains of their ranges.

The law's formulas hold a symbol for every number that such a call changes: the entries of m*, gamma*, eta*, u* that
move with the target, and the gains. The controller stores these numbers beside its state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Literal

import casadi as ca

from pbcgen.models.design import Design
from pbcgen.models.gains import Matrix, Vector, diagonal
from pbcgen.models.laws import Law, gains
from pbcgen.models.ranges import Range
from pbcgen.passivity.target_map import TargetMap
from pbcgen.symbolic.real import Real, rational

Group = Literal["target", "gains"]

#: A gain in a formula: a number, or the symbol of one that may change.
Gain = Fraction | ca.SX
#: Rows of such gains.
GainMatrix = tuple[tuple[Gain, ...], ...]


@dataclass(frozen=True, eq=False)
class Setting:
    """A number that the caller may set.

    Attributes:
        group: which of the two functions sets it.
        name: as the user wrote it; gains of several channels are numbered.
        unit: of the target, where it is known.
        range: what is allowed.
        value: where it starts.
        symbol: in the formulas of what is stored.
    """

    group: Group
    name: str
    unit: str
    range: Range
    value: Fraction
    symbol: ca.SX


@dataclass(frozen=True, eq=False)
class Stored:
    """A number that the controller keeps for the law, as a function of the settings of one group.

    Attributes:
        symbol: in the formulas of the law.
        name: for the state struct.
        unit: where it is known.
        expression: in the settings' symbols and the plant's parameters.
        meaning: for the state struct.
    """

    group: Group
    symbol: ca.SX
    name: str
    unit: str
    expression: ca.SX
    meaning: str


@dataclass(frozen=True, eq=False)
class Settings:
    """The settings of a design, and what the law's formulas have asked to be stored so far."""

    settings: tuple[Setting, ...] = ()
    moving: TargetMap | None = None
    stored: list[Stored] = field(default_factory=list)
    constants: list[tuple[ca.SX, Real]] = field(default_factory=list)
    _gains: dict[str, tuple[ca.SX, ...]] = field(default_factory=dict)

    @staticmethod
    def of(design: Design, law: Law, moving: TargetMap | None) -> Settings:
        """The settings of a design; without ``moving`` its target stays fixed. ``law`` has resolved gains."""
        targets = [] if moving is None else ca.vertsplit(moving.symbols)
        conditions = {c.name: c.value for c in design.target.conditions}
        settings = [
            Setting("target", name, design.system.units.get(name, ""), found, conditions[name], symbol)
            for (name, found), symbol in zip(design.target_box.items() if targets else (), targets, strict=True)
        ]
        values: Mapping[str, Any] = gains(law)
        own: dict[str, tuple[ca.SX, ...]] = {}
        for name, ranges in design.gain_ranges.items():
            labels = [name] if len(ranges) == 1 else [f"{name}_{i + 1}" for i in range(len(ranges))]
            own[name] = tuple(ca.SX.sym(label) for label in labels)
            given = [v if isinstance(v, Fraction) else v[i] for i, v in enumerate(values[name])]
            for label, found, value, symbol in zip(labels, ranges, given, own[name], strict=True):
                settings.append(Setting("gains", label, "", found, value, symbol))
        return Settings(tuple(settings), moving, _gains=own)

    @property
    def targets(self) -> int:
        """How many settings are targets; these come first."""
        return sum(s.group == "target" for s in self.settings)

    def gain(self, name: str, values: Vector) -> tuple[Gain, ...]:
        """A gain for use in formulas."""
        if name not in self._gains:
            return tuple(values)
        return tuple(
            self._store(Stored("gains", ca.SX.sym(s.name()), s.name(), "", s, "gain"), rational(v))
            for s, v in zip(self._gains[name], values, strict=True)
        )

    def diagonal_gain(self, name: str, rows: Matrix) -> GainMatrix:
        """A gain matrix for use in formulas; one that may change is diagonal."""
        if name not in self._gains:
            return rows
        return diagonal(self.gain(name, tuple(row[i] for i, row in enumerate(rows))))

    def star(self, signal: ca.SX, value: Real, name: str, unit: str = "") -> ca.SX | None:
        """The symbol of a signal e(x, u) at a target that may move, or None if e* stays what it is."""
        if self.moving is None:
            return None
        (expression,) = self.moving.at_target(signal)
        if not ca.depends_on(expression, self.moving.moving):
            return None
        for stored in self.stored:
            if stored.group == "target" and ca.is_equal(stored.expression, expression, 100):
                return stored.symbol
        stored = Stored("target", ca.SX.sym(name), name, unit, expression, "at the target")
        return self._store(stored, value)

    def _store(self, stored: Stored, value: Real) -> ca.SX:
        self.stored.append(stored)
        self.constants.append((stored.symbol, value))
        return stored.symbol


def times(*factors: Gain) -> Gain:
    """The product; exact as long as every factor is a number."""
    exact = Fraction(1)
    rest: list[ca.SX] = []
    for factor in factors:
        if isinstance(factor, Fraction):
            exact *= factor
        else:
            rest.append(factor)
    if not rest:
        return exact
    product = rest[0]
    for factor in rest[1:]:
        product = product * factor
    return product if exact == 1 else float(exact) * product


def column(values: Sequence[Gain]) -> ca.SX:
    """Gains as an SX column; numbers become doubles."""
    if all(isinstance(v, Fraction) for v in values):
        return ca.SX(ca.DM([float(v) for v in values]))
    return ca.vertcat(*[_entry(v) for v in values])


def matrix(rows: Sequence[Sequence[Gain]]) -> ca.SX:
    """Gains as a sparse SX matrix; numbers become doubles."""
    if all(isinstance(v, Fraction) for row in rows for v in row):
        return ca.sparsify(ca.SX(ca.DM([[float(v) for v in row] for row in rows])))
    return ca.sparsify(ca.vertcat(*[ca.horzcat(*[_entry(v) for v in row]) for row in rows]))


def _entry(value: Gain) -> ca.SX:
    return ca.SX(float(value)) if isinstance(value, Fraction) else value
