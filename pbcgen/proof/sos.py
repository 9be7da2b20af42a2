"""Nonnegative functions as sums of squares: semidefinite programming proposes, exact rational arithmetic decides.

``p = sum_k g_k z_k^T G_k z_k`` with G_k >= 0 and g_k known to be nonnegative: 1, exponentials and square roots,
``T(xi) xi`` for increasing T, ``1 - T^2`` for bounded T, and bounds of a box (Putinar). The floating-point solution is
rounded to rationals, moved onto the equations exactly, and its matrices are tested over Q. Where they are singular the
common kernel is recognised first and taken out of the basis. Nothing that the solver says is trusted.

The solver is Clarabel, of the optional extra ``sos``; without it nothing is tried.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from itertools import combinations, product
from math import ceil
from typing import Any, TypeAlias

import numpy as np
from flint import fmpq, fmpq_mat, fmpq_mpoly
from numpy.typing import NDArray

from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_semidefinite
from pbcgen.proof.kernels import complement
from pbcgen.proof.known import Known
from pbcgen.proof.nonnegative import nonnegative
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import fraction, rational

Interval: TypeAlias = tuple[Fraction | None, Fraction | None]
Floats: TypeAlias = NDArray[np.float64]
Exponents: TypeAlias = tuple[int, ...]

_LARGEST_BASIS = 60
_LARGEST_PROBLEM = 1600
#: Larger bases are cut down by directions with so many nonzero entries.
_MANY, _MIXED = 20, 3
_MOST_EQUATIONS = 450
_ROUNDS = 4
#: Numbers beside the matrices are rounded with a relative tolerance.
_TOLERANCES = (1e-2, 1e-3, 1e-6, 0.0)
#: Denominator of rounded entries.
_GRAIN = 2**36


@dataclass(frozen=True, eq=False)
class Block:
    """The part ``multiplier * z^T G z`` of a sum, z being the basis."""

    multiplier: fmpq_mpoly
    basis: tuple[fmpq_mpoly, ...]


@dataclass(frozen=True, eq=False)
class SumOfSquares:
    """``polynomial = sum of multiplier * basis^T gram basis``, checked exactly."""

    polynomial: fmpq_mpoly
    blocks: tuple[Block, ...]
    grams: tuple[list[list[fmpq]], ...]

    def holds(self, field: Field) -> bool:
        """The identity and the matrices again, from scratch."""
        total = field.context.constant(0)
        for block, gram in zip(self.blocks, self.grams, strict=True):
            if gram and not _is_semidefinite(gram):
                return False
            for i, row in enumerate(gram):
                for j, entry in enumerate(row):
                    total += block.multiplier * block.basis[i] * block.basis[j] * entry
        return bool((field.polynomial(total) - field.polynomial(self.polynomial)).is_zero())


def available() -> bool:
    """Whether the solver is installed."""
    return find_spec("clarabel") is not None


def squares_tried() -> str:
    """For the method of an undecided verdict."""
    return ", sums of squares" if available() else " (no sums of squares: the extra `sos` is not installed)"


def sum_of_squares(function: Quotient, bounds: Mapping[int, Interval]) -> str | None:
    """Sizes of the matrices of a proof that ``function >= 0`` where the symbols lie in ``bounds``; None without one."""
    if not available():
        return None
    polynomial = function.numerator
    if not function.is_polynomial() and not nonnegative(function.field.polynomial(function.denominator)):
        polynomial = function.numerator * function.denominator
    found = find(function.field, function.field.polynomial(polynomial).numerator, bounds)
    if found is None or not found.holds(function.field):
        return None
    return " + ".join(str(len(block.basis)) for block in found.blocks)


# --- what the sum may consist of ----------------------------------------------------------------------------------


def multipliers(field: Field, polynomial: fmpq_mpoly, bounds: Mapping[int, Interval]) -> list[fmpq_mpoly]:
    """Polynomials that are nonnegative where the symbols lie in ``bounds``, in generators that occur; 1 first."""
    used = _used(polynomial)
    known = Known.of(field)
    generators = field.context.gens()
    found = [field.context.constant(1)]
    found += [generators[k] for k in sorted(known.positive & used)]
    found += [left * right for left, right in known.pairs]
    found += [1 - generators[k] ** 2 for k in sorted(known.bounded & used) if field.atoms[k].kind in ("tanh", "erf")]
    for k in sorted(used):
        lo, hi = bounds.get(k, (None, None)) if k < field.symbol_count else (None, None)
        above = None if lo is None else generators[k] - rational(lo)
        below = None if hi is None else rational(hi) - generators[k]
        found += [side for side in (above, below) if side is not None]
        if above is not None and below is not None:
            found.append(above * below)
    return [g for g in found if not g.is_zero() and _used(g) <= used]


def _used(polynomial: fmpq_mpoly) -> frozenset[int]:
    return frozenset(k for k, degree in enumerate(polynomial.degrees()) if degree)


def blocks(field: Field, polynomial: fmpq_mpoly, bounds: Mapping[int, Interval]) -> list[Block]:
    """For each multiplier the monomials of which squares may occur."""
    used = sorted(_used(polynomial))
    terms = [tuple(int(e) for e in raw) for raw in polynomial.to_dict()]
    most = [max(e[k] for e in terms) for k in used]
    totals = [sum(e[k] for k in used) for e in terms]
    result = []
    for multiplier in multipliers(field, polynomial, bounds):
        degrees = multiplier.degrees()
        own = [sum(int(v) for v in e) for e in multiplier.to_dict()]
        ranges = [range(ceil(max(0, high - int(degrees[k])) / 2) + 1) for high, k in zip(most, used, strict=True)]
        size = 1
        for choice in ranges:
            size *= len(choice)
        if size > 50 * _LARGEST_BASIS:
            continue
        least, largest = (min(totals) - max(own)) / 2, ceil((max(totals) - max(own)) / 2)
        chosen = [z for z in product(*ranges) if least <= sum(z) <= largest]
        if len(chosen) > _MANY and len(multiplier) == 1:
            free = [i for i, k in enumerate(used) if k < field.symbol_count]  # atoms may be roots, or sines and cosines
            chosen = _within(chosen, [[e[k] for k in used] for e in terms], [int(degrees[k]) for k in used], free)
        if chosen and len(chosen) <= _LARGEST_BASIS:
            result.append(Block(multiplier, tuple(_monomial(field, used, z) for z in chosen)))
    return result


def _within(
    basis: Sequence[Exponents], terms: Sequence[Sequence[int]], shift: Sequence[int], free: Sequence[int]
) -> list[Exponents]:
    """The elements whose squares, times a power product, are between the terms in all of some directions (Reznick).

    The directions are those of the ``free`` positions, between which there are no algebraic relations.
    """
    directions = [
        [dict(zip(chosen, signs, strict=True)).get(k, 0) for k in range(len(shift))]
        for count in range(1, min(_MIXED, len(free)) + 1)
        for chosen in combinations(free, count)
        for signs in product((-1, 1), repeat=count)
    ]
    if not directions:
        return list(basis)
    reach = np.array(terms) @ np.array(directions).T
    squares = (2 * np.array(basis) + np.array(shift)) @ np.array(directions).T
    inside = np.all((squares >= reach.min(axis=0)) & (squares <= reach.max(axis=0)), axis=1)
    return [z for z, keep in zip(basis, inside, strict=True) if keep]


def _monomial(field: Field, used: Sequence[int], exponents: Sequence[int]) -> fmpq_mpoly:
    result = field.context.constant(1)
    for k, exponent in zip(used, exponents, strict=True):
        result *= field.context.gens()[k] ** exponent
    return result


# --- equations ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Equations:
    """For each monomial the entries (block, i, j), i <= j, of the matrices that contribute, and the wanted value."""

    rows: dict[Exponents, dict[tuple[int, int, int], fmpq]]
    wanted: dict[Exponents, fmpq]

    @staticmethod
    def of(field: Field, polynomial: fmpq_mpoly, parts: Sequence[Block]) -> _Equations:
        rows: dict[Exponents, dict[tuple[int, int, int], fmpq]] = {}
        for b, block in enumerate(parts):
            for i, left in enumerate(block.basis):
                for j in range(i, len(block.basis)):
                    value = field.polynomial(block.multiplier * left * block.basis[j]).numerator
                    for raw, coefficient in value.to_dict().items():
                        key = tuple(int(e) for e in raw)
                        rows.setdefault(key, {})[b, i, j] = coefficient * (1 if i == j else 2)
        wanted = {tuple(int(e) for e in raw): c for raw, c in polynomial.to_dict().items()}
        return _Equations(rows, wanted)

    @property
    def possible(self) -> bool:
        """Whether every monomial of the polynomial can be produced."""
        return all(key in self.rows for key in self.wanted)

    def vanishing(self) -> set[tuple[int, int]]:
        """Diagonal entries that must be zero: alone, with one sign, in an equation with right side zero."""
        found = set()
        for key, row in self.rows.items():
            if key in self.wanted or any(i != j for _, i, j in row):
                continue
            if len({coefficient > 0 for coefficient in row.values()}) == 1:
                found |= {(b, i) for b, i, _ in row}
        return found


def _pruned(
    field: Field, polynomial: fmpq_mpoly, parts: list[Block], complete: bool = True
) -> tuple[list[Block], _Equations] | None:
    """Blocks without basis elements whose squares cannot occur; None when the problem is too large.

    If ``complete``, None also when a monomial of the polynomial cannot be produced.
    """
    while True:
        parts = [block for block in parts if block.basis]
        if sum(len(block.basis) * (len(block.basis) + 1) // 2 for block in parts) > _LARGEST_PROBLEM:
            parts = parts[:1]
            if sum(len(block.basis) for block in parts) > _LARGEST_BASIS:
                return None
        equations = _Equations.of(field, polynomial, parts)
        if (complete and not equations.possible) or len(equations.rows) > _MOST_EQUATIONS:
            return None
        gone = equations.vanishing()
        if not gone:
            return parts, equations
        parts = [
            Block(block.multiplier, tuple(z for i, z in enumerate(block.basis) if (b, i) not in gone))
            for b, block in enumerate(parts)
        ]


# --- solving ------------------------------------------------------------------------------------------------------


def find(field: Field, polynomial: fmpq_mpoly, bounds: Mapping[int, Interval]) -> SumOfSquares | None:
    """A sum of squares with exact rational matrices, or None."""
    if polynomial.is_zero():
        return None
    found = completed(field, polynomial, (), bounds)
    return None if found is None else found[0]


def completed(
    field: Field, base: fmpq_mpoly, directions: Sequence[fmpq_mpoly], bounds: Mapping[int, Interval]
) -> tuple[SumOfSquares, list[Fraction]] | None:
    """``base + sum c_k directions_k`` as a sum of squares with exact rational matrices and numbers c, or None.

    The equations of matrices and c are linear together, so that c too is moved onto them exactly where they ask for it.
    """
    if not available():
        return None
    support, terms = _support(field, base, directions)
    parts = blocks(field, support, bounds)
    for _ in range(_ROUNDS):
        pruned = _pruned(field, support, parts, complete=not directions)
        if pruned is None:
            return None
        parts, equations = pruned
        equations = _Equations({**{key: {} for key in equations.wanted}, **equations.rows}, terms[0])
        solved = _solve(equations, parts, terms[1:])
        if solved is None:
            return None
        grams, margin, free = solved
        for tolerance in _TOLERANCES if directions else (0.0,):
            wanted = [simplest(float(c), tolerance * max(abs(c), 0.1 * np.max(np.abs(free)))) for c in free]
            exact = _rounded(equations, parts, grams, terms[1:], wanted)
            if exact is not None:
                total = sum((d * rational(c) for d, c in zip(directions, exact[1], strict=True)), base)
                return SumOfSquares(total, tuple(parts), tuple(exact[0])), exact[1]
        if margin > 1e-4:
            return None
        reduced = _without_kernels(parts, grams)
        if reduced is None:
            return None
        parts = reduced
    return None


def _support(
    field: Field, base: fmpq_mpoly, directions: Sequence[fmpq_mpoly]
) -> tuple[fmpq_mpoly, list[dict[Exponents, fmpq]]]:
    """A polynomial with all monomials that occur, and the coefficients of each by monomial."""
    support = field.context.constant(0)
    for index, part in enumerate((base, *directions)):
        support += field.context.from_dict({e: fmpq(1) for e in part.to_dict()}) * (index + 1)
    terms = [{tuple(int(v) for v in e): c for e, c in part.to_dict().items()} for part in (base, *directions)]
    return support, terms


def simplest(value: float, tolerance: float) -> Fraction:
    """The fraction with the least denominator within the tolerance, roughly."""
    exact = Fraction(value)
    for digits in range(16):
        candidate = exact.limit_denominator(10**digits)
        if abs(candidate - exact) <= tolerance:
            return candidate
    return exact


def coefficients(
    field: Field, base: fmpq_mpoly, directions: Sequence[fmpq_mpoly], bounds: Mapping[int, Interval] | None = None
) -> list[float] | None:
    """Numbers c, in floating point, for which ``base + sum c_k directions_k`` seems to be a sum of squares, or None.

    Multipliers are as in :func:`find`. The numbers are a proposal: round them and prove the result.
    """
    if not available() or not directions:
        return None
    support, terms = _support(field, base, directions)
    pruned = _pruned(field, support, blocks(field, support, bounds or {}), complete=False)
    if pruned is None:
        return None
    parts, equations = pruned
    rows = {**{key: {} for key in equations.wanted}, **equations.rows}
    solved = _solve(_Equations(rows, terms[0]), parts, terms[1:])
    return None if solved is None else [float(c) for c in solved[2]]


def _scales(equations: _Equations, parts: Sequence[Block]) -> list[Floats]:
    """Sizes of the basis elements that make the squares comparable with the polynomial."""
    size = max((abs(float(fraction(c))) for c in equations.wanted.values()), default=1.0)
    result = []
    for b, block in enumerate(parts):
        own = np.ones(len(block.basis))
        for key, row in equations.rows.items():
            wanted = equations.wanted.get(key)
            if wanted is None:
                continue
            for (at, i, j), coefficient in row.items():
                if at == b and i == j:
                    own[i] = np.sqrt(abs(float(fraction(wanted))) / size / abs(float(fraction(coefficient))))
        result.append(own)
    return result


def _solve(
    equations: _Equations, parts: Sequence[Block], free: Sequence[Mapping[Exponents, fmpq]] = ()
) -> tuple[list[Floats], float, Floats] | None:
    """Matrices in floating point with the largest least eigenvalue (of the scaled ones), and that eigenvalue.

    With ``free`` the wanted polynomial is ``wanted + sum c_k free_k``; the c are the third part of the result.
    """
    import clarabel
    from scipy.sparse import coo_matrix, csc_matrix

    scales = _scales(equations, parts)
    column: dict[tuple[int, int, int], int] = {}
    for b, block in enumerate(parts):
        for j in range(len(block.basis)):
            for i in range(j + 1):
                column[b, i, j] = len(column)
    count = len(column)
    width = count + 1 + len(free)
    entries: list[tuple[int, int, float]] = []
    right: list[float] = []
    largest = max((abs(float(fraction(c))) for c in equations.wanted.values()), default=1.0)
    for r, (key, row) in enumerate(sorted(equations.rows.items())):
        values = {
            column[b, i, j]: float(fraction(c)) * scales[b][i] * scales[b][j] / (1 if i == j else np.sqrt(2.0))
            for (b, i, j), c in row.items()
        }
        others = {count + 1 + k: -float(fraction(part[key])) for k, part in enumerate(free) if key in part}
        weight = max((abs(v) for v in (*values.values(), *(v / largest for v in others.values()))), default=1.0)
        entries += [(r, k, v / weight) for k, v in values.items()]
        entries += [(r, k, v / largest / weight) for k, v in others.items()]
        right.append(float(fraction(equations.wanted.get(key, fmpq(0)))) / largest / weight)
    offset = len(right)
    entries += [(offset, count, 1.0)]
    right.append(1.0)
    for (_, i, j), k in column.items():
        entries.append((offset + 1 + k, k, -1.0))
        if i == j:
            entries.append((offset + 1 + k, count, 1.0))
        right.append(0.0)
    rows, columns, data = zip(*entries, strict=True)
    matrix = csc_matrix(coo_matrix((data, (rows, columns)), shape=(len(right), width)))
    cones: list[Any] = [clarabel.ZeroConeT(offset), clarabel.NonnegativeConeT(1)]
    cones += [clarabel.PSDTriangleConeT(len(block.basis)) for block in parts]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = 100
    settings.max_threads = 1
    aim = np.zeros(width)
    aim[count] = -1.0
    solution = clarabel.DefaultSolver(csc_matrix((width, width)), aim, matrix, np.array(right), cones, settings).solve()
    x = np.array(solution.x)
    if len(x) != width or not np.all(np.isfinite(x)) or x[count] < -1e-4:
        return None
    grams = [np.zeros((len(block.basis), len(block.basis))) for block in parts]
    for (b, i, j), k in column.items():
        value = x[k] * scales[b][i] * scales[b][j] * largest / (1 if i == j else np.sqrt(2.0))
        grams[b][i, j] = grams[b][j, i] = value
    return grams, float(x[count]), x[count + 1 :]


def _rounded(
    equations: _Equations,
    parts: Sequence[Block],
    grams: Sequence[Floats],
    free: Sequence[Mapping[Exponents, fmpq]] = (),
    numbers: Sequence[Fraction] = (),
) -> tuple[list[list[list[fmpq]]], list[Fraction]] | None:
    """Rational positive semidefinite matrices that satisfy the equations exactly, near the given ones; or None.

    With ``free`` the wanted polynomial is ``wanted + sum c_k free_k``, and c, near ``numbers``, is part of the result.
    """
    entries = sorted({at for row in equations.rows.values() for at in row}, key=lambda at: (at[1] == at[2], at))
    unknowns: list[tuple[int, int, int] | int] = [*entries, *range(len(free))]
    position = {at: k for k, at in enumerate(unknowns)}
    table = [[fmpq(0)] * (len(unknowns) + 1) for _ in equations.rows]
    for line, (key, row) in zip(table, equations.rows.items(), strict=True):
        for at, coefficient in row.items():
            line[position[at]] = coefficient
        for c, part in enumerate(free):
            line[position[c]] = -part.get(key, fmpq(0))
        line[-1] = equations.wanted.get(key, fmpq(0))
    reduced, rank = fmpq_mat(table).rref()
    values = [*(_grain(grams[b][i, j]) for b, i, j in entries), *map(rational, numbers)]
    for r in range(rank):
        pivot = next((k for k in range(len(unknowns) + 1) if reduced[r, k] != 0), len(unknowns))
        if pivot == len(unknowns):
            return None
        total = reduced[r, len(unknowns)]
        for k in range(pivot + 1, len(unknowns)):
            if reduced[r, k] != 0:
                total -= reduced[r, k] * values[k]
        values[pivot] = total
    result = [[[fmpq(0)] * len(block.basis) for _ in block.basis] for block in parts]
    for k, (b, i, j) in enumerate(entries):
        result[b][i][j] = result[b][j][i] = values[k]
    if not all(_is_semidefinite(gram) for gram in result if gram):
        return None
    return result, [fraction(v) for v in values[len(entries) :]]


def _is_semidefinite(gram: Sequence[Sequence[fmpq]]) -> bool:
    return positive_semidefinite([list(row) for row in gram]).status is Status.PROVED


def _grain(value: float) -> fmpq:
    """A rational near a float, relatively."""
    if value == 0:
        return fmpq(0)
    exact = Fraction(value)
    scale = Fraction(2) ** (int(np.floor(np.log2(abs(value)))))
    return rational(Fraction(round(exact / scale * _GRAIN), _GRAIN) * scale)


def _without_kernels(parts: Sequence[Block], grams: Sequence[Floats]) -> list[Block] | None:
    """Bases that span only where the matrices do not vanish; None when no kernel of simple numbers is recognised."""
    result, changed = [], False
    for block, gram in zip(parts, grams, strict=True):
        rows = complement(gram)
        if rows is None:
            result.append(block)
            continue
        changed = True
        basis = []
        for combination in rows:
            element = block.basis[0] * 0
            for weight, z in zip(combination, block.basis, strict=True):
                element += z * rational(weight)
            basis.append(element)
        result.append(Block(block.multiplier, tuple(basis)))
    return result if changed else None
