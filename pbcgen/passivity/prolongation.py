"""Proofs that no gamma exists, from all states where nothing is lost, whether f rests there or not.

Let x_V = 0 be a set on which the loss ``l = -grad S^T f`` vanishes, and psi_i = grad gamma_i. There Z(x) >= 0 asks for

* ``b_i = psi_i^T f - g_i^T grad S = 0``, and ``d b_i = 0`` in every direction d of the kernel of grad^2 l;
* where ``a_ii = psi_i^T g_i = 0`` follows from the other equations: the gradient of a_ii vanishes too, for zero is its
  least value; b_i vanishes to first order in every direction; and ``psi_i^T g_j + psi_j^T g_i = 0`` for every j.

All are linear in the gradients c_i and the symmetric Hessians H_i of gamma_i on the set. Equations without H hold along
the set, so their derivatives along it hold as well: c changes by H. Elimination and derivatives take turns until the
equations contradict each other, or give nothing new.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import casadi as ca

from pbcgen.passivity.plant import Plant
from pbcgen.symbolic.field import Quotient

#: An unknown: (input, entry of c, -1) or (input, row of H, column of H). CONSTANT stands for the rest.
Unknown = tuple[int, int, int]
CONSTANT: Unknown = (-1, -1, -1)
Equation = dict[Unknown, ca.SX]

_ROUNDS = 5
_MOST_UNKNOWNS = 120
_MOST_TERMS = 400


@dataclass(frozen=True)
class Contradiction:
    """A function of the free coordinates that ought to vanish, and divisors that must not for that to follow."""

    value: ca.SX
    divisors: tuple[ca.SX, ...]


@dataclass
class _Stage:
    """The equations so far, and the inputs whose a_ii is known to be zero on the set."""

    plant: Plant
    known: Mapping[str, Fraction]
    free: Sequence[int]
    equations: list[Equation] = field(default_factory=list)
    flat: set[int] = field(default_factory=set)
    divisors: list[ca.SX] = field(default_factory=list)


def slope(i: int, r: int) -> Unknown:
    """The unknown for entry r of c_i."""
    return i, r, -1


def bend(i: int, r: int, s: int) -> Unknown:
    """The unknown for entry (r, s) of H_i, which is symmetric."""
    return i, min(r, s), max(r, s)


def contradiction(
    plant: Plant, zero_states: Sequence[int], free: Sequence[int], kernel: Sequence[ca.SX]
) -> Contradiction | None:
    """What contradicts the existence of gamma, or None.

    Args:
        plant: the system.
        zero_states: coordinates that are zero on the set, where the loss vanishes.
        free: the others.
        kernel: directions, n x 1 functions of the free coordinates, in the kernel of the Hessian of the loss there.

    Raises:
        UnsupportedOperation: for operations that are not analytic.
    """
    system = plant.system
    n, m = system.n, system.m
    if m * (n + n * (n + 1) // 2) > _MOST_UNKNOWNS:
        return None
    known = {system.state_names[k]: Fraction(0) for k in zero_states}
    stage = _Stage(plant, known, free)
    for i in range(m):
        stage.equations.append(_border(plant, i))
        stage.equations += [_border_slope(plant, i, d) for d in kernel]
    rank = 0
    for _ in range(_ROUNDS):
        found = _eliminated(stage)
        if isinstance(found, Contradiction) or found is None:
            return found
        more = [*_of_flat_inputs(stage, found)]
        if len(found) == rank and not more:
            return None
        rank = len(found)
        kept = [{key: plant.expression(value) for key, value in row.items()} for row in found]
        stage.equations = [*kept, *more, *_along_the_set(stage, kept)]
    return None


def _border(plant: Plant, i: int) -> Equation:
    """``b_i = c_i^T f - g_i^T grad S``."""
    system = plant.system
    equation = {slope(i, r): system.f[r] for r in range(system.n)}
    return equation | {CONSTANT: -ca.dot(system.g[:, i], plant.gradient)}


def _border_slope(plant: Plant, i: int, d: ca.SX) -> Equation:
    """``d b_i = c_i^T (df/dx) d + d^T H_i f - d^T grad (g_i^T grad S)``."""
    system = plant.system
    moved = ca.mtimes(ca.jacobian(system.f, system.x), d)
    equation: Equation = {slope(i, r): moved[r] for r in range(system.n)}
    _add_bends(equation, i, d, system.f)
    natural = ca.gradient(ca.dot(system.g[:, i], plant.gradient), system.x)
    return equation | {CONSTANT: -ca.dot(natural, d)}


def _add_bends(equation: Equation, i: int, left: ca.SX, right: ca.SX) -> None:
    """Add ``left^T H_i right``."""
    for r in range(left.numel()):
        for s in range(left.numel()):
            if not (left[r].is_zero() or right[s].is_zero()):
                key = bend(i, r, s)
                equation[key] = equation.get(key, ca.SX(0)) + left[r] * right[s]


def _unit(n: int, k: int) -> ca.SX:
    return ca.SX.eye(n)[:, k]


def _of_flat_inputs(stage: _Stage, rows: Sequence[dict[Unknown, Quotient]]) -> Iterator[Equation]:
    """What follows for inputs with ``a_ii = 0`` on the set."""
    system = stage.plant.system
    n = system.n
    for i in range(system.m):
        g = system.g[:, i]
        if i in stage.flat or not _implied(stage, rows, {slope(i, r): g[r] for r in range(n)}):
            continue
        stage.flat.add(i)
        turned = ca.jacobian(g, system.x)
        for k in range(n):
            least: Equation = {slope(i, r): turned[r, k] for r in range(n)}
            _add_bends(least, i, _unit(n, k), g)
            yield least
            yield _border_slope(stage.plant, i, _unit(n, k))
        for j in range(system.m):
            mixed: Equation = {slope(i, r): system.g[r, j] for r in range(n)}
            for r in range(n):
                mixed[slope(j, r)] = mixed.get(slope(j, r), ca.SX(0)) + g[r]
            yield mixed


def _along_the_set(stage: _Stage, rows: Sequence[Equation]) -> Iterator[Equation]:
    """The derivatives along the free coordinates of the equations that hold no entries of H."""
    x = stage.plant.system.x
    for held in rows:
        if any(key[2] >= 0 for key in held):
            continue
        for k in stage.free:
            moved: Equation = {key: ca.jacobian(value, x[k]) for key, value in held.items()}
            for (i, r, _), value in held.items():
                if i >= 0:
                    key = bend(i, r, k)
                    moved[key] = moved.get(key, ca.SX(0)) + value
            yield moved


def _functions(stage: _Stage, equations: Sequence[Equation]) -> list[dict[Unknown, Quotient]]:
    """Equations on the set, as exact functions without zeros."""
    entries = [(number, key) for number, equation in enumerate(equations) for key in equation]
    column = ca.vertcat(ca.SX(0, 1), *[equations[number][key] for number, key in entries])
    field_, (values,) = stage.plant.exact(column, known=stage.known)
    rows: list[dict[Unknown, Quotient]] = [{} for _ in equations]
    for (number, key), value in zip(entries, values.column(field_.const(0)), strict=True):
        if not value.is_zero():
            rows[number][key] = value
    return rows


def _eliminated(stage: _Stage) -> list[dict[Unknown, Quotient]] | Contradiction | None:
    """The equations in echelon form, entries of H first; or what contradicts; or None when they grow too large."""
    rows = _functions(stage, stage.equations)
    reduced: list[tuple[Unknown, dict[Unknown, Quotient]]] = []
    waiting = [row for row in rows if row]
    while waiting:
        unknowns = {key for row in waiting for key in row if key != CONSTANT}
        if not unknowns:
            return Contradiction(stage.plant.expression(waiting[0][CONSTANT]), tuple(stage.divisors))
        pivot = min(unknowns, key=lambda key: (key[2] < 0, key))
        row = min((r for r in waiting if pivot in r), key=lambda r: _cost(r, pivot))
        head = row[pivot]
        if head.constant() is None:
            stage.divisors.append(stage.plant.expression(head))
        scaled = {key: value / head for key, value in row.items()}
        waiting = [r for r in (_without(r, pivot, scaled) for r in waiting if r is not row) if r]
        if any(len(v.numerator) + len(v.denominator) > _MOST_TERMS for r in waiting for v in r.values()):
            return None
        reduced.append((pivot, scaled))
    result: list[dict[Unknown, Quotient]] = []
    for pivot, row in reversed(reduced):
        clean = row
        for other in result:
            head_key = next(iter(other))
            if head_key in clean and head_key != pivot:
                clean = _without(clean, head_key, other)
        result.append({pivot: clean[pivot]} | {key: v for key, v in clean.items() if key != pivot})
    return result


def _cost(row: Mapping[Unknown, Quotient], pivot: Unknown) -> tuple[bool, int, int]:
    head = row[pivot]
    return head.constant() is None, len(head.numerator) + len(head.denominator), len(row)


def _without(
    row: dict[Unknown, Quotient], pivot: Unknown, scaled: Mapping[Unknown, Quotient]
) -> dict[Unknown, Quotient]:
    """The row without the pivot, by a multiple of a row that has 1 there."""
    factor = row.get(pivot)
    if factor is None:
        return row
    result = dict(row)
    for key, value in scaled.items():
        entry = result[key] - factor * value if key in result else -(factor * value)
        if entry.is_zero():
            result.pop(key, None)
        else:
            result[key] = entry
    return result


def _implied(stage: _Stage, rows: Sequence[dict[Unknown, Quotient]], equation: Equation) -> bool:
    """Whether an equation follows from those in echelon form."""
    if not rows:
        return False
    both = _functions(stage, [equation, *[{key: stage.plant.expression(v) for key, v in row.items()} for row in rows]])
    rest, *given = both
    for row in given:
        head = next(iter(row))
        rest = _without(rest, head, {key: v / row[head] for key, v in row.items()})
    return not rest
