"""Exact proofs that a function is nonnegative or that a symmetric matrix of functions is positive semidefinite.

A rational function of symbols and atoms is split into terms with a known sign: squares, exponentials, square roots,
and sector terms ``xi tanh(a xi) >= 0``. What remains is written as a quadratic form in monomials, whose matrix is
tested over the rationals. The method is sufficient, never necessary: failure says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from flint import fmpq, fmpq_mpoly

from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_definite, positive_semidefinite
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import ZERO, rational

_POSITIVE_KINDS = frozenset({"exp"})
_NONNEGATIVE_KINDS = frozenset({"sqrt"})
#: Odd increasing functions: T(xi) has the sign of xi.
_SECTOR_KINDS = frozenset({"tanh", "atan", "asinh", "erf", "asin", "atanh"})

Exponents = tuple[int, ...]


@dataclass(frozen=True)
class _Known:
    """What is known of the sign of the generators of a field."""

    positive: frozenset[int]
    sector: dict[int, Exponents]

    @staticmethod
    def of(field: Field, positive_symbols: frozenset[int]) -> _Known:
        positive = set(positive_symbols)
        sector: dict[int, Exponents] = {}
        for k, atom in field.atoms.items():
            if atom.kind in _POSITIVE_KINDS | _NONNEGATIVE_KINDS:
                positive.add(k)
            terms = atom.argument.numerator.to_dict()
            if atom.kind in _SECTOR_KINDS and len(terms) == 1 and atom.argument.is_polynomial():
                ((exponents, coefficient),) = terms.items()
                if coefficient > 0:
                    sector[k] = tuple(int(e) for e in exponents)
        return _Known(frozenset(positive), sector)


def nonnegative(function: Quotient, positive_symbols: frozenset[int] = frozenset()) -> bool:
    """Whether ``function >= 0`` wherever it is defined is proved, symbols in ``positive_symbols`` being positive."""
    field = function.field
    known = _Known.of(field, positive_symbols)
    product_form = function.numerator * function.denominator
    if function.is_polynomial() or _nonnegative_polynomial(field, function.denominator, known):
        product_form = function.numerator
    return _nonnegative_polynomial(field, product_form, known)


def positive(function: Quotient, positive_symbols: frozenset[int] = frozenset()) -> bool:
    """Whether ``function > 0`` is proved: nonnegative after subtracting a positive number or positive term."""
    constant = function.constant()
    if constant is not None:
        return bool(constant > 0)
    field = function.field
    known = _Known.of(field, positive_symbols)
    if not (function.is_polynomial() or positive(field.polynomial(function.denominator), positive_symbols)):
        return False
    for form in _trigonometric_forms(field, function.numerator):
        for exponents, coefficient in form.to_dict().items():
            strict = all(e == 0 or (k in known.positive and _strict(field, k)) for k, e in enumerate(exponents))
            if coefficient > 0 and strict:
                rest = form - field.context.from_dict({exponents: coefficient / 2})
                if _nonnegative_form(field, rest, known):
                    return True
    return False


def _strict(field: Field, k: int) -> bool:
    return k < field.symbol_count or field.atoms[k].kind in _POSITIVE_KINDS


def _trigonometric_forms(field: Field, polynomial: fmpq_mpoly) -> list[fmpq_mpoly]:
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


def _nonnegative_polynomial(field: Field, polynomial: fmpq_mpoly, known: _Known) -> bool:
    return any(_nonnegative_form(field, form, known) for form in _trigonometric_forms(field, polynomial))


def _nonnegative_form(field: Field, polynomial: fmpq_mpoly, known: _Known) -> bool:
    """Terms of known sign first; then, for each power of the positive generators, a quadratic form in monomials."""
    groups: dict[Exponents, dict[Exponents, fmpq]] = {}
    for raw, coefficient in polynomial.to_dict().items():
        exponents = _without_sector_pairs(tuple(int(e) for e in raw), known)
        outside = tuple(e % 2 if k in known.positive else 0 for k, e in enumerate(exponents))
        inside = tuple(e - o for e, o in zip(exponents, outside, strict=True))
        if coefficient > 0 and all(e % 2 == 0 for e in inside) and exponents != tuple(raw):
            continue
        if exponents != tuple(int(e) for e in raw):
            return False
        group = groups.setdefault(outside, {})
        group[inside] = group.get(inside, fmpq(0)) + coefficient
    return all(_sum_of_squares(terms) for terms in groups.values())


def _without_sector_pairs(exponents: Exponents, known: _Known) -> Exponents:
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
        place = _gram_place(exponents, halves, position)
        if place is None:
            return False
        i, j = place
        if i == j:
            gram[i][i] = gram[i][i] + coefficient
        else:
            gram[i][j] = gram[i][j] + coefficient / 2
            gram[j][i] = gram[i][j]
    return positive_semidefinite(gram).status is Status.PROVED


def _gram_place(
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


def semidefinite(matrix: Sequence[Sequence[Quotient]], positive_symbols: frozenset[int] = frozenset()) -> bool:
    """Whether the symmetric matrix of functions is proved positive semidefinite wherever it is defined.

    Elimination with pivots that are proved positive. A diagonal entry that is the zero function needs a zero row.
    """
    order = list(range(len(matrix)))
    work = [list(row) for row in matrix]
    while order:
        zero = [k for k in order if work[k][k].is_zero()]
        if any(not work[k][j].is_zero() for k in zero for j in order):
            return False
        order = [k for k in order if k not in zero]
        if not order:
            return True
        isolated = [k for k in order if all(work[k][j].is_zero() for j in order if j != k)]
        if isolated:
            if not all(nonnegative(work[k][k], positive_symbols) for k in isolated):
                return False
            order = [k for k in order if k not in isolated]
            continue
        pivots = sorted(order, key=lambda k: (work[k][k].constant() is None, len(work[k][k].numerator)))
        pivot = next((k for k in pivots if positive(work[k][k], positive_symbols)), None)
        if pivot is None:
            return False
        order.remove(pivot)
        for i in order:
            factor = work[i][pivot] / work[pivot][pivot]
            for j in order:
                work[i][j] = work[i][j] - factor * work[pivot][j]
    return True


def definite(matrix: Sequence[Sequence[Quotient]], positive_symbols: frozenset[int] = frozenset()) -> bool:
    """Whether the symmetric matrix of functions is proved positive definite wherever it is defined."""
    constants = [[entry.constant() for entry in row] for row in matrix]
    if all(entry is not None for row in constants for entry in row):
        return positive_definite([[rational(0) + entry for entry in row] for row in constants]).status is Status.PROVED
    work = [list(row) for row in matrix]
    order = list(range(len(matrix)))
    while order:
        pivots = sorted(order, key=lambda k: (work[k][k].constant() is None, len(work[k][k].numerator)))
        pivot = next((k for k in pivots if positive(work[k][k], positive_symbols)), None)
        if pivot is None:
            return False
        order.remove(pivot)
        for i in order:
            factor = work[i][pivot] / work[pivot][pivot]
            for j in order:
                work[i][j] = work[i][j] - factor * work[pivot][j]
    return True
