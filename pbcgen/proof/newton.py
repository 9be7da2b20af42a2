"""Zeros of square systems: floating-point search from many starts, and Krawczyk's test for a certified enclosure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from flint import arb, arb_mat
from numpy.typing import NDArray

from pbcgen.symbolic.real import Real, ball, is_finite, midpoint, rational
from pbcgen.symbolic.real_matrices import RealMatrix, approximate_inverse, as_balls

#: z -> (F(z), F'(z)) over balls.
System = Callable[[list[Real]], tuple[list[Real], RealMatrix]]
FloatSystem = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]


@dataclass(frozen=True)
class Search:
    """Where to look for zeros: a box for random starts, and starts of its own."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    starts: tuple[NDArray[np.float64], ...] = ()
    samples: int = 60
    seed: int = 0


def float_newton(system: FloatSystem, start: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Newton's method with step halving in double precision; None if it does not settle.

    Equations and unknowns are brought to one size by the Jacobian at the start, so that units do not matter.
    """
    z = start.astype(float)
    with np.errstate(all="ignore"):
        value, jacobian = system(z)
        rows, columns = sizes_of(jacobian)
        norm = float(np.linalg.norm(value / rows))
        for _ in range(80):
            # LAPACK may not return from a least-squares problem with entries that are not finite.
            if not (np.isfinite(norm) and np.all(np.isfinite(jacobian))):
                return None
            try:
                scaled = -np.linalg.lstsq(jacobian / rows[:, None] / columns, value / rows, rcond=None)[0]
            except np.linalg.LinAlgError:
                return None
            step, size = scaled / columns, np.linalg.norm(z * columns)
            if np.linalg.norm(scaled) <= 1e-13 * (1e-3 + size):
                return np.asarray(z + step)
            for halving in range(40):
                candidate = z + step * 0.5**halving
                new_value, new_jacobian = system(candidate)
                new_norm = float(np.linalg.norm(new_value / rows))
                if np.isfinite(new_norm) and new_norm < norm * (1 - 1e-4 * 0.5**halving):
                    break
            else:
                settled = np.linalg.norm(scaled) <= 1e-9 * (1e-3 + size)
                return np.asarray(z) if settled else None
            z, value, jacobian, norm = candidate, new_value, new_jacobian, new_norm
            if norm == 0:
                return np.asarray(z)
    return None


def sizes_of(jacobian: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Powers of two that rows and columns are divided by so that the largest entries of each are about one."""

    def power(sizes: NDArray[np.float64]) -> NDArray[np.float64]:
        usable = np.isfinite(sizes) & (sizes > 0)
        return np.asarray(2.0 ** np.round(np.log2(np.where(usable, sizes, 1.0))))

    rows = power(np.max(np.abs(jacobian), axis=1, initial=0.0))
    return rows, power(np.max(np.abs(jacobian) / rows[:, None], axis=0, initial=0.0))


def find_zeros(system: FloatSystem, search: Search) -> list[NDArray[np.float64]]:
    """Distinct floating-point zeros found from the starts, sorted."""
    generator = np.random.default_rng(search.seed)
    size = len(search.lower)
    starts = [*search.starts, np.clip(np.zeros(size), search.lower, search.upper)]
    span = np.minimum(search.upper - search.lower, 20.0)
    bounded = np.isfinite(search.lower) & np.isfinite(search.upper)
    centre = np.where(bounded, (np.where(bounded, search.lower, 0) + np.where(bounded, search.upper, 0)) / 2, 0.0)
    for k in range(search.samples):
        scale = 10.0 ** -(k % 4)
        offset = generator.uniform(-0.5, 0.5, size) * span * scale
        starts.append(np.clip(centre + offset, search.lower, search.upper))
    found: list[NDArray[np.float64]] = []
    for start in starts:
        zero = float_newton(system, start)
        if zero is None or np.any(zero < search.lower - 1e-9) or np.any(zero > search.upper + 1e-9):
            continue
        if all(np.max(np.abs(zero - other) / (1e-6 + np.abs(other))) > 1e-6 for other in found):
            found.append(zero)
    return sorted(found, key=lambda z: np.round(z, 9).tolist())


def _is_moderate(step: arb, start: float) -> bool:
    """Whether a correction of a floating-point zero is small: a large one means that it was none."""
    return bool(step.is_finite() and abs(step) < arb(1 + abs(start)))


def polish(system: System, start: Sequence[float]) -> list[Fraction] | None:
    """Newton's method at the working precision from a floating-point zero; rationals."""
    z = [Fraction(float(v)) for v in start]
    for _ in range(12):
        value, jacobian = system([rational(v) for v in z])
        if not all(is_finite(v) for v in value):
            return None
        try:
            step = as_balls(jacobian).solve(arb_mat([[ball(v)] for v in value]))
        except ZeroDivisionError:
            return None
        if not all(_is_moderate(step[i, 0], a) for i, a in enumerate(start)):
            return None
        try:
            moves = [midpoint(step[i, 0]) for i in range(len(z))]
        except OverflowError:  # a step of exp(-10^7), from a start where the function is as large
            return None
        z = [midpoint(ball(rational(a - b))) for a, b in zip(z, moves, strict=True)]
        if all(abs(b) <= Fraction(1, 10**90) * (1 + abs(a)) for a, b in zip(z, moves, strict=True)):
            break
    return z


def krawczyk(system: System, centre: Sequence[Fraction], radius: Fraction = Fraction(1, 10**70)) -> list[arb] | None:
    """Balls around ``centre`` that contain exactly one zero, or None if the test fails.

    Krawczyk's operator K = m - Y F(m) + (I - Y F'(B)) (B - m) maps the box B of half-width ``radius * (1 + |m|)`` into
    its interior; then B holds one zero and no other (Krawczyk 1969).
    """
    middle = [rational(c) for c in centre]
    half = [rational(radius * (1 + abs(c))) for c in centre]
    box: list[Real] = [arb(m, arb(r)) for m, r in zip(middle, half, strict=True)]
    value, at_middle = system(list(middle))
    _, over_box = system(box)
    if not all(is_finite(v) for v in value) or not all(is_finite(v) for row in over_box for v in row):
        return None
    size = len(middle)
    y = approximate_inverse(at_middle)
    if y is None:
        return None
    defect = arb_mat(size, size, [int(i == j) for i in range(size) for j in range(size)]) - y * as_balls(over_box)
    offset = arb_mat([[ball(b) - m] for b, m in zip(box, middle, strict=True)])
    image = arb_mat([[ball(m)] for m in middle]) - y * arb_mat([[ball(v)] for v in value]) + defect * offset
    balls = [image[i, 0] for i in range(size)]
    inside = all(ball(b).contains_interior(k) for b, k in zip(box, balls, strict=True))
    return balls if inside else None
