"""Proposals for gamma: the natural output, what a power structure gives, and combinations of given functions.

Nothing here is trusted: :mod:`pbcgen.passivity.passive_output` decides ``Z(x) >= 0`` for each from scratch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations_with_replacement

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.integrate import Curl, curl, potential
from pbcgen.passivity.plant import Plant, columns
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.sos import coefficients, completed, simplest
from pbcgen.symbolic.coefficients import Coefficients, cleared
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows, solve

#: Systems with more states are not searched for a gamma with products of two, or three, coordinates.
_MOST_SQUARED, _MOST_CUBED = 12, 4
#: More coefficients are not sought by semidefinite programming.
_MOST_UNKNOWNS = 72
#: Its coefficients are rounded with a relative tolerance, smaller ones than a share of the largest like that share.
_TOLERANCES = ((1e-3, 1e-1), (1e-3, 1e-3), (1e-6, 1e-3))

#: The strategy of a gamma that comes with the model.
GIVEN = "given with the model"


@dataclass(frozen=True)
class Candidate:
    """gamma, m x 1, and how it came about."""

    strategy: str
    gamma: ca.SX


@dataclass(frozen=True)
class Obstacle:
    """A gradient that belongs to no gamma: for this output its Jacobian is not symmetric."""

    strategy: str
    output: int
    curl: Curl


def _gradients(plant: Plant, structure: PowerStructure | None) -> Iterator[tuple[str, ca.SX]]:
    """Proposals for grad gamma (n x m) that follow from the power structure."""
    g = plant.system.g
    if structure is None:
        yield from _folded(plant, ca.SX(plant.system.n, plant.system.n), -plant.system.f)
        return
    if structure.form == "A":
        yield "y = -g^T A^T x' with grad S = A f", -ca.mtimes(structure.matrix, g)
        return
    natural = _solve(plant, structure.matrix.T, g)
    if natural is not None:
        yield "natural output y = g^T grad S", natural
    swapped = _solve(plant, structure.matrix, -g)
    if swapped is not None:
        yield "y = -g^T F^{-T} x' with f = F grad S", swapped
    if structure.remainder.nnz():
        yield from _folded(plant, structure.matrix, structure.remainder)


def _folded(plant: Plant, matrix: ca.SX, remainder: ca.SX) -> Iterator[tuple[str, ca.SX]]:
    """The proposal of the structure whose F takes each entry of the remainder in as a multiple of that of grad S."""
    try:
        field, (rho, e) = plant.exact(remainder, plant.gradient)
        zero = field.const(0)
        pairs = zip(rho.column(zero), e.column(zero), strict=True)
        shares = [zero if part.is_zero() else part / slope for part, slope in pairs]
    except (UnsupportedOperation, ZeroDivisionError):
        return
    psi = _solve(plant, matrix - ca.diag(ca.vertcat(*[plant.expression(share) for share in shares])), -plant.system.g)
    if psi is not None:
        yield "y = -g^T F^{-T} x' with f = F(x) grad S", psi


def _solve(plant: Plant, matrix: ca.SX, right: ca.SX) -> ca.SX | None:
    """A solution of ``matrix X = right`` with symbolic parameters (at their values if that fails), or None."""
    for symbolic in (True, False):
        try:
            field, (left_values, right_values) = plant.exact(matrix, right, symbolic=symbolic)
        except (UnsupportedOperation, ZeroDivisionError):
            return None
        zero = field.const(0)
        rows, size = left_values.rows(), left_values.shape[1]
        solutions = [solve(rows, column, size, zero) for column in columns(right_values, zero)]
        if all(solution is not None for solution in solutions):
            sx = [ca.vertcat(*[plant.expression(v) for v in s]) for s in solutions if s is not None]
            return ca.sparsify(ca.horzcat(*sx))
    return None


def candidates(plant: Plant, structure: PowerStructure | None) -> Iterator[Candidate | Obstacle]:
    """The model's own gamma, or what its structure gives, likeliest first, and what was found in the way."""
    system = plant.system
    if system.gamma is not None:
        yield Candidate(GIVEN, system.gamma)
        return
    mechanics, circuit = system.mechanical, system.circuit
    if mechanics is not None and not ca.depends_on(mechanics.G, system.x):
        yield Candidate("natural output y = G^T q'", ca.mtimes(mechanics.G.T, mechanics.q))
    if circuit is not None:
        gamma = -ca.mtimes(circuit.g_tilde.T, ca.mtimes(circuit.Xi, circuit.P_gradient))
        yield Candidate("Brayton-Moser, y = -g^T Qtilde^T x'", gamma)
    for strategy, psi in _gradients(plant, structure):
        yield from _integrated(plant, strategy, psi)
    yield from _ansatz(plant)


def _integrated(plant: Plant, strategy: str, psi: ca.SX) -> Iterator[Candidate | Obstacle]:
    """gamma from its gradient, when every column passes the integrability test."""
    parts = []
    for i in range(psi.shape[1]):
        obstacle = curl(plant, psi[:, i])
        if obstacle is not None:
            yield Obstacle(strategy, i, obstacle)
            return
        part = potential(plant, psi[:, i])
        if part is None:
            return
        parts.append(part)
    yield Candidate(strategy, ca.vertcat(*parts))


