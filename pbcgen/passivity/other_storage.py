"""Storages that a system has beside the given one, for hints: ``grad S = B f`` with a constant matrix B.

If ``sym B <= 0`` then ``S' <= y^T u`` with ``gamma = -B g``, integrated (form "A" of `PowerStructure`);
nothing is lost at rest, so that every equilibrium can be held. S exists iff the Jacobian of B f is symmetric, gamma iff
those of B g are: linear equations in B. Among the solutions one is sought that makes S convex at x*, and whose gamma
needs the measured states alone. Thermal, RC and RL networks, connected tanks and motors have one. Solutions are
proposed in doubles; that B is negative semidefinite and that S has a minimum at x* is then decided exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.integrate import potential
from pbcgen.passivity.plant import Plant, Point
from pbcgen.proof.claim import Status
from pbcgen.proof.cutting_planes import boundary, interior
from pbcgen.proof.definite import positive_definite, positive_semidefinite
from pbcgen.symbolic.coefficients import Coefficients, common_denominator
from pbcgen.symbolic.display import formula
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import Row, kernel
from pbcgen.symbolic.real import rational
from pbcgen.symbolic.real_matrices import RealMatrix, add, as_floats, multiply, transpose, weighted_sum

#: Systems with more states, or more unknowns that are left, are not searched.
_MOST_STATES, _MOST_FREE = 8, 40
#: How the weights of a solution are rounded.
_DENOMINATORS = (1, 2, 4, 10, 100, 1000, 10**6)
#: Longer formulas are not shown.
_LONGEST = 240

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class OtherStorage:
    """A storage and its gamma as text with the parameters' names."""

    S: str
    gamma: tuple[str, ...]

    def __str__(self) -> str:
        return f"S = {self.S}, whose gamma is {', '.join(self.gamma)}"


def other_storage(plant: Plant, point: Point, readable: bool = False) -> OtherStorage | None:
    """A storage with which x* can be held; gamma in measured states if there is one, else in any if that will do."""
    system = plant.system
    if system.n > _MOST_STATES or system.mechanical is not None:
        return None
    hidden = [k for k, name in enumerate(system.state_names) if name not in system.measured]
    try:
        for unread in [hidden] if readable or not hidden else [hidden, []]:
            for diagonal in (True, False):
                work = _Search.of(plant, point, unread, diagonal)
                found = None if work is None else work.storage()
                if found is not None:
                    return found
    except (UnsupportedOperation, ZeroDivisionError):
        pass
    return None


