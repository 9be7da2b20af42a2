"""Linear matrix inequalities ``sum t_k M_k >= 0`` in doubles, by linear programmes with cutting planes (Kelley 1960).

For a few dozen unknowns; what is found is a proposal, to be rounded and checked exactly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

Array = NDArray[np.float64]

#: A matrix inequality that is violated by less holds.
_SMALL = 1e-7


def interior(families: Sequence[Array], loose: Sequence[Array] = (), rounds: int = 150) -> Array | None:
    """t in [-1, 1]^d with ``sum t_k M_k >= s I`` for each family, and ``>= 0`` for loose ones, with s large; or None.

    Args:
        families: d symmetric matrices each, d x k x k.
        loose: families that may touch zero.
        rounds: how many programmes may be solved.
    """
    goal = np.append(np.zeros(len(families[0])), -1.0)
    found = _solve(goal, [*((f, 1.0) for f in families), *((f, 0.0) for f in loose)], rounds)
    return None if found is None or found[1] < _SMALL else found[0]


def boundary(families: Sequence[Array], rounds: int = 150) -> Array | None:
    """t in [-1, 1]^d with ``sum t_k M_k >= 0`` for each family and traces that are large, or None."""
    traces = np.sum([np.trace(family, axis1=1, axis2=2) for family in families], axis=0)
    found = _solve(np.append(-traces, 0.0), [(f, 0.0) for f in families], rounds)
    return None if found is None else found[0]


def _solve(goal: Array, families: Sequence[tuple[Array, float]], rounds: int) -> tuple[Array, float] | None:
    """(t, s): the families with 1.0 are at least s I / 2, those with 0.0 at least zero, nearly."""
    if not all(np.isfinite(family).all() for family, _ in families):
        return None  # slopes at x* that do not exist
    rows: list[Array] = []
    bounds = [(-1.0, 1.0)] * (len(goal) - 1) + [(0.0, 1.0)]
    for _ in range(rounds):
        cuts = np.array(rows) if rows else None
        solution = linprog(goal, cuts, None if cuts is None else np.zeros(len(rows)), bounds=bounds, method="highs")
        if solution.x is None:
            return None
        t, s = np.asarray(solution.x[:-1]), float(solution.x[-1])
        if goal[-1] and s < _SMALL:
            return None
        fits = True
        for family, share in families:
            values, vectors = np.linalg.eigh(np.tensordot(t, family, 1))
            for value, v in zip(values, vectors.T, strict=True):
                if value < share * s - _SMALL:
                    rows.append(np.append(-np.einsum("i,kij,j->k", v, family, v), share))
                    fits &= share > 0 and value > s / 2
        if fits:
            return t, s
    return None
