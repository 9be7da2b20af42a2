"""The claim `adjustable`: what code needs holds for every target and gain that the running controller may be given.

The box of settings is cut into cells. On each, x*, u* and the gains are balls, and the arguments that prove the claims
at one target are repeated with them: x* is defined and in the domain, the inputs stay in their limits, the continuous
and the sampled linearisation are stable by Gershgorin's discs in their modes, and the Hessian condition holds if it
does at the declared target. A cell that does not pass is halved. Corners are tried first, as single points: what fails
there for certain is a counterexample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from fractions import Fraction
from itertools import pairwise, product
from typing import Any, Final

import casadi as ca
from flint import arb, fmpq

from pbcgen.control.cells import Loops
from pbcgen.control.sampled import Sampling
from pbcgen.control.saturation import Range, Saturation, saturation
from pbcgen.control.situation import Situation
from pbcgen.law.graph import LawGraph
from pbcgen.law.settings import Setting, Settings
from pbcgen.models.design import Design
from pbcgen.models.laws import Law, PassiveOutput, base_law, shaping
from pbcgen.passivity.plant import Point
from pbcgen.passivity.shaping import extended_hessian, shape_at
from pbcgen.passivity.target_map import NotExplicit, TargetMap
from pbcgen.proof.boxes import Box, halves
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import positive_definite
from pbcgen.proof.lyapunov import Kind
from pbcgen.proof.modal import Varying, blurs, contract
from pbcgen.proof.spectrum import hurwitz, schur
from pbcgen.symbolic.real import (
    BITS,
    Real,
    ball,
    enclose,
    is_finite,
    lower,
    precision,
    rational,
    sign,
    text,
    upper,
)
from pbcgen.symbolic.real_matrices import RealMatrix, diagonal, exact_matrix

#: Cells that are tried before the claim stays open.
_CELLS: Final = 2500
#: The search is given up where this part of the cells has proved less than that share of the box.
_PATIENCE, _LEAST_SHARE = 0.1, 1e-4
#: Corners are tried while there are no more than these, and as many middles of cells that resist.
_CORNERS: Final = 64
#: Where the box is not proved: shares of it around the declared setting, and the cells that each may take.
_SHARES: Final = (Fraction(1, 2), Fraction(1, 4), Fraction(1, 10), Fraction(1, 30))
_SHARE_CELLS: Final = 200
#: Parts into which the interval of sample periods is cut.
_PERIODS: Final = 6

_METHOD: Final = "balls over cells of the settings: saturation, LDL^T, Gershgorin discs in modal coordinates"


@dataclass(frozen=True)
class BoxVerdict:
    """The claim, and what the inputs reach over all settings (None where it is not known)."""

    claim: Claim
    reached: tuple[tuple[Fraction, Fraction], ...] | None

    def intervals(
        self, design: Design, nominal: tuple[tuple[Fraction, Fraction], ...] | None
    ) -> tuple[tuple[Fraction, Fraction], ...] | None:
        """The intervals of the emitted clamp: those of all settings, inside the actuators'."""
        if self.reached is None or nominal is None:
            return nominal
        return tuple(
            (min(a, lo if low is None else max(lo, low)), max(b, hi if high is None else min(hi, high)))
            for (a, b), (lo, hi), (low, high) in zip(nominal, self.reached, design.input_set.intervals, strict=True)
        )


def box_claim(
    situation: Situation,
    graph: LawGraph,
    design: Design,
    moving: TargetMap | NotExplicit | None,
    sampling: Sampling,
) -> BoxVerdict:
    """Decide the claim for the settings of a design."""
    settings = graph.settings
    domain = describe(settings.settings) or ", ".join(design.target_box)
    if isinstance(moving, NotExplicit):
        if moving.assignable:
            return BoxVerdict(Claim("adjustable", Status.UNDECIDED, domain, _METHOD, moving.reason, moving.hint), None)
        counterexample = {"reason": moving.reason}
        return BoxVerdict(
            Claim("adjustable", Status.REFUTED, domain, "elimination", moving.reason, moving.hint, counterexample), None
        )
    jump = situation.plant.jumps(situation.gamma, *([] if situation.eta is None else [situation.eta]))
    if jump:
        why, hint = (
            f"gamma or eta may jump by `{jump}` at some target",
            "give functions that have derivatives everywhere",
        )
        return BoxVerdict(Claim("adjustable", Status.UNDECIDED, domain, _METHOD, why, hint), None)
    box = _Box(situation, graph, design, settings, sampling)
    if not box.agrees():
        why, hint = "the explicit equilibrium is not the one that was proved for the declared target", "mend the target"
        return BoxVerdict(Claim("adjustable", Status.UNDECIDED, domain, _METHOD, why, hint), None)
    counted = box.points() or box.cover(box.whole, _CELLS)
    if isinstance(counted, _Refuted):
        hint = box.narrower() or "narrow the box of targets or the ranges of gains so that they leave this point out"
        return BoxVerdict(
            Claim("adjustable", Status.REFUTED, domain, _METHOD, counted.why, hint, dict(counted.where)), None
        )
    if isinstance(counted, _Open):
        evidence = f"open at {counted.where}: {counted.why}"
        hint = box.narrower() or "narrow the box of targets or the ranges of gains"
        return BoxVerdict(Claim("adjustable", Status.UNDECIDED, domain, _METHOD, evidence, hint), None)
    claim = Claim("adjustable", Status.PROVED, domain, _METHOD, box.evidence(counted), certificate={"cells": counted})
    return BoxVerdict(claim, None if box.reached is None else tuple(box.reached))