@dataclass(frozen=True, eq=False)
class _Search:
    """Matrices that B is a combination of, as expressions of the parameters and at their values, and df/dx at x*."""

    plant: Plant
    point: Point
    basis: list[ca.SX]
    values: list[RealMatrix]
    slope: RealMatrix
    inputs: RealMatrix

    @staticmethod
    def of(plant: Plant, point: Point, unread: Sequence[int], diagonal: bool) -> _Search | None:
        """None where the equations leave no B, or too many."""
        vectors = _solutions(plant, unread, diagonal)
        if not 0 < len(vectors) <= _MOST_FREE:
            return None
        n = plant.system.n
        basis = []
        for vector in vectors:
            matrix = ca.SX(n, n)
            for k, v in enumerate(vector):
                if not v.is_zero():
                    matrix[k // n, k % n] = plant.expression(v)
            basis.append(matrix)
        field, exact = plant.exact(*basis)
        numbers = [[[entry.constant() for entry in row] for row in m.dense(field.const(0))] for m in exact]
        if any(v is None for m in numbers for row in m for v in row):
            return None
        slope, inputs = plant.at(point, ca.densify(ca.jacobian(plant.system.xdot, plant.system.x)), plant.system.g)
        return _Search(plant, point, basis, numbers, slope, inputs)

    def storage(self) -> OtherStorage | None:
        """The first combination that is certainly good and has a formula."""
        for weights in self._proposals():
            if not self._serves(weights):
                continue
            total = sum((self.plant.number(w) * m for w, m in zip(weights, self.basis, strict=True)), ca.SX(0))
            system = self.plant.system
            S = potential(self.plant, ca.mtimes(total, system.f))
            parts = [S, *(potential(self.plant, -ca.mtimes(total, system.g[:, j])) for j in range(system.m))]
            functions = [part for part in parts if part is not None]
            if len(functions) < len(parts):
                return None
            field, (values,) = self.plant.exact(ca.vertcat(*functions), symbolic=True, known=self.plant.numbers)
            shown = [formula(v, self.plant.parameter_positions()) for v in values.column(field.const(0))]
            return OtherStorage(shown[0], tuple(shown[1:])) if sum(map(len, shown)) <= _LONGEST else None
        return None

    def _serves(self, weights: Sequence[Fraction]) -> bool:
        """``sym B <= 0``, and ``hess S_d > 0`` at x* for alpha beta large enough."""
        B = weighted_sum([rational(w) for w in weights], self.values)
        loss = [[-v for v in row] for row in add(B, transpose(B))]
        if positive_semidefinite(loss).status is not Status.PROVED:
            return False
        N = multiply(B, self.inputs)  # grad gamma, but for its sign
        if any(all(v == 0 for v in column) for column in transpose(N)):
            return False
        bent, drawn = multiply(B, self.slope), multiply(N, transpose(N))
        doubled = add(add(bent, transpose(bent)), add(drawn, drawn))
        return positive_definite(doubled).status is Status.PROVED

    def _proposals(self) -> Iterator[list[Fraction]]:
        """Weights in simple fractions, from the optimum of a semidefinite programme (Kelley's cutting planes)."""
        slope = as_floats(self.slope)
        matrices = [as_floats(m) for m in self.values]
        losses = [-(m + m.T) / 2 for m in matrices]
        bends = [(m @ slope + (m @ slope).T) / 2 for m in matrices]
        scales = [max(float(np.max(np.abs(np.stack(part)))), 1e-300) for part in (losses, bends)]
        for margin in (True, False):
            families = [np.stack(losses) / scales[0], np.stack(bends) / scales[1]]
            t = interior(families) if margin else boundary(families)
            if t is None or not np.max(np.abs(t)) > 0:
                continue
            t = t / np.max(np.abs(t))
            for denominator in _DENOMINATORS:
                weights = [Fraction(float(v)).limit_denominator(denominator) for v in t]
                if any(weights):
                    yield weights


def _solutions(plant: Plant, unread: Sequence[int], diagonal: bool) -> list[list[Quotient]]:
    """A basis of the B, row by row, with symmetric Jacobians of B f and of B g, and zeros of B g where unread."""
    system = plant.system
    n = system.n
    jacobians = [ca.jacobian(v, system.x) for v in (system.f, *ca.horzsplit(system.g))]
    field, (g, *slopes) = plant.exact(system.g, *jacobians, symbolic=True)
    zero = field.const(0)
    coefficients = Coefficients(field, plant.parameter_positions())

    def split(matrix: list[list[Quotient]]) -> list[list[dict[tuple[int, ...], Quotient] | None]] | None:
        common = common_denominator(field, [v for row in matrix for v in row])
        parts = [[coefficients.split(entry * common) for entry in row] for row in matrix]
        return None if any(p is None for row in parts for p in row) else parts

    one = field.const(1)
    rows: dict[object, Row] = {k: {k: one} for k in range(n * n) if diagonal and k // n != k % n}

    def ask(place: object, unknown: int, parts: dict[tuple[int, ...], Quotient] | None, side: int) -> None:
        for monomial, value in (parts or {}).items():
            row = rows.setdefault((place, monomial), {})
            row[unknown] = row.get(unknown, zero) + (value if side > 0 else -value)

    for number, matrix in enumerate(slopes):
        parts = split(matrix.dense(zero))
        if parts is None:
            return []
        for i in range(n):
            for j in range(i + 1, n):
                for k in range(n):
                    ask((number, i, j), i * n + k, parts[k][j], 1)
                    ask((number, i, j), j * n + k, parts[k][i], -1)
    inputs = split(g.dense(zero))
    if inputs is None:
        return []
    for i in unread:
        for j in range(system.m):
            for k in range(n):
                ask(("unread", i, j), i * n + k, inputs[k][j], 1)
    return kernel(rows.values(), n * n, zero, one)
