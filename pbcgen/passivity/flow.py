"""What moves where the Lyapunov function rests, and the equations that hold there from the start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
from flint import fmpq

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.construction import drift_by_construction
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.elimination import definite
from pbcgen.proof.nonnegative import positive
from pbcgen.proof.squares import decompose
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import Row, reduce_rows

#: A dissipation that varies is looked at by blocks for at most so many states.
_LARGEST_VARYING = 30


@dataclass(frozen=True, eq=False)
class Flow:
    """What moves on the invariant set: ``x' = f + g (u_c + ubar)`` with constant ubar.

    Attributes:
        plant: the system.
        constant: the m symbols ubar.
        drift: n x 1 expression of x, ubar and the parameters, that x' equals on the set.
        base: equations that hold on the set from the start, a column.
    """

    plant: Plant
    constant: ca.SX
    drift: ca.SX
    base: ca.SX


def flow(
    plant: Plant, structure: PowerStructure, gamma: ca.SX, compensation: ca.SX | None, still: ca.SX | None = None
) -> Flow:
    """The flow on the set where the dissipation vanishes and gamma (and ``still``) is constant.

    Args:
        plant: the system.
        structure: a power structure that proves Assumption 1, with grad gamma = -F^-1 g (or -A g).
        gamma: m x 1.
        compensation: u_c, m x 1, or None.
        still: other functions that are constant on the set (eta for natural damping), or None.
    """
    system = plant.system
    ubar = ca.SX.sym("ubar", system.m)
    u = ubar if compensation is None else compensation + ubar
    mechanics = system.mechanical
    if mechanics is not None and _velocity_vanishes(plant, structure, gamma):
        force = ca.mtimes(mechanics.G, u) - ca.gradient(mechanics.V, mechanics.q)
        return Flow(plant, ubar, ca.SX(system.n, 1), ca.vertcat(mechanics.p, force))
    drift = system.f + ca.mtimes(system.g, u)
    psi = ca.jacobian(gamma, system.x).T
    v = plant.gradient - ca.mtimes(psi, u) if structure.form == "F" else drift
    rest = [_without_loss(plant, structure.dissipation(), v), ca.dot(structure.remainder, plant.gradient)]
    rest.append(ca.mtimes(psi.T, drift))
    if still is not None:
        rest.append(ca.mtimes(ca.jacobian(still, system.x), drift))
    return Flow(plant, ubar, drift, ca.vertcat(*rest))


def flow_by_balance(plant: Plant, gamma: ca.SX, compensation: ca.SX | None) -> Flow:
    """The same without a power structure: ``u^T gamma' - S'`` is nowhere negative, and zero on the set; so is gamma'.

    Raises UnsupportedOperation for models that are not analytic.
    """
    system = plant.system
    ubar = ca.SX.sym("ubar", system.m)
    u = ubar if compensation is None else compensation + ubar
    rate = ca.mtimes(ca.jacobian(gamma, system.x), system.xdot)
    loss = ca.dot(system.u, rate) - ca.dot(plant.gradient, system.xdot)
    _, (value,) = plant.exact(loss)
    squares = decompose(value.scalar(value.entries[0, 0].field.const(0))) if value.entries else []
    alone = [plant.expression(square.vector[0]) for square in squares or [] if not square.factors]
    base = ca.substitute(ca.vertcat(loss, *alone, rate), system.u, u)
    drift = system.f + ca.mtimes(system.g, u)
    return Flow(plant, ubar, drift, base)


def _without_loss(plant: Plant, B: ca.SX, v: ca.SX) -> ca.SX:
    """``B v = 0``, with ``v_k = 0`` for the blocks of a varying B that are definite."""
    lost = ca.mtimes(B, v)
    if not ca.depends_on(B, plant.system.x) or B.shape[0] > _LARGEST_VARYING:
        return lost
    try:
        field_, (matrix,) = plant.exact(B)
    except (UnsupportedOperation, ZeroDivisionError):
        return lost
    dense = matrix.dense(field_.const(0))
    rows = [lost[k] for k in range(len(dense))]
    for block in _blocks(dense):
        if definite([[dense[i][j] for j in block] for i in block]):
            for k in block:
                rows[k] = v[k]
    return ca.vertcat(*rows)


def _blocks(matrix: Sequence[Sequence[Quotient]]) -> list[list[int]]:
    """Positions that the entries of a symmetric matrix join."""
    left, blocks = set(range(len(matrix))), []
    while left:
        block, edge = set(), {min(left)}
        while edge:
            block |= edge
            edge = {j for i in edge for j in left - block if not matrix[i][j].is_zero()}
        blocks.append(sorted(block))
        left -= block
    return blocks


def _velocity_vanishes(plant: Plant, structure: PowerStructure, gamma: ca.SX) -> bool:
    """Whether q' = 0 on the set: ``D q' = 0`` and ``gamma' = (d gamma/dq) q' = 0`` have no other solution.

    There ``q'^T D q' = 0``, which is nowhere negative, so that D q' = 0 for a symmetric D. With q' = 0 also p = 0,
    because M > 0, and p' = G u - grad V vanishes: nothing needs to be known of M.
    """
    system, mechanics = plant.system, plant.system.mechanical
    assert mechanics is not None
    if not (structure.known and plant.gradient_is_exact and drift_by_construction(system)):
        return False
    if ca.depends_on(gamma, mechanics.p):
        return False
    try:
        field_, (damping, slope) = plant.exact(mechanics.D, ca.jacobian(gamma, mechanics.q))
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    zero = field_.const(0)
    D = damping.dense(zero)
    if any(not (D[i][j] - D[j][i]).is_zero() for i in range(len(D)) for j in range(i)):
        return False
    alone = [k for k, line in enumerate(D) if all(k == j or entry.is_zero() for j, entry in enumerate(line))]
    rows: list[Row] = [{k: fmpq(1)} for k in alone if positive(D[k][k])]
    for line in [*D, *slope.dense(zero)]:
        numbers = [entry.constant() for entry in line]
        if all(number is not None for number in numbers):
            rows.append(dict(enumerate(numbers)))
    return len(reduce_rows(rows)) == mechanics.q.numel()
