"""From stable to asymptotically stable, where the linearisation is silent or left out: LaSalle's invariant set.

On the invariant set the filters rest: with ``w = ubar + kappa`` the saturated term gives ``w = -alpha tanh(beta z)``
and the filter ``K_c x_c = w`` (no x_c for `passive-output`), hence

    gamma(x) - gamma* + K_c^{-1} w + beta^{-1} atanh(w / alpha) = 0.                                    (rest)

Under potential compensation u = grad V + ubar, and kappa is zero in this relation.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import casadi as ca
from flint import fmpq

from pbcgen.control.leaves import conserved, written
from pbcgen.control.situation import Situation
from pbcgen.errors import UnsupportedOperation
from pbcgen.models.laws import DynamicExtension, PassiveOutput
from pbcgen.passivity.lasalle import InvariantSet
from pbcgen.passivity.structure import PowerStructure
from pbcgen.passivity.undamped import Plane
from pbcgen.proof.claim import Claim, Status
from pbcgen.symbolic.linear import Row, kernel, reduce_rows
from pbcgen.symbolic.real import BITS, REAL, fraction, precision, reals, sign
from pbcgen.symbolic.real_matrices import as_balls


def beyond_linearisation(situation: Situation, by_lyapunov: bool) -> Claim | None:
    """Decide `asymptotically-stable` where the linearisation does not, or None.

    PROVED when the invariant set consists of equilibria and x* is an isolated one (regular Jacobian of the closed
    loop). REFUTED when a linear function of the state is conserved by every input, when the system moves without loss
    in a plane in which the controller sees nothing, or when the invariant set at u = u* is more than x*: there the
    Lyapunov function stays above its minimum.
    """
    decided = _conserved(situation) or _in_a_plane(situation)
    if decided is not None or not by_lyapunov:
        return decided
    parts = situation.branches_near_target
    if parts and all(part.resting for part in parts) and _isolated(situation):
        return _attractive(*parts)
    return _undamped(situation)


def locally_by_storage(situation: Situation) -> Claim | None:
    """`asymptotically-stable` PROVED without the linearised loop, or None; the premises of `stable` must be proved.

    The invariant set consists of equilibria, and these are critical points of the storage, whose Hessian is regular at
    x*: grad S - grad gamma u = A (f + g u), or F^-1 (f + g u) with F regular at x*, and x_c rests where the slope of
    the storage in x_c vanishes.
    """
    structure, parts = situation.structure, situation.branches_near_target
    known = isinstance(situation.law, DynamicExtension | PassiveOutput)
    if not known or structure is None or not parts or not all(part.resting for part in parts):
        return None
    return _attractive(*parts) if structure.form == "A" or _is_regular(situation, structure) else None


def _is_regular(situation: Situation, structure: PowerStructure) -> bool:
    """Whether F is a regular matrix of exact numbers at x*, and f = F grad S."""
    if structure.remainder.nnz():
        return False
    plant, point = situation.plant, situation.point
    parameters = reals(plant.parameter_values)
    with precision(BITS):
        (matrix,) = plant.tape(structure.matrix).walk(REAL, [list(point.x), list(point.u), parameters])
    if not all(isinstance(entry, fmpq) for entry in matrix.entries.values()):
        return False
    rows: dict[int, Row] = {}
    for (i, j), entry in matrix.entries.items():
        rows.setdefault(i, {})[j] = entry
    return len(reduce_rows(rows.values())) == plant.system.n


def _attractive(*parts: InvariantSet) -> Claim:
    chain = ", or ".join("; ".join(part.steps) for part in parts)
    return Claim(
        "asymptotically-stable",
        Status.PROVED,
        "near x*",
        "Lyapunov function and LaSalle's invariant set by elimination",
        f"where the Lyapunov function rests: {chain}; so x' = 0, and x* is an isolated equilibrium",
    )


def _isolated(situation: Situation) -> bool:
    with precision(BITS):
        return sign(as_balls(situation.loop.continuous()).det()) in (1, -1)


def _conserved(situation: Situation) -> Claim | None:
    """A linear combination c^T x with ``c^T f = 0`` and ``c^T g = 0``."""
    basis = conserved(situation.plant)
    if not basis:
        return None
    shown = written(situation.plant, basis[0])
    return Claim(
        "asymptotically-stable",
        Status.REFUTED,
        "near x*",
        "a conserved linear function, over the rationals",
        f"{shown} is constant along every trajectory, whatever the input",
        f"eliminate a state: {shown} keeps the value that it starts with, so the others follow without it",
        {"conserved": shown},
    )


def _in_a_plane(situation: Situation) -> Claim | None:
    """A plane through x* in which the plant moves by itself, and the controller sees nothing of it."""
    plane = situation.undamped_plane if situation.found["equilibrium"].status is Status.PROVED else None
    if plane is None:
        return None
    names = situation.plant.system.state_names
    relations = plane.words(names)
    free = ", ".join(names[k] for k in plane.free)
    where = f"in the plane through x* with {', '.join(relations)}" if relations else "everywhere"
    return Claim(
        "asymptotically-stable",
        Status.REFUTED,
        "near x*",
        "invariant plane at u = u*, by exact identities",
        f"{where}, where {free} are free, the system moves at u = u* without loss and with gamma = gamma*",
        "add damping to this motion, or an output that sees it",
        {"relations": relations, "free": [names[k] for k in plane.free]},
    )


def _undamped(situation: Situation) -> Claim | None:
    """An invariant set at u = u* that is more than a point."""
    found = situation.undamped_set
    if found is None:
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


def drift(situation: Situation) -> Claim | None:
    """`stable` REFUTED by a motion through x* that nothing stops, or None.

    In a plane in which the plant moves by itself and the controller sees nothing, let ``z' = B z`` exactly, z being the
    deviations of the free states. Where ``B^2 w = 0`` and ``B w != 0``, ``z(t) = s (w + t B w)`` is a motion of the
    loop for every s: it starts as near to x* as one likes and leaves every bounded set. So move two masses that only a
    spring joins, with a common speed.
    """
    plane = situation.undamped_plane if situation.found["equilibrium"].status is Status.PROVED else None
    B = None if plane is None else _rates_in(situation, plane)
    if plane is None or B is None:
        return None
    twice = [[sum((a * b[j] for a, b in zip(row, B, strict=True)), fmpq(0)) for j in range(len(B))] for row in B]
    rank, of_twice = (len(reduce_rows([dict(enumerate(row)) for row in M])) for M in (B, twice))
    if of_twice == rank:
        return None
    still = kernel([dict(enumerate(row)) for row in twice], len(B), fmpq(0), fmpq(1))
    w = next(w for w in still if any(_times(B, w)))
    start, speed = (_named(situation, plane, z) for z in (w, _times(B, w)))
    shown = ", ".join(f"d{name} = {v} s" for name, v in start.items())
    moved = ", ".join(f"{name}' = {v} s" for name, v in speed.items())
    return Claim(
        "stable",
        Status.REFUTED,
        "near x*",
        "a motion in an invariant plane at u = u*, by exact identities",
        f"from {shown} for any s the loop moves on and on with {moved}, and gamma = gamma*",
        "measure what drifts, or describe the plant by coordinates that do not change with it",
        {"start": start, "rate": speed},
    )


def _named(situation: Situation, plane: Plane, z: Sequence[fmpq]) -> dict[str, str]:
    """The direction of the plane with these entries of the free states, by the names of all states that it moves."""
    own = {f: fraction(v) for f, v in zip(plane.free, z, strict=True)}
    own |= {p: sum((c * own[f] for f, c in row.items()), Fraction(0)) for p, row in plane.rows.items()}
    return {name: str(own[k]) for k, name in enumerate(situation.plant.system.state_names) if own[k]}


def _times(B: Sequence[Sequence[fmpq]], w: Sequence[fmpq]) -> list[fmpq]:
    return [sum((a * b for a, b in zip(row, w, strict=True)), fmpq(0)) for row in B]


def _rates_in(situation: Situation, plane: Plane) -> list[list[fmpq]] | None:
    """B with ``z' = B z`` in the plane for the deviations z of its free states; None where the rates are not so."""
    plant, system = situation.plant, situation.plant.system
    if not all(isinstance(v, fmpq) for v in (*situation.point.x, *situation.point.u)):
        return None
    held = ca.vertcat(*[plant.number(fraction(v), alone=True) for v in situation.point.u])
    solved = plane.solved(plant, situation.point.x)
    rates = ca.substitute(system.xdot, system.u, held if situation.compensation is None else situation.compensation)
    rates = rates[list(plane.free)]
    if solved:
        rates = ca.substitute(rates, ca.vertcat(*[system.x[p] for p in solved]), ca.vertcat(*solved.values()))
    try:
        field, (slopes,) = plant.exact(ca.jacobian(rates, system.x[list(plane.free)]))
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    rows = [[entry.constant() for entry in row] for row in slopes.dense(field.const(0))]
    exact = [[v for v in row if v is not None] for row in rows]
    return exact if all(len(row) == len(exact) for row in exact) else None
