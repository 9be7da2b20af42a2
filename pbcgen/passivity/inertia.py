"""M(q) > 0 on the whole space: by exact elimination, or by the factors of ``M = sum J_i^T W_i J_i``.

With W_i > 0 a vector v with ``v^T M v = 0`` has ``J_i v = 0`` for every i. Rows of the J_i in which one coordinate is
left, with entries that are never zero together, make this coordinate zero; and so on to the last one.
"""

from __future__ import annotations

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.affine import Mechanics
from pbcgen.models.inertia import sum_of_factors
from pbcgen.passivity.construction import same_formulas
from pbcgen.passivity.plant import Plant
from pbcgen.proof.extrema import term_bounds
from pbcgen.proof.nonnegative import definite
from pbcgen.symbolic.field import Quotient


def missing_for_definiteness(plant: Plant) -> str:
    """Why M(q) > 0 fails to be proved for all q; empty when it is proved."""
    mechanics = plant.system.mechanical
    assert mechanics is not None
    if _by_factors(plant, mechanics):
        return ""
    entries = _exact(plant, mechanics.M)
    return "" if entries is not None and definite(entries) else "M(q) > 0 was not proved on the whole space"


def missing_for_growth(plant: Plant) -> str:
    """Why ``p^T M^-1 p / 2 >= c |p|^2`` fails to be proved; empty when it is: M > 0 and bounded."""
    mechanics = plant.system.mechanical
    assert mechanics is not None
    missing = missing_for_definiteness(plant)
    if missing:
        return missing
    entries = _exact(plant, ca.diag(mechanics.M))
    if entries is None or any(term_bounds(row[0], {}).hi is None for row in entries):
        return "M(q) is not bounded"
    return ""


def _exact(plant: Plant, matrix: ca.SX) -> list[list[Quotient]] | None:
    try:
        field, (values,) = plant.exact(matrix)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    return values.dense(field.const(0))


def _by_factors(plant: Plant, mechanics: Mechanics) -> bool:
    """Whether the factors that came with the model give M, and leave no direction without energy."""
    if not mechanics.factors:
        return False
    total = sum_of_factors(mechanics.factors)
    if not same_formulas(plant.system, mechanics.M, total):
        difference = _exact(plant, mechanics.M - total)
        if difference is None or not all(entry.is_zero() for row in difference for entry in row):
            return False
    rows: list[dict[int, ca.SX]] = []
    for J, W in mechanics.factors:
        weight = _exact(plant, W)
        if weight is None or not definite(weight):
            return False
        rows += _rows(J)
    left = set(range(mechanics.q.numel()))
    while left:
        still = next((k for k in sorted(left) if _zero_with_the_rest(plant, rows, left, k)), None)
        if still is None:
            return False
        left.remove(still)
    return True


def _rows(J: ca.SX) -> list[dict[int, ca.SX]]:
    """The entries of each row by column, those that are zero as written left out."""
    rows: list[dict[int, ca.SX]] = [{} for _ in range(J.shape[0])]
    given = ca.sparsify(J)
    for i, j in zip(*given.sparsity().get_triplet(), strict=True):
        rows[i][j] = given[i, j]
    return rows


def _zero_with_the_rest(plant: Plant, rows: list[dict[int, ca.SX]], left: set[int], k: int) -> bool:
    """Whether v_k = 0 follows from ``J v = 0`` where only the coordinates in ``left`` may differ from zero."""
    alone = [row[k] for row in rows if set(row) & left == {k}]
    square = _exact(plant, ca.sumsqr(ca.vertcat(*alone))) if alone else None
    return square is not None and definite(square)
