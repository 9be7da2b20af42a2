"""The passive output and gamma with ``gamma' = y`` (Assumptions 1 and 2).

gamma gives a passive output for the storage S iff for all x (Hill-Moylan)

    Z(x) = [[-grad S^T f, (grad gamma^T f - g^T grad S)^T / 2], [., sym(grad gamma^T g)]] >= 0.

:mod:`pbcgen.passivity.gamma_candidates` proposes gamma; an exact prover then decides Z >= 0 from scratch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.gamma_candidates import GIVEN, Candidate, Obstacle, candidates, synthesised
from pbcgen.passivity.obstruction import Obstruction, obstruction
from pbcgen.passivity.plant import Plant, Point, columns, dot, sparse_dot
from pbcgen.passivity.region import Region, holding, search_with_inputs
from pbcgen.passivity.response import Response, negative_response
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.branch import Budget
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import positive_semidefinite
from pbcgen.proof.elimination import semidefinite
from pbcgen.proof.nonnegative import Prover
from pbcgen.proof.sos import squares_tried, sum_of_squares
from pbcgen.symbolic.display import number
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import rational, sign, text

#: Boxes that may be looked at for all candidates on a region.
_BOXES = 2000


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
    search = _Search(plant, structure, storage_proved, structure_proved, point)
    found = search.on(where, chain(candidates(plant, structure), synthesised(plant, storage_proved)))
    if found is not None:
        return found
    searched = plant.system.gamma is None and (storage_proved or not search.unproved)
    impossible = _impossible(obstruction(plant)) if searched else None
    if impossible is None and storage_proved and point is not None:
        impossible = _contradicted(plant, negative_response(plant, point))
    stated = Region.stated(plant)
    if impossible is None and storage_proved and where.is_whole and not stated.is_whole:
        found, where = search.on(stated, iter([*search.obstacles, *search.unproved])), stated
        if found is not None:
            return found
    if search.unproved:
        first, jump = search.unproved[0], plant.jumps(search.unproved[0].gamma)
        claim = _refuted_gamma(plant, first, where) or impossible
        claim = claim or _unproved(first, storage_proved, where, jump)
        return PassiveOutput(first.gamma, first.strategy, claim, False)
    return impossible or _none(plant, search.tried, search.obstacles, _forced(plant, point))


@dataclass(eq=False)
class _Search:
    """The candidates one after the other, and what became of them."""

    plant: Plant
    structure: PowerStructure | None
    storage_proved: bool
    structure_proved: bool
    point: Point | None
    tried: list[str] = field(default_factory=list)
    obstacles: list[Obstacle] = field(default_factory=list)
    unproved: list[Candidate] = field(default_factory=list)
    budget: Budget = field(default_factory=Budget)

    def on(self, where: Region, proposals: Iterator[Candidate | Obstacle]) -> PassiveOutput | None:
        """The first that is proved on a region, or None."""
        self.tried, self.obstacles, self.unproved, self.budget = [], [], [], Budget(_BOXES)
        try:
            for candidate in proposals:
                found = self._look(candidate, where)
                if found is not None:
                    return found
        except (UnsupportedOperation, ZeroDivisionError) as reason:
            self.tried.append(str(reason))
        return None

    def _look(self, candidate: Candidate | Obstacle, where: Region) -> PassiveOutput | None:
        plant = self.plant
        if isinstance(candidate, Obstacle):
            self.obstacles.append(candidate)
            self.tried.append(f"{candidate.strategy}: not integrable")
        elif _is_constant(plant, candidate.gamma):
            self.tried.append(f"{candidate.strategy}: only a constant gamma, which feeds nothing back")
        elif method := prove(plant, self.structure, candidate.gamma, self.storage_proved, self.structure_proved, where):
            _, domain = holding(plant, where, _BOXES, candidate.gamma)
            claim = _proved(candidate, method, domain, _forced(plant, self.point))
            return PassiveOutput(candidate.gamma, candidate.strategy, claim, method.startswith("structure"))
        elif candidate.strategy != GIVEN and _pushes_forward(plant, candidate.gamma, self.point):
            self.tried.append(f"{candidate.strategy}: gamma' falls where u pushes, so Z(x) >= 0 fails")
        else:
            self.tried.append(f"{candidate.strategy}: Z(x) >= 0 not proved")
            self.unproved.append(candidate)
        return None


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


def prove(
    plant: Plant,
    structure: PowerStructure | None,
    gamma: ca.SX,
    storage_proved: bool,
    structure_proved: bool,
    region: Region | None = None,
    budget: Budget | None = None,
) -> str | None:
    """How ``Z(x) >= 0`` was proved for this gamma, or None.

    Args:
        plant: the system.
        gamma: the candidate.
        structure: a power structure whose identity holds, or None.
        storage_proved: whether Assumption 1 is proved.
        structure_proved: whether its dissipation B >= 0 is proved, so that it may be used for u != 0.
        region: where Assumption 1 is proved, and Z(x) >= 0 is wanted; the whole space if not given.
        budget: of boxes, where the region is bounded.
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
        if not where.is_whole and (squares := _by_squares(plant, gamma, where)) is not None:
            return squares  # boxes take longer
        direct = _direct(*signals, zero, where.prover(budget or Budget()))
        return direct or (_by_squares(plant, gamma, where) if where.is_whole else None)
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


def _proved(candidate: Candidate, method: str, domain: str, forced: str) -> Claim:
    evidence = f"gamma found: {candidate.strategy}" + (f"; {forced}" if forced else "")
    return Claim("passive-output", Status.PROVED, domain, method, evidence)


def _refuted_gamma(plant: Plant, candidate: Candidate, region: Region) -> Claim | None:
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


def _unproved(candidate: Candidate, storage_proved: bool, region: Region, jump: str) -> Claim:
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


def _hint(candidate: Candidate, storage_proved: bool) -> str:
    if not storage_proved:
        return "mend assumption-1 first"
    if candidate.strategy == GIVEN:
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


def _contradicted(plant: Plant, found: Response | None) -> Claim | None:
    """The verdict when the system, linearised at a rest, contradicts every gamma."""
    if found is None:
        return None
    omega, value = number(found.omega), text(found.value, 6)
    names = (*plant.system.state_names, *plant.system.input_names)
    rest = {name: text(v, 17) for name, v in zip(names, (*found.point.x, *found.point.u), strict=True)}
    shown = ", ".join(f"{name} = {text(v, 6)}" for name, v in zip(names, (*found.point.x, *found.point.u), strict=True))
    return Claim(
        "passive-output",
        Status.REFUTED,
        "all x",
        "response of the system, linearised at a rest, in ball arithmetic",
        f"no gamma exists, whatever w: at the rest {shown}, with e = grad S and A = d(f + g u)/dx, Z(x) >= 0 needs "
        f"e^T (A^2 + omega^2 I)^-1 g u >= 0 at every frequency, and it is {value} at omega = {omega}",
        "take a storage whose loss is zero at x* (such as the integrals of all flows), or use another input",
        {"rest": rest, "omega": omega, "e^T (A^2 + omega^2 I)^-1 g u": value},
    )


def _none(plant: Plant, tried: list[str], obstacles: list[Obstacle], forced: str) -> Claim:
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
