"""Witnesses of attraction for certificates: how the invariant set is reached, why the storage grows, why x* is alone.

They are looked for with the checker's own reading of the model, so that what is found here is what is checked there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from flint import fmpq, fmpq_mpoly

from pbcgen.control.writing import Writing
from pbcgen.proof.squares import decompose_matrix
from pbcgen.symbolic.field import Field as Algebra
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.plain.elimination import Elimination, put_in, slopes
from pbcgen.symbolic.plain.formulas import Formulas, rational
from pbcgen.symbolic.plain.values import NONNEGATIVE, ODD, Field, Function, sign
from pbcgen.symbolic.real import fraction
from pbcgen.verify.stability import Stability

Steps = list[list[Any]]
#: Rounds of Lie derivatives, as a multiple of the number of states, and the size of equations that are given up.
_ROUNDS, _MOST_TERMS = 3, 300
#: Slopes that the currents of a circuit may have at least.
_LEAST_SLOPES = ("1/100", "1/100000", "1/1000000000")
#: What is added to a storage that shall be a sum of squares.
_CONSTANTS = (0, 1, 100, 10**6)
#: Atoms that a function may have to be taken to the prover's field.
_ATOMS = 96


# --- the invariant set -------------------------------------------------------------------------------------------


def steps_to_rest(system: Stability, terms: Writing) -> tuple[Elimination, dict[str, Any]] | None:
    """The chain of steps after which nothing moves, and which combinations of equations the rates are; or None."""
    chain = system.rest()

    def rates() -> dict[str, dict[str, str]] | None:
        equations, found = [chain.reduced(e) for e in chain.equations], {}
        for i, rate in enumerate(system.rates):
            weights = _weights(chain.reduced(rate), equations)
            if weights is None:
                return None
            found[str(i)] = {str(j): str(c) for j, c in weights.items()}
        return {i: row for i, row in found.items() if row}

    steps = eliminate(chain, terms, range(len(system.field.symbols)), lambda: rates() is not None, range(system.n))
    combined = rates()
    return None if combined is None else (chain, {"steps": steps} | ({"rates": combined} if combined else {}))


def _weights(function: Function, others: Sequence[Function], up_to_constant: bool = False) -> dict[int, fmpq] | None:
    """Constant weights with which a function is a combination of others, or None."""
    common = function.bottom
    for bottom in (other.bottom for other in others):
        common = common * bottom / common.gcd(bottom)
    if up_to_constant and not common.is_constant():
        return None
    rows: dict[Any, Row] = {}
    for key, side, f in ((CONSTANT, -1, function), *((k, 1, other) for k, other in enumerate(others))):
        for exponents, c in (f.top * (common / f.bottom)).to_dict().items():
            rows.setdefault(exponents, {})[key] = c * side
    try:
        solution = particular_solution(
            reduce_rows([row for e, row in rows.items() if any(e) or not up_to_constant]), fmpq(0)
        )
    except Inconsistent:
        return None
    return {int(str(k)): c for k, c in solution.items() if c}


def eliminate(
    chain: Elimination,
    terms: Writing,
    order: Sequence[int],
    enough: Callable[[], bool] = lambda: False,
    alike: Sequence[int] = (),
) -> Steps:
    """Solve equations for variables and take Lie derivatives until that is enough, or nothing new appears.

    Variables are taken in order, except for those that are ``alike``.
    """
    steps: Steps = []
    derived: set[int] = set()
    left: list[Function] = []  # of each equation
    for _ in range(_ROUNDS * len(order)):
        while (found := _solvable(chain, order, alike, left)) is not None:
            source, k, value, kind, scale = found
            if not chain.solve(source, k, value, kind, scale):
                return steps
            steps.append([source, k, terms.function(value), *([kind, str(fraction(scale))] if kind else [])])
        open_ = [i for i, e in enumerate(left) if i not in derived and _is_open(e)]
        if not open_ or not any(rate.top for rate in chain.rates) or enough():
            return steps
        for i in open_:
            derived.add(i)
            chain.derive(i)
            steps.append([i])
    return steps


def _is_open(e: Function) -> bool:
    return bool(e.top) and len(e.top) <= _MOST_TERMS


def _solvable(
    chain: Elimination, order: Sequence[int], alike: Sequence[int], left: list[Function]
) -> tuple[int, int, Function, str, fmpq] | None:
    """The first step that an equation allows; ``left`` takes what is left of each that is looked at."""
    left += chain.equations[len(left) :]
    for source, equation in enumerate(left):
        reduced = left[source] = chain.reduced(equation)
        if not _is_open(reduced):
            continue
        factor = _essential(chain.field, reduced.top)
        if factor is None:
            continue
        for k in _among(chain.field, factor, order):
            solution = _linear(chain.field, factor, k)
            if solution is not None:
                found = _fewest(chain, factor, alike) if k in alike else (k, solution)
                return source, *found, "", fmpq(1)
            inside = _through(chain.field, factor, k)
            if inside is not None:
                return source, k, *inside
    return None


def _among(field: Field, polynomial: fmpq_mpoly, order: Sequence[int]) -> Sequence[int]:
    """The variables that a polynomial may depend on: all where it holds atoms."""
    used = {j for j, degree in enumerate(polynomial.degrees()) if degree}
    return order if min(used, default=0) < field.pool else [k for k in order if field.pool + k in used]


def _fewest(chain: Elimination, factor: fmpq_mpoly, alike: Sequence[int]) -> tuple[int, Function]:
    """Of several variables that an equation gives one that the fewest solved ones depend on: these change with it."""
    field, used = chain.field, [value.used for value in chain.solved.values()]
    found = {k: v for k in _among(field, factor, alike) if (v := _linear(field, factor, k)) is not None}
    return min(found.items(), key=lambda item: sum(field.pool + item[0] in places for places in used))


def _essential(field: Field, polynomial: fmpq_mpoly) -> fmpq_mpoly | None:
    """The one factor that may vanish."""
    open_ = [factor for factor, _ in polynomial.factor()[1] if not field.everywhere(factor)]
    return open_[0] if len(open_) == 1 else None


def _occurs(field: Field, polynomial: fmpq_mpoly, k: int) -> bool:
    """Whether symbol k occurs inside an atom of the polynomial."""
    inside = [j for j, degree in enumerate(polynomial.degrees()) if degree and j < field.pool]
    arguments = list(field.atoms.values())
    return any(
        part.degrees()[field.pool + k] or _occurs(field, part, k)
        for j in inside
        for part in (arguments[field.pool - 1 - j].top, arguments[field.pool - 1 - j].bottom)
    )


def _linear(field: Field, polynomial: fmpq_mpoly, k: int) -> Function | None:
    """The value of symbol k in ``A x_k + B = 0`` with A nowhere zero."""
    at = field.pool + k
    if polynomial.degrees()[at] != 1 or _occurs(field, polynomial, k):
        return None
    split: tuple[dict[Any, fmpq], dict[Any, fmpq]] = ({}, {})
    for exponents, coefficient in polynomial.to_dict().items():
        split[int(exponents[at])][tuple(0 if j == at else e for j, e in enumerate(exponents))] = coefficient
    B, A = (field.ctx.from_dict(part) for part in split)
    return field.quotient(-B, A) if field.everywhere(A) else None


def _through(field: Field, polynomial: fmpq_mpoly, k: int) -> tuple[Function, str, fmpq] | None:
    """``T(c (x_k - value)) = 0`` for an odd increasing T."""
    terms = list(polynomial.to_dict())
    used = [j for j, e in enumerate(terms[0]) if e]
    if len(terms) != 1 or len(used) != 1 or used[0] >= field.pool:
        return None
    (kind, _, _), argument = list(field.atoms.items())[field.pool - 1 - used[0]]
    slope = slopes(field, argument)[k].number() if kind in ODD else None
    return None if not slope else (field.symbols[k] - argument / slope, kind, slope)


# --- x* alone ----------------------------------------------------------------------------------------------------


def uniqueness(
    system: Stability, chain: Elimination, terms: Writing, find_power: Callable[[], list[list[int | None]]]
) -> dict[str, Any] | None:
    """Why the invariant set is {x*}.

    What is constant fixes all states; or (rest) is monotone in the constant input; or the storage is convex, where
    ``find_power`` gives the places of N with ``grad S = N f`` (none if there is none).
    """
    n, m = system.n, system.m
    still = [chain.solved[n + j].number() if n + j in chain.solved else None for j in range(m)]
    if still == system.resting_input:
        chain.equations += [row[0] - v for row, v in system.changes("gamma")]
        then = eliminate(chain, terms, range(n))
        alone = [chain.solved[k].number() if k in chain.solved else None for k in range(n)] == system.point[0]
        return {"then": then} if alone else None
    if {*chain.solved} >= {*range(n)}:
        squares = in_squares(system.field, system.compliance(chain), terms)
        if squares is not None:
            return {"squares": squares}
    power = find_power()
    if not power:
        return None
    system.__dict__["placed"] = read(system, terms)  # with the places of N
    squares = in_squares(system.field, system.convex_part(chain, power), terms)
    return None if squares is None else {"power": power, "squares": squares}


def in_squares(field: Field, matrix: Sequence[Sequence[Function]], terms: Writing) -> list[list[Any]] | None:
    """A matrix of the checker's functions as a sum of squares, written; None if that is not found."""
    angles = _angles(field)
    found = decompose_matrix(_as_quotients(field, matrix, angles))
    return None if found is None else terms.squares(found, dict(enumerate(angles, len(field.symbols))))


