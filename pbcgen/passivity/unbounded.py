"""Radial unboundedness of the closed-loop storage, in exact arithmetic.

The terms in ln cosh grow like alpha_i |gamma_i|, and minimising over x_c takes only a constant from that. So with
affine gamma the storage is radially unbounded if S is a positive semidefinite quadratic form plus bounded terms, and on
the kernel of that form ``sum alpha_i |gamma_i'v| > |(kappa^T gamma' + c) v|`` for the linear part c of S. Beside a
definite form there may be terms that grow linearly. Circuits have ``S = w^T Xi w / 2`` with w = grad P and gamma linear
in w; there it suffices that x -> w has a continuous inverse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
from flint import fmpq

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.coordinates import proper
from pbcgen.passivity.inertia import missing_for_definiteness, missing_for_growth
from pbcgen.passivity.plant import Plant
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_semidefinite
from pbcgen.proof.elimination import definite
from pbcgen.proof.extrema import term_bounds
from pbcgen.proof.known import BOUNDED_KINDS
from pbcgen.proof.nonnegative import nonnegative
from pbcgen.proof.sos import sum_of_squares
from pbcgen.symbolic.coefficients import cleared
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, kernel, particular_solution, reduce_rows
from pbcgen.symbolic.real import ZERO, Real, fraction, rational, sign
from pbcgen.symbolic.real_matrices import SparseRow
from pbcgen.symbolic.terms import terms

#: Forms are sought for functions of at most so many states, with these factors and constants.
_MOST_OUTGROWN = 16
_MARGINS = tuple((Fraction(1, 10**k), Fraction(10) ** (k + 1)) for k in (0, 1, 2, 4))
#: What stands for any constant: it is as large as one likes.
_HUGE = 10**9
#: Semidefinite programming is used for functions of at most so many states and atoms.
_MOST_IN_PROGRAMME = 4


@dataclass(frozen=True)
class Growth:
    """Whether the storage is radially unbounded, and why (not)."""

    proved: bool
    reason: str


def radially_unbounded(
    plant: Plant, gamma: ca.SX, alpha: Sequence[Fraction], kappa: Sequence[Real], compensated: bool
) -> Growth:
    """Decide for ``S + Phi + kappa^T gamma`` (kinetic energy + Phi under potential compensation)."""
    try:
        if plant.system.circuit is not None and _circuit(plant, gamma):
            return Growth(True, "S is a positive definite form of grad P, and x -> grad P has a continuous inverse")
        return _by_terms(plant, gamma, alpha, kappa, compensated)
    except (UnsupportedOperation, ZeroDivisionError) as reason:
        return Growth(False, str(reason))


def _circuit(plant: Plant, gamma: ca.SX) -> bool:
    """Whether x is bounded where w = grad P is.

    gamma must be ``-g_tilde^T Xi w``, which no quadratic form of w is outgrown by.
    """
    return depends_on_currents(plant, gamma) and proper(plant, *currents(plant))


def depends_on_currents(plant: Plant, gamma: ca.SX) -> bool:
    """Whether ``S = w^T Xi w / 2`` and ``gamma = -g_tilde^T Xi w + constant`` with w = grad P and constant Xi > 0."""
    circuit = plant.system.circuit
    if circuit is None or ca.depends_on(circuit.Xi, plant.system.x) or ca.depends_on(circuit.g_tilde, plant.system.x):
        return False
    other = gamma + ca.mtimes(circuit.g_tilde.T, ca.mtimes(circuit.Xi, circuit.P_gradient))
    field, (weight, difference) = plant.exact(circuit.Xi, other)
    zero = field.const(0)
    return definite(weight.rows()) and all(entry.constant() is not None for entry in difference.column(zero))


def currents(plant: Plant) -> tuple[ca.SX, list[ca.SX], list[int]]:
    """w = grad P, its variables, and signs with which its Jacobian is definite where every branch has a resistance."""
    circuit, system = plant.system.circuit, plant.system
    assert circuit is not None
    inductors = circuit.currents
    return circuit.P_gradient, ca.vertsplit(system.x), [1] * inductors + [-1] * (system.n - inductors)


@dataclass(frozen=True, eq=False)
class _Energy:
    """What has to grow: a function of some of the states, while what is left of S bounds the other states.

    Attributes:
        value: the function, for which only ln cosh terms and ``kappa^T gamma`` come on top.
        variables: positions of the states that it depends on.
        missing: why the other states may not be bounded where S and these states are; empty if they are.
    """

    value: ca.SX
    variables: list[int]
    missing: str


def _energy(plant: Plant, gamma: ca.SX, compensated: bool) -> _Energy:
    """S; for a mechanical system the potential energy, because M(q) > 0 bounds p where S and q are bounded."""
    system, mechanics = plant.system, plant.system.mechanical
    if mechanics is None:
        return _Energy(system.S, list(range(system.n)), "")
    missing = missing_for_growth(plant) if ca.depends_on(gamma, mechanics.p) else missing_for_definiteness(plant)
    return _Energy(ca.SX(0) if compensated else mechanics.V, list(range(system.n // 2)), missing)


def _by_terms(
    plant: Plant, gamma: ca.SX, alpha: Sequence[Fraction], kappa: Sequence[Real], compensated: bool
) -> Growth:
    """S outgrows a semidefinite form; on its kernel, the ln cosh terms must outgrow the rest."""
    energy = _energy(plant, gamma, compensated)
    if energy.missing:
        return Growth(False, energy.missing)
    field, (value, slope) = plant.exact(energy.value, ca.jacobian(gamma, plant.system.x))
    zero = field.const(0)
    force = [ZERO] * len(kappa) if compensated else list(kappa)
    rows = [[entry.constant() for entry in row] for row in slope.dense(zero)]
    affine = [None not in row for row in rows]
    weak = [i for i, a in enumerate(affine) if not a and sign(rational(alpha[i]) - abs(force[i])) not in (0, 1)]
    if weak:
        i = weak[0] + 1
        return Growth(
            False, f"gamma_{i} is not affine, and alpha_{i} is less than |kappa_{i}|: its growth is not known"
        )
    function, variables = value.scalar(zero), energy.variables
    found = _quadratic(function, variables, plant.system.n)
    if isinstance(found, str):
        found = _outgrown(plant, function, variables) or found
    if isinstance(found, str):
        return Growth(False, found)
    form, linear = found
    gammas = [
        [row[k] or fmpq(0) for k in variables] if a else [fmpq(0)] * len(variables)
        for row, a in zip(rows, affine, strict=True)
    ]
    grown = _on_kernel(form, linear, gammas, alpha, force)
    if grown.proved or all(affine):
        return grown
    room = [a - abs(k) for a, k in zip(map(rational, alpha), force, strict=True)]
    outgrowing = [g for g, left in zip(gammas, room, strict=True) if sign(left) not in (0, 1)]
    if any(_dot(g, v) != 0 for g in outgrowing for v in _kernel(form)):
        return grown
    return _in_coordinates(plant, gamma, (form, linear), energy, room)


def _in_coordinates(
    plant: Plant, gamma: ca.SX, split: tuple[list[SparseRow], list[fmpq]], energy: _Energy, room: Sequence[Real]
) -> Growth:
    """With nonlinear gamma: what the form and the ln cosh terms with alpha > |kappa| bound must bound all states."""
    form, linear = split
    x = plant.system.x
    solved = reduce_rows(form)
    rows = [[row.get(k, fmpq(0)) if k != p else fmpq(1) for k in range(len(linear))] for p, row in solved.items()]
    if any(_dot(linear, v) != 0 for v in _kernel(form)):
        return Growth(False, "the linear part of S is not outgrown, and gamma is not affine")
    states = [x[k] for k in energy.variables]
    forms = [sum((plant.number(fraction(c)) * s for c, s in zip(row, states, strict=True)), ca.SX(0)) for row in rows]
    outgrown = [gamma[i] for i, left in enumerate(room) if sign(left) == 1]
    functions = ca.vertcat(ca.SX(0, 1), *forms, *outgrown)
    others = [k for k in range(plant.system.n) if k not in energy.variables]
    if functions.numel() and not ca.depends_on(functions, x[others]) and proper(plant, functions, states):
        return Growth(
            True, "S outgrows a quadratic form and ln cosh outgrows kappa^T gamma in coordinates that fix the state"
        )
    return Growth(False, "there are directions in which neither S nor gamma is known to grow")


def _quadratic(value: Quotient, variables: Sequence[int], states: int) -> tuple[list[SparseRow], list[fmpq]] | str:
    """The semidefinite form and the linear part of S, whose other terms are outgrown by the form or nonnegative."""
    split = _split(value, variables, states)
    if split is None:
        return "S is not a quadratic form plus terms of less growth"
    form, linear, small = split
    if not small and _kernel(form):
        return "S has terms beside its quadratic form that grow, and the form is not definite"
    if positive_semidefinite(form).status is not Status.PROVED:
        return "the quadratic part of S is not positive semidefinite"
    return form, linear


def _outgrown(plant: Plant, value: Quotient, variables: Sequence[int]) -> tuple[list[SparseRow], list[fmpq]] | None:
    """A semidefinite form that S, without its linear part, outgrows: ``S + constant >= form``.

    The form has as its kernel the directions in which S, its linear and bounded terms set apart, does not change at
    all. Where that is too much, the squares of single combinations are tried, and those that are outgrown added up.
    """
    if len(variables) > _MOST_OUTGROWN:
        return None
    field, size = value.field, len(variables)
    position = {k: i for i, k in enumerate(variables)}
    linear, rest = [fmpq(0)] * size, field.const(0)
    whole = value
    if value.is_polynomial():
        kept = {}
        for exponents, c in value.numerator.to_dict().items():
            used = [k for k, e in enumerate(exponents) for _ in range(int(e))]
            if len(used) == 1 and used[0] in position:
                linear[position[used[0]]] += c
            elif term_bounds(field.polynomial(field.context.from_dict({exponents: c})), {}).hi is None:
                kept[exponents] = c
        whole = field.polynomial(field.context.from_dict(kept)) + rest
    rows = _changing(plant, whole, variables)
    if rows is None:
        return None
    squares = [_square(field, row, variables) for row in rows]
    form = _sum_of_squares(rows, size)
    if squares and _above(whole, sum(squares, field.const(0))):
        return form, linear
    single = [row for row, square in zip(rows, squares, strict=True) if _above(whole, square)]
    return (_sum_of_squares(single, size), linear) if single else None


def _sum_of_squares(rows: Sequence[Sequence[fmpq]], size: int) -> list[SparseRow]:
    """The form ``sum (row x)^2``."""
    return [{j: sum((r[i] * r[j] for r in rows), fmpq(0)) for j in range(size)} for i in range(size)]


def _changing(plant: Plant, value: Quotient, variables: Sequence[int]) -> list[list[fmpq]] | None:
    """Linear functions that fix S: a basis of the rows v with ``v^T d = 0`` wherever S does not change along d."""
    slopes = ca.gradient(plant.expression(value), plant.system.x[list(variables)])
    field, (gradient,) = plant.exact(slopes)
    entries = gradient.column(field.const(0))
    rows: dict[object, Row] = {}
    for k, entry in enumerate(cleared(field, entries)):
        for exponents, c in entry.to_dict().items():
            rows.setdefault(tuple(exponents), {})[k] = c
    solved = reduce_rows(rows.values())
    return [[fmpq(1) if k == p else row.get(k, fmpq(0)) for k in range(len(entries))] for p, row in solved.items()]


def _square(field: Field, row: Sequence[fmpq], variables: Sequence[int]) -> Quotient:
    """``(sum row_k x_k)^2``."""
    total = field.const(0)
    for c, k in zip(row, variables, strict=True):
        total = total + field.symbol(k) * field.const(fraction(c))
    return total * total


def _above(value: Quotient, square: Quotient) -> bool:
    """Whether ``value + C - c square >= 0`` is proved for some positive constants; only c is tried."""
    field = value.field
    helped = _with_lower_powers(value) + field.const(_HUGE**3)
    for c, C in _MARGINS:
        if nonnegative(helped - field.const(c) * square):
            return True
        few = value.is_polynomial() and len(value.generators()) <= _MOST_IN_PROGRAMME
        if few and sum_of_squares(value + field.const(C) - field.const(c) * square, {}) is not None:
            return True
    return False


def _with_lower_powers(value: Quotient) -> Quotient:
    """A function that ``value`` plus a constant exceeds: half of an even power outgrows any multiple of lower ones."""
    if not value.is_polynomial():
        return value
    field, terms_ = value.field, dict(value.numerator.to_dict())
    for exponents, c in list(terms_.items()):
        used = [k for k, e in enumerate(exponents) if e]
        degree = int(exponents[used[0]]) if len(used) == 1 else 0
        if c <= 0 or degree < 4 or degree % 2 or used[0] >= field.symbol_count:
            continue
        terms_[exponents] = terms_[exponents] - c / 2
        for lower in range(2, degree, 2):
            power = tuple(lower if e else 0 for e in exponents)
            terms_[power] = terms_.get(power, fmpq(0)) + _HUGE
    return field.polynomial(field.context.from_dict(terms_))


def _split(value: Quotient, variables: Sequence[int], states: int) -> tuple[list[SparseRow], list[fmpq], bool] | None:
    """The quadratic form and the linear part of S, and whether the other terms are all bounded or nonnegative.

    None if one of them may grow faster than linearly.
    """
    if not value.is_polynomial():
        return None
    field: Field = value.field
    size = len(variables)
    form: list[SparseRow] = [{} for _ in range(size)]
    linear = [fmpq(0)] * size
    small = True
    position = {k: i for i, k in enumerate(variables)}
    for index, (powers, coefficient) in enumerate(terms(value.numerator)):
        used = [k for k, e in powers for _ in range(e)]
        symbols = [k for k in used if k < field.symbol_count]
        if len(symbols) == len(used) and len(used) <= 2 and all(k in position for k in symbols):
            places = [position[k] for k in symbols]
            if len(places) == 2:
                i, j = places
                form[i][j] = form[i].get(j, ZERO) + coefficient / 2
                form[j][i] = form[j].get(i, ZERO) + coefficient / 2
            elif len(places) == 1:
                linear[places[0]] += coefficient
        else:
            factors_bounded = all(field.atoms[k].kind in BOUNDED_KINDS for k in used if k >= field.symbol_count)
            if factors_bounded and not symbols:
                continue
            if nonnegative(field.polynomial(field.context.from_dict({value.numerator.monomial(index): coefficient}))):
                continue
            if len(symbols) > 1 or not factors_bounded:
                return None
            small = False
    return form, linear, small


def _on_kernel(
    form: list[SparseRow],
    linear: Sequence[fmpq],
    gammas: Sequence[Sequence[fmpq]],
    alpha: Sequence[Fraction],
    kappa: Sequence[Real],
) -> Growth:
    """The linear growth on the kernel of the quadratic form."""
    basis = _kernel(form)
    if not basis:
        return Growth(True, "the quadratic part of S is positive definite")
    on_kernel = [[_dot(row, v) for v in basis] for row in gammas]
    solved = reduce_rows([dict(enumerate(row)) for row in on_kernel])
    if len(solved) < len(basis):
        return Growth(False, "there are directions in which neither S nor gamma grows")
    offset = [_dot(linear, v) for v in basis]
    rows: list[Row] = [
        {**{i: on_kernel[i][k] for i in range(len(gammas))}, CONSTANT: -offset[k]} for k in range(len(basis))
    ]
    try:
        extra = particular_solution(reduce_rows(rows), fmpq(0))
    except Inconsistent:
        return Growth(False, "the linear part of S is not balanced by gamma")
    for i, bound in enumerate(alpha):
        if all(entry == 0 for entry in on_kernel[i]):
            continue
        total = kappa[i] + extra.get(i, fmpq(0))
        if sign(rational(bound) - abs(total)) != 1:
            return Growth(False, f"alpha_{i + 1} does not exceed |kappa_{i + 1}|, and only ln cosh grows there")
    return Growth(True, "S grows quadratically, and ln cosh faster than kappa^T gamma where S does not")


def _kernel(form: Sequence[SparseRow]) -> list[list[fmpq]]:
    return kernel(form, len(form), fmpq(0), fmpq(1))


def _dot(a: Sequence[fmpq], b: Sequence[fmpq]) -> fmpq:
    return sum((x * y for x, y in zip(a, b, strict=True)), fmpq(0))
