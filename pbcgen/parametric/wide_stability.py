"""The stability claims with symbolic parameters: Lyapunov function, LaSalle's set, Routh's array, growth.

Each holds for all positive parameters, or is said to hold where the conditions of its premises do.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from functools import cached_property

import casadi as ca
import numpy as np

from pbcgen.control.stability import lyapunov_premises
from pbcgen.errors import UnsupportedOperation
from pbcgen.law.gain_matrices import exact_inverse
from pbcgen.models.exact import decimal
from pbcgen.models.laws import DynamicExtension, Integral, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.parametric.resting_point import RestingPoint
from pbcgen.parametric.wide import EVERYWHERE, GIVE_UP, NEAR_TARGET, Wide, pairs, refuted, undecided
from pbcgen.parametric.wide_conditions import Verdict, condition
from pbcgen.passivity.coordinates import proper
from pbcgen.passivity.flow import Flow, flow
from pbcgen.passivity.inertia import missing_for_definiteness
from pbcgen.passivity.lasalle import InvariantSet, invariant_set
from pbcgen.passivity.structure import PowerStructure
from pbcgen.passivity.unbounded import currents, depends_on_currents
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.elimination import definite, has_one_sign, is_regular, semidefinite
from pbcgen.proof.known import BOUNDED_KINDS
from pbcgen.proof.nonnegative import positive
from pbcgen.proof.spectrum import hurwitz
from pbcgen.symbolic.coefficients import Coefficients
from pbcgen.symbolic.field import Quotient

#: Parameters are tried within these factors of their values, so many times each.
SPREADS, _TRIALS = (10.0, 1000.0), 100
#: Closed loops with more states are not decided by Routh's array in functions.
_LARGEST_ROUTH = 6
#: Conditions are shown for closed loops up to this size; entries with more terms are not tested for their sign.
_LARGEST_SHOWN = 4
_MOST_TERMS = 400
#: Instructions that the elimination of LaSalle's set may look at, per state: symbolic coefficients take their time.
_BUDGET_PER_STATE = 600


class Stability:
    """The claims `stable`, `asymptotically-stable` and `globally-asymptotically-stable`.

    Args:
        wide: the design.
        point: x* and u* as functions of the parameters, or None.
        structure: one that proves Assumption 1 and matches gamma, or None.
        found: the claims that the Lyapunov function rests on.
        strict: whether Theta > 0, for natural damping.
    """

    def __init__(
        self,
        wide: Wide,
        point: RestingPoint | None,
        structure: PowerStructure | None,
        found: Mapping[str, Verdict],
        strict: bool,
    ) -> None:
        self.wide, self.point, self.structure = wide, point, structure
        self.strict = strict or not isinstance(wide.base, NaturalDamping)
        assert wide.law is not None
        premises = lyapunov_premises(wide.law)
        open_ = [n for n in premises if n not in found or found[n].claim.status is not Status.PROVED]
        self.missing = [n for n in open_ if n not in found or not found[n].condition]
        self.available = bool(premises) and not self.missing
        self.where = " and ".join(dict.fromkeys(found[n].condition for n in open_ if n not in self.missing))

    def _given(self, name: str, domain: str, method: str, evidence: str) -> Claim:
        """What the Lyapunov function gives: for all positive parameters, or where its premises hold."""
        if not self.where:
            return self.wide.proved(name, domain, method, evidence)
        return undecided(name, domain, f"proved where {self.where} ({method}); open for other parameters")

    def stable(self) -> Claim:
        """`stable`, by the Lyapunov function only."""
        if self.available:
            return self._given("stable", NEAR_TARGET, "Lyapunov function", "its premises hold")
        why = "open for " + ", ".join(self.missing) if self.missing else "there is no Lyapunov function for this law"
        return undecided("stable", NEAR_TARGET, why)

    # --- near x* --------------------------------------------------------------------------------------------------

    def attractive(self) -> Claim:
        """`asymptotically-stable`: LaSalle's set consists of isolated equilibria, or Routh's array in functions."""
        name, tried = "asymptotically-stable", "LaSalle's set and Routh's array were tried with symbolic parameters"
        if self.point is None or self.wide.gamma is None:
            return undecided(name, NEAR_TARGET, "x* is not known as a function of the parameters")
        by_lasalle = self._by_lasalle(name)
        if by_lasalle is not None and not self.where:
            return by_lasalle
        try:
            loop = self.wide.entries(self.point.put_in(self.closed_loop(self.wide)))
            largest = _LARGEST_ROUTH if by_lasalle is None else _LARGEST_SHOWN
            left = self._open_in_routh(loop) if len(loop) <= largest else None
            if left == []:
                evidence = "every entry of the first column is positive"
                method = "linearisation: Routh's array over Q(parameters)"
                return self.wide.proved(name, NEAR_TARGET, method, evidence)
            condition_ = condition(self.wide, left) if left else ""
            if condition_:
                tried = f"Hurwitz iff {condition_}, by Routh's array"
        except GIVE_UP as reason:
            tried = f"{tried}; {reason}"
        return by_lasalle or self._unstable(name) or undecided(name, NEAR_TARGET, tried)

    def _unstable(self, name: str) -> Claim | None:
        """REFUTED by positive parameters at which the linearised loop certainly has a growing mode; or None."""
        assert self.point is not None
        try:
            matrix = self.wide.at_parameters(self.point.put_in(self.closed_loop(self.wide)))
        except GIVE_UP:
            return None
        own = np.array([float(v) for v in self.wide.values.values()])
        if len(own) == 0 or not np.all(own > 0):
            return None
        generator = np.random.default_rng(0)
        for reach in SPREADS:
            for _ in range(_TRIALS):
                values = own * reach ** generator.uniform(-1, 1, len(own))
                loop = matrix.rounded(values)
                if not np.all(np.isfinite(loop)) or np.max(np.linalg.eigvals(loop).real) <= 1e-6 * np.linalg.norm(loop):
                    continue
                exact = [Fraction(f"{v:.4g}") for v in values]
                found = hurwitz(matrix.exact(exact))
                if found.status is Status.REFUTED:
                    shown = {key: decimal(v) for key, v in zip(self.wide.values, exact, strict=True)}
                    why = f"the linearised loop has an eigenvalue of real part {found.extreme:.4g} with {pairs(shown)}"
                    hint = "restrict the parameters, or change the gains with them"
                    return refuted(name, NEAR_TARGET, why, hint, {"parameters": shown})
        return None

    def _open_in_routh(self, loop: Sequence[Sequence[Quotient]]) -> list[Quotient] | None:
        """The entries of the first column that are not proved positive; None if not all were looked at."""
        left = []
        for entry in routh_column(loop):
            if len(entry.numerator) > _MOST_TERMS:
                return None
            if not positive(entry):
                if len(loop) > _LARGEST_SHOWN:
                    return None
                left.append(entry)
        return left

    def _by_lasalle(self, name: str) -> Claim | None:
        found = self.resting
        if not self.available or found is None or not found.resting or not self._isolated():
            return None
        chain = "; ".join(map(self.wide.named, found.steps))
        evidence = f"where the Lyapunov function rests: {chain}; and x* is isolated"
        return self._given(name, NEAR_TARGET, "Lyapunov function and LaSalle's set", evidence)

    @cached_property
    def flow(self) -> Flow | None:
        """What moves where the Lyapunov function rests, or None if that is not known."""
        wide = self.wide
        if self.structure is None or wide.gamma is None or isinstance(wide.law, Integral) or not self.strict:
            return None
        still = wide.eta if isinstance(wide.base, NaturalDamping) else None
        return flow(wide.plant, self.structure, wide.gamma, wide.compensation, still)

    @cached_property
    def resting(self) -> InvariantSet | None:
        """What is left of the set where the Lyapunov function rests, or None if that is not known."""
        try:
            return (
                None
                if self.flow is None
                else invariant_set(self.flow, budget=_BUDGET_PER_STATE * self.wide.plant.system.n)
            )
        except GIVE_UP:
            return None

    def _isolated(self) -> bool:
        """Whether rests of the closed loop are critical points of the storage, or x* a regular zero.

        The Hessian of the storage is definite at x* by the premises, so that a critical point is isolated. With
        f + g u = F (grad S - grad gamma u) and a regular F, or grad S - grad gamma u = A x', a rest is one: the
        filters rest where the gradient in their states vanishes.
        """
        if self._rests_are_critical():
            return True
        try:
            assert self.point is not None
            return _is_regular(self.wide.entries(self.point.put_in(self.closed_loop(self.wide))))
        except GIVE_UP:
            return False

    def _rests_are_critical(self) -> bool:
        structure = self.structure
        if structure is None:
            return False
        if structure.form == "A":
            return True
        try:
            F, rho = self.wide.exact(structure.matrix, structure.remainder)
            return all(row[0].is_zero() for row in rho) and is_regular(F)
        except GIVE_UP:
            return False

    # --- globally -------------------------------------------------------------------------------------------------

    def globally(self) -> Claim:
        """`globally-asymptotically-stable`: growth of the storage, LaSalle's set, and one rest only."""
        name, domain, wide = "globally-asymptotically-stable", EVERYWHERE, self.wide
        found = self.resting
        reasons = {
            "the Lyapunov function is not available with symbolic parameters": self.available,
            "the model is not certainly defined for all positive parameters": wide.defined,
            "the model is stated on a domain": not wide.given.system.domain,
            "x* is not known as a function of the parameters": self.point is not None,
            "LaSalle's set was not reduced to equilibria": found is not None and found.resting,
        }
        for why, holds in reasons.items():
            if not holds:
                return undecided(name, domain, why)
        assert found is not None
        try:
            growth, unique = self._growth(), self._only_rest()
        except GIVE_UP as reason:
            return undecided(name, domain, str(reason))
        if not growth:
            return undecided(name, domain, "radial unboundedness was not proved with symbolic parameters")
        if not unique:
            return undecided(name, domain, "it was not proved that x* is the only rest for all positive parameters")
        steps = "; ".join(map(wide.named, found.steps))
        evidence = f"{growth}; where the Lyapunov function rests: {steps}; {unique}"
        return self._given(name, domain, "Lyapunov function, LaSalle's set and radial unboundedness", evidence)

    def _growth(self) -> str:
        """Why the storage is radially unbounded; nothing if that was not proved."""
        wide, system = self.wide, self.wide.plant.system
        gamma, point, comp = wide.gamma, self.point, wide.compensation
        assert gamma is not None
        assert point is not None
        mechanics = system.mechanical
        if depends_on_currents(wide.plant, gamma) and proper(wide.plant, *currents(wide.plant)):
            return "S is a definite form of grad P, and x -> grad P has a continuous inverse"
        x, energy = (system.x, system.S) if mechanics is None else (mechanics.q, mechanics.V)
        if mechanics is not None and missing_for_definiteness(wide.plant):  # M > 0 bounds p where S and q are bounded
            return ""
        slope = ca.jacobian(gamma, x)
        if ca.depends_on(ca.jacobian(gamma, system.x), system.x):
            return ""
        if mechanics is not None and ca.depends_on(gamma, mechanics.p):
            return ""
        rest = ca.SX(0) if comp is not None else energy
        split = self._split(rest, x)
        if split is None:
            return ""
        P, linear, bounded = split
        if definite(wide.entries(P)):
            return "the quadratic part of S is positive definite"
        N = ca.mtimes(slope.T, slope)
        if not bounded or not (semidefinite(wide.entries(P)) and definite(wide.entries(P + N))):
            return ""
        # On the kernel of P there are the linear part, kappa^T gamma, and the saturated terms with alpha_i |gamma_i|.
        u_star = point.put_in(system.u) if comp is None else ca.SX(system.m, 1)
        balance = linear - ca.mtimes(slope.T, u_star) + ca.mtimes(P, point.put_in(x))
        if comp is not None or all(row[0].is_zero() for row in wide.entries(balance)):
            return "S grows quadratically, and ln cosh where S does not"
        alpha = wide.base.alpha_c if isinstance(wide.base, NaturalDamping) else wide.base.alpha  # type: ignore[union-attr]
        spare = ca.vertcat(*[wide.plant.number(a) ** 2 for a in alpha]) - u_star**2
        if all(row[0].is_zero() for row in wide.entries(linear)) and all(positive(r[0]) for r in wide.entries(spare)):
            return "S grows quadratically, and ln cosh faster than kappa^T gamma where S does not"
        return ""

    def _split(self, energy: ca.SX, x: ca.SX) -> tuple[ca.SX, ca.SX, bool] | None:
        """The quadratic form and the linear part of a function of x, and whether the rest is bounded from below.

        None if the rest may grow as fast as the form. Beside a form that is definite terms of less growth do no harm.
        """
        wide, plant = self.wide, self.wide.plant
        field, (value,) = plant.exact(energy)
        positions = {plant.names.index(entry.name()): i for i, entry in enumerate(ca.vertsplit(x))}
        terms = Coefficients(field, frozenset(range(plant.system.n + plant.system.m, len(field.names)))).split(
            value.scalar(field.const(0))
        )
        if terms is None:
            return None
        size, bounded = x.numel(), True
        P, linear = ca.SX(size, size), ca.SX(size, 1)
        for monomial, coefficient in terms.items():
            used = [k for k, e in enumerate(monomial) for _ in range(e)]
            free = [positions[k] for k in used if k in positions]
            others = [k for k in used if k not in positions]
            harmless = all(field.atoms[k].kind in BOUNDED_KINDS | {"atan"} for k in others)
            if not others and len(free) == 2:
                P[free[0], free[1]] += wide.plant.expression(coefficient)
                P[free[1], free[0]] += wide.plant.expression(coefficient)
            elif not others and len(free) == 1:
                linear[free[0]] += wide.plant.expression(coefficient)
            elif all(e % 2 == 0 for e in monomial) and positive(coefficient):
                continue
            elif harmless and len(free) <= 1:
                bounded &= not free
            else:
                return None
        return P, linear, bounded

    def _only_rest(self) -> str:
        """Why x* is the only rest of the closed loop; nothing if that was not proved."""
        wide, system = self.wide, self.wide.plant.system
        gamma, mechanics = wide.gamma, system.mechanical
        assert gamma is not None
        if ca.depends_on(ca.jacobian(gamma, system.x), system.x):
            return ""
        if wide.compensation is not None and mechanics is not None:
            slope = ca.jacobian(gamma, mechanics.q)
            if definite(wide.entries(ca.mtimes(slope.T, slope))) and not ca.depends_on(gamma, mechanics.p):
                return "u = grad V there, so gamma = gamma*, which has one solution"
            return ""
        energy, x = (mechanics.V, mechanics.q) if mechanics is not None else (system.S, system.x)
        if self._rests_are_critical() and semidefinite(wide.entries(ca.hessian(energy, x)[0])):
            return "the storage is convex"
        return "the filter's state determines it, by a monotone relation" if self._is_monotone(gamma) else ""

    def _is_monotone(self, gamma: ca.SX) -> bool:
        """``d gamma/d ubar + K_c^-1 >= 0`` where ubar determines the rest: the rests of the filters are one then."""
        wide, found, start, base = self.wide, self.resting, self.flow, self.wide.base
        if found is None or start is None or found.free or found.pending or found.inputs:
            return False
        system = wide.plant.system
        along = ca.substitute(gamma, system.x, ca.vertcat(*[found.solved[k] for k in range(system.n)]))
        slope = ca.jacobian(along, start.constant)
        total = (slope + slope.T) / 2
        if isinstance(base, DynamicExtension | PotentialCompensation | NaturalDamping):
            total = total + wide.matrix(exact_inverse(base.K_c))
        return semidefinite(wide.exact(ca.substitute(total, start.constant, system.u))[0])

    # --- the linearised loop --------------------------------------------------------------------------------------

    @staticmethod
    def closed_loop(wide: Wide) -> ca.SX:
        """The Jacobian of the closed loop in (x, x_c, x_l, psi) at rest: tanh has slope one there, and sech is one."""
        base, system = wide.base, wide.plant.system
        if base is None or wide.gamma is None:
            raise UnsupportedOperation("the closed loop of this law is not written with symbolic parameters")
        N, A = ca.jacobian(wide.gamma, system.x), wide.diagonal(wide.alpha_beta)
        open_loop = ca.jacobian(system.xdot, system.x)
        if isinstance(base, PassiveOutput):
            k_p = _diagonal(wide, base.k_p)
            loop = ca.SX.eye(system.m) + ca.mtimes([k_p, N, system.g])
            pull = ca.solve(loop, ca.mtimes(A, N) + ca.mtimes([k_p, N, open_loop]))
            return open_loop - ca.mtimes(system.g, pull)
        assert isinstance(base, DynamicExtension | PotentialCompensation | NaturalDamping)
        R_c, K_c, zero = wide.matrix(base.R_c), wide.matrix(base.K_c), ca.SX(system.m, system.m)
        # u = u* + held - (sum of pulls), and xi' = -(gain) (what the filter reads and its own part), all linear: for
        # each term the gain, what it pulls by x and by xi, what its filter reads of x, and its own part.
        terms = [(R_c, ca.mtimes(A, N), A, ca.mtimes(A, N), A + K_c)]
        if isinstance(base, NaturalDamping):
            if wide.eta is None or base.Upsilon is None:
                raise UnsupportedOperation("there is no eta")
            B = _diagonal(wide, [a * b for a, b in zip(base.alpha_l, base.beta_l, strict=True)])
            read = ca.mtimes([B, wide.matrix(base.Upsilon), ca.jacobian(wide.eta, system.x)])
            soft = ca.mtimes(B, wide.matrix(base.K_l))
            terms.append((wide.matrix(base.R_l), read, soft, read, soft))
        if isinstance(wide.law, Integral):
            law, one = wide.law, ca.SX.eye(system.m)
            B = _diagonal(wide, [a * b for a, b in zip(law.alpha_psi, law.beta_psi, strict=True)])
            terms.append((one, ca.SX(system.m, system.n), B, -ca.mtimes(B, N), wide.matrix(law.R_psi)))
        comp = wide.compensation
        held = ca.SX(system.m, system.n) if comp is None else ca.jacobian(comp, system.x)
        driven = held - sum((by_x for _, by_x, _, _, _ in terms), ca.SX(system.m, system.n))
        pulls = ca.horzcat(*[by_filter for _, _, by_filter, _, _ in terms])
        rows = [ca.horzcat(open_loop + ca.mtimes(system.g, driven), -ca.mtimes(system.g, pulls))]
        for i, (gain, _, _, read, own) in enumerate(terms):
            beside = [-ca.mtimes(gain, own) if i == j else zero for j in range(len(terms))]
            rows.append(ca.horzcat(-ca.mtimes(gain, read), *beside))
        return ca.vertcat(*rows)


