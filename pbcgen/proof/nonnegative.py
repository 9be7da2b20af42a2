"""Exact proofs that a function is nonnegative or positive.

A rational function of symbols and atoms is split into terms with a known sign: squares, exponentials, square roots,
sector terms ``xi tanh(a xi) >= 0``, and products ``(T(a) - T(b)) (a - b) >= 0`` of increasing functions. What remains
is written as a quadratic form in monomials, whose matrix is tested over the rationals. The method is sufficient,
never necessary: failure says nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Protocol

from flint import fmpq, fmpq_mpoly

from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_semidefinite
from pbcgen.proof.known import POSITIVE_KINDS, SECTOR_KINDS, Exponents, Known, without_content
from pbcgen.proof.number_atoms import below
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.real import ZERO

#: How often a polynomial is taken apart, and the sizes beyond which it is not.
_DEPTH = 3
_MOST_TERMS = 300
#: Shares of a positive term without which the rest is to be nonnegative, a small one for small least values.
_STRICT = (fmpq(1, 2), fmpq(1, 10**9))
_MOST_BOUNDED = 6
_MOST_PRODUCTS = 8
#: How many pairs of a negative term and a square are looked at for a quadratic form.
_MOST_TRIALS = 20_000


class Prover(Protocol):
    """Something that proves signs of functions, on a region of its own."""

    def nonnegative(self, function: Quotient) -> bool:
        """Whether ``function >= 0`` is proved."""
        ...

    def positive(self, function: Quotient) -> bool:
        """Whether ``function > 0`` is proved."""
        ...


@dataclass(frozen=True)
class Everywhere:
    """Exact algebra, valid wherever the function is defined; ``positive_symbols`` are taken to be positive."""

    positive_symbols: frozenset[int] = frozenset()

    def nonnegative(self, function: Quotient) -> bool:
        """See :func:`nonnegative`."""
        return nonnegative(function, self.positive_symbols)

    def positive(self, function: Quotient) -> bool:
        """See :func:`positive`."""
        return positive(function, self.positive_symbols)


def exponential_pairs(
    field: Field, polynomial: fmpq_mpoly, positive: frozenset[int]
) -> Iterator[tuple[fmpq_mpoly, fmpq_mpoly]]:
    """``(exp(a) - exp(b)) (a - b) >= 0`` for the products of exponentials that occur in a polynomial, 1 among them."""
    exponentials = [k for k, a in field.atoms.items() if a.kind == "exp" and a.argument.is_polynomial()]
    products = {tuple(int(e) if k in exponentials else 0 for k, e in enumerate(raw)) for raw in polynomial.to_dict()}
    if len(products) > _MOST_PRODUCTS:
        return
    for left, right in combinations(sorted(products), 2):
        common = tuple(map(min, left, right))
        factors = [
            field.context.from_dict({tuple(a - b for a, b in zip(side, common, strict=True)): fmpq(1)})
            for side in (left, right)
        ]
        difference = field.context.constant(0)
        for k in exponentials:
            difference += field.atoms[k].argument.numerator * (left[k] - right[k])
        yield factors[0] - factors[1], without_content(field, difference, positive)


def nonnegative(function: Quotient, positive_symbols: frozenset[int] = frozenset()) -> bool:
    """Whether ``function >= 0`` wherever it is defined is proved, symbols in ``positive_symbols`` being positive."""
    constant = function.constant()
    if constant is not None:
        return bool(constant >= 0)
    field = function.field
    known = Known.of(field, positive_symbols)
    product_form = function.numerator * function.denominator
    if function.is_polynomial() or _certain(field, function.denominator, known):
        product_form = function.numerator
    if _certain(field, product_form, known):
        return True
    smaller = below(field, product_form, known)
    return smaller is not None and _certain(field, smaller, known)


def positive(function: Quotient, positive_symbols: frozenset[int] = frozenset()) -> bool:
    """Whether ``function > 0`` is proved: nonnegative after subtracting a positive number or positive term."""
    constant = function.constant()
    if constant is not None:
        return bool(constant > 0)
    field = function.field
    known = Known.of(field, positive_symbols)
    if function.is_polynomial() or _certainly_positive(field, function.denominator, known):
        return _certainly_positive(field, function.numerator, known)
    return _certainly_positive(field, function.numerator * function.denominator, known)


def _certainly_positive(field: Field, polynomial: fmpq_mpoly, known: Known) -> bool:
    if _strictly(field, polynomial, known):
        return True
    smaller = below(field, polynomial, known)
    return smaller is not None and _strictly(field, smaller, known)


def _strictly(field: Field, polynomial: fmpq_mpoly, known: Known) -> bool:
    """Whether the polynomial is positive everywhere."""
    if _plain(polynomial, known) and any(_strict_term(field, e, known) for e in polynomial.to_dict()):
        return True
    if known.spots.shows_negative(polynomial):
        return False
    for form in trigonometric_forms(field, polynomial):
        for exponents, coefficient in form.to_dict().items():
            if coefficient > 0 and _strict_term(field, exponents, known):
                rests = (form - field.context.from_dict({exponents: coefficient * share}) for share in _STRICT)
                if any(_certain(field, rest, known) for rest in rests):
                    return True
    vertices = _vertices(field, polynomial, known)
    if vertices is not None and all(_strictly(field, vertex, known) for vertex in vertices):
        return True
    return len(polynomial) <= _MOST_TERMS and _strictly_by_factors(field, polynomial, known)


def _strictly_by_factors(field: Field, polynomial: fmpq_mpoly, known: Known) -> bool:
    """As a product of several factors that each have a sign."""
    content, factors = polynomial.factor()
    if len(factors) == 1 and factors[0][1] == 1:
        return False
    negatives = 0 if content > 0 else 1
    for factor, power in factors:
        if not _strictly(field, factor, known):
            if not _strictly(field, -factor, known):
                return False
            negatives += int(power)
    return negatives % 2 == 0


def _strict_term(field: Field, exponents: Exponents, known: Known) -> bool:
    """Whether a product of powers is positive everywhere."""
    return all(
        e == 0 or (k in known.positive and (k < field.symbol_count or field.atoms[k].kind in POSITIVE_KINDS))
        for k, e in enumerate(exponents)
    )


def _plain(polynomial: fmpq_mpoly, known: Known) -> bool:
    """Whether every term is nonnegative by itself."""
    return all(
        coefficient > 0 and all(e % 2 == 0 or k in known.positive for k, e in enumerate(exponents))
        for exponents, coefficient in polynomial.to_dict().items()
    )


def trigonometric_forms(field: Field, polynomial: fmpq_mpoly) -> list[fmpq_mpoly]:
    """The polynomial written with cos^2 = 1 - sin^2 for every choice of angles (the field itself removes sin^2)."""
    sines = {
        (str(a.argument.numerator), str(a.argument.denominator)): k for k, a in field.atoms.items() if a.kind == "sin"
    }
    pairs = []
    for k, atom in field.atoms.items():
        key = (str(atom.argument.numerator), str(atom.argument.denominator))
        if atom.kind == "cos" and polynomial.degrees()[k] > 1:
            pairs.append((k, sines[key]))
    forms = []
    for choice in product((False, True), repeat=min(len(pairs), 5)):
        form = polynomial
        for (cosine, sine), swap in zip(pairs, choice, strict=False):
            if swap:
                form = _swap_squares(field, form, cosine, sine)
        forms.append(form)
    return forms


def _swap_squares(field: Field, polynomial: fmpq_mpoly, cosine: int, sine: int) -> fmpq_mpoly:
    square = field.context.constant(1) - field.context.gens()[sine] ** 2
    total = field.context.constant(0)
    for exponents, coefficient in polynomial.to_dict().items():
        power = int(exponents[cosine])
        rest = tuple(power % 2 if k == cosine else e for k, e in enumerate(exponents))
        total += field.context.from_dict({rest: coefficient}) * square ** (power // 2)
    return total


def _certain(field: Field, polynomial: fmpq_mpoly, known: Known, depth: int = _DEPTH) -> bool:
    """Whether the polynomial in symbols and atoms is proved nonnegative."""
    if _plain(polynomial, known):
        return True
    if known.spots.shows_negative(polynomial):
        return False
    if polynomial.is_zero() or any(
        _nonnegative_form(field, form, known) for form in trigonometric_forms(field, polynomial)
    ):
        return True
    if depth == 0 or len(polynomial) > _MOST_TERMS:
        return False
    return (
        _by_pairs(field, polynomial, known, depth)
        or _by_dominance(field, polynomial, known, depth)
        or _by_vertices(field, polynomial, known, depth)
        or _by_factors(field, polynomial, known, depth)
    )


def _by_pairs(field: Field, polynomial: fmpq_mpoly, known: Known, depth: int) -> bool:
    """Take out a multiple of a product that is nowhere negative, if both the multiplier and the rest are so too."""
    present = {k for k, degree in enumerate(polynomial.degrees()) if degree}
    for left, right in (*known.pairs, *exponential_pairs(field, polynomial, known.positive)):
        divisor = left * right
        if divisor.is_zero() or not {k for k, degree in enumerate(divisor.degrees()) if degree} <= present:
            continue
        quotient, rest = divmod(polynomial, divisor)
        if quotient.is_zero() or not _certain(field, quotient, known, depth - 1):
            continue
        if _certain(field, rest, known, depth - 1):
            return True
    return False


def _by_dominance(field: Field, polynomial: fmpq_mpoly, known: Known, depth: int) -> bool:
    """Terms ``sum T(a_k) C_kl a_l`` with T odd and increasing and C doubly dominant are nonnegative (Willems 1971)."""
    degrees = polynomial.degrees()
    for kind in sorted(SECTOR_KINDS):
        group = [
            k
            for k, a in sorted(field.atoms.items())
            if a.kind == kind and degrees[k] == 1 and a.argument.is_polynomial()
        ]
        if len(group) < 2:
            continue
        split = _linear_part(field, polynomial, group)
        if split is None:
            continue
        linear, rest = split
        arguments = [field.atoms[k].argument.numerator for k in group]
        rows = [_coordinates(linear[k], arguments) for k in group]
        if all(row is not None for row in rows) and _doubly_dominant([row for row in rows if row is not None]):
            return _certain(field, rest, known, depth - 1)
    return False


def _linear_part(
    field: Field, polynomial: fmpq_mpoly, group: Sequence[int]
) -> tuple[dict[int, fmpq_mpoly], fmpq_mpoly] | None:
    """The coefficients of the generators of a group and the rest, or None when two of them are multiplied."""
    terms: dict[int | None, dict[Exponents, fmpq]] = {None: {}, **{k: {} for k in group}}
    for raw, coefficient in polynomial.to_dict().items():
        exponents = tuple(int(e) for e in raw)
        present = [k for k in group if exponents[k]]
        if len(present) > 1:
            return None
        key = present[0] if present else None
        terms[key][tuple(0 if i == key else e for i, e in enumerate(exponents))] = coefficient
    return {k: field.context.from_dict(terms[k]) for k in group}, field.context.from_dict(terms[None])


def _coordinates(polynomial: fmpq_mpoly, basis: Sequence[fmpq_mpoly]) -> list[fmpq] | None:
    """Rational numbers c with ``polynomial = sum c_k basis_k``, or None."""
    rows: dict[Exponents, Row] = {}
    for k, element in enumerate(basis):
        for exponents, coefficient in element.to_dict().items():
            rows.setdefault(tuple(int(e) for e in exponents), {})[k] = coefficient
    for exponents, coefficient in polynomial.to_dict().items():
        rows.setdefault(tuple(int(e) for e in exponents), {})[CONSTANT] = -coefficient
    try:
        solution = particular_solution(reduce_rows(rows.values()), fmpq(0))
    except Inconsistent:
        return None
    return [solution.get(k, fmpq(0)) for k in range(len(basis))]


def _doubly_dominant(matrix: Sequence[Sequence[fmpq]]) -> bool:
    """Whether each diagonal entry is at least the sum of the magnitudes beside it, in its row and in its column."""
    size = range(len(matrix))
    by_rows = all(matrix[k][k] >= sum((abs(matrix[k][j]) for j in size if j != k), fmpq(0)) for k in size)
    return by_rows and all(matrix[k][k] >= sum((abs(matrix[j][k]) for j in size if j != k), fmpq(0)) for k in size)


def _by_vertices(field: Field, polynomial: fmpq_mpoly, known: Known, depth: int) -> bool:
    """Products of sin, cos, tanh and erf as independent numbers in [-1, 1], or [0, 1] for squares and exp(-a^2)."""
    vertices = _vertices(field, polynomial, known)
    return vertices is not None and all(_certain(field, vertex, known, depth - 1) for vertex in vertices)


def _vertices(field: Field, polynomial: fmpq_mpoly, known: Known) -> list[fmpq_mpoly] | None:
    """The polynomial with each product of bounded atoms at the ends of its range, in every combination.

    It is affine in these products, so its least value over all of them is at one of these. None if there are no
    bounded atoms or too many products.
    """
    parts: dict[Exponents, dict[Exponents, fmpq]] = {}
    bounded, unit = known.bounded, largest_exponential(field, polynomial, known)
    if unit is not None:
        bounded |= known.exponentials
    for raw, coefficient in polynomial.to_dict().items():
        exponents = tuple(int(e) - (0 if unit is None else unit[k]) for k, e in enumerate(raw))
        inside = tuple(e if k in bounded else 0 for k, e in enumerate(exponents))
        outside = tuple(0 if k in bounded else e for k, e in enumerate(exponents))
        parts.setdefault(inside, {})[outside] = coefficient
    products = [inside for inside in sorted(parts) if any(inside)]
    if not products or len(products) > _MOST_BOUNDED:
        return None
    free = field.context.from_dict(next((terms for inside, terms in parts.items() if not any(inside)), {}))
    ends = [(0 if all(inside[k] % 2 == 0 for k in known.bounded) else -1, 1) for inside in products]
    slopes = [field.context.from_dict(parts[inside]) for inside in products]
    return [sum((slope * end for slope, end in zip(slopes, choice, strict=True)), free) for choice in product(*ends)]


def largest_exponential(field: Field, polynomial: fmpq_mpoly, known: Known) -> Exponents | None:
    """The product of exponentials in a term that no other such product exceeds: divided by it, they are in (0, 1]."""
    terms = polynomial.to_dict()
    parts = {tuple(int(e) if k in known.exponentials else 0 for k, e in enumerate(raw)) for raw in terms}
    if not 2 <= len(parts) <= _MOST_PRODUCTS:
        return None
    for unit in sorted(parts):
        fall = (exponent_of(field, unit, known) - exponent_of(field, part, known) for part in parts if part != unit)
        if all(_nonnegative_form(field, difference, known) for difference in fall):
            return unit
    return None


def exponent_of(field: Field, powers: Exponents, known: Known) -> fmpq_mpoly:
    """a, for a product of exponentials that is exp(a)."""
    total = field.context.constant(0)
    for k in known.exponentials:
        total += field.atoms[k].argument.numerator * powers[k]
    return total


def _by_factors(field: Field, polynomial: fmpq_mpoly, known: Known, depth: int) -> bool:
    """Without its square factors; or as a product of factors that each have a known sign."""
    content, factors = polynomial.factor()
    odd = [factor for factor, power in factors if power % 2]
    if len(odd) == len(factors) == 1:
        return False
    remaining = field.context.constant(1 if content > 0 else -1)
    for factor in odd:
        remaining *= factor
    if remaining != polynomial and _certain(field, remaining, known, depth - 1):
        return True
    negatives = 0 if content > 0 else 1
    for factor in odd:
        if _certain(field, factor, known, depth - 1):
            continue
        if not _certain(field, -factor, known, depth - 1):
            return False
        negatives += 1
    return negatives % 2 == 0


def _nonnegative_form(field: Field, polynomial: fmpq_mpoly, known: Known) -> bool:
    """Terms of known sign first; then, for each power of the positive generators, a quadratic form in monomials.

    A negative term joins the form of its own powers, or one where it stands between two squares: c^2 - c e + e^2 needs
    no sign of c and e.
    """
    groups: dict[Exponents, dict[Exponents, fmpq]] = {}
    negative: list[tuple[Exponents, fmpq]] = []
    for raw, coefficient in polynomial.to_dict().items():
        exponents = without_sector_pairs(tuple(int(e) for e in raw), known)
        outside = tuple(e % 2 if k in known.positive else 0 for k, e in enumerate(exponents))
        inside = tuple(e - o for e, o in zip(exponents, outside, strict=True))
        if coefficient > 0 and all(e % 2 == 0 for e in inside) and exponents != tuple(raw):
            continue
        if exponents != tuple(int(e) for e in raw):
            return False
        if coefficient < 0 and any(outside):
            negative.append((exponents, coefficient))
            continue
        group = groups.setdefault(outside, {})
        group[inside] = group.get(inside, fmpq(0)) + coefficient
    halves = {g: _halves(terms) for g, terms in groups.items()}
    few = len(negative) * sum(map(len, halves.values())) <= _MOST_TRIALS
    for exponents, coefficient in negative:
        own = tuple(e % 2 if k in known.positive else 0 for k, e in enumerate(exponents))
        outside = own
        if few:
            places = (own, *groups) if own in groups else tuple(groups)
            outside = next((g for g in places if _fits(_less(exponents, g), groups[g], halves.get(g, set()))), own)
        group, inside = groups.setdefault(outside, {}), _less(exponents, outside)
        group[inside] = group.get(inside, fmpq(0)) + coefficient
    return all(_sum_of_squares(terms) for terms in groups.values())


def _less(exponents: Exponents, outside: Exponents) -> Exponents:
    return tuple(e - o for e, o in zip(exponents, outside, strict=True))


def _halves(terms: Mapping[Exponents, fmpq]) -> set[Exponents]:
    """The monomials whose squares are among the terms, with a positive coefficient."""
    return {tuple(e // 2 for e in term) for term, c in terms.items() if c > 0 and all(e % 2 == 0 for e in term)}


def _fits(exponents: Exponents, terms: Mapping[Exponents, fmpq], halves: set[Exponents]) -> bool:
    """Whether a monomial is one of the terms, or a product of two of the halves."""
    if min(exponents) < 0:
        return False
    return exponents in terms or any(_less(exponents, half) in halves for half in halves)


def without_sector_pairs(exponents: Exponents, known: Known) -> Exponents:
    """The exponents after taking out factors ``T(xi) xi`` with an odd function T, which are nonnegative."""
    result = exponents
    for k, argument in known.sector.items():
        if result[k] % 2 == 1 and all(r >= a for r, a in zip(result, argument, strict=True)):
            odd = [r % 2 for r in result]
            pair = [a % 2 for a in argument]
            if all(o >= p for o, p in zip(odd, pair, strict=True)):
                result = tuple(
                    r - a - (1 if i == k else 0) for i, (r, a) in enumerate(zip(result, argument, strict=True))
                )
    return result


def _sum_of_squares(terms: dict[Exponents, fmpq]) -> bool:
    """Whether the polynomial is ``z^T G z`` with G >= 0 and z the monomials whose squares occur."""
    terms = {e: c for e, c in terms.items() if c != 0}
    halves = sorted(tuple(x // 2 for x in e) for e, c in terms.items() if c > 0 and all(x % 2 == 0 for x in e))
    size = len(halves)
    gram = [[ZERO] * size for _ in range(size)]
    position = {half: i for i, half in enumerate(halves)}
    for exponents, coefficient in terms.items():
        place = gram_place(exponents, halves, position)
        if place is None:
            return False
        i, j = place
        if i == j:
            gram[i][i] = gram[i][i] + coefficient
        else:
            gram[i][j] = gram[i][j] + coefficient / 2
            gram[j][i] = gram[i][j]
    return positive_semidefinite(gram).status is Status.PROVED


def gram_place(
    exponents: Exponents, halves: Sequence[Exponents], position: dict[Exponents, int]
) -> tuple[int, int] | None:
    """The entry of the Gram matrix for a monomial: the diagonal for a positive square, else the first fitting pair."""
    if all(x % 2 == 0 for x in exponents) and tuple(x // 2 for x in exponents) in position:
        i = position[tuple(x // 2 for x in exponents)]
        return i, i
    for i, half in enumerate(halves):
        other = tuple(e - h for e, h in zip(exponents, half, strict=True))
        if other in position:
            return i, position[other]
    return None
