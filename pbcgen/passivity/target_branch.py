"""Unknowns of the equilibrium that no formula gives: a polynomial of the target and a few Newton steps.

With the equations F(p, z) = 0 left of the elimination, the running controller computes z(p) from a polynomial z_0(p),
fitted to samples of the solution, by a constant number of steps ``z <- z - F_z^{-1} F``. Over a ball of targets the
solution is enclosed by Krawczyk's test, and the steps are shown to reach it: with ``abs(z_0 - z) <= e`` and balls that
hold everything within e of z, one step leaves at most ``abs(F_z^{-1}) abs(F_zz) e e / 2``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from typing import Final

import casadi as ca
import numpy as np
from flint import arb
from numpy.typing import NDArray

from pbcgen.passivity.plant import Plant
from pbcgen.proof.boxes import halves, lengths, longest_side
from pbcgen.proof.newton import float_newton, krawczyk, polish
from pbcgen.symbolic.doubles import Doubles
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, ball, enclose, is_finite, midpoint, precision, rational, reals
from pbcgen.symbolic.real_matrices import RealMatrix, as_balls
from pbcgen.symbolic.tape import Tape

#: More unknowns than these are not solved for together.
LARGEST: Final = 3
#: Degree of the polynomial, and samples of each setting, by the number of settings.
_DEGREES: Final = {1: 6, 2: 4, 3: 3}
_SAMPLES: Final = {1: 25, 2: 9, 3: 6}
_MOST_SETTINGS: Final = 4
#: Steps of the path from the declared target to a sample.
_PATH: Final = 8
#: Newton steps at most, and what they may leave, relative to the largest value in the box.
_STEPS: Final = 8
_LEFT: Final = 2.0**-48

#: Cells that the proof of the steps may take, and steps that are added to shorten it.
_CELLS: Final = 400
_MORE: Final = 3

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Enclosed:
    """z and dz/dp over a ball of targets."""

    z: tuple[Real, ...]
    rates: RealMatrix


@dataclass(frozen=True, eq=False)
class Branch:
    """A solution of equations in a box of targets.

    Attributes:
        p, z: symbols of the settings and of the unknowns.
        equations: F(p, z), a column of as many entries as z.
        start: z_0(p). steps: Newton steps from there. degree: of the polynomial.
        scale: the largest absolute value of each unknown among the samples.
    """

    plant: Plant
    p: ca.SX
    z: ca.SX
    equations: ca.SX
    start: ca.SX
    steps: int
    degree: int
    scale: tuple[float, ...]

    def __post_init__(self) -> None:
        F_z = ca.jacobian(self.equations, self.z)
        parts = [self.equations, F_z, ca.jacobian(self.equations, self.p), ca.jacobian(ca.vec(F_z), self.z)]
        parameters = self.plant.parameter_symbols
        object.__setattr__(self, "_tape", Tape.of([self.p, self.z, parameters], [ca.densify(e) for e in parts]))
        starts = [self.start, ca.jacobian(self.start, self.p)]
        object.__setattr__(self, "_starts", Tape.of([self.p], [ca.densify(e) for e in starts]))
        object.__setattr__(self, "_system", _float_system(self.plant, self.p, self.z, self.equations))

    @property
    def formula(self) -> ca.SX:
        """z after the last step, in p and the parameters."""
        z = self.start
        F_z = ca.jacobian(self.equations, self.z)
        step = self.equations / F_z if self.z.numel() == 1 else ca.mtimes(ca.inv_minor(F_z), self.equations)
        for _ in range(self.steps):
            z = z - ca.substitute(step, self.z, z)
        return z

    def enclose(self, values: Sequence[Real]) -> Enclosed | None:
        """z over a ball of targets of the box, or None where that is not proved to be one solution.

        It is the solution that the steps reach: at the middle of the ball they do, and beside it both are continuous.
        """
        with precision(BITS):
            try:
                middle: list[Real] = [rational(midpoint(v)) for v in values]
                here, over = self._solution(middle, middle), self._solution(values, middle)
                if here is None or over is None or not self._reached(middle, middle, here):
                    return None
                return over
            except (ValueError, ZeroDivisionError, np.linalg.LinAlgError):
                return None

    def holds(self, box: Sequence[tuple[Fraction, Fraction]]) -> bool:
        """Whether the steps reach the solution for every target of a box: on cells, halved where they do not.

        Neighbours share the solution at their border: there the steps end so near to both that these are one.
        """
        waiting, whole = [tuple(box)], lengths(tuple(box))
        with precision(BITS):
            for _ in range(_CELLS):
                if not waiting:
                    return True
                cell = waiting.pop()
                if not self._passes(cell):
                    waiting += halves(cell, longest_side(cell, whole))
        return False

    def _passes(self, cell: Sequence[tuple[Fraction, Fraction]]) -> bool:
        middle: list[Real] = [rational((lo + hi) / 2) for lo, hi in cell]
        values: list[Real] = [enclose(lo, hi) for lo, hi in cell]
        try:
            over = self._solution(values, middle)
            return over is not None and self._reached(values, middle, over)
        except (ValueError, ZeroDivisionError, np.linalg.LinAlgError):
            return False

    def _solution(self, values: Sequence[Real], middle: Sequence[Real]) -> Enclosed | None:
        """Krawczyk's test for all targets at once, around the solution in the middle that the polynomial is near."""
        (start, _) = self._starts.walk(REAL, [list(middle)])  # type: ignore[attr-defined]
        first = np.array([float(ball(row[0]).mid()) for row in start.dense(ZERO)])
        numbers = np.array([float(midpoint(v)) for v in middle])
        found = float_newton(lambda z: self._system(numbers, z), first)  # type: ignore[attr-defined]
        centre = None if found is None else polish(lambda z: self._values(middle, z)[:2], list(found))
        over = None if centre is None else self._over(values, centre)
        if over is None:
            return None
        _, F_z, F_p, _ = self._values(values, list(over))
        return Enclosed(tuple(over), (-(as_balls(F_z).inv() * as_balls(F_p))).tolist())

    def _reached(self, values: Sequence[Real], middle: Sequence[Real], over: Enclosed) -> bool:
        """Whether the steps come to the solution from where the polynomial is, for all targets of a ball."""
        here = self._solution(middle, middle)
        if here is None:
            return False
        (start, _), (_, turn) = (self._starts.walk(REAL, [list(p)]) for p in (middle, values))  # type: ignore[attr-defined]
        apart = as_balls(turn.dense(ZERO)) - as_balls(over.rates)
        widths = [abs(ball(v) - ball(m)).upper() for v, m in zip(values, middle, strict=True)]
        floor = [4 * arb(_LEFT) * arb(scale) for scale in self.scale]  # a neighbour's solution is nearer than this
        error = [
            (abs(ball(s[0]) - z) + sum((abs(apart[i, k]) * w for k, w in enumerate(widths)), floor[i])).abs_upper()
            for i, (s, z) in enumerate(zip(start.dense(ZERO), here.z, strict=True))
        ]
        return self._steps_reach(values, over.z, error)

    def _values(self, p: Sequence[Real], z: Sequence[Real]) -> tuple[list[Real], RealMatrix, RealMatrix, RealMatrix]:
        """F, F_z, F_p and the rows of F_zz."""
        parameters = reals(self.plant.parameter_values)
        F, F_z, F_p, F_zz = self._tape.walk(REAL, [list(p), list(z), parameters])  # type: ignore[attr-defined]
        return [row[0] for row in F.dense(ZERO)], F_z.dense(ZERO), F_p.dense(ZERO), F_zz.dense(ZERO)

    def _over(self, values: Sequence[Real], centre: Sequence[Fraction]) -> list[arb] | None:
        """Balls of the solution over all targets, as wide as it moves."""
        at: list[Real] = [rational(c) for c in centre]
        F, F_z, _, _ = self._values(values, at)
        moved = as_balls(F_z).inv() * as_balls([[v] for v in F])
        reach = max(
            (float(abs(moved[i, 0]).abs_upper()) / (1 + abs(float(c))) for i, c in enumerate(centre)), default=0.0
        )
        for factor in (2, 4):
            radius = Fraction(factor * reach) + Fraction(1, 10**40)
            found = krawczyk(lambda z: self._values(values, z)[:2], centre, radius)
            if found is not None:
                return found
        return None

    def _steps_reach(self, values: Sequence[Real], over: Sequence[Real], error: Sequence[arb]) -> bool:
        """Whether the steps from everywhere within ``error`` of the solution come to it."""
        k = range(len(over))
        near: list[Real] = [ball(z) + arb(0, e) for z, e in zip(over, error, strict=True)]
        _, F_z, _, F_zz = self._values(values, near)
        if not all(is_finite(v) for row in (*F_z, *F_zz) for v in row):
            return False
        inverse, own = as_balls(F_z).inv(), list(error)
        for _ in range(self.steps):
            bent = [
                sum((abs(ball(F_zz[j * len(over) + i][m])) * own[j] * own[m] for j in k for m in k), arb(0)) for i in k
            ]
            following = [(sum((abs(inverse[i, j]) * bent[j] for j in k), arb(0)) / 2).abs_upper() for i in k]
            if not all(b <= a for a, b in zip(own, following, strict=True)):
                return False
            own = following
        return all(bool(e <= arb(_LEFT) * arb(s)) for e, s in zip(own, self.scale, strict=True))


