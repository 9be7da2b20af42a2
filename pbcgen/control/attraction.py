"""A certified region of attraction: a level set of the Lyapunov function.

Minimised over the filter states the Lyapunov function is bounded below by

    W(x) = S(x) + kappa^T gamma(x) + e(gamma(x) - gamma*),

e the envelope of the ln cosh terms (:mod:`pbcgen.control.envelope`). Let X be a box around x* in the domain and c a
level below W on the boundary of X. Then {x in X, V <= c} cannot be left, and LaSalle's argument applies inside: every
trajectory converges to x* if no other equilibrium of the closed loop lies in {x in X, W <= c}. Both statements are
decided by branch and bound in ball arithmetic, within a budget of boxes. For mechanical systems X is a box of positions
(:mod:`pbcgen.control.landscape`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbcgen.control.derive import Derivation
from pbcgen.control.landscape import Landscape
from pbcgen.control.situation import Situation
from pbcgen.control.stability import LYAPUNOV
from pbcgen.passivity.region import Region as Domain
from pbcgen.passivity.shaping import shape_at
from pbcgen.proof.boxes import Box, halves, lengths, longest_side
from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import BITS, approximate, enclose, midpoint, precision, rational
from pbcgen.symbolic.real_matrices import RealMatrix, dense, inverse

#: Bits for branch and bound: the enclosures are wide anyway.
_BITS = 64
#: Boxes that may be looked at, and how many between two words on the progress.
BOXES = 20_000
_TELL = 500
#: Growth of the box from one trial to the next.
_RATIO = Fraction(3, 2)
#: Growth by less than this is not tried.
_FINEST = Fraction(21, 20)


@dataclass(frozen=True)
class Region:
    """A level set that is attracted to x*.

    Attributes:
        status: PROVED, or UNDECIDED when nothing was certified within the budget.
        level: the height c - V(x*) of the level set above the minimum; infinite for the whole space or domain.
        box: half-open bounds of the box X by state name, empty for the whole space; of momenta about what the level
            allows in X.
        evidence: what was done.
        height, height_at_zero: V - V(x*) of a state, with the filters where it is least and with the filters at zero.
    """

    status: Status
    level: float
    box: dict[str, tuple[float, float]]
    evidence: str
    height: Callable[[Sequence[float]], float] | None = field(default=None, repr=False, compare=False)
    height_at_zero: Callable[[Sequence[float]], float] | None = field(default=None, repr=False, compare=False)

    def contains(self, x: Sequence[float], at_zero: bool = False) -> bool:
        """Whether a state certainly belongs to the region (double precision, 1e-9 margin).

        The filters count too: they are where they come to rest if x stands still, or with ``at_zero`` at zero.
        """
        if self.status is not Status.PROVED:
            return False
        if not self.box:
            return True
        inside = all(lo <= v <= hi for v, (lo, hi) in zip(x, self.box.values(), strict=True))
        if np.isinf(self.level):
            return inside
        height = self.height_at_zero if at_zero else self.height
        return inside and height is not None and height(x) <= self.level * (1 - 1e-9)

    def as_json(self) -> dict[str, Any]:
        """For ``derived.region_of_attraction``."""
        return {
            "status": str(self.status),
            "level": self.level if np.isfinite(self.level) else None,
            "box": {name: [v if np.isfinite(v) else None for v in bounds] for name, bounds in self.box.items()},
            "evidence": self.evidence,
        }


@dataclass
class _Budget:
    """Boxes that may still be looked at, and who is told of the progress."""

    left: int
    progress: Callable[[str], None] | None
    used: int = 0

    def spend(self) -> bool:
        """Count a box; False when none is left."""
        self.used += 1
        self.left -= 1
        if self.progress is not None and self.used % _TELL == 0:
            self.progress(f"region of attraction, {self.used} boxes")
        return self.left > 0


def region_of_attraction(
    situation: Situation,
    by_lyapunov: bool,
    everywhere: bool,
    boxes: int = BOXES,
    progress: Callable[[str], None] | None = None,
) -> Region:
    """The largest level set that is certified within a budget; the same for the same design and budget.

    Args:
        situation: the design at x*.
        by_lyapunov: whether `stable` is proved by the Lyapunov function.
        everywhere: whether `globally-asymptotically-stable` is proved.
        boxes: how many may be looked at.
        progress: called with a word on how far it is.
    """
    if everywhere:
        return Region(Status.PROVED, float("inf"), {}, "the whole space: x* is globally asymptotically stable")
    found = situation.invariant
    if not by_lyapunov or found is None or not found.resting:
        return _none("needs a Lyapunov function whose invariant set consists of equilibria")
    with precision(_BITS):
        return _grow(situation, Landscape(situation), _Budget(boxes, progress))


def attracted_level_set(
    found: Derivation, boxes: int = BOXES, progress: Callable[[str], None] | None = None
) -> Region | None:
    """:func:`region_of_attraction` of what was derived; None where that stopped before there was a closed loop."""
    if found.situation is None:
        return None
    claims = {c.claim: c for c in found.claims}
    overall, stated = claims["globally-asymptotically-stable"], Domain.stated(found.plant)
    if overall.status is Status.PROVED and not stated.is_whole and overall.domain == stated.text:
        return _kept(stated)
    by_lyapunov = claims["stable"].method == LYAPUNOV
    return region_of_attraction(found.situation, by_lyapunov, overall.holds_everywhere, boxes, progress)


def _kept(stated: Domain) -> Region:
    """The whole domain, which no trajectory leaves."""
    ends = ((-np.inf if lo is None else float(lo), np.inf if hi is None else float(hi)) for lo, hi in stated.bounds)
    box = dict(zip(stated.names, ends, strict=True))
    return Region(Status.PROVED, float("inf"), box, f"x* attracts from all of the domain, {stated.text}")


def _none(why: str) -> Region:
    return Region(Status.UNDECIDED, 0.0, {}, why)


def _grow(situation: Situation, landscape: Landscape, budget: _Budget) -> Region:
    widths = _half_widths(situation, landscape)
    best = _none("no level set was certified: the Lyapunov function is too flat or the budget too small")
    scale, ratio = Fraction(1, 64), _RATIO
    while budget.left > 0 and scale <= 10**6:
        trial = _certify(situation, landscape, _clipped(situation, landscape, widths, scale), budget)
        grown = trial is not None and trial.level > best.level
        if trial is not None and grown:
            best = trial
        elif best.status is Status.PROVED:
            # Beyond the largest box that passes: smaller steps from the last one that did.
            scale, ratio = scale / ratio, 1 + (ratio - 1) / 3
            if ratio < _FINEST:
                break
        scale = _short(scale * ratio)
    return best


def _short(value: Fraction) -> Fraction:
    return value.limit_denominator(1000)


def _half_widths(situation: Situation, landscape: Landscape) -> list[Fraction]:
    """Half-widths of the box around the ellipsoid of the Hessian of W at x*."""
    shape = shape_at(situation.plant, situation.point, situation.gamma, situation.law)
    series: RealMatrix = [[rational(Fraction(float(v))) for v in row] for row in landscape.envelope.series_at_target()]
    with precision(BITS):
        inverted = inverse(dense(shape.hessian(series), len(shape.N)))
    if inverted is None:
        return [Fraction(1)] * situation.plant.system.n
    return [Fraction(float(np.sqrt(max(approximate(inverted[i][i]), 1e-300)))) for i in range(len(inverted))]


def _clipped(situation: Situation, landscape: Landscape, widths: Sequence[Fraction], scale: Fraction) -> Box:
    box = []
    names = situation.plant.system.state_names
    for k, (name, value, width) in enumerate(zip(names, situation.point.x, widths, strict=True)):
        centre = midpoint(value)
        if k in landscape.momenta:
            box.append((Fraction(0), Fraction(0)))
            continue
        lo, hi = situation.plant.system.domain.get(name, (None, None))
        low, high = centre - scale * width, centre + scale * width
        box.append((low if lo is None else max(low, lo), high if hi is None else min(high, hi)))
    return tuple(box)


def _certify(situation: Situation, landscape: Landscape, box: Box, budget: _Budget) -> Region | None:
    """The level set below the boundary of the box, if it is proved to be attracted to x*."""
    faces = [
        (*box[:k], (end, end), *box[k + 1 :])
        for k, bounds in enumerate(box)
        if k not in landscape.momenta
        for end in bounds
    ]
    lowest = [_lowest(landscape, face) for face in faces]
    least = min(height for height, _ in lowest)
    if not np.isfinite(least) or least <= 0:
        return None
    level = Fraction(least) * Fraction(98, 100)
    count = 0
    for face, (_, anchor) in zip(faces, lowest, strict=True):
        used = _prove_above(landscape, face, level, anchor, budget)
        if used is None:
            return None
        count += used
    inside = _prove_alone(situation, landscape, box, level, budget)
    if inside is None:
        return None
    names = situation.plant.system.state_names
    bounds = {name: (float(lo), float(hi)) for name, (lo, hi) in zip(names, box, strict=True)}
    for k, most in zip(landscape.momenta, landscape.momentum(box, float(level)), strict=True):
        bounds[names[k]] = (-most, most)
    evidence = (
        f"V - V(x*) <= {float(level):.6g} inside the box; {count} boxes on its boundary and {inside} inside, "
        "by branch and bound in ball arithmetic"
    )
    return Region(Status.PROVED, float(level), bounds, evidence, landscape.height, landscape.height_at_zero)


def _lowest(landscape: Landscape, face: Box) -> tuple[float, list[Fraction]]:
    """The least height on a face and where, by sampling and local descent in double precision."""
    from scipy.optimize import minimize

    generator = np.random.default_rng(0)
    lo = np.array([float(a) for a, _ in face])
    hi = np.array([float(b) for _, b in face])
    points = generator.uniform(lo, hi, size=(40, len(face)))
    points[0] = (lo + hi) / 2
    start = points[int(np.argmin([landscape.height(p) for p in points]))]
    result = minimize(landscape.height, start, bounds=list(zip(lo, hi, strict=True)), method="L-BFGS-B")
    return float(result.fun), [Fraction(float(v)) for v in np.clip(result.x, lo, hi)]


def _prove_above(
    landscape: Landscape, face: Box, level: Fraction, anchor: Sequence[Fraction], budget: _Budget
) -> int | None:
    """The number of boxes that show W > level on the face, or None."""
    waiting, count, whole = [face], 0, lengths(face)
    while waiting:
        part = waiting.pop()
        count += 1
        if not budget.spend():
            return None
        if landscape.exceeds(part, level, anchor):
            continue
        if landscape.height([float((lo + hi) / 2) for lo, hi in part]) <= level:
            return None
        waiting.extend(halves(part, longest_side(part, whole)))
    return count


def _prove_alone(situation: Situation, landscape: Landscape, box: Box, level: Fraction, budget: _Budget) -> int | None:
    """The number of boxes that show x* to be the only equilibrium with W <= level in the box, or None."""
    centre = landscape.centre_slope()
    if centre is None:
        return None
    x_star = [midpoint(v) for v in situation.point.x]
    core = _core(landscape, box, x_star, centre)
    if core is None:
        return None
    whole = lengths(box)
    waiting, count = [box], 0
    while waiting:
        part = waiting.pop()
        count += 1
        if not budget.spend():
            return None
        x = [enclose(lo, hi) for lo, hi in part]
        inside = all(c[0] <= p[0] and p[1] <= c[1] for p, c in zip(part, core, strict=True))
        if (inside or not landscape.can_rest(x)) and landscape.regular_inertia(x):
            continue
        if not inside and landscape.exceeds(part, level, [(lo + hi) / 2 for lo, hi in part]):
            continue
        waiting.extend(halves(part, longest_side(part, whole)))
    return count


def _core(landscape: Landscape, box: Box, x_star: Sequence[Fraction], centre: NDArray[np.float64]) -> Box | None:
    """A box around x* in which the rest equations have at most one solution."""
    shrink = Fraction(1)
    for _ in range(24):
        core = tuple((c - shrink * (c - lo), c + shrink * (hi - c)) for c, (lo, hi) in zip(x_star, box, strict=True))
        if landscape.regular([enclose(lo, hi) for lo, hi in core], centre):
            return core
        shrink /= 2
    return None
