"""Constants of Assumption 3 where the dissipation or the outputs vary with the state, on the whole space or on a box.

With ``v^T B(x) v`` lost and rates ``R(x) v`` of (eta, gamma), ``diag(Lambda)`` is found when

    B(x) - R(x)^T diag(Lambda) R(x) >= 0   for all x of the region.

At one state that holds iff ``diag(Lambda)^{-1} >= W = R B^+ R^T``. States of the region propose the constants; that
they hold everywhere is then proved from scratch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import floor, isfinite, log10

import casadi as ca
import numpy as np
from flint import fmpq
from numpy.typing import NDArray

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.exact import rounded_down
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.region import Region
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.branch import Budget
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_semidefinite
from pbcgen.proof.elimination import semidefinite
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import approximate, fraction, rational
from pbcgen.symbolic.real_matrices import RealMatrix

Floats = NDArray[np.float64]

#: States at which constants are proposed, and how far they lie where the region is unbounded.
_SAMPLES = 200
_SPREAD = 10.0
#: What is left of the proposed constants when they are not proved as they are.
_PARTS = (Fraction(1), Fraction(999, 1000), Fraction(9, 10), Fraction(1, 2), Fraction(1, 10))
#: A row lies in the range of the dissipation when its rest is smaller, relative to the row.
_OUTSIDE = 1e-9
#: Systems with more states are not searched.
_MOST = 12


@dataclass(frozen=True)
class Bounds:
    """Positions of the signals that are damped, and Lambda for them and for the outputs."""

    chosen: tuple[int, ...]
    Lambda: tuple[fmpq, ...]


def bounds_on(
    plant: Plant, structure: PowerStructure, gamma: ca.SX, signals: Sequence[ca.SX], region: Region, all_signals: bool
) -> Bounds | None:
    """Signals that the dissipation damps everywhere on the region, at most n - m, with constants; None if none are.

    Args:
        plant: the system.
        structure: a power structure whose identity holds, and that gives gamma.
        gamma: m x 1.
        signals: scalar functions of the state that may be damped, in the order of preference.
        region: where.
        all_signals: whether every signal has to be damped.
    """
    system = plant.system
    if not signals or system.n > _MOST:
        return None
    work = _Work(plant, structure, gamma, list(signals), region)
    try:
        usable = work.usable()
        chosen = [k for k in usable if work.proposal([k]) is not None][: system.n - system.m]
        if not chosen or (all_signals and len(chosen) < len(signals)):
            return None
        compliance = work.proposal(chosen)
        proposed = [] if compliance is None else [1 / v for v in compliance]
        for candidate in _rounded(proposed):
            if work.proved(chosen, _diagonal(candidate)):
                return Bounds(tuple(chosen), tuple(rational(v) for v in candidate))
    except (UnsupportedOperation, ZeroDivisionError):
        pass
    return None


def exceeds(
    plant: Plant, structure: PowerStructure, gamma: ca.SX, eta: ca.SX, Lambda: RealMatrix, region: Region
) -> bool:
    """Whether ``|l + w u|^2 >= |(eta', y)|^2_Lambda`` is proved on the region; Lambda is symmetric, of any sign.

    The structure must hold, give gamma, and leave eta to itself, as for :func:`bounds_on`.
    """
    if plant.system.n > _MOST or not all(isinstance(v, fmpq) for row in Lambda for v in row):
        return False
    signals = ca.vertsplit(eta)
    work = _Work(plant, structure, gamma, signals, region)
    try:
        rational_ = [[fraction(v) for v in row] for row in Lambda]
        return work.proved(range(len(signals)), rational_)
    except (UnsupportedOperation, ZeroDivisionError):
        return False


def _diagonal(values: Sequence[Fraction]) -> list[list[Fraction]]:
    return [[v if i == j else Fraction(0) for j, _ in enumerate(values)] for i, v in enumerate(values)]


class _Work:
    """The dissipation and the rates as functions of the state."""

    def __init__(
        self, plant: Plant, structure: PowerStructure, gamma: ca.SX, signals: list[ca.SX], region: Region
    ) -> None:
        system = plant.system
        self.plant, self.region, self.count = plant, region, len(signals)
        self.psi = ca.jacobian(gamma, system.x)
        self.slopes = ca.jacobian(ca.vertcat(*signals), system.x)
        stacked = ca.vertcat(self.slopes, self.psi)
        self.rows = ca.mtimes(stacked, structure.matrix) if structure.form == "F" else stacked
        self.dissipation = structure.dissipation()
        self.remainder = structure.remainder

    def usable(self) -> list[int]:
        """The signals that gamma and the friction beside the structure leave alone."""
        overlap = ca.mtimes(self.slopes, self.psi.T)
        field, (o, friction) = self.plant.exact(overlap, ca.mtimes(self.slopes, self.remainder))
        zero = field.const(0)
        dense, rest = o.dense(zero), friction.column(zero)
        return [k for k in range(self.count) if rest[k].is_zero() and all(v.is_zero() for v in dense[k])]

    @cached_property
    def values(self) -> list[tuple[Floats, Floats]]:
        """The dissipation and the rows at states of the region."""
        system, generator = self.plant.system, np.random.default_rng(3)
        function = self.plant.doubles(self.dissipation, self.rows)
        ends = [
            (-_SPREAD if lo is None else float(lo), _SPREAD if hi is None else float(hi))
            for lo, hi in self.region.bounds
        ]
        ends = [(lo, max(lo, hi)) for lo, hi in ends]
        lower, upper = (np.array(side) for side in zip(*ends, strict=True))
        share = generator.uniform(0, 1, (_SAMPLES, system.n))
        share[: _SAMPLES // 2] = np.round(share[: _SAMPLES // 2] * 2) / 2
        found = []
        for point in lower + share * (upper - lower):
            B, rows = function(point, np.zeros(system.m))
            if np.all(np.isfinite(B)) and np.all(np.isfinite(rows)):
                found.append((B, rows))
        return found

    def proposal(self, chosen: Sequence[int]) -> list[float] | None:
        """The diagonal of a matrix above the compliance at every sample, or None where a row is not damped."""
        picked = [*chosen, *range(self.count, self.rows.shape[0])]
        found: list[Floats] = []
        for B, rows in self.values:
            C = rows[picked]
            inverse = np.linalg.pinv(B, hermitian=True)
            if np.any(np.abs(C - C @ inverse @ B) > _OUTSIDE * (1 + np.abs(C))):
                return None
            found.append(C @ inverse @ C.T)
        if not found:
            return None
        sizes = np.max([np.sum(np.abs(W), axis=1) for W in found], axis=0)
        if not np.all(sizes > 0) or not np.all(np.isfinite(sizes)):
            return None
        root = np.sqrt(sizes)
        share = max(float(np.linalg.eigvalsh(W / np.outer(root, root))[-1]) for W in found)
        return [float(v) * share for v in sizes]

    def proved(self, chosen: Sequence[int], Lambda: Sequence[Sequence[Fraction]]) -> bool:
        """Whether ``B - R^T Lambda R >= 0`` and ``rho^T grad S >= 0`` on the region."""
        friction = ca.dot(self.remainder, self.plant.gradient)
        field, (B, rows, rest) = self.plant.exact(self.dissipation, self.rows, friction)
        zero = field.const(0)
        if not self.region.prover(Budget()).nonnegative(rest.scalar(zero)):
            return False
        dense, signals = B.dense(zero), rows.dense(zero)
        picked = [signals[k] for k in (*chosen, *range(self.count, len(signals)))]

        def entry(i: int, j: int) -> Quotient:
            total: Quotient = dense[i][j]
            for weights, left in zip(Lambda, picked, strict=True):
                for weight, right in zip(weights, picked, strict=True):
                    if weight and not (left[i].is_zero() or right[j].is_zero()):
                        total = total - field.const(weight) * left[i] * right[j]
            return total

        size = range(len(dense))
        left = [[entry(i, j) for j in size] for i in size]
        return semidefinite(left, prover=self.region.prover(Budget()))


def _rounded(proposed: Sequence[float]) -> Iterator[list[Fraction]]:
    """Positive fractions with few digits, at the proposed constants first, then below."""
    if not proposed or not all(isfinite(v) and v > 0 for v in proposed):
        return
    for tolerance in (1e-9, 1e-2):
        yield [_near(v, tolerance) for v in proposed]
    for part in _PARTS[1:]:
        yield [rounded_down(Fraction(v * float(part)), 3) for v in proposed]


def _near(value: float, tolerance: float) -> Fraction:
    """The simplest fraction within the relative tolerance, else a decimal below."""
    for digits in range(1, 7):
        simple = Fraction(value).limit_denominator(10**digits)
        if simple > 0 and abs(float(simple) - value) <= tolerance * value:
            return simple
    return rounded_down(Fraction(value), 3)


def tightened(W: RealMatrix, diagonal: Sequence[fmpq]) -> list[fmpq]:
    """A multiple of the diagonal matrix that is still ``>= W``, as small as goes in three digits, or itself."""
    root = np.sqrt([approximate(v) for v in diagonal])
    scaled = np.array([[approximate(v) for v in row] for row in W]) / np.outer(root, root)
    share = float(np.linalg.eigvalsh(scaled)[-1])
    if not 0 < share < 1:
        return list(diagonal)
    smaller = rational(rounded_down(Fraction(share), 3) + Fraction(10) ** (floor(log10(share)) - 2))
    result = [v * smaller for v in diagonal]
    excess = [
        [(d if i == j else fmpq(0)) - v for j, v in enumerate(row)]
        for i, (d, row) in enumerate(zip(result, W, strict=True))
    ]
    return result if smaller < 1 and positive_semidefinite(excess).status is Status.PROVED else list(diagonal)
