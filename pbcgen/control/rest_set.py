"""The equilibria on the invariant set, by coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from pbcgen.control.situation import Situation
from pbcgen.passivity.lasalle import InvariantSet


@dataclass(frozen=True, eq=False)
class RestSet:
    """An invariant set that consists of equilibria, by its free coordinates z.

    Attributes:
        z: the states, and entries of u that stand for the constant inputs, that are left.
        inputs: all constant inputs as functions of z, m x 1.
        outputs: gamma there, plus ``K_c^{-1}`` times the inputs, m x 1.
        zero: functions that vanish on the set, a column.
    """

    z: list[ca.SX]
    inputs: ca.SX
    outputs: ca.SX
    zero: ca.SX

    @staticmethod
    def of(situation: Situation, found: InvariantSet) -> RestSet:
        """What elimination left of the invariant set."""
        system, start = situation.plant.system, situation.flow
        assert start is not None
        constant = ca.vertsplit(start.constant)
        replaced = [system.x[k] for k in found.solved] + [constant[j] for j in found.inputs]
        values = [*found.solved.values(), *found.inputs.values()]
        expressions = [
            start.constant,
            situation.gamma + ca.mtimes(situation.compliance, start.constant),
            ca.vertcat(ca.SX(0, 1), *found.pending),
        ]
        if replaced:
            old, new = ca.vertcat(*replaced), ca.densify(ca.vertcat(*values))
            expressions = [ca.substitute(e, old, new) for e in expressions]
        expressions = [ca.substitute(e, start.constant, system.u) for e in expressions]
        z = [system.x[k] for k in found.free] + [system.u[j] for j in range(system.m) if j not in found.inputs]
        return RestSet(z, *expressions)
