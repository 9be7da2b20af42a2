"""The claim `adjustable`: what code needs holds for every target and gain that the running controller may be given.

The box of settings is cut into cells. On each, x*, u* and the gains are balls, and the arguments that prove the claims
at one target are repeated with them: x* is defined and in the domain, the inputs stay in their limits, the continuous
and the sampled linearisation are stable by Gershgorin's discs in their modes, and the Hessian condition holds if it
does at the declared target. A cell that does not pass is halved. Corners are tried first, as single points: what fails
there for certain is a counterexample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from fractions import Fraction
from itertools import product
from typing import Any, Final

import casadi as ca
from flint import fmpq

from pbcgen.control.attractivity import Situation
from pbcgen.control.cells import Loops
from pbcgen.control.graph import LawGraph
from pbcgen.control.saturation import Range, Saturation, saturation
from pbcgen.control.settings import Setting, Settings
from pbcgen.models.design import Design
from pbcgen.models.laws import Integral, Law, NaturalDamping, PotentialCompensation
from pbcgen.passivity.plant import Point
from pbcgen.passivity.shaping import diagonal, shape_at
from pbcgen.passivity.target_map import NotExplicit, TargetMap
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import RealMatrix, positive_definite
from pbcgen.proof.lyapunov import Kind
from pbcgen.proof.modal import Varying, blurs, discs_inside
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

#: Cells that are tried before the claim stays open.
_CELLS: Final = 1500
#: Corners are tried while there are no more than these.
_CORNERS: Final = 64

_METHOD: Final = "balls over cells of the settings: saturation, LDL^T, Gershgorin discs in modal coordinates"

Cell = tuple[tuple[Fraction, Fraction], ...]


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
    situation: Situation, graph: LawGraph, design: Design, moving: TargetMap | NotExplicit | None
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
    box = _Box(situation, graph, design, settings)
    if not box.agrees():
        why, hint = "the explicit equilibrium is not the one that was proved for the declared target", "mend the target"
        return BoxVerdict(Claim("adjustable", Status.UNDECIDED, domain, _METHOD, why, hint), None)
    refuted = box.refuted_corner()
    if refuted is not None:
        cell, why = refuted
        where = {s.name: text(rational(lo), 9) for s, (lo, _) in zip(settings.settings, cell, strict=True)}
        hint = "narrow the box of targets or the ranges of gains so that they leave this point out"
        return BoxVerdict(Claim("adjustable", Status.REFUTED, domain, _METHOD, why, hint, where), None)
    return box.cover(domain)


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

    def __post_init__(self) -> None:
        moving = self.settings.moving
        plant = self.situation.plant
        self.whole: Cell = tuple((s.range.lo, s.range.hi) for s in self.settings.settings)
        self.reached: list[tuple[Fraction, Fraction]] | None = None
        self.hessian = self.situation.found["hessian-condition"].status is Status.PROVED
        self.base = self.situation.law.base if isinstance(self.situation.law, Integral) else self.situation.law
        self.target = [s for s in self.settings.settings if s.group == "target"]
        self.loops = Loops.of(plant, self.situation.point, self.graph, self.design.sample_period)
        if moving is not None:
            self.equilibrium = moving.tape(ca.vertcat(moving.x, moving.u))
            slopes = [ca.jacobian(u, moving.symbols).T for u in ca.vertsplit(moving.u)]
            self.slopes = moving.tape(*slopes)
        self.n = plant.system.n

    def agrees(self) -> bool:
        """Whether the map gives x* and u* of the claim `equilibrium` where the design's own values are put in."""
        own = self._point([rational(s.value) for s in self.settings.settings])
        point = self.situation.point
        pairs = zip((*own.x, *own.u), (*point.x, *point.u), strict=True)
        return all(is_finite(a) and sign(a - b) in (0, None) for a, b in pairs)

    def refuted_corner(self) -> tuple[Cell, str] | None:
        """A corner, and what certainly fails there."""
        if 2 ** len(self.whole) > _CORNERS:
            return None
        for corner in product(*self.whole):
            cell = tuple((v, v) for v in corner)
            verdict = self.decide(cell)
            if verdict[0] is Status.REFUTED:
                return cell, verdict[1]
        return None

    def cover(self, domain: str) -> BoxVerdict:
        """Prove every cell, or say which one resists."""
        waiting, proved, where, why = [self.whole], 0, "", ""
        for _ in range(_CELLS):
            if not waiting:
                break
            cell = waiting.pop()
            status, reason = self.decide(cell)
            if status is Status.PROVED:
                proved += 1
                continue
            waiting += self._halves(cell)
            where, why = self._show(cell), reason
        if waiting:
            hint = "narrow the box of targets or the ranges of gains"
            evidence = f"after {_CELLS} cells open at {where}: {why}"
            return BoxVerdict(Claim("adjustable", Status.UNDECIDED, domain, _METHOD, evidence, hint), None)
        evidence = (
            f"x* exists, saturation{', the Hessian condition' if self.hessian else ''} and stability near x*, "
            f"continuous and sampled, on {proved} cell{'s' if proved != 1 else ''}"
        )
        claim = Claim("adjustable", Status.PROVED, domain, _METHOD, evidence, certificate={"cells": proved})
        return BoxVerdict(claim, None if self.reached is None else tuple(self.reached))

    def _halves(self, cell: Cell) -> list[Cell]:
        """The cell cut across the setting that blurs the linearisations most."""
        try:
            found = [blurs(m, kind) for kind, m in self._loops(cell)]
            blurred = [sum(column) for column in zip(*found, strict=True)]
        except ZeroDivisionError:
            blurred = [0.0] * len(cell)
        shares = [float((hi - lo) / (b - a)) for (lo, hi), (a, b) in zip(cell, self.whole, strict=True)]
        k = max(range(len(cell)), key=lambda i: (blurred[i] if shares[i] else -1.0, shares[i]))
        lo, hi = cell[k]
        middle = (lo + hi) / 2
        return [(*cell[:k], (middle, hi), *cell[k + 1 :]), (*cell[:k], (lo, middle), *cell[k + 1 :])]

    def _loops(self, cell: Cell) -> list[tuple[Kind, Varying]]:
        """The continuous and the sampled linearisation. Raises ZeroDivisionError where the loop may be singular."""
        middle: Cell = tuple(((lo + hi) / 2,) * 2 for lo, hi in cell)
        centre, over = self.loops.at(_balls(middle)), self.loops.at(_balls(cell))
        with precision(BITS):
            widths = tuple(ball(enclose((lo - hi) / 2, (hi - lo) / 2)) for lo, hi in cell)
        return [(kind, Varying(centre[kind].value, over[kind].slopes, widths)) for kind in ("hurwitz", "schur")]

    def _show(self, cell: Cell) -> str:
        names = [s.name for s in self.settings.settings]
        return ", ".join(f"{n} in [{float(lo):.6g}, {float(hi):.6g}]" for n, (lo, hi) in zip(names, cell, strict=True))

    def decide(self, cell: Cell) -> tuple[Status, str]:
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
            for kind, matrix in self._loops(cell):
                status = _stable(matrix, kind, is_point)
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

    def _saturation(self, point: Point, cell: Cell) -> Saturation:
        inputs = [self._input(k, u, cell) for k, u in enumerate(point.u)]
        return saturation(self.situation.plant, self.design, self._law(cell, 1), point, inputs)

    def _input(self, k: int, u: Real, cell: Cell) -> Range:
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

    def _is_minimum(self, point: Point, cell: Cell) -> bool:
        """The Hessian condition; the Hessian grows with alpha beta, so that the smallest decide."""
        base = self._law(cell, 0)
        base = base.base if isinstance(base, Integral) else base
        alpha, beta = (base.alpha_c, base.beta_c) if isinstance(base, NaturalDamping) else (base.alpha, base.beta)
        shape = shape_at(
            self.situation.plant, point, self.situation.gamma, compensated=isinstance(base, PotentialCompensation)
        )
        stiffness = diagonal([rational(a * b) for a, b in zip(alpha, beta, strict=True)])
        with precision(BITS):
            return positive_definite(shape.hessian(stiffness)).status is Status.PROVED

    def _law(self, cell: Cell, side: int) -> Law:
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


def _balls(cell: Cell) -> list[Real]:
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


def _stable(matrix: Varying, kind: Kind, is_point: bool) -> Status:
    """Discs around the modes; for single points also the Routh array, which may refute."""
    if discs_inside(matrix, kind):
        return Status.PROVED
    if is_point:
        rows: RealMatrix = matrix.centre.tolist()
        return (hurwitz if kind == "hurwitz" else schur)(rows).status
    return Status.UNDECIDED
