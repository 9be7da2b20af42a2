"""The matrix Theta of Prop. pro4: whether natural damping carries the filter x_l.

With ``E = [Upsilon, -I]`` the rate of the storage is at most

    -(|l + w u|^2 + w_l^T K_l R_l w_l + w_l^T E (eta', y)),        x_l' = R_l w_l,

which is never positive iff ``|l + w u|^2 >= |(eta', y)|^2`` in the weight ``E^T (4 K_l R_l)^-1 E`` (Schur complement).
A constant part ``v^T B0 v`` of the dissipation is at least ``|(eta', y)|^2_Lambda`` for ``Lambda = W^-1``, the largest
one in the Loewner order; with it the condition reads ``4 K_l R_l >= E W E^T``. Diagonal Lambda, as in the paper, ask
for more than is needed where eta' and y share damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from flint import fmpq

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.gains import Matrix
from pbcgen.models.laws import NaturalDamping
from pbcgen.passivity.damping_bounds import exceeds
from pbcgen.passivity.damping_search import Finding, Port
from pbcgen.passivity.dissipation import NaturalDampingBounds
from pbcgen.passivity.region import Region, holding
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import eigenvalues, positive_definite, positive_semidefinite
from pbcgen.symbolic.real import ZERO, approximate, rational
from pbcgen.symbolic.real_matrices import RealMatrix, congruence, diagonal, exact_matrix, multiply, transpose

_SCHUR = "Schur complement over the rationals"
_SEARCH = "search for a state with too little damping, confirmed at a rational point"
#: What is left of K_l R_l when damping shall be to spare.
SPARE = fmpq(999, 1000)
_WHOLE = fmpq(1)
#: Boxes for whether the model is defined.
_BOXES = 2000


@dataclass(frozen=True)
class ThetaVerdict:
    """The claim `theta` and the bound ``E W E^T / 4`` on K_l R_l, with its largest eigenvalue.

    ``strict`` says whether damping is left: then the storage rests only where eta', y and x_l' vanish.
    """

    claim: Claim
    bound: RealMatrix | None
    smallest: float | None
    strict: bool = False


def theta(
    bounds: NaturalDampingBounds,
    law: NaturalDamping,
    port: Port | None = None,
    structure: PowerStructure | None = None,
) -> ThetaVerdict:
    """``Theta >= 0`` (Th), in the Loewner order; touching zero counts.

    Args:
        bounds: the constants of Assumption 3; without them only a counterexample can be found.
        law: with its gains.
        port: where to look for states at which the damping is too weak, or None.
        structure: the power structure of Assumption 3, for dissipation that varies with the state.
    """
    if bounds.Lambda_l is None or bounds.Lambda_c is None or law.Upsilon is None:
        return ThetaVerdict(_without_bounds(law, port), None, None)
    W = compliance_of(bounds)
    bound, product = required(W, law.Upsilon), filter_gain(law)
    verdict = positive_semidefinite(excess(product, bound))
    smallest = eigenvalues(bound)[-1]
    given = ", ".join(f"{float(p):.6g}" for p in product)
    evidence = f"K_l R_l = {given}; sufficient and, for these Lambda, necessary: {smallest:.6g}"
    hint = f"raise K_l R_l to {smallest:.6g}"
    if verdict.status is Status.PROVED:
        claim = Claim("theta", Status.PROVED, bounds.claim.domain, _SCHUR, evidence)
        strict = positive_definite(excess(product, bound)).status is Status.PROVED
        return ThetaVerdict(claim, bound, smallest, strict)
    found = _along(bounds, law, port, structure, verdict.witness or ())
    if found is not None and port is not None:
        return ThetaVerdict(_too_weak(port, found, hint, evidence), bound, smallest)
    region = _carried(law, port, structure, _WHOLE)
    if region is not None and port is not None:
        method = "Schur complement and Loewner order, by elimination with exact functions"
        evidence = f"K_l R_l = {given}: the dissipation carries the filter at every state"
        _, domain = holding(port.plant, region, _BOXES, port.gamma, port.eta)
        claim = Claim("theta", Status.PROVED, domain, method, evidence)
        return ThetaVerdict(claim, bound, smallest, _carried(law, port, structure, SPARE) is not None)
    found = None if port is None else port.theta_negative(law.Upsilon, product)
    if found is not None and port is not None:
        return ThetaVerdict(_too_weak(port, found, hint, evidence), bound, smallest)
    evidence += "; other Lambda may do: no state was found at which the dissipation is too weak"
    method = f"{_SCHUR}; search for a state with too little damping"
    return ThetaVerdict(Claim("theta", Status.UNDECIDED, "all x", method, evidence, hint), bound, smallest)


def compliance_of(bounds: NaturalDampingBounds) -> RealMatrix:
    """W of the dissipation's constant part, or the inverse of the diagonal Lambda."""
    if bounds.compliance is not None:
        return bounds.compliance
    return diagonal([fmpq(1) / v for v in (*(bounds.Lambda_l or ()), *(bounds.Lambda_c or ()))])