def find_branch(
    plant: Plant,
    p: ca.SX,
    z: ca.SX,
    equations: ca.SX,
    box: Sequence[tuple[Fraction, Fraction]],
    declared: tuple[Sequence[float], Sequence[float]],
) -> Branch | str:
    """The branch through the declared (p, z) over a box of p; else why it was not found."""
    settings = len(box)
    if settings > _MOST_SETTINGS:
        return f"more than {_MOST_SETTINGS} adjustable conditions"
    lo, hi = (np.array([float(b[end]) for b in box]) for end in (0, 1))
    system = _float_system(plant, p, z, equations)
    count = _SAMPLES.get(settings, 4)
    nodes = np.cos(np.pi * np.arange(count) / (count - 1))
    samples = [np.array(s) for s in product(nodes, repeat=settings)]
    values = []
    for s in samples:
        found = _followed(system, declared, (lo + hi) / 2 + s * (hi - lo) / 2)
        if found is None:
            return "its solution could not be followed over the box"
        values.append(found)
    degree = _DEGREES.get(settings, 2)
    exponents = [e for e in product(range(degree + 1), repeat=settings) if sum(e) <= degree]
    powers = np.array([[np.prod(s**e) for e in exponents] for s in samples])
    fitted = _short(np.linalg.lstsq(powers, np.array(values), rcond=None)[0])
    steps = _needed(system, samples, (lo, hi), powers @ fitted, np.array(values))
    if steps is None:
        return f"{_STEPS} Newton steps do not reach its solution everywhere in the box"
    scaled = [(s - float(a + b) / 2) * float(2 / (b - a)) for s, (a, b) in zip(ca.vertsplit(p), box, strict=True)]
    start = [_polynomial(dict(zip(exponents, column, strict=True)), scaled) for column in fitted.T]
    scale = tuple(float(v) for v in np.abs(values).max(axis=0))
    for more in range(_MORE):
        branch = Branch(plant, p, z, equations, ca.vertcat(*start), steps + more, degree, scale)
        if branch.holds(box):
            return branch
    return f"that {steps + _MORE - 1} Newton steps reach its solution everywhere in the box was not proved"


