"""Kernels of singular matrices in doubles, recognised as spanned by vectors of simple numbers."""

from __future__ import annotations

from fractions import Fraction
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]


def complement(gram: Floats) -> list[list[Fraction]] | None:
    """Rational rows that span the orthogonal complement of the kernel, or None when there is no clear kernel."""
    size = len(gram)
    diagonal = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    diagonal = np.where(diagonal < 1e-6 * diagonal.max(), diagonal.max(), diagonal)
    values, vectors = np.linalg.eigh(gram / np.outer(diagonal, diagonal))
    small = values < 1e-5 * max(values.max(), 1e-12)
    if not small.any():
        return None
    if small.all():
        return []
    kernel = (vectors[:, small] / diagonal[:, None]).T
    echelon, pivots = _echelon(kernel)
    free = [k for k in range(size) if k not in pivots]
    rows = []
    for k in free:
        row = [Fraction(0)] * size
        row[k] = Fraction(1)
        for r, pivot in enumerate(pivots):
            simple = Fraction(float(echelon[r, k])).limit_denominator(2000)
            if abs(float(simple) - echelon[r, k]) > 1e-3 * (1 + abs(echelon[r, k])):
                return None
            row[pivot] = -simple
        rows.append(row)
    return rows


def _echelon(matrix: Floats) -> tuple[Floats, list[int]]:
    """Reduced row echelon form with full pivoting, and the pivot columns."""
    work = matrix.astype(float).copy()
    pivots: list[int] = []
    for r in range(len(work)):
        remaining = np.abs(work[r:]).copy()
        remaining[:, pivots] = 0
        at, column = np.unravel_index(int(np.argmax(remaining)), remaining.shape)
        work[[r, r + int(at)]] = work[[r + int(at), r]]
        work[r] /= work[r, column]
        for other in range(len(work)):
            if other != r:
                work[other] -= work[other, column] * work[r]
        pivots.append(int(column))
    return work, pivots
