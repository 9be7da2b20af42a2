"""M(q) > 0 on the whole space: by exact elimination, or by the factors of ``M = sum J_i^T W_i J_i``.

With W_i > 0 a vector v with ``v^T M v = 0`` has ``J_i v = 0`` for every i. Rows of the J_i in which one coordinate is
left, with entries that are never zero together, make this coordinate zero; and so on to the last one.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from functools import lru_cache

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.affine import Mechanics
from pbcgen.models.factors import sum_of_factors
from pbcgen.passivity.construction import same_formulas
from pbcgen.passivity.plant import Plant
from pbcgen.proof.elimination import definite
from pbcgen.proof.extrema import term_bounds
from pbcgen.proof.nonnegative import Everywhere, Prover
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.tape import OPERATIONS, Matrix, Tape

#: CasADi's operation codes by the tape's names.
_CODES = {name: code for code, (name, _) in reversed(list(OPERATIONS.items()))}


@lru_cache(maxsize=2)
def missing_for_definiteness(plant: Plant) -> str:
    """Why M(q) > 0 fails to be proved for all q; empty when it is proved."""
    mechanics = plant.system.mechanical
    assert mechanics is not None
    if _by_factors(plant, mechanics):
        return ""
    entries = _exact(plant, mechanics.M)
    return "" if entries is not None and definite(entries) else "M(q) > 0 was not proved on the whole space"


def is_definite_on(plant: Plant, prover: Prover) -> bool:
    """Whether M(q) > 0 is proved wherever it is defined in the prover's region."""
    if not missing_for_definiteness(plant):
        return True
    assert plant.system.mechanical is not None
    entries = None if isinstance(prover, Everywhere) else _exact(plant, plant.system.mechanical.M)
    return entries is not None and definite(entries, prover=prover)


def missing_for_growth(plant: Plant) -> str:
    """Why ``p^T M^-1 p / 2 >= c |p|^2`` fails to be proved; empty when it is: M > 0 and bounded."""
    mechanics = plant.system.mechanical
    assert mechanics is not None
    if _by_factors(plant, mechanics) and _bounded(plant, mechanics):
        return ""
    missing = missing_for_definiteness(plant)
    if missing:
        return missing
    entries = _exact(plant, ca.diag(mechanics.M))
    if entries is None or any(term_bounds(row[0], {}).hi is None for row in entries):
        return "M(q) is not bounded"
    return ""


def _bounded(plant: Plant, mechanics: Mechanics) -> bool:
    """Whether every entry of the factors and of their weights is bounded."""
    matrices = [matrix for pair in mechanics.factors for matrix in pair]
    for entry in ca.vertsplit(ca.vertcat(*[ca.vec(ca.densify(matrix)) for matrix in matrices])):
        values = _exact(plant, entry, free_angles=True)
        if values is None:
            return False
        bounds = term_bounds(values[0][0], {})
        if bounds.lo is None or bounds.hi is None:
            return False
    return True


def _exact(plant: Plant, matrix: ca.SX, free_angles: bool = False) -> list[list[Quotient]] | None:
    """The entries as exact functions, None if they cannot be; with ``free_angles`` every angle is a variable."""
    try:
        if free_angles:
            field, (values,) = _with_free_angles(plant, matrix)
        else:
            field, (values,) = plant.exact(matrix)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    return values.dense(field.const(0))


def _with_free_angles(plant: Plant, matrix: ca.SX) -> tuple[Field, list[Matrix[Quotient]]]:
    """The matrix with a variable in place of each argument of sin and cos.

    What holds for all values of these holds for the angles too, and sums of many angles need not be expanded.
    """
    graph = _Graph(plant)
    inputs = [ca.vertsplit(column) if column.numel() else [] for column in plant.symbols]
    (rebuilt,) = plant.tape(matrix).walk(graph, inputs)
    entries = ca.SX(*rebuilt.shape)
    for (i, j), value in rebuilt.entries.items():
        entries[i, j] = value
    angles = ca.vertcat(*graph.angles.values())
    tape = Tape.of([*plant.symbols, angles], [entries])
    names = [*plant.names, *(f"angle {k}" for k in range(angles.numel()))]
    return evaluate(tape, names, plant.values)


class _Graph:
    """The tape's operations on SX, with symbols for the arguments of sin and cos."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.angles: dict[int, ca.SX] = {}
        self._arguments: list[ca.SX] = []  # kept, so that their identities stay theirs

    def const(self, value: Fraction) -> ca.SX:
        return self.plant.number(value)

    def _angle(self, a: ca.SX) -> ca.SX:
        self._arguments.append(a)
        return self.angles.setdefault(a.element_hash(), ca.SX.sym(f"angle{len(self.angles)}"))

    def sin(self, a: ca.SX) -> ca.SX:
        return ca.sin(self._angle(a))

    def cos(self, a: ca.SX) -> ca.SX:
        return ca.cos(self._angle(a))

    def __getattr__(self, name: str) -> Callable[..., ca.SX]:
        code = _CODES.get(name)
        if code is None:
            raise UnsupportedOperation(f"the operation `{name}` is not followed")
        return lambda *operands: ca.SX.unary(code, *operands) if len(operands) == 1 else ca.SX.binary(code, *operands)


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
    square = _exact(plant, ca.sumsqr(ca.vertcat(*alone)), free_angles=True) if alone else None
    return square is not None and definite(square)
