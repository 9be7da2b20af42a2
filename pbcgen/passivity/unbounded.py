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
from pbcgen.passivity.equation import linear_in
from pbcgen.passivity.inertia import missing_for_growth
from pbcgen.passivity.plant import Plant
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import RealMatrix, positive_semidefinite
from pbcgen.proof.elimination import definite
from pbcgen.proof.extrema import term_bounds
from pbcgen.proof.nonnegative import nonnegative
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.real import ZERO, Real, rational, sign
from pbcgen.symbolic.terms import terms


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
        return _quadratic(plant, gamma, alpha, kappa, compensated)
    except (UnsupportedOperation, ZeroDivisionError) as reason:
        return Growth(False, str(reason))


def _circuit(plant: Plant, gamma: ca.SX) -> bool:
    """Whether x -> w = grad P is solved for x one coordinate at a time, each linear with a constant coefficient.

    gamma must be ``-g_tilde^T Xi w``, which no quadratic form of w is outgrown by.
    """
    circuit = plant.system.circuit
    if circuit is None or ca.depends_on(circuit.Xi, plant.system.x) or ca.depends_on(circuit.g_tilde, plant.system.x):
        return False
    other = gamma + ca.mtimes(circuit.g_tilde.T, ca.mtimes(circuit.Xi, circuit.P_gradient))
    field, (w, weight, difference) = plant.exact(circuit.P_gradient, circuit.Xi, other)
    zero = field.const(0)
    if not definite(weight.dense(zero)) or any(entry.constant() is None for entry in difference.column(zero)):
        return False
    equations = w.column(zero)
    left = set(range(plant.system.n))
    used: set[int] = set()
    while left:
        step = _triangular_step(equations, left, used)
        if step is None:
            return False
        left.discard(step[0])
        used.add(step[1])
    return True


def _triangular_step(equations: Sequence[Quotient], left: set[int], used: set[int]) -> tuple[int, int] | None:
    """A state that an unused equation gives from states found before."""
    for i, equation in enumerate(equations):
        if i in used or not equation.is_polynomial():
            continue
        unknown = equation.symbols() & left
        if len(unknown) == 1:
            k = next(iter(unknown))
            if linear_in(equation, k) is not None:
                return k, i
    return None


def _quadratic(
    plant: Plant, gamma: ca.SX, alpha: Sequence[Fraction], kappa: Sequence[Real], compensated: bool
) -> Growth:
    system = plant.system
    mechanics = system.mechanical
    if mechanics is not None:
        reason = missing_for_growth(plant)
        if reason:
            return Growth(False, reason)
        variables = list(range(system.n // 2))
        rest = ca.SX(0) if compensated else mechanics.V
    else:
        variables = list(range(system.n))
        rest = system.S
    field, (value, slope) = plant.exact(rest, ca.jacobian(gamma, system.x))
    zero = field.const(0)
    rows = [[entry.constant() for entry in row] for row in slope.dense(zero)]
    if any(entry is None for row in rows for entry in row):
        return Growth(False, "gamma is not affine, so its growth is not known")
    split = _split(value.scalar(zero), variables, system.n)
    if split is None:
        return Growth(False, "S is not a quadratic form plus terms of less growth")
    form, linear, small = split
    if not small and _kernel(form):
        return Growth(False, "S has terms beside its quadratic form that grow, and the form is not definite")
    if positive_semidefinite(form).status is not Status.PROVED:
        return Growth(False, "the quadratic part of S is not positive semidefinite")
    gammas = [[row[k] or fmpq(0) for k in variables] for row in rows]
    return _on_kernel(form, linear, gammas, alpha, [ZERO] * len(kappa) if compensated else kappa)


def _split(value: Quotient, variables: Sequence[int], states: int) -> tuple[RealMatrix, list[fmpq], bool] | None:
    """The quadratic form and the linear part of S, and whether the other terms are all bounded or nonnegative.

    None if one of them may grow faster than linearly.
    """
    if not value.is_polynomial():
        return None
    field: Field = value.field
    size = len(variables)
    form: RealMatrix = [[ZERO] * size for _ in range(size)]
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
                form[i][j] = form[i][j] + coefficient / 2
                form[j][i] = form[j][i] + coefficient / 2
            elif len(places) == 1:
                linear[places[0]] += coefficient
        else:
            exponents = value.numerator.monomial(index)
            term = field.polynomial(field.context.from_dict({exponents: coefficient}))
            if term_bounds(term, {}).hi is not None or nonnegative(term):
                continue
            factor = {k: int(e) if k >= field.symbol_count else 0 for k, e in enumerate(exponents)}
            bounded = field.polynomial(field.context.from_dict({tuple(factor.values()): coefficient}))
            if len(symbols) > 1 or term_bounds(bounded, {}).hi is None:
                return None
            small = False
    return form, linear, small


def _on_kernel(
    form: RealMatrix,
    linear: Sequence[fmpq],
    gammas: Sequence[Sequence[fmpq]],
    alpha: Sequence[Fraction],
    kappa: Sequence[Real],
) -> Growth:
    """The linear growth on the kernel of the quadratic form."""
    kernel = _kernel(form)
    if not kernel:
        return Growth(True, "the quadratic part of S is positive definite")
    on_kernel = [[_dot(row, v) for v in kernel] for row in gammas]
    solved = reduce_rows([dict(enumerate(row)) for row in on_kernel])
    if len(solved) < len(kernel):
        return Growth(False, "there are directions in which neither S nor gamma grows")
    offset = [_dot(linear, v) for v in kernel]
    rows: list[Row] = [
        {**{i: on_kernel[i][k] for i in range(len(gammas))}, CONSTANT: -offset[k]} for k in range(len(kernel))
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


def _kernel(form: RealMatrix) -> list[list[fmpq]]:
    size = len(form)
    solved = reduce_rows([dict(enumerate(row)) for row in form])
    free = [k for k in range(size) if k not in solved]
    basis = []
    for f in free:
        v = [fmpq(0)] * size
        v[f] = fmpq(1)
        for pivot, row in solved.items():
            v[int(str(pivot))] = -row.get(f, fmpq(0))
        basis.append(v)
    return basis


def _dot(a: Sequence[fmpq], b: Sequence[fmpq]) -> fmpq:
    return sum((x * y for x, y in zip(a, b, strict=True)), fmpq(0))