def rows_of(upsilon: Matrix) -> RealMatrix:
    """``E = [Upsilon, -I]``."""
    m = len(upsilon)
    return [[*row, *(fmpq(-1 if i == j else 0) for j in range(m))] for i, row in enumerate(exact_matrix(upsilon))]


def required(W: RealMatrix, upsilon: Matrix) -> RealMatrix:
    """``E W E^T / 4``."""
    return [[v / 4 for v in row] for row in congruence(rows_of(upsilon), W)]


def needed_damping(law: NaturalDamping, share: fmpq = _WHOLE) -> RealMatrix:
    """``E^T (4 share K_l R_l)^-1 E``: the weight of (eta', y) that the dissipation must reach."""
    weights = diagonal([fmpq(1) / (4 * share * rational(k)) for k in filter_gain(law)])
    return congruence(transpose(rows_of(law.Upsilon or ())), weights)


def filter_gain(law: NaturalDamping) -> list[Fraction]:
    """The diagonal of K_l R_l."""
    return [law.K_l[i][i] * law.R_l[i][i] for i in range(len(law.K_l))]


def _carried(law: NaturalDamping, port: Port | None, structure: PowerStructure | None, share: fmpq) -> Region | None:
    """Where the dissipation is certainly at least what the filters need: the whole space, else the stated domain."""
    if port is None or structure is None or port.eta is None or any(k <= 0 for k in filter_gain(law)):
        return None
    whole = Region.whole(port.plant)
    weight = needed_damping(law, share)
    for region in (whole,) if port.region.is_whole else (whole, port.region):
        if exceeds(port.plant, structure, port.gamma, port.eta, weight, region):
            return region
    return None


def _without_bounds(law: NaturalDamping, port: Port | None) -> Claim:
    """A state at which no Lambda would be enough for these gains, or nothing."""
    if port is None or law.Upsilon is None or port.eta_rate.numel() == 0:
        return Claim("theta", Status.UNDECIDED, "all x", _SEARCH, "needs assumption-3", "satisfy assumption-3 first")
    found = port.theta_negative(law.Upsilon, filter_gain(law))
    if found is None:
        evidence = "no state with too little damping was found; a proof needs assumption-3"
        return Claim("theta", Status.UNDECIDED, port.region.text, _SEARCH, evidence, "satisfy assumption-3 first")
    return _too_weak(port, found, "raise K_l R_l, or add friction")


def _too_weak(port: Port, found: Finding, hint: str, asked: str = "") -> Claim:
    shown = ", ".join(f"{name} = {value}" for name, value in found.values.items())
    evidence = f"|l + w u|^2 - |Upsilon eta' - y|^2_(4 K_l R_l)^-1 = {found.dissipation} < 0 at {shown}"
    evidence = f"{asked}; {evidence}" if asked else evidence
    witness = {"x": found.values, "Theta form": found.dissipation}
    return Claim("theta", Status.REFUTED, port.region.text, _SEARCH, evidence, hint, witness)


def excess(product: Sequence[Fraction], bound: RealMatrix) -> RealMatrix:
    """``K_l R_l - bound``."""
    return [[(rational(product[i]) if i == j else ZERO) - v for j, v in enumerate(row)] for i, row in enumerate(bound)]


def _along(
    bounds: NaturalDampingBounds,
    law: NaturalDamping,
    port: Port | None,
    structure: PowerStructure | None,
    direction: Sequence[Fraction],
) -> Finding | None:
    """A state and an input for a direction w that ``K_l R_l - E W E^T / 4`` does not carry, or None.

    (eta', y) is then least where v is a multiple of ``B0^+ C^T E^T w``.
    """
    if bounds.flows is None or port is None or structure is None or not direction or min(filter_gain(law)) <= 0:
        return None
    (pull,) = multiply([[rational(c) for c in direction]], rows_of(law.Upsilon or ()))
    flow = [row[0] for row in multiply(bounds.flows, [[v] for v in pull])]
    v = np.array([approximate(entry) for entry in flow])
    size = float(np.linalg.norm(v))
    try:
        return port.theta_negative_along(law.Upsilon or (), filter_gain(law), structure, v / size) if size else None
    except UnsupportedOperation:
        return None
