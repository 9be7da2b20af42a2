"""Assumption 1: the storage does not grow by itself, ``grad S^T f <= 0`` (pascond)."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.structure import PowerStructure, StructureProof, power_structure
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.nonnegative import nonnegative
from pbcgen.symbolic.real import BITS, Real, precision, rational, sign, text

#: Random points at which a counterexample is looked for.
_SAMPLES = 4000


@dataclass(frozen=True)
class Storage:
    """The verdict on Assumption 1 and the power structure that was found, if any.

    Attributes:
        claim: the verdict `assumption-1`.
        structure: f and grad S satisfy its identity; a source of candidates for gamma.
        by_structure: whether its dissipation B is proved nonnegative for every v, not only for v = grad S (or f).
            Assumption 1 may hold without that; conclusions about u != 0 may not be drawn from B then.
    """

    claim: Claim
    structure: PowerStructure | None
    by_structure: bool = False

    @property
    def proved(self) -> bool:
        """Whether Assumption 1 is proved."""
        return self.claim.status is Status.PROVED


def assumption_1(plant: Plant) -> Storage:
    """Prove, refute or leave open that the storage is nonincreasing for u = 0."""
    found = power_structure(plant) if plant.gradient_is_exact else None
    if found is not None and found[1].complete:
        return Storage(_by_structure(found[0]), found[0], by_structure=True)
    structure = found[0] if found else None
    if _directly(plant):
        claim = Claim(
            "assumption-1", Status.PROVED, "all x", "exact algebra", "-grad S^T f is a sum of terms of known sign"
        )
        return Storage(claim, structure)
    return Storage(_refute(plant, found[1] if found else None), structure)


def _by_structure(structure: PowerStructure) -> Claim:
    terms = "sym F <= 0" if structure.form == "F" else "sym A <= 0"
    friction = ", remainder rho^T grad S >= 0" if structure.remainder.nnz() else ""
    return Claim(
        "assumption-1",
        Status.PROVED,
        "all x",
        f"structure: {terms}{friction}",
        structure.origin,
    )


def _directly(plant: Plant) -> bool:
    power = ca.dot(plant.gradient, plant.system.f)
    try:
        field, (value,) = plant.exact(power)
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    return nonnegative(-value.scalar(field.const(0)))


def _refute(plant: Plant, proof: StructureProof | None) -> Claim:
    """Look for a state where the storage grows, and confirm it in ball arithmetic."""
    power = ca.dot(ca.gradient(plant.system.S, plant.system.x), plant.system.f)
    function = plant.numeric(power)
    generator = np.random.default_rng(0)
    worst, where = -np.inf, None
    points = sample_points(plant, generator, _SAMPLES)
    values = np.array(function.map(len(points))(points.T, np.zeros((plant.system.m, len(points))))).ravel()
    values = np.where(np.isfinite(values), values, -np.inf)
    best = int(np.argmax(values))
    worst, where = float(values[best]), points[best]
    if worst > 0:
        confirmed = _confirm(plant, power, where)
        if confirmed is not None:
            return confirmed
    return Claim(
        "assumption-1",
        Status.UNDECIDED,
        "all x",
        f"exact algebra; {_SAMPLES} samples with seed 0",
        f"no proof of grad S^T f <= 0; largest sampled value {worst:.3g}" + _what_failed(proof),
        "write S and f so that f = F grad S with sym F <= 0, or check the signs of the dissipation",
    )


def _what_failed(proof: StructureProof | None) -> str:
    if proof is None:
        return "; no F with f = F grad S was found"
    return "; f = F grad S, but sym F <= 0 was not proved" if not proof.dissipation else "; the remainder has no sign"


def sample_points(plant: Plant, generator: np.random.Generator, count: int) -> np.ndarray:
    """States in the domain, on scales from 1e-3 to 10 where it is unbounded; count x n."""
    n = plant.system.n
    points = generator.normal(size=(count, n)) * 10.0 ** generator.uniform(-3, 1, size=(count, 1))
    for k, name in enumerate(plant.system.state_names):
        lo, hi = plant.system.domain.get(name, (None, None))
        if lo is not None and hi is not None:
            points[:, k] = generator.uniform(float(lo), float(hi), count)
        elif lo is not None:
            points[:, k] = float(lo) + np.abs(points[:, k])
        elif hi is not None:
            points[:, k] = float(hi) - np.abs(points[:, k])
    return points


def _confirm(plant: Plant, power: ca.SX, where: np.ndarray) -> Claim | None:
    x: list[Real] = [rational(Fraction(float(v))) for v in where]
    with precision(BITS):
        value = plant.walk(plant.tape(power), x, [rational(0)] * plant.system.m)[0][0][0]
    if sign(value) != 1:
        return None
    point = dict(zip(plant.system.state_names, [text(v, 17) for v in x], strict=True))
    return Claim(
        "assumption-1",
        Status.REFUTED,
        "all x",
        "ball arithmetic at a rational point",
        f"grad S^T f = {text(value, 6)} > 0: the storage grows without input",
        "check the signs of the dissipation, or restrict the domain",
        {"x": point, "grad S^T f": text(value, 9)},
    )
