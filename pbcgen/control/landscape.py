"""The Lyapunov function over boxes of states, minimised over the filters, and the rest equations of the closed loop.

``W(x) = S(x) + kappa^T gamma(x) + e(gamma(x) - gamma*)``, e the envelope of the ln cosh terms. Enclosures are in balls.

For a mechanical system ``W(q, p) = U(q) + p^T M^{-1} p / 2``, and all equilibria have p = 0. Where M > 0 a box of
positions is therefore enough: W is above a level wherever U is, and ``{W <= c}`` is bounded in p.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import casadi as ca
import numpy as np
from flint import arb, arb_mat
from numpy.typing import NDArray

from pbcgen.control.envelope import Envelope, log_cosh
from pbcgen.control.situation import Situation
from pbcgen.models.laws import NaturalDamping
from pbcgen.proof.boxes import Box
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_definite, positive_semidefinite
from pbcgen.symbolic.real import BITS, Real, approximate, ball, enclose, is_finite, lower, precision, rational, upper
from pbcgen.symbolic.real_matrices import RealMatrix, congruence, multiply, transpose
from pbcgen.symbolic.tape import Tape


class Landscape:
    """W and the closed-loop rest equations over boxes of x.

    Attributes:
        momenta: the indices of the momenta, which boxes leave at zero; empty where boxes are of the whole state.
    """

    def __init__(self, situation: Situation) -> None:
        self.situation = situation
        plant = situation.plant
        system = plant.system
        self.envelope = Envelope(*situation.gains)
        comp = situation.compensation
        mechanics = system.mechanical
        if comp is not None and mechanics is not None:
            energy = ca.dot(mechanics.p, mechanics.velocity) / 2
            drift = system.f + ca.mtimes(system.g, comp)
        else:
            energy = system.S - ca.dot(system.u, situation.gamma)
            drift = system.f + ca.mtimes(system.g, system.u)
        self.drift_slope = ca.jacobian(drift, system.x)
        self.tape: Tape = plant.tape(energy, situation.gamma)
        self.rest_tape: Tape = plant.tape(drift, system.g, situation.gamma)
        self.slope_tape: Tape = plant.tape(
            ca.densify(self.drift_slope),
            ca.densify(ca.jacobian(situation.gamma, system.x)),
            ca.densify(system.g),
            situation.gamma,
        )
        gradient = ca.gradient(energy, system.x)
        slope = ca.jacobian(situation.gamma, system.x)
        self.momenta = _momenta(situation)
        self._moving = [k for k in range(system.n) if k not in self.momenta]
        self.inertia_tape: Tape | None = None
        if self.momenta and mechanics is not None:
            self.inertia_tape = plant.tape(ca.densify(mechanics.M), ca.densify(mechanics.M_inv))
            self.inertia = plant.doubles(mechanics.M)
        self.affine = not ca.depends_on(ca.densify(slope), system.x)
        self.first_tape: Tape = plant.tape(energy, ca.densify(gradient), ca.densify(slope), situation.gamma)
        self.second_tape: Tape = plant.tape(
            ca.densify(ca.jacobian(gradient, system.x)), ca.densify(slope), situation.gamma
        )
        u: list[Real] = list(situation.point.u)
        self.u = u
        with precision(BITS):
            energy_star, gamma_star = plant.walk(self.tape, situation.point.x, u)
        self.minimum: Real = energy_star[0][0]
        self.gamma_star = [row[0] for row in gamma_star]
        self.numeric = plant.doubles(energy, situation.gamma)

    def above(self, x: Sequence[Real]) -> Real:
        """A ball not above W(x) - V(x*) on the box."""
        energy, gamma = self.situation.plant.walk(self.tape, x, self.u)
        return ball(energy[0][0]) - ball(self.minimum) + self.envelope.least(self._deviation(gamma))

    def _deviation(self, gamma: RealMatrix) -> list[Real]:
        """gamma - gamma*."""
        return [ball(row[0]) - ball(star) for row, star in zip(gamma, self.gamma_star, strict=True)]

    def exceeds(self, part: Box, level: Fraction, anchor: Sequence[Fraction]) -> bool:
        """Whether W - V(x*) > level on the whole box: by enclosure, by a supporting plane, or to second order."""
        x = [enclose(lo, hi) for lo, hi in part]
        value = self.above(x)
        if is_finite(value) and lower(value) > level:
            return True
        if not self.affine:
            return self._tilted(part, x) > level
        hessian = self._hessian(x)
        if hessian is None:
            return False
        middle = [(lo + hi) / 2 for lo, hi in part]
        if positive_semidefinite(hessian).status is Status.PROVED:
            near = [min(max(a, lo), hi) for a, (lo, hi) in zip(anchor, part, strict=True)]
            return any(self._plane(part, c) > level for c in (near, middle))
        radii = [(hi - lo) / 2 for lo, hi in (part[k] for k in self._moving)]
        return self._plane(part, middle) + _least_curvature(hessian, radii) > level

    def _tilted(self, part: Box, x: Sequence[Real]) -> Fraction:
        """A lower bound on the box: the value in its middle, and the slopes on the whole box (mean value theorem)."""
        middle = [rational((lo + hi) / 2) for lo, hi in part]
        _, gradient, slope, gamma = self.situation.plant.walk(self.first_tape, x, self.u)
        value = self.above(middle)
        slopes = [ball(row[0]) for row in gradient]
        for force, row in zip(self.envelope.forces(self._deviation(gamma)), slope, strict=True):
            slopes = [a + force * ball(b) for a, b in zip(slopes, row, strict=True)]
        if not value.is_finite() or not all(a.is_finite() for a in slopes):
            return Fraction(-1)
        steepest = [max(abs(lower(a)), abs(upper(a))) for a in slopes]
        return lower(value) - sum((a * (hi - lo) / 2 for a, (lo, hi) in zip(steepest, part, strict=True)), Fraction(0))

    def _plane(self, part: Box, at: Sequence[Fraction]) -> Fraction:
        """A lower bound of the tangent plane at a point over the box."""
        energy, gradient, slope, gamma = self.situation.plant.walk(self.first_tape, [rational(v) for v in at], self.u)
        s = self._deviation(gamma)
        value = ball(energy[0][0]) - ball(self.minimum) + self.envelope.least(s)
        g = [ball(row[0]) for row in gradient]
        for force, row in zip(self.envelope.forces(s), slope, strict=True):
            g = [a + force * ball(b) for a, b in zip(g, row, strict=True)]
        if not value.is_finite() or not all(a.is_finite() for a in g):
            return Fraction(-1)
        total = lower(value)
        for a, c, (lo, hi) in zip(g, at, part, strict=True):
            total += min(lower(a) * (lo - c), lower(a) * (hi - c), upper(a) * (lo - c), upper(a) * (hi - c))
        return total

    def _hessian(self, x: Sequence[Real]) -> RealMatrix | None:
        """An enclosure of the Hessian of W over the box, for affine gamma."""
        second, slope, gamma = self.situation.plant.walk(self.second_tape, x, self.u)
        stiff = self.envelope.stiffness(self._deviation(gamma))
        added = congruence(transpose(slope), [list(row) for row in stiff])
        rows: RealMatrix = [
            [ball(second[max(i, j)][min(i, j)]) + ball(added[max(i, j)][min(i, j)]) for j in self._moving]
            for i in self._moving
        ]
        return rows if all(is_finite(v) for row in rows for v in row) else None

    def height(self, x: Sequence[float]) -> float:
        """W(x) - V(x*) in double precision."""
        energy, gamma = self.numeric(x, [approximate(v) for v in self.u])
        deviations = gamma.ravel() - np.array([approximate(v) for v in self.gamma_star])
        return float(energy[0, 0]) - approximate(self.minimum) + self.envelope.value(deviations)

    def regular_inertia(self, x: Sequence[Real]) -> bool:
        """Whether M > 0 on the box, so that momenta store energy; true where boxes are of the whole state."""
        if self.inertia_tape is None:
            return True
        for matrix in self.situation.plant.walk(self.inertia_tape, x, self.u):
            if all(is_finite(v) for row in matrix for v in row):
                symmetric = [
                    [row[j] if j <= i else matrix[j][i] for j in range(len(row))] for i, row in enumerate(matrix)
                ]
                if positive_definite(symmetric).status is Status.PROVED:
                    return True
        return False

    def momentum(self, box: Box, level: float) -> list[float]:
        """About the largest momenta with W <= level over a box of positions: ``sqrt(2 c M_ii)``."""
        if self.inertia_tape is None:
            return []
        generator = np.random.default_rng(0)
        lo, hi = np.array(box, dtype=float).T
        largest = np.zeros(len(self.momenta))
        for x in generator.uniform(lo, hi, size=(200, len(box))):
            (M,) = self.inertia(x, [approximate(v) for v in self.u])
            room = 2 * max(level - self.height(x), 0.0)
            largest = np.maximum(largest, np.sqrt(room * np.maximum(np.diag(M), 0.0)))
        return [float(v) for v in largest]

    def height_at_zero(self, x: Sequence[float]) -> float:
        """V - V(x*) with all filters at zero, in double precision."""
        u = [approximate(v) for v in self.u]
        energy, gamma = self.numeric(x, u)
        away = gamma.ravel() - np.array([approximate(v) for v in self.gamma_star])
        total = float(energy[0, 0]) - approximate(self.minimum) + self.envelope.spring(away)
        law, eta = self.situation.base, self.situation.eta
        if isinstance(law, NaturalDamping) and eta is not None:
            signal = self.situation.plant.numeric(eta)
            star = [approximate(v) for v in self.situation.point.x]
            moved = np.array(signal(x, u)).ravel() - np.array(signal(star, u)).ravel()
            upsilon = np.array([[float(v) for v in row] for row in law.Upsilon or ()])
            arguments = np.array([float(b) for b in law.beta_l]) * (upsilon @ moved)
            slopes = np.array([float(a / b) for a, b in zip(law.alpha_l, law.beta_l, strict=True)])
            total += float(slopes @ log_cosh(arguments))
        return total

    def rest_equations(self, x: Sequence[Real]) -> list[arb]:
        """``f + g (u* - force)`` on the box; for a mechanical system the rates of the momenta, at rest."""
        drift, g, gamma = self.situation.plant.walk(self.rest_tape, x, self.u)
        forces = self.envelope.forces(self._deviation(gamma))
        rates = []
        for i in self.momenta or range(len(drift)):
            total = ball(drift[i][0])
            for j, force in enumerate(forces):
                total = total - ball(g[i][j]) * force
            rates.append(total)
        return rates

    def can_rest(self, x: Sequence[Real]) -> bool:
        """Whether an equilibrium of the closed loop in the box is not excluded."""
        return all(not rate.is_finite() or rate.contains(0) for rate in self.rest_equations(x))

    def regular(self, x: Sequence[Real], centre: NDArray[np.float64]) -> bool:
        """Whether the Jacobian of the rest equations is regular for every selection from the box: one zero at most."""
        matrix = self.slopes(x)
        if matrix is None:
            return False
        n = len(centre)
        try:
            guess = np.linalg.inv(centre)
        except np.linalg.LinAlgError:
            return False
        Y = arb_mat([[arb(float(v)) for v in row] for row in guess])
        product = Y * matrix
        return all(
            bool(
                (product[i, i] - 1).abs_upper() + sum((product[i, j].abs_upper() for j in range(n) if j != i), arb(0))
                < 1
            )
            for i in range(n)
        )

    def slopes(self, x: Sequence[Real]) -> arb_mat | None:
        """The Jacobian of the rest equations on the box, in the states that move; None where it is not finite."""
        drift, slope, g, gamma = self.situation.plant.walk(self.slope_tape, x, self.u)
        stiff = self.envelope.stiffness(self._deviation(gamma))
        pull = multiply(multiply(g, [list(row) for row in stiff]), slope)
        rows = [[ball(a) - ball(b) for a, b in zip(p, q, strict=True)] for p, q in zip(drift, pull, strict=True)]
        if self.momenta:  # q' vanishes with p; what is left is p' as a function of q
            rows = [[rows[i][j] for j in self._moving] for i in self.momenta]
        if not all(entry.is_finite() for row in rows for entry in row):
            return None
        return arb_mat(rows)

    def centre_slope(self) -> NDArray[np.float64] | None:
        """The Jacobian of the rest equations at x*, in double precision."""
        matrix = self.slopes([ball(v) for v in self.situation.point.x])
        if matrix is None:
            return None
        n = matrix.nrows()
        return np.array([[float(matrix[i, j].mid()) for j in range(n)] for i in range(n)])


def _least_curvature(hessian: RealMatrix, radii: Sequence[Fraction]) -> Fraction:
    """A lower bound of ``d^T H d / 2`` for ``|d_i| <= r_i``, by scaled diagonal dominance."""
    total = Fraction(0)
    for i, row in enumerate(hessian):
        if radii[i] == 0:
            continue
        others = sum((max(abs(lower(v)), abs(upper(v))) * radii[j] for j, v in enumerate(row) if j != i), Fraction(0))
        total += min(Fraction(0), lower(row[i]) * radii[i] - others) * radii[i] / 2
    return total


def _momenta(situation: Situation) -> tuple[int, ...]:
    """The indices of the momenta, if W is a function of the positions and the kinetic energy; else none."""
    system = situation.plant.system
    mechanics = system.mechanical
    if mechanics is None or ca.depends_on(situation.gamma, mechanics.p):
        return ()
    half = system.n // 2
    names = system.state_names[half:]
    ordered = ca.is_equal(system.x, ca.vertcat(mechanics.q, mechanics.p), 1)
    if not ordered or any(system.domain.get(name, (None, None)) != (None, None) for name in names):
        return ()
    return tuple(range(half, system.n))
