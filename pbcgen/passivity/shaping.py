"""Energy shaping at x*: kappa, the gradient and Hessian conditions (hesscond), and the bound on K_c (hessSdc)."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import isfinite

import casadi as ca

from pbcgen.models.laws import Law, PotentialCompensation, base_law
from pbcgen.passivity.local import Local
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.response import has_full_rank
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import Definiteness, eigenvalues, positive_definite, smallest_eigenvalue, solve_positive
from pbcgen.symbolic.real import BITS, ZERO, Real, is_finite, precision, radius, rational, sign, text
from pbcgen.symbolic.real_matrices import (
    RealMatrix,
    SparseRow,
    add,
    as_balls,
    congruence,
    diagonal,
    exact_matrix,
    multiply,
    nonzeros,
    transpose,
)

#: The method of the gradient condition where nothing but the passive output shows it.
BY_RANK = "passive-output near x*, and [d(f + g u)/dx, g] has rank n there"


@dataclass(frozen=True)
class Shape:
    """Second-order data of the shaped storage at x*, exact or enclosed.

    Attributes:
        kappa: m entries (kappa); the equilibrium input is -kappa.
        gradient: grad S + grad gamma kappa at x*, n entries; zero when the gradient condition holds.
        H0: hess S + hess(gamma^T kappa) at x*, n x n, its entries that are not exactly zero.
        N: grad gamma at x*, n x m.
    """

    kappa: tuple[Real, ...]
    gradient: tuple[Real, ...]
    H0: list[SparseRow]
    N: RealMatrix

    def hessian(self, stiffness: RealMatrix) -> list[SparseRow]:
        """``H0 + N A N^T`` for an m x m stiffness A."""
        result = [dict(row) for row in self.H0]
        reached = [i for i, row in enumerate(nonzeros(self.N)) if row]
        shaped = congruence([self.N[i] for i in reached], stiffness)
        for i, row in zip(reached, shaped, strict=True):
            for j, entry in zip(reached, row, strict=True):
                result[i][j] = result[i].get(j, ZERO) + entry
        return result


def shape_at(plant: Plant, point: Point, gamma: ca.SX, law: Law | None = None) -> Shape:
    """Evaluate kappa, gradient and Hessians at x*.

    Args:
        plant: the system.
        point: x* and u* = -kappa.
        gamma: m x 1.
        law: one that cancels the potential energy (umec) shapes the kinetic energy instead of S, and kappa plays no
            role then.
    """
    system = plant.system
    kappa = tuple(-u for u in point.u)
    local = Local.of(plant, point)
    compensated = isinstance(base_law(law), PotentialCompensation)
    total = local.kinetic if compensated and system.mechanical is not None else local.S + ca.dot(gamma, -system.u)
    gradient = ca.gradient(total, system.x)
    first, second, slope = local.walk(gradient, ca.jacobian(gradient, system.x), ca.jacobian(gamma, system.x).T)
    symmetric: list[SparseRow] = [{} for _ in range(system.n)]
    for (i, j), entry in second.entries.items():
        if i >= j:
            symmetric[i][j] = symmetric[j][i] = entry
    return Shape(kappa, tuple(first.column(ZERO)), symmetric, slope.dense(ZERO))


# --- claims ------------------------------------------------------------------------------------------------------


def gradient_condition(
    plant: Plant, point: Point, shape: Shape, structure: PowerStructure | None, output: Claim | None = None
) -> Claim:
    """``grad S + grad gamma kappa = 0`` at x*.

    Where x* is only enclosed, balls cannot show that a number is zero. Then the power structure does: with
    F grad gamma = -g, ``0 = f + g u = F (grad S + grad gamma kappa) - rho`` at x*, so a regular F and rho = 0 leave
    only zero; with grad gamma = -A g, ``grad S + grad gamma kappa = A (f + g u) = 0`` outright. And so does any proof
    that gamma' is a passive output near x*, where [df/dx + u dg/dx, g] has rank n: see
    :mod:`pbcgen.passivity.response`. There ``grad S + grad gamma kappa`` is -r.

    Args:
        plant: the system.
        point: x*.
        shape: kappa and the gradients there.
        structure: a power structure for which the relation with grad gamma is proved, or None.
        output: the claim `passive-output` for S and gamma; None where another storage is shaped.
    """
    signs = [sign(v) for v in shape.gradient]
    nonzero = [k for k, s in enumerate(signs) if s in (1, -1)]
    passive = output is None or output.status is Status.PROVED
    if nonzero and not passive and plant.system.gamma is None:
        return _gradient_of_candidate(plant, shape, nonzero[0])
    if nonzero:
        return _gradient_refuted(plant, shape, nonzero[0])
    if all(s == 0 for s in signs):
        return Claim("gradient-condition", Status.PROVED, "at x*", "exact evaluation", "grad S + grad gamma kappa = 0")
    finite = all(is_finite(v) for v in shape.gradient)
    if structure is not None and finite and _is_regular(plant, point, structure):
        relation = (
            "F regular at x*, F (grad S + grad gamma kappa) = f + g u" if structure.form == "F" else "A (f + g u)"
        )
        return Claim(
            "gradient-condition",
            Status.PROVED,
            "at x*",
            f"structure: {relation} = 0",
            f"each entry lies within {max(float(radius(v)) for v in shape.gradient):.1e} of zero, and must be zero",
        )
    if output is not None and passive and finite and has_full_rank(*plant.at(point, _slope(plant), plant.system.g)):
        return Claim(
            "gradient-condition",
            Status.PROVED,
            "at x*",
            BY_RANK,
            "u^T gamma' - S' is least at rest, so that grad S + grad gamma kappa = 0",
        )
    return Claim(
        "gradient-condition",
        Status.UNDECIDED,
        "at x*",
        "ball arithmetic",
        "the enclosure contains zero",
        "mend the claims above, whose structure decides this one; or give x* itself in decimals",
    )


def _slope(plant: Plant) -> ca.SX:
    return ca.densify(ca.jacobian(plant.system.xdot, plant.system.x))


def _gradient_of_candidate(plant: Plant, shape: Shape, k: int) -> Claim:
    """A gamma that was not shown to be passive fails the condition: another one may meet it."""
    name, value = plant.system.state_names[k], text(shape.gradient[k], 6)
    return Claim(
        "gradient-condition",
        Status.UNDECIDED,
        "at x*",
        "exact or ball arithmetic",
        f"entry {name} of grad S + grad gamma kappa is {value} for a gamma that is only a candidate",
        "mend the claim `passive-output` first: another gamma, or another storage, may meet the condition",
    )


def _gradient_refuted(plant: Plant, shape: Shape, k: int) -> Claim:
    name = plant.system.state_names[k]
    return Claim(
        "gradient-condition",
        Status.REFUTED,
        "at x*",
        "exact or ball arithmetic",
        f"entry {name} of grad S + grad gamma kappa is {text(shape.gradient[k], 6)}",
        "l(x*) is not zero for this storage (dissipation obstacle), or gamma does not reach this coordinate",
        {"entry": name, "value": text(shape.gradient[k], 9)},
    )


def _is_regular(plant: Plant, point: Point, structure: PowerStructure) -> bool:
    """Whether the structure determines grad S + grad gamma kappa from f + g u at x*."""
    if structure.form == "A":
        return True
    matrix, remainder = plant.at(point, ca.densify(structure.matrix), structure.remainder)
    with precision(BITS):
        regular = sign(as_balls(matrix).det()) in (1, -1)
    return regular and all(sign(row[0]) == 0 for row in remainder)


@dataclass(frozen=True)
class HessianVerdict:
    """The claims `hessian-condition` and `kc-bound` with the numbers behind them.

    Attributes:
        hessian, kc: the claims.
        smallest_eigenvalue: of hess S_d at x*.
        alpha_beta_min: the diagonal of the smallest multiple of diag(alpha beta) that meets the Hessian condition,
            zeros if every positive one does, None if none does.
        kc_min: the smallest k with K_c = k I above A N^T H^-1 N A - A, which K_c must exceed.
    """

    hessian: Claim
    kc: Claim
    smallest_eigenvalue: float
    alpha_beta_min: tuple[float, ...] | None
    kc_min: float | None


def hessian_conditions(
    plant: Plant, shape: Shape, alpha_beta: tuple[Fraction, ...], K_c: tuple[tuple[Fraction, ...], ...] | None
) -> HessianVerdict:
    """Decide (hesscond) and ``hess S_dc > 0`` for the gains."""
    stiffness = diagonal([rational(v) for v in alpha_beta])
    with precision(BITS):
        H = shape.hessian(stiffness)
        verdict = positive_definite(H)
        smallest = smallest_eigenvalue(H, verdict.status is Status.PROVED)
        threshold = _smallest_multiple(shape, stiffness)
        bound = None if verdict.status is not Status.PROVED else _kc_bound(shape, stiffness, H)
        kc = _kc_claim(shape, stiffness, bound, K_c)
    minimum = None if threshold is None else tuple(threshold * float(v) for v in alpha_beta)
    kc_min = None if bound is None else max(0.0, eigenvalues(bound)[-1])
    return HessianVerdict(_hessian_claim(plant, verdict, smallest, minimum, alpha_beta), kc, smallest, minimum, kc_min)


def _hessian_claim(
    plant: Plant,
    verdict: Definiteness,
    smallest: float,
    minimum: tuple[float, ...] | None,
    alpha_beta: tuple[Fraction, ...],
) -> Claim:
    method = "LDL^T in exact or ball arithmetic"
    if verdict.status is Status.PROVED:
        evidence = f"hess S_d(x*) > 0, smallest eigenvalue {smallest:.6g}"
        return Claim("hessian-condition", Status.PROVED, "at x*", method, evidence)
    if not isfinite(smallest):
        evidence = "the second derivatives of the storage or of gamma are not defined at x*"
        hint = "write S and gamma with functions that are smooth at x*, or choose another target"
        return Claim("hessian-condition", Status.UNDECIDED, "at x*", method, evidence, hint)
    given = ", ".join(f"{float(v):.6g}" for v in alpha_beta)
    if minimum is None:
        hint = (
            "no alpha*beta helps: the storage has no minimum at x* in the directions that gamma does not act on; "
            "choose another target or actuator"
        )
    else:
        hint = f"alpha*beta must exceed {', '.join(f'{v:.9g}' for v in minimum)}; it is {given}"
    evidence = f"hess S_d(x*) is not positive definite, smallest eigenvalue {smallest:.6g}"
    counterexample = None
    if verdict.status is Status.REFUTED and verdict.witness is not None and verdict.value is not None:
        direction = {n: f"{float(v):.9g}" for n, v in zip(plant.system.state_names, verdict.witness, strict=True)}
        counterexample = {"v": direction, "v^T hess S_d v": text(verdict.value, 9)}
    return Claim("hessian-condition", verdict.status, "at x*", method, evidence, hint, counterexample)


def _smallest_multiple(shape: Shape, stiffness: RealMatrix) -> float | None:
    """The infimum t of multiples with H0 + t N A N^T > 0: 0 if H0 > 0, None if there is none.

    Bisection on exact tests; the set of good multiples is an up-set.
    """

    def good(t: Fraction) -> bool:
        scaled = [[entry * rational(t) for entry in row] for row in stiffness]
        return positive_definite(shape.hessian(scaled)).status is Status.PROVED

    if good(Fraction(0)):
        return 0.0
    lo, hi = Fraction(0), Fraction(1)
    while not good(hi):
        lo, hi = hi, hi * 16
        if hi > Fraction(10) ** 24:
            return None
    while lo == 0 and hi > Fraction(1, 10**15):
        middle = hi / 16
        lo, hi = (Fraction(0), middle) if good(middle) else (middle, hi)
    for _ in range(60):
        if hi - lo <= hi * Fraction(1, 10**13):
            break
        middle = (lo + hi) / 2
        lo, hi = (lo, middle) if good(middle) else (middle, hi)
    return 0.0 if lo == 0 else float(hi)


def _kc_bound(shape: Shape, stiffness: RealMatrix, H: list[SparseRow]) -> RealMatrix | None:
    NA = multiply(shape.N, stiffness)
    solved = solve_positive(H, NA)
    if solved is None:
        return None
    product = multiply(transpose(NA), solved)
    return [[p - a for p, a in zip(x, y, strict=True)] for x, y in zip(product, stiffness, strict=True)]


def _kc_claim(
    shape: Shape, stiffness: RealMatrix, bound: RealMatrix | None, K_c: tuple[tuple[Fraction, ...], ...] | None
) -> Claim:
    if bound is None or K_c is None:
        return Claim(
            "kc-bound",
            Status.UNDECIDED,
            "at x*",
            "Schur complement",
            "needs the Hessian condition first",
            "satisfy hessian-condition",
        )
    gains = exact_matrix(K_c)
    verdict = positive_definite(extended_hessian(shape, stiffness, gains))
    required = max(0.0, eigenvalues(bound)[-1])
    if verdict.status is Status.PROVED:
        evidence = "hess S_dc > 0" + (f"; K_c = k I needs k > {required:.6g}" if required > 0 else "; any K_c > 0 does")
        return Claim("kc-bound", Status.PROVED, "at x*", "LDL^T in exact or ball arithmetic", evidence)
    counterexample = None
    if verdict.status is Status.REFUTED and verdict.witness is not None and verdict.value is not None:
        counterexample = {"v": [f"{float(v):.9g}" for v in verdict.witness], "v^T hess S_dc v": text(verdict.value, 9)}
    return Claim(
        "kc-bound",
        verdict.status,
        "at x*",
        "LDL^T in exact or ball arithmetic",
        "hess S_dc(x*, 0) is not positive definite",
        f"make K_c larger: K_c = k I needs k > {required:.9g}",
        counterexample,
    )


def extended_hessian(shape: Shape, stiffness: RealMatrix, K_c: RealMatrix) -> list[SparseRow]:
    """hess S_dc at (x*, 0), (n + m) x (n + m) (hessSdc)."""
    n, result = len(shape.N), shape.hessian(stiffness)
    result += nonzeros([[ZERO] * n + row for row in add(K_c, stiffness)])
    for i, row in enumerate(nonzeros(multiply(shape.N, stiffness))):
        for j, entry in row.items():
            result[i][n + j] = result[n + j][i] = entry
    return result


def gain_definiteness(gains: dict[str, tuple[tuple[Fraction, ...], ...]]) -> Claim:
    """The claim `gain-definiteness`: every matrix gain is positive definite (R_psi: semidefinite)."""
    for name, gain in gains.items():
        verdict = positive_definite(exact_matrix(gain))
        if verdict.status is not Status.PROVED and verdict.witness is not None:
            return Claim(
                "gain-definiteness",
                Status.REFUTED,
                "at x*",
                "LDL^T over the rationals",
                f"{name} is not positive definite",
                f"choose a positive definite {name}",
                {"gain": name, "v": [str(v) for v in verdict.witness], "v^T K v": text(verdict.value or ZERO)},
            )
    listed = ", ".join(gains)
    return Claim("gain-definiteness", Status.PROVED, "all x", "LDL^T over the rationals", f"{listed} > 0")
