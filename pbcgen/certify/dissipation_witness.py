"""Witnesses of dissipation for certificates: matrices of functions written as sums of squares."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
from flint import fmpq

from pbcgen.certify.signs import Boxes, by_sign
from pbcgen.certify.writing import Writing
from pbcgen.control.derive import Derivation
from pbcgen.models.laws import NaturalDamping, base_law
from pbcgen.passivity.dissipation import constant_part, port_damping
from pbcgen.passivity.plant import Plant, columns, dot
from pbcgen.passivity.region import Region
from pbcgen.passivity.structure import PowerStructure
from pbcgen.passivity.theta import SPARE, excess, filter_gain, needed_damping, required
from pbcgen.proof.branch import Formula
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_semidefinite
from pbcgen.proof.sos import find as find_squares
from pbcgen.proof.squares import Leaf, Square, decompose, decompose_matrix, of_programme
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import Real, midpoint
from pbcgen.symbolic.real_matrices import RealMatrix, congruence, dense, diagonal, transpose, weighted_sum
from pbcgen.symbolic.tape import Tape

#: Boxes for the formula of the model itself.
_MANY = 4000

_Rows = list[list[Quotient]]
Witness = dict[str, Any] | None


def storage(derivation: Derivation, domain: str, terms: Writing) -> Witness:
    """For `assumption-1`: ``-grad S^T f`` as a sum of squares."""
    return _squares(_decomposed(derivation, False, domain, terms), terms)


def passivity(derivation: Derivation, domain: str, terms: Writing) -> Witness:
    """For `passive-output`: the matrix Z of Hill and Moylan as a sum of squares."""
    return _squares(_decomposed(derivation, True, domain, terms), terms)


def _decomposed(derivation: Derivation, inputs: bool, domain: str, terms: Writing) -> list[Square] | None:
    """Z of Hill and Moylan, or its first entry, as a sum of squares.

    By the power structure, directly, by semidefinite programming; on the box that is the domain also by branching.
    """
    plant, structure = derivation.plant, derivation.structure
    gamma = derivation.gamma if inputs and derivation.gamma is not None else ca.SX(0, 1)
    region = Region.stated(plant)
    boxes = Boxes(plant, region) if domain == region.text and not region.is_whole else None
    leaves: list[Leaf] = [by_sign] if boxes is None else [by_sign, boxes]
    for leaf in leaves:
        if structure is not None:
            lift = _Lift.of(plant, structure, gamma)
            squares = decompose_matrix(lift.dissipation, leaf) if lift.matched else None
            lifted = None if squares is None else lift.apply(squares)
            if lifted is not None:
                return lifted
        squares = decompose_matrix(_power_form(plant, gamma), leaf)
        if squares is not None:
            return squares
    found = _programmed(plant, gamma, region if boxes is not None else Region.whole(plant))
    return found if found is not None or boxes is None else _as_written(plant, gamma, boxes, terms)


def _as_written(plant: Plant, gamma: ca.SX, boxes: Boxes, terms: Writing) -> list[Square] | None:
    """A power that no input changes, by branching on the formula of the model, which is tighter than its expansion."""
    form = _power_form(plant, gamma)
    if any(not v.is_zero() for row in form for v in row if v is not form[0][0]):
        return None
    system = plant.system
    loss = -ca.dot(ca.gradient(system.S, system.x), system.f)
    constants = plant.parameter_values
    (matrix,) = terms.tape(Tape.of([system.x, plant.parameter_symbols], [loss]), ["state", "parameter"], {1: constants})
    place = matrix.entries.get((0, 0))
    formula = Formula(loss, system.x, plant.parameter_symbols, constants)
    factor = None if place is None else boxes.factor(terms, place, list(range(system.n)), formula, place, _MANY)
    one = form[0][0].field.const(1)
    vector = (one, *[one - one] * gamma.numel())
    return None if factor is None else [Square(fmpq(1), (factor,), vector)]


def _programmed(plant: Plant, gamma: ca.SX, region: Region) -> list[Square] | None:
    """``u^T gamma' - S'`` as a sum of squares in state and input, each linear in the input."""
    system, m = plant.system, gamma.numel()
    u = system.u if m else ca.SX(system.m, 1)
    rate = system.f + ca.mtimes(system.g, u)
    balance = -ca.dot(plant.gradient, rate) + (ca.dot(u, ca.mtimes(ca.jacobian(gamma, system.x), rate)) if m else 0)
    field, (value,) = plant.exact(balance)
    total, bounds = value.scalar(field.const(0)), dict(enumerate(region.bounds))
    below = field.polynomial(total.denominator)
    divisors, found = decompose(below), find_squares(field, total.numerator, bounds)
    squares = None if found is None else of_programme(field, found, bounds)
    if squares is None or divisors is None:
        return None
    positions = [system.n + j for j in range(m)]
    split = [_split(square.vector[0], positions) for square in squares]
    return [  # p / q = p q / q^2
        Square(s.weight * d.weight, (*s.factors, *d.factors), tuple(entry * d.vector[0] / below for entry in v))
        for s, v in zip(squares, split, strict=True)
        for d in divisors
        if v is not None
    ]


def _split(value: Quotient, positions: Sequence[int]) -> tuple[Quotient, ...] | None:
    """The coefficients of (1, u) in a polynomial that is linear in u."""
    field = value.field
    parts: list[dict[tuple[int, ...], fmpq]] = [{} for _ in range(1 + len(positions))]
    for exponents, coefficient in value.numerator.to_dict().items():
        used = [1 + j for j, k in enumerate(positions) for _ in range(int(exponents[k]))]
        if len(used) > 1:
            return None
        rest = tuple(0 if k in positions else int(e) for k, e in enumerate(exponents))
        parts[used[0] if used else 0][rest] = coefficient
    return tuple(field.polynomial(field.context.from_dict(part)) for part in parts)


def _power_form(plant: Plant, gamma: ca.SX) -> _Rows:
    """``u^T y - S'`` as a quadratic form in (1, u), with y = gamma'."""
    system = plant.system
    m = gamma.numel()
    psi = ca.jacobian(gamma, system.x) if m else ca.SX(0, system.n)
    border = (ca.mtimes(psi, system.f) - ca.mtimes(system.g.T, plant.gradient)[:m, :]) / 2
    block = ca.mtimes(psi, system.g)[:, :m]
    corner = -ca.dot(plant.gradient, system.f)
    field, (Z,) = plant.exact(ca.blockcat([[corner, border.T], [border, (block + block.T) / 2]]))
    return Z.dense(field.const(0))


class _Lift:
    """From quadratic forms in v to quadratic forms in (1, u): v = grad S - grad gamma u, or v = x'."""

    def __init__(
        self, dissipation: _Rows, first: list[Quotient], others: _Rows, friction: Quotient, matched: bool
    ) -> None:
        self.dissipation, self.first, self.others = dissipation, first, others
        self.friction, self.matched = friction, matched
        self.zero = friction.field.const(0)

    @staticmethod
    def of(plant: Plant, structure: PowerStructure, gamma: ca.SX) -> _Lift:
        """The relation of a power structure; ``matched`` says whether it holds for gamma."""
        system = plant.system
        psi = ca.jacobian(gamma, system.x).T if gamma.numel() else ca.SX(system.n, 0)
        field, (B, e, f, g, p, M, rest) = plant.exact(
            structure.dissipation(), plant.gradient, system.f, system.g, psi, structure.matrix, structure.remainder
        )
        zero = field.const(0)
        gradient, drift, rho, matrix = e.column(zero), f.column(zero), rest.column(zero), M.dense(zero)
        slopes, inputs = columns(p, zero), columns(g, zero)
        by_gradient = structure.form == "F"
        matched = True
        for slope, column in zip(slopes, inputs, strict=False):
            inside, out = (slope, column) if by_gradient else (column, slope)
            matched &= dot(rho, slope, zero).is_zero()
            matched &= all((dot(row, inside, zero) + out[k]).is_zero() for k, row in enumerate(matrix))
        others = [[-v for v in slope] for slope in slopes] if by_gradient else inputs[: len(slopes)]
        return _Lift(B.dense(zero), gradient if by_gradient else drift, others, dot(rho, gradient, zero), matched)

    def apply(self, squares: Sequence[Square]) -> list[Square] | None:
        """The squares as forms in (1, u), with the power of the friction; None if that is not a sum of squares."""
        friction = decompose(self.friction, by_sign)
        if friction is None:
            return None
        lifted = [
            Square(
                s.weight, s.factors, tuple(dot(s.vector, column, self.zero) for column in (self.first, *self.others))
            )
            for s in squares
        ]
        unit = [self.zero.field.const(1), *[self.zero] * len(self.others)]
        return lifted + [square.times(unit) for square in friction]