def _angles(field: Field) -> list[Function]:
    """The arguments of sin and cos that are sums and are not expanded: symbols of their own in the provers' field."""
    sums = [a for (kind, _, _), a in field.atoms.items() if kind in ("sin", "cos") and len(a.top) > 1]
    return [*{(str(a.top), str(a.bottom)): a for a in sums}.values()] if field.whole else []


def _as_quotients(
    field: Field, matrix: Sequence[Sequence[Function]], angles: Sequence[Function]
) -> list[list[Quotient]]:
    """Functions of the checker's field in the field of the provers."""
    places = {(str(a.top), str(a.bottom)): len(field.symbols) + k for k, a in enumerate(angles)}
    algebra = Algebra([f"z{k}" for k in range(len(field.symbols) + len(angles))], _ATOMS)
    atoms = list(field.atoms.items())

    def generator(k: int) -> Quotient:
        if k >= field.pool:
            return algebra.symbol(k - field.pool)
        (kind, top, bottom), argument = atoms[field.pool - 1 - k]
        angle = places.get((top, bottom)) if kind in ("sin", "cos") else None
        result: Quotient = getattr(algebra, kind)(quotient(argument) if angle is None else algebra.symbol(angle))
        return result

    def polynomial(p: fmpq_mpoly) -> Quotient:
        total = algebra.const(0)
        for exponents, coefficient in p.to_dict().items():
            term = algebra.const(fraction(coefficient))
            for k, e in enumerate(exponents):
                for _ in range(int(e)):
                    term = term * generator(k)
            total = total + term
        return total

    def quotient(value: Function) -> Quotient:
        return polynomial(value.top) / polynomial(value.bottom)

    return [[quotient(field.lift(v)) for v in row] for row in matrix]


