"""Dense scans along lines, and local descents from the lowest states."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbcgen.proof.seeker import Points, Seeker, distinct, some_states, spread

#: Relative distance of the points of a dense scan.
_DENSITY = 5e-5
_DECADES = (-3.0, 3.0)
#: Descents from the lowest states, and from those that probes, samples and scans remembered.
_STARTS = 24
_REMEMBERED = 48
_CLEARLY_NEGATIVE = -1e-9


def _grid(lo: float, hi: float, density: float) -> Points:
    """Positions in [lo, hi] that are ``density`` apart, relatively to their distance from zero or to the width."""
    decades = _DECADES[1] - _DECADES[0]
    magnitudes = 10.0 ** np.arange(_DECADES[0], _DECADES[1], density / np.log(10))
    both = np.concatenate([-magnitudes[::-1], [0.0], magnitudes])
    if np.isfinite(lo) and np.isfinite(hi):
        even = np.linspace(lo, hi, int(decades / density / 4))
        both = np.concatenate([even, both * max(abs(lo), abs(hi)) * 10.0 ** -_DECADES[1]])
    return np.unique(both[(both >= lo) & (both <= hi)])


def scan_coordinates(seeker: Seeker, generator: np.random.Generator) -> None:
    """Dense scans along each coordinate through a few states."""
    bases = some_states(seeker, generator, 4)
    count = len(bases) * len(seeker.active)
    wanted = 2 * (_DECADES[1] - _DECADES[0]) * np.log(10) / _DENSITY
    density = _DENSITY * max(1.0, wanted / seeker.affordable(0.6 / count))
    grids = {k: _grid(seeker.lower[k], seeker.upper[k], density) for k in seeker.active}
    for base in bases:
        for k in seeker.active:
            direction = np.zeros(seeker.n)
            direction[k] = 1.0
            origin = base.copy()
            origin[k] = 0.0
            _scan(seeker, origin, direction, grids[k])


def scan_lines(seeker: Seeker, generator: np.random.Generator) -> None:
    """Scans along lines through pairs of the lowest states and random ones."""
    low = [np.array(where) for _, where in distinct(seeker.best, 6)]
    others = list(spread(seeker.lower, seeker.upper, 6, generator))
    pairs = [(a, b) for i, a in enumerate(low) for b in [*low[:i], *others[:2]]][:16]
    steps = min(8000, seeker.affordable(0.15 / max(1, len(pairs))))
    for a, b in pairs:
        _scan(seeker, a, b - a, np.linspace(-1.0, 2.0, steps))


def _scan(seeker: Seeker, origin: Points, direction: Points, grid: Points) -> None:
    """Evaluate along a line and look closer where the values dip."""
    if len(grid) < 3:
        return
    values = seeker.offer(origin + grid[:, None] * direction, 6)
    finite = np.where(np.isfinite(values), values, np.nanmax(np.where(np.isfinite(values), values, -np.inf)))
    if not np.all(np.isfinite(finite)):
        return
    with np.errstate(all="ignore"):
        bend = np.nan_to_num(finite[:-2] + finite[2:] - 2 * finite[1:-1])
    dips = np.flatnonzero((finite[1:-1] < finite[:-2]) & (finite[1:-1] <= finite[2:]))
    sharpest = dips[np.argsort(-bend[dips], kind="stable")[:6]]
    lowest = dips[np.argsort(finite[1:-1][dips], kind="stable")[:4]]
    for k in sorted({*sharpest.tolist(), *lowest.tolist()}):
        lo, hi = grid[k], grid[k + 2]
        for _ in range(4):
            fine = np.linspace(lo, hi, 41)
            j = int(np.argmin(seeker.offer(origin + fine[:, None] * direction, 2)))
            lo, hi = fine[max(j - 1, 0)], fine[min(j + 1, 40)]
        seeker.starts.append(origin + fine[j] * direction)


def descend(seeker: Seeker, generator: np.random.Generator) -> None:
    """Local optimisation of h/scale from the lowest states, in variables scaled by the start."""
    from scipy.optimize import minimize

    lowest = [np.array(where) for _, where in distinct(seeker.best, _STARTS)]
    chosen = generator.permutation(len(seeker.starts))[:_REMEMBERED]
    for start in [*lowest, *(seeker.starts[k] for k in chosen)]:
        size = np.where(start != 0, np.abs(start), 1e-2)

        def objective(z: Points, size: Points = size) -> tuple[float, Points]:
            value, gradient = seeker.slope(z * size)
            seeker.evaluations += 1
            flat = gradient.ravel() * size
            result = float(value[0, 0])
            return (result, flat) if np.isfinite(result) and np.all(np.isfinite(flat)) else (1e300, np.zeros_like(z))

        limits: Any = list(zip(seeker.lower / size, seeker.upper / size, strict=True))
        with np.errstate(all="ignore"):
            result = minimize(
                objective, start / size, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 60}
            )
        if seeker.offer((result.x * size)[None, :])[0] < _CLEARLY_NEGATIVE:
            return