@dataclass(frozen=True)
class _Refuted:
    """A setting, and what certainly fails there."""

    where: Mapping[str, str]
    why: str


@dataclass(frozen=True)
class _Open:
    """A cell that resists, and what."""

    where: str
    why: str


def describe(settings: Sequence[Setting]) -> str:
    """The box in words."""
    return ", ".join(
        f"{s.name} in [{text(rational(s.range.lo), 6)}, {text(rational(s.range.hi), 6)}]" for s in settings
    )


@dataclass
class _Box:
    """The claims as functions of a cell."""

    situation: Situation
    graph: LawGraph
    design: Design
    settings: Settings
    sampling: Sampling

    def __post_init__(self) -> None:
        moving = self.settings.moving
        plant = self.situation.plant
        self.whole: Box = tuple((s.range.lo, s.range.hi) for s in self.settings.settings)
        self.reached: list[tuple[Fraction, Fraction]] | None = None
        found = self.situation.found
        self.hessian = found["hessian-condition"].status is Status.PROVED
        self.filtered = "kc-bound" in found and found["kc-bound"].status is Status.PROVED
        self.base = base_law(self.situation.law)
        self.target = [s for s in self.settings.settings if s.group == "target"]
        self.loops = Loops.of(plant, self.situation.point, self.graph, self.design.sample_period, self.sampling.delay)
        if moving is not None:
            self.equilibrium = moving.tape(ca.vertcat(moving.x, moving.u))
            slopes = [moving.slope(u).T for u in ca.vertsplit(moving.u)]
            self.slopes = moving.tape(*slopes)
        self.n = plant.system.n

    def agrees(self) -> bool:
        """Whether the map gives x* and u* of the claim `equilibrium` where the design's own values are put in."""
        own = self._point([rational(s.value) for s in self.settings.settings])
        point = self.situation.point
        pairs = zip((*own.x, *own.u), (*point.x, *point.u), strict=True)
        return all(is_finite(a) and sign(a - b) in (0, None) for a, b in pairs)

    def points(self) -> _Open | _Refuted | None:
        """What resists at the declared setting or at a corner: without these no cell around them passes."""
        corners = list(product(*self.whole)) if 2 ** len(self.whole) <= _CORNERS else []
        for point in [tuple(s.value for s in self.settings.settings), *corners]:
            cell = tuple((v, v) for v in point)
            status, why = self.decide(cell)
            if status is not Status.PROVED:
                return self._at(cell, why) if status is Status.REFUTED else _Open(self._show(cell), why)
        return None

    def cover(self, whole: Box, budget: int) -> int | _Open | _Refuted:
        """The number of cells on which a box is proved, or what resists."""
        budget //= 1 + _PERIODS * bool(self.sampling.jitter)
        waiting, proved, middles, left, done = [whole], 0, 0, _Open("", ""), 0.0
        for count in range(1, budget + 1):
            if not waiting or (done < _LEAST_SHARE and count > _PATIENCE * budget):
                break
            cell = waiting.pop()
            status, reason = self.decide(cell)
            if status is Status.PROVED:
                proved, done = proved + 1, done + _share(cell, whole)
                continue
            if middles < _CORNERS:
                middles += 1
                middle = tuple(((lo + hi) / 2,) * 2 for lo, hi in cell)
                status, why = self.decide(middle)
                if status is Status.REFUTED:
                    return self._at(middle, why)
            waiting += self._halves(cell)
            left = _Open(f"{self._show(cell)} after {count} cells", reason)
        return left if waiting else proved

    def _at(self, point: Box, why: str) -> _Refuted:
        names = [s.name for s in self.settings.settings]
        return _Refuted({n: text(rational(lo), 9) for n, (lo, _) in zip(names, point, strict=True)}, why)

    def narrower(self) -> str | None:
        """A hint: a part of the box, around the declared setting, that is proved."""
        for share in _SHARES:
            part = tuple(
                (_towards(s.value, lo, share), _towards(s.value, hi, share))
                for s, (lo, hi) in zip(self.settings.settings, self.whole, strict=True)
            )
            if all(lo < hi for lo, hi in part) and isinstance(self.cover(part, _SHARE_CELLS), int):
                return f"narrow it: {self._show(part, 12)} is proved"
        return None

    def evidence(self, cells: int) -> str:
        """What is proved, in words."""
        sampled = ["sampled"]
        if self.sampling.delay:
            sampled.append(f"with a delay of {float(self.sampling.delay):g} samples")
        if self.sampling.jitter:
            sampled.append(f"with periods that vary by {100 * float(self.sampling.jitter):g} %")
        moving = self.settings.moving
        return (
            f"x* exists{'' if moving is None else moving.how}, saturation"
            f"{', the Hessian condition' if self.hessian else ''} and stability near x*, "
            f"continuous and {' '.join(sampled)}, on {cells} cell{'s' if cells != 1 else ''}"
        )

    def _halves(self, cell: Box) -> list[Box]:
        """The cell cut across the setting that helps most with the linearisation that is furthest from a proof."""
        try:
            _, *after = max(blurs(family[0], kind) for kind, family in self._loops(cell, periods=False))
        except ZeroDivisionError:
            after = [math.inf] * len(cell)
        shares = [float((hi - lo) / (b - a)) for (lo, hi), (a, b) in zip(cell, self.whole, strict=True)]
        k = min(range(len(cell)), key=lambda i: (after[i] if shares[i] else math.inf, -shares[i]))
        return [*reversed(halves(cell, k))]

    def _loops(self, cell: Box, periods: bool = True) -> list[tuple[Kind, list[Varying]]]:
        """The continuous and the sampled linearisation; the latter also with all ``periods`` that may occur.

        Raises ZeroDivisionError where the loop may be singular.
        """
        at_middle, at_cell = _balls(tuple(((lo + hi) / 2,) * 2 for lo, hi in cell)), _balls(cell)
        with precision(BITS):
            widths = tuple(_radius(lo, hi) for lo, hi in cell)
        centre, over = self.loops.at(at_middle), self.loops.at(at_cell)
        families: dict[Kind, list[Varying]] = {
            kind: [Varying(centre[kind].value, over[kind].slopes, widths)] for kind in ("hurwitz", "schur")
        }
        if periods and self.sampling.jitter:
            h, share = self.design.sample_period, self.sampling.jitter
            ends = [h * (1 - share + 2 * share * k / _PERIODS) for k in range(_PERIODS + 1)]
            for a, b in pairwise(ends):
                with precision(BITS):
                    middle, period, width = ball(rational((a + b) / 2)), enclose(a, b), _radius(a, b)
                own, slopes = self.loops.at(at_middle, middle)["schur"], self.loops.at(at_cell, period)["schur"].slopes
                families["schur"].append(Varying(own.value, slopes, (*widths, width)))
        return list(families.items())

    def _show(self, cell: Box, digits: int = 6) -> str:
        parts = []
        for setting, (lo, hi) in zip(self.settings.settings, cell, strict=True):
            low, high = (f"{float(v):.{digits}g}" for v in (lo, hi))
            parts.append(f"{setting.name} = {low}" if lo == hi else f"{setting.name} in [{low}, {high}]")
        return ", ".join(parts)

    def decide(self, cell: Box) -> tuple[Status, str]:
        """All claims on one cell; REFUTED only where the cell is a point."""
        point = self._point(_balls(cell))
        outside = self._outside(point)
        if outside is not None:
            return outside
        limits = self._saturation(point, cell)
        if limits.claim.status is not Status.PROVED:
            return limits.claim.status, limits.claim.evidence
        is_point = all(lo == hi for lo, hi in cell)
        try:
            for kind, family in self._loops(cell):
                status = _stable(family, kind, is_point)
                if status is not Status.PROVED:
                    what = "continuous" if kind == "hurwitz" else "sampled"
                    not_ = "is not" if status is Status.REFUTED else "may not be"
                    return status, f"the {what} linearisation {not_} stable"
        except ZeroDivisionError:
            return Status.UNDECIDED, "the loop equation may be singular"
        if self.hessian and not self._is_minimum(point, cell):
            return Status.UNDECIDED, "the Hessian condition"
        self._reach(limits)
        return Status.PROVED, ""

    def _point(self, balls: Sequence[Real]) -> Point:
        moving = self.settings.moving
        if moving is None:
            return self.situation.point
        with precision(BITS):
            (values,) = moving.walk(self.equilibrium, balls[: len(self.target)])
        return Point(tuple(values[: self.n]), tuple(values[self.n :]))

    def _outside(self, point: Point) -> tuple[Status, str] | None:
        if not all(is_finite(v) for v in (*point.x, *point.u)):
            return Status.UNDECIDED, "the equilibrium is not certainly defined"
        system = self.situation.plant.system
        for name, value in zip(system.state_names, point.x, strict=True):
            lo, hi = system.domain.get(name, (None, None))
            if (lo is not None and upper(value) < lo) or (hi is not None and lower(value) > hi):
                return Status.REFUTED, f"the equilibrium has {name} = {text(value, 6)}, outside its domain"
            if (lo is not None and lower(value) < lo) or (hi is not None and upper(value) > hi):
                return Status.UNDECIDED, f"the equilibrium may leave the domain of {name}"
        return None

    def _saturation(self, point: Point, cell: Box) -> Saturation:
        inputs = [self._input(k, u, cell) for k, u in enumerate(point.u)]
        return saturation(self.situation.plant, self.design, self._law(cell, 1), point, inputs)

    def _input(self, k: int, u: Real, cell: Box) -> Range:
        """The range of an entry of u* over a cell: from corners where it is monotone, so that limits may be touched."""
        moving = self.settings.moving
        if moving is None or isinstance(u, fmpq):
            return Range(u, u)
        own = cell[: len(self.target)]
        with precision(BITS):
            signs = [sign(v) for v in moving.walk(self.slopes, _balls(own))[k]]
            if any(s is None for s in signs):
                return Range(u, u)
            ends = []
            for up in (False, True):
                corner = [hi if (s == 1) == up else lo for s, (lo, hi) in zip(signs, own, strict=True)]
                ends.append(moving.walk(self.equilibrium, [rational(v) for v in corner])[0][self.n + k])
        return Range(ends[0], ends[1])

    def _is_minimum(self, point: Point, cell: Box) -> bool:
        """The Hessian condition, that of (x, x_c) where it was proved; the least alpha beta and K_c decide."""
        law = self._law(cell, 0)
        base = base_law(law)
        shape = shape_at(self.situation.plant, point, self.situation.gamma, law)
        stiffness = diagonal([rational(v) for v in shaping(law).stiffness])
        with precision(BITS):
            if self.filtered and not isinstance(base, PassiveOutput):
                hessian = extended_hessian(shape, stiffness, exact_matrix(base.K_c))
            else:
                hessian = shape.hessian(stiffness)
            return positive_definite(hessian).status is Status.PROVED

    def _law(self, cell: Box, side: int) -> Law:
        """The law with every adjustable gain at one end of the cell."""
        ends: dict[str, list[Fraction]] = {}
        values = {s.name: bounds[side] for s, bounds in zip(self.settings.settings, cell, strict=True)}
        for name, ranges in self.design.gain_ranges.items():
            labels = [name] if len(ranges) == 1 else [f"{name}_{i + 1}" for i in range(len(ranges))]
            ends[name] = [values[label] for label in labels]
        return _with_gains(self.situation.law, ends)

    def _reach(self, limits: Saturation) -> None:
        found = [(lower(r.lo), upper(r.hi)) for r in limits.ranges if r is not None]
        if self.reached is None:
            self.reached = found
        self.reached = [(min(a, c), max(b, d)) for (a, b), (c, d) in zip(self.reached, found, strict=True)]


