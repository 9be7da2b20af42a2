"""What the claims of attraction rest on, and from stable to asymptotically stable where the linearisation is silent.

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
from flint import fmpq

from pbcgen.control.family import LoopFamily
from pbcgen.control.gain_matrices import exact_inverse
from pbcgen.control.transition import LinearLoop
from pbcgen.errors import UnsupportedOperation
from pbcgen.models.gains import Matrix, Vector
from pbcgen.models.laws import Integral, Law, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.passivity.dissipation import NaturalDampingBounds, theta_is_strict
from pbcgen.passivity.lasalle import Flow, InvariantSet, flow, invariant_set
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import as_balls
from pbcgen.symbolic.linear import Inconsistent, Row, reduce_rows
from pbcgen.symbolic.real import BITS, Real, approximate, fraction, precision, sign, text
from pbcgen.symbolic.tape import exact_decimal


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

    @property
    def compliance(self) -> ca.SX:
        """``K_c^{-1}``, m x m; zero for `passive-output`."""
        _, _, K_c = self.gains
        if K_c is None:
            return ca.SX(self.plant.system.m, self.plant.system.m)
        return ca.vertcat(*[ca.horzcat(*map(self.plant.number, row)) for row in exact_inverse(K_c)])

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
