"""Domains that no trajectory leaves: the rates point inside at their ends, whatever the law asks for.

A saturated law keeps u within ``u* +- s``, or ``u_c(x) +- s`` under compensation. Let the domain be a box D, and let

    f_k(x) + g_k(x) u >= 0  for all x in D with x_k = lo_k,      <= 0  where x_k = hi_k,      for all these u.

D times all states of the filters is then invariant (Nagumo; f, g and the law are Lipschitz on it). The rates are affine
in u, so the corners of its range are enough. Levels in tanks and concentrations are kept so by inputs of one sign.

A Lyapunov function that falls on D, and grows with the states that D does not bound, thus makes every trajectory from D
settle on the invariant set in D.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import islice, product

import casadi as ca

from pbcgen.control.situation import Situation
from pbcgen.errors import UnsupportedOperation
from pbcgen.models.laws import amplitudes
from pbcgen.passivity.region import Region, undefined
from pbcgen.proof.branch import Budget
from pbcgen.symbolic.real import BITS, ZERO, Real, approximate, is_finite, lower, precision, rational, sign, text, upper

#: More inputs are not looked at.
_MOST_INPUTS = 6
#: Boxes of the branch and bound over all ends, and places looked at for a way out of each end.
_BOXES, _PLACES = 3000, 81


def is_kept(situation: Situation) -> bool:
    """Whether no trajectory that starts in the stated domain leaves it; what the loop is made of is smooth on it."""
    plant, region = situation.plant, Region.stated(situation.plant)
    if region.is_whole or not plant.is_continuous or plant.system.m > _MOST_INPUTS:
        return False
    budget = Budget(_BOXES)
    try:
        field, _ = plant.exact(plant.system.f, plant.system.g, plant.system.S, situation.read)
        if undefined(field, region.prover(budget), plant.system.n):
            return False
        return all(_points_inside(situation, region, *end, budget) for end in _ends(region))
    except (UnsupportedOperation, ZeroDivisionError):
        return False


def _ends(region: Region) -> Iterator[tuple[int, Fraction, int]]:
    """State, end, and the sign that its rate must not have there, turned over."""
    for k, (lo, hi) in enumerate(region.bounds):
        if lo is not None:
            yield k, lo, 1
        if hi is not None:
            yield k, hi, -1


def _points_inside(situation: Situation, region: Region, k: int, end: Fraction, side: int, budget: Budget) -> bool:
    """Whether ``side * x_k' >= 0`` where ``x_k = end``, for every u that the law may ask for."""
    plant, system = situation.plant, situation.plant.system
    bounds = tuple((end, end) if i == k else interval for i, interval in enumerate(region.bounds))
    prover = Region(region.names, bounds).prover(budget)
    for u in _corners(situation):
        rate = ca.substitute(side * system.xdot[k], system.u, u)
        at_end = ca.substitute(rate, system.x[k], plant.number(end, alone=True))
        field, (value,) = plant.exact(at_end)
        if not prover.nonnegative(value.scalar(field.const(0))):
            return False
    return True


def _corners(situation: Situation) -> Iterator[ca.SX]:
    """The corners of the range of u, rounded outwards."""
    plant, reach = situation.plant, amplitudes(situation.law)
    held, compensation = situation.point.u, situation.compensation
    for sides in product((-1, 1), repeat=len(reach)):
        ends = []
        for u, s, side in zip(held, reach, sides, strict=True):
            centre = Fraction(0) if compensation is not None else upper(u) if side > 0 else lower(u)
            ends.append(plant.number(centre + side * s, alone=True))
        yield ca.vertcat(*ends) + (0 if compensation is None else compensation)


def way_out(situation: Situation) -> str:
    """A state at an end of the domain where every input of the law leads out, in words; empty where none was found."""
    plant, system, region = situation.plant, situation.plant.system, Region.stated(situation.plant)
    if region.is_whole or system.m > _MOST_INPUTS:
        return ""
    tape = plant.tape(system.S, *[ca.substitute(system.xdot, system.u, u) for u in _corners(situation)])
    idle: list[Real] = [ZERO] * system.m
    for k, end, side in _ends(region):
        for x in islice(_places(situation, region, k, end), _PLACES):
            with precision(BITS):
                stored, *rates = [column[k if i else 0][0] for i, column in enumerate(plant.walk(tape, x, idle))]
            if is_finite(stored) and all(is_finite(rate) and sign(rate) == -side for rate in rates):
                shown = zip(system.state_names, x, strict=True)
                return "at " + ", ".join(f"{name} = {text(v)}" for name, v in shown)
    return ""


def _places(situation: Situation, region: Region, k: int, end: Fraction) -> Iterator[list[Real]]:
    """States at an end: x* and the other states' own ends, or places far from x*, in all combinations."""
    choices: list[list[Fraction]] = []
    for i, (star, (lo, hi)) in enumerate(zip(situation.point.x, region.bounds, strict=True)):
        rest = Fraction(approximate(star))
        away = 10 * (1 + abs(rest))
        choices.append(
            [end] if i == k else [rest, rest - away if lo is None else lo, rest + away if hi is None else hi]
        )
    for chosen in product(*choices):
        yield [rational(v) for v in chosen]
