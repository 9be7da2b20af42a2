"""Proofs that no gamma exists near x*, whatever w and D, from the response of the linearised system.

Let ``e = grad S``, ``A = d(f + g u*)/dx`` and ``b = g u*`` at x*, where ``f + g u* = 0``. If [A, g] has rank n there
and Z(x) >= 0 near x* for some gamma, then for every omega > 0 for which the inverse exists

    e^T z >= 0   with   z = (A^2 + omega^2 I)^-1 b.

Proof. ``[1, u]^T Z [1, u] = r^T (f + g u)`` with ``r(x, u) = (grad gamma) u - grad S`` is nowhere negative near x*, and
zero at (x*, u*). So its gradient ``[A, g]^T r`` vanishes there, and by the rank r does: ``(grad gamma) u* = e``. Then
its second derivative in a direction (a, d), which is not negative, is twice

    q(a, d) = (H a + (grad gamma) d)^T (A a + g d),   H = hess(gamma^T u* - S) at x*, a symmetric matrix.

With ``(a, d) = (-A z, u*)`` the second factor is ``b - A^2 z = omega^2 z``, with ``(-omega z, 0)`` it is
``-omega A z``. The sum of the two is ``omega^2 (-z^T A^T H z + e^T z + z^T H A z) = omega^2 e^T z``.

In words: the energy that u* supplies at rest tells how gamma must rise along u*, and the linearised system would have
to be passive from u to the rate of that. ``b = 0`` or ``e = 0`` says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import casadi as ca
import numpy as np
from flint import arb

from pbcgen.passivity.plant import Plant, Point
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_definite
from pbcgen.symbolic.real import BITS, Real, is_finite, precision, rational, sign
from pbcgen.symbolic.real_matrices import RealMatrix, as_balls, as_floats, diagonal, multiply, transpose

#: Systems with more states are not looked at.
_MOST_STATES: Final = 40
#: Frequencies looked at, beyond the slowest and the fastest mode by this factor; the worst are tried in balls.
_FREQUENCIES, _BEYOND, _TRIED = 120, 100.0, 5


@dataclass(frozen=True)
class Response:
    """A frequency in rad/s, and ``e^T (A^2 + omega^2 I)^-1 g u*`` there, which is certainly negative."""

    omega: Fraction
    value: Real


def negative_response(plant: Plant, point: Point) -> Response | None:
    """A frequency at which the system contradicts every gamma, or None if none was found."""
    system = plant.system
    if system.n > _MOST_STATES:
        return None
    entries = plant.at(point, ca.densify(ca.jacobian(system.xdot, system.x)), system.g, plant.gradient)
    if not all(is_finite(v) for matrix in entries for row in matrix for v in row):
        return None
    A, g, e = entries
    if not has_full_rank(A, g):
        return None
    with precision(BITS):
        b = multiply(g, [[u] for u in point.u])
        for omega in _proposals(A, b, e):
            value = _value(A, b, e, omega)
            if value is not None and sign(value) == -1:
                return Response(omega, value)
    return None


def has_full_rank(A: RealMatrix, g: RealMatrix) -> bool:
    """Whether [A, g] certainly has as many independent columns as rows: the inputs reach every mode at rest."""
    with precision(BITS):
        joined = [[*row, *inputs] for row, inputs in zip(A, g, strict=True)]
        return positive_definite(multiply(joined, transpose(joined))).status is Status.PROVED


def _value(A: RealMatrix, b: RealMatrix, e: RealMatrix, omega: Fraction) -> arb | None:
    """``e^T z``, in balls; None where the inverse may not exist."""
    matrix, square = as_balls(A), rational(omega * omega)
    shifted = matrix * matrix + as_balls(diagonal([square] * len(A)))
    try:
        z = shifted.solve(as_balls(b))
    except (ValueError, ZeroDivisionError):
        return None
    return sum((arb(row[0]) * z[i, 0] for i, row in enumerate(e)), arb(0))


def _proposals(A: RealMatrix, b: RealMatrix, e: RealMatrix) -> list[Fraction]:
    """Frequencies in two digits, those first at which the value is most negative beside its terms, in doubles."""
    matrix, right, left = as_floats(A), as_floats(b)[:, 0], as_floats(e)[:, 0]
    speeds = [abs(v) for v in np.linalg.eigvals(matrix) if abs(v) > 0]
    if not speeds or not np.any(right) or not np.any(left):
        return []
    found: list[tuple[float, float]] = []
    for omega in np.geomspace(min(speeds) / _BEYOND, max(speeds) * _BEYOND, _FREQUENCIES):
        try:
            terms = left * np.linalg.solve(matrix @ matrix + omega**2 * np.eye(len(matrix)), right)
        except np.linalg.LinAlgError:
            continue
        size = float(np.sum(np.abs(terms)))
        if size > 0 and np.isfinite(size) and float(np.sum(terms)) < 0:
            found.append((float(np.sum(terms)) / size, float(omega)))
    return [Fraction(f"{omega:.1e}") for _, omega in sorted(found)[:_TRIED]]