def _share(cell: Box, whole: Box) -> float:
    """The share of a box that a cell of it has."""
    return math.prod(float((hi - lo) / (b - a)) for (lo, hi), (a, b) in zip(cell, whole, strict=True) if b > a)


def _balls(cell: Box) -> list[Real]:
    with precision(BITS):
        return [rational(lo) if lo == hi else enclose(lo, hi) for lo, hi in cell]


def _with_gains(law: Law, values: Mapping[str, Sequence[Fraction]]) -> Law:
    own: dict[str, Any] = {
        item.name: _with_gains(getattr(law, item.name), values)
        if item.name == "base"
        else values.get(item.name, getattr(law, item.name))
        for item in fields(law)
    }
    return type(law)(**own)


def _stable(family: list[Varying], kind: Kind, is_point: bool) -> Status:
    """Discs around the modes; for single points also the Routh array, which may refute."""
    if contract(family, kind):
        return Status.PROVED
    if not is_point:
        return Status.UNDECIDED
    rows: RealMatrix = family[0].centre.tolist()
    found = (hurwitz if kind == "hurwitz" else schur)(rows).status
    return Status.UNDECIDED if found is Status.PROVED and len(family) > 1 else found


def _radius(lo: Fraction, hi: Fraction) -> arb:
    return ball(enclose((lo - hi) / 2, (hi - lo) / 2))


def _towards(value: Fraction, end: Fraction, share: Fraction) -> Fraction:
    """A point between a value and an end of its range, at this share of the way, in four digits."""
    distance = (end - value) * share
    if not distance:
        return value
    point = Fraction(f"{float(value + distance):.4g}")
    return point if min(value, end) <= point <= max(value, end) else value
