"""Proofs that no gamma exists, from the Taylor polynomials of Z(x) >= 0 at equilibria of f.

With psi_i = grad gamma_i, the border b_i = psi_i^T f - g_i^T grad S of the matrix obeys ``b_i^2 <= 4 l a_i`` with the
loss l = -grad S^T f and a_i = psi_i^T g_i >= 0. At an equilibrium x0 of f, where l and its gradient vanish, that makes
some derivatives of b_i zero. They are linear in c_i = psi_i(x0) and in the symmetric H_i = grad^2 gamma_i(x0):

* ``d b_i = 0`` for d in the kernel of grad^2 l, and its derivative along a set of equilibria;
* ``d d b_i = 0`` on a subspace of coordinates where l vanishes identically, and f may point out of it;
* where the equations found so far force ``a_i(x0) = 0``, a least value: the gradient of a_i vanishes too, b_i vanishes
  to first order in every direction, and to second order in the kernel of grad^2 l.

If the equations for (c_i, H_i) contradict each other, then no twice differentiable gamma gives a passive output.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations_with_replacement

import casadi as ca

from pbcgen.passivity.plant import Plant, dot
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows

Vector = list[Quotient]
Square = list[Vector]


def slope_name(r: int) -> tuple[int, int]:
    """The unknown for entry r of c."""
    return r, -1


def bend_name(r: int, s: int) -> tuple[int, int]:
    """The unknown for entry (r, s) of H, which is symmetric."""
    return min(r, s), max(r, s)


@dataclass(frozen=True, eq=False)
class Jets:
    """Derivatives at x0 of what Z is made of, for input i, as functions of the coordinates that x0 may have.

    Attributes:
        field: of the functions.
        A: Jacobian of f.
        f2: Hessian of each entry of f.
        y1, y2: gradient and Hessian of g_i^T grad S.
        g, g1: g_i and its Jacobian.
        kernel: a basis of the kernel of grad^2 l, and how it changes along each free coordinate.
        free: coordinates along which x0 may move.
        lossless: coordinates on whose span through x0 the loss vanishes identically.
    """

    field: Field
    A: Square
    f2: list[Square]
    y1: Vector
    y2: Square
    g: Vector
    g1: Square
    kernel: list[Vector]
    kernel1: list[list[Vector]]
    free: tuple[int, ...]
    lossless: tuple[int, ...]

    @property
    def size(self) -> int:
        """The number of states."""
        return len(self.A)


def equations(jets: Jets) -> list[Row]:
    """Every equation for (c, H) that Z >= 0 forces at x0, each ``row = 0``."""
    rows = [*_first(jets, jets.kernel), *_along(jets)]
    units = [_unit(jets, k) for k in jets.lossless]
    rows += [_second(jets, d, e) for d, e in combinations_with_replacement(units, 2)]
    height = _corner(jets)
    if not forces_zero(rows, height, jets.field):
        return rows
    rows.append(height)
    rows += [_corner_slope(jets, k) for k in range(jets.size)]
    rows += _first(jets, [_unit(jets, k) for k in range(jets.size)])
    rows += [_second(jets, d, e) for d, e in combinations_with_replacement(jets.kernel, 2)]
    return rows


def _unit(jets: Jets, k: int) -> Vector:
    zero, one = jets.field.const(0), jets.field.const(1)
    return [one if j == k else zero for j in range(jets.size)]


class _Sum:
    """A row that is being added up."""

    def __init__(self) -> None:
        self.row: Row = {}

    def add(self, key: object, *factors: Quotient) -> None:
        if any(factor.is_zero() for factor in factors):
            return
        value = factors[0]
        for factor in factors[1:]:
            value = value * factor
        name = key if isinstance(key, tuple) else CONSTANT
        self.row[name] = self.row[name] + value if name in self.row else value


def _times(matrix: Square, vector: Vector, zero: Quotient) -> Vector:
    return [dot(row, vector, zero) for row in matrix]


def _first(jets: Jets, directions: Sequence[Vector]) -> Iterator[Row]:
    """``d b = c^T A d - y1^T d = 0``."""
    zero = jets.field.const(0)
    for d in directions:
        total = _Sum()
        for r, value in enumerate(_times(jets.A, d, zero)):
            total.add(slope_name(r), value)
        total.add(CONSTANT, -dot(jets.y1, d, zero))
        yield total.row


def _along(jets: Jets) -> Iterator[Row]:
    """The derivative of ``d b = 0`` along the free coordinate k, for d in the kernel: d itself may change with k."""
    for k, changes in zip(jets.free, jets.kernel1, strict=True):
        for d, change in zip(jets.kernel, changes, strict=True):
            total = _Sum()
            total.row |= _second(jets, d, _unit(jets, k))
            for row in _first(jets, [change]):
                for key, value in row.items():
                    total.add(key, value)
            yield total.row


def _second(jets: Jets, d: Vector, e: Vector) -> Row:
    """``d e b = c^T f''(d, e) + (H d)^T A e + (H e)^T A d - d^T y2 e = 0``."""
    zero = jets.field.const(0)
    total = _Sum()
    for r in range(jets.size):
        total.add(slope_name(r), dot(d, _times(jets.f2[r], e, zero), zero))
    for one, other in ((d, _times(jets.A, e, zero)), (e, _times(jets.A, d, zero))):
        for r in range(jets.size):
            for s in range(jets.size):
                total.add(bend_name(r, s), one[r], other[s])
    total.add(CONSTANT, -dot(d, _times(jets.y2, e, zero), zero))
    return total.row


def _corner(jets: Jets) -> Row:
    """``a(x0) = c^T g``."""
    total = _Sum()
    for r, value in enumerate(jets.g):
        total.add(slope_name(r), value)
    return total.row


def _corner_slope(jets: Jets, k: int) -> Row:
    """Entry k of ``grad a = H g + (dg/dx)^T c``."""
    total = _Sum()
    for r in range(jets.size):
        total.add(slope_name(r), jets.g1[r][k])
        total.add(bend_name(r, k), jets.g[r])
    return total.row


def multipliers(rows: Sequence[Row], target: Row, field: Field) -> list[Quotient] | None:
    """Weights with ``sum weight * row = target``, constants included, or None."""
    transposed: dict[object, Row] = {}
    for number, row in enumerate(rows):
        for key, value in row.items():
            transposed.setdefault(key, {})[number] = value
    for key, value in target.items():
        transposed.setdefault(key, {})[CONSTANT] = -value
    try:
        solution = particular_solution(reduce_rows(transposed.values()), field.const(0))
    except Inconsistent:
        return None
    return [solution.get(number, field.const(0)) for number in range(len(rows))]


def forces_zero(rows: Sequence[Row], target: Row, field: Field) -> bool:
    """Whether the rows force the target to be zero; also true of a target that is zero anyway."""
    return not target or multipliers(rows, target, field) is not None


def jets_at(plant: Plant, zero_states: Sequence[int], free: tuple[int, ...], kernel: list[Vector], i: int) -> Jets:
    """The derivatives for input i at the equilibria whose other coordinates are zero.

    Args:
        plant: the system.
        zero_states: coordinates that are zero there.
        free: the others.
        kernel: a basis of the kernel of the Hessian of the loss, as functions of the free coordinates.
        i: the input.
    """
    system, x = plant.system, plant.system.x
    n = system.n
    natural = ca.dot(system.g[:, i], plant.gradient)
    basis = ca.horzcat(*[ca.vertcat(*[plant.expression(entry) for entry in d]) for d in kernel])
    changes = [ca.reshape(ca.jacobian(ca.vec(basis), x[k]), n, len(kernel)) for k in free] if kernel else []
    stacked = ca.vertcat(*[ca.hessian(system.f[r], x)[0] for r in range(n)])
    known = {system.state_names[k]: Fraction(0) for k in zero_states}
    field, found = plant.exact(
        ca.jacobian(system.f, x),
        stacked,
        ca.gradient(natural, x),
        ca.hessian(natural, x)[0],
        system.g[:, i],
        ca.jacobian(system.g[:, i], x),
        ca.sparsify(basis) if kernel else ca.SX(n, 0),
        *changes,
        known=known,
    )
    zero = field.const(0)
    dense = [matrix.dense(zero) for matrix in found]
    vectors = [[list(column) for column in zip(*matrix, strict=True)] for matrix in dense[6:]]
    return Jets(
        field,
        dense[0],
        [dense[1][r * n : (r + 1) * n] for r in range(n)],
        [row[0] for row in dense[2]],
        dense[3],
        [row[0] for row in dense[4]],
        dense[5],
        vectors[0] if kernel else [],
        vectors[1:] if kernel else [[] for _ in free],
        free,
        _lossless(plant, free),
    )


def _lossless(plant: Plant, free: tuple[int, ...]) -> tuple[int, ...]:
    """As many coordinates as go beside the free ones so that the loss vanishes where all others are zero."""
    system = plant.system
    loss = -ca.dot(plant.gradient, system.f)

    def vanishes(chosen: Sequence[int]) -> bool:
        known = {name: Fraction(0) for k, name in enumerate(system.state_names) if k not in chosen}
        field, (value,) = plant.exact(loss, known=known)
        return value.scalar(field.const(0)).is_zero()

    chosen = list(free)
    if not vanishes(chosen):
        return ()
    for k in range(system.n):
        if k not in chosen and vanishes([*chosen, k]):
            chosen.append(k)
    return tuple(chosen)
