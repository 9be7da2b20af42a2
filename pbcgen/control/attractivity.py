"""From stable to asymptotically stable, locally and globally: LaSalle's invariant set, growth, other equilibria.

On the invariant set the filters rest: with ``w = ubar + kappa`` the saturated term gives ``w = -alpha tanh(beta z)``
and the filter ``K_c x_c = w`` (no x_c for `passive-output`), hence

    gamma(x) - gamma* + K_c^{-1} w + beta^{-1} atanh(w / alpha) = 0.                                    (rest)

Under potential compensation u = grad V + ubar, and kappa is zero in this relation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from flint import fmpq
from numpy.typing import NDArray

from pbcgen.control.family import LoopFamily
from pbcgen.control.gain_matrices import exact_inverse
from pbcgen.control.transition import LinearLoop
from pbcgen.errors import UnsupportedOperation
from pbcgen.models.gains import Matrix, Vector
from pbcgen.models.laws import Integral, Law, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.passivity.construction import drift_by_construction
from pbcgen.passivity.dissipation import NaturalDampingBounds, theta_is_strict
from pbcgen.passivity.inertia import missing_for_definiteness
from pbcgen.passivity.lasalle import Flow, InvariantSet, flow, invariant_set
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.structure import PowerStructure
from pbcgen.passivity.unbounded import Growth, radially_unbounded
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import as_balls
from pbcgen.proof.elimination import semidefinite
from pbcgen.proof.newton import Search, find_zeros, krawczyk, polish
from pbcgen.proof.nonnegative import positive
from pbcgen.symbolic.linear import Inconsistent, Row, reduce_rows
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, approximate, ball, fraction, precision, rational, sign, text
from pbcgen.symbolic.tape import Tape, exact_decimal

#: Starts of the search for other equilibria.
_STARTS = 30
#: Other equilibria are not searched for in systems with more states.
_LARGEST_SEARCH = 12

#: Functions that are defined and smooth for every argument.
_ENTIRE_KINDS = frozenset({"sin", "cos", "exp", "tanh", "atan", "asinh", "erf"})


@dataclass(frozen=True, eq=False)
class Situation:
    """What the stability claims rest on.

    Attributes:
        plant, point, law: the system at x* and the law with resolved gains.
        gamma: m x 1. eta: s x 1 or None.
        structure: a power structure that proves Assumption 1 and matches gamma, or None.
        bounds: of Assumption 3, for natural damping.
        family, loop: the linearised closed loop, for other gains and for these.
        found: the claims so far.
    """

    plant: Plant
    point: Point
    law: Law
    gamma: ca.SX
    eta: ca.SX | None
    structure: PowerStructure | None
    bounds: NaturalDampingBounds | None
    family: LoopFamily
    loop: LinearLoop
    found: Mapping[str, Claim]

    @property
    def base(self) -> Law:
        """The law without the integral term."""
        return self.law.base if isinstance(self.law, Integral) else self.law

    @property
    def compensation(self) -> ca.SX | None:
        """grad V for potential compensation, else None."""
        mechanics = self.plant.system.mechanical
        if isinstance(self.base, PotentialCompensation) and mechanics is not None:
            return ca.gradient(mechanics.V, mechanics.q)
        return None

    @property
    def gains(self) -> tuple[Vector, Vector, Matrix | None]:
        """alpha, beta, K_c (None for `passive-output`)."""
        base = self.base
        if isinstance(base, NaturalDamping):
            return base.alpha_c, base.beta_c, base.K_c
        if isinstance(base, PassiveOutput):
            return base.alpha, base.beta, None
        if isinstance(base, Integral):
            raise TypeError("an integral law has no integral base")
        return base.alpha, base.beta, base.K_c

    @cached_property
    def flow(self) -> Flow | None:
        """What moves on the invariant set, or None when the Lyapunov function does not give one."""
        if self.structure is None or isinstance(self.law, Integral) or not self._theta_strict():
            return None
        still = self.eta if isinstance(self.base, NaturalDamping) else None
        return flow(self.plant, self.structure, self.gamma, self.compensation, still)

    @cached_property
    def invariant(self) -> InvariantSet | None:
        """The invariant set with ubar unknown, or None when it is not available."""
        if self.flow is None:
            return None
        try:
            return invariant_set(self.flow)
        except (UnsupportedOperation, ZeroDivisionError, Inconsistent):
            return None

    def _theta_strict(self) -> bool:
        """Theta > 0 is what makes eta', y and x_l' vanish where the Lyapunov function rests."""
        if not isinstance(self.base, NaturalDamping):
            return True
        return self.bounds is not None and theta_is_strict(self.bounds, self.base)

    def at_target(self, *functions: ca.SX) -> InvariantSet | None:
        """The invariant set with u = u* and ``functions`` at their values of x*; None when those are not decimals."""
        inputs: list[Real] = [fmpq(0)] * len(self.point.u) if self.compensation is not None else list(self.point.u)
        fixed = [_decimal(v) for v in inputs]
        start = self.flow
        if start is None or any(v is None for v in fixed):
            return None
        equations = []
        for function in functions:
            (values,) = self.plant.at(self.point, function)
            for expression, row in zip(ca.vertsplit(function), values, strict=True):
                value = _decimal(row[0])
                if value is None:
                    return None
                equations.append(expression - value)
        try:
            at_rest = ca.SX(ca.DM([v for v in fixed if v is not None]))
            return invariant_set(start, at_rest, ca.vertcat(*equations))
        except (UnsupportedOperation, ZeroDivisionError, Inconsistent):
            return None


def _decimal(value: Real) -> float | None:
    """The double that denotes the exact number, or None."""
    if not isinstance(value, fmpq):
        return None
    rounded = approximate(value)
    return rounded if exact_decimal(rounded) == fraction(value) else None


# --- local -------------------------------------------------------------------------------------------------------


def beyond_linearisation(situation: Situation, by_lyapunov: bool) -> Claim | None:
    """Decide `asymptotically-stable` where the linearisation does not, or None.

    PROVED when the invariant set consists of equilibria and x* is an isolated one (regular Jacobian of the closed
    loop). REFUTED when a linear function of the state is conserved by every input, or when the invariant set at
    u = u* is more than x*: there the Lyapunov function stays above its minimum.
    """
    conserved = _conserved(situation)
    if conserved is not None:
        return conserved
    if not by_lyapunov:
        return None
    found = situation.invariant
    if found is not None and found.resting and _isolated(situation):
        chain = "; ".join(found.steps)
        return Claim(
            "asymptotically-stable",
            Status.PROVED,
            "near x*",
            "Lyapunov function and LaSalle's invariant set by elimination",
            f"where the Lyapunov function rests: {chain}; so x' = 0, and x* is an isolated equilibrium",
        )
    return _undamped(situation)


def _isolated(situation: Situation) -> bool:
    with precision(BITS):
        return sign(as_balls(situation.loop.continuous()).det()) in (1, -1)


def _conserved(situation: Situation) -> Claim | None:
    """A linear combination c^T x with ``c^T f = 0`` and ``c^T g = 0``."""
    plant = situation.plant
    system = plant.system
    try:
        field, (f, g) = plant.exact(system.f, system.g)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    zero = field.const(0)
    functions = [[entry, *row] for entry, row in zip(f.column(zero), g.dense(zero), strict=True)]
    if not all(entry.is_polynomial() for row in functions for entry in row):
        return None
    rows: dict[object, Row] = {}
    for i, row in enumerate(functions):
        for j, entry in enumerate(row):
            for exponents, coefficient in entry.numerator.to_dict().items():
                rows.setdefault((j, tuple(exponents)), {})[i] = coefficient
    solved = reduce_rows(rows.values())
    free = [k for k in range(system.n) if k not in solved]
    if not free:
        return None
    weights = {free[0]: fmpq(1)}
    weights |= {int(str(p)): -r[free[0]] for p, r in solved.items() if free[0] in r}
    names = system.state_names
    shown = " + ".join(f"{text(c)}*{names[k]}" for k, c in sorted(weights.items()) if c != 0)
    return Claim(
        "asymptotically-stable",
        Status.REFUTED,
        "near x*",
        "a conserved linear function, over the rationals",
        f"{shown} is constant along every trajectory, whatever the input",
        "remove the conserved quantity from the model by eliminating a state",
        {"conserved": shown},
    )


def _undamped(situation: Situation) -> Claim | None:
    """An invariant set at u = u* that is more than a point."""
    constants = [situation.gamma]
    if isinstance(situation.base, NaturalDamping) and situation.eta is not None:
        constants.append(situation.eta)
    found = situation.at_target(*constants)
    if found is None or not found.closed or found.pending or not found.free:
        return None
    names = situation.plant.system.state_names
    free = ", ".join(names[k] for k in found.free)
    return Claim(
        "asymptotically-stable",
        Status.REFUTED,
        "near x*",
        "invariant set at u = u*, by elimination",
        f"trajectories with u = u* and gamma = gamma* form an invariant set in which {free} are free, without damping",
        "add damping to this motion, or an output that sees it",
        {"relations": list(found.steps), "free": [names[k] for k in found.free]},
    )


# --- global ------------------------------------------------------------------------------------------------------


def globally(situation: Situation, by_lyapunov: bool, asymptotic: Claim) -> Claim:
    """The claim `globally-asymptotically-stable`."""
    if asymptotic.status is Status.REFUTED:
        return _verdict(
            Status.REFUTED, asymptotic.method, asymptotic.evidence, asymptotic.hint, asymptotic.counterexample
        )
    proved_or_open = _by_storage(situation, by_lyapunov)
    if proved_or_open.status is Status.PROVED:
        return proved_or_open
    return _second_equilibrium(situation) or proved_or_open


def _by_storage(situation: Situation, by_lyapunov: bool) -> Claim:
    """PROVED by the Lyapunov function, or what is missing for that."""
    if isinstance(situation.law, Integral):
        return _verdict(
            Status.UNDECIDED,
            "not available",
            "the linearisation of Prop. pro:int gives local stability only",
            "use the law without the integral term for a global claim",
        )
    missing = _global_premises(situation, by_lyapunov)
    if missing:
        return _verdict(Status.UNDECIDED, "Lyapunov function and LaSalle", missing[0], missing[1])
    growth = _growth(situation)
    if not growth.proved:
        return _verdict(
            Status.UNDECIDED,
            "radial unboundedness",
            growth.reason,
            _to_grow(situation),
        )
    unique = _only_rest(situation)
    if unique is None:
        return _verdict(
            Status.UNDECIDED,
            "LaSalle's invariant set by elimination",
            "it was not proved that x* is the only point of the invariant set",
            "rely on the local claim; no other equilibrium was found",
        )
    return _verdict(
        Status.PROVED,
        "Lyapunov function, LaSalle's invariant set and radial unboundedness",
        f"{growth.reason}; {unique}",
    )


def _verdict(
    status: Status, method: str, evidence: str, hint: str = "", counterexample: Mapping[str, object] | None = None
) -> Claim:
    return Claim("globally-asymptotically-stable", status, "all x", method, evidence, hint, counterexample)


def _global_premises(situation: Situation, by_lyapunov: bool) -> tuple[str, str] | None:
    if not by_lyapunov:
        return "the Lyapunov function is not available", "satisfy the claims that `stable` needs by the Lyapunov route"
    needed = ["assumption-1", "passive-output"]
    if isinstance(situation.base, NaturalDamping):
        needed.append("assumption-3")
    for name in needed:
        if situation.found[name].domain != "all x":
            return f"{name} holds only on {situation.found[name].domain}", "extend the assumption to the whole space"
    if situation.plant.system.domain:
        return (
            "the model is stated on a domain, not on the whole space",
            "remove the domain if the model holds everywhere",
        )
    undefined = _undefined(situation)
    if undefined:
        return undefined, "rely on the local claim"
    found = situation.invariant
    if found is None or not found.resting:
        return "the invariant set was not reduced to equilibria", "rely on the local claim"
    return None


def _undefined(situation: Situation) -> str:
    """Why f, g, S and gamma are not known to be smooth on the whole space; M^-1 is, where M is and M > 0."""
    plant, system = situation.plant, situation.plant.system
    parts = [system.f, system.g, system.S, situation.gamma]
    mechanics = system.mechanical
    if mechanics is not None and plant.gradient_is_exact and drift_by_construction(system):
        missing = missing_for_definiteness(plant)
        if missing:
            return missing
        parts = [mechanics.M, mechanics.V, mechanics.D, mechanics.G, situation.gamma]
    try:
        field, _ = plant.exact(*parts)
    except (UnsupportedOperation, ZeroDivisionError) as reason:
        return str(reason)
    fine = all(atom.kind in _ENTIRE_KINDS for atom in field.atoms.values())
    fine = fine and all(positive(d) or positive(-d) for d in field.divisors.values())
    return "" if fine else "f, g or S is not defined on the whole space"


def _growth(situation: Situation) -> Growth:
    alpha, _, _ = situation.gains
    kappa = [-u for u in situation.point.u]
    return radially_unbounded(situation.plant, situation.gamma, alpha, kappa, situation.compensation is not None)


def _to_grow(situation: Situation) -> str:
    """What would make the storage radially unbounded, as far as that is known."""
    alpha, _, _ = situation.gains
    weak = [a for a, u in zip(alpha, situation.point.u, strict=True) if a <= abs(approximate(u))]
    rely = "rely on the local claim; `pbcgen region` finds states from where the loop certainly settles"
    return f"raise alpha above |kappa|, or {rely}" if weak and situation.compensation is None else rely


def _only_rest(situation: Situation) -> str | None:
    """Why x* is the only equilibrium of the invariant set, or None."""
    found = situation.invariant
    assert found is not None
    if _convex(situation):
        return "the invariant set consists of equilibria (" + "; ".join(found.steps) + "), and the storage is convex"
    if len(found.inputs) == situation.plant.system.m and all(v.is_zero() for v in map(ca.SX, found.inputs.values())):
        zero = situation.compensation is not None or all(isinstance(u, fmpq) and u == 0 for u in situation.point.u)
        if zero and _injective(situation, found):
            return "the invariant set forces " + "; ".join(
                [*found.steps, "gamma = gamma*, which has one solution there"]
            )
        at_target = situation.at_target(situation.gamma) if zero else None
        if at_target is not None and not at_target.free and not at_target.pending:
            return "the invariant set forces " + "; ".join(
                dict.fromkeys([*found.steps, "gamma = gamma*", *at_target.steps])
            )
        return None
    if not found.free and not found.pending and not found.inputs and _monotone(situation, found):
        return (
            "the invariant set is parametrised by ubar (" + "; ".join(found.steps) + "), and (rest) is monotone in it"
        )
    return None


def _injective(situation: Situation, found: InvariantSet) -> bool:
    """Whether gamma is affine and one-to-one on the set with ubar = 0, so that gamma = gamma* leaves x* only."""
    system, start = situation.plant.system, situation.flow
    assert start is not None
    along = situation.gamma
    if found.solved:
        old = ca.vertcat(*[system.x[k] for k in found.solved])
        values = ca.substitute(ca.densify(ca.vertcat(*found.solved.values())), start.constant, ca.SX.zeros(system.m))
        along = ca.substitute(along, old, values)
    if not found.free:
        return True
    try:
        field, (slope,) = situation.plant.exact(ca.jacobian(along, ca.vertcat(*[system.x[k] for k in found.free])))
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    rows = [[entry.constant() for entry in row] for row in slope.dense(field.const(0))]
    if any(entry is None for row in rows for entry in row):
        return False
    return len(reduce_rows([dict(enumerate(row)) for row in rows])) == len(found.free)


def _convex(situation: Situation) -> bool:
    """Whether equilibria of the closed loop are critical points of a convex function: then x* is the only one.

    With f + g u = F (grad S - grad gamma u), F regular, a rest has ``grad (S + kappa^T gamma + Phi_c) = 0``. Phi_c and
    kappa^T gamma are convex for affine gamma, so S convex is enough; the Hessian at x* is positive definite, which
    makes the minimiser unique. For a mechanical system S may be replaced by V(q), because p = 0 at rest.
    """
    plant, structure = situation.plant, situation.structure
    system = plant.system
    if structure is None or structure.form != "F" or situation.compensation is not None:
        return False
    mechanics = system.mechanical
    energy, variables = (mechanics.V, mechanics.q) if mechanics is not None else (system.S, system.x)
    try:
        field, (hessian, slope, F, rho) = plant.exact(
            ca.hessian(energy, variables)[0],
            ca.jacobian(situation.gamma, system.x),
            ca.det(structure.matrix),
            structure.remainder,
        )
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    zero = field.const(0)
    determinant = F.scalar(zero)
    regular = not determinant.is_zero() and (positive(determinant) or positive(-determinant))
    affine = all(entry.constant() is not None for row in slope.dense(zero) for entry in row)
    no_remainder = all(entry.is_zero() for entry in rho.column(zero))
    return regular and affine and no_remainder and semidefinite(hessian.dense(zero))


def _monotone(situation: Situation, found: InvariantSet) -> bool:
    """``d gamma/d ubar + K_c^{-1} >= 0`` along the solved states: (rest) then has one solution."""
    plant = situation.plant
    system = plant.system
    _, _, K_c = situation.gains
    start = situation.flow
    assert start is not None
    along = ca.substitute(situation.gamma, system.x, ca.vertcat(*[found.solved[k] for k in range(system.n)]))
    slope = ca.jacobian(along, start.constant)
    compliance = ca.SX(system.m, system.m) if K_c is None else _exact_matrix(plant, exact_inverse(K_c))
    total = ca.substitute((slope + slope.T) / 2 + compliance, start.constant, system.u)
    try:
        field, (values,) = plant.exact(total)
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    return semidefinite(values.dense(field.const(0)))


def _second_equilibrium(situation: Situation) -> Claim | None:
    """Search for a rest of the closed loop away from x*, and certify it."""
    if isinstance(situation.law, Integral) or situation.plant.system.n > _LARGEST_SEARCH:
        return None
    plant, point = situation.plant, situation.point
    system, n = plant.system, plant.system.n
    at_star = ca.SX.sym("at_star", 2 * system.m)
    residual = _rest_equations(situation, at_star[: system.m], at_star[system.m :])
    jacobian = ca.jacobian(residual, ca.vertcat(system.x, system.u))
    with precision(BITS):
        (gamma_star,) = plant.at(point, situation.gamma)
        constants = [*point.u, *[row[0] for row in gamma_star]]
    rounded = ca.DM([approximate(v) for v in constants])
    function = plant.numeric(*[ca.substitute(e, at_star, ca.SX(rounded)) for e in (residual, jacobian)])

    def evaluate(point: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        value, slope = function(point[:n], point[n:])
        return np.array(value).ravel(), np.array(ca.densify(slope))

    star = np.array([approximate(v) for v in (*situation.point.x, *situation.point.u)])
    spread = np.full(n + system.m, 10.0)
    around = Search(star - spread, star + spread, starts=_with_gamma_kept(situation, star), samples=_STARTS)
    tape = Tape.of([*plant.symbols, at_star], [residual, jacobian])
    parameters: list[Real] = [rational(v) for v in plant.parameter_values]

    def in_balls(values: list[Real]) -> tuple[list[Real], list[list[Real]]]:
        value, slope = (v.dense(ZERO) for v in tape.walk(REAL, [values[:n], values[n:], parameters, constants]))
        return [row[0] for row in value], slope

    with precision(BITS):
        for zero in sorted(find_zeros(evaluate, around), key=lambda z: float(np.linalg.norm(z - star))):
            if np.max(np.abs(zero[:n] - star[:n])) < 1e-6 * (1 + np.max(np.abs(star[:n]))):
                continue
            centre = polish(in_balls, list(zero))
            balls = None if centre is None else krawczyk(in_balls, centre)
            if balls is not None and any(
                sign(ball(b) - ball(s)) in (1, -1) for b, s in zip(balls[:n], situation.point.x, strict=True)
            ):
                return _second(situation, balls[:n])
    return None


def _with_gamma_kept(situation: Situation, star: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Starts along which gamma stays near gamma*: elsewhere the saturated law is flat, and Newton's method lost."""
    plant, n = situation.plant, situation.plant.system.n
    slope = plant.numeric(ca.jacobian(situation.gamma, plant.system.x))(star[:n], star[n:])
    N = np.array(ca.densify(slope))
    if not np.all(np.isfinite(N)):
        return ()
    keep = np.eye(n) - np.linalg.pinv(N) @ N
    generator = np.random.default_rng(0)
    moves = generator.uniform(-7.0, 7.0, (_STARTS, n)) @ keep
    return tuple(star + np.concatenate([move, np.zeros(len(star) - n)]) for move in moves)


