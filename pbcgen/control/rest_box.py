"""x* as the only rest where bounded functions keep all rests in a box.

(rest) reads ``U - u* + alpha tanh(beta (Gamma - Gamma*)) = 0`` with ``Gamma = gamma + K_c^{-1} U``. So every rest has
``|U_i - u_i*| < alpha_i``, and

    |Gamma_i - Gamma_i*| <= atanh(r / alpha_i) / beta_i   where |U_i - u_i*| <= r < alpha_i.

A function that is a polynomial in one coordinate with bounded coefficients then bounds it (Cauchy's bound).
"""

from __future__ import annotations

from fractions import Fraction
from typing import TypeAlias

import casadi as ca
from flint import arb, fmpq

from pbcgen.control.rest_set import RestSet
from pbcgen.control.situation import Situation
from pbcgen.proof.alone import only_zero
from pbcgen.proof.boxes import Box
from pbcgen.proof.extrema import term_bounds
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, lower, precision, rational, upper
from pbcgen.symbolic.tape import Tape

#: More coordinates are not searched.
_MOST = 3
#: How often bounds of some coordinates are used for bounds of others.
_ROUNDS = 3
#: Instructions that branch and bound may run.
_WORK = 200_000
#: Ends of the box are rounded outwards to this grain.
_GRAIN = Fraction(1, 64)

#: Bounds of the magnitudes of coordinates, by position among the plant's symbols.
Ends: TypeAlias = dict[int, Fraction]


