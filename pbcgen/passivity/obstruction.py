"""Proofs that no gamma exists for a storage, whatever w and D.

Where f = 0 and the dissipation vanishes to second order in the directions d, Z(x) >= 0 forces, for each input i,

    d^T (df/dx)^T grad gamma_i = d^T grad (g_i^T grad S),   and  g_i^T grad S = 0.

On a set of such equilibria x_V = 0 these linear equations may have no solution, or may determine the gradient of gamma
along the set, which then needs a symmetric Jacobian there; :mod:`pbcgen.passivity.jets` adds second derivatives, and
:mod:`pbcgen.passivity.prolongation` all states where nothing is lost, and all inputs together. All is decided exactly,
and the witness, a state inside the domain, is checked in balls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.construction import WEIGHTS, general_position
from pbcgen.passivity.jets import equations as jet_equations
from pbcgen.passivity.jets import jets_at, multipliers
from pbcgen.passivity.plant import Plant, dot
from pbcgen.passivity.prolongation import contradiction
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Row, kernel
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, is_finite, precision, rational, sign, text
from pbcgen.symbolic.tape import Tape

_LARGEST = 12
_LARGEST_JETS = 8


@dataclass(frozen=True)
class Obstruction:
    """Why no gamma exists.

    Attributes:
        reason: in words and formulas.
        point: where it shows, by state.
        value: the quantity that ought to be zero, there.
        input: the position of the input whose gamma does not exist.
        zero: the states that are zero on the set of equilibria.
        directions: directions d on the set, each with j where ``df/dx d`` is unit vector j, or None if it is zero.
        by_jets: whether second derivatives of gamma are needed to show it; the directions do not then.
        along_losses: whether the point is one where nothing is lost, and f need not rest there.
    """

    reason: str
    point: dict[str, str]
    value: str
    input: int = 0
    zero: tuple[int, ...] = ()
    directions: tuple[tuple[int | None, tuple[Quotient, ...]], ...] = ()
    by_jets: bool = False
    along_losses: bool = False


@dataclass(frozen=True)
class _Set:
    """A set of equilibria: the states that are zero on it, and those that are free."""

    zero: tuple[int, ...]
    free: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class _Equations:
    """``rows psi = right`` for psi = grad gamma_i, one for each direction, valid where these are defined."""

    rows: list[list[Quotient]]
    right: list[Quotient]
    directions: list[list[Quotient]]

    @property
    def finite(self) -> list[Quotient]:
        """What must be defined."""
        return [entry for d in self.directions for entry in d]

    def combined(self, field: Field, weights: list[Quotient]) -> tuple[Quotient, ...]:
        """The direction that belongs to a combination of the equations."""
        return tuple(dot(weights, [d[k] for d in self.directions], field.const(0)) for k in range(len(self.rows[0])))


def obstruction(plant: Plant) -> Obstruction | None:
    """The first proof found, or None."""
    if plant.system.n > _LARGEST:
        return None
    try:
        places = _equilibria(plant)
        for i in range(plant.system.m if places is not None else 0):
            assert places is not None
            found = _for_input(plant, places, i)
            if found is not None:
                return replace(found, input=i, zero=places.zero)
        return _by_prolongation(plant)
    except (UnsupportedOperation, ZeroDivisionError):
        return None


def _equilibria(plant: Plant) -> _Set | None:
    """Coordinates that are zero on a set of equilibria of f, as few as possible; None when x = 0 is none."""
    names = plant.system.state_names

    def rests(zero: list[int]) -> bool:
        try:
            field, (drift,) = plant.exact(plant.system.f, known={names[k]: Fraction(0) for k in zero})
        except (UnsupportedOperation, ZeroDivisionError):
            return False
        return all(entry.is_zero() for entry in drift.column(field.const(0)))

    zero = list(range(plant.system.n))
    if not rests(zero):
        return None
    inside = [_surrounds(plant.system.domain.get(name, (None, None))) for name in names]
    for k in range(plant.system.n):
        fewer = [j for j in zero if j != k]
        if rests(fewer):
            zero = fewer
    if not all(inside[k] for k in zero):
        return None
    return _Set(tuple(zero), tuple(k for k in range(plant.system.n) if k not in zero))


def _surrounds(interval: tuple[Fraction | None, Fraction | None]) -> bool:
    """Whether zero is inside, and not on the edge."""
    lo, hi = interval
    return (lo is None or lo < 0) and (hi is None or hi > 0)


def _for_input(plant: Plant, places: _Set, i: int) -> Obstruction | None:
    """The equations for grad gamma_i on the set, and what contradicts them."""
    system = plant.system
    x, slope = system.x, plant.gradient
    natural = ca.dot(system.g[:, i], slope)
    loss = -ca.dot(slope, system.f)
    known = {system.state_names[k]: Fraction(0) for k in places.zero}
    jacobian = ca.jacobian(system.f, x)
    field, outputs = plant.exact(jacobian, ca.gradient(natural, x), ca.hessian(loss, x)[0], natural, known=known)
    zero = field.const(0)
    J, wanted, hessian = outputs[0].dense(zero), outputs[1].column(zero), outputs[2].dense(zero)
    rest = outputs[3].scalar(zero)
    if not rest.is_zero():
        reason = f"f = 0, so grad gamma^T f = 0, but the natural output for {system.input_names[i]} is not zero"
        return _witness(plant, places, rest, [], reason)
    directions = _kernel(field, hessian)
    rows = [[dot(d, J[j], zero) for j in range(system.n)] for d in directions]
    right = [dot(d, wanted, zero) for d in directions]
    equations = _Equations(rows, right, directions)
    return (
        _contradiction(plant, field, places, equations, i)
        or _curl(plant, field, places, equations, i)
        or _by_jets(plant, places, directions, i)
    )


def _kernel(field: Field, matrix: list[list[Quotient]]) -> list[list[Quotient]]:
    """A basis of the kernel of a square matrix of functions."""
    return kernel([dict(enumerate(row)) for row in matrix], len(matrix), field.const(0), field.const(1))


def _multipliers(
    field: Field, rows: list[list[Quotient]], right: list[Quotient] | None, target: list[Quotient]
) -> list[Quotient] | None:
    """Weights with ``weights^T rows = target`` (and ``weights^T right = 1`` if given), or None."""
    given: list[Row] = [dict(enumerate(row)) for row in rows]
    wanted: Row = dict(enumerate(target))
    if right is not None:
        given = [{**row, CONSTANT: value} for row, value in zip(given, right, strict=True)]
        wanted[CONSTANT] = field.const(1)
    return multipliers(given, wanted, field)


def _contradiction(plant: Plant, field: Field, places: _Set, equations: _Equations, i: int) -> Obstruction | None:
    """A combination of the equations that reads 0 = 1."""
    weights = _multipliers(field, equations.rows, equations.right, [field.const(0)] * plant.system.n)
    if weights is None:
        return None
    name = plant.system.input_names[i]
    reason = f"without dissipation near these equilibria, the equations for grad gamma of {name} contradict each other"
    found = _witness(plant, places, field.const(1), [*weights, *equations.finite], reason)
    return None if found is None else replace(found, directions=((None, equations.combined(field, weights)),))


def _curl(plant: Plant, field: Field, places: _Set, equations: _Equations, i: int) -> Obstruction | None:
    """The gradient of gamma_i along the set, where it is determined, must have a symmetric Jacobian."""
    one, zero = field.const(1), field.const(0)
    slopes: dict[int, tuple[Quotient, list[Quotient]]] = {}
    for j in places.free:
        weights = _multipliers(field, equations.rows, None, [one if k == j else zero for k in range(plant.system.n)])
        if weights is not None:
            slopes[j] = dot(weights, equations.right, zero), weights
    names = plant.system.state_names
    for j, (left, first) in slopes.items():
        for k, (other, second) in slopes.items():
            if j >= k:
                continue
            a, b = plant.expression(left), plant.expression(other)
            skew = ca.jacobian(a, plant.system.x[k]) - ca.jacobian(b, plant.system.x[j])
            reason = (
                f"where f = 0 the gradient of gamma for {plant.system.input_names[i]} is determined, and "
                f"d psi_{names[j]}/d{names[k]} - d psi_{names[k]}/d{names[j]} is not zero"
            )
            found = _witness(plant, places, skew, [*first, *second, *equations.finite], reason)
            if found is not None:
                both = ((j, equations.combined(field, first)), (k, equations.combined(field, second)))
                return replace(found, directions=both)
    return None


def _by_jets(plant: Plant, places: _Set, directions: list[list[Quotient]], i: int) -> Obstruction | None:
    """The first and second derivatives of gamma_i at the equilibria contradict each other."""
    if plant.system.n > _LARGEST_JETS:
        return None
    jets = jets_at(plant, places.zero, places.free, directions, i)
    one, name = jets.field.const(1), plant.system.input_names[i]
    weights = multipliers(jet_equations(jets), {CONSTANT: one}, jets.field)
    if weights is None:
        return None
    reason = f"at these equilibria the first and second derivatives of gamma for {name} contradict each other"
    finite = [entry for d in jets.kernel for entry in d]
    found = _witness(plant, places, one, [*weights, *finite], f"{reason}: it has no symmetric Hessian")
    return None if found is None else replace(found, by_jets=True)


def _by_prolongation(plant: Plant) -> Obstruction | None:
    """All states where nothing is lost, and all inputs together."""
    system = plant.system
    if system.n > _LARGEST_JETS:
        return None
    loss, natural = -ca.dot(plant.gradient, system.f), ca.mtimes(system.g.T, plant.gradient)
    sets = dict.fromkeys([_lossless(plant, loss), _lossless(plant, ca.vertcat(loss, natural))])
    return next((found for places in sets if places and (found := _on_set(plant, loss, places))), None)


def _on_set(plant: Plant, loss: ca.SX, places: _Set) -> Obstruction | None:
    system, x = plant.system, plant.system.x
    known = {system.state_names[k]: Fraction(0) for k in places.zero}
    field, (hessian,) = plant.exact(ca.hessian(loss, x)[0], known=known)
    directions = _kernel(field, hessian.dense(field.const(0)))
    moves = [ca.vertcat(*[plant.expression(entry) for entry in d]) for d in directions]
    found = contradiction(plant, places.zero, places.free, moves)
    if found is None:
        return None
    inverse = [1 / divisor for divisor in found.divisors]
    reason = (
        "along states where nothing is lost, Z(x) >= 0 gives equations for the first and second derivatives of gamma "
        "that contradict each other"
    )
    finite = [*(entry for d in moves for entry in ca.vertsplit(d)), *inverse]
    shown = _witness(plant, places, found.value, finite, reason)
    return None if shown is None else replace(shown, zero=places.zero, by_jets=True, along_losses=True)


def _lossless(plant: Plant, functions: ca.SX) -> _Set | None:
    """Coordinates that are zero on a set where functions vanish, as few as possible; None where that is a point."""
    names, domain = plant.system.state_names, plant.system.domain

    def vanishes(free: list[int]) -> bool:
        known = {name: Fraction(0) for k, name in enumerate(names) if k not in free}
        try:
            field, (values,) = plant.exact(functions, known=known)
        except (UnsupportedOperation, ZeroDivisionError):
            return False
        return all(value.is_zero() for value in values.column(field.const(0)))

    free: list[int] = []
    for k in range(plant.system.n):
        if vanishes([*free, k]):
            free.append(k)
    zero = tuple(k for k in range(plant.system.n) if k not in free)
    if not free or not all(_surrounds(domain.get(names[k], (None, None))) for k in zero):
        return None
    return _Set(zero, tuple(free))


def _witness(
    plant: Plant, places: _Set, value: Quotient | ca.SX, finite: Sequence[Quotient | ca.SX], reason: str
) -> Obstruction | None:
    """A rational point of the set at which ``value`` is certainly not zero and ``finite`` are defined, in balls."""
    system = plant.system
    expressions = [value if isinstance(value, ca.SX) else plant.expression(value)]
    conditions = [w if isinstance(w, ca.SX) else plant.expression(w) for w in finite]
    tape = Tape.of(plant.symbols, [*expressions, ca.vertcat(ca.SX(0, 1), *conditions)])
    parameters = [rational(v) for v in plant.parameter_values]
    for shift in range(len(WEIGHTS)):
        x: list[Real] = [ZERO] * system.n
        for k in places.free:
            x[k] = general_position(system, k, shift)
        with precision(BITS):
            first, second = tape.walk(REAL, [x, [ZERO] * system.m, parameters])
        number = first.scalar(ZERO)
        defined = all(is_finite(entry) for entry in second.column(ZERO)) and is_finite(number)
        if defined and sign(number) in (1, -1):
            point = {name: text(v) for name, v in zip(system.state_names, x, strict=True)}
            return Obstruction(reason, point, text(number, 9))
    return None
