"""Witnesses of attraction for certificates: how the invariant set is reached, and matrices as sums of squares.

They are looked for with the checker's own reading of the model, so that what is found here is what is checked there.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from flint import fmpq, fmpq_mpoly

from pbcgen.certify.signs import by_sign_or_harmonics
from pbcgen.certify.writing import Writing
from pbcgen.proof.squares import decompose_matrix
from pbcgen.symbolic.field import Field as Algebra
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.plain.elimination import Elimination, slopes
from pbcgen.symbolic.plain.formulas import Formulas
from pbcgen.symbolic.plain.values import ODD, Field, Function
from pbcgen.symbolic.real import fraction
from pbcgen.verify.stability import Stability

Steps = list[list[Any]]
#: Rounds of Lie derivatives, as a multiple of the number of states, and the size of equations that are given up.
_ROUNDS, _MOST_TERMS = 3, 300
#: Terms of all equations that are looked at in all rounds.
_MOST_SPENT = 4000
#: How many cases a product may make, and how many products one after the other are looked at.
_MOST_CASES, _DEEPEST = 8, 4
#: Atoms that a function may have to be taken to the prover's field.
_ATOMS = 96


# --- the invariant set -------------------------------------------------------------------------------------------


def steps_to_rest(system: Stability, terms: Writing, depth: int = _DEEPEST) -> dict[str, Any] | None:
    """The chain of steps after which nothing moves, and which combinations of equations the rates are; or None.

    First without looking at cases; where that does not end, an equation that is a product makes one for each factor.
    """
    return terms.first(partial(_settled, system, cases) for cases in (0, depth))


def _settled(system: Stability, depth: int, terms: Writing, chain: Elimination | None = None) -> dict[str, Any] | None:
    chain = system.undriven() if chain is None else chain

    def rates() -> dict[str, dict[str, str]] | None:
        equations, found = [chain.reduced(e) for e in chain.equations], {}
        for i, rate in enumerate(system.rates):
            weights = combined(chain.reduced(rate), equations)
            if weights is None:
                return None
            found[str(i)] = {str(j): str(c) for j, c in weights.items()}
        return {i: row for i, row in found.items() if row}

    def enough() -> bool:
        return rates() is not None or (depth > 0 and open_product(chain) is not None)

    steps = eliminate(chain, terms, range(len(system.field.symbols)), enough, range(system.n))
    found = rates()
    if found is not None:
        return {"steps": steps} | ({"rates": found} if found else {})
    product = open_product(chain) if depth else None
    if product is None:
        return None
    source, factors = product
    cases: list[Any] = []
    for factor in factors:
        other = copy.copy(chain)
        other.equations = [*chain.equations, factor]
        case = _settled(system, depth - 1, terms, other)
        if case is None:
            return None
        cases.append([terms.function(factor), case])
    return {"steps": steps, "cases": [source, *cases]}


def open_product(chain: Elimination) -> tuple[int, list[Function]] | None:
    """An equation that is a product of functions that may vanish, and these."""
    field = chain.field
    for source, equation in enumerate(chain.equations):
        reduced = chain.reduced(equation)
        if not _is_open(reduced):
            continue
        open_ = [factor for factor, _ in reduced.top.factor()[1] if not field.everywhere(factor)]
        if 1 < len(open_) <= _MOST_CASES:
            return source, [field.quotient(factor, field.one) for factor in open_]
    return None


def combined(function: Function, others: Sequence[Function], up_to_constant: bool = False) -> dict[int, fmpq] | None:
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
    accept: Callable[[Function], bool] = lambda value: True,
) -> Steps:
    """Solve equations for variables and take Lie derivatives until that is enough, or nothing new appears.

    Variables are taken in order, except for those that are ``alike``; ``accept`` says by which values.
    """
    steps: Steps = []
    derived: set[int] = set()
    stopped: set[int] = set()
    left: list[Function] = []  # of each equation
    spent = 0
    for _ in range(_ROUNDS * len(order)):
        while (found := _solvable(chain, order, alike, left, accept)) is not None:
            source, k, value, kind, scale = found
            if not chain.solve(source, k, value, kind, scale):
                return steps
            steps.append([source, k, terms.function(value), *([kind, str(fraction(scale))] if kind else [])])
        for source, k in _held(chain, left, stopped):
            stopped.add(k)
            chain.equations.append(chain.rates[k])
            left.append(chain.reduced(chain.rates[k]))
            steps.append([source, k])
        open_ = [i for i, e in enumerate(left) if i not in derived and _is_open(e)]
        spent += sum(len(e.top) for e in left)
        if not open_ or not any(rate.top for rate in chain.rates) or spent > _MOST_SPENT or enough():
            return steps
        for i in open_:
            derived.add(i)
            chain.derive(i)
            steps.append([i])
    return steps


def _is_open(e: Function) -> bool:
    return bool(e.top) and len(e.top) <= _MOST_TERMS


def _held(chain: Elimination, left: Sequence[Function], known: set[int]) -> list[tuple[int, int]]:
    """Equations that hold a single variable with a rate, and this; one for each."""
    found: dict[int, int] = {}
    for source, equation in enumerate(left) if chain.rates else ():
        alone = equation.used if _is_open(equation) else set()
        if len(alone) == 1 and not alone & known and chain.reduced(chain.rates[min(alone)]).top:
            found.setdefault(min(alone), source)
    return [(source, k) for k, source in found.items()]


def _solvable(
    chain: Elimination,
    order: Sequence[int],
    alike: Sequence[int],
    left: list[Function],
    accept: Callable[[Function], bool],
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
            if solution is not None and accept(solution):
                found = _fewest(chain, factor, alike) if k in alike else (k, solution)
                return source, *found, "", fmpq(1)
            inside = _through(chain.field, factor, k)
            if inside is not None and accept(inside[0]):
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
    return min(found.items(), key=lambda item: sum(item[0] in places for places in used))


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


def in_squares(field: Field, matrix: Sequence[Sequence[Function]], terms: Writing) -> list[list[Any]] | None:
    """A matrix of the checker's functions as a sum of squares, written; None if that is not found."""
    angles = _angles(field)
    found = decompose_matrix(as_quotients(field, matrix, angles), partial(by_sign_or_harmonics, ends=field.ends))
    return None if found is None else terms.squares(found, dict(enumerate(angles, len(field.symbols))))


def _angles(field: Field) -> list[Function]:
    """The arguments of sin and cos that are sums and are not expanded: symbols of their own in the provers' field."""
    sums = [a for (kind, _, _), a in field.atoms.items() if kind in ("sin", "cos") and len(a.top) > 1]
    return [*{(str(a.top), str(a.bottom)): a for a in sums}.values()] if field.whole else []


def as_quotients(
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
