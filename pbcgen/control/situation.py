"""What the stability claims rest on: a law at its target, with what is made of it when a claim asks for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
from flint import fmpq

from pbcgen.errors import UnsupportedOperation
from pbcgen.law.compensation import compensated_force
from pbcgen.law.gain_matrices import exact_inverse
from pbcgen.models.gains import Matrix, Vector
from pbcgen.models.laws import BaseLaw, Integral, Law, NaturalDamping, base_law, filters, shaping
from pbcgen.passivity.flow import Flow, flow, flow_by_balance
from pbcgen.passivity.lasalle import InvariantSet, branches, invariant_set
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.structure import PowerStructure
from pbcgen.passivity.undamped import Plane, undamped_plane
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.spectrum import Stability, hurwitz
from pbcgen.sampling.family import LoopFamily
from pbcgen.sampling.transition import LinearLoop
from pbcgen.symbolic.linear import Inconsistent, reduce_rows
from pbcgen.symbolic.real import Real, fraction, sign

#: Loops of more states are linearised only where the storage leaves a claim open: that takes dense matrices.
LARGEST_LINEARISED = 50


@dataclass(frozen=True, eq=False)
class Situation:
    """What the stability claims rest on.

    Attributes:
        plant, point, law: the system at x* and the law with resolved gains.
        gamma: m x 1. eta: s x 1 or None.
        structure: a power structure that proves Assumption 1 and matches gamma, or None.
        damping_to_spare: whether Theta > 0, for natural damping.
        found: the claims so far.
    """

    plant: Plant
    point: Point
    law: Law
    gamma: ca.SX
    eta: ca.SX | None
    structure: PowerStructure | None
    damping_to_spare: bool
    found: Mapping[str, Claim]

    @property
    def base(self) -> BaseLaw:
        """The law without the integral term."""
        return base_law(self.law)

    @property
    def compensation(self) -> ca.SX | None:
        """grad V for potential compensation, else None."""
        return compensated_force(self.plant.system, self.law)

    @property
    def gains(self) -> tuple[Vector, Vector, Matrix | None]:
        """alpha, beta, K_c (None for `passive-output`)."""
        term = shaping(self.law)
        return term.alpha, term.beta, term.K_c

    @property
    def compliance(self) -> ca.SX:
        """``K_c^{-1}``, m x m; zero for `passive-output`."""
        _, _, K_c = self.gains
        if K_c is None:
            return ca.SX(self.plant.system.m, self.plant.system.m)
        return ca.vertcat(*[ca.horzcat(*map(self.plant.number, row)) for row in exact_inverse(K_c)])

    @property
    def order(self) -> int:
        """The number of states of plant and controller."""
        return self.plant.system.n + self.plant.system.m * filters(self.law)

    @cached_property
    def family(self) -> LoopFamily:
        """The closed loop linearised at x*, for any gains: dense matrices."""
        return LoopFamily.of(self.plant, self.point, self.gamma, self.eta)

    @cached_property
    def loop(self) -> LinearLoop:
        """The closed loop linearised at x*."""
        return self.family.loop(self.law)

    @cached_property
    def linearised(self) -> Stability:
        """Whether the linearised continuous loop is Hurwitz."""
        return hurwitz(self.loop.continuous())

    @property
    def _held_input(self) -> tuple[Real, ...]:
        """What the saturated terms hold at x*: u*, or nothing where the compensation holds it."""
        return self.point.u if self.compensation is None else (fmpq(0),) * self.plant.system.m

    @property
    def read(self) -> ca.SX:
        """What the controller reads of the state: gamma, and eta for natural damping; a column."""
        if isinstance(self.base, NaturalDamping) and self.eta is not None:
            return ca.vertcat(self.gamma, self.eta)
        return self.gamma

    @cached_property
    def undamped_plane(self) -> Plane | None:
        """A plane through x* in which the plant moves by itself and the controller sees nothing, or None."""
        return undamped_plane(self.plant, self.point, self.read, self.compensation)

    @cached_property
    def undamped_set(self) -> InvariantSet | None:
        """The invariant set at u = u* with what the controller reads as at x*, if it is more than a point."""
        found = self.at_target(self.read)
        return None if found is None or not found.closed or found.pending or not found.free else found

    @cached_property
    def flow(self) -> Flow | None:
        """What moves on the invariant set, or None when the Lyapunov function does not give one."""
        if isinstance(self.law, Integral) or (isinstance(self.base, NaturalDamping) and not self.damping_to_spare):
            return None  # Theta > 0 is what makes eta', y and x_l' vanish where the Lyapunov function rests
        if self.structure is None:
            return self._flow_by_balance()
        still = self.eta if isinstance(self.base, NaturalDamping) else None
        return flow(self.plant, self.structure, self.gamma, self.compensation, still)

    def _flow_by_balance(self) -> Flow | None:
        output = self.found.get("passive-output")
        if output is None or output.status is not Status.PROVED or isinstance(self.base, NaturalDamping):
            return None
        try:
            return flow_by_balance(self.plant, self.gamma, self.compensation)
        except (UnsupportedOperation, ZeroDivisionError):
            return None

    @cached_property
    def _elimination(self) -> tuple[list[InvariantSet], str]:
        """Parts of the invariant set, or why there are none."""
        if self.flow is None:
            return [], "nothing says what vanishes on it: no power structure, or no damping to spare"
        try:
            found = branches(self.flow)
            parts = found if len(found) < 2 else [part for part in found if part.resting or not self._empty(part)]
            return parts, "" if found else "it has too many branches"
        except (UnsupportedOperation, ZeroDivisionError, Inconsistent) as reason:
            return [], str(reason)

    @property
    def _parts(self) -> list[InvariantSet]:
        return self._elimination[0]

    @property
    def unreduced(self) -> str:
        """How far LaSalle's invariant set was reduced, where it was not to equilibria; else an empty string."""
        parts, why = self._elimination
        if parts and all(part.resting for part in parts):
            return ""
        if not parts:
            return f"LaSalle's invariant set was not reduced: {why}"
        part = next(part for part in parts if not part.resting)
        names = ", ".join(self.plant.system.state_names[k] for k in part.free) or "no state"
        known = "; ".join(part.steps) or "nothing"
        end = "every Lie derivative was followed" if part.closed else "the Lie derivatives did not end"
        left = f"{len(part.pending)} equations could not be solved" if part.pending else "no equation is left"
        return f"LaSalle's invariant set was reduced to {known}, with {names} free: {end}, and {left}"

    def _empty(self, part: InvariantSet) -> bool:
        """Whether the filters cannot rest on a part of the invariant set.

        Where all inputs are u* there, the filters rest only if gamma = gamma*; an equation of the part in states that
        this fixes, which does not hold at x*, then holds nowhere.
        """
        plant, system = self.plant, self.plant.system
        fixed = self._numbers(self._held_input)
        if fixed is None or len(part.inputs) < system.m or not part.pending:
            return False
        change = ca.vertcat(*[part.inputs[j] - fixed[j] for j in range(system.m)])
        field, (changes, pending, slope) = plant.exact(
            change, ca.vertcat(*part.pending), ca.jacobian(self.gamma, system.x)
        )
        zero = field.const(0)
        equations = [value for value in pending.column(zero) if value.numerator.total_degree() > 0]
        for value in changes.column(zero):
            if not any(divmod(value.numerator, e.numerator)[1].is_zero() for e in equations):
                return False
        rows = [[entry.constant() for entry in row] for row in slope.dense(zero)]
        known = reduce_rows([dict(enumerate(row)) for row in rows if None not in row])
        held = {int(str(k)) for k, row in known.items() if not any(c for j, c in row.items() if j != k)}
        for value in equations:
            if value.symbols() <= held:
                ((entry,),) = plant.at(self.point, plant.expression(value))
                if sign(entry[0]) in (1, -1):
                    return True
        return False

    @cached_property
    def invariant(self) -> InvariantSet | None:
        """The invariant set with ubar unknown, or None when it is not available."""
        if self.flow is None or len(self._parts) == 1:
            return self._parts[0] if self._parts else None
        try:
            return invariant_set(self.flow)
        except (UnsupportedOperation, ZeroDivisionError, Inconsistent):
            return None

    @cached_property
    def branches(self) -> list[InvariantSet]:
        """The invariant set, or parts that it is the union of; nothing when it is not available."""
        if len(self._parts) > 1 and all(part.resting for part in self._parts):
            return self._parts
        return [] if self.invariant is None else [self.invariant]

    @cached_property
    def branches_near_target(self) -> list[InvariantSet]:
        """The same for what lies near x*: without parts with an equation that certainly does not hold at x* and u*."""
        near = [part for part in self._parts if part.resting or not self._is_away(part)]
        return near if near and all(part.resting for part in near) else self.branches

    def _is_away(self, part: InvariantSet) -> bool:
        assert self.flow is not None
        system, constant = self.plant.system, self.flow.constant
        relations = [system.x[k] - value for k, value in part.solved.items()]
        relations += [constant[j] - value for j, value in part.inputs.items()]
        column = ca.substitute(ca.vertcat(ca.SX(0, 1), *relations, *part.pending), constant, system.u)
        (values,) = self.plant.at(Point(self.point.x, self._held_input), column)
        return any(sign(row[0]) in (1, -1) for row in values)

    def at_target(self, *functions: ca.SX) -> InvariantSet | None:
        """The invariant set with u = u* and ``functions`` at their values of x*; None when those are not exact."""
        start, fixed = self.flow, self._numbers(self._held_input)
        values = [row[0] for function in functions for row in self.plant.at(self.point, function)[0]]
        known = self._numbers(values)
        if start is None or fixed is None or known is None:
            return None
        try:
            return invariant_set(start, fixed, ca.vertcat(*functions) - known)
        except (UnsupportedOperation, ZeroDivisionError, Inconsistent):
            return None

    def _numbers(self, values: Sequence[Real]) -> ca.SX | None:
        """Exact values as a column that may be put into expressions, or None when one is not exact."""
        exact = [fraction(v) for v in values if isinstance(v, fmpq)]
        column = ca.vertcat(*[self.plant.number(v, alone=True) for v in exact])
        return ca.SX(column) if len(exact) == len(values) else None
