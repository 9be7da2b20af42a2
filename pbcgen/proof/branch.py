"""Signs of functions on a box, by branch and bound in ball arithmetic, with factoring where zero is attained.

A box is done when the enclosure of the function, or its mean value form, has the wanted sign; else it is halved. That
never ends where the value is zero, so zeros are taken out first:

* squares that divide the function are dropped;
* a quadratic polynomial in some of the symbols becomes a matrix of functions of the others, proved semidefinite by
  elimination, so these symbols need no bounds;
* where the function and its slope vanish for x_V = c, it is ``(x_V - c)^T H (x_V - c)`` with an average H of the second
  derivatives, and it suffices that these are positive definite near there.

An angle that occurs only in sines and cosines ranges over one turn. Every other symbol needs a bounded interval.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import gcd
from typing import TypeAlias

import casadi as ca
from flint import fmpq, fmpq_mpoly

from pbcgen.errors import UnsupportedOperation
from pbcgen.proof.boxes import Box, halves
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import positive_definite
from pbcgen.proof.elimination import semidefinite
from pbcgen.proof.nonnegative import nonnegative, positive
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import REAL, ZERO, Real, enclose, fraction, is_finite, lower, precision, rational, sign
from pbcgen.symbolic.tape import Tape

Interval: TypeAlias = tuple[Fraction | None, Fraction | None]
#: Called now and then with the number of boxes done so far.
Progress: TypeAlias = Callable[[int], None] | None

_BITS = 64
#: Boxes narrower than this, relatively to the first one, are given up.
_NARROWEST = Fraction(1, 10**10)
_MOST_FACTORED = 150
#: A rational above pi.
_PI = Fraction(355, 113)


class EmptyBoxError(ValueError):
    """A box without points was given: every claim on it would hold."""


@dataclass(frozen=True)
class BoxProof:
    """The verdict on ``function > 0`` or ``>= 0`` on a box.

    Attributes:
        status: PROVED, REFUTED (``point`` is a rational point with a certainly negative value) or UNDECIDED.
        boxes: how many boxes were looked at.
        point: for REFUTED.
    """

    status: Status
    boxes: int
    point: tuple[Fraction, ...] | None = None


@dataclass(eq=False)
class Budget:
    """How many boxes may be looked at, over all proofs that share it."""

    boxes: int = 5000
    progress: Progress = None
    used: int = 0

    def spend(self) -> bool:
        """Whether there is one box left; it is used up then."""
        if self.used >= self.boxes:
            return False
        self.used += 1
        if self.progress is not None and self.used % 200 == 0:
            self.progress(self.used)
        return True


def checked(box: Box) -> Box:
    """The box. Raises EmptyBoxError when it contains no point or has no dimension."""
    if not box or any(lo > hi for lo, hi in box):
        raise EmptyBoxError(f"the box {box} is empty: a proof on it would be vacuous")
    return box


# --- branch and bound on formulas ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Formula:
    """A scalar SX of ``variables``, with ``constants`` that have exact values."""

    value: ca.SX
    variables: ca.SX
    constants: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    constant_values: tuple[Fraction, ...] = ()

    def evaluator(self, *outputs: ca.SX) -> Callable[[Sequence[Real]], list[list[list[Real]]]]:
        """The outputs, functions of the same symbols, over exact numbers and balls."""
        tape = Tape.of([self.variables, self.constants], [ca.SX(output) for output in outputs])
        values = [rational(v) for v in self.constant_values]
        return lambda x: [matrix.dense(ZERO) for matrix in tape.walk(REAL, [list(x), values])]


def positive_on_box(formula: Formula, box: Box, budget: Budget) -> BoxProof:
    """Whether the function is positive on the closed box."""
    return _Branching(formula, checked(box), budget, strict=True).run()


def nonnegative_on_box(
    formula: Formula, box: Box, budget: Budget, zeros: Mapping[int, Fraction] | None = None
) -> BoxProof:
    """Whether the function is nonnegative on the closed box.

    Args:
        formula: the function.
        box: exact bounds of the variables.
        budget: of boxes.
        zeros: values of some variables at which function and gradient in these variables are known to vanish, whatever
            the other variables; the caller has proved that, see :func:`zero_set`.
    """
    return _Branching(formula, checked(box), budget, strict=False, zeros=dict(zeros or {})).run()


@dataclass(eq=False)
class _Branching:
    formula: Formula
    box: Box
    budget: Budget
    strict: bool
    zeros: dict[int, Fraction] = field(default_factory=dict)
    _count: int = 0

    def __post_init__(self) -> None:
        f = self.formula
        self._value = f.evaluator(f.value)
        self._slope = f.evaluator(f.value, ca.densify(ca.gradient(f.value, f.variables)))
        chosen = sorted(self.zeros)
        hessian = ca.hessian(f.value, f.variables[chosen])[0] if chosen else ca.SX(0, 0)
        self._hessian = f.evaluator(f.value, ca.densify(hessian))
        self._widths = [hi - lo for lo, hi in self.box]

    def run(self) -> BoxProof:
        """Best first: the box with the lowest enclosure is looked at next."""
        waiting: list[tuple[float, int, Box]] = [(0.0, 0, self.box)]
        start = self.budget.used
        with precision(_BITS):
            while waiting:
                if not self.budget.spend():
                    return BoxProof(Status.UNDECIDED, self.budget.used - start)
                _, _, box = heapq.heappop(waiting)
                pieces = self._look(box)
                if isinstance(pieces, BoxProof):
                    return BoxProof(pieces.status, self.budget.used - start, pieces.point)
                for bound, piece in pieces:
                    self._count += 1
                    heapq.heappush(waiting, (bound, self._count, piece))
        return BoxProof(Status.PROVED, self.budget.used - start)

    def _look(self, box: Box) -> list[tuple[float, Box]] | BoxProof:
        """Nothing when the sign is certain on the box, else its halves, or the verdict that ends the search."""
        value, gradient = self._enclosures(box)
        if self._good(value):
            return []
        centre = tuple((lo + hi) / 2 for lo, hi in box)
        at_centre = self._value([rational(c) for c in centre])[0][0][0]
        if is_finite(at_centre) and sign(at_centre) == -1:
            return BoxProof(Status.REFUTED, 0, centre)
        # A jump has slope zero on both sides: slopes count only where the value itself is enclosed.
        if is_finite(value) and all(is_finite(g) for g in gradient):
            slopes = [enclose(lo - c, hi - c) for (lo, hi), c in zip(box, centre, strict=True)]
            if self._good(sum((g * d for g, d in zip(gradient, slopes, strict=True)), at_centre)):
                return []
            if self._good(self._value(self._lowest_face(box, gradient))[0][0][0]):
                return []
        if self.zeros and self._convex(box):
            return []
        return self._halves(box, gradient, value)

    def _enclosures(self, box: Box) -> tuple[Real, list[Real]]:
        value, gradient = self._slope([enclose(lo, hi) for lo, hi in box])
        return value[0][0], [row[0] for row in gradient]

    def _good(self, value: Real) -> bool:
        if not is_finite(value):
            return False
        return sign(value) == 1 or (not self.strict and bool(value >= 0))

    def _lowest_face(self, box: Box, gradient: Sequence[Real]) -> list[Real]:
        """The face that contains the least value, as far as the signs of the slopes tell."""
        face: list[Real] = []
        for (lo, hi), slope in zip(box, gradient, strict=True):
            certain = sign(slope)
            if certain in (0, 1):
                face.append(rational(lo))
            else:
                face.append(rational(hi) if certain == -1 else enclose(lo, hi))
        return face

    def _convex(self, box: Box) -> bool:
        """Whether the function is convex in the zero variables from here to where they take their zero values."""
        hull = [
            enclose(min(lo, self.zeros[k]), max(hi, self.zeros[k])) if k in self.zeros else enclose(lo, hi)
            for k, (lo, hi) in enumerate(box)
        ]
        value, hessian = self._hessian(hull)
        if not all(is_finite(entry) for row in (*value, *hessian) for entry in row):
            return False
        return positive_definite(hessian).status is Status.PROVED

    def _halves(self, box: Box, gradient: Sequence[Real], value: Real) -> list[tuple[float, Box]] | BoxProof:
        """Cut where the function varies most."""

        def variation(k: int) -> float:
            width = float(box[k][1] - box[k][0])
            relative = width / float(self._widths[k]) if self._widths[k] else 0.0
            size = -_below(-abs(gradient[k]))
            return relative if size == float("inf") else width * size + 1e-9 * relative

        widest = max(range(len(box)), key=variation)
        lo, hi = box[widest]
        if hi - lo <= _NARROWEST * self._widths[widest]:
            return BoxProof(Status.UNDECIDED, 0)
        return [(_below(value), half) for half in halves(box, widest)]


def _below(value: Real) -> float:
    """The lower end of an enclosure as a float, for the order of the search; minus infinity when it has none."""
    try:
        return float(lower(value)) if is_finite(value) else float("-inf")
    except OverflowError:
        return float("-inf")


def zero_set(formula: Formula, names: Sequence[str], centre: Sequence[Fraction]) -> dict[int, Fraction] | None:
    """A smallest set of variables such that function and gradient vanish where these take their values of ``centre``.

    It is found by leaving out one variable after the other; each step is an exact identity. None if the function and
    its gradient do not vanish at ``centre`` itself, or if the formula is not analytic.
    """
    constants = {f"constant {k}": value for k, value in enumerate(formula.constant_values)}
    tape = Tape.of(
        [formula.variables, formula.constants],
        [ca.vertcat(formula.value, ca.gradient(formula.value, formula.variables))],
    )

    def vanishes(chosen: Sequence[int]) -> bool:
        values = {names[k]: centre[k] for k in chosen}
        try:
            algebra, (entries,) = evaluate(tape, [*names, *constants], {**values, **constants})
        except (UnsupportedOperation, ZeroDivisionError):
            return False
        column = entries.column(algebra.const(0))
        return column[0].is_zero() and all(column[1 + k].is_zero() for k in chosen)

    chosen = list(range(len(names)))
    if not vanishes(chosen):
        return None
    for k in range(len(names)):
        fewer = [j for j in chosen if j != k]
        if fewer and vanishes(fewer):
            chosen = fewer
    return {k: centre[k] for k in chosen}


# --- signs of exact functions on a box ----------------------------------------------------------------------------


@dataclass(eq=False)
class OnBox:
    """Proves signs of exact functions where the symbols lie in intervals (a :class:`Prover`).

    Attributes:
        bounds: intervals by position of the symbol; a missing one is unbounded.
        budget: of boxes, over everything that is asked.
        centre: values at which zeros are looked for, by position; zero if not given.
    """

    bounds: Mapping[int, Interval]
    budget: Budget = field(default_factory=Budget)
    centre: Mapping[int, Fraction] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if any(lo is not None and hi is not None and lo > hi for lo, hi in self.bounds.values()):
            raise EmptyBoxError("an interval of the domain is empty: a proof on it would be vacuous")

    def positive(self, function: Quotient) -> bool:
        """Whether ``function > 0`` on the box is proved."""
        if positive(function, self._above(strictly=True)):
            return True
        denominator = self._sign(function.field, function.denominator)
        return denominator != 0 and self._sign(function.field, function.numerator) == denominator

    def nonnegative(self, function: Quotient) -> bool:
        """Whether ``function >= 0`` on the box is proved, wherever the function is defined."""
        if nonnegative(function, self._above(strictly=False)):
            return True
        denominator = self._sign(function.field, function.denominator)
        if denominator == 0:
            return False
        return self._nonnegative(function.field, function.numerator * denominator)

    def _above(self, strictly: bool) -> frozenset[int]:
        found = {k for k, (lo, _) in self.bounds.items() if lo is not None and (lo > 0 or (lo == 0 and not strictly))}
        return frozenset(found)

    def _sign(self, algebra: Field, polynomial: fmpq_mpoly) -> int:
        """1 or -1 when the polynomial is proved to be positive or negative on the box, else 0."""
        if polynomial.is_constant():
            return 1 if polynomial.leading_coefficient() > 0 else -1
        for certain in (1, -1):
            if positive(algebra.polynomial(polynomial * certain), self._above(strictly=True)):
                return certain
        problem = self._problem(algebra, polynomial)
        if problem is None:
            return 0
        formula, box, _ = problem
        middle = formula.evaluator(formula.value)([rational((lo + hi) / 2) for lo, hi in box])[0][0][0]
        guess = sign(middle) if is_finite(middle) else None
        if not guess:
            return 0
        signed = Formula(formula.value * guess, formula.variables, formula.constants, formula.constant_values)
        return guess if positive_on_box(signed, box, self.budget).status is Status.PROVED else 0

    def _nonnegative(self, algebra: Field, polynomial: fmpq_mpoly) -> bool:
        remaining = self._without_known_factors(algebra, polynomial)
        if remaining.is_zero() or nonnegative(algebra.polynomial(remaining), self._above(strictly=False)):
            return True
        if self._by_quadratic_form(algebra, remaining):
            return True
        problem = self._problem(algebra, remaining)
        if problem is None:
            return False
        formula, box, used = problem
        names = [algebra.names[k] for k in used]
        zeros = zero_set(formula, names, [self.centre.get(k, Fraction(0)) for k in used])
        return nonnegative_on_box(formula, box, self.budget, zeros).status is Status.PROVED

    def _without_known_factors(self, algebra: Field, polynomial: fmpq_mpoly) -> fmpq_mpoly:
        """The product of the factors with odd power, without those of a proved sign."""
        if len(polynomial) > _MOST_FACTORED:
            return polynomial
        content, factors = polynomial.factor()
        remaining = algebra.context.constant(1 if content > 0 else -1)
        odd = [factor for factor, power in factors if power % 2]
        for factor in odd:
            certain = self._sign(algebra, factor) if len(odd) > 1 else 0
            remaining *= factor if certain == 0 else certain
        return remaining

    def _by_quadratic_form(self, algebra: Field, polynomial: fmpq_mpoly) -> bool:
        """The polynomial as ``[1, z]^T M [1, z]`` with z symbols that M does not depend on."""
        degrees = polynomial.degrees()
        inside = {s for k, atom in algebra.atoms.items() if degrees[k] for s in atom.argument.symbols()}
        direct = [k for k in range(algebra.symbol_count) if degrees[k] and k not in inside]
        chosen = [k for k in direct if degrees[k] <= 2]
        unbounded = [k for k in direct if None in self.bounds.get(k, (None, None))]
        for z in (chosen, unbounded):
            form = _quadratic_form(algebra, polynomial, z) if z else None
            if form is not None and semidefinite(form, prover=self):
                return True
        return False

    def _problem(self, algebra: Field, polynomial: fmpq_mpoly) -> tuple[Formula, Box, list[int]] | None:
        """The polynomial as a formula of the symbols that occur, with their box; None when one has no bounds."""
        used = sorted(algebra.polynomial(polynomial).symbols())
        box = []
        for k in used:
            lo, hi = self.bounds.get(k, (None, None))
            if lo is None or hi is None:
                turn = _turn(algebra, polynomial, k)
                if turn is None:
                    return None
                lo, hi = -turn, turn
            box.append((lo, hi))
        if not used:
            return None
        return formula_of(algebra, polynomial, used), tuple(box), used


def _turn(algebra: Field, polynomial: fmpq_mpoly, k: int) -> Fraction | None:
    """Half a common period of a symbol that occurs only in sines and cosines of its multiples, rounded up."""
    degrees = polynomial.degrees()
    if degrees[k]:
        return None
    unit = Fraction(0)
    for position, atom in algebra.atoms.items():
        if not degrees[position] or k not in atom.argument.symbols():
            continue
        terms = atom.argument.numerator.to_dict()
        if atom.kind not in ("sin", "cos") or not atom.argument.is_polynomial() or len(terms) != 1:
            return None
        ((exponents, coefficient),) = terms.items()
        if int(exponents[k]) != 1 or sum(int(e) for e in exponents) != 1:
            return None
        multiple = abs(fraction(coefficient))
        unit = multiple if unit == 0 else _common_unit(unit, multiple)
    return _PI / unit if unit else None


def _common_unit(a: Fraction, b: Fraction) -> Fraction:
    return Fraction(gcd(a.numerator * b.denominator, b.numerator * a.denominator), a.denominator * b.denominator)


def _quadratic_form(algebra: Field, polynomial: fmpq_mpoly, z: Sequence[int]) -> list[list[Quotient]] | None:
    """M with ``polynomial = [1, z]^T M [1, z]`` without zero rows, or None when a term has a higher degree in z."""
    size = len(z) + 1
    entries: dict[tuple[int, int], dict[tuple[int, ...], fmpq]] = {}
    for raw, coefficient in polynomial.to_dict().items():
        exponents = tuple(int(e) for e in raw)
        places = [1 + i for i, k in enumerate(z) for _ in range(exponents[k])]
        if len(places) > 2:
            return None
        i, j = [0, 0, *places][-2:]
        rest = tuple(0 if k in z else e for k, e in enumerate(exponents))
        for at in {(i, j), (j, i)}:
            entries.setdefault(at, {})[rest] = coefficient if i == j else coefficient / 2
    zero = algebra.const(0)
    rows = [
        [
            algebra.polynomial(algebra.context.from_dict(entries[i, j])) if (i, j) in entries else zero
            for j in range(size)
        ]
        for i in range(size)
    ]
    kept = [i for i in range(size) if any(not entry.is_zero() for entry in rows[i])]
    return [[rows[i][j] for j in kept] for i in kept]


def formula_of(algebra: Field, polynomial: fmpq_mpoly, used: Sequence[int]) -> Formula:
    """A polynomial in symbols and atoms as a formula; coefficients that no double holds become exact constants."""
    symbols = [ca.SX.sym(algebra.names[k]) for k in range(algebra.symbol_count)]
    constants: list[ca.SX] = []
    values: list[Fraction] = []
    cache: dict[int, ca.SX] = dict(enumerate(symbols))

    def generator(k: int) -> ca.SX:
        if k not in cache:
            atom = algebra.atoms[k]
            inline = bool(atom.argument.symbols())
            top, bottom = (expression(p, inline) for p in (atom.argument.numerator, atom.argument.denominator))
            cache[k] = getattr(ca, atom.kind)(top if atom.argument.is_polynomial() else top / bottom)
        return cache[k]

    def number(coefficient: fmpq, inline: bool) -> ca.SX:
        if inline and coefficient.q == 1 and abs(coefficient.p) < 2**53:
            return ca.SX(float(int(coefficient.p)))
        constants.append(ca.SX.sym(f"constant {len(constants)}"))
        values.append(fraction(coefficient))
        return constants[-1]

    def expression(p: fmpq_mpoly, inline: bool = True) -> ca.SX:
        """Numbers go inline only where CasADi has a symbol to keep it from computing with them in doubles."""
        total = ca.SX(0)
        for exponents, coefficient in sorted(p.to_dict().items()):
            term = number(coefficient, inline)
            for k, exponent in enumerate(exponents):
                if exponent:
                    term = term * generator(k) ** int(exponent)
            total = total + term
        return total

    value = expression(polynomial)
    return Formula(value, ca.vertcat(*[symbols[k] for k in used]), ca.vertcat(ca.SX(0, 1), *constants), tuple(values))
