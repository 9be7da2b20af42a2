"""Proofs that no gamma exists, whatever w and D, from the response of the system linearised at a rest.

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
to be passive from u to the rate of that. ``b = 0`` or ``e = 0`` says nothing; but any rest inside of the domain will do
in place of the target, so that others are looked at, which other inputs hold, in enclosures that Krawczyk's test gives.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from typing import Final, TypeAlias

import casadi as ca
import numpy as np
from flint import arb
from numpy.typing import NDArray

from pbcgen.passivity.plant import Plant, Point
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_definite
from pbcgen.proof.newton import float_newton, krawczyk, polish
from pbcgen.symbolic.real import BITS, Real, approximate, is_finite, lower, precision, rational, sign, upper
from pbcgen.symbolic.real_matrices import RealMatrix, as_balls, as_floats, diagonal, multiply, transpose

Floats: TypeAlias = NDArray[np.float64]

#: Systems with more states are not looked at.
_MOST_STATES: Final = 40
#: Frequencies looked at, beyond the slowest and the fastest mode by this factor; the worst are tried in balls.
_FREQUENCIES, _BEYOND, _TRIED = 120, 100.0, 5
#: Inputs of other rests differ from that of x* by such shares of its size, or of 1 where it is zero.
_SHARES: Final = (Fraction(1, 10), Fraction(1, 2), Fraction(2))


@dataclass(frozen=True)
class Response:
    """A rest, a frequency in rad/s, and ``e^T (A^2 + omega^2 I)^-1 g u`` there, which is certainly negative."""

    point: Point
    omega: Fraction
    value: Real


def negative_response(plant: Plant, point: Point) -> Response | None:
    """A rest and a frequency at which the system contradicts every gamma, or None if none was found.

    Args:
        plant: the system.
        point: a rest, which is looked at first; then others whose input is not far from its own.
    """
    if plant.system.n > _MOST_STATES:
        return None
    found = _at(plant, point)
    others = _other_rests(plant, point) if found is None else iter(())
    return found or next((shown for rest in others if (shown := _at(plant, rest)) is not None), None)


def _other_rests(plant: Plant, point: Point) -> Iterator[Point]:
    """Rests inside of the domain, for inputs around that of a known one, each enclosed with certainty."""
    system, n = plant.system, plant.system.n
    slope = plant.numeric(system.xdot, ca.jacobian(system.xdot, system.x))
    tape = plant.tape(system.xdot, ca.densify(ca.jacobian(system.xdot, system.x)))
    bounds = [system.domain.get(name, (None, None)) for name in system.state_names]
    start = np.array([approximate(v) for v in point.x])
    near = [Fraction(f"{approximate(v):.6e}") for v in point.u]
    size = max((abs(v) for v in near), default=Fraction(0)) or Fraction(1)
    for share in _SHARES:
        for signs in product((1, -1), repeat=min(system.m, 3)):
            u = [v + s * share * size for v, s in zip(near, (*signs, *[1] * system.m), strict=False)]
            held: list[Real] = [rational(v) for v in u]

            def roughly(z: Floats, u: list[Fraction] = u) -> tuple[Floats, Floats]:
                value, by_state = slope(z, [float(v) for v in u])
                return np.array(value)[:, 0], np.array(ca.densify(by_state))

            def rates(z: list[Real], held: list[Real] = held) -> tuple[list[Real], RealMatrix]:
                value, by_state = plant.walk(tape, z, held)
                return [row[0] for row in value], by_state

            zero = float_newton(roughly, start)
            with precision(BITS):
                centre = None if zero is None else polish(rates, zero.tolist())
                balls = None if centre is None else krawczyk(rates, centre)
            if (
                balls is not None
                and len(balls) == n
                and all(
                    (lo is None or lower(b) > lo) and (hi is None or upper(b) < hi)
                    for b, (lo, hi) in zip(balls, bounds, strict=True)
                )
            ):
                yield Point(tuple(balls), tuple(held))


def _at(plant: Plant, point: Point) -> Response | None:
    """What one rest shows."""
    system = plant.system
    slope, bends = ca.jacobian(system.xdot, system.x), ca.hessian(system.S, system.x)[0]
    entries = plant.at(point, ca.densify(slope), system.g, plant.gradient, ca.densify(bends))
    if not all(is_finite(v) for matrix in entries for row in matrix for v in row):
        return None
    A, g, e, _ = entries
    if not has_full_rank(A, g):
        return None
    with precision(BITS):
        b = multiply(g, [[u] for u in point.u])
        for omega in _proposals(A, b, e):
            value = _value(A, b, e, omega)
            if value is not None and sign(value) == -1:
                return Response(point, omega, value)
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
