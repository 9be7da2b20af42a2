"""Witnesses of growth for certificates: why the storage of a global claim is radially unbounded.

They are looked for with the checker's own reading of the model, so that what is found here is what is checked there.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

from flint import fmpq

from pbcgen.certify.attraction_witness import combined, in_squares
from pbcgen.certify.writing import Writing
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.plain.elimination import put_in, slopes
from pbcgen.symbolic.plain.formulas import rational
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, dot, plus, symmetric
from pbcgen.symbolic.plain.values import NONNEGATIVE, Field, Function, sign
from pbcgen.symbolic.real import approximate
from pbcgen.verify.stability import Stability

#: Slopes that functions may have at least.
_LEAST_SLOPES = ("1", "1/100", "1/100000", "1/1000000000")
#: What is added to a storage that shall be a sum of squares.
_CONSTANTS = (0, 1, 100, 10**6)
#: Squares of states at which fourth powers are cut.
_SPARE = (1, 10, 100)

#: What a storage with higher powers may have of a square.
_LITTLE = (fmpq(1), fmpq(1, 100))

#: Bits of numbers that an input at x* is between.
_BITS = 40

#: (s, t) for the term s t^2 of a storage.
Part = tuple[Function, Function]
Witness = dict[str, Any] | None


def growth(
    system: Stability,
    terms: Writing,
    currents: Sequence[Function] = (),
    weight: Sequence[Sequence[fmpq]] = (),
    kinetic: Sequence[Part] = (),
    least: fmpq = _LITTLE[0],
) -> Witness:
    """Functions that the storage bounds, and how these bound the state; or None.

    Args:
        system: the design as the checker reads it.
        terms: takes the formulas.
        currents: functions w with ``S = w^T weight w / 2``, for circuits; none for others.
        weight: constant, symmetric.
        kinetic: (s, t) with the kinetic energy ``sum s t^2``, where M is known to be such a sum; found if not given.
        least: s for squares that the storage has with the wrong sign, where higher powers may outgrow them.
    """
    field, n, gamma = system.field, system.n, system.column("gamma")
    known = {k for k, pair in enumerate(system.ends[:n]) if None not in pair}
    if len(known) == n:
        return {}
    energy = system.column("S")[0]
    if system.compensated:
        energy = energy - system.potential(field.symbols[: system.half], field.lift)
    linear = [fmpq(0)] * system.m
    if currents:
        parts = [
            (field.lift(d / 2), t) for d, t in _diagonal([[field.lift(v) for v in row] for row in weight], currents)
        ]
    else:
        parts = [*kinetic] or _kinetic(system, energy)
        more, linear = _quadratic(field, _less(energy, parts), gamma, n)
        parts = parts + [(s if s.number() is None or s.number() > 0 else field.lift(least), t) for s, t in more]  # type: ignore[operator]
    force = [v - u for v, u in zip(linear, system.resting_input, strict=True)]
    outgrown = [bool(a - abs(v) > 0) for a, v in zip(system.model.vector("alpha"), force, strict=True)]
    rows = [{} if o else _combination(g, parts) for g, o in zip(gamma, outgrown, strict=True)]
    rest = _less(energy, parts)
    for weight_, g in zip(linear, gamma, strict=True):
        rest = rest - g * weight_
    spans = _by_currents(system, parts, currents, terms) if currents else None
    if spans is None:
        spans = _ordered(system, parts, [g if o else None for g, o in zip(gamma, outgrown, strict=True)], known, terms)
    excess = None if spans is None or any(row is None for row in rows) else _excess(field, rest, terms)
    if excess is None:
        return None
    given = {"parts": _written(parts, terms), "linear": [str(v) for v in linear], "rows": rows}
    return given | {"excess": excess, "spans": spans}


def convex_growth(system: Stability, terms: Writing, kinetic: Sequence[Part] = ()) -> Witness:
    """The same for a storage that is convex in some states, beside a kinetic energy."""
    gamma, energy = system.column("gamma"), system.column("S")[0]
    parts = [] if system.compensated else [*kinetic] or _kinetic(system, energy) or _separate(system, energy)
    parts = parts if _flat(system, parts, gamma) else []
    rest = _less(energy, parts)
    states = sorted(rest.used.union(*(v.used for v in gamma)))
    shown = None if system.compensated else _bends(system, rest, states, terms)
    spans = None if shown is None else _ordered(system, parts, [], {*states}, terms)
    if spans is None:
        return None
    return {"parts": _written(parts, terms), "convex": {"states": states} | (shown or {}), "spans": spans}


def _bends(system: Stability, rest: Function, states: Sequence[int], terms: Writing) -> dict[str, Any] | None:
    """Squares that show that the rest is convex; less what the inputs at x* do, unless gamma is affine."""
    field, n, m = system.field, system.n, system.m
    left = field.lift(rest - dot(system.constants, system.column("gamma")))
    H = [[slopes(field, v)[k] for k in states] for v in (slopes(field, left)[k] for k in states)]
    if all(v.used <= {*states} for row in H for v in row):
        squares = in_squares(field, H, terms)
        return None if squares is None else {"squares": squares}
    forces = [sorted({decimal(u, side) for side in (-1, 1)}, key=rational) for u in system.point[1]]
    corners = []
    for corner in product(*forces):
        place = [*field.symbols[:n], *map(rational, corner), *field.symbols[n + m :]]
        squares = in_squares(field, [[field.lift(put_in(field, v, place)) for v in row] for row in H], terms)
        if squares is None:
            return None
        corners.append({"squares": squares})
    return {"forces": forces, "corners": corners}


def decimal(value: Any, side: int) -> str:
    """A number that is not larger (-1), or not smaller (1)."""
    if isinstance(value, fmpq):
        return str(value)
    near = approximate(value)
    return str(fmpq(round(near * 2**_BITS) + side * (1 + round(abs(near))), 2**_BITS))


def inertia(system: Stability, terms: Writing, kinetic: Sequence[Part] = ()) -> list[list[int]]:
    """The kinetic energy as squares, which show M(q) > 0; nothing where they are not found."""
    return _written([*kinetic] or _kinetic(system, system.column("S")[0]), terms)


def _flat(system: Stability, parts: Sequence[Part], gamma: Sequence[Function]) -> bool:
    """Whether the parts vanish at x* together with their slopes by what gamma reads."""
    read = set[int]().union(*(g.used for g in gamma))
    values = [v for _, t in parts for v in (t, *(slopes(system.field, t)[k] for k in sorted(read)))]
    return all(sign(put_in(system.field, v, system.rest_point)) == 0 for v in values)


def _written(parts: Sequence[Part], terms: Writing) -> list[list[int]]:
    return [[terms.function(s), terms.function(t)] for s, t in parts]


def increase(
    system: Stability, values: Sequence[Function], states: Sequence[int], least: Function, terms: Writing
) -> list[list[Any]] | None:
    """Squares that show that the values increase with these states by ``least``, or None."""
    field = system.field
    J: Matrix = symmetric([[slopes(field, field.lift(v))[k] for k in states] for v in values])
    return in_squares(field, plus(J, diagonal([least] * len(states)), -1), terms)


def _by_currents(
    system: Stability, parts: Sequence[Part], currents: Sequence[Function], terms: Writing
) -> list[dict[str, Any]] | None:
    """All states at once, by the currents of a circuit with signs."""
    field, states = system.field, [*range(system.n)]
    rows = [combined(w, [t for _, t in parts]) for w in currents]
    if any(row is None for row in rows) or len(parts) != system.n:
        return None
    signs = current_signs(system, currents)
    values = [w * s for w, s in zip(currents, signs, strict=True)]
    for text in _LEAST_SLOPES:
        least = field.lift(rational(text))
        squares = increase(system, values, states, least, terms)
        if squares is not None:
            weighted = [
                {str(k): str(c * s) for k, c in (row or {}).items()} for row, s in zip(rows, signs, strict=True)
            ]
            return [{"states": states, "rows": weighted, "least": terms.function(least), "squares": squares}]
    return None


def current_signs(system: Stability, currents: Sequence[Function]) -> list[int]:
    """Signs that make the diagonal of the Jacobian of the currents positive at x*."""
    slope = [slopes(system.field, system.field.lift(w))[i] for i, w in enumerate(currents)]
    return [-1 if sign(put_in(system.field, v, system.rest_point)) == -1 else 1 for v in slope]


def _less(value: Function, parts: Sequence[Part]) -> Function:
    for weight, t in parts:
        value = value - weight * t * t
    return value


def _kinetic(system: Stability, energy: Function) -> list[tuple[Function, Function]]:
    """``p^T M^-1(q) p / 2`` by elimination, for the momenta of a mechanical system; nothing for others."""
    n, half, field = system.n, system.half, system.field
    momenta = range(half, n)
    if n % 2 or n == 0:
        return []
    H = [slopes(field, row)[half:n] for row in slopes(field, energy)[half:n]]
    entries = [v for row in H for v in row]
    if all(v.number() is not None for v in entries):
        return []  # part of the constant quadratic form
    if any(slopes(field, v)[j].top for v in entries for j in momenta):
        return []
    return [(d / 2, t) for d, t in _diagonal(H, field.symbols[half:n])]


def _separate(system: Stability, energy: Function) -> list[Part]:
    """The momenta of a constant M, where they stand in a form of their own."""
    field, half, n = system.field, system.half, system.n
    H = [[slopes(field, v)[k] for k in range(half, n)] for v in slopes(field, energy)[half:n]]
    if n % 2 or any(v.number() is None for row in H for v in row):
        return []
    return [(d / 2, t) for d, t in _diagonal(H, field.symbols[half:n])]


def _diagonal(
    matrix: Sequence[Sequence[Function]], z: Sequence[Function], last: Sequence[bool] | None = None
) -> list[tuple[Function, Function]]:
    """``z^T M z = sum d_i t_i^2``: (d_i, t_i), without those with d_i = 0; rows with few entries first, some last."""
    late = last or [False] * len(z)
    work, found = {i: {k: v for k, v in enumerate(row) if v.top} for i, row in enumerate(matrix)}, []
    while work := {i: row for i, row in work.items() if row}:
        pivots = [(late[i], len(row), i) for i, row in work.items() if i in row]
        if not pivots:
            return []
        i = min(pivots)[-1]
        row = work.pop(i)
        pivot = row.pop(i)
        ratios, t = {k: v / pivot for k, v in row.items()}, z[i]
        for k, ratio in ratios.items():
            t = t + ratio * z[k]
        found.append((pivot, t))
        for a, v in row.items():
            del work[a][i]
            for b, ratio in ratios.items():
                value = work[a][b] - v * ratio if b in work[a] else -(v * ratio)
                work[a] = {k: w for k, w in work[a].items() if k != b} | ({b: value} if value.top else {})
    return found


def _quadratic(
    field: Field, rest: Function, gamma: Sequence[Function], n: int
) -> tuple[list[tuple[Function, Function]], list[fmpq]]:
    """The constant quadratic form with the linear part taken in, and what of that is left for gamma."""
    Q = [[field.lift(0)] * n for _ in range(n)]
    linear = [fmpq(0)] * n
    for exponents, c in rest.top.to_dict().items() if rest.bottom.is_constant() else ():
        used = [k for k, e in enumerate(exponents) for _ in range(int(e))]
        places = [k - field.pool for k in used]
        if min(places, default=-1) < 0 or len(places) > 2:
            continue
        if len(places) == 1:
            linear[places[0]] += c
        else:
            for i, j in (places, places[::-1]):
                Q[i][j] = Q[i][j] + c / 2
    rows = []
    for k in range(n):  # linear = 2 Q shift + sum lambda_j grad gamma_j
        row: Row = {("x", j): v.number() * 2 for j, v in enumerate(Q[k]) if v.top}  # type: ignore[operator]
        for j, g in enumerate(gamma):
            slope = slopes(field, g)[k].number()
            if slope:
                row["gamma", j] = slope
        rows.append({**row, CONSTANT: -linear[k]})
    try:
        solution = particular_solution(reduce_rows(rows), fmpq(0))
    except Inconsistent:
        return [], [fmpq(0)] * len(gamma)
    shifted = [field.symbols[k] + solution.get(("x", k), fmpq(0)) for k in range(n)]
    steep = [degree > 2 for degree in rest.top.degrees()[field.pool : field.pool + n]]  # these outgrow a square
    return _diagonal(Q, shifted, steep), [solution.get(("gamma", j), fmpq(0)) for j in range(len(gamma))]


def _ordered(
    system: Stability, parts: Sequence[Part], gamma: Sequence[Function | None], known: set[int], terms: Writing
) -> list[dict[str, Any]] | None:
    """One combination of functions after the other, each with one new state; None if a state is left over."""
    field, states = system.field, {*range(system.n)}
    functions = [*parts, *((field.lift(1), g) for g in gamma if g is not None)]
    places = [*range(len(parts)), *(len(parts) + j for j, g in enumerate(gamma) if g is not None)]
    waiting = [({place: fmpq(1)}, t) for place, (_, t) in zip(places, functions, strict=True)]
    weights = dict(zip(places, (s for s, _ in functions), strict=True))
    spans, later = list[dict[str, Any]](), list[tuple[dict[int, fmpq], Function, int]]()
    while not states <= known | {k for *_, k in later}:
        for at, (row, t) in enumerate(waiting):
            new, fit = t.used - known, all(weights[i].used <= known for i in row)
            step = _span(system, row, t, min(new), known, terms) if len(new) == 1 and fit else None
            if step is not None:
                spans.append(step)
                known = known | new
                del waiting[at]
                break
        else:
            apart = _apart(field, waiting, known)
            if apart is None:
                return None
            waiting, first = apart
            later.append(first)
    for row, t, k in later[::-1]:
        step = _span(system, row, t, k, known, terms)
        if step is None or not t.used <= known | {k} or not all(weights[i].used <= known for i in row):
            return None
        spans.append(step)
        known = known | {k}
    return spans


def _apart(
    field: Field, waiting: Sequence[tuple[dict[int, fmpq], Function]], known: set[int]
) -> tuple[list[tuple[dict[int, fmpq], Function]], tuple[dict[int, fmpq], Function, int]] | None:
    """The functions without a state that all of them are affine in, by one that will give it; and that one."""
    for k in sorted({k for _, t in waiting for k in t.used} - known):
        by = [slopes(field, t)[k].number() for _, t in waiting]
        at = next((i for i, c in enumerate(by) if c), None)
        if at is None or any(c is None for c in by):
            continue
        row, t = waiting[at]
        left = []
        for i, (other, value) in enumerate(waiting):
            ratio = (by[i] or fmpq(0)) / (by[at] or fmpq(1))
            if i != at:
                mixed = {j: other.get(j, fmpq(0)) - row.get(j, fmpq(0)) * ratio for j in {*other, *row}}
                left.append(({j: c for j, c in sorted(mixed.items()) if c}, value - t * ratio if ratio else value))
        return left, (row, t, k)
    return None


def _span(
    system: Stability, row: dict[int, fmpq], t: Function, k: int, known: set[int], terms: Writing
) -> dict[str, Any] | None:
    """A combination t grows with state k: it is affine in it with a slope that the known states give, or increases."""
    field = system.field
    slope = slopes(field, t)[k]
    side = field.everywhere(slope.top) * field.everywhere(slope.bottom)
    exact = bool(side) and slope.used <= known
    side = side if exact else sign(put_in(field, slope, system.rest_point)) or 0
    rows = [{str(i): str(c * side) for i, c in row.items()}]
    if exact:
        return {"states": [k], "rows": rows, "least": terms.function(slope * side), "squares": []}
    for text in _LEAST_SLOPES if side else ():
        least = field.lift(rational(text))
        squares = increase(system, [t * side], [k], least, terms)
        if squares is not None:
            return {"states": [k], "rows": rows, "least": terms.function(least), "squares": squares}
    return None


def _combination(gamma: Function, parts: Sequence[Part]) -> dict[str, str] | None:
    """gamma as a combination of the parts with constant weights, up to a constant."""
    steady = [k for k, (s, _) in enumerate(parts) if s.number() is not None]
    weights = combined(gamma, [parts[k][1] for k in steady], up_to_constant=True)
    return None if weights is None else {str(steady[k]): str(c) for k, c in weights.items()}


def _excess(field: Field, rest: Function, terms: Writing) -> list[list[Any]] | None:
    """Squares that leave bounded terms of the storage: its terms one by one, else all of it and a constant."""
    found, left = [], rest
    for exponents, c in rest.top.to_dict().items() if rest.bottom.is_constant() else ():
        term = field.quotient(field.ctx.from_dict({exponents: c}), rest.bottom)
        if field.bounded(term) or c <= 0:
            continue
        odd = [k for k, e in enumerate(exponents) if e % 2]
        atoms = [list(field.atoms.items())[field.pool - 1 - k] for k in odd if k < field.pool]
        if len(atoms) == len(odd) and all(kind in NONNEGATIVE for (kind, _, _), _ in atoms):
            factors = [[kind, terms.function(argument), None, True] for (kind, _, _), argument in atoms]
            half = field.quotient(field.ctx.from_dict({tuple(e // 2 for e in exponents): fmpq(1)}), field.one)
            found.append([str(c), factors, [terms.function(half)]])
            left = left - term
    if field.bounded(left):
        return found
    for constant in _CONSTANTS:
        squares = in_squares(field, [[rest + fmpq(constant)]], terms)
        if squares is not None:
            return squares
    return _by_fourth_powers(field, rest, terms)


def _by_fourth_powers(field: Field, rest: Function, terms: Writing) -> list[list[Any]] | None:
    """``c x^4 = c (x^2 - r)^2 + 2 c r x^2 - c r^2``: what a fourth power has to spare for squares and linear terms."""
    powers = {k: rest.top.to_dict().get(_alone(field, k, 4), fmpq(0)) for k in range(len(field.symbols))}
    steep = {k: c for k, c in powers.items() if c > 0 and rest.bottom.is_constant()}
    for r in _SPARE if steep else ():
        tops = {k: field.symbols[k] * field.symbols[k] - r for k in steep}
        left = rest - sum((tops[k] * tops[k] * c for k, c in steep.items()), field.lift(0))
        for constant in _CONSTANTS:
            squares = in_squares(field, [[left + fmpq(constant)]], terms)
            if squares is not None:
                return [[str(c), [], [terms.function(tops[k])]] for k, c in steep.items()] + squares
    return None


def _alone(field: Field, k: int, power: int) -> tuple[int, ...]:
    """The exponents of a power of a symbol."""
    size = range(field.pool + len(field.symbols))
    return tuple(power if j == field.pool + k else 0 for j in size)
