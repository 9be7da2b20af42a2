"""Finding F with ``f = F grad S - rho`` (or A with ``grad S = A f``) for a system given without structure.

The entries of F are sought as constants, or as affine functions of the state. Among the many F that fit, the one with
the least symmetric part is taken: energy exchange is skew, so what is left is dissipation. Terms of f whose monomials
do not occur in grad S (friction laws, diodes) go to the remainder rho. The search runs at the parameter values; the
pattern of zeros and equal-and-opposite pairs is then imposed with the parameters symbolic. Nothing found here is
trusted: the provers check the identities and signs again.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import product

from flint import fmpq

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.coefficients import Coefficients
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.real import fraction
from pbcgen.symbolic.terms import Powers, descending, exponents

#: Systems with more unknown coefficients than this are not searched for state-dependent factors.
_MOST_UNKNOWNS = 700

Entry = tuple[int, int, int]
#: An affine form over the rationals: coefficients by unknown, and CONSTANT.
_Form = dict[Hashable, fmpq]


@dataclass(frozen=True)
class Factor:
    """``targets = matrix * basis - remainder`` as exact functions, the matrix by row and column."""

    matrix: list[dict[int, Quotient]]
    remainder: list[Quotient]


def find_factor(
    field: Field,
    targets: Sequence[Quotient],
    basis: Sequence[Quotient],
    multipliers: Sequence[Quotient],
    remainder_allowed: bool,
) -> tuple[Factor, dict[Entry, Quotient]] | None:
    """Coefficients C with ``targets_i = sum_jk C_ijk multipliers_k basis_j - remainder_i`` at parameter values.

    Returns the factor and the coefficients by (i, j, k), or None if there are none.
    """
    if len(multipliers) == 1:
        unique = _unique_constant(field, targets, basis, multipliers, remainder_allowed)
        if unique is not None:
            return unique
    size = len(targets)
    if size * len(basis) * len(multipliers) > _MOST_UNKNOWNS:
        return None
    equations = _matching_rows(field, targets, basis, multipliers, frozenset(), remainder_allowed)
    if equations is None:
        return None
    rows, remainder = equations
    try:
        solved = reduce_rows(rows)
        entries = _least_symmetric(field, solved, size, len(basis), len(multipliers))
    except Inconsistent:
        return None
    return _assemble(field, entries, size, multipliers, remainder), entries


def _unique_constant(
    field: Field,
    targets: Sequence[Quotient],
    basis: Sequence[Quotient],
    multipliers: Sequence[Quotient],
    remainder_allowed: bool,
) -> tuple[Factor, dict[Entry, Quotient]] | None:
    """The constant factor when the entries of the basis are independent, which leaves one at most: for any size."""
    coefficients = Coefficients(field)
    columns = [coefficients.split_sparsely(entry) for entry in basis]
    wanted = [coefficients.split_sparsely(entry) for entry in targets]
    if any(split is None for split in (*columns, *wanted)):
        return None
    offered = [split for split in columns if split is not None]
    if any(v.constant() is None for split in (*columns, *wanted) for v in (split or {}).values()):
        return None  # a coefficient such as sqrt(2): the search over the field takes it
    present = {powers for split in offered for powers in split}
    equations: dict[Powers, Row] = {powers: {} for powers in sorted(present, key=descending, reverse=True)}
    for j, split in enumerate(offered):
        for monomial, value in split.items():
            equations[monomial][j] = _number(value)
    remainder = []
    for i, found in enumerate(wanted):
        beyond = {}
        for monomial, value in (found or {}).items():
            if monomial in equations:
                equations[monomial]["target", i] = _number(value)
            else:
                beyond[monomial] = value
        if beyond and not remainder_allowed:
            return None
        remainder.append(-_recombine(field, beyond))
    try:
        solved = reduce_rows(equations.values(), {("target", i) for i in range(len(targets))})
    except Inconsistent:
        return None
    if len(solved) < len(offered):
        return None
    entries: dict[Entry, Quotient] = {}
    for unknown, row in solved.items():
        for key, value in row.items():
            if isinstance(key, tuple):
                entries[key[1], int(str(unknown)), 0] = field.const(fraction(value))
    return _assemble(field, entries, len(targets), multipliers, remainder), entries


def refine_symbolically(
    field: Field,
    targets: Sequence[Quotient],
    basis: Sequence[Quotient],
    multipliers: Sequence[Quotient],
    parameters: frozenset[int],
    pattern: dict[Entry, Quotient],
    remainder_allowed: bool,
) -> Factor | None:
    """The factor with symbolic parameters that has the zeros and skew pairs of ``pattern``, or None."""
    nonzero = {entry for entry, value in pattern.items() if not value.is_zero()}
    equations = _matching_rows(field, targets, basis, multipliers, parameters, remainder_allowed, nonzero)
    if equations is None:
        return None
    rows, remainder = equations
    one = field.const(1)
    size = len(targets)
    for i, j, k in sorted(nonzero):
        if i < j and (j, i, k) in nonzero and str(pattern[i, j, k].numerator) == str(-pattern[j, i, k].numerator):
            rows.append({(i, j, k): one, (j, i, k): one})
    try:
        solution = particular_solution(reduce_rows(rows), field.const(0))
    except Inconsistent:
        return None
    entries = {entry: value for entry, value in solution.items() if isinstance(entry, tuple)}
    return _assemble(field, entries, size, multipliers, remainder)


def _matching_rows(
    field: Field,
    targets: Sequence[Quotient],
    basis: Sequence[Quotient],
    multipliers: Sequence[Quotient],
    parameters: frozenset[int],
    remainder_allowed: bool,
    pattern: set[Entry] | None = None,
) -> tuple[list[Row], list[Quotient]] | None:
    """One equation for each target and monomial, and the parts of the targets that no product can match.

    With a ``pattern`` every other unknown is zero.
    """
    coefficients = Coefficients(field, parameters)
    products: dict[tuple[int, int], dict[Powers, Quotient]] = {}
    for j, k in product(range(len(basis)), range(len(multipliers))):
        split = coefficients.split_sparsely(basis[j] * multipliers[k])
        if split is None:
            return None
        products[j, k] = split
    by_monomial: dict[Powers, dict[tuple[int, int], Quotient]] = {}
    for at, terms in products.items():
        for monomial, value in terms.items():
            by_monomial.setdefault(monomial, {})[at] = value
    within: list[set[Powers]] | None = None if pattern is None else [set() for _ in targets]
    for i, j, k in pattern or ():
        if within is not None:
            within[i].update(products[j, k])
    rows: list[Row] = []
    remainder = []
    for i, target in enumerate(targets):
        split = coefficients.split_sparsely(target)
        if split is None:
            return None
        beyond = {m: c for m, c in split.items() if m not in by_monomial}
        if beyond and not remainder_allowed:
            return None
        remainder.append(-_recombine(field, beyond))
        chosen = by_monomial if within is None else {*split, *within[i]} - beyond.keys()
        for monomial in sorted(chosen, key=descending, reverse=True):
            row: Row = {
                (i, j, k): value
                for (j, k), value in by_monomial[monomial].items()
                if pattern is None or (i, j, k) in pattern
            }
            if monomial in split:
                row[CONSTANT] = -split[monomial]
            if row:
                rows.append(row)
    return rows, remainder


def _recombine(field: Field, terms: dict[Powers, Quotient]) -> Quotient:
    total = field.const(0)
    for monomial, coefficient in terms.items():
        power_product = field.context.from_dict({exponents(monomial, field.context.nvars()): fmpq(1)})
        total = total + field.polynomial(power_product) * coefficient
    return total


def _least_symmetric(
    field: Field, solved: dict[Hashable, Row], size: int, width: int, depth: int
) -> dict[Entry, Quotient]:
    """The simplest solution over the rationals.

    In this order: least state-dependent exchange that is not skew, least state dependence, least symmetric part off
    the diagonal, least diagonal, least entries.
    """
    entries: list[Entry] = list(product(range(size), range(width), range(depth)))
    forms: dict[Entry, _Form] = {}
    for entry in entries:
        row = solved.get(entry)
        forms[entry] = {entry: fmpq(1)} if row is None else {k: -_number(v) for k, v in row.items() if k != entry}
    symmetric = {
        (i, j, k): _combine(forms[i, j, k], forms[j, i, k], fmpq(1))
        for i, j, k in entries
        if i < j < size and i < width
    }
    aims: list[list[_Form]] = [
        [form for (_, _, k), form in symmetric.items() if k > 0],
        [form for (_, _, k), form in forms.items() if k > 0],
        [form for (_, _, k), form in symmetric.items() if k == 0],
        [form for (i, j, k), form in forms.items() if k == 0 and i == j],
        list(forms.values()),
    ]
    choice: dict[Hashable, _Form] = {}
    for aim in aims:
        substituted = [_substitute(form, choice) for form in aim]
        settled = _least_squares([form for form in substituted if set(form) - {CONSTANT}])
        choice = {key: _substitute(form, settled) for key, form in choice.items()} | settled
    return {
        entry: field.const(fraction(_substitute(form, choice).get(CONSTANT, fmpq(0)))) for entry, form in forms.items()
    }


def _number(value: Quotient) -> fmpq:
    constant = value.constant()
    if constant is None:
        raise UnsupportedOperation("a coefficient of f or grad S is no rational number")
    return constant


def _combine(a: _Form, b: _Form, weight: fmpq) -> _Form:
    """``a + weight * b``."""
    return {key: a.get(key, fmpq(0)) + weight * b.get(key, fmpq(0)) for key in {*a, *b}}


def _substitute(form: _Form, choice: dict[Hashable, _Form]) -> _Form:
    """The form with settled unknowns replaced."""
    result: _Form = {}
    for key, value in form.items():
        result = _combine(result, choice.get(key, {key: fmpq(1)}), value)
    return {key: value for key, value in result.items() if value != 0}


def _least_squares(forms: Sequence[_Form]) -> dict[Hashable, _Form]:
    """The unknowns as forms in those that the least sum of squares leaves free: the normal equations, exactly."""
    rows: dict[Hashable, Row] = {}
    for form in forms:
        for unknown, weight in form.items():
            if unknown == CONSTANT:
                continue
            row = rows.setdefault(unknown, {})
            for key, value in form.items():
                row[key] = row.get(key, fmpq(0)) + weight * value
    return {
        pivot: {key: -value for key, value in row.items() if key != pivot}
        for pivot, row in reduce_rows(rows.values()).items()
    }


def _assemble(
    field: Field,
    entries: dict[Entry, Quotient],
    size: int,
    multipliers: Sequence[Quotient],
    remainder: list[Quotient],
) -> Factor:
    matrix: list[dict[int, Quotient]] = [{} for _ in range(size)]
    for (i, j, k), value in entries.items():
        if not value.is_zero():
            matrix[i][j] = matrix[i].get(j, field.const(0)) + value * multipliers[k]
    return Factor(matrix, remainder)
