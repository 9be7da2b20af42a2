"""The linearised closed loop as a function of the gains: plant and target fixed, the law free.

At the target every tanh has slope one, so with ``A = diag(alpha beta)`` and ``dg = (grad gamma)^T dx`` the laws are

    x_c' = -R_c (A_c (dg + x_c) + K_c x_c),           u_c = -A_c (dg + x_c)          (uc), (dxc)
    x_l' = -R_l A_l (Upsilon de + K_l x_l),           u_l = -A_l (Upsilon de + K_l x_l)   (ulc), (dxl)
    psi' = -R_psi psi + A_psi dg,                     u_psi = -A_psi psi             (conint), (dpsi)
    y = (I + W k_p)^{-1} (C_y - W A (grad gamma)^T) dx,   u = -A dg - k_p y          (u)

and potential compensation adds (hess V) dq to u. Everything is exact or enclosed.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from pbcgen.models.gains import Matrix, Vector
from pbcgen.models.laws import (
    Integral,
    Law,
    NaturalDamping,
    PassiveOutput,
    PotentialCompensation,
    Shaping,
    base_law,
    shaping,
)
from pbcgen.passivity.local import Local
from pbcgen.passivity.plant import Plant, Point
from pbcgen.sampling.transition import LinearLoop
from pbcgen.symbolic.real import BITS, ONE, ZERO, Real, precision, rational
from pbcgen.symbolic.real_matrices import RealMatrix, add, diagonal, exact_matrix, inverse, multiply


@dataclass(frozen=True, eq=False)
class LoopFamily:
    """What of plant and target enters the linearised loop, whatever the gains.

    Attributes:
        A: d(f + g u)/dx, n x n. B: g, n x m.
        gamma: (grad gamma)^T, m x n. eta: (grad eta)^T, s x n, or None.
        potential: hess V over x, m x n; zero unless the law compensates.
        rate: dy/dx at constant u, m x n. feedthrough: W = dy/du, m x m.
    """

    A: RealMatrix
    B: RealMatrix
    gamma: RealMatrix
    eta: RealMatrix | None
    potential: RealMatrix
    rate: RealMatrix
    feedthrough: RealMatrix

    @staticmethod
    def of(plant: Plant, point: Point, gamma: ca.SX, eta: ca.SX | None) -> LoopFamily:
        """Linearise plant, gamma and eta at the target."""
        system = plant.system
        slope = ca.jacobian(gamma, system.x)
        mechanics = system.mechanical
        potential = ca.SX(system.m, system.n)
        if mechanics is not None and mechanics.G.shape == (system.m, system.m):
            potential = ca.jacobian(ca.gradient(mechanics.V, mechanics.q), system.x)
        signals = eta if eta is not None else ca.SX(0, 1)
        local = Local.of(plant, point)
        A, B, gamma_x, potential_x, eta_x = local.at(
            ca.jacobian(local.xdot, system.x), system.g, slope, potential, ca.jacobian(signals, system.x)
        )
        with precision(BITS):
            y_x, y_u = multiply(gamma_x, A), multiply(gamma_x, B)  # y = grad gamma^T x', and x' = 0 at the target
        return LoopFamily(A, B, gamma_x, eta_x if eta is not None else None, potential_x, y_x, y_u)

    def loop(self, law: Law) -> LinearLoop:
        """The loop with a law whose gains are resolved; its measurement is x. Raises ValueError if eta is missing."""
        with precision(BITS):
            base = base_law(law)
            if isinstance(base, PassiveOutput):
                return self._passive_output(base)
            parts = [self._filter(shaping(base), base.K_c, base.R_c)]
            if isinstance(base, NaturalDamping):
                parts.append(self._natural(base))
            if isinstance(law, Integral):
                parts.append(self._integral(law))
            u_x = [p[2] for p in parts]
            total = u_x[0]
            for more in u_x[1:]:
                total = add(total, more)
            if isinstance(base, PotentialCompensation):
                total = add(total, self.potential)
            n = len(self.A)
            return LinearLoop(
                self.A,
                self.B,
                diagonal([ONE] * n),
                [row for p in parts for row in p[0]],
                _blocks([p[1] for p in parts]),
                total,
                [[v for p in parts for v in p[3][i]] for i in range(len(total))],
            )

    def _filter(self, term: Shaping, K: Matrix, R: Matrix) -> _Part:
        stiffness = diagonal([rational(v) for v in term.stiffness])
        R_c = exact_matrix(R)
        return (
            _negative(multiply(multiply(R_c, stiffness), self.gamma)),
            _negative(multiply(R_c, add(stiffness, exact_matrix(K)))),
            _negative(multiply(stiffness, self.gamma)),
            _negative(stiffness),
        )

    def _natural(self, law: NaturalDamping) -> _Part:
        if self.eta is None or law.Upsilon is None:
            raise ValueError("natural-damping needs eta")
        stiffness = _products(law.alpha_l, law.beta_l)
        signal = multiply(exact_matrix(law.Upsilon), self.eta)
        R, K = exact_matrix(law.R_l), exact_matrix(law.K_l)
        return (
            _negative(multiply(multiply(R, stiffness), signal)),
            _negative(multiply(multiply(R, stiffness), K)),
            _negative(multiply(stiffness, signal)),
            _negative(multiply(stiffness, K)),
        )

    def _integral(self, law: Integral) -> _Part:
        stiffness = _products(law.alpha_psi, law.beta_psi)
        m, n = len(stiffness), len(self.A)
        return (
            multiply(stiffness, self.gamma),
            _negative(exact_matrix(law.R_psi)),
            [[ZERO] * n for _ in range(m)],
            _negative(stiffness),
        )

    def _passive_output(self, law: PassiveOutput) -> LinearLoop:
        n, m = len(self.A), len(self.B[0])
        pull = multiply(_products(law.alpha, law.beta), self.gamma)
        k_p = diagonal([rational(v) for v in law.k_p])
        loop = inverse(add(diagonal([ONE] * m), multiply(self.feedthrough, k_p)))
        if loop is None:
            raise ZeroDivisionError("the algebraic loop of the law may be singular")
        y_x = multiply(loop, add(self.rate, _negative(multiply(self.feedthrough, pull))))
        u_x = _negative(add(pull, multiply(k_p, y_x)))
        return LinearLoop(self.A, self.B, diagonal([ONE] * n), [], [], u_x, [[] for _ in range(m)])


#: Rows of xi' over x, xi' over xi, u over x, u over xi.
_Part = tuple[RealMatrix, RealMatrix, RealMatrix, RealMatrix]


def _products(a: Vector, b: Vector) -> RealMatrix:
    return diagonal([rational(x * y) for x, y in zip(a, b, strict=True)])


def _negative(a: RealMatrix) -> RealMatrix:
    return [[-v for v in row] for row in a]


def _blocks(parts: list[RealMatrix]) -> RealMatrix:
    size = sum(len(p) for p in parts)
    rows: RealMatrix = []
    start = 0
    for part in parts:
        for row in part:
            full: list[Real] = [ZERO] * size
            full[start : start + len(row)] = row
            rows.append(full)
        start += len(part)
    return rows