def _diagonal(wide: Wide, values: Sequence[Fraction]) -> ca.SX:
    return ca.diag(ca.vertcat(*map(wide.plant.number, values)))


def _is_regular(matrix: Sequence[Sequence[Quotient]]) -> bool:
    """Whether the determinant has one sign."""
    return has_one_sign(_characteristic(matrix)[-1])


def _characteristic(matrix: Sequence[Sequence[Quotient]]) -> list[Quotient]:
    """Coefficients of det(s I - A), leading one first (Faddeev and LeVerrier)."""
    size = range(len(matrix))
    field = matrix[0][0].field
    zero, one = field.const(0), field.const(1)
    M = [[zero for _ in size] for _ in size]
    coefficients = [one]
    for k in range(1, len(matrix) + 1):
        product = [[sum((matrix[i][j] * M[j][c] for j in size), zero) for c in size] for i in size]
        M = [[product[i][c] + (coefficients[-1] if i == c else zero) for c in size] for i in size]
        trace = sum((matrix[i][j] * M[j][i] for i in size for j in size), zero)
        coefficients.append(-trace * field.const(Fraction(1, k)))
    return coefficients


def routh_column(matrix: Sequence[Sequence[Quotient]]) -> Iterator[Quotient]:
    """The first column of Routh's array of det(s I - A), without the leading one: all positive iff A is Hurwitz.

    Raises ZeroDivisionError where an entry is the zero function.
    """
    coefficients = _characteristic(matrix)
    upper, lower = coefficients[0::2], coefficients[1::2]
    zero = coefficients[0].field.const(0)
    while lower:
        yield lower[0]
        padded = [*lower, *[zero] * (len(upper) - len(lower))]
        upper, lower = lower, [a - upper[0] / lower[0] * b for a, b in zip(upper[1:], padded[1:], strict=True)]
