"""A design with numbers that may be set at run time: its equilibrium and its closed loop as functions of these."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

from flint import arb, fmpq

from pbcgen.reading.sums import Sums
from pbcgen.reading.system import RESTING, Witness
from pbcgen.symbolic.plain.boxes import Box, ball
from pbcgen.symbolic.plain.formulas import Formulas, Lift, rational
from pbcgen.symbolic.plain.matrices import dot, negative, product
from pbcgen.symbolic.plain.spectra import all_stable, inverse, krawczyk
from pbcgen.symbolic.plain.values import Dual, Field, partial, plain, sign, variables

#: What is kept of a design once it is known, and is another at another x*.
_AT_X_STAR = ["point", "star", "gamma", "stiffness", "shaped", "hessian_d", "hessian_dc", "plant", "controller"]
_AT_X_STAR += ["continuous", "sampled", "is_hurwitz", "is_schur"]
#: Newton's steps from the start of an unknown, and what a box around it is wider than its values.
_STEPS, _LEAST = 12, fmpq(1, 10**60)
#: Parts of the range of periods that vary.
_PARTS = 6
#: In the words of a domain, numbers have six digits.
_ROUNDED = fmpq(1, 10**5)


class Family(Sums):
    """The designs that a box of settings holds; a certificate has x* and u* as formulas of the settings."""

    @cached_property
    def written_rest(self) -> Formulas:
        """x* and u* as functions of the settings; none where no target moves."""
        return Formulas.parse(self.witness["adjustable"].get("rest", []))

    @property
    def box(self) -> Box:
        """The range of each setting."""
        return [(lo, hi) for _, _, lo, hi in self.model.settings]

    def rest_at(self, values: Sequence[Any]) -> list[Any]:
        """x* and u* at settings of any kind of value."""
        if not self.written_rest.outputs:
            return [*self.point[0], *self.point[1]]
        return self._rest(values, self._solved(values))

    def _rest(self, values: Sequence[Any], z: Sequence[Any], lift: Lift = fmpq) -> list[Any]:
        """The formulas of x* and u* with settings and unknowns put in."""
        return self.written_rest.column("rest", self.written_rest.walk(lift, {"setting": values, "solved": z}))

    def _left(self, values: Sequence[Any], z: Sequence[Any], lift: Lift = fmpq, standing: bool = False) -> list[Any]:
        """What the equations of an equilibrium that meets the target leave of zero; ``standing`` systems in (q, v)."""
        x_u = self._rest(values, z, lift)
        x, u = x_u[: self.n], x_u[self.n :]
        found = self.walk(x, lift, dict.fromkeys(self.velocities, lift(fmpq(0))) if standing else None, RESTING)
        wanted = {name: lift(value) for name, value in self.model.target.items()}
        wanted |= {name: v for (name, entry, _, _), v in zip(self.model.settings, values, strict=True) if entry is None}
        return self.misfits(found, u, wanted)

    @cached_property
    def unknowns(self) -> int:
        """How many unknowns the formulas have beside the settings."""
        return self.written_rest.outputs["start"][0] if "start" in self.written_rest.outputs else 0

    @cached_property
    def open_rows(self) -> list[int]:
        """The equations that do not vanish with the formulas put in, whatever the settings and unknowns are."""
        count = len(self.model.settings)
        field = Field(count + self.unknowns, self.field.pool, self.field.units)
        values, z = field.symbols[:count], field.symbols[count:]
        momenta = self._rest(values, z, field.lift)[self.half : self.n]
        standing = self.in_velocities and not any(field.lift(p).top for p in momenta)
        return [k for k, v in enumerate(self._left(values, z, field.lift, standing)) if field.lift(v).top]

    def rests(self) -> bool:
        """Whether these are equilibria that meet the target, and the declared one is among them."""
        if not self.written_rest.outputs:
            return not any(entry is None for _, entry, _, _ in self.model.settings)
        own = [lo if entry is not None else self.model.target[name] for name, entry, lo, _ in self.model.settings]
        apart = {sign(a - b) for a, b in zip(self.rest_at(own), [*self.point[0], *self.point[1]], strict=True)}
        return len(self.open_rows) == self.unknowns and not apart & {1, -1}

    def _solved(self, values: Sequence[Any]) -> list[Any]:
        """The unknowns: Newton's steps from the start, and Krawczyk's test for all these settings at once."""
        size, over = range(self.unknowns), [plain(v) for v in values]
        if not size:
            return []

        def left(z: Sequence[Any], at: Sequence[Any] = over) -> list[Any]:
            found = self._left(at, z)
            return [found[k] for k in self.open_rows]

        middle = [arb(v).mid() for v in over]
        start = self.written_rest.walk(fmpq, {"setting": middle}, None, self.written_rest.outputs["start"][2].values())
        z = [arb(v).mid() for v in self.written_rest.column("start", start)]
        for _ in range(_STEPS):
            found = left(variables(z), middle)
            back = inverse([[partial(v, k) for k in size] for v in found])
            z = [arb(v - s).mid() for v, (s,) in zip(z, product(back, [[plain(v)] for v in found]), strict=True)]
        moved = product(back, [[v] for v in left(z)])
        reach = max((abs(arb(s)) / (1 + abs(c))).abs_upper() for c, (s,) in zip(z, moved, strict=True))
        boxes = (krawczyk(left, z, reach * factor + _LEAST) for factor in (2, 4))
        box = next((box for box in boxes if box is not None), None)
        if box is None:
            return [arb("nan")] * len(size)
        found = self._left(variables([*over, *box])[: len(over)], variables([*over, *box])[len(over) :])
        rows = [found[k] for k in self.open_rows]
        back = inverse([[partial(v, len(over) + k) for k in size] for v in rows])
        rates = negative(product(back, [[partial(v, k) for k in range(len(over))] for v in rows]))
        keys = {k for v in values if isinstance(v, Dual) for k in v.slope}
        slopes = [{k: dot(row, [partial(v, k) for v in values]) for k in keys} for row in rates]
        return [Dual(v, slope) if keys else v for v, slope in zip(box, slopes, strict=True)]

    def at(self, values: Sequence[Any], slopes: bool = False) -> Self:
        """The design with these settings; with ``slopes`` its closed loop has those by the settings."""
        other, moved = self._moved(), variables(values) if slopes else [*values]
        x_u, size = self.rest_at(moved), range(len(moved) if slopes else 0)
        other.model = self.model.with_settings(moved)
        other.moves = {k: [plain(partial(v, k)) for v in x_u[: self.n]] for k in size}
        other.point = [plain(v) for v in x_u[: self.n]], x_u[self.n :]
        return other

    def elsewhere(self, rest: Mapping[str, Any]) -> Self:
        """The design at another rest, which no target asks for; it is given as x* is."""
        other = self._moved()
        other.model, other.witness = replace(self.model, target={}), {"equilibrium": Witness(rest)}
        return other

    def _moved(self) -> Self:
        """The design without what is known of it at x*."""
        other = copy.copy(self)
        for name in _AT_X_STAR:
            other.__dict__.pop(name, None)
        return other

    @property
    def jitter(self) -> fmpq:
        """The share by which periods vary."""
        return rational(self.model.words.get("jitter", ["0"])[0])

    @property
    def periods(self) -> Box:
        """The range of the periods, which may come in any sequence."""
        return [(self.period * (1 - self.jitter), self.period * (1 + self.jitter))]

    def spread(self, cell: Box) -> tuple[Self, Self]:
        """The design in the middle of a cell, and over the cell with slopes."""
        balls = [ball(lo, hi) for lo, hi in cell]
        return self.at([(lo + hi) / 2 for lo, hi in cell]), self.at(balls, True)

    def passes(self, cell: Box) -> bool:
        """Whether for all settings of a cell x* is in the domain, and the closed loop stable near it, sampled too.

        Where periods vary, whatever their sequence is.
        """
        middle, over = self.spread(cell)
        widths = [(hi - lo) / 2 for lo, hi in cell]
        continuous, sampled = (middle.continuous, over.continuous, widths), [(middle.sampled, over.sampled, widths)]
        (lo, hi), parts = self.periods[0], _PARTS if self.jitter else 0
        for k in range(parts):
            a, b = lo + (hi - lo) * k / parts, lo + (hi - lo) * (k + 1) / parts
            moved = over.transition(Dual(ball(a, b), {len(cell): fmpq(1)}))
            sampled.append((middle.transition((a + b) / 2), moved, [*widths, (b - a) / 2]))
        inside = self.inside(dict(zip(self.states, over.point[0], strict=True)), {1})
        return inside and all_stable([continuous], False) and all_stable(sampled, True)

    def room(self, k: int) -> Callable[[Sequence[Any]], Any]:
        """What is left to a limit of the inputs, as a function of the settings; the force is not compensated."""
        return lambda values: self.at(values).rooms[k]

    def misses(self) -> bool:
        """Whether x* is certainly outside the domain, or an input beyond its limits; no force is compensated."""
        at = dict(zip(self.states, self.point[0], strict=True))
        bounds = [(at[name], lo, hi) for name, (lo, hi) in self.model.domain.items()]
        left = [v - lo for v, lo, _ in bounds if lo is not None] + [hi - v for v, _, hi in bounds if hi is not None]
        return -1 in map(sign, [*left, *([] if self.compensated else self.rooms)])

    def is_described(self, claim: str) -> bool:
        """Whether the domain of a claim names the settings with their ranges, or conditions that depend on others."""
        found = re.findall(r"(\S+) in \[([^,]+), ([^\]]+)\]", self.domain[claim])
        names = [name for name, _, _, _ in self.model.settings]
        if not found and self.status[claim] == "REFUTED":
            return bool(self.domain[claim] == ", ".join(name for name, k, _, _ in self.model.settings if k is None))
        labels = [name if names.count(name) == 1 else f"{name}_{(k or 0) + 1}" for name, k, _, _ in self.model.settings]
        numbers = [rational(end) for _, *ends in found for end in ends], [end for ends in self.box for end in ends]
        same = [name for name, *_ in found] == labels
        return same and all(abs(a - b) <= abs(b) * _ROUNDED for a, b in zip(*numbers, strict=True))