def only_in_a_box(situation: Situation, along: RestSet) -> str | None:
    """The box that holds all rests, in words, if x* is proved to be the only one; else None.

    Raises UnsupportedOperation for operations that are not analytic.
    """
    size = len(along.z)
    if not size or size != along.inputs.numel() + along.zero.numel() or size > _MOST:
        return None
    along = along.shorter(situation.plant)
    with precision(BITS):
        star = _Star(situation, along)
        box = _box(situation, along, star)
        if box is None or not only_zero(star.rest, star.z, box, _WORK // len(star.tape.instructions)):
            return None
    return ", ".join(f"{z} in [{float(lo):.6g}, {float(hi):.6g}]" for z, (lo, hi) in zip(along.z, box, strict=True))


class _Star:
    """The values at x*, and (rest) as a function of z in balls."""

    def __init__(self, situation: Situation, along: RestSet) -> None:
        plant, system = situation.plant, situation.plant.system
        alpha, beta, _ = situation.gains
        u: list[Real] = [ZERO] * system.m if situation.compensation is not None else list(situation.point.u)
        self.symbols = [*ca.vertsplit(system.x), *ca.vertsplit(system.u)]
        self.places = [next(k for k, s in enumerate(self.symbols) if ca.is_equal(s, z)) for z in along.z]
        self.n, self.m = system.n, system.m
        values = [*situation.point.x, *u]
        self.z = [values[k] for k in self.places]
        self.inputs = u
        (found,) = plant.walk(plant.tape(along.outputs), values[: self.n], values[self.n :])
        self.outputs = [row[0] for row in found]
        held = ca.SX.sym("held", 2 * self.m)
        gains = [ca.vertcat(*map(plant.number, gain)) for gain in (alpha, beta)]
        residual = along.inputs - held[: self.m] + gains[0] * ca.tanh(gains[1] * (along.outputs - held[self.m :]))
        residual = ca.vertcat(residual, along.zero)
        slopes = ca.densify(ca.jacobian(residual, ca.vertcat(*along.z)))
        self.tape = Tape.of([*plant.symbols, held], [residual, slopes])
        self.parameters: list[Real] = [rational(v) for v in plant.parameter_values]

    def rest(self, z: list[Real]) -> tuple[list[Real], list[list[Real]]]:
        """The residual of (rest), what vanishes on the set, and their Jacobian."""
        values: list[Real] = [ZERO] * len(self.symbols)
        for place, value in zip(self.places, z, strict=True):
            values[place] = value
        inputs = [values[: self.n], values[self.n :], self.parameters, [*self.inputs, *self.outputs]]
        value, slopes = (matrix.dense(ZERO) for matrix in self.tape.walk(REAL, inputs))
        return [row[0] for row in value], slopes


def _box(situation: Situation, along: RestSet, star: _Star) -> Box | None:
    """A box of z that holds every rest, or None."""
    plant = situation.plant
    alpha, beta, _ = situation.gains
    field, (U, G, vanishing) = plant.exact(along.inputs, along.outputs, along.zero)
    zero = field.const(0)
    ends: Ends = {}
    for _ in range(_ROUNDS):
        found = [_bounded_by(v, ZERO, Fraction(0), ends) for v in vanishing.column(zero)]
        functions = zip(U.column(zero), G.column(zero), star.inputs, star.outputs, alpha, beta, strict=True)
        for U_i, G_i, u, g, a, b in functions:
            found += [_bounded_by(U_i, u, a, ends), _through_tanh(U_i, G_i, (u, g), a, b, ends)]
        for k, bound in (pair for pair in found if pair is not None):
            ends[k] = min(ends.get(k, bound), bound)
    if not set(star.places) <= ends.keys():
        return None
    whole = [-(-ends[k] // _GRAIN) * _GRAIN for k in star.places]
    return tuple((-end, end) for end in whole)


def _intervals(ends: Ends) -> dict[int, tuple[Fraction | None, Fraction | None]]:
    return {k: (-end, end) for k, end in ends.items()}


def _through_tanh(
    inputs: Quotient, outputs: Quotient, star: tuple[Real, Real], alpha: Fraction, beta: Fraction, ends: Ends
) -> tuple[int, Fraction] | None:
    """A bound by the output, where the input is bounded more closely than by alpha."""
    bounds = term_bounds(inputs, _intervals(ends))
    if bounds.lo is None or bounds.hi is None:
        return None
    least = max(bounds.hi - lower(star[0]), upper(star[0]) - bounds.lo) / alpha
    if least >= 1:
        return None
    reach = upper(arb(rational(least)).atanh()) / beta if least > 0 else Fraction(0)
    return _bounded_by(outputs, star[1], reach, ends)


def _bounded_by(function: Quotient, centre: Real, reach: Fraction, ends: Ends) -> tuple[int, Fraction] | None:
    """A coordinate and a bound of its magnitude where ``|function - centre| <= reach``, or None.

    With ``function = sum a_j z^j`` of degree d, the a_j bounded and a_d away from zero, it is ``1 + max |a_j / a_d|``,
    a_0 being what its terms, the centre and the reach may make of it (Cauchy).
    """
    field, coordinate = function.field, _single(function, ends)
    if coordinate is None or not function.is_polynomial():
        return None
    powers: dict[int, dict[tuple[int, ...], fmpq]] = {}
    for exponents, c in function.numerator.to_dict().items():
        others = tuple(0 if k == coordinate else int(e) for k, e in enumerate(exponents))
        powers.setdefault(int(exponents[coordinate]), {})[others] = c
    sizes: dict[int, Fraction] = {0: Fraction(0)}
    leading = Fraction(0)
    for power, terms in sorted(powers.items()):
        bounds = term_bounds(field.polynomial(field.context.from_dict(terms)), _intervals(ends))
        if bounds.lo is None or bounds.hi is None:
            return None
        sizes[power] = max(abs(bounds.lo), abs(bounds.hi))
        leading = max(bounds.lo, -bounds.hi)
    degree = max(sizes)
    if degree == 0 or leading <= 0:
        return None
    sizes[0] += max(abs(upper(centre)), abs(lower(centre))) + reach
    largest = max(size for power, size in sizes.items() if power < degree) / leading
    return coordinate, largest if degree == 1 else 1 + largest


def _single(function: Quotient, ends: Ends) -> int | None:
    """The coordinate that occurs outside of atoms: the one without a bound, if there is one such."""
    outside = [k for k in function.generators() if k < function.field.symbol_count]
    open_ = [k for k in outside if k not in ends]
    if len(open_) > 1 or not outside:
        return None
    return open_[0] if open_ else min(outside)
