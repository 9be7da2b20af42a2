"""Targets that no real state meets: the equations of a rest under the target contradict each other.

The equations ``e_i(x, u) = 0`` are those of :class:`pbcgen.passivity.completion.Equations`. What is concluded holds of
every real state and input at which they are defined and which lies in the domain:

1. A sum of terms of one sign vanishes only if each does; a product, only if a factor does (a case for each). An
   equation ``c (v - r) = 0``, with c a number or an exponential and r without v, gives v = r, which is put in for v.
2. A function that is proved to be positive, or negative, on the domain has no zero. Nor has a polynomial in one unknown
   whose real roots, isolated in balls, lie outside of the bounds of that unknown. A state that was found to be a
   function r with ``r < lo`` or ``r > hi`` on the domain is never in it.
3. ``sum m_i e_i`` vanishes wherever all e_i do, whatever the functions m_i: if it is proved to be positive on the
   domain, there is no rest. For polynomials some m_i show it whenever there is none (Krivine and Stengle); multipliers
   of low degree are proposed in doubles by semidefinite programming and rounded, and the sign is then decided exactly.

Numerators are used in place of the functions: a quotient that vanishes has a numerator that does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import product
from math import lcm

import casadi as ca
from flint import arb, fmpq, fmpq_mpoly, fmpz_poly

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.equation import essentials, linear_in, never_zero, parts
from pbcgen.passivity.plant import Plant
from pbcgen.proof.branch import Budget, Interval, OnBox
from pbcgen.proof.sos import coefficients, sum_of_squares
from pbcgen.symbolic.display import formula, number
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import BITS, fraction, lower, precision, text, upper

#: How many products may be followed one inside the other, and how many factors they may have.
_DEEPEST, _MOST_CASES = 3, 4
#: Boxes that branch and bound may take for all equations of a case.
_BOXES = 2000
#: Multipliers are sought up to this degree, and rounded to these denominators.
_DEGREE = 2
_DENOMINATORS = (1, 8, 10**3, 10**6)
#: More products of a multiplier and an equation are not offered to the programme.
_MOST_PRODUCTS = 60
#: Formulas of more terms, or characters, are not shown.
_MOST_SHOWN, _LONGEST = 30, 160
#: Polynomials of a higher degree are not searched for roots.
_HIGHEST = 60


@dataclass(frozen=True)
class Contradiction:
    """Why no real state meets the equations.

    Attributes:
        equation: what is left of them, as text that ends in ``= 0``.
        why: what shows that it has no solution.
        steps: what was found on the way.
    """

    equation: str
    why: str
    steps: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """For the evidence of a verdict."""
        found = f"with {', '.join(self.steps)} " if self.steps else ""
        return f"{found}the equations leave {self.equation}, {self.why}"


@dataclass(frozen=True)
class _Case:
    """Equations that are left, and states and inputs, by position, that were found to be functions of the others."""

    equations: tuple[ca.SX, ...]
    solved: Mapping[int, ca.SX] = field(default_factory=dict)
    steps: tuple[str, ...] = ()
    depth: int = 0


@dataclass(frozen=True)
class _Left:
    """The equations of a case as exact functions, each without factors that never vanish."""

    field: Field
    functions: list[Quotient]

    @staticmethod
    def of(work: _Work, case: _Case) -> _Left | Contradiction:
        """The functions, or the equation that is true nowhere."""
        field_, (values,) = work.plant.exact(ca.vertcat(ca.SX(0, 1), *case.equations), known=work.known)
        functions: list[Quotient] = []
        for value in values.column(field_.const(0)):
            if value.is_zero():
                continue
            if never_zero(field_.polynomial(value.numerator)):
                return Contradiction(_stated(value), "which is true nowhere", case.steps)
            for part in parts(value):
                factors = essentials(part)
                functions.append(factors[0] if len(factors) == 1 else part)
        impossible = next((f for f in functions if never_zero(f)), None)
        if impossible is not None:
            return Contradiction(_stated(impossible), "which is true nowhere", case.steps)
        return _Left(field_, functions)


def contradiction(plant: Plant, equations: ca.SX, known: Mapping[str, Fraction]) -> Contradiction | None:
    """Why ``equations = 0`` has no real solution in the domain, or None if that was not shown.

    Args:
        plant: the system.
        equations: a column of functions of x and u.
        known: values of some of these by name, which follow from the equations.
    """
    try:
        return _Work(plant, known).case(_Case(tuple(ca.vertsplit(equations))))
    except (UnsupportedOperation, ZeroDivisionError):
        return None


@dataclass(frozen=True)
class _Work:
    plant: Plant
    known: Mapping[str, Fraction]

    @property
    def symbols(self) -> dict[int, ca.SX]:
        """The states and inputs that have no value, by their position among the names of the plant."""
        system = self.plant.system
        every = ca.vertsplit(ca.vertcat(system.x, system.u))
        return {k: symbol for k, symbol in enumerate(every) if self.plant.names[k] not in self.known}

    @property
    def bounds(self) -> dict[int, Interval]:
        """The domain by position."""
        domain = self.plant.system.domain
        return {k: domain[name] for k, name in enumerate(self.plant.system.state_names) if name in domain}

    def case(self, case: _Case) -> Contradiction | None:
        """One variable after the other is put in; then what is left is looked at."""
        while True:
            left = _Left.of(self, case)
            if isinstance(left, Contradiction):
                return left
            following = self._put_in(case, left)
            if following is None:
                break
            case = following
        return self._alone(case, left) or self._together(case, left) or self._by_factors(case, left)

    def _put_in(self, case: _Case, left: _Left) -> _Case | None:
        """The case in which an equation has given a variable, an input rather than a state; None if none does."""
        inputs_first = sorted(self.symbols, key=lambda k: (k < self.plant.system.n, k in self.bounds, k))
        for k in inputs_first:
            for i, function in enumerate(left.functions):
                rest = linear_in(function, k, units=True)
                if rest is None:
                    continue
                value = self.plant.expression(-rest, alone=True)
                others = [self.plant.expression(f) for j, f in enumerate(left.functions) if j != i]
                moved = [ca.substitute(e, self.symbols[k], value) for e in (*case.solved.values(), *others)]
                solved = dict(zip(case.solved, moved, strict=False)) | {k: value}
                steps = (*case.steps, f"{self.plant.names[k]} = {_shown(-rest)}")
                return _Case(tuple(moved[len(case.solved) :]), solved, steps, case.depth)
        return None

    # --- one equation at a time ------------------------------------------------------------------------------------

    def _alone(self, case: _Case, left: _Left) -> Contradiction | None:
        """An equation without a zero in the domain, or a state that is never in it."""
        prover = OnBox(self.bounds, Budget(_BOXES))
        within = " in the domain" if self.bounds else ""
        for function in left.functions:
            if prover.positive(function) or prover.positive(-function):
                return Contradiction(_stated(function), f"which is true nowhere{within}", case.steps)
            roots = _real_roots(function, self.bounds)
            if roots is not None and not any(inside for _, inside in roots):
                listed = ", ".join(text(root, 9) for root, _ in roots)
                why = (
                    f"whose real roots are {listed} only, outside of the domain" if roots else "which has no real root"
                )
                return Contradiction(_stated(function), why, case.steps)
        return self._outside(case, prover)

    def _outside(self, case: _Case, prover: OnBox) -> Contradiction | None:
        for k, (lo, hi) in self.bounds.items():
            if k not in case.solved:
                continue
            field_, (value,) = self.plant.exact(case.solved[k], known=self.known)
            found, name = value.scalar(field_.const(0)), self.plant.names[k]
            beyond = {"below": None if lo is None else field_.const(lo) - found}
            beyond["above"] = None if hi is None else found - field_.const(hi)
            for side, excess in beyond.items():
                if excess is not None and prover.positive(excess):
                    return Contradiction(f"{name} = {_shown(found)}", f"which is {side} its domain", case.steps)
        return None

    # --- several equations -----------------------------------------------------------------------------------------

    def _together(self, case: _Case, left: _Left) -> Contradiction | None:
        """A sum of multiples of the equations that is positive on the domain."""
        for weights in multipliers(left.field, left.functions, self.bounds):
            total = sum((m * e for m, e in zip(weights, left.functions, strict=True)), left.field.const(0))
            one = left.field.const(1)
            if sum_of_squares(total - one, self.bounds) is None:
                continue
            parts_ = [(m, e) for m, e in zip(weights, left.functions, strict=True) if not m.is_zero()]
            equations = " and ".join(_stated(e) for _, e in parts_)
            added = " + ".join(f"({_shown(m)}) ({_shown(e)})" for m, e in parts_)
            return Contradiction(equations, f"and {added} >= 1 as a sum of squares", case.steps)
        return None

    def _by_factors(self, case: _Case, left: _Left) -> Contradiction | None:
        """An equation that is a product, each factor of which leads to a contradiction."""
        if case.depth == _DEEPEST:
            return None
        for i, function in enumerate(left.functions):
            factors = essentials(function)
            if not 1 < len(factors) <= _MOST_CASES:
                continue
            others = [self.plant.expression(f) for j, f in enumerate(left.functions) if j != i]
            found = []
            for factor in factors:
                equations = (self.plant.expression(factor), *others)
                inner = self.case(replace(case, equations=equations, depth=case.depth + 1))
                if inner is None:
                    return None
                found.append(f"where {_shown(factor)} = 0, {inner.equation}, {inner.why}")
            return Contradiction(f"{_shown(function)} = 0", "; ".join(found), case.steps)
        return None


def _shown(function: Quotient) -> str:
    """The function as a formula, if it is not too long to be read."""
    found = formula(function) if len(function.numerator) <= _MOST_SHOWN else ""
    return found if 0 < len(found) <= _LONGEST else f"(a function of {', '.join(_names(function))})"


def _names(function: Quotient) -> list[str]:
    return [function.field.names[k] for k in sorted(function.symbols())]


def _stated(function: Quotient) -> str:
    """The equation ``function = 0`` as text; for a multiple of an atom and a number, what the atom would have to be."""
    field_, terms = function.field, {tuple(map(int, e)): c for e, c in function.numerator.to_dict().items()}
    constant = terms.pop((0,) * len(field_.context.gens()), fmpq(0))
    if len(terms) == 1:
        ((exponents, slope),) = terms.items()
        if sum(exponents) == 1 and (k := exponents.index(1)) in field_.atoms:
            return f"{formula(field_.symbol(k))} = {number(fraction(-constant / slope))}"
    return f"{_shown(function)} = 0"


def _real_roots(function: Quotient, bounds: Mapping[int, Interval]) -> list[tuple[arb, bool]] | None:
    """The real roots of a polynomial in one unknown, and whether they may lie within its bounds; None for others.

    Roots are isolated with certainty: those that are not real have a certain imaginary part.
    """
    used = [k for k, degree in enumerate(function.numerator.degrees()) if degree]
    if len(used) != 1 or used[0] in function.field.atoms or function.numerator.total_degree() > _HIGHEST:
        return None
    (k,) = used
    terms = {int(e[k]): c for e, c in function.numerator.to_dict().items()}
    common = lcm(*(int(c.q) for c in terms.values()))
    polynomial = fmpz_poly([int(terms.get(d, fmpq(0)) * common) for d in range(max(terms) + 1)])
    lo, hi = bounds.get(k, (None, None))
    with precision(BITS):
        balls = [root.real for root, _ in polynomial.complex_roots() if root.imag.contains(0)]
        return [(b, (lo is None or upper(b) >= lo) and (hi is None or lower(b) <= hi)) for b in balls]


def multipliers(
    field_: Field, functions: Sequence[Quotient], bounds: Mapping[int, Interval]
) -> Iterator[list[Quotient]]:
    """Proposals for m_i, polynomials in what occurs, with which ``sum m_i e_i > 1`` seems to be true."""
    zero = field_.const(0)
    used = sorted({k for e in functions for k in e.generators()})
    for degree in range(_DEGREE + 1):
        exponents = [e for e in product(range(degree + 1), repeat=len(used)) if sum(e) <= degree]
        if not functions or len(exponents) * len(functions) > _MOST_PRODUCTS:
            return
        monomials = [field_.polynomial(_monomial(field_, dict(zip(used, e, strict=True)))) for e in exponents]
        directions = [(m * e).numerator for e in functions for m in monomials]
        found = coefficients(field_, field_.const(-1).numerator, directions, bounds)
        if found is None:
            continue
        for denominator in _DENOMINATORS:
            rounded = [Fraction(2 * c).limit_denominator(denominator) for c in found]
            rows = [rounded[i : i + len(monomials)] for i in range(0, len(rounded), len(monomials))]
            yield [sum((m * field_.const(c) for c, m in zip(row, monomials, strict=True)), zero) for row in rows]


def _monomial(field_: Field, powers: Mapping[int, int]) -> fmpq_mpoly:
    return field_.context.from_dict({tuple(powers.get(k, 0) for k in range(len(field_.context.gens()))): fmpq(1)})