def _ansatz(plant: Plant) -> Iterator[Candidate]:
    """gamma as a combination of coordinates, their products, and the model's atoms, with w = 0.

    The conditions ``grad gamma^T f = g^T grad S`` and ``grad gamma^T g = 0`` are linear in the coefficients.
    """
    for functions in _bases(plant):
        found = _matching(plant, functions)
        if found is not None:
            yield found
            return


def _matching(plant: Plant, functions: Sequence[ca.SX]) -> Candidate | None:
    """The combination of functions that meets these conditions."""
    system = plant.system
    gradients = ca.jacobian(ca.vertcat(*functions), system.x)
    along_f, along_g = ca.mtimes(gradients, system.f), ca.mtimes(gradients, system.g)
    natural = ca.mtimes(system.g.T, plant.gradient)
    field, (drift, inputs, wanted) = plant.exact(along_f, along_g, natural, symbolic=True)
    zero = field.const(0)
    parts = []
    for i in range(system.m):
        row = _combination(plant, field, drift.column(zero), inputs.dense(zero), wanted.column(zero)[i])
        if row is None:
            return None
        parts.append(sum((plant.expression(c) * functions[k] for k, c in row.items()), ca.SX(0)))
    return Candidate("basis ansatz with w = 0", ca.vertcat(*parts))


def _bases(plant: Plant) -> Iterator[list[ca.SX]]:
    """Coordinates, their products, and the atoms of f, g, S; then these times a coordinate, too."""
    x = ca.vertsplit(plant.system.x)
    products = [a * b for a, b in combinations_with_replacement(x, 2)] if len(x) <= _MOST_SQUARED else []
    field, _ = plant.exact(plant.system.f, plant.system.g, plant.system.S, symbolic=True)
    parameters = plant.parameter_positions()
    atoms = [
        plant.expression(field.symbol(k))
        for k, a in sorted(field.atoms.items())
        if not a.argument.symbols() <= parameters
    ]
    yield [*x, *atoms, *products]
    if len(x) <= _MOST_CUBED:
        cubes = [a * b * c for a, b, c in combinations_with_replacement(x, 3)]
        yield [*x, *atoms, *products, *(a * b for a in atoms for b in x), *cubes]


def _combination(
    plant: Plant, field: Field, drift: list[Quotient], inputs: list[list[Quotient]], wanted: Quotient
) -> dict[int, Quotient] | None:
    coefficients = Coefficients(field, plant.parameter_positions())
    rows: list[Row] = []
    conditions = [(drift, wanted)] + [([row[j] for row in inputs], field.const(0)) for j in range(plant.system.m)]
    for offered, target in conditions:
        splits = [coefficients.split(value) for value in offered]
        goal = coefficients.split(target)
        if goal is None or any(split is None for split in splits):
            return None
        present = {m for split in splits if split for m in split} | set(goal)
        for monomial in sorted(present):
            row: Row = {k: split[monomial] for k, split in enumerate(splits) if split and monomial in split}
            if monomial in goal:
                row[CONSTANT] = -goal[monomial]
            rows.append(row)
    try:
        solution = particular_solution(reduce_rows(rows), field.const(0))
    except Inconsistent:
        return None
    return {int(str(k)): value for k, value in solution.items() if not value.is_zero()}


def synthesised(plant: Plant, storage_proved: bool) -> Iterator[Candidate]:
    """gamma as a combination of functions for which Z(x) >= 0 is a matrix sum of squares; w may be nonzero.

    ``u^T gamma' - S'`` is linear in the coefficients of gamma and must be a sum of squares in x and u: a semidefinite
    programme. Its solution is rounded to short numbers, and moved onto its linear equations exactly: every rest is in
    the kernel of Z(x), whatever gamma.
    """
    if plant.system.gamma is not None or not storage_proved:
        return
    for functions in _bases(plant):
        yield from _programmed(plant, functions)


def _programmed(plant: Plant, functions: Sequence[ca.SX]) -> Iterator[Candidate]:
    system = plant.system
    if len(functions) * system.m > _MOST_UNKNOWNS:
        return
    rates = ca.mtimes(ca.jacobian(ca.vertcat(*functions), system.x), system.xdot)
    loss = -ca.dot(plant.gradient, system.xdot)
    field, (base, offered) = plant.exact(loss, ca.vertcat(*[system.u[i] * rates for i in range(system.m)]))
    balance, *directions = cleared(field, [base.scalar(field.const(0)), *offered.column(field.const(0))])

    def candidate(weights: Sequence[Fraction]) -> Candidate:
        rows = [weights[i * len(functions) : (i + 1) * len(functions)] for i in range(system.m)]
        gamma = [sum((plant.number(c) * f for c, f in zip(row, functions, strict=True) if c), ca.SX(0)) for row in rows]
        return Candidate("basis ansatz, Z(x) as a matrix sum of squares", ca.vertcat(*gamma))

    found = coefficients(field, balance, directions)
    if found is None:
        return
    largest = max(abs(c) for c in found)
    for tolerance, floor in _TOLERANCES:
        yield candidate([simplest(c, tolerance * max(abs(c), floor * largest)) for c in found])
    exact = completed(field, balance, directions, {})
    if exact is not None:
        yield candidate(exact[1])
