"""Looking for states at which natural damping is missing (Assumption 3) or too weak for the gains (Theta).

The dissipation is ``u^T y - S' = |l + w u|^2``. Positive Lambda_l and Lambda_c cannot exist where it is zero, or even
negative, while eta' or y is not. Theta is the form ``|l + w u|^2 + w_l^T K_l R_l w_l + w_l^T (Upsilon eta' - y)`` with
x_l' = R_l w_l; its least value over w_l is ``|l + w u|^2 - |Upsilon eta' - y|^2_{(4 K_l R_l)^{-1}}``. Both are searched
for over states and inputs, and what is found is checked at a rational point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.gains import Matrix
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.region import Region, search_with_inputs
from pbcgen.symbolic.real import BITS, precision, rational, sign, text

#: Damping below this, relative to the rates, is looked at more closely.
_WEAK = Fraction(1, 10**6)


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
        if found is None:
            return None
        point, _ = found
        n = self.plant.system.n
        tape = self.plant.tape(self.dissipation, rates)
        with precision(BITS):
            x, u = [rational(v) for v in point[:n]], [rational(v) for v in point[n:]]
            loss, moving = (matrix[0][0] for matrix in self.plant.walk(tape, x, u))
            return Finding(self._named(point), text(loss, 9), sign(loss) in (0, -1) and sign(moving) == 1)

    def theta_negative(self, upsilon: Matrix, product: Sequence[Fraction]) -> Finding | None:
        """Where Theta is certainly negative, with its value for the dissipation."""
        gains = [ca.SX(0, 1) if not row else ca.horzcat(*[self.plant.number(v) for v in row]) for row in upsilon]
        excess = ca.mtimes(ca.vertcat(*gains), self.eta_rate) - self.y
        supplied = sum((excess[i] ** 2 * self.plant.number(1 / (4 * k)) for i, k in enumerate(product)), ca.SX(0))
        found = self._search(self.dissipation - supplied, ca.sumsqr(excess))
        return None if found is None else Finding(self._named(found[0]), found[1], True)

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