def _rest_equations(situation: Situation, u_star: ca.SX, gamma_star: ca.SX) -> ca.SX:
    """Equilibria of the closed loop in (x, u): ``f + g (u_c + u) = 0``, and (rest) in the form with tanh."""
    plant, system = situation.plant, situation.plant.system
    alpha, beta, K_c = situation.gains
    comp = situation.compensation
    u = system.u if comp is None else comp + system.u
    w = system.u if comp is not None else system.u - u_star
    inside = situation.gamma - gamma_star
    if K_c is not None:
        inside = inside + ca.mtimes(_exact_matrix(plant, exact_inverse(K_c)), w)
    alpha_, beta_ = (ca.vertcat(*map(plant.number, gain)) for gain in (alpha, beta))
    return ca.vertcat(system.f + ca.mtimes(system.g, u), w + alpha_ * ca.tanh(beta_ * inside))


def _exact_matrix(plant: Plant, rows: Matrix) -> ca.SX:
    """Fractions as a matrix in the plant's expressions."""
    return ca.vertcat(*[ca.horzcat(*map(plant.number, row)) for row in rows])


def _second(situation: Situation, x: list[Real]) -> Claim:
    names = situation.plant.system.state_names
    shown = ", ".join(f"{name} = {text(v, 9)}" for name, v in zip(names, x, strict=True))
    return _verdict(
        Status.REFUTED,
        "Krawczyk test in ball arithmetic",
        f"the closed loop has another equilibrium: {shown}",
        "the claim can only be local; start inside the region of attraction",
        {"x": dict(zip(names, [text(v, 15) for v in x], strict=True))},
    )
