"""Assumption 3: natural damping of coordinates eta.

With the power structure the dissipation is ``v^T B v + rho^T grad S``, and every signal sigma(x) has
``sigma' = r v`` with the row r = grad sigma^T F (or grad sigma^T), provided rho does not act on it. For a constant
part B0 <= B the inequality of Assumption 3, ``v^T B v >= |eta'|^2_{Lambda_l} + |y|^2_{Lambda_c}``, holds iff the rows
lie in the range of B0 and ``diag(Lambda_l, Lambda_c)^{-1} >= W = C B0^+ C^T``, C being the rows of eta' and y.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from flint import fmpq

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.damping_bounds import bounds_on, tightened
from pbcgen.passivity.damping_search import Port
from pbcgen.passivity.least import constant_below
from pbcgen.passivity.passive_output import gives_output
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.region import Region, holding
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import positive_semidefinite
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.real import ZERO, Real, approximate, rational, text
from pbcgen.symbolic.real_matrices import RealMatrix, SparseRow, dense, inverse, multiply, transpose

#: Boxes for whether the model is defined.
_BOXES = 2000


@dataclass(frozen=True, eq=False)
class NaturalDampingBounds:
    """What Assumption 3 gives.

    Attributes:
        eta: s x 1 expression, or None when no damped coordinate was found.
        eta_names: how to call its entries.
        Lambda_l, Lambda_c: the largest constant diagonals found, or None.
        claim: the verdict `assumption-3`.
        flows: ``B0^+ C^T``, n x (s + m), whose columns are the v that lose least for given (eta', y); None where the
            dissipation varies.
        compliance: W, whose inverse is the largest constant matrix Lambda in the Loewner order, for a constant part of
            the dissipation; it is diagonal where eta' and y share no damping.
    """

    eta: ca.SX | None
    eta_names: tuple[str, ...]
    Lambda_l: tuple[Real, ...] | None
    Lambda_c: tuple[Real, ...] | None
    claim: Claim
    flows: RealMatrix | None = None
    compliance: RealMatrix | None = None


@dataclass(frozen=True)
class _Rows:
    """The rows of signals over v as constants, with the constant part B0 of the dissipation."""

    B0: list[SparseRow]
    y: RealMatrix
    signals: list[list[Real] | None]
    complete: bool


def assumption_3(
    plant: Plant,
    structure: PowerStructure | None,
    gamma: ca.SX,
    matched: bool,
    storage_proved: bool,
    region: Region | None = None,
) -> NaturalDampingBounds:
    """Find naturally damped coordinates and the largest constants for them, or a state without the damping.

    Args:
        plant: the system.
        structure: a power structure whose identity holds, or None.
        gamma: its gradient gives the passive output.
        matched: whether the structure gives this gamma.
        storage_proved: whether Assumption 1 is proved.
        region: where a state without damping counts; the whole space if not given.
    """
    where = region or Region.whole(plant)
    jump = "" if plant.system.eta is None else plant.jumps(plant.system.eta)
    if jump:
        why = f"the given eta may jump by `{jump}`, and has no derivative there"
        return NaturalDampingBounds(_given(plant), (), None, None, _undecided(why))
    bounds = _bounds(plant, structure, gamma, matched, storage_proved, where)
    if structure is not None and storage_proved and bounds.claim.status is not Status.PROVED:
        bounds = _varying_bounds(plant, structure, gamma, where) or bounds
    if bounds.claim.status is Status.PROVED:
        region = Region.whole(plant) if bounds.claim.holds_everywhere else where
        _, domain = holding(plant, region, _BOXES, gamma, bounds.eta)
        return replace(bounds, claim=replace(bounds.claim, domain=domain))
    if bounds.claim.status is Status.REFUTED:
        return bounds
    found = Port.of(plant, where, gamma, bounds.eta).undamped(never_negative=storage_proved)
    if found is None:
        return bounds
    shown = ", ".join(f"{name} = {value}" for name, value in found.values.items())
    if not found.shows:
        evidence = f"{bounds.claim.evidence}; the dissipation is only {found.dissipation} at {shown}"
        return replace(bounds, claim=replace(bounds.claim, evidence=evidence))
    claim = Claim(
        "assumption-3",
        Status.REFUTED,
        where.text,
        "exact or ball arithmetic at a rational point",
        f"no positive Lambda exists: the dissipation is {found.dissipation} where eta' or y is not zero, at {shown}",
        "use dynamic-extension, or model the friction that is missing there",
        {"x": found.values, "u^T y - S'": found.dissipation},
    )
    return replace(bounds, claim=claim, Lambda_l=None, Lambda_c=None)


def _bounds(
    plant: Plant, structure: PowerStructure | None, gamma: ca.SX, matched: bool, storage_proved: bool, where: Region
) -> NaturalDampingBounds:
    """What the constant part of the dissipation gives."""
    candidates, names = _candidates(plant, gamma)
    if structure is None or not matched or not storage_proved:
        why = "it needs assumption-1 and gamma by the power structure"
        return NaturalDampingBounds(_given(plant), (), None, None, _undecided(why))
    rows = _constant_rows(plant, structure, gamma, candidates)
    if rows is None:
        return NaturalDampingBounds(_given(plant), (), None, None, _undecided("the dissipation has no constant part"))
    y_solutions = [_range_solution(rows.B0, row) for row in rows.y]
    if any(solution is None for solution in y_solutions):
        k = next(k for k, s in enumerate(y_solutions) if s is None)
        claim = _undamped_output(plant, structure, Port.of(plant, where, gamma, None), rows, k)
        return NaturalDampingBounds(_given(plant), (), None, None, claim)
    still = next((k for k, row in enumerate(rows.y) if not any(v != 0 for v in row)), None)
    if still is not None:
        why = f"gamma of {plant.system.input_names[still]} never moves: the input does nothing"
        return NaturalDampingBounds(_given(plant), (), None, None, _undecided(why))
    chosen = [
        k
        for k, row in enumerate(rows.signals)
        if row is not None and any(v != 0 for v in row) and _range_solution(rows.B0, row) is not None
    ]
    if plant.system.eta is not None and len(chosen) < len(candidates):
        return NaturalDampingBounds(
            plant.system.eta, tuple(names), None, None, _unusable(plant, gamma, plant.system.eta)
        )
    limit = plant.system.n - plant.system.m
    chosen = chosen[:limit]
    if not chosen:
        return NaturalDampingBounds(None, (), None, None, _no_damped_coordinate(plant))
    signal_rows = [rows.signals[k] or [] for k in chosen]
    flows = transpose([_range_solution(rows.B0, row) or [] for row in (*signal_rows, *rows.y)])
    W = multiply([*signal_rows, *rows.y], flows)
    bounds = [fmpq(1) / v for v in tightened(W, [_row_sum(row) for row in W])]
    found = flows if rows.complete else None
    s = len(chosen)
    eta = ca.vertcat(*[candidates[k] for k in chosen])
    eta_names = tuple(names[k] for k in chosen)
    claim = _with_constants("all x", "exact compliance of the dissipation", eta_names, bounds)
    largest = None if is_diagonal(W) else inverse(W)
    if largest is not None:
        shown = "; ".join(", ".join(text(v, 6) for v in row) for row in largest)
        claim = replace(claim, evidence=f"{claim.evidence}; the largest Lambda for (eta, gamma) is [{shown}]")
    return NaturalDampingBounds(eta, eta_names, tuple(bounds[:s]), tuple(bounds[s:]), claim, found, W)


def _varying_bounds(
    plant: Plant, structure: PowerStructure, gamma: ca.SX, stated: Region
) -> NaturalDampingBounds | None:
    """Constants for a dissipation that varies: on the whole space, else on the stated box."""
    if not gives_output(plant, structure, ca.jacobian(gamma, plant.system.x).T):
        return None
    candidates, names = _candidates(plant, gamma)
    whole = Region.whole(plant)
    for region in (whole,) if stated.is_whole else (whole, stated):
        found = bounds_on(plant, structure, gamma, candidates, region, plant.system.eta is not None)
        if found is None:
            continue
        eta = ca.vertcat(*[candidates[k] for k in found.chosen])
        eta_names = tuple(names[k] for k in found.chosen)
        claim = _with_constants(
            region.text, "Loewner order, by elimination with exact functions", eta_names, found.Lambda
        )
        s = len(found.chosen)
        return NaturalDampingBounds(eta, eta_names, found.Lambda[:s], found.Lambda[s:], claim)
    return None


def _with_constants(domain: str, method: str, eta_names: Sequence[str], Lambda: Sequence[Real]) -> Claim:
    s = len(eta_names)
    evidence = (
        f"eta = ({', '.join(eta_names)}), Lambda_l = diag({', '.join(text(v, 6) for v in Lambda[:s])}), "
        f"Lambda_c = diag({', '.join(text(v, 6) for v in Lambda[s:])})"
    )
    return Claim("assumption-3", Status.PROVED, domain, method, evidence)


def _given(plant: Plant) -> ca.SX | None:
    return plant.system.eta


def _candidates(plant: Plant, gamma: ca.SX) -> tuple[list[ca.SX], list[str]]:
    """The given eta, or coordinates that gamma does not depend on, measured ones first."""
    system = plant.system
    if system.eta is not None:
        entries = ca.vertsplit(system.eta)
        return entries, [str(e) for e in entries]
    slope = ca.jacobian(gamma, system.x)
    try:
        field, (matrix,) = plant.exact(slope)
    except (UnsupportedOperation, ZeroDivisionError):
        return [], []
    slopes = matrix.dense(field.const(0))
    decoupled = [k for k in range(system.n) if all(row[k].is_zero() for row in slopes)]
    measured = [k for k in decoupled if system.state_names[k] in system.measured]
    order = measured or decoupled
    return [system.x[k] for k in order], [system.state_names[k] for k in order]


def _constant_rows(plant: Plant, structure: PowerStructure, gamma: ca.SX, signals: Sequence[ca.SX]) -> _Rows | None:
    system = plant.system
    psi = ca.jacobian(gamma, system.x)
    slopes = ca.jacobian(ca.vertcat(*signals), system.x) if signals else ca.SX(0, system.n)
    stacked = ca.vertcat(psi, slopes)
    rows = ca.mtimes(stacked, structure.matrix) if structure.form == "F" else stacked
    overlap = ca.mtimes(psi, slopes.T) if signals else ca.SX(system.m, 0)
    friction = ca.mtimes(slopes, structure.remainder) if signals else ca.SX(0, 1)
    try:
        field, (B, r, o, fr) = plant.exact(structure.dissipation(), rows, overlap, friction)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    zero = field.const(0)
    split = constant_part(B.rows())
    if split is None:
        return None
    B0, complete = split
    values = [[entry.constant() for entry in row] for row in r.dense(zero)]
    y = values[: system.m]
    if any(entry is None for row in y for entry in row):
        return None
    found: list[list[Real] | None] = []
    for k, row in enumerate(values[system.m :]):
        usable = (
            all(entry is not None for entry in row)
            and fr.column(zero)[k].is_zero()
            and all(line[k].is_zero() for line in o.dense(zero))
        )
        found.append([entry for entry in row if entry is not None] if usable else None)
    return _Rows(B0, [[entry for entry in row if entry is not None] for row in y], found, complete)


def constant_part(B: Sequence[Mapping[int, Quotient]]) -> tuple[list[SparseRow], bool] | None:
    """A constant B0 >= 0 with B - B0 diagonal and nonnegative, and whether B is B0.

    None where no such B0 was found: lowering the diagonal of B to constants may lose the sign of the whole.
    """
    result: list[SparseRow] = [{} for _ in B]
    complete = True
    for i, row in enumerate(B):
        for j, entry in row.items():
            constant = entry.constant()
            if constant is not None:
                result[i][j] = constant
                continue
            if i != j:
                return None
            complete = False
            result[i][i] = rational(constant_below(entry))
    if positive_semidefinite(result).status is not Status.PROVED:
        return None
    return result, complete


def _range_solution(B0: Sequence[SparseRow], row: Sequence[Real]) -> list[Real] | None:
    """z with ``B0 z = row``, or None when the row is outside the range."""
    equations = [{**line, CONSTANT: -value} for line, value in zip(B0, row, strict=True)]
    try:
        solution = particular_solution(reduce_rows(equations), fmpq(0))
    except Inconsistent:
        return None
    return [solution.get(k, fmpq(0)) for k in range(len(row))]


def _compliance(B0: Sequence[SparseRow], rows: RealMatrix) -> RealMatrix:
    """``W = C B0^+ C^T`` for rows C in the range of B0."""
    solutions = [_range_solution(B0, row) or [] for row in rows]
    return multiply(rows, transpose(solutions))


def port_damping(plant: Plant, structure: PowerStructure, gamma: ca.SX, eta: ca.SX | None) -> RealMatrix | None:
    """The largest constant Lambda with ``|l + w u|^2 >= |(eta', y)|^2_Lambda``, or None; full, not diagonal.

    Without eta the matrix concerns y alone. It is the inverse of the compliance W.
    """
    signals = [] if eta is None else ca.vertsplit(eta)
    rows = _constant_rows(plant, structure, gamma, signals)
    if rows is None or any(row is None for row in rows.signals):
        return None
    stacked = [*(row or [] for row in rows.signals), *rows.y]
    if any(_range_solution(rows.B0, row) is None for row in stacked):
        return None
    return inverse(_compliance(rows.B0, stacked))


def is_diagonal(matrix: RealMatrix) -> bool:
    """Whether every entry off the diagonal is exactly zero."""
    return all(isinstance(v, fmpq) and v == 0 for i, row in enumerate(matrix) for j, v in enumerate(row) if i != j)


def _row_sum(row: Sequence[Real]) -> Real:
    """The diagonal entry that dominates a row of W: exact when W is diagonal."""
    total: Real = ZERO
    for entry in row:
        total = total + abs(entry)
    return total


def _undecided(why: str) -> Claim:
    return Claim(
        "assumption-3",
        Status.UNDECIDED,
        "all x",
        "exact compliance of the dissipation",
        why,
        "model the friction of the coordinate that shall be damped, and of the output port",
    )


def _no_damped_coordinate(plant: Plant) -> Claim:
    mechanics = plant.system.mechanical
    if mechanics is None or plant.system.m < mechanics.q.numel():
        return _undecided("no coordinate with constant natural damping")
    return replace(
        _undecided("every coordinate has an actuator, so none is left that only nature damps"),
        hint="use DynamicExtension, which damps what the actuators reach; or give eta=... with the model",
    )


def _unusable(plant: Plant, gamma: ca.SX, eta: ca.SX) -> Claim:
    """Why the given eta has no constants, where gamma may be the reason."""
    slopes = [ca.jacobian(e, plant.system.x) for e in (gamma, eta)]
    try:
        field, (overlap,) = plant.exact(ca.mtimes(slopes[0], slopes[1].T))
    except (UnsupportedOperation, ZeroDivisionError):
        return _undecided("the given eta is not damped by a constant")
    if all(v.is_zero() for row in overlap.dense(field.const(0)) for v in row):
        return _undecided("the given eta is not damped by a constant")
    claim = _undecided("grad gamma^T grad eta is not zero: the given eta and gamma share a direction")
    return replace(claim, hint="give an eta whose gradient is orthogonal to that of gamma")


def _undamped_output(plant: Plant, structure: PowerStructure, port: Port, rows: _Rows, k: int) -> Claim:
    """REFUTED where a state brings about a v without losses, but with an output of input k."""
    name = plant.system.input_names[k]
    open_ = _undecided(f"no constant Lambda_c > 0 was found for the output of {name}")
    if not rows.complete:
        return open_
    flow = [approximate(v) for v in _kernel_direction(rows.B0, rows.y[k])]
    found = port.undamped_along(structure, np.array(flow))
    if found is None:
        return open_
    shown = ", ".join(f"{name} = {value}" for name, value in found.values.items())
    return Claim(
        "assumption-3",
        Status.REFUTED,
        port.region.text,
        "kernel of the dissipation, and exact arithmetic at a state",
        f"the output of {name} is not damped: no Lambda_c > 0 exists, as nothing is lost at {shown}",
        "use dynamic-extension, or model the dissipation at the input port",
        {"x": found.values, "u^T y - S'": found.dissipation},
    )


def _kernel_direction(B0: Sequence[SparseRow], row: Sequence[Real]) -> list[Real]:
    """v with ``B0 v = 0`` and ``row v = 1``; exists when the row is outside the range of the symmetric B0."""
    equations: list[Row] = [dict(enumerate(line)) for line in dense(B0, len(row))]
    equations.append({**dict(enumerate(row)), CONSTANT: fmpq(-1)})
    solution = particular_solution(reduce_rows(equations), fmpq(0))
    return [solution.get(k, fmpq(0)) for k in range(len(row))]