def read(system: Stability, terms: Writing) -> list[Function]:
    """What is written so far, as the checker reads it."""
    return Formulas.parse(terms.lines()).walk(system.field.lift, {"state": system.field.symbols})


# --- growth ------------------------------------------------------------------------------------------------------


def growth(
    system: Stability,
    terms: Writing,
    currents: Sequence[Function],
    weight: Sequence[Sequence[fmpq]],
    kinetic: Sequence[tuple[Function, Function]] = (),
) -> dict[str, Any] | None:
    """Coordinates in which the storage is radially unbounded, or None.

    Args:
        system: the design as the checker reads it.
        terms: takes the formulas.
        currents: functions w with ``S = w^T weight w / 2``, for circuits; none for others.
        weight: constant, symmetric.
        kinetic: (s, t) with the kinetic energy ``sum s t^2``, where M is known to be such a sum; found if not given.
    """
    field, n = system.field, system.n
    gamma = system.column("gamma")
    energy = system.column("S")[0]
    if system.compensated:
        energy = energy - system.potential(field.symbols[: system.half], field.lift)
    linear = [fmpq(0)] * system.m
    squares: list[tuple[Function, Function]] = []
    if currents:
        squares = [
            (field.lift(d / 2), t) for d, t in _diagonal([[field.lift(v) for v in row] for row in weight], currents)
        ]
    else:
        squares = [*kinetic] or _kinetic(system, energy)
        more, linear = _quadratic(field, _less(energy, squares), gamma, n)
        squares = squares + more
    rest = _less(energy, squares)
    for weight_, g in zip(linear, gamma, strict=True):
        rest = rest - g * weight_
    force = [v - u for v, u in zip(linear, system.resting_input, strict=True)]
    outgrown = [bool(a - abs(v) > 0) for a, v in zip(system.model.vector("alpha"), force, strict=True)]
    ordered = _ordered(field, n, squares, [g if o else None for g, o in zip(gamma, outgrown, strict=True)], terms)
    if ordered is None:
        return None
    coordinates, others = ordered
    rows = [{} if o else _combination(g, squares, terms) for g, o in zip(gamma, outgrown, strict=True)]
    excess = _excess(field, rest, terms)
    if excess is None or any(row is None for row in rows):
        return None
    excess = excess + [[str(s.number()), [], [terms.function(t)]] for s, t in others]
    return {"coordinates": coordinates, "linear": [str(v) for v in linear], "rows": rows, "excess": excess}


