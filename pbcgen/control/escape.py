"""States from which a saturated law cannot bring the plant back: then x* does not attract from everywhere.

Let ``x' = A x + b(x) + g(x) u`` with b and g bounded, and u bounded because the law saturates. For an eigenvalue
lambda of A with Re lambda > 0 and a left eigenvector w, ``s = w^H x`` obeys ``|s|' >= Re lambda |s| - C`` with a
constant C: it grows without end from every state at which ``|s|`` is large enough, whatever the gains are.
"""

from __future__ import annotations

from fractions import Fraction

from flint import fmpq

from pbcgen.control.situation import Situation
from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.plant import Plant
from pbcgen.proof.claim import Status
from pbcgen.proof.extrema import term_bounds
from pbcgen.proof.spectrum import hurwitz
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real_matrices import RealMatrix


def growth_rate(situation: Situation) -> Fraction | None:
    """A positive number that the real part of an eigenvalue of A exceeds, or None if there is none or b is not bounded.

    A compensated force is not bounded by the law's amplitudes, and a domain has no states far away.
    """
    system = situation.plant.system
    if situation.compensation is not None or system.domain:
        return None
    try:
        A = _linear_part(situation.plant)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    if A is None:
        return None
    extreme = hurwitz(A).extreme
    if not extreme > 0:
        return None
    rate = Fraction(extreme / 2).limit_denominator(10**6) or Fraction(extreme / 2)
    shift = fmpq(rate.numerator, rate.denominator)
    shifted: RealMatrix = [[v - shift if i == j else v for j, v in enumerate(row)] for i, row in enumerate(A)]
    return rate if hurwitz(shifted).status is Status.REFUTED else None


def _linear_part(plant: Plant) -> RealMatrix | None:
    """A, where f - A x and g are bounded on the whole space; else None."""
    system = plant.system
    field, (f, g) = plant.exact(system.f, system.g)
    zero = field.const(0)
    if any(not _bounded(entry) for row in g.dense(zero) for entry in row):
        return None
    A: RealMatrix = []
    for value in f.column(zero):
        if not value.is_polynomial():
            return None
        row, rest = [fmpq(0)] * system.n, {}
        for exponents, c in value.numerator.to_dict().items():
            used = [k for k, e in enumerate(exponents) for _ in range(int(e))]
            if len(used) == 1 and used[0] < system.n:
                row[used[0]] += c
            else:
                rest[exponents] = c
        if rest and not _bounded(field.polynomial(field.context.from_dict(rest))):
            return None
        A.append(list(row))
    return A


def _bounded(value: Quotient) -> bool:
    bounds = term_bounds(value, {})
    return bounds.lo is not None and bounds.hi is not None
