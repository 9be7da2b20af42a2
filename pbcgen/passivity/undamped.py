"""Planes through x* in which the plant moves by itself and the controller sees nothing: x* does not attract.

Let the inputs be those of the law at rest, ``u = u*`` or ``u = u_c(x)``, so that the plant is ``x' = F(x)``, F(x*) = 0.
Let E be an affine plane through x* with

    F(x) in the directions of E,   gamma(x) = gamma*,   grad e(x)^T F(x) = 0   for all x in E,

e = S, less the potential energy under compensation. The controller's filters stay at rest while x is in E, so
every solution of ``x' = F(x)`` in E is one of the closed loop, whatever the gains, and e is constant along it. Where e
is not constant on E near x*, solutions start as near to x* as one likes at another value of e, and do not
converge to x*, for e is continuous.

E is looked for in doubles and given rational coefficients; the three statements are then decided as identities of exact
functions. At x* the directions of E are in the kernels of grad gamma and of the Hessian of the loss, and kept by
dF/dx; of the largest such plane, planes are tried on which an equation that fails has a linear factor, or in which two
states are equal or opposite or one stands still.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import casadi as ca
import numpy as np
from flint import fmpq
from numpy.typing import NDArray

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.equation import affine, essentials
from pbcgen.passivity.plant import Plant, Point
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT
from pbcgen.symbolic.real import BITS, Real, approximate, fraction, precision, sign
from pbcgen.symbolic.real_matrices import quadratic_form
from pbcgen.symbolic.tape import Tape

#: Systems with more states are not searched, and no more than so many planes are looked at.
_MOST_STATES, _MOST_PLANES = 40, 60
#: Relative sizes that count as zero in doubles, and how simple the coefficients are.
_SMALL, _DENOMINATOR = 1e-8, 10**4
#: Longer equations are not factored.
_MOST_FACTORED = 60

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Plane:
    """An affine plane through x*: ``x_p - x_p* = sum_f rows[p][f] (x_f - x_f*)`` over the free states f.

    Attributes:
        free: positions of the states that are free.
        rows: the coefficients of every other state.
    """

    free: tuple[int, ...]
    rows: dict[int, dict[int, Fraction]]

    def solved(self, plant: Plant, star: Sequence[ca.SX | fmpq]) -> dict[int, ca.SX]:
        """The states that are not free as expressions of those that are, given x* in rationals or expressions."""
        centre = [plant.number(fraction(v)) if isinstance(v, fmpq) else v for v in star]
        x = plant.system.x
        return {
            p: centre[p] + sum((plant.number(c) * (x[f] - centre[f]) for f, c in row.items()), ca.SX(0))
            for p, row in self.rows.items()
        }

    def words(self, names: Sequence[str]) -> list[str]:
        """The equations of the plane, for directions from x*."""
        result = []
        for p, row in sorted(self.rows.items()):
            terms = [f"{_factor(c)}d{names[f]}" for f, c in sorted(row.items()) if c]
            result.append(f"d{names[p]} = " + (" + ".join(terms) or "0").replace("+ -", "- "))
        return result


def _factor(c: Fraction) -> str:
    return {1: "", -1: "-"}.get(int(c) if c.denominator == 1 else 0, f"{c}*")


def undamped_plane(plant: Plant, point: Point, still: ca.SX, compensation: ca.SX | None) -> Plane | None:
    """A plane that shows that x* does not attract, or None.

    Args:
        plant: the system.
        point: x* and u*.
        still: what the controller reads: gamma, and eta for natural damping; a column.
        compensation: u_c, m x 1, or None.
    """
    if plant.system.n > _MOST_STATES:
        return None
    work = _Planes(plant, point, still, compensation)
    try:
        return next((plane for plane in work.candidates() if work.serves(plane)), None)
    except (UnsupportedOperation, ZeroDivisionError):
        return None


@dataclass(eq=False)
class _Planes:
    plant: Plant
    point: Point
    still: ca.SX
    compensation: ca.SX | None

    @cached_property
    def star(self) -> list[ca.SX]:
        """x* and u*: numbers where they are rational, else symbols."""
        return [self.plant.number(fraction(v)) if isinstance(v, fmpq) else self.held[k] for k, v in enumerate(self.x)]

    @property
    def x(self) -> tuple[Real, ...]:
        return (*self.point.x, *(() if self.compensation is not None else self.point.u))

    @cached_property
    def held(self) -> dict[int, ca.SX]:
        """Symbols for the values of x* and u* that are not known as rationals."""
        return {k: ca.SX.sym(f"star{k}") for k, v in enumerate(self.x) if not isinstance(v, fmpq)}

    @cached_property
    def drift(self) -> ca.SX:
        """F."""
        system, n = self.plant.system, self.plant.system.n
        u = ca.vertcat(*self.star[n:]) if self.compensation is None else self.compensation
        return ca.densify(system.f + ca.mtimes(system.g, u))

    @cached_property
    def energy(self) -> ca.SX:
        """e."""
        mechanics = self.plant.system.mechanical
        compensated = self.compensation is not None and mechanics is not None
        return self.plant.system.S - mechanics.V if compensated and mechanics is not None else self.plant.system.S

    @cached_property
    def loss(self) -> ca.SX:
        """``-grad e^T F``."""
        return -ca.dot(ca.gradient(self.energy, self.plant.system.x), self.drift)

    # --- what is a candidate, in doubles -----------------------------------------------------------------------------

    def numeric(self, *outputs: ca.SX) -> Callable[[Array], list[Array]]:
        """A function of x in doubles, with x* and u* at theirs."""
        old = ca.vertcat(ca.SX(0, 1), *self.held.values())
        new = ca.SX(ca.DM([approximate(self.x[k]) for k in self.held]))
        function = self.plant.doubles(*[ca.substitute(o, old, new) if self.held else o for o in outputs])
        idle = np.zeros(self.plant.system.m)
        return lambda x: function(x, idle)

    def candidates(self) -> Iterator[Plane]:
        """Planes on which the equations hold at some points, larger ones first."""
        x, n = self.plant.system.x, self.plant.system.n
        centre = np.array([approximate(v) for v in self.point.x])
        linear = self.numeric(ca.jacobian(self.drift, x), ca.jacobian(self.still, x), ca.hessian(self.loss, x)[0])
        A, *seen = linear(centre)
        if not all(np.all(np.isfinite(m)) for m in (A, *seen)):
            return
        equations = self.numeric(self.drift, self.still, self.loss)
        generator = np.random.default_rng(0)
        waiting = [_kept(np.vstack([_unit(m) for m in seen]), A, np.eye(n))]
        known: set[Plane | tuple[object, ...]] = set()
        while waiting and len(known) < _MOST_PLANES:
            basis = waiting.pop(0)
            plane = _rational(basis)
            if plane is None or (key := (plane.free, str(plane.rows))) in known:
                continue
            known.add(key)
            samples = [centre + basis @ z for z in generator.uniform(-0.5, 0.5, (3, basis.shape[1]))]
            if all(_holds(basis, equations(centre), equations(sample)) for sample in samples):
                yield plane
            elif basis.shape[1] > 1:
                smaller = [_kept(row[None, :], A, basis) for row in self._restrictions(plane)]
                waiting += [b for b in smaller if 0 < b.shape[1] < basis.shape[1]]
                waiting.sort(key=lambda b: -b.shape[1])

    def _restrictions(self, plane: Plane) -> Iterator[Array]:
        """Linear functions of ``x - x*`` that may vanish on a smaller plane that serves."""
        n = self.plant.system.n
        try:
            values = self.equations(plane)
        except (UnsupportedOperation, ZeroDivisionError):
            values = []
        for value in values:
            if len(value.numerator) > _MOST_FACTORED:
                continue
            for factor in essentials(value):
                row = affine(factor, n)
                if row is not None and row.keys() - {CONSTANT}:
                    yield np.array([float(fraction(row[k])) if k in row else 0.0 for k in range(n)])
        for i in range(n):
            yield np.eye(n)[i]
            for j in range(i):
                for side in (1, -1):
                    yield np.eye(n)[i] + side * np.eye(n)[j]

    # --- the proof ---------------------------------------------------------------------------------------------------

    def equations(self, plane: Plane) -> list[Quotient]:
        """What must vanish on the plane, as exact functions of the free states."""
        plant, n = self.plant, self.plant.system.n
        x, solved = plant.system.x, plane.solved(plant, self.star)
        across = [self._across(p, row) for p, row in plane.rows.items()]
        at_star = ca.vertcat(*self.star[:n])
        kept = ca.vertcat(ca.SX(0, 1), *across, self.still)
        column = ca.vertcat(kept - ca.substitute(kept, x, at_star), self.loss)
        if solved:
            column = ca.substitute(column, ca.vertcat(*[x[p] for p in solved]), ca.vertcat(*solved.values()))
        held = ca.vertcat(ca.SX(0, 1), *self.held.values())
        tape = Tape.of([x, held, plant.parameter_symbols], [ca.densify(column)])
        names = [*plant.system.state_names, *(str(s) for s in self.held.values()), *plant.parameter_names]
        field, (values,) = evaluate(tape, names, plant.values, plant.reads_signs(tape))
        return [v for v in values.column(field.const(0)) if not v.is_zero()]

    def _across(self, p: int, row: Mapping[int, Fraction]) -> ca.SX:
        """What takes F out of the directions of the plane."""
        return self.drift[p] - sum((self.plant.number(c) * self.drift[f] for f, c in row.items()), ca.SX(0))

    def serves(self, plane: Plane) -> bool:
        """Whether the three equations hold on the plane, and e is not constant there near x*."""
        if not plane.free or self.equations(plane):
            return False
        (hessian,) = self.plant.at(self.point, ca.hessian(self.energy, self.plant.system.x)[0])
        with precision(BITS):
            return any(sign(quadratic_form(hessian, self._direction(plane, f))) in (1, -1) for f in plane.free)

    def _direction(self, plane: Plane, f: int) -> list[Fraction]:
        """The direction of the plane in which state f moves by one, and no other free state."""
        along = {f: Fraction(1)} | {p: row[f] for p, row in plane.rows.items() if f in row}
        return [along.get(k, Fraction(0)) for k in range(self.plant.system.n)]


# --- subspaces in doubles --------------------------------------------------------------------------------------------


def _unit(matrix: Array) -> Array:
    """The rows that are not zero, scaled to length one."""
    sizes = np.linalg.norm(matrix, axis=1)
    keep = sizes > _SMALL * max(1.0, float(np.max(sizes, initial=0.0)))
    scaled: Array = matrix[keep] / sizes[keep, None]
    return scaled


def _kernel(matrix: Array) -> Array:
    """An orthonormal basis of the kernel, as columns."""
    if not matrix.shape[0]:
        return np.eye(matrix.shape[1])
    _, values, right = np.linalg.svd(matrix)
    rank = int(np.sum(values > _SMALL * max(1.0, float(np.max(values, initial=0.0)))))
    kernel: Array = right[rank:].T
    return kernel


def _kept(rows: Array, A: Array, basis: Array) -> Array:
    """A basis of the largest subspace of span(basis) in the kernel of the rows that A keeps."""
    basis = basis @ _kernel(rows @ basis)
    scale = float(np.linalg.norm(A)) or 1.0
    while basis.shape[1]:
        moved = A @ basis / scale
        inside = _kernel(moved - basis @ (basis.T @ moved))
        if inside.shape[1] == basis.shape[1]:
            break
        basis = basis @ inside
    return basis


def _rational(basis: Array) -> Plane | None:
    """The plane with this basis by an echelon form with simple coefficients; None if these do not fit."""
    work, free = basis.T.copy(), []  # rows span the directions; the free states are the pivots
    for i in range(len(work)):
        k = int(np.argmax(np.max(np.abs(work[i:]), axis=0)))
        largest = i + int(np.argmax(np.abs(work[i:, k])))
        if abs(work[largest, k]) <= _SMALL:
            return None
        work[[i, largest]] = work[[largest, i]]
        work[i] /= work[i, k]
        for j in range(len(work)):
            if j != i:
                work[j] -= work[j, k] * work[i]
        free.append(k)
    rows: dict[int, dict[int, Fraction]] = {}
    for p in range(basis.shape[0]):
        if p in free:
            continue
        simple = {f: Fraction(float(work[i, p])).limit_denominator(_DENOMINATOR) for i, f in enumerate(free)}
        if any(abs(float(c) - work[i, p]) > _SMALL for i, c in enumerate(simple.values())):
            return None
        rows[p] = {f: c for f, c in simple.items() if c}
    return Plane(tuple(sorted(free)), rows)


def _holds(basis: Array, at_star: Sequence[Array], at_sample: Sequence[Array]) -> bool:
    """Whether the equations hold at a point of the plane, up to rounding."""
    moved, still, loss = (b - a for a, b in zip(at_star, at_sample, strict=True))
    across = moved - basis @ (basis.T @ moved)
    size = 1.0 + float(np.max(np.abs(moved), initial=0.0))
    values = [np.max(np.abs(v), initial=0.0) for v in (across, still, loss)]
    return bool(np.all(np.isfinite(values)) and max(values) <= _SMALL * size * size)
