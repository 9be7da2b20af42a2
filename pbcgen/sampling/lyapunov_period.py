"""The Lyapunov route of `sampled-stable`: for which sample periods the storage of the continuous proof decreases.

Sampling consumes damping, and what is left must do. With the held input, backward Euler in x_c and x_l, and constants
of Assumption 3, ``|l + w u|^2 >= |(eta', y)|^2_Lambda``, it holds when

    2 Lambda_c - h (diag(alpha beta) + L) >= 0                              (uc), (umec): L >= -hess V, zero for (uc)
    Theta >= 0 with Lambda_c - h/2 (diag(alpha_c beta_c) + diag(alpha_l beta_l)) for Lambda_c     (ulc)

for any positive definite K_c, R_c; the derivation is in docs/theory-sampled.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
from flint import fmpq

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.laws import DynamicExtension, Integral, Law, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.passivity.dissipation import port_damping
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_definite, positive_semidefinite
from pbcgen.proof.extrema import term_bounds
from pbcgen.symbolic.real import rational
from pbcgen.symbolic.real_matrices import RealMatrix, diagonal, exact_matrix, transpose

#: The bound on h is given as a rational below the true one by at most this factor.
_SHARP = Fraction(1, 10**9)


@dataclass(frozen=True)
class LyapunovPeriods:
    """The Lyapunov route for one set of gains.

    Attributes:
        largest: a rational h up to which the storage does not grow, closely below the best one, or None if this
            route has no bound to offer; then ``reason`` says why.
        Lambda: the constant damping matrix over (eta', y) that was used.
        any_sequence: whether periods may vary below ``largest`` while the controller steps by a fixed one.
    """

    largest: Fraction | None
    reason: str
    Lambda: RealMatrix | None = None
    any_sequence: bool = True


def lyapunov_periods(
    plant: Plant, structure: PowerStructure | None, gamma: ca.SX, eta: ca.SX | None, law: Law, missing: Sequence[str]
) -> LyapunovPeriods:
    """The largest period of the Lyapunov route.

    Args:
        plant: the system.
        structure: a power structure that proves Assumption 1 and matches gamma, or None.
        gamma: m x 1.
        eta: s x 1, or None.
        law: with resolved gains.
        missing: premises of the continuous proof that are not proved.
    """
    if isinstance(law, Integral | PassiveOutput):
        return LyapunovPeriods(None, f"there is no storage argument for a held {law.name} law")
    if missing:
        return LyapunovPeriods(None, "open for " + ", ".join(missing))
    if structure is None:
        return LyapunovPeriods(None, "it needs the power structure of the system")
    signals = eta if isinstance(law, NaturalDamping) else None
    Lambda = port_damping(plant, structure, gamma, signals)
    if Lambda is None:
        return LyapunovPeriods(None, "the output is not damped by a constant (Lambda_c)")
    consumed = _consumed(plant, law)
    if consumed is None:
        return LyapunovPeriods(None, "hess V is not bounded below by a constant diagonal")
    largest = _largest(_budget(Lambda, consumed, law, False), _budget(Lambda, consumed, law, True))
    if largest is None:
        return LyapunovPeriods(None, "no h > 0 leaves enough damping", Lambda)
    return LyapunovPeriods(largest, "", Lambda, not isinstance(law, NaturalDamping))


def _consumed(plant: Plant, law: Law) -> RealMatrix | None:
    """C with ``h C / 2`` the damping of y that a period h consumes."""
    if isinstance(law, NaturalDamping):
        pairs = zip(law.alpha_c, law.beta_c, law.alpha_l, law.beta_l, strict=True)
        return diagonal([rational(a * b + c * d) for a, b, c, d in pairs])
    assert isinstance(law, DynamicExtension | PotentialCompensation)
    entries = [rational(a * b) for a, b in zip(law.alpha, law.beta, strict=True)]
    if isinstance(law, PotentialCompensation):
        softening = _softening(plant)
        if softening is None:
            return None
        entries = [e + rational(s) for e, s in zip(entries, softening, strict=True)]
    return diagonal(entries)


def _softening(plant: Plant) -> list[Fraction] | None:
    """A diagonal L with ``hess V(q) >= -L`` for every q of the domain, by Gershgorin's discs."""
    mechanics = plant.system.mechanical
    if mechanics is None:
        return None
    hessian = ca.densify(ca.jacobian(ca.gradient(mechanics.V, mechanics.q), mechanics.q))
    try:
        field, (matrix,) = plant.exact(hessian)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    domain = {k: plant.system.domain.get(name, (None, None)) for k, name in enumerate(plant.system.state_names)}
    result = []
    for i, row in enumerate(matrix.dense(field.const(0))):
        total = Fraction(0)
        for j, entry in enumerate(row):
            if entry.is_zero():
                continue
            bounds = term_bounds(entry, domain)
            if bounds.lo is None or (i != j and bounds.hi is None):
                return None
            total += -bounds.lo if i == j else max(abs(bounds.lo), abs(bounds.hi or Fraction(0)))
        result.append(max(total, Fraction(0)))
    return result


def _budget(Lambda: RealMatrix, consumed: RealMatrix, law: Law, touching: bool) -> Callable[[Fraction], bool]:
    """The test of a period: whether damping is left in every direction (touching zero counts only if ``touching``)."""
    m = len(consumed)
    s = len(Lambda) - m
    decide = positive_semidefinite if touching else positive_definite

    def left(h: Fraction) -> RealMatrix:
        half = rational(h / 2)
        rest = [list(row) for row in Lambda]
        for i in range(m):
            for j in range(m):
                rest[s + i][s + j] = rest[s + i][s + j] - half * consumed[i][j]
        return rest

    if not isinstance(law, NaturalDamping):
        return lambda h: decide(left(h)).status is Status.PROVED
    upsilon = exact_matrix(law.Upsilon or ())
    coupling = [[*(-v / 2 for v in row), *(fmpq(int(i == j), 2) for j in range(m))] for i, row in enumerate(upsilon)]
    filters = diagonal([rational(law.K_l[i][i] * law.R_l[i][i]) for i in range(m)])

    def theta(h: Fraction) -> bool:
        top = [[*a, *b] for a, b in zip(left(h), transpose(coupling), strict=True)]
        bottom = [[*a, *b] for a, b in zip(coupling, filters, strict=True)]
        return decide([*top, *bottom]).status is Status.PROVED

    return theta


def _largest(test: Callable[[Fraction], bool], touching: Callable[[Fraction], bool]) -> Fraction | None:
    """The end of the interval (0, h) that passes a test, exactly where it is a simple fraction, else closely below."""
    lo, hi = Fraction(0), Fraction(1)
    while test(hi):
        lo, hi = hi, hi * 16
        if hi > 10**9:
            return lo
    while lo == 0:
        middle = hi / 16
        lo, hi = (middle, hi) if test(middle) else (lo, middle)
        if hi < Fraction(1, 10**15):
            return None
    while hi - lo > lo * _SHARP:
        middle = _between(lo, hi)
        lo, hi = (middle, hi) if test(middle) else (lo, middle)
    simple = hi.limit_denominator(10**6)
    return simple if lo < simple and touching(simple) else lo


def _between(lo: Fraction, hi: Fraction) -> Fraction:
    middle = (lo + hi) / 2
    short = middle.limit_denominator(max(10**6, round(10**12 / float(hi))))
    return short if lo < short < hi else middle