def natural_damping(derivation: Derivation, terms: Writing) -> Witness:
    """For `assumption-3`: Lambda, and what the dissipation has beyond it as a sum of squares."""
    bounds, eta = derivation.bounds, derivation.eta
    if bounds is None or eta is None or bounds.Lambda_l is None or bounds.Lambda_c is None:
        return None
    values = diagonal([*bounds.Lambda_l, *bounds.Lambda_c])
    found = _squares(_beyond(derivation, eta, values) or _beyond_varying(derivation, eta, values), terms)
    lambdas = {"Lambda_l": [str(v) for v in bounds.Lambda_l], "Lambda_c": [str(v) for v in bounds.Lambda_c]}
    return lambdas | (found or {})


def carrying_damping(derivation: Derivation) -> RealMatrix | None:
    """Lambda for `theta` where the diagonal one of Assumption 3 does not show it; else None.

    It is what K_l and R_l ask for, which the dissipation then exceeds, with something of the diagonal Lambda and some
    of K_l R_l to spare where there is any.
    """
    bounds, law = derivation.bounds, base_law(derivation.law)
    claim = next((c for c in derivation.claims if c.claim == "theta"), None)
    if bounds is None or claim is None or not isinstance(law, NaturalDamping) or law.Upsilon is None:
        return None
    if bounds.Lambda_l is None or bounds.Lambda_c is None or claim.status is not Status.PROVED:
        return None
    enough = required(diagonal([1 / v for v in (*bounds.Lambda_l, *bounds.Lambda_c)]), law.Upsilon)
    if positive_semidefinite(excess(filter_gain(law), enough)).status is Status.PROVED:
        return None
    touching = needed_damping(law)
    if not derivation.situation or not derivation.situation.damping_to_spare:
        return touching
    share = fmpq(1, 2000)  # half of what strictness leaves
    own = [*bounds.Lambda_l, *bounds.Lambda_c]
    more = needed_damping(law, SPARE)
    return weighted_sum([1 - share, share], [more, diagonal(own)])


