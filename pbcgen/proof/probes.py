"""States where an inner quantity of a formula vanishes or is extremal.

``exp(-((v - v0)/w)^2)`` or ``tanh((v - v0)/w)`` hides a narrow feature at ``v = v0``; the inner quantity leads there,
whatever the width. It moves only the variables that it depends on: the others keep the values of many random states,
because a damping that is negative at ``v0`` may show only where another coordinate is large. Quantities of different
variables are led to together, which finds the ball where several of them meet. Factors of products that are flat almost
everywhere, such as the difference of two steps, are first brought each to the place where it stands out.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from pbcgen.proof.seeker import Points, Seeker, some_states
from pbcgen.symbolic.doubles import Doubles

_MOST_PROBES = 120
#: States from which every quantity starts, steps of Newton's method, and how often quantities are put together.
_BASES = 96
_STEPS = 8
_MEETINGS = 160
#: Narrow features that are looked at in the middle between two places.
_MOST_MIDDLES = 80
#: How often the factors that stand out are put together, and by how much they must differ from their usual values.
_ASSEMBLIES = 16
_OUTSTANDING = 10.0
#: Relative distance below which two places are the same.
_SAME = 1e-9
#: Factors by which variables are changed, for how many states of each place, how often, and how many results a
#: descent may start from.
_FACTORS = (-1.0, 0.0, 0.1, 0.6, 1.7, 10.0, 100.0)
_EACH = 6
_ROUNDS = 4
_ADJUSTED = 24
#: Operations whose operand is worth probing: steep, bounded or singular somewhere.
_STEEP = (
    "EXP LOG POW CONSTPOW SQRT SQ SIN COS TAN ASIN ACOS ATAN SINH COSH TANH ASINH ACOSH ATANH ERF INV DIV "
    "FABS SIGN LT LE FMIN FMAX LOG1P EXPM1"
)
_PROBED = frozenset(getattr(ca, f"OP_{name}") for name in _STEEP.split())
_DIVISIONS = (ca.OP_DIV, ca.OP_INV)


def inner_quantities(value: ca.SX) -> tuple[list[ca.SX], list[ca.SX]]:
    """The operands of steep, bounded or singular operations in the graph of a scalar, and the factors of products."""
    steep: dict[int, ca.SX] = {}
    factors: dict[int, ca.SX] = {}
    seen: set[int] = set()
    waiting = [ca.SX(value)]
    while waiting:
        node = waiting.pop()
        key = node.element_hash()
        if key in seen or node.is_constant():
            continue
        seen.add(key)
        operands = [node.dep(k) for k in range(node.n_dep())]
        if operands and (node.op() in _PROBED or node.op() == ca.OP_MUL):
            chosen = operands[-1:] if node.op() in _DIVISIONS else operands
            found = factors if node.op() == ca.OP_MUL else steep
            found |= {o.element_hash(): o for o in chosen if not (o.is_constant() or o.is_symbolic())}
        waiting.extend(operands)
    return list(steep.values()), [factor for key, factor in factors.items() if key not in steep]


def _first(steep: list[ca.SX], factors: list[ca.SX]) -> tuple[list[ca.SX], list[ca.SX]]:
    """As many as are looked at."""
    chosen = steep[:_MOST_PROBES]
    return chosen, factors[: _MOST_PROBES - len(chosen)]


@dataclass(frozen=True, eq=False)
class _Quantity:
    """An inner quantity with its derivatives by the variables that it depends on.

    Attributes:
        support: positions of these.
        derivatives: state -> value, gradient, Hessian.
    """

    support: tuple[int, ...]
    derivatives: Doubles

    @staticmethod
    def of(value: ca.SX, x: ca.SX) -> _Quantity:
        support = tuple(k for k, depends in enumerate(ca.which_depends(value, x, 1, False)) if depends)
        own = ca.vertcat(*[x[k] for k in support])
        hessian, gradient = ca.hessian(value, own)
        return _Quantity(support, Doubles([x], [value, gradient, hessian]))

    def at(self, points: Points) -> tuple[Points, Points, Points]:
        """Values (N), gradients (N x k) and Hessians (N x k x k) at N states."""
        value, gradient, hessian = self.derivatives.many(points)
        return value.ravel(), gradient[:, :, 0], hessian


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a quantity leads from each base: values of the variables of its support; NaN where it leads nowhere."""

    support: tuple[int, ...]
    values: Points


