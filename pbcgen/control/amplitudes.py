"""From actuator limits to amplitudes: how far the saturated terms of each input may reach, exactly.

An input is ``u_i = c_i + a_i``, c_i from a known range (the equilibrium input -kappa_i, or (grad V)_i over all q) and
``|a_i| <= s_i``, s_i the sum of the amplitudes alpha of its tanh terms. A limit ``row u <= b`` holds for all iff
``sum |row_i| s_i <= b - max row c`` : one linear inequality in s for each limit, with coefficients over the rationals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from pbcgen.models.design import Design
from pbcgen.models.exact import rounded_down
from pbcgen.models.gains import Vector
from pbcgen.models.limits import row_text
from pbcgen.symbolic.real import Real, lower, rational, text, upper


@dataclass(frozen=True)
class Room:
    """What one limit leaves for the amplitudes: ``sum weights_i s_i <= room``.

    Attributes:
        limit: the limit in words: ``u <= 3.1``, ``u2 + u3 <= 7.901``.
        weights: |row|, m entries.
        room: a rational that the true room does not fall below; touching the limit counts as keeping it.
    """

    limit: str
    weights: Vector
    room: Fraction

    def slack(self, amplitudes: Sequence[Fraction]) -> Fraction:
        """What is left of the room with these amplitudes."""
        return self.room - sum((w * s for w, s in zip(self.weights, amplitudes, strict=True)), Fraction(0))


def rooms(design: Design, centres: Sequence[tuple[Real, Real]]) -> list[Room]:
    """One entry for each limit of the design.

    Args:
        design: whose limits.
        centres: for each input the lowest and highest value of its offset c_i.
    """
    m, names = design.system.m, design.system.input_names
    found = []
    for i, (lo, hi) in enumerate(design.input_set.intervals):
        weights = tuple(Fraction(i == j) for j in range(m))
        if hi is not None:
            found.append(Room(f"{names[i]} <= {text(rational(hi))}", weights, hi - upper(centres[i][1])))
        if lo is not None:
            found.append(Room(f"{names[i]} >= {text(rational(lo))}", weights, lower(centres[i][0]) - lo))
    for row, bound in zip(design.input_set.A, design.input_set.b, strict=True):
        reach = sum(
            (a * upper(hi) if a > 0 else a * lower(lo) for a, (lo, hi) in zip(row, centres, strict=True)), Fraction(0)
        )
        label = f"{row_text(row, names)} <= {text(rational(bound))}"
        found.append(Room(label, tuple(abs(a) for a in row), bound - reach))
    return found


def blocking(limits: Sequence[Room]) -> Room | None:
    """The limit that leaves no room at all, or None: then some positive amplitudes exist."""
    closed = [room for room in limits if room.room <= 0]
    return min(closed, key=lambda room: room.room, default=None)


def largest_amplitudes(limits: Sequence[Room], wanted: Sequence[Fraction]) -> Vector | None:
    """Amplitudes s > 0 as large as the limits allow: first in the ratio ``wanted``, then each as far as it goes.

    A linear program in double precision proposes them; they are rounded down to four digits and every limit is
    checked again over the rationals. None if a limit leaves no room.

    Args:
        limits: from :func:`rooms`; an input that none of them bounds keeps its wanted amplitude.
        wanted: the ratio, m positive numbers.
    """
    from scipy.optimize import linprog

    if blocking(limits) is not None:
        return None
    m = len(wanted)
    free = [i for i in range(m) if not any(room.weights[i] for room in limits)]
    if not limits or len(free) == m:
        return tuple(wanted)
    A = np.array([[float(w) for w in room.weights] for room in limits])
    b = np.array([float(room.room) for room in limits])
    ratio = np.array([float(w) for w in wanted])
    common = float(np.min(b / np.maximum(A @ ratio, 1e-300)))
    bounds = [
        (float(w), float(w)) if i in free else (common * float(w) * (1 - 1e-12), None) for i, w in enumerate(wanted)
    ]
    solution = linprog(-np.ones(m), A_ub=A, b_ub=b, bounds=bounds, method="highs")
    start = solution.x if solution.status == 0 else common * ratio
    proposed = tuple(wanted[i] if i in free else rounded_down(Fraction(float(v)), 4) for i, v in enumerate(start))
    while any(room.slack(proposed) < 0 for room in limits):
        proposed = tuple(s if i in free else rounded_down(s * Fraction(9999, 10000), 4) for i, s in enumerate(proposed))
    return proposed