def theta_damping(derivation: Derivation, terms: Writing) -> Witness:
    """For `theta`: that Lambda, and what the dissipation has beyond it as a sum of squares."""
    Lambda, eta = carrying_damping(derivation), derivation.eta
    if Lambda is None or eta is None:
        return None
    squares = _beyond(derivation, eta, Lambda) or _beyond_varying(derivation, eta, Lambda)
    return {"Lambda": [[str(v) for v in row] for row in Lambda]} | (_squares(squares, terms) or {})


def sampled_damping(derivation: Derivation, damped: bool, terms: Writing) -> Witness:
    """For `sampled-stable` by the storage: the full Lambda, and what the dissipation has beyond it."""
    structure, gamma = derivation.structure, derivation.gamma
    eta = derivation.eta if damped else None
    if structure is None or gamma is None:
        return None
    Lambda = port_damping(derivation.plant, structure, gamma, eta)
    squares = None if Lambda is None else _beyond(derivation, eta, Lambda)
    if squares is None or Lambda is None:
        return None
    return {"Lambda": [[str(v) for v in row] for row in Lambda], "squares": terms.squares(squares)}


def _beyond(derivation: Derivation, eta: ca.SX | None, Lambda: RealMatrix) -> list[Square] | None:
    """The dissipation minus ``|(eta', y)|^2_Lambda``: a constant matrix, and nonnegative functions."""
    plant, structure, gamma = derivation.plant, derivation.structure, derivation.gamma
    if structure is None or gamma is None:
        return None
    lift = _Lift.of(plant, structure, gamma)
    field, zero = lift.zero.field, lift.zero
    split = constant_part([dict(enumerate(row)) for row in lift.dissipation])
    if split is None or not lift.matched:
        return None
    slopes = ca.jacobian(gamma if eta is None else ca.vertcat(eta, gamma), plant.system.x)
    _, (rows,) = plant.exact(ca.mtimes(slopes, structure.matrix) if structure.form == "F" else slopes)
    size = range(plant.system.n)
    signals = [[entry.constant() for entry in row] for row in rows.dense(zero)]
    if any(entry is None for row in signals for entry in row):
        return None
    taken = congruence(transpose(signals), Lambda)
    least = dense(split[0], plant.system.n)
    constant = [[least[i][j] - taken[i][j] for j in size] for i in size]

    def number(value: Real) -> Quotient:
        return field.const(midpoint(value))

    squares = decompose_matrix([[number(v) for v in row] for row in constant], by_sign)
    excess = decompose_matrix([[lift.dissipation[i][j] - number(least[i][j]) for j in size] for i in size], by_sign)
    return None if squares is None or excess is None else lift.apply([*squares, *excess])


def _beyond_varying(derivation: Derivation, eta: ca.SX, Lambda: RealMatrix) -> list[Square] | None:
    """The same where it varies with the state, on the domain that `assumption-3` is stated on."""
    plant, structure, gamma, bounds = derivation.plant, derivation.structure, derivation.gamma, derivation.bounds
    if structure is None or gamma is None or bounds is None:
        return None
    lift = _Lift.of(plant, structure, gamma)
    slopes = ca.jacobian(ca.vertcat(eta, gamma), plant.system.x)
    field, (matrix, rows) = plant.exact(
        structure.dissipation(), ca.mtimes(slopes, structure.matrix) if structure.form == "F" else slopes
    )
    zero = field.const(0)
    left, signals = matrix.dense(zero), rows.dense(zero)
    for a, weights in zip(signals, Lambda, strict=True):
        for b, weight in zip(signals, weights, strict=True):
            if weight != 0:
                scaled = [field.const(midpoint(weight)) * v for v in a]
                left = [[v - p * q for v, q in zip(line, b, strict=True)] for line, p in zip(left, scaled, strict=True)]
    region = Region.stated(plant)
    leaf = Boxes(plant, region) if bounds.claim.domain == region.text and not region.is_whole else by_sign
    squares = decompose_matrix(left, leaf) if lift.matched else None
    return None if squares is None else lift.apply(squares)


def _squares(squares: Sequence[Square] | None, terms: Writing) -> Witness:
    return None if squares is None else {"squares": terms.squares(squares)}
