"""Functions without negative values, written in a certificate as sums of squares."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

from flint import fmpq

from pbcgen.reading.system import System
from pbcgen.symbolic.plain.boxes import shown
from pbcgen.symbolic.plain.elimination import Elimination, slopes
from pbcgen.symbolic.plain.formulas import Formulas, rational
from pbcgen.symbolic.plain.matrices import Matrix, dot, plus
from pbcgen.symbolic.plain.outcomes import Malformed, NotCheckable, require
from pbcgen.symbolic.plain.values import AT_ZERO, INCREASING, Dual, never_negative, partial, plain

Ends = tuple[fmpq | None, fmpq | None]

WHERE_DEFINED = " where the model is defined"
#: Claims that say of a box that the model is defined there; global ones show it otherwise.
_BOXES = {"assumption-1", "passive-output", "assumption-3", "theta"}
#: Ends that belong to a domain are moved outwards by so much of their size, for signs on what is between them.
_BEYOND = fmpq(1, 10**9)
_AMPLITUDES = ("alpha", "alpha_c", "alpha_l", "alpha_psi", "k_p")


class Sums(System):
    """A design with the formulas and witnesses of its certificate."""

    def __init__(self, document: Mapping[str, Any], *settings: Any) -> None:
        super().__init__(document, *settings)
        self.passed: set[str] = set()
        self.readings = Formulas.parse(document["readings"])
        self.reach: list[Ends] = []  # of the inputs, where it is looked at
        require(len(self.witness) == len(document["claims"]), "a claim is made twice", Malformed)
        self.domain, self.status = ({c["claim"]: c[key] for c in document["claims"]} for key in ("domain", "status"))

    def given(self, claim: str, name: str) -> list[fmpq]:
        """Numbers of a witness."""
        return [rational(v) for v in self.witness[claim][name]]

    def vector(self, places: Sequence[int | None]) -> list[Any]:
        """Terms by their places; None is zero."""
        return [self.field.lift(0 if place is None else self.placed[place]) for place in places]

    def matrix(self, claim: str) -> Matrix:
        """The matrix Lambda of a witness."""
        return [[rational(v) for v in row] for row in self.witness[claim]["Lambda"]]

    def storage(self, claim: str) -> Matrix | None:
        """The matrix P of a witness, given by its lower triangle."""
        rows = self.witness[claim].get("P")
        return rows and [[rational(rows[max(i, j)][min(i, j)]) for j in range(len(rows))] for i in range(len(rows))]

    @property
    def rows(self) -> list[Any]:
        """For each square of passive-output a function that vanishes where the square does, in (x, u)."""
        one_u, found = [self.field.lift(1), *self.constants], []
        for _, factors, places in self.witness["passive-output"]["squares"]:
            row = dot(self.vector(places), one_u)
            for kind, a, b, alone in factors:
                if kind in (("fabs",) if alone else INCREASING):
                    row = row * (self.placed[a] - (0 if b is None else self.placed[b]))
                elif kind not in ("exp", "positive"):
                    row = row * self._factor("passive-output", kind, a, b, alone)
            found.append(row)
        return found

    def power_at(self, u: Sequence[Any]) -> Any:
        """``u^T gamma' - S'`` for these inputs."""
        one_u = [self.field.lift(1), *u]
        return dot(one_u, [dot(row, one_u) for row in self.power])

    def on_set(self, claim: str) -> Elimination:
        """The set that a witness describes: some states and inputs as functions of the others."""
        chain = Elimination(self.field, [], [])
        chain.solved = {int(k): self.placed[place] for k, place in self.witness[claim]["set"].items()}
        return chain

    def without_squares(self, matrix: Matrix, claim: str, squares: Sequence[Any]) -> Matrix:
        """The matrix without ``sum weight * factors * v v^T``: positive weights, factors that are never negative."""
        for weight, factors, places in squares:
            require(rational(weight) > 0, "a weight is not positive")
            scale = self.field.lift(rational(weight))
            for factor in factors:
                scale = scale * self._factor(claim, *factor)
            vector = self.vector(places)
            matrix = plus(matrix, [[scale * a * b for b in vector] for a in vector], -1)
        return matrix

    def nonnegative(self, matrix: Matrix, claim: str, part: Mapping[str, Any] | None = None) -> None:
        """The matrix is the sum of squares of a witness or of a part of it, on the domain of the claim."""
        rest = self.without_squares(matrix, claim, (self.witness[claim] if part is None else part)["squares"])
        self.zero([v for row in rest for v in row], "the squares do not add up to what they stand for")
        wanted = {"assumption-1": "[fS]$", "passive-output": "([fgS]|gamma)$"}.get(claim, "([fgS]|gamma|eta)$")
        if claim in _BOXES and self.on_box(claim) and not self.domain[claim].endswith(WHERE_DEFINED):
            require(self.is_defined(wanted, self.widened), "the model may have poles on the domain", NotCheckable)
        if self.domain[claim] == "all x":
            require(self.defined or self.is_defined(wanted, {}), "the model may have poles", NotCheckable)
            require(not self.inertia or self.has_inertia, "M may be singular", NotCheckable)

    @cached_property
    def has_inertia(self) -> bool:
        """Whether M(q) > 0 for all q: ``p^T v / 2 = sum s t^2`` with s > 0, and where every t is zero so is v.

        The t are linear in v. One coordinate after the other is zero because, of those t in which no other is left,
        the coefficients vanish nowhere together.
        """
        parts = [[self.placed[place] for place in both] for both in self.witness["assumption-1"]["inertia"]]
        require(all(self.field.positive(s) for s, _ in parts), "a weight is not positive")
        velocities = {*range(self.half, self.n)}
        energy = dot([*map(plain, self.momenta)], self.field.symbols[self.half : self.n]) / 2
        self.zero([energy - sum((s * t * t for s, t in parts), self.field.lift(0))], "this is not the kinetic energy")
        rows, left = [slopes(self.field, t)[self.half : self.n] for _, t in parts], {*range(self.half)}
        steady = (v for (s, _), row in zip(parts, rows, strict=True) for v in (s, *row))
        known = not any(self.field.has_poles(v) or v.used & velocities for v in steady)
        while known and left:
            alone = {k: [row[k] for row in rows if not any(row[j].top for j in left - {k})] for k in left}
            zero = {k for k, column in alone.items() if self.field.positive(self.field.lift(dot(column, column)))}
            known, left = bool(zero), left - zero
        return known

    def _factor(self, claim: str, kind: str, a: int, b: Any, alone: bool) -> Any:
        """A function without negative values.

        ``(T(a) - T(b)) (a - b)`` with T increasing (b = None: zero). Alone: T(a), or ``1 - T(a)^2`` for a bounded T. Or
        what its terms show to be positive.
        Or what a tree b of boxes shows, on the domain that the claim is made for or on a period; and on the domain how
        far state a is above or below its bound.
        """
        if kind == "box":
            return self._by_boxes(claim, a, *b)
        if kind in ("above", "below"):
            require(self.restricted(claim), "the claim is not restricted to the domain")
            bound = self.ends[a][kind == "below"]
            require(bound is not None and a >= 0, "there is no such bound")
            return (self.field.symbols[a] - bound) * (1 if kind == "above" else -1)
        if kind == "positive":
            require(self.field.positive(self.placed[a]), "a factor may not be positive")
            return self.placed[a]
        found = never_negative(kind, self.placed[a], self.field.lift(0) if b is None else self.placed[b], alone)
        require(found is not None and (b is not None or kind in AT_ZERO), "a factor has no sign")
        return found

    def _by_boxes(self, claim: str, place: int, tree: str, used: Sequence[int], zeros: Mapping[str, str]) -> Any:
        """A term that is nonnegative where the states it uses are; it and its slopes vanish at the zeros."""
        at = {int(k): rational(v) for k, v in zeros.items()}

        def value(x: Sequence[Any], lift: Callable[[Any], Any] = fmpq) -> Any:
            return self.terms.walk(lift, {"state": dict(zip(used, x, strict=True))}, None, [place])[place]

        symbols = [self.still(at[k]) if k in at else self.still(self.field.symbols[j]) for k, j in enumerate(used)]
        moved = [Dual(s.value, {k: fmpq(1)}) if k in at else s for k, s in enumerate(symbols)]
        if at:
            found = value(moved, self.still)
            self.zero([plain(found), *(partial(found, k) for k in at)], "the function does not vanish at its zeros")
        box = [self.extent(claim, self.placed[place], j) for j in used]
        require(shown(tree, box, value, at), "the boxes do not show that a function is nonnegative")
        return self.placed[place]

    @property
    def pull(self) -> list[fmpq]:
        """The size of all tanh of an input together."""
        present = [self.model.gains[name][0] for name in _AMPLITUDES if name in self.model.gains]
        return [sum(column, fmpq(0)) for column in zip(*present, strict=True)]

    @property
    def rooms(self) -> list[Any]:
        """What is left to each limit of the inputs when every tanh is at its worst."""
        held = self.force if self.compensated else self.point[1]
        left = [b - dot(row, held) - dot([abs(a) for a in row], self.pull) for row, b in self.model.limits]
        return [self.field.lift(v) for v in left] if self.compensated else left

    def extent(self, claim: str, function: Any, k: int) -> tuple[Any, Any]:
        """Where state k is for a claim: the domain that it is restricted to, or a period of the function.

        The state must then occur inside sines and cosines only, with one frequency.
        """
        lo, hi = self.ends[k]
        if lo is not None and hi is not None and self.restricted(claim):
            return lo, hi
        degrees, pool = function.top.degrees(), self.field.pool
        atoms = [atom for i, atom in enumerate(self.field.atoms.items(), 1) if degrees[pool - i]]
        inside = [(kind in ("sin", "cos"), slopes(self.field, a)[k]) for (kind, _, _), a in atoms if k in a.used]
        frequencies = {periodic and abs(slope.number() or 0) for periodic, slope in inside}
        periodic = function.bottom.is_constant() and not degrees[pool + k] and len(frequencies) == 1
        require(periodic and min(frequencies), "a function is not periodic, and its state has no bounds")
        end = fmpq(22, 7) / frequencies.pop()  # 22/7 > pi
        return -end, end

    def restricted(self, claim: str) -> bool:
        """Whether a claim speaks of states in the domain of the model only."""
        return claim in ("saturation", "equilibrium") or self.on_box(claim)

    @property
    def ends(self) -> list[Ends]:
        """The ends of each state on the domain, and those of the inputs where they are known."""
        return [(*self.model.domain.get(name, (None, None)),) for name in self.states] + self.reach

    @property
    def bounded(self) -> dict[int, Ends]:
        """The states with ends."""
        return {k: (lo, hi) for k, (lo, hi) in enumerate(self.ends[: self.n]) if not lo is hi is None}

    @property
    def widened(self) -> dict[int, Ends]:
        """The same, a little further out."""

        def beyond(v: fmpq | None, side: int) -> fmpq | None:
            return None if v is None else v + (1 + abs(v)) * side * _BEYOND

        return {k: (beyond(lo, -1), beyond(hi, 1)) for k, (lo, hi) in self.bounded.items()}

    def on_box(self, claim: str) -> bool:
        """Whether the claim is stated on the domain of the model, with its ends or without."""
        text = self.domain[claim].removesuffix(WHERE_DEFINED)
        part = r"(\S+) (?:in [\[(]([^,]+), ([^\])]+)[\])]|([<>])=? ([^,\s]+))(?:, |$)"
        box = {
            name: [rational(lo), rational(hi)] if lo else [rational(end) if side == s else None for s in "><"]
            for name, lo, hi, side, end in re.findall(part, text)
        }
        return box == self.model.domain != {} and not re.sub(part, "", text)
