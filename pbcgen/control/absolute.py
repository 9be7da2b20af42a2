"""Global stability without a passive output: a quadratic form and the saturations' integrals as Lyapunov function.

Let ``phi_i = alpha_i tanh(beta_i z_i)`` with ``z = gamma - gamma* + x_c``. With the deviations x~ of the plant and
gamma affine, the loop is ``x~' = F(x~, phi)``, ``x_c' = -R_c (phi + K_c x_c)``. For

    V = zeta^T P zeta / 2 + sum lambda_i int_0^{z_i} phi_i dz,   zeta = (x~, x_c),   lambda_i >= 0, P > 0,

V' is a polynomial in (zeta, phi) where F is one. Because ``phi_i (z_i - phi_i / (alpha_i beta_i)) >= 0`` (a sector),

    -V' - sum tau_i phi_i (z_i - phi_i / (alpha_i beta_i)) = positive definite form of (zeta, phi),   tau_i >= 0,

makes V' < 0 but at x*: x* attracts from everywhere (Lur'e, Popov, the S-procedure). Terms that are not quadratic must
vanish, which is a linear condition on P: gyroscopic forces and what motors exchange between their coils vanish so. P,
lambda and tau are proposed in doubles and rounded; the definite forms are decided exactly.

The law `integral` adds ``theta = alpha tanh(beta psi)`` to phi, ``psi' = -r psi + alpha beta sech(beta psi) gamma~``.
``W = (cosh(beta psi) - 1) / beta^2`` then has ``W' = gamma~ theta - r psi sinh(beta psi) / beta``, which is at most
``gamma~ theta - r theta^2 / (alpha beta)^2``. V is given ``mu W``, mu >= 0, and the form is one of (zeta, phi, theta).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations_with_replacement, product
from typing import TypeAlias

import casadi as ca
import numpy as np
from flint import fmpq
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

from pbcgen.control.situation import Situation
from pbcgen.errors import UnsupportedOperation
from pbcgen.models.laws import DynamicExtension, Integral, Law
from pbcgen.proof.claim import Status
from pbcgen.proof.cutting_planes import interior
from pbcgen.proof.definite import positive_definite
from pbcgen.symbolic.linear import Row, kernel
from pbcgen.symbolic.real import approximate, fraction, rational
from pbcgen.symbolic.real_matrices import as_floats, weighted_sum

#: The method of the claim that this proves.
METHOD = "absolute stability: sectors of the saturations and the S-procedure, definite forms over the rationals"
#: Loops of more states are not tried.
_MOST = 8
_ROUNDS = 200
_DENOMINATORS = (10**3, 10**5, 10**8)

#: Coefficients by the positions of the variables of (zeta, phi), in order.
_Polynomial: TypeAlias = dict[tuple[int, ...], fmpq]
_Matrix: TypeAlias = list[list[fmpq]]
_Array: TypeAlias = NDArray[np.float64]


def absolutely_stable(situation: Situation) -> str | None:
    """Why x* attracts from everywhere, in words, or None."""
    system = situation.plant.system
    base = situation.base
    if not isinstance(base, DynamicExtension) or system.domain or system.n + system.m > _MOST:
        return None
    try:
        loop = _Loop.of(situation, base, situation.law)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    found = None if loop is None else loop.storage()
    if found is None:
        return None
    terms = ["a positive definite quadratic form of x - x* and x_c"]
    terms += ["integrals of the saturations"] if any(found.popov) else []
    terms += ["cosh(beta_psi psi)"] if found.integral else []
    return f"V = {' and '.join(terms)}: V' < 0 but at x*, whatever is in the sectors 0 <= phi_i / z_i <= alpha_i beta_i"


@dataclass(frozen=True, eq=False)
class _Storage:
    """P, and the weights lambda, tau, and mu of the integral term if there is one."""

    P: _Matrix
    popov: list[fmpq]
    sectors: list[fmpq]
    integral: list[fmpq]


@dataclass(frozen=True, eq=False)
class _Loop:
    """The rates of zeta as polynomials in (zeta, phi, theta), z and gamma~, the sectors' slopes, r / (alpha beta)^2."""

    rates: list[_Polynomial]
    arguments: list[_Polynomial]
    outputs: list[_Polynomial]
    slopes: list[fmpq]
    leaks: list[fmpq]

    @staticmethod
    def of(situation: Situation, base: DynamicExtension, law: Law) -> _Loop | None:
        """None where x* is not exact, gamma not affine, the plant no polynomial, or a filter psi does not leak."""
        plant, system, point = situation.plant, situation.plant.system, situation.point
        leaks = _leaks(law)
        if leaks is None or not all(isinstance(v, fmpq) for v in (*point.x, *point.u)):
            return None
        n, m = system.n, system.m
        star = [ca.vertcat(*[plant.number(fraction(v), alone=True) for v in part]) for part in (point.x, point.u)]
        moved = ca.substitute(
            system.xdot, ca.vertcat(system.x, system.u), ca.vertcat(star[0] + system.x, star[1] - system.u)
        )
        field, (rate, slope) = plant.exact(moved, ca.jacobian(situation.gamma, system.x))
        zero = field.const(0)
        N = [[entry.constant() for entry in row] for row in slope.dense(zero)]
        values = rate.column(zero)
        if any(v is None for row in N for v in row) or not all(v.is_polynomial() for v in values):
            return None
        places = {k: [k] for k in range(n)}  # of x~ and phi + theta among (x~, x_c, phi, theta)
        places |= {n + j: [n + m + j, n + 2 * m + j] if leaks else [n + m + j] for j in range(m)}
        rates: list[_Polynomial] = []
        for value in values:
            found: _Polynomial = {}
            for exponents, c in value.numerator.to_dict().items():
                used = [k for k, e in enumerate(exponents) for _ in range(int(e))]
                if any(k not in places for k in used):
                    return None
                for chosen in product(*(places[k] for k in used)):
                    key = tuple(sorted(chosen))
                    found[key] = found.get(key, fmpq(0)) + c
            rates.append(found)
        R, K = ([[rational(v) for v in row] for row in gain] for gain in (base.R_c, base.K_c))
        for row in R:
            own: _Polynomial = {(n + m + j,): -v for j, v in enumerate(row)}
            own |= {(n + j,): -sum((v * K[i][j] for i, v in enumerate(row)), fmpq(0)) for j in range(m)}
            rates.append(own)
        outputs: list[_Polynomial] = [{(k,): v for k, v in enumerate(row) if v is not None} for row in N]
        arguments = [_plus(output, {(n + i,): fmpq(1)}) for i, output in enumerate(outputs)]
        slopes = [rational(a * b) for a, b in zip(base.alpha, base.beta, strict=True)]
        return _Loop(rates, arguments, outputs, slopes, leaks)

    @property
    def order(self) -> int:
        return len(self.rates)

    @property
    def size(self) -> int:
        """How many variables (zeta, phi, theta) are."""
        return self.order + len(self.slopes) + len(self.leaks)

    def storage(self) -> _Storage | None:
        """P, lambda, tau and mu that are certainly good, or None."""
        if self._hopeless:
            return None
        pairs, parts = self._parts()
        m, order = len(self.slopes), self.order
        rows: dict[object, Row] = {}
        for k, part in enumerate(parts):
            for key, c in part.items():
                if len(key) != 2 and c != 0:
                    rows.setdefault(key, {})[k] = c
        basis = kernel(rows.values(), len(parts), fmpq(0), fmpq(1))
        if not basis:
            return None
        P = [_symmetric({pair: v for pair, v in zip(pairs, vector, strict=False) if v}, order) for vector in basis]
        forms = [_symmetric(_combined(parts, vector), self.size, halved=True) for vector in basis]
        weights = [vector[len(pairs) :] for vector in basis]
        for t in self._proposals(P, forms, weights):
            size = len(weights[0])
            signs = [sum((c * w[i] for c, w in zip(t, weights, strict=True)), fmpq(0)) for i in range(size)]
            if any(v < 0 for v in signs):
                continue
            chosen = weighted_sum(t, P)
            if all(positive_definite(matrix).status is Status.PROVED for matrix in (chosen, weighted_sum(t, forms))):
                return _Storage(chosen, signs[:m], signs[m : 2 * m], signs[2 * m :])
        return None

    def _parts(self) -> tuple[list[tuple[int, int]], list[_Polynomial]]:
        """What each unknown adds to the form: entries of P, lambda, tau, mu."""
        order = self.order
        pairs = list(combinations_with_replacement(range(order), 2))
        parts: list[_Polynomial] = []
        for a, b in pairs:
            total = _times(a, self.rates[b])
            parts.append(_negative(total if a == b else _plus(total, _times(b, self.rates[a]))))
        for i, argument in enumerate(self.arguments):
            rate: _Polynomial = {}
            for (k,), c in argument.items():
                rate = _plus(rate, {key: c * v for key, v in self.rates[k].items()})
            parts.append(_negative(_times(order + i, rate)))
        for i, (argument, slope) in enumerate(zip(self.arguments, self.slopes, strict=True)):
            parts.append(_plus(_negative(_times(order + i, argument)), {(order + i, order + i): 1 / slope}))
        for i, (output, leak) in enumerate(zip(self.outputs, self.leaks, strict=False)):
            theta = order + len(self.slopes) + i
            parts.append(_plus(_negative(_times(theta, output)), {(theta, theta): leak}))
        return pairs, parts

    def _proposals(
        self, P: Sequence[_Matrix], forms: Sequence[_Matrix], weights: Sequence[Sequence[fmpq]]
    ) -> Iterator[list[fmpq]]:
        """Weights of the basis, from cutting planes in balanced coordinates."""
        scale = self._scales()
        families = [np.array([as_floats(M) for M in part]) for part in (P, forms)]
        families = [f * np.outer(scale[: f.shape[1]], scale[: f.shape[1]]) for f in families]
        signs = np.array([[float(v.p) / float(v.q) for v in row] for row in weights])
        sizes = np.max(np.abs(families[1]), axis=(1, 2))
        if not np.all(np.isfinite(sizes)) or not np.all(sizes > 0):
            return
        families = [f / sizes[:, None, None] for f in families]
        families[0] /= np.max(np.abs(families[0]))
        loose = [(column / sizes)[:, None, None] for column in signs.T]
        loose = [f / max(float(np.max(np.abs(f))), 1e-300) for f in loose]
        t = interior(families, loose, _ROUNDS)
        if t is None:
            return
        t = t / sizes
        t = t / np.max(np.abs(t))
        for denominator in _DENOMINATORS:
            yield [rational(Fraction(float(v)).limit_denominator(denominator)) for v in t]

    def _linear(self, share: float) -> _Array:
        """The linear part of the loop with slopes of a share of those of the sectors."""
        order = self.order
        A = np.zeros((order, self.size))
        for i, rate in enumerate(self.rates):
            for key, c in rate.items():
                if len(key) == 1:
                    A[i, key[0]] += approximate(c)
        loop = A[:, :order]
        for j, (argument, slope) in enumerate(zip(self.arguments, self.slopes, strict=True)):
            for (k,), c in argument.items():
                loop[:, k] += A[:, order + j] * share * approximate(slope) * approximate(c)
        return loop

    @property
    def _hopeless(self) -> bool:
        """Whether a linear loop in the sector does not decay: then no V exists."""
        loops = [self._linear(share) for share in (0.0, 0.5, 1.0)]
        return any(np.max(np.linalg.eigvals(loop).real) >= -1e-12 * np.linalg.norm(loop) for loop in loops)

    def _scales(self) -> _Array:
        """Sizes of (zeta, phi) with which the linear part of the loop is balanced."""
        _, (scaling, _) = matrix_balance(self._linear(1.0), permute=False, separate=True)
        drawn = [
            max(abs(approximate(c)) * scaling[k] for (k,), c in argument.items()) * approximate(slope)
            for argument, slope in zip(self.arguments, self.slopes, strict=True)
        ]
        held = [
            max(abs(approximate(c)) * scaling[k] for (k,), c in output.items()) / approximate(leak)
            for output, leak in zip(self.outputs, self.leaks, strict=False)
        ]
        return np.concatenate([scaling, drawn, held])


