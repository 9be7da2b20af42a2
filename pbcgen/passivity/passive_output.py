"""The passive output and gamma with ``gamma' = y`` (Assumptions 1 and 2).

gamma gives a passive output for the storage S iff for all x (Hill-Moylan)

    Z(x) = [[-grad S^T f, (grad gamma^T f - g^T grad S)^T / 2], [., sym(grad gamma^T g)]] >= 0.

The strategies below propose gradients of gamma; an exact prover then decides Z >= 0 from scratch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.integrate import Curl, curl, potential
from pbcgen.passivity.obstruction import Obstruction, obstruction
from pbcgen.passivity.plant import Plant, Point, columns, dot, sparse_dot
from pbcgen.passivity.region import Region, search_with_inputs
from pbcgen.passivity.response import Response, negative_response
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.branch import Budget
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import positive_semidefinite
from pbcgen.proof.elimination import semidefinite
from pbcgen.proof.nonnegative import Prover
from pbcgen.proof.sos import coefficients, squares_tried, sum_of_squares
from pbcgen.symbolic.coefficients import Coefficients
from pbcgen.symbolic.display import number
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows, solve
from pbcgen.symbolic.real import rational, sign, text

#: gamma is sought by semidefinite programming for systems with at most so many states times inputs.
_MOST_SYNTHESISED = 8
#: Its coefficients are rounded with a relative tolerance, smaller ones than a share of the largest like that share.
_TOLERANCES = ((1e-3, 1e-1), (1e-3, 1e-3), (1e-6, 1e-3))


#: The strategy of a gamma that comes with the model.
_GIVEN = "given with the model"


@dataclass(frozen=True, eq=False)
class PassiveOutput:
    """gamma and where it comes from.

    Attributes:
        gamma: m x 1 expression of x and the parameters.
        strategy: how it was found.
        claim: the verdict `passive-output`.
        matched: whether grad gamma is proved to be -F^-1 g (or -A g) for the power structure.
    """

    gamma: ca.SX
    strategy: str
    claim: Claim
    matched: bool


@dataclass(frozen=True)
class _Candidate:
    strategy: str
    gamma: ca.SX


@dataclass(frozen=True)
class _Obstacle:
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
        solutions = [solve(left_values.dense(zero), column, zero) for column in columns(right_values, zero)]
        if all(solution is not None for solution in solutions):
            [s for column in plant.symbols for s in ca.vertsplit(column)]
            sx = [ca.vertcat(*[plant.expression(v) for v in s]) for s in solutions if s is not None]
            return ca.sparsify(ca.horzcat(*sx))
    return None


def _candidates(plant: Plant, structure: PowerStructure | None) -> Iterator[_Candidate | _Obstacle]:
    system = plant.system
    if system.gamma is not None:
        yield _Candidate(_GIVEN, system.gamma)
        return
    mechanics, circuit = system.mechanical, system.circuit
    if mechanics is not None and not ca.depends_on(mechanics.G, system.x):
        yield _Candidate("natural output y = G^T q'", ca.mtimes(mechanics.G.T, mechanics.q))
    if circuit is not None:
        gamma = -ca.mtimes(circuit.g_tilde.T, ca.mtimes(circuit.Xi, circuit.P_gradient))
        yield _Candidate("Brayton-Moser, y = -g^T Qtilde^T x'", gamma)
    for strategy, psi in _gradients(plant, structure):
        yield from _integrated(plant, strategy, psi)
    yield from _ansatz(plant)


def _integrated(plant: Plant, strategy: str, psi: ca.SX) -> Iterator[_Candidate | _Obstacle]:
    """gamma from its gradient, when every column passes the integrability test."""
    parts = []
    for i in range(psi.shape[1]):
        obstacle = curl(plant, psi[:, i])
        if obstacle is not None:
            yield _Obstacle(strategy, i, obstacle)
            return
        part = potential(plant, psi[:, i])
        if part is None:
            return
        parts.append(part)
    yield _Candidate(strategy, ca.vertcat(*parts))


def _ansatz(plant: Plant) -> Iterator[_Candidate]:
    """gamma as a combination of coordinates, their products, and the model's atoms, with w = 0.

    The conditions ``grad gamma^T f = g^T grad S`` and ``grad gamma^T g = 0`` are linear in the coefficients.
    """
    system = plant.system
    functions = _basis(plant)
    gradients = ca.jacobian(ca.vertcat(*functions), system.x)
    along_f, along_g = ca.mtimes(gradients, system.f), ca.mtimes(gradients, system.g)
    natural = ca.mtimes(system.g.T, plant.gradient)
    field, (drift, inputs, wanted) = plant.exact(along_f, along_g, natural, symbolic=True)
    zero = field.const(0)
    parts = []
    for i in range(system.m):
        row = _combination(plant, field, drift.column(zero), inputs.dense(zero), wanted.column(zero)[i])
        if row is None:
            return
        parts.append(sum((plant.expression(c) * functions[k] for k, c in row.items()), ca.SX(0)))
    yield _Candidate("basis ansatz with w = 0", ca.vertcat(*parts))


def _basis(plant: Plant) -> list[ca.SX]:
    """Coordinates, their products, and the atoms of f, g, S."""
    x = ca.vertsplit(plant.system.x)
    products = [x[i] * x[j] for i in range(len(x)) for j in range(i, len(x))] if len(x) <= 12 else []
    field, _ = plant.exact(plant.system.f, plant.system.g, plant.system.S, symbolic=True)
    parameters = plant.parameter_positions()
    atoms = [
        plant.expression(field.symbol(k))
        for k, a in sorted(field.atoms.items())
        if not a.argument.symbols() <= parameters
    ]
    return [*x, *atoms, *products]


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


# --- the proof ---------------------------------------------------------------------------------------------------


def find(
    plant: Plant,
    structure: PowerStructure | None,
    storage_proved: bool,
    structure_proved: bool,
    region: Region | None = None,
    point: Point | None = None,
) -> PassiveOutput | Claim:
    """The first gamma that is proved to give a passive output, else the verdict that says what was tried.

    Args:
        plant: the system.
        structure: a power structure whose identity holds, or None.
        storage_proved: whether Assumption 1 is proved.
        structure_proved: whether the dissipation of the structure is proved nonnegative.
        region: where Assumption 1 holds; the whole space if not given.
        point: the equilibrium, to say whether its dissipation forces w != 0.
    """
    where = region or Region.whole(plant)
    tried: list[str] = []
    obstacles: list[_Obstacle] = []
    unproved: list[_Candidate] = []
    try:
        for candidate in chain(_candidates(plant, structure), _synthesised(plant, storage_proved)):
            if isinstance(candidate, _Obstacle):
                obstacles.append(candidate)
                tried.append(f"{candidate.strategy}: not integrable")
                continue
            if _is_constant(plant, candidate.gamma):
                tried.append(f"{candidate.strategy}: only a constant gamma, which feeds nothing back")
                continue
            method = prove(plant, structure, candidate.gamma, storage_proved, structure_proved, where)
            if method is not None:
                claim = _proved(candidate, method, where, _forced(plant, point))
                return PassiveOutput(candidate.gamma, candidate.strategy, claim, method.startswith("structure"))
            if candidate.strategy != _GIVEN and _pushes_forward(plant, candidate.gamma, point):
                tried.append(f"{candidate.strategy}: gamma' falls where u pushes, so Z(x) >= 0 fails")
                continue
            tried.append(f"{candidate.strategy}: Z(x) >= 0 not proved")
            unproved.append(candidate)
    except (UnsupportedOperation, ZeroDivisionError) as reason:
        tried.append(str(reason))
    searched = plant.system.gamma is None and (storage_proved or not unproved)
    impossible = _impossible(obstruction(plant)) if searched else None
    if impossible is None and storage_proved and point is not None:
        impossible = _contradicted(negative_response(plant, point))
    if unproved:
        first, jump = unproved[0], plant.jumps(unproved[0].gamma)
        claim = impossible or _refuted_gamma(plant, first, where) or _unproved(first, storage_proved, where, jump)
        return PassiveOutput(first.gamma, first.strategy, claim, False)
    return impossible or _none(plant, tried, obstacles, _forced(plant, point))


def _is_constant(plant: Plant, gamma: ca.SX) -> bool:
    """Whether no state moves gamma: the controller would hold every input where it is and be no feedback at all."""
    try:
        field, (slope,) = plant.exact(ca.jacobian(gamma, plant.system.x))
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    return all(entry.is_zero() for row in slope.dense(field.const(0)) for entry in row)


def _pushes_forward(plant: Plant, gamma: ca.SX, point: Point | None) -> bool:
    """Whether ``grad gamma^T g`` is certainly not positive semidefinite at x*: the law would drive u away."""
    if point is None:
        return False
    feedthrough = ca.mtimes(ca.jacobian(gamma, plant.system.x), plant.system.g)
    (matrix,) = plant.at(point, ca.densify(feedthrough + feedthrough.T))
    return positive_semidefinite(matrix).status is Status.REFUTED


def _forced(plant: Plant, point: Point | None) -> str:
    """The dissipation obstacle, if there is one: l* != 0 leaves no gamma with w = 0 near x*."""
    if point is None:
        return ""
    ((row,),) = plant.at(point, -ca.dot(plant.gradient, plant.system.f))
    return "" if sign(row[0]) != 1 else f"dissipation at x* is {text(row[0], 6)} > 0, so w != 0 is needed"


def _synthesised(plant: Plant, storage_proved: bool) -> Iterator[_Candidate]:
    """gamma in a basis, with coefficients for which Z(x) >= 0 seems to be a matrix sum of squares; w may be nonzero."""
    system = plant.system
    if system.gamma is not None or not storage_proved or system.n * system.m > _MOST_SYNTHESISED:
        return
    functions = _basis(plant)
    rates = ca.mtimes(ca.jacobian(ca.vertcat(*functions), system.x), system.xdot)
    loss = -ca.dot(plant.gradient, system.xdot)
    directions = ca.vertcat(*[system.u[i] * rates for i in range(system.m)])
    field, (base, offered) = plant.exact(loss, directions)
    zero = field.const(0)
    quotients = [base.scalar(zero), *offered.column(zero)]
    if not all(q.is_polynomial() for q in quotients):
        return
    found = coefficients(field, quotients[0].numerator, [q.numerator for q in quotients[1:]])
    if found is None:
        return
    largest = max(abs(c) for c in found)
    for tolerance, floor in _TOLERANCES:
        simple = [_simplest(c, tolerance * max(abs(c), floor * largest)) for c in found]
        rows = [simple[i * len(functions) : (i + 1) * len(functions)] for i in range(system.m)]
        gamma = [sum((plant.number(c) * f for c, f in zip(row, functions, strict=True) if c), ca.SX(0)) for row in rows]
        yield _Candidate("basis ansatz, Z(x) as a matrix sum of squares", ca.vertcat(*gamma))


def _simplest(value: float, tolerance: float) -> Fraction:
    """The fraction with the least denominator within the tolerance, roughly."""
    exact = Fraction(value)
    for digits in range(16):
        candidate = exact.limit_denominator(10**digits)
        if abs(candidate - exact) <= tolerance:
            return candidate
    return exact


def prove(
    plant: Plant,
    structure: PowerStructure | None,
    gamma: ca.SX,
    storage_proved: bool,
    structure_proved: bool,
    region: Region | None = None,
) -> str | None:
    """How ``Z(x) >= 0`` was proved for this gamma, or None.

    Args:
        plant: the system.
        gamma: the candidate.
        structure: a power structure whose identity holds, or None.
        storage_proved: whether Assumption 1 is proved.
        structure_proved: whether its dissipation B >= 0 is proved, so that it may be used for u != 0.
        region: where Assumption 1 is proved, and Z(x) >= 0 is wanted; the whole space if not given.
    """
    system = plant.system
    where = region or Region.whole(plant)
    if not storage_proved or not plant.is_differentiable(gamma):
        return None
    psi = ca.jacobian(gamma, system.x).T
    if structure_proved and structure is not None and gives_output(plant, structure, psi):
        return f"structure: grad gamma = {'-F^-1 g' if structure.form == 'F' else '-A g'}"
    try:
        field, (p, g, f, e) = plant.exact(psi, system.g, system.f, plant.gradient)
        zero = field.const(0)
        signals = columns(p, zero), columns(g, zero), f.column(zero), e.column(zero)
        direct = _direct(*signals, zero, where.prover(Budget()))
        return direct or _by_squares(plant, gamma, where)
    except (UnsupportedOperation, ZeroDivisionError):
        return None


def _balance(plant: Plant, gamma: ca.SX) -> ca.SX:
    """``u^T gamma' - S'``, which is [1, u]^T Z [1, u]."""
    system = plant.system
    rate = ca.mtimes(ca.jacobian(gamma, system.x), system.xdot)
    return ca.dot(system.u, rate) - ca.dot(plant.gradient, system.xdot)


def _by_squares(plant: Plant, gamma: ca.SX, region: Region) -> str | None:
    """Z(x) >= 0 as a matrix sum of squares."""
    field, (value,) = plant.exact(_balance(plant, gamma))
    found = sum_of_squares(value.scalar(field.const(0)), dict(enumerate(region.bounds)))
    return f"Z(x) is a matrix sum of squares, checked exactly; sizes of the matrices {found}" if found else None


def gives_output(plant: Plant, structure: PowerStructure, psi: ca.SX) -> bool:
    """``F grad gamma = -g`` and ``rho^T grad gamma = 0`` (or grad gamma = -A g): then Z is a quadratic form of B."""
    try:
        field, (p, g, matrix, rho) = plant.exact(psi, plant.system.g, structure.matrix, structure.remainder)
        zero = field.const(0)
        (rest,), rows = rho.columns(), matrix.rows()
        for psi_i, g_i in zip(p.columns(), g.columns(), strict=True):
            left, right = (psi_i, g_i) if structure.form == "F" else (g_i, psi_i)
            if not sparse_dot(rest, psi_i, zero).is_zero():
                return False
            if any(not (sparse_dot(row, left, zero) + right.get(k, zero)).is_zero() for k, row in enumerate(rows)):
                return False
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    return True


def _direct(
    psi: list[list[Quotient]],
    g: list[list[Quotient]],
    f: list[Quotient],
    e: list[Quotient],
    zero: Quotient,
    prover: Prover,
) -> str | None:
    """Z >= 0 as a matrix of functions; its corner is the dissipation, which Assumption 1 makes nonnegative."""
    m = len(psi)
    half = zero.field.const(1) / zero.field.const(2)
    corner = -dot(e, f, zero)
    border = [(dot(psi[i], f, zero) - dot(g[i], e, zero)) * half for i in range(m)]
    feedthrough = [[dot(psi[i], g[j], zero) for j in range(m)] for i in range(m)]
    block = [[(feedthrough[i][j] + feedthrough[j][i]) * half for j in range(m)] for i in range(m)]
    if all(entry.is_zero() for entry in border):
        return "exact algebra: Z block diagonal" if semidefinite(block, prover=prover) else None
    Z = [[corner, *border], *[[border[i], *block[i]] for i in range(m)]]
    return "exact algebra: Z(x) >= 0 by elimination" if semidefinite(Z, prover=prover) else None


# --- verdicts ----------------------------------------------------------------------------------------------------


def _proved(candidate: _Candidate, method: str, region: Region, forced: str) -> Claim:
    evidence = f"gamma found: {candidate.strategy}" + (f"; {forced}" if forced else "")
    return Claim("passive-output", Status.PROVED, region.text, method, evidence)


def _refuted_gamma(plant: Plant, candidate: _Candidate, region: Region) -> Claim | None:
    """A gamma that the user gave, and a state and input for which more is stored than supplied; else None.

    The state is one that the model is stated for.
    """
    if plant.system.gamma is None:
        return None
    region = Region.stated(plant) if region.is_whole else region
    balance = _balance(plant, candidate.gamma)
    names = (*plant.system.state_names, *plant.system.input_names)
    found = search_with_inputs(plant, region, balance)
    if found.point is None or found.value is None:
        return None
    values = {name: text(rational(v), 25) for name, v in zip(names, found.point, strict=True)}
    return Claim(
        "passive-output",
        Status.REFUTED,
        region.text,
        "ball arithmetic at a rational point",
        f"with the given gamma u^T gamma' - S' = {text(found.value, 6)} < 0: Z(x) is not positive semidefinite",
        "leave gamma out to have it derived, or check its signs",
        {"x": values, "u^T gamma' - S'": text(found.value, 9)},
    )


def _unproved(candidate: _Candidate, storage_proved: bool, region: Region, jump: str) -> Claim:
    why = "Z(x) >= 0 was not proved" if storage_proved else "assumption-1 is not proved, and it is part of Z(x) >= 0"
    why = f"gamma may jump by `{jump}`, and has no derivative there" if jump else why
    return Claim(
        "passive-output",
        Status.UNDECIDED,
        region.text,
        "exact algebra" + squares_tried(),
        f"candidate gamma: {candidate.strategy}; {why}",
        "give a gamma that has a derivative everywhere" if jump else _hint(candidate, storage_proved),
    )


def _hint(candidate: _Candidate, storage_proved: bool) -> str:
    if not storage_proved:
        return "mend assumption-1 first"
    if candidate.strategy == _GIVEN:
        return "leave gamma out to have it derived, or check its sign and scale: gamma' must be a passive output"
    return "give gamma with the model"


def _impossible(found: Obstruction | None) -> Claim | None:
    """The verdict when it is proved that no gamma exists."""
    if found is None:
        return None
    place = "nothing is lost" if found.along_losses else "f = 0"
    return Claim(
        "passive-output",
        Status.REFUTED,
        "all x",
        f"necessary conditions where {place}, exactly; witness in ball arithmetic",
        found.reason,
        "choose another storage or input; no gamma fits this one, whatever w",
        {"x": found.point, "value": found.value},
    )


def _contradicted(found: Response | None) -> Claim | None:
    """The verdict when the linearised system contradicts every gamma near x*."""
    if found is None:
        return None
    omega, value = number(found.omega), text(found.value, 6)
    return Claim(
        "passive-output",
        Status.REFUTED,
        "near x*",
        "response of the linearised system in ball arithmetic",
        "no gamma exists near x*, whatever w: with e = grad S and A = d(f + g u*)/dx at x*, Z(x) >= 0 needs "
        f"e^T (A^2 + omega^2 I)^-1 g u* >= 0 at every frequency, and it is {value} at omega = {omega}",
        "take a storage whose loss is zero at x* (such as the integrals of all flows), or use another input",
        {"omega": omega, "e^T (A^2 + omega^2 I)^-1 g u*": value},
    )


def _none(plant: Plant, tried: list[str], obstacles: list[_Obstacle], forced: str) -> Claim:
    evidence = "no gamma found; tried " + ("; ".join(tried) if tried else "every strategy")
    given = plant.system.gamma is not None
    hint = "leave gamma out to have it derived" if given else "give gamma=... with the model, or use another input"
    if forced and not given:
        hint = f"take a storage whose loss is zero at x* (such as the integrals of all flows), {hint}"
    if obstacles:
        first = obstacles[0]
        names = plant.system.state_names
        evidence += (
            f"; the gradient from {first.strategy} has d psi_{names[first.curl.i]}/d{names[first.curl.j]} "
            f"!= d psi_{names[first.curl.j]}/d{names[first.curl.i]}"
        )
    if forced:
        evidence += f"; {forced} (dissipation obstacle)"
    return Claim("passive-output", Status.UNDECIDED, "all x", "strategies for gamma", evidence, hint)