def monotone(
    system: Stability,
    terms: Writing,
    currents: Sequence[Function],
    weight: Sequence[Sequence[fmpq]],
    charges: Sequence[Sequence[fmpq | None]],
) -> dict[str, Any] | None:
    """For a circuit whose currents w grow with the state: the squares that show it, or None.

    Args:
        system: the design as the checker reads it.
        terms: takes the formulas.
        currents: w with ``S = w^T weight w / 2``.
        weight: Xi, constant.
        charges: Q with ``Q f = w``.
    """
    field, n = system.field, system.n
    rows = [_weights(g, currents, up_to_constant=True) for g in system.column("gamma")]
    if any(row is None for row in rows) or any(v is None for row in charges for v in row):
        return None
    J = [slopes(field, w)[:n] for w in currents]
    signs = [1 if (v := _sign_at_zero(field, J[i][i])) is None or v > 0 else -1 for i in range(n)]
    J = [[v * s for v in row] for row, s in zip(J, signs, strict=True)]
    for least in _LEAST_SLOPES:
        margin = [[(J[i][j] + J[j][i]) / 2 - rational(least) * int(i == j) for j in range(n)] for i in range(n)]
        squares = in_squares(field, margin, terms)
        if squares is None:
            continue
        zero = terms.put("constant 0")
        N = [[terms.put(f"constant {fraction(v)}") if v else zero for v in row] for row in charges]
        R = [[str((row or {}).get(k, fmpq(0))) for k in range(n)] for row in rows]
        found = {"w": [terms.function(w) for w in currents], "N": N, "R": R, "signs": signs, "least": least}
        return {"currents": found | {"Xi": [[str(v) for v in row] for row in weight]}, "squares": squares}
    return None


def _sign_at_zero(field: Field, value: Function) -> int | None:
    point = [fmpq(0)] * len(field.symbols)
    return sign(put_in(field, value, point))


def _less(value: Function, squares: Sequence[tuple[Function, Function]]) -> Function:
    for weight, t in squares:
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


def _diagonal(matrix: Sequence[Sequence[Function]], z: Sequence[Function]) -> list[tuple[Function, Function]]:
    """``z^T M z = sum d_i t_i^2``: (d_i, t_i), without those with d_i = 0; rows with few entries first."""
    work, found = {i: {k: v for k, v in enumerate(row) if v.top} for i, row in enumerate(matrix)}, []
    while work := {i: row for i, row in work.items() if row}:
        i = min((len(row), i) for i, row in work.items() if i in row)[1] if any(i in work[i] for i in work) else None
        if i is None:
            return []
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
    return _diagonal(Q, shifted), [solution.get(("gamma", j), fmpq(0)) for j in range(len(gamma))]


def _present(field: Field, function: Function | None) -> set[int]:
    return set() if function is None else {k for k, d in enumerate(slopes(field, function)) if d.top}


def _ordered(
    field: Field,
    n: int,
    squares: Sequence[tuple[Function, Function]],
    gamma: Sequence[Function | None],
    terms: Writing,
) -> tuple[list[list[Any]], list[tuple[Function, Function]]] | None:
    """One coordinate after the other, each with one new state, and the other squares; None if a state is left over."""
    known: set[int] = set()
    result: list[list[Any]] = []
    waiting: list[tuple[Function | None, Function, Any]] = [(s, t, None) for s, t in squares]
    waiting += [(None, g, j) for j, g in enumerate(gamma) if g is not None]
    present = [(_present(field, s), _present(field, t)) for s, t, _ in waiting]
    while waiting:
        ready = [(i, in_t - known) for i, (in_s, in_t) in enumerate(present) if in_s <= known]
        single = ((i, *new) for i, new in ready if len(new) == 1)
        chosen = next(((i, k) for i, k in single if _is_coordinate(field, *waiting[i][:2], k)), None)
        if chosen is None:
            break
        present.pop(chosen[0])
        weight, t, j = waiting.pop(chosen[0])
        k = chosen[1]
        known.add(k)
        place = j if weight is None else terms.function(t)
        result.append([None if weight is None else terms.function(weight), place, k])
    return (result, [(s, t) for s, t, _ in waiting if s is not None]) if known == {*range(n)} else None


def _is_coordinate(field: Field, s: Function | None, t: Function, k: int) -> bool:
    """Whether s > 0, and t is affine in state k with a slope that vanishes nowhere."""
    a = slopes(field, t)[k]
    positive = s is None or field.everywhere(s.top) * field.everywhere(s.bottom) == 1
    return positive and not slopes(field, a)[k].top and field.everywhere(a.top) != 0


def _combination(
    gamma: Function, squares: Sequence[tuple[Function, Function]], terms: Writing
) -> dict[str, str] | None:
    """gamma as a combination of the coordinates with constant weights, up to a constant."""
    basis = [t for s, t in squares if s.number() is not None]
    weights = _weights(gamma, basis, up_to_constant=True)
    return None if weights is None else {str(terms.function(basis[k])): str(c) for k, c in weights.items()}


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
    return None
