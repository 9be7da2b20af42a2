"""Nonnegative functions and semidefinite matrices of functions written out as sums of squares, for certificates.

``M = sum weight * factors * v v^T`` with positive weights, factors that are nonnegative by their kind, and vectors v of
rational functions. Who reads it multiplies out and compares; nothing has to be found again. The writing follows the
proofs in :mod:`pbcgen.proof.nonnegative`, and may fail where they succeed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from flint import fmpq, fmpq_mpoly

from pbcgen.proof.known import Exponents, Known
from pbcgen.proof.nonnegative import (
    exponent_of,
    gram_place,
    largest_exponential,
    trigonometric_forms,
    without_sector_pairs,
)
from pbcgen.proof.sos import Interval, SumOfSquares
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import rational

#: Functions that increase where they are defined, and the values at zero of those that are defined there.
AT_ZERO = {"tanh": 0, "atan": 0, "asinh": 0, "erf": 0, "asin": 0, "atanh": 0, "exp": 1}
INCREASING = frozenset(AT_ZERO) | {"log", "sqrt"}

_MOST_TERMS = 300


@dataclass(frozen=True)
class Factor:
    """A nonnegative function.

    ``(T(a) - T(b)) (a - b)`` with T increasing, or ``|a| + a`` for the modulus and b = 0. For b = None: T(a) itself,
    ``1 - T(a)^2`` for a bounded T, how far the symbol a is ``above`` or ``below`` its bound, a itself that is
    ``positive`` by the signs of its terms, or (kind ``box``) what the tree of boxes shows of a, which may be the place
    of a term that is written already.
    """

    kind: str
    a: Quotient | int
    b: Quotient | None
    tree: tuple[str, list[int], dict[str, str]] | None = None

    def written(self, place: Callable[[Quotient], int]) -> list[Any]:
        """The factor as it stands in a certificate; ``place`` writes a function down."""
        a = self.a if isinstance(self.a, int) else place(self.a)
        b = None if self.b is None or self.b.is_zero() else place(self.b)
        return [self.kind, a, b if self.tree is None else list(self.tree), self.b is None]


#: Shows that a polynomial is nonnegative where the algebra here does not.
Leaf = Callable[[Field, fmpq_mpoly], "list[Square] | None"]


@dataclass(frozen=True)
class Square:
    """``weight * factors * v v^T``."""

    weight: fmpq
    factors: tuple[Factor, ...]
    vector: tuple[Quotient, ...]

    def times(self, scale: Sequence[Quotient]) -> Square:
        """The square with the scalar v replaced by ``v * scale``."""
        return Square(self.weight, self.factors, tuple(self.vector[0] * s for s in scale))


def decompose(function: Quotient, leaf: Leaf | None = None) -> list[Square] | None:
    """The function as a sum of squares (vectors of length one), or None if none was found."""
    field = function.field
    if (constant := function.constant()) is not None and constant > 0:
        return [Square(constant, (), (field.const(1),))]
    known = Known.of(field, frozenset())
    if function.is_polynomial():
        return _polynomial(field, function.numerator, known, leaf=leaf)
    inverse = field.const(1) / field.polynomial(function.denominator)
    above, below = (_polynomial(field, p, known, leaf=leaf) for p in (function.numerator, function.denominator))
    if above is not None and below is not None:
        return [square.times([inverse]) for square in _product(above, below)]
    product = _polynomial(field, function.numerator * function.denominator, known, leaf=leaf)
    return None if product is None else [square.times([inverse]) for square in product]


def decompose_matrix(matrix: Sequence[Sequence[Quotient]], leaf: Leaf | None = None) -> list[Square] | None:
    """A symmetric matrix of functions as a sum of squares, by elimination; None if none was found."""
    work = {i: {j: v for j, v in enumerate(row) if not v.is_zero()} for i, row in enumerate(matrix)}
    found: list[Square] = []
    while work := {i: row for i, row in work.items() if row}:
        if any(i not in row for i, row in work.items()):
            return None
        order = sorted(work, key=lambda i: (len(work[i]), len(work[i][i].numerator), i))
        i, squares = next(((i, s) for i in order if (s := decompose(work[i][i], leaf)) is not None), (-1, []))
        if i < 0:
            return None
        row = work.pop(i)
        column = {j: v / row[i] for j, v in row.items()}
        zero = row[i].field.const(0)
        found += [square.times([column.get(j, zero) for j in range(len(matrix))]) for square in squares]
        for j in row.keys() - {i}:
            below = work[j]
            del below[i]
            for k in row.keys() - {i}:
                value = below.get(k, zero) - column[j] * row[k]
                below.pop(k, None)
                below |= {} if value.is_zero() else {k: value}
    return found


def _polynomial(
    field: Field, polynomial: fmpq_mpoly, known: Known, depth: int = 3, leaf: Leaf | None = None
) -> list[Square] | None:
    """Terms and quadratic forms, products of increasing functions, factors with a sign each, or what the leaf shows."""
    if polynomial.is_zero():
        return []
    for form in trigonometric_forms(field, polynomial):
        squares = _form(field, form, known)
        if squares is not None:
            return squares
    if depth == 0 or len(polynomial) > _MOST_TERMS:
        return None
    found = _by_pairs(field, polynomial, known, depth)
    found = found if found is not None else _by_factors(field, polynomial, known, depth, leaf)
    found = found if found is not None else _by_ends(field, polynomial, known, depth)
    found = found if found is not None else _by_square_of_bounded(field, polynomial, known, depth)
    found = found if found is not None else _by_falling_exponential(field, polynomial, known, depth)
    return found if found is not None or leaf is None else leaf(field, polynomial)


def _by_pairs(field: Field, polynomial: fmpq_mpoly, known: Known, depth: int) -> list[Square] | None:
    """Take out a multiple of ``(T(a) - T(b)) (a - b)`` where multiplier and rest are sums of squares too."""
    for factor, divisor in _increasing(field):
        quotient, rest = divmod(polynomial, divisor)
        if quotient.is_zero():
            continue
        multiplier = _polynomial(field, quotient, known, depth - 1)
        remaining = None if multiplier is None else _polynomial(field, rest, known, depth - 1)
        if multiplier is not None and remaining is not None:
            return [Square(s.weight, (*s.factors, factor), s.vector) for s in multiplier] + remaining
    return None


def _increasing(field: Field) -> Iterator[tuple[Factor, fmpq_mpoly]]:
    """``(T(a) - T(b)) (a - b)`` for the atoms T(a), T(b) of the field, b = 0 for odd functions and exp; ``|a| + a``."""
    atoms = [(k, a) for k, a in sorted(field.atoms.items()) if a.kind in INCREASING and a.argument.is_polynomial()]
    generators = field.context.gens()
    for k in sorted(field.moduli):
        for argument in (field.atoms[k].argument, -field.atoms[k].argument):
            yield Factor("fabs", argument, field.const(0)), generators[k] + argument.numerator
    for k, atom in atoms:
        if atom.kind in AT_ZERO:
            difference = generators[k] - AT_ZERO[atom.kind]
            yield Factor(atom.kind, atom.argument, field.const(0)), difference * atom.argument.numerator
    for (k, a), (j, b) in combinations(atoms[:12], 2):
        if a.kind == b.kind:
            apart = a.argument.numerator - b.argument.numerator
            yield Factor(a.kind, a.argument, b.argument), (generators[k] - generators[j]) * apart


def _by_factors(
    field: Field, polynomial: fmpq_mpoly, known: Known, depth: int, leaf: Leaf | None
) -> list[Square] | None:
    """Without its square factors; or as a product of factors that each have a known sign."""
    content, factors = polynomial.factor()
    odd = [factor for factor, power in factors if power % 2]
    if len(odd) == len(factors) == 1:
        return None
    root = field.context.constant(1)
    for factor, power in factors:
        root *= factor ** (power // 2)
    square = Square(abs(content), (), (field.polynomial(root),))
    total = [square]
    sign = 1 if content > 0 else -1
    for factor in odd:
        upward = _polynomial(field, factor, known, depth - 1, leaf)
        squares = upward if upward is not None else _polynomial(field, -factor, known, depth - 1, leaf)
        if squares is None:
            break
        sign = sign if upward is not None else -sign
        total = _product(total, squares)
    else:
        return total if sign > 0 else None
    remaining = field.context.constant(1 if content > 0 else -1)
    for factor in odd:
        remaining *= factor
    squares = None if remaining == polynomial else _polynomial(field, remaining, known, depth - 1, leaf)
    return None if squares is None else _product([square], squares)


def _by_ends(field: Field, polynomial: fmpq_mpoly, known: Known, depth: int) -> list[Square] | None:
    """Linear in T with values in [-1, 1], from both ends of the interval.

    ``2 p(T) = (1 + T) p(1) + (1 - T) p(-1)``, and ``2 (1 +- T) = (1 +- T)^2 + (1 - T^2)``.
    """
    k = next((k for k in sorted(known.bounded) if polynomial.degrees()[k] == 1), None)
    if k is None:
        return None
    generators, one = field.context.gens(), field.const(1)
    result: list[Square] = []
    for end in (1, -1):
        at_end = polynomial.compose(*generators[:k], field.context.constant(end), *generators[k + 1 :])
        squares = _polynomial(field, at_end, known, depth - 1)
        if squares is None:
            return None
        toward = Square(fmpq(1, 4), (), (one + field.polynomial(generators[k] * end),))
        spread = Square(fmpq(1, 4), (Factor(field.atoms[k].kind, field.atoms[k].argument, None),), (one,))
        result += _product([toward, spread], squares)
    return result


def _by_square_of_bounded(field: Field, polynomial: fmpq_mpoly, known: Known, depth: int) -> list[Square] | None:
    """``p + q T^2 = (1 - T^2) p + T^2 (p + q)`` with T in [-1, 1]."""
    for k in sorted(known.bounded):
        split: dict[int, dict[Exponents, fmpq]] = {}
        for raw, coefficient in polynomial.to_dict().items():
            exponents = tuple(int(e) for e in raw)
            split.setdefault(exponents[k], {})[(*exponents[:k], 0, *exponents[k + 1 :])] = coefficient
        if not {2} <= {*split} <= {0, 2}:
            continue
        p, q = (field.context.from_dict(split.get(power, {})) for power in (0, 2))
        below, above = (_polynomial(field, value, known, depth - 1) for value in (p, p + q))
        if below is None or above is None:
            continue
        one, T = field.const(1), field.polynomial(field.context.gens()[k])
        spread = Square(fmpq(1), (Factor(field.atoms[k].kind, field.atoms[k].argument, None),), (one,))
        return _product([spread], below) + _product([Square(fmpq(1), (), (T,))], above)
    return None


def _by_falling_exponential(field: Field, polynomial: fmpq_mpoly, known: Known, depth: int) -> list[Square] | None:
    """``E (p + q e^a)`` with products of exponentials E and e^a, a <= 0.

    ``p + q e^a = (1 - e^a) p + e^a (p + q)``, and ``1 - e^a = (1 - e^a) (-a) (-a) / a^2`` where a is not zero, which
    is almost everywhere.
    """
    parts: dict[Exponents, dict[Exponents, fmpq]] = {}
    for raw, coefficient in polynomial.to_dict().items():
        exponents = tuple(int(e) for e in raw)
        powers = tuple(e if k in known.exponentials else 0 for k, e in enumerate(exponents))
        rest = tuple(e - p for e, p in zip(exponents, powers, strict=True))
        parts.setdefault(powers, {})[rest] = coefficient
    unit = largest_exponential(field, polynomial, known)
    if unit is None or len(parts) != 2:
        return None
    (other,) = parts.keys() - {unit}
    a = exponent_of(field, other, known) - exponent_of(field, unit, known)
    p = field.context.from_dict(parts[unit])
    both = p + field.context.from_dict(parts[other])
    found = [_polynomial(field, value, known, depth - 1) for value in (p, both, -a)]
    if found[0] is None or found[1] is None or found[2] is None:
        return None
    argument = field.polynomial(a)
    scale = Factor("exp", field.polynomial(exponent_of(field, unit, known)), None)
    gap, fall = Factor("exp", argument, field.const(0)), Factor("exp", argument, None)
    inverse = field.const(1) / argument
    above = [Square(s.weight, (*s.factors, gap), (s.vector[0] * inverse,)) for s in found[2]]
    return [
        Square(s.weight, (*s.factors, scale, *more), s.vector)
        for more, squares in (((), _product(above, found[0])), ((fall,), found[1]))
        for s in squares
    ]


def _product(left: Sequence[Square], right: Sequence[Square]) -> list[Square]:
    """The product of two sums of scalar squares."""
    return [
        Square(a.weight * b.weight, a.factors + b.factors, (a.vector[0] * b.vector[0],)) for a in left for b in right
    ]


def _form(field: Field, polynomial: fmpq_mpoly, known: Known) -> list[Square] | None:
    """Terms of known sign one by one; then a quadratic form for each power of the positive generators."""
    groups: dict[Exponents, dict[Exponents, fmpq]] = {}
    found: list[Square] = []
    for raw, coefficient in polynomial.to_dict().items():
        exponents = tuple(int(e) for e in raw)
        rest = without_sector_pairs(exponents, known)
        outside = tuple(e % 2 if k in known.positive else 0 for k, e in enumerate(rest))
        inside = tuple(e - o for e, o in zip(rest, outside, strict=True))
        if rest == exponents:
            group = groups.setdefault(outside, {})
            group[inside] = group.get(inside, fmpq(0)) + coefficient
        elif coefficient > 0 and all(e % 2 == 0 for e in inside):
            root = _monomial(field, tuple(e // 2 for e in inside))
            sector = Square(coefficient, _positive(field, outside), (root,))
            found.append(_with_sectors(field, sector, exponents, rest))
        else:
            return None
    for outside, terms in groups.items():
        squares = _gram(field, terms)
        if squares is None or any(e and k < field.symbol_count for k, e in enumerate(outside)):
            return None
        found += [Square(weight, _positive(field, outside), (v,)) for weight, v in squares]
    return found


def _with_sectors(field: Field, square: Square, exponents: Exponents, rest: Exponents) -> Square:
    """The square times the factors ``T(a) xi`` that were taken out of a monomial; a is a positive multiple of xi."""
    for k, atom in field.atoms.items():
        if exponents[k] > rest[k] and atom.kind in AT_ZERO and atom.kind not in ("exp", "sqrt"):
            ((whole, coefficient),) = atom.argument.numerator.to_dict().items()
            positive = tuple(
                int(e) if i in field.atoms and field.atoms[i].kind in ("exp", "sqrt") else 0
                for i, e in enumerate(whole)
            )
            factors = (
                Factor(atom.kind, atom.argument, field.const(0)),
                *_positive(field, tuple(e % 2 for e in positive)),
            )
            half = _monomial(field, tuple((e + 1) // 2 for e in positive))
            square = Square(square.weight / coefficient, square.factors + factors, (square.vector[0] / half,))
    return square


def _monomial(field: Field, exponents: Exponents) -> Quotient:
    return field.polynomial(field.context.from_dict({exponents: fmpq(1)}))


def _positive(field: Field, outside: Exponents) -> tuple[Factor, ...]:
    atoms = [field.atoms[k] for k, e in enumerate(outside) if e and k in field.atoms]
    return tuple(Factor(atom.kind, atom.argument, None) for atom in atoms)


def _gram(field: Field, terms: dict[Exponents, fmpq]) -> list[tuple[fmpq, Quotient]] | None:
    """The polynomial as ``sum weight * (polynomial)^2`` through LDL^T of its Gram matrix."""
    terms = {e: c for e, c in terms.items() if c != 0}
    halves = sorted(tuple(x // 2 for x in e) for e, c in terms.items() if c > 0 and all(x % 2 == 0 for x in e))
    position = {half: i for i, half in enumerate(halves)}
    size = len(halves)
    gram = [[fmpq(0)] * size for _ in range(size)]
    for exponents, coefficient in terms.items():
        place = gram_place(exponents, halves, position)
        if place is None:
            return None
        for i, j in (place, place[::-1]):
            gram[i][j] += coefficient / 2
    order = list(range(size))
    found: list[tuple[fmpq, Quotient]] = []
    while order:
        pivot = max(order, key=lambda k: gram[k][k])
        weight = gram[pivot][pivot]
        if weight <= 0:
            return found if all(gram[i][j] == 0 for i in order for j in order) else None
        ratios = {i: gram[i][pivot] / weight for i in order if gram[i][pivot] != 0}
        polynomial = field.context.from_dict({halves[i]: ratio for i, ratio in ratios.items()})
        found.append((weight, field.polynomial(polynomial)))
        order.remove(pivot)
        for i in order:
            for j in order:
                gram[i][j] -= ratios.get(i, fmpq(0)) * gram[pivot][j]
    return found


def of_programme(field: Field, found: SumOfSquares, bounds: Mapping[int, Interval]) -> list[Square] | None:
    """A sum that semidefinite programming found, with vectors of length one; None if a multiplier has no factor."""
    known = _multipliers(field, bounds)
    result: list[Square] = []
    for block, gram in zip(found.blocks, found.grams, strict=True):
        factors = known.get(str(block.multiplier))
        if factors is None:
            return None
        for weight, row in _eliminated(gram):
            total = block.basis[0] * 0
            for entry, z in zip(row, block.basis, strict=True):
                total += z * entry
            result.append(Square(weight, factors, (field.polynomial(total),)))
    return result


def _multipliers(field: Field, bounds: Mapping[int, Interval]) -> dict[str, tuple[Factor, ...]]:
    """Polynomials without negative values by their text, as products of factors."""
    generators, one = field.context.gens(), field.context.constant(1)
    result: dict[str, tuple[Factor, ...]] = {str(one): ()}
    for k, atom in field.atoms.items():
        if atom.kind in ("exp", "sqrt"):
            result[str(generators[k])] = (Factor(atom.kind, atom.argument, None),)
        if atom.kind in ("tanh", "erf"):
            result[str(one - generators[k] ** 2)] = (Factor(atom.kind, atom.argument, None),)
    result |= {str(divisor): (factor,) for factor, divisor in _increasing(field)}
    for k, (lo, hi) in bounds.items():
        above = None if lo is None else generators[k] - rational(lo)
        below = None if hi is None else rational(hi) - generators[k]
        sides = (Factor("above", k, None), Factor("below", k, None))
        result |= {str(p): (f,) for p, f in zip((above, below), sides, strict=True) if p is not None}
        if above is not None and below is not None:
            result[str(above * below)] = sides
    return result


def _eliminated(gram: Sequence[Sequence[fmpq]]) -> Iterator[tuple[fmpq, list[fmpq]]]:
    """``G = sum d v v^T`` for a positive semidefinite G."""
    work = [list(row) for row in gram]
    for k in range(len(work)):
        if work[k][k] != 0:
            pivot, v = work[k][k], [row[k] / work[k][k] for row in work]
            yield pivot, v
            work = [[e - pivot * v[i] * v[j] for j, e in enumerate(row)] for i, row in enumerate(work)]