@dataclass(frozen=True, eq=False)
class _Moved:
    """States that were led to places: N x n, and the variables that were moved for that."""

    points: Points
    variables: frozenset[int]


def probe(seeker: Seeker, generator: np.random.Generator) -> None:
    """Zeros and critical points of the inner quantities, alone, between each other and together."""
    x = seeker.question.variables
    steep, factors = (
        [q for value in found if (q := _Quantity.of(value, x)).support]
        for found in _first(*inner_quantities(seeker.question.value))
    )
    quantities = [*steep, *factors]
    if not quantities:
        return
    count = max(4, min(_BASES, seeker.affordable(0.3) // (20 * len(quantities))))
    bases = some_states(seeker, generator, count)
    with np.errstate(all="ignore"):
        places = [place for q in quantities for place in (_zeros(seeker, q, bases), _critical(seeker, q, bases))]
        places = _different(places)
        middles = _middles(places)
        outstanding = _outstanding(factors, bases, [*middles, *places])
    places = [*middles, *places]
    moved = [_Moved(_at(bases, place), frozenset(place.support)) for place in places]
    for k in range(_ASSEMBLIES if outstanding else 0):
        moved.append(_together(bases, outstanding, k / _ASSEMBLIES, generator, everything=True))
        seeker.suspects += list(moved[-1].points[:: len(bases) // 3])
    for k in range(_MEETINGS):
        moved.append(_together(bases, (middles, places)[k % 2], k / _MEETINGS, generator))
    with np.errstate(all="ignore"):
        moved += _in_turn(seeker, quantities, bases[:4])
    points = np.vstack([m.points for m in moved])
    values = seeker.offer(points, 60)
    seeker.remember(points, values)
    _surround(seeker, points, values, generator)
    _adjust(seeker, moved, generator)


def _zeros(seeker: Seeker, quantity: _Quantity, bases: Points) -> _Place:
    """Where the quantity vanishes, by Newton steps of least length."""
    own = list(quantity.support)
    at = bases.copy()
    for _ in range(_STEPS):
        value, gradient, _ = quantity.at(at)
        length = np.sum(gradient * gradient, axis=1)
        step = (value / length)[:, None] * gradient
        at[:, own] = np.clip(at[:, own] - step, seeker.lower[own], seeker.upper[own])
    return _Place(quantity.support, at[:, own])


def _critical(seeker: Seeker, quantity: _Quantity, bases: Points) -> _Place:
    """Where the gradient of the quantity vanishes, by Newton's method."""
    own = list(quantity.support)
    at = bases.copy()
    for _ in range(_STEPS):
        _, gradient, hessian = quantity.at(at)
        usable = np.all(np.isfinite(hessian), axis=(1, 2)) & np.any(hessian != 0, axis=(1, 2))
        step = np.full_like(gradient, np.nan)
        if np.any(usable):
            inverse = np.linalg.pinv(hessian[usable], rcond=1e-12, hermitian=True)
            step[usable] = np.einsum("kij,kj->ki", inverse, gradient[usable])
        at[:, own] = np.clip(at[:, own] - step, seeker.lower[own], seeker.upper[own])
    return _Place(quantity.support, at[:, own])


def _different(places: list[_Place]) -> list[_Place]:
    """Without places that others lead to as well."""
    chosen: list[_Place] = []
    for place in places:
        twins = (other for other in chosen if other.support == place.support)
        if np.any(np.isfinite(place.values)) and not any(_apart(place, other) < _SAME for other in twins):
            chosen.append(place)
    return chosen


def _apart(a: _Place, b: _Place) -> float:
    """The relative distance of two places of the same variables, from most bases."""
    with np.errstate(all="ignore"):
        apart = np.linalg.norm(a.values - b.values, axis=1) / np.linalg.norm(a.values + b.values, axis=1)
    finite = apart[np.isfinite(apart)]
    return float(np.median(finite)) if finite.size else float("inf")


def _middles(places: list[_Place]) -> list[_Place]:
    """Between two places of the same variables, such as the edges of a band; close ones first."""
    pairs = [(a, b) for i, a in enumerate(places) for b in places[:i] if a.support == b.support]
    ranked = sorted(((_apart(a, b), k) for k, (a, b) in enumerate(pairs)), key=lambda item: item[0])
    close = [pairs[k] for distance, k in ranked[:_MOST_MIDDLES] if distance < 1]
    return [_Place(a.support, (a.values + b.values) / 2) for a, b in close]


def _at(bases: Points, place: _Place) -> Points:
    """The bases, moved to the place where it exists."""
    moved = bases.copy()
    own = list(place.support)
    moved[:, own] = np.where(np.isfinite(place.values), place.values, bases[:, own])
    return moved


def _outstanding(factors: list[_Quantity], bases: Points, places: list[_Place]) -> list[_Place]:
    """The places where factors differ most from their values at the bases, and by how much; the greatest first."""
    ranked: list[tuple[float, int, _Place]] = []
    for factor in factors:
        candidates = [_at(bases, place) for place in places if place.support == factor.support]
        if not candidates:
            continue
        usual, _, _ = factor.at(bases)
        points = np.vstack(candidates)
        values, _, _ = factor.at(points)
        away = np.abs(values - np.median(usual))
        away[~np.isfinite(away)] = -1.0
        best = int(np.argmax(away))
        spread = float(np.median(np.abs(usual - np.median(usual))))
        if np.isfinite(spread) and away[best] > _OUTSTANDING * spread:
            found = np.tile(points[best, list(factor.support)], (len(bases), 1))
            ranked.append((spread / away[best], len(ranked), _Place(factor.support, found)))
    return [place for _, _, place in sorted(ranked, key=lambda item: item[:2])]


def _together(
    bases: Points, places: list[_Place], disorder: float, generator: np.random.Generator, everything: bool = False
) -> _Moved:
    """The bases, moved to places of different variables: all that fit or only some, the first ones or any."""
    points, taken = bases, frozenset[int]()
    size = len(places)
    wanted = size if everything else int(generator.choice((2, 3, size)))
    for k in np.argsort(np.arange(size) + generator.random(size) * size * disorder):
        if wanted and taken.isdisjoint(places[k].support):
            points = _at(points, places[k])
            taken |= set(places[k].support)
            wanted -= 1
    return _Moved(points, taken)


def _in_turn(seeker: Seeker, quantities: list[_Quantity], bases: Points) -> list[_Moved]:
    """One quantity after the other, each from where the one before led, also where they share variables."""
    batches = []
    for lead in (_zeros, _critical):
        at = bases
        for quantity in quantities:
            at = _at(at, lead(seeker, quantity, at))
            batches.append(_Moved(at, frozenset(quantity.support)))
    return batches


def _surround(seeker: Seeker, points: Points, values: Points, generator: np.random.Generator) -> None:
    """States at many small distances of the lowest probes and of some others."""
    count = min(len(points), max(1, seeker.affordable(0.1) // 12))
    order = np.argsort(values, kind="stable")
    chosen = points[np.concatenate([order[: count // 4], generator.choice(len(points), count - count // 4)])]
    sizes = 10.0 ** generator.uniform(-7, 0, (12, count, 1))
    offsets = generator.normal(size=(12, count, seeker.n)) * sizes * (1e-3 + np.abs(chosen))
    around = (chosen + offsets).reshape(-1, seeker.n)
    seeker.remember(around, seeker.offer(around, 60))


def _adjust(seeker: Seeker, moved: list[_Moved], generator: np.random.Generator) -> None:
    """Change the variables that were not moved by factors, one at a time, while that leads lower."""
    chosen = [(m.points[k], m.variables) for m in moved for k in generator.choice(len(m.points), _EACH)]
    count = max(1, seeker.affordable(0.25) // (_ROUNDS * len(seeker.active) * len(_FACTORS)))
    chosen = [chosen[k] for k in generator.permutation(len(chosen))[:count]]
    at = np.array([point for point, _ in chosen])
    values = seeker.values(at)
    for _ in range(_ROUNDS):
        for k in seeker.active:
            free = np.array([k not in variables for _, variables in chosen])
            if not np.any(free):
                continue
            trials = np.repeat(at[free][None], len(_FACTORS), axis=0)
            trials[:, :, k] *= np.array(_FACTORS)[:, None]
            found = seeker.offer(trials.reshape(-1, seeker.n)).reshape(len(_FACTORS), -1)
            lowest = np.argmin(found, axis=0)
            better = np.min(found, axis=0) < values[free]
            at[free] = np.where(better[:, None], trials[lowest, np.arange(len(lowest))], at[free])
            values[free] = np.minimum(values[free], np.min(found, axis=0))
    seeker.remember(at, values)
    seeker.starts += list(at[generator.permutation(len(at))[:_ADJUSTED]])