def _float_system(plant: Plant, p: ca.SX, z: ca.SX, equations: ca.SX) -> _FloatSystem:
    numbers = ca.DM([float(v) for v in plant.parameter_values])
    symbols = plant.parameter_symbols
    F = ca.substitute(equations, symbols, numbers) if symbols.numel() else equations
    return _FloatSystem(Doubles([p, z], [F, ca.jacobian(F, z)]))


@dataclass(frozen=True, eq=False)
class _FloatSystem:
    """F and F_z in double precision."""

    function: Doubles

    def __call__(self, p: Array, z: Array) -> tuple[Array, Array]:
        F, F_z = self.function(p, z)
        return F[:, 0], F_z


def _followed(system: _FloatSystem, declared: tuple[Sequence[float], Sequence[float]], end: Array) -> Array | None:
    """The solution at ``end`` on the straight path from the declared target."""
    begin, z = (np.array(v, dtype=float) for v in declared)
    for k in range(1, _PATH + 1):
        at = begin + (end - begin) * k / _PATH
        found = float_newton(lambda z, at=at: system(at, z), z)  # type: ignore[misc]
        if found is None:
            return None
        z = found
    return z


def _needed(
    system: _FloatSystem, samples: Sequence[Array], box: tuple[Array, Array], start: Array, truth: Array
) -> int | None:
    """Newton steps that leave nothing at the samples, and one more."""
    lo, hi = box
    scale = np.abs(truth).max(axis=0)
    if not np.all(scale > 0):
        return None
    z = start.copy()
    for step in range(_STEPS):
        if np.all(np.abs(z - truth) <= 1e-8 * scale):
            return step + 1
        for row, s in enumerate(samples):
            F, F_z = system((lo + hi) / 2 + s * (hi - lo) / 2, z[row])
            if not np.all(np.isfinite(F_z)) or abs(np.linalg.det(F_z)) == 0:
                return None
            z[row] -= np.linalg.solve(F_z, F)
    return None


def _short(fitted: Array) -> Array:
    """Coefficients in six digits: so many are the same on every machine, and the steps make up for the rest."""
    least = 1e-7 * np.abs(fitted).max(axis=0)
    rows = [
        [float(f"{c:.6g}") if abs(c) > small else 0.0 for c, small in zip(row, least, strict=True)] for row in fitted
    ]
    return np.array(rows)


def _polynomial(coefficients: Mapping[tuple[int, ...], float], variables: Sequence[ca.SX]) -> ca.SX:
    """Horner's scheme, variable by variable."""
    if not variables:
        return ca.SX(float(coefficients.get((), 0.0)))
    result = ca.SX(0)
    for power in range(max((e[0] for e in coefficients), default=0), -1, -1):
        inner = {e[1:]: c for e, c in coefficients.items() if e[0] == power}
        result = result * variables[0] + _polynomial(inner, variables[1:])
    return result
