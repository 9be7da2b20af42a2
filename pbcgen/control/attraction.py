"""A certified region of attraction: a level set of the Lyapunov function.

Minimised over the filter states the Lyapunov function is bounded below by

    W(x) = S(x) + kappa^T gamma(x) + e(gamma(x) - gamma*),

e the envelope of the ln cosh terms (:mod:`pbcgen.control.envelope`). Let X be a box around x* in the domain and c a
level below W on the boundary of X. Then {x in X, V <= c} cannot be left, and LaSalle's argument applies inside: every
trajectory converges to x* if no other equilibrium of the closed loop lies in {x in X, W <= c}. Both statements are
decided by branch and bound in ball arithmetic, within a budget of boxes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
from flint import arb, arb_mat
from numpy.typing import NDArray

from pbcgen.control.attractivity import Situation
from pbcgen.control.envelope import Envelope
from pbcgen.passivity.shaping import add, congruence, multiply, shape_at, transpose
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import RealMatrix, inverse, positive_semidefinite
from pbcgen.symbolic.real import (
    BITS,
    Real,
    approximate,
    ball,
    enclose,
    is_finite,
    lower,
    midpoint,
    precision,
    rational,
    upper,
)
from pbcgen.symbolic.tape import Tape

Box = tuple[tuple[Fraction, Fraction], ...]

#: Bits for branch and bound: the enclosures are wide anyway.
_BITS = 64
#: Boxes that may be looked at, and how many between two words on the progress.
BOXES = 20_000
_TELL = 500
#: Growth of the box from one trial to the next.
_RATIO = Fraction(3, 2)


@dataclass(frozen=True)
class Region:
    """A level set that is attracted to x*.

    Attributes:
        status: PROVED, or UNDECIDED when nothing was certified within the budget.
        level: the height c - V(x*) of the level set above the minimum; infinite for the whole space.
        box: half-open bounds of the box X by state name, empty for the whole space.
        evidence: what was done.
    """

    status: Status
    level: float
    box: dict[str, tuple[float, float]]
    evidence: str
    height: Callable[[Sequence[float]], float] | None = field(default=None, repr=False, compare=False)

    def contains(self, x: Sequence[float]) -> bool:
        """Whether a state with resting filters certainly belongs to the region (double precision, 1e-9 margin)."""
        if self.status is not Status.PROVED:
            return False
        if not self.box:
            return True
        inside = all(lo <= v <= hi for v, (lo, hi) in zip(x, self.box.values(), strict=True))
        return inside and self.height is not None and self.height(x) <= self.level * (1 - 1e-9)

    def as_json(self) -> dict[str, Any]:
        """For ``derived.region_of_attraction``."""
        return {
            "status": str(self.status),
            "level": self.level if np.isfinite(self.level) else None,
            "box": {name: list(bounds) for name, bounds in self.box.items()},
            "evidence": self.evidence,
        }


class _Landscape:
    """W and the closed-loop rest equations over boxes of x."""

    def __init__(self, situation: Situation) -> None:
        self.situation = situation
        plant = situation.plant
        system = plant.system
        self.envelope = Envelope(*situation.gains)
        comp = situation.compensation
        mechanics = system.mechanical
        if comp is not None and mechanics is not None:
            energy = ca.dot(mechanics.p, mechanics.velocity) / 2
            drift = system.f + ca.mtimes(system.g, comp)
        else:
            energy = system.S - ca.dot(system.u, situation.gamma)
            drift = system.f + ca.mtimes(system.g, system.u)
        self.drift_slope = ca.jacobian(drift, system.x)
        self.tape: Tape = plant.tape(energy, situation.gamma)
        self.rest_tape: Tape = plant.tape(drift, system.g, situation.gamma)
        self.slope_tape: Tape = plant.tape(
            ca.densify(self.drift_slope),
            ca.densify(ca.jacobian(situation.gamma, system.x)),
            ca.densify(system.g),
            situation.gamma,
        )
        gradient = ca.gradient(energy, system.x)
        slope = ca.jacobian(situation.gamma, system.x)
        self.affine = not ca.depends_on(ca.densify(slope), system.x)
        self.first_tape: Tape = plant.tape(energy, ca.densify(gradient), ca.densify(slope), situation.gamma)
        self.second_tape: Tape = plant.tape(
            ca.densify(ca.jacobian(gradient, system.x)), ca.densify(slope), situation.gamma
        )
        u: list[Real] = list(situation.point.u)
        self.u = u
        with precision(BITS):
            energy_star, gamma_star = plant.walk(self.tape, situation.point.x, u)
        self.minimum: Real = energy_star[0][0]
        self.gamma_star = [row[0] for row in gamma_star]
        self.numeric = plant.numeric(energy, situation.gamma)

    def above(self, x: Sequence[Real]) -> Real:
        """A ball not above W(x) - V(x*) on the box."""
        energy, gamma = self.situation.plant.walk(self.tape, x, self.u)
        return ball(energy[0][0]) - ball(self.minimum) + self.envelope.least(self._deviation(gamma))

    def _deviation(self, gamma: RealMatrix) -> list[Real]:
        """gamma - gamma*."""
        return [ball(row[0]) - ball(star) for row, star in zip(gamma, self.gamma_star, strict=True)]

    def exceeds(self, part: Box, level: Fraction, anchor: Sequence[Fraction]) -> bool:
        """Whether W - V(x*) > level on the whole box: by enclosure, by a supporting plane, or to second order."""
        x = [enclose(lo, hi) for lo, hi in part]
        value = self.above(x)
        if is_finite(value) and lower(value) > level:
            return True
        if not self.affine:
            return False
        hessian = self._hessian(x)
        if hessian is None:
            return False
        middle = [(lo + hi) / 2 for lo, hi in part]
        if positive_semidefinite(hessian).status is Status.PROVED:
            near = [min(max(a, lo), hi) for a, (lo, hi) in zip(anchor, part, strict=True)]
            return any(self._plane(part, c) > level for c in (near, middle))
        radii = [(hi - lo) / 2 for lo, hi in part]
        return self._plane(part, middle) + _least_curvature(hessian, radii) > level

    def _plane(self, part: Box, at: Sequence[Fraction]) -> Fraction:
        """A lower bound of the tangent plane at a point over the box."""
        energy, gradient, slope, gamma = self.situation.plant.walk(self.first_tape, [rational(v) for v in at], self.u)
        s = self._deviation(gamma)
        value = ball(energy[0][0]) - ball(self.minimum) + self.envelope.least(s)
        g = [ball(row[0]) for row in gradient]
        for force, row in zip(self.envelope.forces(s), slope, strict=True):
            g = [a + force * ball(b) for a, b in zip(g, row, strict=True)]
        if not value.is_finite() or not all(a.is_finite() for a in g):
            return Fraction(-1)
        total = lower(value)
        for a, c, (lo, hi) in zip(g, at, part, strict=True):
            total += min(lower(a) * (lo - c), lower(a) * (hi - c), upper(a) * (lo - c), upper(a) * (hi - c))
        return total

    def _hessian(self, x: Sequence[Real]) -> RealMatrix | None:
        """An enclosure of the Hessian of W over the box, for affine gamma."""
        second, slope, gamma = self.situation.plant.walk(self.second_tape, x, self.u)
        stiff = self.envelope.stiffness(self._deviation(gamma))
        n = len(second)
        added = congruence(transpose(slope), [list(row) for row in stiff])
        rows: RealMatrix = [
            [ball(second[max(i, j)][min(i, j)]) + ball(added[max(i, j)][min(i, j)]) for j in range(n)] for i in range(n)
        ]
        return rows if all(is_finite(v) for row in rows for v in row) else None

    def height(self, x: Sequence[float]) -> float:
        """W(x) - V(x*) in double precision."""
        energy, gamma = self.numeric(x, [approximate(v) for v in self.u])
        deviations = np.array(gamma).ravel() - np.array([approximate(v) for v in self.gamma_star])
        return float(energy) - approximate(self.minimum) + self.envelope.value(deviations)

    def can_rest(self, x: Sequence[Real]) -> bool:
        """Whether an equilibrium of the closed loop in the box is not excluded."""
        drift, g, gamma = self.situation.plant.walk(self.rest_tape, x, self.u)
        forces = self.envelope.forces(self._deviation(gamma))
        for i, row in enumerate(drift):
            total = ball(row[0])
            for j, force in enumerate(forces):
                total = total - ball(g[i][j]) * force
            if not total.is_finite() or total.contains(0):
                continue
            return False
        return True

    def regular(self, x: Sequence[Real], centre: NDArray[np.float64]) -> bool:
        """Whether the Jacobian of the rest equations is regular for every selection from the box: one zero at most."""
        matrix = self._slopes(x)
        if matrix is None:
            return False
        n = len(x)
        try:
            guess = np.linalg.inv(centre)
        except np.linalg.LinAlgError:
            return False
        Y = arb_mat([[arb(float(v)) for v in row] for row in guess])
        product = Y * matrix
        return all(
            bool(
                (product[i, i] - 1).abs_upper() + sum((product[i, j].abs_upper() for j in range(n) if j != i), arb(0))
                < 1
            )
            for i in range(n)
        )

    def _slopes(self, x: Sequence[Real]) -> arb_mat | None:
        drift, slope, g, gamma = self.situation.plant.walk(self.slope_tape, x, self.u)
        stiff = self.envelope.stiffness(self._deviation(gamma))
        pull = multiply(multiply(g, [list(row) for row in stiff]), slope)
        rows = [[ball(a) - ball(b) for a, b in zip(p, q, strict=True)] for p, q in zip(drift, pull, strict=True)]
        if not all(entry.is_finite() for row in rows for entry in row):
            return None
        return arb_mat(rows)

    def centre_slope(self) -> NDArray[np.float64] | None:
        """The Jacobian of the rest equations at x*, in double precision."""
        matrix = self._slopes([ball(v) for v in self.situation.point.x])
        if matrix is None:
            return None
        n = matrix.nrows()
        return np.array([[float(matrix[i, j].mid()) for j in range(n)] for i in range(n)])


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
        return _grow(situation, _Landscape(situation), _Budget(boxes, progress))


def _none(why: str) -> Region:
    return Region(Status.UNDECIDED, 0.0, {}, why)


def _grow(situation: Situation, landscape: _Landscape, budget: _Budget) -> Region:
    widths = _half_widths(situation, landscape)
    best = _none("no level set was certified: the Lyapunov function is too flat or the budget too small")
    scale = Fraction(1, 64)
    while budget.left > 0:
        box = _clipped(situation, widths, scale)
        trial = _certify(situation, landscape, box, budget)
        if trial is None and best.status is Status.PROVED:
            break
        if trial is not None:
            if trial.level <= best.level:
                break
            best = trial
        scale *= _RATIO
        if scale > 10**6:
            break
    return best


def _half_widths(situation: Situation, landscape: _Landscape) -> list[Fraction]:
    """Half-widths of the box around the ellipsoid of the Hessian of W at x*."""
    shape = shape_at(situation.plant, situation.point, situation.gamma, situation.compensation is not None)
    series: RealMatrix = [[rational(Fraction(float(v))) for v in row] for row in landscape.envelope.series_at_target()]
    hessian = add(shape.H0, congruence(shape.N, series))
    with precision(BITS):
        inverted = inverse(hessian)
    if inverted is None:
        return [Fraction(1)] * situation.plant.system.n
    return [Fraction(float(np.sqrt(max(approximate(inverted[i][i]), 1e-300)))) for i in range(len(inverted))]


def _clipped(situation: Situation, widths: Sequence[Fraction], scale: Fraction) -> Box:
    box = []
    for name, value, width in zip(situation.plant.system.state_names, situation.point.x, widths, strict=True):
        centre = midpoint(value)
        lo, hi = situation.plant.system.domain.get(name, (None, None))
        low, high = centre - scale * width, centre + scale * width
        box.append((low if lo is None else max(low, lo), high if hi is None else min(high, hi)))
    return tuple(box)


def _certify(situation: Situation, landscape: _Landscape, box: Box, budget: _Budget) -> Region | None:
    """The level set below the boundary of the box, if it is proved to be attracted to x*."""
    faces = [(*box[:k], (end, end), *box[k + 1 :]) for k, bounds in enumerate(box) for end in bounds]
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
    evidence = (
        f"V - V(x*) <= {float(level):.6g} inside the box; {count} boxes on its boundary and {inside} inside, "
        "by branch and bound in ball arithmetic"
    )
    return Region(Status.PROVED, float(level), bounds, evidence, landscape.height)


def _lowest(landscape: _Landscape, face: Box) -> tuple[float, list[Fraction]]:
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


def _split(box: Box, widths: Sequence[Fraction]) -> tuple[Box, Box]:
    k = max(range(len(box)), key=lambda i: (box[i][1] - box[i][0]) / widths[i] if widths[i] else 0)
    lo, hi = box[k]
    middle = (lo + hi) / 2
    return (*box[:k], (lo, middle), *box[k + 1 :]), (*box[:k], (middle, hi), *box[k + 1 :])


def _widths(box: Box) -> list[Fraction]:
    return [hi - lo for lo, hi in box]


def _prove_above(
    landscape: _Landscape, face: Box, level: Fraction, anchor: Sequence[Fraction], budget: _Budget
) -> int | None:
    """The number of boxes that show W > level on the face, or None."""
    waiting, count, widths = [face], 0, _widths(face)
    while waiting:
        part = waiting.pop()
        count += 1
        if not budget.spend():
            return None
        if landscape.exceeds(part, level, anchor):
            continue
        waiting.extend(_split(part, widths))
    return count


def _least_curvature(hessian: RealMatrix, radii: Sequence[Fraction]) -> Fraction:
    """A lower bound of ``d^T H d / 2`` for ``|d_i| <= r_i``, by scaled diagonal dominance."""
    total = Fraction(0)
    for i, row in enumerate(hessian):
        if radii[i] == 0:
            continue
        others = sum((max(abs(lower(v)), abs(upper(v))) * radii[j] for j, v in enumerate(row) if j != i), Fraction(0))
        total += min(Fraction(0), lower(row[i]) * radii[i] - others) * radii[i] / 2
    return total


def _prove_alone(situation: Situation, landscape: _Landscape, box: Box, level: Fraction, budget: _Budget) -> int | None:
    """The number of boxes that show x* to be the only equilibrium with W <= level in the box, or None."""
    centre = landscape.centre_slope()
    if centre is None:
        return None
    x_star = [midpoint(v) for v in situation.point.x]
    core = _core(landscape, box, x_star, centre)
    if core is None:
        return None
    widths = _widths(box)
    waiting, count = [box], 0
    while waiting:
        part = waiting.pop()
        count += 1
        if not budget.spend():
            return None
        if all(c[0] <= p[0] and p[1] <= c[1] for p, c in zip(part, core, strict=True)):
            continue
        x = [enclose(lo, hi) for lo, hi in part]
        if not landscape.can_rest(x) or landscape.exceeds(part, level, [(lo + hi) / 2 for lo, hi in part]):
            continue
        waiting.extend(_split(part, widths))
    return count


def _core(landscape: _Landscape, box: Box, x_star: Sequence[Fraction], centre: NDArray[np.float64]) -> Box | None:
    """A box around x* in which the rest equations have at most one solution."""
    shrink = Fraction(1)
    for _ in range(24):
        core = tuple((c - shrink * (c - lo), c + shrink * (hi - c)) for c, (lo, hi) in zip(x_star, box, strict=True))
        if landscape.regular([enclose(lo, hi) for lo, hi in core], centre):
            return core
        shrink /= 2
    return None
