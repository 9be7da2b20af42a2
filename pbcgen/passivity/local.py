"""A system around its equilibrium: f + g u to first order, S to second.

For a mechanical system p = 0 there, so terms that are quadratic in p have no slope, and M^-1 enters as the matrix of
numbers M(q*)^-1: no inverse is differentiated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
from flint import fmpq

from pbcgen.passivity.construction import drift_by_construction
from pbcgen.passivity.plant import Plant, Point
from pbcgen.symbolic.continued import continued
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, precision, reals
from pbcgen.symbolic.real_matrices import RealMatrix, inverse
from pbcgen.symbolic.tape import Matrix, Tape


@dataclass(frozen=True, eq=False)
class Local:
    """Expressions with the derivatives that the system has at x*; they are no models of it elsewhere.

    Attributes:
        plant, point: where.
        xdot: n x 1, with the Jacobian of f + g u at x*.
        S, kinetic: with the gradient and the Hessian of S and of the kinetic energy (zero if there is none) at x*.
        symbols, values: constants that occur in them.
    """

    plant: Plant
    point: Point
    xdot: ca.SX
    S: ca.SX
    kinetic: ca.SX
    symbols: ca.SX
    values: tuple[Real, ...]

    @staticmethod
    def of(plant: Plant, point: Point) -> Local:
        """The system itself where it is not mechanical, or not known to rest with p = 0."""
        system, mechanics = plant.system, plant.system.mechanical
        whole = Local(plant, point, system.xdot, system.S, ca.SX(0), ca.SX(0, 1), ())
        if mechanics is None:
            return whole
        whole = Local(plant, point, system.xdot, system.S, ca.dot(mechanics.p, mechanics.velocity) / 2, ca.SX(0, 1), ())
        n = mechanics.q.numel()
        still = all(isinstance(v, fmpq) and v == 0 for v in point.x[n:])
        if not still or not (plant.gradient_is_exact and drift_by_construction(system)):
            return whole
        (inertia,) = plant.at(point, mechanics.M)
        with precision(BITS):
            inverted = inverse(inertia)
        if inverted is None:
            return whole
        W = ca.SX.sym("W", n, n)
        velocity = ca.mtimes(W, mechanics.p)
        force = ca.mtimes(mechanics.G, system.u) - ca.gradient(mechanics.V, mechanics.q)
        kinetic = ca.dot(mechanics.p, velocity) / 2
        return Local(
            plant,
            point,
            ca.vertcat(velocity, force - ca.mtimes(mechanics.D, velocity)),
            kinetic + mechanics.V,
            kinetic,
            ca.vec(W),
            tuple(inverted[i][j] for j in range(n) for i in range(n)),
        )

    def at(self, *outputs: ca.SX) -> list[RealMatrix]:
        """The values of expressions in (x, u, parameters, symbols) at x*, dense."""
        return [matrix.dense(ZERO) for matrix in self.walk(*outputs)]

    def walk(self, *outputs: ca.SX) -> list[Matrix[Real]]:
        """The same values, sparse."""
        plant = self.plant
        tape = Tape.of([*plant.symbols, self.symbols], list(outputs))
        if plant.reads_signs(tape):
            tape = self._continued(outputs)
        numbers = plant.values
        parameters = reals([numbers[name] for name in plant.parameter_names])
        inputs: list[list[Real]] = [list(self.point.x), list(self.point.u), parameters, list(self.values)]
        with precision(BITS):
            return tape.walk(REAL, inputs)

    def _continued(self, outputs: Sequence[ca.SX]) -> Tape:
        """The tape of derivatives that are continuous although there are moduli."""
        plant, own = self.plant, [f"own {k}" for k in range(self.symbols.numel())]
        # The constants that are made on the way come last, so the symbols of x* stand before all of them.
        inputs = [plant.system.x, plant.system.u, self.symbols, plant.parameter_symbols]
        names = [*plant.system.state_names, *plant.system.input_names, *own, *plant.parameter_names]
        whole = continued(outputs, inputs, names, plant.values, plant.number)
        return Tape.of([*plant.symbols, self.symbols], whole)
