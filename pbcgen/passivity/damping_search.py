"""Looking for states at which natural damping is missing (Assumption 3) or too weak for the gains (Theta).

The dissipation is ``u^T y - S' = |l + w u|^2``. Positive Lambda_l and Lambda_c cannot exist where it is zero, or even
negative, while eta' or y is not. Theta is the form ``|l + w u|^2 + w_l^T K_l R_l w_l + w_l^T (Upsilon eta' - y)`` with
x_l' = R_l w_l; its least value over w_l is ``|l + w u|^2 - |Upsilon eta' - y|^2_{(4 K_l R_l)^{-1}}``. Both are searched
for over states and inputs, and what is found is checked at a rational point.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.gains import Matrix
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.region import Region, search_with_inputs
from pbcgen.passivity.structure import PowerStructure
from pbcgen.symbolic.real import BITS, Real, is_finite, precision, rational, sign, text

#: Damping below this, relative to the rates, is looked at more closely.
_WEAK = Fraction(1, 10**6)
Floats = NDArray[np.float64]

#: Denominators of states at which something may vanish exactly.
_SIMPLE = 10**6
#: Sizes of the flows that are aimed at, states to start from for each, Newton steps, and how near they must come.
_SIZES, _STARTS, _STEPS, _NEAR = (1.0, 1e-2, 1e-4, 1e-6, 1e3, 1e8, 1e12), 3, 30, 1e-9


@dataclass(frozen=True)
class Finding:
    """A state and an input.

    Attributes:
        values: them, by name.
        dissipation: ``u^T y - S'`` there.
        shows: whether it is certainly zero or negative (or Theta certainly negative), or only small.
    """

    values: dict[str, str]
    dissipation: str
    shows: bool


@dataclass(frozen=True, eq=False)
class Port:
    """The rates and the dissipation as expressions of x, u and the parameters."""

    plant: Plant
    region: Region
    eta_rate: ca.SX
    y: ca.SX
    gamma: ca.SX
    eta: ca.SX | None

    @staticmethod
    def of(plant: Plant, region: Region, gamma: ca.SX, eta: ca.SX | None) -> Port:
        """For the given gamma, and eta if there is one."""
        x, xdot = plant.system.x, plant.system.xdot
        rate = ca.SX(0, 1) if eta is None else ca.mtimes(ca.jacobian(eta, x), xdot)
        return Port(plant, region, rate, ca.mtimes(ca.jacobian(gamma, x), xdot), gamma, eta)

    @property
    def dissipation(self) -> ca.SX:
        """``u^T y - S'``."""
        system = self.plant.system
        return ca.dot(system.u, self.y) - ca.dot(self.plant.gradient, system.xdot)

    def undamped(self, never_negative: bool) -> Finding | None:
        """Where the dissipation is zero, negative, or hardly there although eta' or y is not zero.

        Args:
            never_negative: whether it is known that the dissipation is not negative.
        """
        rates = ca.sumsqr(self.eta_rate) + ca.sumsqr(self.y)
        found = None if never_negative else self._search(self.dissipation, rates)
        found = found or self._search(self.dissipation - self.plant.number(_WEAK) * rates, rates)
        return None if found is None else self._judged(found[0], rates)

    def undamped_along(self, structure: PowerStructure, flow: Floats) -> Finding | None:
        """Where the dissipation is zero although y is not, and its vector v is a multiple of ``flow``."""
        found = (self._judged(point, ca.sumsqr(self.y)) for point in self._along(structure, flow))
        return next((finding for finding in found if finding.shows), None)

    def _judged(self, point: Sequence[Fraction], rates: ca.SX) -> Finding:
        """The dissipation at a state and an input, and whether it is certainly not enough for the rates."""
        loss, moving = self._at(point, self.dissipation, rates)
        return Finding(self._named(point), text(loss, 9), sign(loss) in (0, -1) and sign(moving) == 1)

    def _at(self, point: Sequence[Fraction], *values: ca.SX) -> list[Real]:
        """Scalars at a state and an input."""
        n = self.plant.system.n
        with precision(BITS):
            x, u = [rational(v) for v in point[:n]], [rational(v) for v in point[n:]]
            return [matrix[0][0] for matrix in self.plant.walk(self.plant.tape(*values), x, u)]

    def theta_negative(self, upsilon: Matrix, product: Sequence[Fraction]) -> Finding | None:
        """Where Theta is certainly negative, with its value for the dissipation."""
        found = self._search(*self._theta(upsilon, product))
        return None if found is None else Finding(self._named(found[0]), found[1], True)

    def theta_negative_along(
        self, upsilon: Matrix, product: Sequence[Fraction], structure: PowerStructure, flow: Floats
    ) -> Finding | None:
        """The same where the vector v of the dissipation is a multiple of ``flow`` but for what is not dissipated."""
        value = self._theta(upsilon, product)[0]
        for point in self._along(structure, flow):
            (form,) = self._at(point, value)
            if is_finite(form) and sign(form) == -1:
                return Finding(self._named(point), text(form, 9), True)
        return None

    def _theta(self, upsilon: Matrix, product: Sequence[Fraction]) -> tuple[ca.SX, ca.SX]:
        """The least value of Theta over x_l', and what it is judged by."""
        gains = [ca.SX(0, 1) if not row else ca.horzcat(*[self.plant.number(v) for v in row]) for row in upsilon]
        excess = ca.mtimes(ca.vertcat(*gains), self.eta_rate) - self.y
        supplied = sum((excess[i] ** 2 * self.plant.number(1 / (4 * k)) for i, k in enumerate(product)), ca.SX(0))
        return self.dissipation - supplied, ca.sumsqr(excess)

    def _along(self, structure: PowerStructure, flow: Floats) -> Iterator[tuple[Fraction, ...]]:
        """States of the region and inputs with such a v and its y, rounded, by Newton's method from a few states."""
        system, generator = self.plant.system, np.random.default_rng(5)
        v, psi = system.xdot, ca.jacobian(self.gamma, system.x)
        rows = ca.vertcat(structure.dissipation(), psi)
        if structure.form == "F":
            v = self.plant.gradient - ca.mtimes(psi.T, system.u)
            rows = ca.vertcat(structure.dissipation(), ca.mtimes(psi, structure.matrix))
        aimed, z = ca.mtimes(rows, v), ca.vertcat(system.x, system.u)
        function = self.plant.doubles(aimed, ca.jacobian(aimed, z), rows)
        ends = [(lo if lo is not None else -1, hi if hi is not None else 1) for lo, hi in self.region.bounds]
        lower, upper = (np.array([float(end[k]) for end in (*ends, *[(-1, 1)] * system.m)]) for k in (0, 1))
        middle = (lower + upper) / 2
        for size in _SIZES:
            for k in range(_STARTS):
                at = middle + k * (generator.uniform(lower, upper) - middle) / _STARTS
                for _ in range(_STEPS):
                    value, slope, matrix = function(at[: system.n], at[system.n :])
                    wanted = size * matrix @ flow
                    left = np.ravel(value) - wanted
                    if not np.all(np.isfinite(left)) or not np.all(np.isfinite(slope)):
                        break
                    if np.linalg.norm(left) <= _NEAR * np.linalg.norm(wanted):
                        break
                    at = at - np.linalg.lstsq(slope, left, rcond=None)[0]
                if np.all(np.isfinite(at)):
                    simple = tuple(Fraction(value).limit_denominator(_SIMPLE) for value in at)
                    for point in (simple, tuple(Fraction(f"{value:.16e}") for value in at)):
                        if self.region.contains(point[: system.n]):
                            yield point

    def _search(self, value: ca.SX, scale: ca.SX) -> tuple[tuple[Fraction, ...], str] | None:
        try:
            found = search_with_inputs(self.plant, self.region, value, scale)
        except UnsupportedOperation:
            return None
        if found.point is None or found.value is None:
            return None
        return found.point, text(found.value, 9)

    def _named(self, point: Sequence[Fraction]) -> dict[str, str]:
        names = (*self.plant.system.state_names, *self.plant.system.input_names)
        return {name: text(rational(v), 25) for name, v in zip(names, point, strict=True)}
