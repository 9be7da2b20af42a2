"""Assumption 1: the storage does not grow by itself, ``grad S^T f <= 0`` (pascond).

In this order: by the power structure, by exact algebra, a search for a counterexample, sums of squares, and on the box
that the system states by branch and bound. A counterexample outside the box does not count.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.construction import derivative_is_rounded
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.region import Region, holding, search
from pbcgen.passivity.smooth import smooth_forms
from pbcgen.passivity.structure import PowerStructure, StructureProof, power_structure, prove
from pbcgen.proof.branch import Budget, Formula, nonnegative_on_box, zero_set
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.nonnegative import nonnegative
from pbcgen.proof.refute import Search
from pbcgen.proof.sos import squares_tried, sum_of_squares
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import approximate, rational, text

#: Boxes of the branch and bound over everything that is tried.
_BOXES = 12_000
#: Longer powers are not taken to semidefinite programming and branching.
_MOST_TERMS = 400
#: The part of ``|grad S| |f|`` that rounded numbers can make of zero.
_ROUNDING = 1e-13


@dataclass(frozen=True)
class Storage:
    """The verdict on Assumption 1 and the power structure that was found, if any.

    Attributes:
        claim: the verdict `assumption-1`.
        structure: f and grad S satisfy its identity; a source of candidates for gamma.
        by_structure: whether its dissipation B is proved nonnegative for every v, not only for v = grad S (or f).
            Assumption 1 may hold without that; conclusions about u != 0 may not be drawn from B then.
        region: where the claim holds when PROVED; None is the whole space.
    """

    claim: Claim
    structure: PowerStructure | None
    by_structure: bool = False
    region: Region | None = None

    @property
    def proved(self) -> bool:
        """Whether Assumption 1 is proved."""
        return self.claim.status is Status.PROVED


def assumption_1(plant: Plant) -> Storage:
    """Prove, refute or leave open that the storage is nonincreasing for u = 0."""
    jump = plant.jumps(plant.system.S)
    if jump:
        evidence = f"S contains the operation `{jump}`, so it may jump, and its derivative does not show it"
        hint = f"write a smooth storage: {smooth_forms(plant) or 'without comparisons and roundings'}"
        return Storage(Claim("assumption-1", Status.UNDECIDED, "all x", "operations of S", evidence, hint), None)
    rounded = derivative_is_rounded(plant.system)
    found = power_structure(plant) if plant.gradient_is_exact and not rounded else None
    structure = found[0] if found else None
    whole = Region.whole(plant)
    if found is not None and found[1].complete:
        return _where_defined(plant, Storage(_by_structure(found[0], whole), found[0], by_structure=True))
    power = None if rounded else _power(plant)
    if power is not None and nonnegative(-power):
        evidence = "-grad S^T f is a sum of terms of known sign"
        return _where_defined(plant, Storage(_proved(whole, "exact algebra", evidence), structure))
    stated = Region.stated(plant)
    counterexample = search(plant, stated, -_rate(plant), _scale(plant))
    if counterexample.point is not None:
        refuted = _refuted(plant, stated, counterexample)
        return Storage(_rounded(plant, refuted) if _is_rounding(plant, counterexample) else refuted, structure)
    if rounded:
        evidence = "CasADi has rounded a number in the derivative of S: f and grad S are known to 16 digits only"
        hint = "declare the constants of the model with Parameters(...); for erf write tanh or atan"
        return Storage(Claim("assumption-1", Status.UNDECIDED, "all x", "derivative of S", evidence, hint), None)
    for region in dict.fromkeys((whole, stated)):
        for claim in _attempts(plant, region, structure, power):
            storage = Storage(claim, structure, region=None if region.is_whole else region)
            return _where_defined(plant, storage)
    return Storage(_open(plant, stated, counterexample, found[1] if found else None), structure)


def _rate(plant: Plant) -> ca.SX:
    """``grad S^T f`` with the derivative of S itself."""
    return ca.dot(ca.gradient(plant.system.S, plant.system.x), plant.system.f)


def _scale(plant: Plant) -> ca.SX:
    """The size of the two factors of the rate, by which a margin is judged."""
    return ca.norm_2(ca.gradient(plant.system.S, plant.system.x)) * ca.norm_2(plant.system.f)


def _power(plant: Plant) -> Quotient | None:
    """``grad S^T f`` as an exact function, or None when it is not analytic."""
    try:
        field, (value,) = plant.exact(ca.dot(plant.gradient, plant.system.f))
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    return value.scalar(field.const(0))


def _attempts(
    plant: Plant, region: Region, structure: PowerStructure | None, power: Quotient | None
) -> Iterator[Claim]:
    """Claims that the expensive provers reach on a region, strongest first."""
    if power is not None and len(power.numerator) <= _MOST_TERMS:
        squares = sum_of_squares(-power, dict(enumerate(region.bounds)))
        if squares is not None:
            evidence = f"-grad S^T f is a sum of squares; sizes of the matrices {squares}"
            yield _proved(region, "sum of squares, found by semidefinite programming and checked exactly", evidence)
    if region.is_whole:
        return
    for share, attempt in ((2, _on_box), (4, _by_exact_function), (4, _by_matrix)):
        budget = Budget(_BOXES // share)
        if attempt(plant, region, structure, power, budget):
            yield _branched(region, budget)


def _by_exact_function(
    plant: Plant, region: Region, structure: PowerStructure | None, power: Quotient | None, budget: Budget
) -> bool:
    """The power as an exact function, taken apart and branched on."""
    del plant, structure
    return power is not None and len(power.numerator) <= _MOST_TERMS and region.prover(budget).nonnegative(-power)


def _by_matrix(
    plant: Plant, region: Region, structure: PowerStructure | None, power: Quotient | None, budget: Budget
) -> bool:
    """The dissipation matrix of the power structure, semidefinite on the box."""
    del power
    return structure is not None and prove(plant, structure, region.prover(budget)).complete


def _on_box(
    plant: Plant, region: Region, structure: PowerStructure | None, power: Quotient | None, budget: Budget
) -> bool:
    """Branch and bound on the formula as it was written: tighter than its expansion, and it need not be analytic."""
    del structure, power
    box = [(lo, hi) for lo, hi in region.bounds if lo is not None and hi is not None]
    if len(box) < plant.system.n:
        return False
    values = plant.parameter_values
    formula = Formula(-_rate(plant), plant.system.x, plant.parameter_symbols, values)
    zeros = zero_set(formula, plant.system.state_names, [Fraction(0)] * plant.system.n)
    return nonnegative_on_box(formula, tuple(box), budget, zeros).status is Status.PROVED


# --- verdicts ----------------------------------------------------------------------------------------------------


def _proved(region: Region, method: str, evidence: str, budget: Budget | None = None) -> Claim:
    certificate = {} if region.is_whole else {"box": region.text}
    if budget is not None and budget.used:
        certificate["boxes"] = str(budget.used)
        evidence += f"; {budget.used} boxes"
    return Claim("assumption-1", Status.PROVED, region.text, method, evidence, certificate=certificate)


def _branched(region: Region, budget: Budget) -> Claim:
    return _proved(region, "branch and bound in ball arithmetic", "-grad S^T f >= 0 on the stated box", budget)


def _by_structure(structure: PowerStructure, region: Region) -> Claim:
    terms = "sym F <= 0" if structure.form == "F" else "sym A <= 0"
    friction = ", remainder rho^T grad S >= 0" if structure.remainder.nnz() else ""
    return _proved(region, f"structure: {terms}{friction}", structure.origin)


def _where_defined(plant: Plant, storage: Storage) -> Storage:
    """The verdict with a smaller domain when the formulas are not proved to be defined on all of it."""
    region, domain = holding(plant, storage.region or Region.whole(plant), _BOXES // 4)
    return replace(storage, claim=replace(storage.claim, domain=domain), region=None if region.is_whole else region)


def _refuted(plant: Plant, region: Region, search: Search) -> Claim:
    """The state where the storage certainly grows."""
    assert search.point is not None
    assert search.value is not None
    names = plant.system.state_names
    point = {name: text(rational(v), 17) for name, v in zip(names, search.point, strict=True)}
    shown = (f"{name} = {float(v):.4g}" for name, v in zip(names, search.point, strict=True))
    growth = -search.value
    return Claim(
        "assumption-1",
        Status.REFUTED,
        region.text,
        "ball arithmetic at a rational point",
        f"grad S^T f = {text(growth, 6)} > 0: the storage grows without input at {', '.join(shown)}",
        _mend(plant, dict(zip(names, search.point, strict=True))),
        {"x": point, "grad S^T f": text(growth, 9)},
    )


def _is_rounding(plant: Plant, search: Search) -> bool:
    """Whether the storage grows by no more than the rounded numbers in the model can make of zero."""
    if not plant.system.long_numbers or search.point is None or search.value is None:
        return False
    size = float(plant.numeric(_scale(plant))([float(v) for v in search.point], [0.0] * plant.system.m))
    return abs(approximate(search.value)) <= _ROUNDING * size


def _rounded(plant: Plant, refuted: Claim) -> Claim:
    """The verdict where only rounding may let the storage grow."""
    return replace(
        refuted,
        status=Status.UNDECIDED,
        evidence=f"{refuted.evidence}; that is within the rounding of the numbers in the model",
        hint=_declare(plant),
        counterexample=None,
    )


def _declare(plant: Plant) -> str:
    """What to do about numbers that look like results of a computation."""
    shown = repr(plant.system.long_numbers[0])
    return f"declare the constants of the model with Parameters(...): the number {shown} in it looks rounded"


def _mend(plant: Plant, point: Mapping[str, Fraction]) -> str:
    """What to look at when the storage grows at a point: the friction that is negative there, if there is one."""
    mechanics = plant.system.mechanical
    if mechanics is not None:
        values = [float(point[name]) for name in plant.system.state_names]
        damping = plant.numeric(ca.diag(ca.densify(mechanics.D)))(values, [0.0] * plant.system.m)
        for name, value in zip(plant.system.state_names, ca.vertsplit(damping), strict=False):
            if float(value) < 0:
                return f"the friction of `{name}` is {float(value):.4g} there: friction must not be negative"
    return "look for a wrong sign in the friction, or a source in f that belongs to g u; a domain may exclude the state"


def _open(plant: Plant, region: Region, search: Search, proof: StructureProof | None) -> Claim:
    hint = smooth_forms(plant) or (
        "write S and f so that f = F grad S with sym F <= 0, or check the signs of the dissipation"
    )
    if plant.system.long_numbers:
        hint = f"{_declare(plant)}; else {hint}"
    if region.is_whole:
        hint += "; a bounded domain would allow branch and bound"
    return Claim(
        "assumption-1",
        Status.UNDECIDED,
        region.text,
        f"exact algebra{squares_tried()}{'' if region.is_whole else ', branch and bound'}; search for a counterexample",
        f"no proof of grad S^T f <= 0; {search.summary}" + _what_failed(proof),
        hint,
    )


def _what_failed(proof: StructureProof | None) -> str:
    if proof is None:
        return "; no F with f = F grad S was found"
    return "; f = F grad S, but sym F <= 0 was not proved" if not proof.dissipation else "; the remainder has no sign"
