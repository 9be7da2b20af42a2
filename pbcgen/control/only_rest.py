"""Proofs that x* is the only equilibrium of the closed loop on the whole space.

They start from the invariant set, on which x' = 0, and from (rest) of :mod:`pbcgen.control.attractivity`. For two
equilibria with the constant inputs U1, U2 and the outputs gamma1, gamma2, (rest) gives

    (U1 - U2)^T (gamma1 - gamma2 + K_c^{-1} (U1 - U2)) < 0   unless U1 = U2, and then gamma1 = gamma2.

So it is enough that the left side is never negative, and that U and gamma fix the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import casadi as ca
from flint import fmpq

from pbcgen.control.rest_box import only_in_a_box
from pbcgen.control.rest_set import RestSet
from pbcgen.control.situation import Situation
from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.coordinates import injective
from pbcgen.passivity.inertia import missing_for_definiteness
from pbcgen.passivity.lasalle import InvariantSet
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.unbounded import currents, depends_on_currents
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_definite
from pbcgen.proof.elimination import has_one_sign, is_regular, semidefinite
from pbcgen.proof.nonnegative import nonnegative
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.real import lower, upper

#: Convexity with kappa in an enclosure is looked at for so many inputs.
_MOST_FORCES = 4
#: Determinants of larger matrices are not written out.
_LARGEST_DETERMINANT = 8


def only_rest(situation: Situation) -> str | None:
    """Why x* is the only equilibrium of the invariant set, or None.

    The set must be known to consist of equilibria, and x* to meet the conditions of the Lyapunov route.
    """
    if _convex(situation):
        steps = ", or ".join("; ".join(part.steps) for part in situation.branches)
        return f"the invariant set consists of equilibria ({steps}), and the storage is convex"
    if len(situation.branches) != 1:
        return _by_currents(situation)
    (found,) = situation.branches
    if len(found.inputs) == situation.plant.system.m and all(v.is_zero() for v in map(ca.SX, found.inputs.values())):
        zero = situation.compensation is not None or all(isinstance(u, fmpq) and u == 0 for u in situation.point.u)
        if zero and _one_to_one(situation, found):
            return "the invariant set forces " + "; ".join(
                [*found.steps, "gamma = gamma*, which has one solution there"]
            )
        at_target = situation.at_target(situation.gamma) if zero else None
        if at_target is not None and not at_target.free and not at_target.pending:
            return "the invariant set forces " + "; ".join(
                dict.fromkeys([*found.steps, "gamma = gamma*", *at_target.steps])
            )
    if not found.free and not found.pending and not found.inputs and _monotone(situation, found):
        return (
            "the invariant set is parametrised by ubar (" + "; ".join(found.steps) + "), and (rest) is monotone in it"
        )
    return _by_currents(situation) or _along_the_set(situation, found) or _in_a_box(situation, found)


def _one_to_one(situation: Situation, found: InvariantSet) -> bool:
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


def storage_is_convex(situation: Situation) -> bool:
    """Whether the Lyapunov function is convex, besides a kinetic energy: a strict minimum then makes it grow.

    It is S (for a mechanical system V(q), while M(q) > 0 bounds p) and functions of gamma, convex where that is affine.
    """
    plant, mechanics = situation.plant, situation.plant.system.mechanical
    if situation.compensation is not None:
        return False
    if mechanics is not None and (ca.depends_on(situation.gamma, mechanics.p) or missing_for_definiteness(plant)):
        return False
    return _is_convex(situation) or _is_convex_with_its_force(situation)


def _at_rest(situation: Situation) -> tuple[ca.SX, ca.SX]:
    """What is stored where nothing moves, and the states that it depends on: S, of a mechanical system V(q)."""
    system = situation.plant.system
    return (system.S, system.x) if system.mechanical is None else (system.mechanical.V, system.mechanical.q)


def _is_convex_with_its_force(situation: Situation) -> bool:
    """Whether ``S + kappa^T gamma`` is convex, with a strict minimum at x*; what else is stored is not negative.

    Its Hessian is affine in kappa, so it is enough to look at the corners of an enclosure of kappa.
    """
    plant, (energy, variables) = situation.plant, _at_rest(situation)
    if len(situation.point.u) > _MOST_FORCES:
        return False
    for corner in product(*[{-lower(u), -upper(u)} for u in situation.point.u]):
        kappa = ca.vertcat(*map(plant.number, corner))
        hessian = ca.hessian(energy + ca.dot(kappa, situation.gamma), variables)[0]
        try:
            _, (exact,) = plant.exact(hessian)
            (at_star,) = plant.at(situation.point, hessian)
        except (UnsupportedOperation, ZeroDivisionError):
            return False
        if positive_definite(at_star).status is not Status.PROVED or not semidefinite(exact.rows()):
            return False
    return True


def _is_convex(situation: Situation) -> bool:
    plant, (energy, variables) = situation.plant, _at_rest(situation)
    try:
        _, (hessian, slope) = plant.exact(
            ca.hessian(energy, variables)[0], ca.jacobian(situation.gamma, plant.system.x)
        )
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    affine = all(entry.constant() is not None for entry in slope.entries.values())
    return affine and semidefinite(hessian.rows())


def _convex(situation: Situation) -> bool:
    """Whether equilibria of the closed loop are critical points of a convex function: then x* is the only one.

    With f + g u = F (grad S - grad gamma u), F regular, or ``A (f + g u) = grad S - grad gamma u``, a rest has
    ``grad (S + kappa^T gamma + Phi_c) = 0``. Phi_c and kappa^T gamma are convex for affine gamma, so S convex is
    enough; the Hessian at x* is positive definite, which makes the minimiser unique. For a mechanical system S may be
    replaced by V(q), because p = 0 at rest.
    """
    plant, structure = situation.plant, situation.structure
    if structure is None or situation.compensation is not None:
        return False
    if structure.form == "A":
        return _is_convex(situation)
    try:
        _, (F, rho) = plant.exact(structure.matrix, structure.remainder)
        if any(not entry.is_zero() for entry in rho.entries.values()):
            return False
        return (is_regular(F.rows()) or _has_determinant(plant, structure.matrix)) and _is_convex(situation)
    except (UnsupportedOperation, ZeroDivisionError):
        return False


def _has_determinant(plant: Plant, matrix: ca.SX) -> bool:
    """Whether the determinant of a small matrix has one sign everywhere, though no entry may have one."""
    if matrix.shape[0] > _LARGEST_DETERMINANT:
        return False
    field, (value,) = plant.exact(ca.det(matrix))
    return has_one_sign(value.scalar(field.const(0)))


def _monotone(situation: Situation, found: InvariantSet) -> bool:
    """``d gamma/d ubar + K_c^{-1} >= 0`` along the solved states: (rest) then has one solution."""
    plant = situation.plant
    system = plant.system
    start = situation.flow
    assert start is not None
    along = ca.substitute(situation.gamma, system.x, ca.vertcat(*[found.solved[k] for k in range(system.n)]))
    slope = ca.jacobian(along, start.constant)
    total = ca.substitute((slope + slope.T) / 2 + situation.compliance, start.constant, system.u)
    try:
        _, (values,) = plant.exact(total)
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    return semidefinite(values.rows())


def _by_currents(situation: Situation) -> str | None:
    """For a circuit: a rest has ``w = grad P = -g_tilde u``, so ``gamma = g_tilde^T Xi g_tilde u``, and w fixes x."""
    plant = situation.plant
    if situation.compensation is not None:
        return None
    try:
        if not depends_on_currents(plant, situation.gamma) or not injective(plant, *currents(plant)):
            return None
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    return "gamma is a monotone function of the input at every rest, and grad P has each value at one state only"


def _along_the_set(situation: Situation, found: InvariantSet) -> str | None:
    """Whether inputs and outputs increase together along the set, and fix its points."""
    plant = situation.plant
    try:
        along = RestSet.of(situation, found)
        functions = ca.vertcat(along.inputs, along.outputs, along.zero)
        if (not along.z or _increase_together(situation, along)) and injective(plant, functions, along.z):
            steps = "; ".join(found.steps)
            return f"the invariant set consists of equilibria ({steps}), along which ubar and gamma increase together"
    except (UnsupportedOperation, ZeroDivisionError):
        pass
    return None


def _in_a_box(situation: Situation, found: InvariantSet) -> str | None:
    """Whether bounded functions keep every rest in a box, where branch and bound finds x* only."""
    try:
        box = only_in_a_box(situation, RestSet.of(situation, found))
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    if box is None:
        return None
    steps = "; ".join(found.steps)
    return f"the invariant set consists of equilibria ({steps}); all of them have {box}, where x* is alone"


def _increase_together(situation: Situation, along: RestSet) -> bool:
    """Whether ``(U1 - U2)^T (Gamma1 - Gamma2) >= 0`` for any two points z; Gamma includes ``K_c^{-1} U``.

    One of them is a constant matrix times the other, or affine in z, which leaves a matrix to be semidefinite at each
    z; or z is a number and both are monotone in it.
    """
    plant, z = situation.plant, ca.vertcat(*along.z)
    field, (U, G, A, B) = plant.exact(
        along.inputs, along.outputs, ca.jacobian(along.inputs, z), ca.jacobian(along.outputs, z)
    )
    zero = field.const(0)
    slopes = A.dense(zero), B.dense(zero)
    for one, other in (slopes, slopes[::-1]):
        if all(entry.constant() is not None for row in one for entry in row) and _semidefinite_product(one, other):
            return True
    if z.numel() == 1 == len(slopes[0]):
        a, b = slopes[0][0][0], slopes[1][0][0]
        if any(nonnegative(p) and nonnegative(q) for p, q in ((a, b), (-a, -b))):
            return True
    multiple = _multiple(U.column(zero), G.column(zero))
    return multiple is not None and semidefinite(
        [
            [field.const(0) + p + q for p, q in zip(*rows, strict=True)]
            for rows in zip(multiple, zip(*multiple, strict=True), strict=True)
        ]
    )


def _semidefinite_product(left: list[list[Quotient]], right: list[list[Quotient]]) -> bool:
    """Whether the symmetric part of ``left^T right`` is positive semidefinite."""
    size = len(left[0])

    def entry(i: int, j: int) -> Quotient:
        total = left[0][0].field.const(0)
        for a, b in zip(left, right, strict=True):
            total = total + a[i] * b[j]
        return total

    return semidefinite([[entry(i, j) + entry(j, i) for j in range(size)] for i in range(size)])


def _multiple(inputs: Sequence[Quotient], outputs: Sequence[Quotient]) -> list[list[Quotient]] | None:
    """A constant matrix C with ``outputs = C inputs + constant``, or None."""
    field = inputs[0].field
    result = []
    if not all(v.is_polynomial() for v in (*inputs, *outputs)):
        return None
    for output in outputs:
        rows: dict[object, Row] = {}
        for key, value in (*enumerate(inputs), (CONSTANT, -output)):
            for exponents, c in value.numerator.to_dict().items():
                if any(exponents):
                    rows.setdefault(tuple(exponents), {})[key] = c
        try:
            solution = particular_solution(reduce_rows(rows.values()), fmpq(0))
        except Inconsistent:
            return None
        result.append([field.polynomial(field.context.constant(solution.get(k, fmpq(0)))) for k in range(len(inputs))])
    return result