def _leaks(law: Law) -> list[fmpq] | None:
    """``r / (alpha beta)^2`` for each filter psi; None where one does not leak by itself. Without filters: nothing."""
    if not isinstance(law, Integral):
        return []
    gains = enumerate(zip(law.alpha_psi, law.beta_psi, law.R_psi, strict=True))
    found = [(row[i] / (a * b) ** 2, any(v for j, v in enumerate(row) if j != i)) for i, (a, b, row) in gains]
    return None if any(leak <= 0 or mixed for leak, mixed in found) else [rational(leak) for leak, _ in found]


def _times(k: int, p: _Polynomial) -> _Polynomial:
    return {tuple(sorted((k, *key))): c for key, c in p.items()}


def _plus(a: _Polynomial, b: _Polynomial) -> _Polynomial:
    return {key: a.get(key, fmpq(0)) + b.get(key, fmpq(0)) for key in a.keys() | b.keys()}


def _negative(p: _Polynomial) -> _Polynomial:
    return {key: -c for key, c in p.items()}


def _combined(parts: Sequence[_Polynomial], weights: Sequence[fmpq]) -> _Polynomial:
    """The quadratic terms of a combination."""
    total: _Polynomial = {}
    for part, weight in zip(parts, weights, strict=True):
        if weight != 0:
            total = _plus(total, {key: weight * c for key, c in part.items() if len(key) == 2})
    return total


def _symmetric(entries: dict[tuple[int, ...], fmpq], size: int, halved: bool = False) -> _Matrix:
    """A symmetric matrix; ``halved`` where the entries are the coefficients of a quadratic form."""
    matrix = [[fmpq(0)] * size for _ in range(size)]
    for (i, j), c in entries.items():
        matrix[i][j] = matrix[j][i] = c / 2 if halved and i != j else c
    return matrix
