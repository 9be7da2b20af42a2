"""Assumption 3 and Theta with symbolic parameters: Lambda as formulas, and the condition on the gains.

As in :mod:`pbcgen.passivity.dissipation`, ``W = C B0^+ C^T`` for the rows C of (eta', y) over the vector v of the
dissipation, and Lambda_i is the inverse of the sum of magnitudes in row i. Here all of this are functions of the
parameters, found without care for pivots that might vanish; what is proved is the inequality itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from pbcgen.models.laws import NaturalDamping
from pbcgen.parametric.wide import EVERYWHERE, FAR_REACHES, GIVE_UP, Wide, pairs, refuted, undecided
from pbcgen.parametric.wide_conditions import Verdict, condition, negative_minor
from pbcgen.passivity.damping_search import Finding, Port
from pbcgen.passivity.plant import dot
from pbcgen.passivity.region import Region
from pbcgen.passivity.structure import PowerStructure
from pbcgen.passivity.theta import filter_gain
from pbcgen.proof.elimination import definite, positivity_conditions, semidefinite
from pbcgen.proof.nonnegative import nonnegative, positive
from pbcgen.symbolic.coefficients import Coefficients
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT, particular_solution, reduce_rows

_Matrix = list[list[Quotient]]


@dataclass(frozen=True)
class Damping:
    """Assumption 3 with symbolic parameters.

    Attributes:
        verdict: the claim.
        inverse_l, inverse_c: 1/Lambda_l and 1/Lambda_c as expressions, or None.
        tight: whether no larger Lambda exists.
    """

    verdict: Verdict
    inverse_l: ca.SX | None = None
    inverse_c: ca.SX | None = None
    tight: bool = False


def assumption_3(wide: Wide, structure: PowerStructure | None) -> Damping:
    """Lambda for the eta that was found at the values; ``structure`` proves Assumption 1 and matches gamma."""
    name = "assumption-3"
    bounds = wide.derivation.bounds
    if wide.eta is None or wide.gamma is None or bounds is None:
        return Damping(Verdict(undecided(name, EVERYWHERE, "no eta was found at the values of the parameters")))
    if structure is None:
        why = "it needs assumption-1 and gamma by the power structure"
        return Damping(Verdict(undecided(name, EVERYWHERE, why)))
    try:
        found = _found(wide, structure, wide.gamma, wide.eta)
    except GIVE_UP as reason:
        return Damping(Verdict(undecided(name, EVERYWHERE, str(reason))))
    if isinstance(found, str):
        return Damping(Verdict(undecided(name, EVERYWHERE, found)))
    totals, tight = found
    s = int(wide.eta.numel())
    one = totals[0].field.const(1)
    shown = [wide.text(one / total) for total in totals]
    evidence = (
        f"eta = ({', '.join(bounds.eta_names)}), Lambda_l = diag({', '.join(shown[:s])}), "
        f"Lambda_c = diag({', '.join(shown[s:])})"
    )
    claim = wide.proved(name, EVERYWHERE, "dissipation less Lambda by elimination over Q(parameters)", evidence)
    inverses = [wide.plant.expression(total) for total in totals]
    return Damping(Verdict(claim), ca.vertcat(*inverses[:s]), ca.vertcat(*inverses[s:]), tight)


def _found(wide: Wide, structure: PowerStructure, gamma: ca.SX, eta: ca.SX) -> tuple[list[Quotient], bool] | str:
    """1/Lambda for (eta', y) and whether it is the least there is; or why there is none."""
    system = wide.plant.system
    psi, slopes = ca.jacobian(gamma, system.x), ca.jacobian(eta, system.x)
    stacked = ca.vertcat(slopes, psi)
    signals = ca.mtimes(stacked, structure.matrix) if structure.form == "F" else stacked
    friction, overlap = ca.mtimes(stacked, structure.remainder), ca.mtimes(psi, slopes.T)
    field, matrices = wide.plant.exact(*map(ca.densify, (structure.dissipation(), signals, friction, overlap)))
    if not wide.defined:
        return "the model is not certainly defined for all positive parameters"
    zero = field.const(0)
    B, C, rho, crossed = (matrix.dense(zero) for matrix in matrices)
    if any(not entry.is_zero() for row in (*rho, *crossed) for entry in row):
        return "eta' and y are not functions of the dissipated flows alone"
    parameters = frozenset(range(system.n + system.m, len(field.names)))
    if any(not entry.symbols() <= parameters for row in C for entry in row):
        return "eta' or y depends on the dissipated flows by functions of the state"
    B0 = _constant_part(B, parameters)
    totals, separate = _row_sums(_compliance(B0, C, zero), zero)
    if not all(positive(total) for total in totals):
        return "the sign of Lambda was not proved for all positive parameters"
    rest = [
        [
            entry - sum((C[k][i] * C[k][j] / total for k, total in enumerate(totals)), zero)
            for j, entry in enumerate(row)
        ]
        for i, row in enumerate(B)
    ]
    if not semidefinite(rest):
        return "the dissipation was not proved to exceed what Lambda asks for"
    complete = all((a - b).is_zero() for p, q in zip(B, B0, strict=True) for a, b in zip(p, q, strict=True))
    return totals, complete and separate


def _constant_part(B: _Matrix, parameters: frozenset[int]) -> _Matrix:
    """A part of B without the state: on the diagonal what the entry is proved never to fall below.

    Off the diagonal entries stay: those with the state are for :func:`semidefinite` to deal with.
    """
    field = B[0][0].field
    split = Coefficients(field, parameters)
    result = [list(row) for row in B]
    for i, row in enumerate(B):
        for j, entry in enumerate(row):
            if entry.symbols() <= parameters:
                continue
            terms = split.split(entry) or {}
            least = next((value for monomial, value in terms.items() if not any(monomial)), field.const(0))
            known = i == j and nonnegative(entry - least)
            result[i][j] = least if known else field.const(0)
    return result


def _compliance(B0: _Matrix, C: _Matrix, zero: Quotient) -> _Matrix:
    """``C B0^+ C^T``, for parameters in general position. Raises Inconsistent for a row outside the range of B0."""
    solutions = []
    for target in C:
        equations = [{**dict(enumerate(line)), CONSTANT: -value} for line, value in zip(B0, target, strict=True)]
        solution = particular_solution(reduce_rows(equations), zero)
        solutions.append([solution.get(k, zero) for k in range(len(target))])
    return [[dot(row, solution, zero) for solution in solutions] for row in C]


def _row_sums(W: _Matrix, zero: Quotient) -> tuple[list[Quotient], bool]:
    """The sum of magnitudes of each row, and whether W is diagonal."""
    totals = []
    for i, row in enumerate(W):
        total = zero
        for j, entry in enumerate(row):
            total = total + (entry if i == j or nonnegative(entry) else -entry)
        totals.append(total)
    return totals, all(entry.is_zero() for i, row in enumerate(W) for j, entry in enumerate(row) if i != j)


@dataclass(frozen=True)
class Theta:
    """The claim `theta`, and whether Theta > 0 is proved, or holds on its condition."""

    verdict: Verdict
    strict: bool = False


def theta(wide: Wide, damping: Damping) -> Theta:
    """``K_l R_l >= (Upsilon Lambda_l^-1 Upsilon^T + Lambda_c^-1) / 4`` for all positive parameters."""
    name, law = "theta", wide.base
    assert isinstance(law, NaturalDamping)
    if damping.inverse_l is None or damping.inverse_c is None or law.Upsilon is None:
        return Theta(Verdict(undecided(name, EVERYWHERE, "needs assumption-3")))
    upsilon = wide.matrix(law.Upsilon)
    needed = (ca.mtimes([upsilon, ca.diag(damping.inverse_l), upsilon.T]) + ca.diag(damping.inverse_c)) / 4
    excess = wide.diagonal(wide.K_l_R_l) - needed
    method = "Schur complement over Q(parameters)"
    condition_ = ""
    try:
        entries = wide.entries(excess)
        if semidefinite(entries):
            claim = wide.proved(name, EVERYWHERE, method, "K_l R_l exceeds what these Lambda ask for")
            return Theta(Verdict(claim), definite(entries))
        left = positivity_conditions(wide.entries(wide.diagonal(wide.K_l_R_l, symbolic=True) - needed))
        condition_ = condition(wide, left, wide.K_l_R_l)
    except GIVE_UP:
        pass
    iff = f"Theta > 0 with these Lambda iff {condition_}" if condition_ else "Theta was not proved"
    against = negative_minor(wide, excess, FAR_REACHES) if damping.tight else None
    state = None if against is None else _too_weak(wide, law, against.values)
    if against is None or state is None:
        return Theta(Verdict(undecided(name, EVERYWHERE, iff), condition_), bool(condition_))
    why = f"{iff}; not so with {pairs(against.values)}"
    found = {"parameters": against.values, "x": state.values, "Theta form": state.dissipation}
    claim = refuted(name, EVERYWHERE, why, "keep to this condition, or raise K_l R_l", found)
    return Theta(Verdict(claim, condition_), bool(condition_))


def _too_weak(wide: Wide, law: NaturalDamping, values: Mapping[str, str]) -> Finding | None:
    """A state and an input at which these parameters damp too little for the gains, whatever Lambda is."""
    own = wide.derivation
    assert own.gamma is not None
    port = Port.of(wide.given.with_values(values), Region.stated(wide.given), own.gamma, own.eta)
    return port.theta_negative(law.Upsilon or (), filter_gain(law))
