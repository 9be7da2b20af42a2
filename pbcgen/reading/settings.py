"""A design with numbers that may be set at run time: its equilibrium and its closed loop as functions of these."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Self

from flint import arb, fmpq

from pbcgen.reading.sums import Sums
from pbcgen.symbolic.plain.boxes import Box, halves, shown
from pbcgen.symbolic.plain.formulas import Formulas, rational
from pbcgen.symbolic.plain.matrices import all_stable, plus, product
from pbcgen.symbolic.plain.values import Field, partial, plain, sign, variables

#: What is kept of a design once it is known, and is another at another x*.
_AT_X_STAR = (
    *("star", "gamma", "stiffness", "shaped", "hessian_d", "hessian_dc", "plant", "controller"),
    *("continuous", "sampled", "is_hurwitz"),
)
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

    def rest_at(self, values: Sequence[Any], lift: Callable[[fmpq], Any] = fmpq) -> list[Any]:
        """x* and u* at settings of any kind of value."""
        if not self.written_rest.outputs:
            return [*self.point[0], *self.point[1]]
        return self.written_rest.column("rest", self.written_rest.walk(lift, {"setting": values}))

    def rests(self) -> bool:
        """Whether these are equilibria that meet the target, for all settings."""
        field = Field(len(self.model.settings), 32)
        names, values = [name for name, entry, _, _ in self.model.settings if entry is None], field.symbols
        z = [field.lift(v) for v in self.rest_at(values, field.lift)] if names else []
        if not z:
            return bool(self.point)
        standing = bool(self.inertia) and all(p.number() == 0 for p in z[self.half : self.n])
        found = self.walk(z[: self.n], field.lift, dict.fromkeys(self.velocities, field.lift(0)) if standing else None)
        rates = [v for (v,) in plus(found["f"], product(found["g"], [[u] for u in z[self.n :]]))]
        wanted = self.model.target | dict(zip(names, values, strict=False))
        rates += [found[f"target {name}"][0][0] - value for name, value in wanted.items()]
        return not any(field.lift(v).top for v in rates)

    def at(self, values: Sequence[Any], slopes: bool = False) -> Self:
        """The design with these settings; with ``slopes`` its closed loop has those by the settings."""
        other, moved = copy.copy(self), variables(values) if slopes else [*values]
        x_u, size = self.rest_at(moved), range(len(moved) if slopes else 0)
        for name in _AT_X_STAR:
            other.__dict__.pop(name, None)
        other.model = self.model.with_settings(moved)
        other.moves = {k: [plain(partial(v, k)) for v in x_u[: self.n]] for k in size}
        other.point = [plain(v) for v in x_u[: self.n]], x_u[self.n :]
        return other

    def passes(self, cell: Box) -> bool:
        """Whether for all settings of a cell x* is in the domain, and the closed loop stable near it, sampled too."""
        middle = self.at([(lo + hi) / 2 for lo, hi in cell])
        over = self.at([lo if lo == hi else arb(lo).union(arb(hi)) for lo, hi in cell], True)
        widths = [(hi - lo) / 2 for lo, hi in cell]
        inside = self.inside(dict(zip(self.states, over.point[0], strict=True)), {1})
        return (
            inside
            and all_stable(middle.continuous, over.continuous, widths, False)
            and all_stable(middle.sampled, over.sampled, widths, True)
        )

    def passes_by(self, tree: str) -> bool:
        """Whether every cell of the box passes, the tree saying how it is cut."""
        letters = iter(tree)

        def look(part: Box) -> bool:
            letter = next(letters, "")
            if letter == ".":
                return self.passes(part)
            return bool(letter) and all(look(half) for half in halves(part, ord(letter) - ord("a")))

        return look(self.box) and not [*letters]

    def room(self, k: int) -> Callable[[Sequence[Any]], Any]:
        """What is left to a limit of the inputs, as a function of the settings; the force is not compensated."""
        return lambda values: self.at(values).rooms[k]

    def misses(self) -> bool:
        """Whether x* is certainly outside the domain, or an input beyond its limits; no force is compensated."""
        at = dict(zip(self.states, self.point[0], strict=True))
        bounds = [(at[name], lo, hi) for name, (lo, hi) in self.model.domain.items()]
        left = [v - lo for v, lo, _ in bounds if lo is not None] + [hi - v for v, _, hi in bounds if hi is not None]
        return -1 in map(sign, [*left, *([] if self.compensated else self.rooms)])

    def fits(self, trees: Sequence[str]) -> bool:
        """Whether the inputs stay in their limits at all settings, no force being compensated: by a tree for each."""
        limits = range(len(self.model.limits))
        return len(trees) == len(limits) and all(shown(trees[k], self.box, self.room(k), {}) for k in limits)

    def is_described(self, claim: str) -> bool:
        """Whether the domain of a claim names the settings with their ranges."""
        found = re.findall(r"(\S+) in \[([^,]+), ([^\]]+)\]", self.domain[claim])
        numbers = [rational(end) for _, *ends in found for end in ends], [end for ends in self.box for end in ends]
        same = len(found) == len(self.box)
        return same and all(abs(a - b) <= abs(b) * _ROUNDED for a, b in zip(*numbers, strict=True))
