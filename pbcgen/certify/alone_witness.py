"""Witnesses for certificates of why x* is the only rest of the closed loop: a monotone relation, or a tree of boxes.

They are looked for with the checker's own reading of the model, so that what is found here is what is checked there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from flint import arb, fmpq

from pbcgen.certify.attraction_witness import eliminate, in_squares, read
from pbcgen.certify.growth_witness import current_signs, increase
from pbcgen.certify.writing import Writing
from pbcgen.proof.tree import cover
from pbcgen.reading.overall import Rests
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.plain.boxes import Box
from pbcgen.symbolic.plain.elimination import Elimination, put_in, slopes
from pbcgen.symbolic.plain.matrices import is_definite, symmetric
from pbcgen.symbolic.plain.outcomes import Fails, NotCheckable
from pbcgen.symbolic.plain.values import Field, Function, sign
from pbcgen.symbolic.real import fraction
from pbcgen.verify.stability import Stability

#: More coordinates are not searched, and more boxes not looked at.
_MOST_SEARCHED, _MOST_BOXES = 3, 1500
#: How often bounds of some coordinates are used for bounds of others.
_ROUNDS = 3
#: Larger boxes are not looked at.
_FARTHEST = 10**9
#: The share of its width by which a part of a box is taken wider than the checker takes it.
_MARGIN = fmpq(1, 8)

Witness = dict[str, Any] | None
#: For each equation the states and inputs that it is multiplied with.
Multipliers = dict[int, dict[int, fmpq]]
#: For each state a combination of inputs, outputs and equations.
Block = Mapping[int, dict[int, fmpq]]


@dataclass(frozen=True, eq=False)
class Circuit:
    """The currents w of a circuit, R with ``gamma = R w + constant``, and Q with ``Q f = w``."""

    currents: Sequence[Function]
    outputs: Sequence[Mapping[int, fmpq]]
    charges: Sequence[Sequence[fmpq]]


def alone(
    system: Stability,
    terms: Writing,
    find_power: Callable[[Writing], Sequence[Sequence[int | None]]],
    circuit: Circuit | None,
) -> Witness:
    """Why x* is the only rest, or None.

    Args:
        system: the design as the checker reads it.
        terms: takes the formulas.
        find_power: writes N with ``grad S = N f`` and ``grad gamma = -N g`` and gives its places, if there is one.
        circuit: of a circuit.
    """
    ways = (_monotone, _determined, _convex, _circuit, _boxed, _by_states)
    return terms.first(partial(_tried, way, system, find_power, circuit) for way in ways)


@dataclass(frozen=True, eq=False)
class _Search:
    system: Stability
    find_power: Callable[[Writing], Sequence[Sequence[int | None]]]
    circuit: Circuit | None
    terms: Writing

    def chain(self, order: Sequence[int], numbers: bool = False) -> tuple[Elimination, list[list[Any]]]:
        """The equations of a rest, and what they give of these variables one after the other."""
        chain = self.system.standing
        accept = (lambda v: v.number() is not None) if numbers else (lambda v: True)
        return chain, eliminate(chain, self.terms, order, accept=accept)

    def witness(self, rests: Rests, steps: list[Any], multipliers: Multipliers, block: Block | None = None) -> Witness:
        """The monotone relation with these multipliers, and how it fixes all states.

        A block may fix all states that are left.
        """
        written = {str(j): {str(k): str(c) for k, c in row.items()} for j, row in multipliers.items()}
        try:
            total = self.system.relation(rests, written)
        except Fails:
            return None
        squares = in_squares(self.system.field, symmetric(total), self.terms)
        fixed = None if squares is None else self.fixed(rests, block or {})
        if fixed is None:
            return None
        return {"steps": steps, "multipliers": written, "squares": squares, "fixed": fixed}

    def fixed(self, rests: Rests, block: Block) -> list[dict[str, Any]] | None:
        """How equal inputs, outputs and equations fix all that is free."""
        known, result = set[int](), list[dict[str, Any]]()
        while not known >= {*rests[0]}:
            step = next(self._candidates(rests, known, block), None)
            if step is None:
                return None
            result.append(step)
            known |= {*step["states"]}
        return result

    def _candidates(self, rests: Rests, known: set[int], block: Block) -> Iterator[dict[str, Any]]:
        field, functions = self.system.field, rests[1]
        left = [k for k in rests[0] if k not in known]
        linear = _linear(rests, left, field)
        choices: list[tuple[list[int], list[dict[int, fmpq]]]] = [([k], [row]) for k, row in linear.items()]
        for i, value in enumerate(functions):
            new = value.used - known
            if len(new) == 1:
                side = sign(put_in(field, slopes(field, value)[min(new)], self.system.rest_point)) or 1
                choices.append(([*new], [{i: fmpq(side)}]))
        if block.keys() >= {*left}:
            choices.append((left, [block[k] for k in left]))
        for states, rows in choices:
            values = [sum((functions[i] * c for i, c in row.items()), field.lift(0)) for row in rows]
            if not set().union(*(v.used for v in values)) <= known | {*states}:
                continue
            J = symmetric([[slopes(field, v)[k] for k in states] for v in values])
            if not is_definite([[put_in(field, v, self.system.rest_point) for v in row] for row in J]):
                continue
            squares = increase(self.system, values, states, field.lift(0), self.terms)
            if squares is not None:
                weights = [{str(i): str(c) for i, c in row.items()} for row in rows]
                yield {"states": states, "rows": weights, "squares": squares}


def _linear(rests: Rests, left: Sequence[int], field: Field) -> dict[int, dict[int, fmpq]]:
    """Combinations of functions, affine in what is left, that are one state or input that is left."""
    affine: dict[int, list[fmpq]] = {}
    for i, value in enumerate(rests[1]):
        row = [slopes(field, value)[k].number() for k in left]
        if any(row) and None not in row:
            affine[i] = [v for v in row if v is not None]
    found = {}
    for at, k in enumerate(left):
        equations: list[Row] = [{i: row[j] for i, row in affine.items() if row[j]} for j in range(len(left))]
        equations[at][CONSTANT] = fmpq(-1)
        try:
            weights = particular_solution(reduce_rows(equations), fmpq(0))
        except Inconsistent:
            continue
        found[k] = {int(str(i)): c for i, c in weights.items() if c}
    return found


def _tried(way: Callable[[_Search], Witness], *parts: Any) -> Witness:
    try:
        return way(_Search(*parts))
    except NotCheckable:
        return None


def _monotone(search: _Search) -> Witness:
    """States as affine functions of the inputs."""
    chain, steps = search.chain(_states(search.system))
    return search.witness(search.system.along(chain), steps, {})


def _determined(search: _Search) -> Witness:
    """Inputs that are determined, or affine in states that are left."""
    chain, steps = search.chain([*_states(search.system), *range(search.system.n, search.system.n + search.system.m)])
    return search.witness(search.system.along(chain), steps, {})


def _by_states(search: _Search) -> Witness:
    """Inputs as functions of states, as far as the states are on a domain that inputs alone do not know of."""
    system = search.system
    inputs = [*range(system.n, system.n + system.m)]
    chain, steps = search.chain([*inputs, *_states(system)]) if system.field.ends else (system.standing, [])
    return search.witness(system.along(chain), steps, {}) if steps else None


def _states(system: Stability) -> list[int]:
    """The symbols that are no inputs."""
    return [k for k in range(len(system.field.symbols)) if not system.n <= k < system.n + system.m]


def _convex(search: _Search) -> Witness:
    """``grad S - grad gamma u = 0`` with a convex S: these equations times the states."""
    system = search.system
    power = [] if system.inertia else search.find_power(search.terms)
    if system.compensated or not (power or system.inertia):
        return None
    placed = read(system, search.terms)
    chain, steps = search.chain(_states(system), numbers=True)
    own = {k: system.half + k for k in range(system.half)}  # the balance of the momenta
    if not system.inertia:
        own, left = {}, [chain.reduced(e) for e in chain.equations]
        for k in (k for k in range(system.n) if k not in chain.solved):
            weights = {str(j): place for j, place in enumerate(power[k]) if place is not None and left[j].top}
            own[k] = len(chain.equations)
            steps.append([None, weights])
            chain.equations.append(
                sum(
                    (chain.equations[int(j)] * placed[p] for j, p in weights.items()),
                    system.field.lift(0),
                )
            )
    rests, m = system.along(chain), system.m
    own = {k: i for k, i in own.items() if k in rests[0]}
    slope = [[v.number() or fmpq(0) for v in slopes(system.field, g)] for g in system.column("gamma")]
    block = {k: {2 * m + i: fmpq(1)} | {m + j: row[k] for j, row in enumerate(slope) if row[k]} for k, i in own.items()}
    return search.witness(rests, steps, {i: {k: fmpq(1)} for k, i in own.items()}, block)


def _circuit(search: _Search) -> Witness:
    """``w + N g u = 0`` with ``gamma = R w``: these equations times ``-R^T u``."""
    circuit = search.circuit
    if circuit is None:
        return None
    system, terms, n, m = search.system, search.terms, search.system.n, search.system.m
    chain, steps = system.standing, list[Any]()
    signs = current_signs(system, circuit.currents)
    for row in circuit.charges:
        weights = {str(j): terms.put(f"constant {fraction(c)}") for j, c in enumerate(row) if c}
        steps.append([None, weights])
        values = [chain.equations[j] * c for j, c in enumerate(row) if c]
        chain.equations.append(sum(values, system.field.lift(0)))
    multipliers: Multipliers = {}
    for a, output in enumerate(circuit.outputs):
        for i, c in output.items():
            multipliers.setdefault(n + i, {})[n + a] = -c
    block = {k: {2 * m + n + k: fmpq(signs[k])} for k in range(n)}
    return search.witness(system.along(chain), steps, multipliers, block)


def _wider(part: Box) -> Box:
    return [(lo - (hi - lo) * _MARGIN, hi + (hi - lo) * _MARGIN) for lo, hi in part]


def _boxed(search: _Search) -> Witness:
    """A box that holds all rests, with a tree."""
    system = search.system
    chain, steps = search.chain(range(len(system.field.symbols)))
    rests = system.along(chain)
    if not 0 < len(rests[0]) <= _MOST_SEARCHED:
        return None
    zero = _independent(system, rests)
    ends, found = dict[int, fmpq](), list[list[Any]]()
    for _ in range(_ROUNDS):
        for i in range(len(rests[1])):
            for k in rests[0]:
                end = _end(system, rests, i, k, ends)
                if end is not None and end < ends.get(k, end + 1):
                    ends[k] = end
                    found.append([i, k, str(end)])
    if len(zero) + system.m != len(rests[0]) or not ends.keys() >= {*rests[0]}:
        return None
    box = [(-ends[k], ends[k]) for k in rests[0]]
    holds = system.no_other(rests, zero)
    # The checker may multiply in another order, which bounds differently: a leaf must hold on more than its part.
    tree = cover(box, lambda kind, part: holds(kind, _wider(part)), ".;", _MOST_BOXES)
    return None if tree is None else {"steps": steps, "box": {"ends": found, "zero": zero, "tree": tree}}


def _independent(system: Stability, rests: Rests) -> list[int]:
    """Equations that are left, as many as their slopes at x* are independent."""
    chosen: list[int] = []
    rows: list[list[float]] = []
    for i, value in enumerate(rests[1][2 * system.m :]):
        if value.top:
            slope = [put_in(system.field, slopes(system.field, value)[k], system.rest_point) for k in rests[0]]
            more = [*rows, [float(arb(v)) for v in slope]]
            if np.linalg.matrix_rank(np.array(more)) == len(more):
                rows = more
                chosen.append(i)
    return chosen


def _end(system: Stability, rests: Rests, i: int, k: int, ends: Mapping[int, fmpq]) -> fmpq | None:
    """A bound of a coordinate by a function, or None; some 1/64 above the least that the checker grants."""

    def holds(end: fmpq) -> bool:
        try:
            return system.bounds(rests, i, k, end, ends)
        except (NotCheckable, ValueError, ZeroDivisionError):
            return False

    high = fmpq(1, 64)
    while not holds(high):
        high = high * 2
        if high > _FARTHEST:
            return None
    low = high / 2
    while high - low > max(fmpq(1, 64), high / 16):
        middle = (low + high) / 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
