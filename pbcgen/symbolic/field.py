"""Exact rational functions over Q whose indeterminates are symbols and transcendental atoms.

``sin``, ``cos`` and ``exp`` of sums are expanded by the addition theorems into atoms of single monomials, so that
identities such as cos(a+b) = cos a cos b - sin a sin b or exp(2a) = exp(a)^2 hold by construction, and
sin^2 = 1 - cos^2 is a rewriting rule. Every other function gives an atom of its own, identified by its exact
argument. A result that is the zero function here is zero; a result that is not may still be zero, because atoms are
treated as independent: this decides identities in one direction only.

fabs(a) is an atom s with ``s^2 = a^2``, and its derivative sign(a) is ``s / a``, so that ``(v |v|)' = 2 |v|``. Where
sign was not to be read, which is the default, it is an error: a function with jumps is none of this field. Where it
was, the caller must see that a result is continuous before using its values where a = 0: its denominator vanishes
nowhere then, and it is the derivative there too, because a Lipschitz function whose derivative, where it has one,
continues continuously has that derivative everywhere. With such atoms there are functions that vanish on regions, as
v + |v| does; nothing is divided by these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import gcd

from flint import fmpq, fmpq_mpoly, fmpq_mpoly_ctx

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.real import fraction, rational

#: Multiples of an angle or exponent beyond this are kept as separate atoms instead of being expanded.
_LARGEST_MULTIPLE = 24

#: The work of rewriting a term by a relation between atoms, in terms that are multiplied.
_TERMS_PER_REDUCTION = 8

#: Functions with as many moduli are taken to vanish on a region.
_MOST_MODULI = 7


class TooLarge(UnsupportedOperation):
    """The exact functions grow beyond the budget: nothing is known of the result."""


class Restart(Exception):
    """The field was set up too small; walk again with the corrected settings."""


@dataclass(frozen=True)
class Atom:
    """An indeterminate that stands for ``kind(argument)``."""

    kind: str
    argument: Quotient


@dataclass(frozen=True, eq=False)
class Quotient:
    """A rational function ``numerator / denominator`` of a :class:`Field`, in lowest terms."""

    field: Field
    numerator: fmpq_mpoly
    denominator: fmpq_mpoly

    def __add__(self, other: Quotient) -> Quotient:
        if self.denominator == other.denominator:
            self.field.charge(min(len(self.numerator), len(other.numerator)))  # copying the longer one costs little
            return self.field.quotient(self.numerator + other.numerator, self.denominator)
        self.field.charge(len(self.numerator) * len(other.denominator) + len(self.denominator) * len(other.numerator))
        return self.field.quotient(
            self.numerator * other.denominator + other.numerator * self.denominator,
            self.denominator * other.denominator,
        )

    def __sub__(self, other: Quotient) -> Quotient:
        return self + (-other)

    def __neg__(self) -> Quotient:
        return Quotient(self.field, -self.numerator, self.denominator)

    def __mul__(self, other: Quotient) -> Quotient:
        self.field.charge(len(self.numerator) * len(other.numerator) + len(self.denominator) * len(other.denominator))
        return self.field.quotient(self.numerator * other.numerator, self.denominator * other.denominator)

    def __truediv__(self, other: Quotient) -> Quotient:
        if other.is_zero():
            raise ZeroDivisionError("division by the zero function")
        self.field.charge(len(self.numerator) * len(other.denominator) + len(self.denominator) * len(other.numerator))
        return self.field.quotient(self.numerator * other.denominator, self.denominator * other.numerator)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Quotient) and (self - other).is_zero()

    def __hash__(self) -> int:
        return hash((str(self.numerator), str(self.denominator)))

    def is_zero(self) -> bool:
        """Whether this is the zero function (a certain yes; a no is not certain when atoms are related)."""
        return bool(self.numerator.is_zero())

    def constant(self) -> fmpq | None:
        """The value when the function is a rational number, else None."""
        if self.numerator.is_constant() and self.denominator.is_constant():
            return (
                self.numerator.leading_coefficient() / self.denominator.leading_coefficient()
                if not self.numerator.is_zero()
                else fmpq(0)
            )
        return None

    def is_polynomial(self) -> bool:
        """Whether the denominator is a number."""
        return bool(self.denominator.is_constant())

    def generators(self) -> set[int]:
        """The positions of the indeterminates that occur directly."""
        degrees = [self.numerator.degrees(), self.denominator.degrees()]
        return {k for row in degrees for k, degree in enumerate(row) if degree > 0}

    def symbols(self) -> set[int]:
        """The positions of the symbols that occur, directly or inside an atom."""
        found = set()
        for k in self.generators():
            if k < self.field.symbol_count:
                found.add(k)
            else:
                found |= self.field.atoms[k].argument.symbols()
        return found


class Field:
    """The field Q(symbols, atoms) and the SX operations over it (an Algebra of the tape).

    Args:
        names: the symbols.
        pool: how many atoms may appear.
        scales: for each (kind, monomial) the rational unit of which all its multiples are integers.
        signs: whether sign(a) has a meaning.
    """

    title = "exact algebra"

    def __init__(
        self,
        names: Sequence[str],
        pool: int = 0,
        scales: dict[tuple[str, str], Fraction] | None = None,
        signs: bool = False,
    ) -> None:
        self.names = tuple(names)
        self.signs = signs
        self.symbol_count = len(self.names)
        self.pool = pool
        self.scales = {} if scales is None else scales
        generators = [f"v{k}" for k in range(self.symbol_count)] + [f"a{k}" for k in range(pool)]
        self.context = fmpq_mpoly_ctx.get(generators or ["v"], "degrevlex")
        self._generators = self.context.gens()
        self._one = self.context.constant(1)
        self.atoms: dict[int, Atom] = {}
        self._atom_of: dict[tuple[str, str], int] = {}
        self._squares: dict[int, fmpq_mpoly] = {}
        self.moduli: set[int] = set()
        self.divisors: dict[str, Quotient] = {}
        self.spent = 0
        self.limit: int | None = None

    def charge(self, terms: int) -> None:
        """Count the terms of an operation before it is done. Raises TooLarge beyond the limit."""
        self.spent += terms
        if self.limit is not None and self.spent > self.limit:
            raise TooLarge("the exact functions of the model grow too large to be expanded")

    # --- elements -----------------------------------------------------------------------------------------

    def const(self, value: Fraction | int) -> Quotient:
        """A rational number."""
        return Quotient(self, self.context.constant(rational(value)), self._one)

    def symbol(self, k: int) -> Quotient:
        """Symbol number k."""
        return Quotient(self, self._generators[k], self._one)

    def polynomial(self, numerator: fmpq_mpoly) -> Quotient:
        """A polynomial of this field's context as an element."""
        return self.quotient(numerator, self._one)

    def quotient(self, numerator: fmpq_mpoly, denominator: fmpq_mpoly) -> Quotient:
        """The fraction in lowest terms, with the relations between atoms applied."""
        numerator = self.reduced(numerator)
        denominator = self.reduced(denominator)
        if denominator.is_zero():
            raise ZeroDivisionError("division by the zero function")
        if numerator.is_zero():
            return Quotient(self, numerator, self._one)
        if denominator.is_constant():
            return Quotient(self, numerator / denominator.leading_coefficient(), self._one)
        if self.moduli and self._vanishes_on_region(denominator):
            raise UnsupportedOperation("the model divides by a function that vanishes on a region")
        common = numerator.gcd(denominator)
        if not common.is_constant():
            numerator, denominator = numerator / common, denominator / common
        scale = denominator.leading_coefficient()
        return Quotient(self, numerator / scale, denominator / scale)

    def _vanishes_on_region(self, polynomial: fmpq_mpoly) -> bool:
        """Whether a polynomial, as v + |v| does, may vanish on a region.

        It does where its product with itself for the other sign of a modulus does, which is free of that modulus; a
        modulus inside of another one comes before it.
        """
        norm = polynomial
        for _ in range(_MOST_MODULI):
            degrees = norm.degrees()
            inside = [k for k in self.moduli if degrees[k]]
            if not inside:
                return bool(norm.is_zero())
            last = max(inside)
            flipped = [-g if k == last else g for k, g in enumerate(self._generators)]
            norm = self.reduced(norm * norm.compose(*flipped, ctx=self.context))
        return True

    def reduced(self, polynomial: fmpq_mpoly) -> fmpq_mpoly:
        """The polynomial with the relations between atoms applied."""
        if not self._squares:
            return polynomial
        degrees = polynomial.degrees()
        for generator, square in self._squares.items():
            while degrees[generator] > 1:
                polynomial = self._lower_degree(polynomial, generator, square)
                degrees = polynomial.degrees()
        return polynomial

    def _lower_degree(self, polynomial: fmpq_mpoly, generator: int, square: fmpq_mpoly) -> fmpq_mpoly:
        self.charge(_TERMS_PER_REDUCTION * len(polynomial))
        kept: dict[tuple[int, ...], fmpq] = {}
        by_half: dict[int, dict[tuple[int, ...], fmpq]] = {}
        for exponents, coefficient in polynomial.to_dict().items():
            half, odd = divmod(int(exponents[generator]), 2)
            if half:
                rest = (*exponents[:generator], odd, *exponents[generator + 1 :])
                by_half.setdefault(half, {})[rest] = coefficient
            else:
                kept[exponents] = coefficient
        total = self.context.from_dict(kept)
        for half, rest_terms in by_half.items():
            total += self.context.from_dict(rest_terms) * square**half
        return total

    # --- atoms --------------------------------------------------------------------------------------------

    def _atom(self, kind: str, argument: Quotient) -> fmpq_mpoly:
        key = (kind, f"{argument.numerator}|{argument.denominator}")
        if key not in self._atom_of:
            position = self.symbol_count + len(self._atom_of)
            if len(self._atom_of) >= self.pool:
                self.pool = 2 * self.pool + 4
                raise Restart
            self._atom_of[key] = position
            self.atoms[position] = Atom(kind, argument)
        return self._generators[self._atom_of[key]]

    def _generic(self, kind: str, argument: Quotient, at_zero: int | None) -> Quotient:
        if argument.is_zero() and at_zero is not None:
            return self.const(at_zero)
        return self.polynomial(self._atom(kind, argument))

    def _multiples(self, kind: str, argument: Quotient) -> list[tuple[Quotient, int]]:
        """The argument as a sum of integer multiples of units, one unit for each monomial of the numerator."""
        parts = []
        for exponents, coefficient in sorted(argument.numerator.to_dict().items()):
            monomial = self.context.from_dict({exponents: fmpq(1)})
            key = (kind, f"{monomial}|{argument.denominator}")
            value = fraction(coefficient)
            unit = self.scales.setdefault(key, abs(value))
            if (value / unit).denominator != 1:
                self.scales[key] = Fraction(
                    gcd(unit.numerator * value.denominator, value.numerator * unit.denominator),
                    unit.denominator * value.denominator,
                )
                raise Restart
            multiple = int(value / unit)
            if abs(multiple) > _LARGEST_MULTIPLE:
                unit, multiple = abs(value), 1 if value > 0 else -1
            parts.append((self.quotient(monomial * rational(unit), argument.denominator), multiple))
        return parts

    def _cos_sin(self, argument: Quotient) -> tuple[Quotient, Quotient]:
        cosine, sine = self.const(1), self.const(0)
        for unit, multiple in self._multiples("angle", argument):
            c_atom, s_atom = self._atom("cos", unit), self._atom("sin", unit)
            s_position = self._atom_of[("sin", f"{unit.numerator}|{unit.denominator}")]
            self._squares[s_position] = self._one - c_atom * c_atom
            c, s = self.polynomial(c_atom), self.polynomial(s_atom)
            if multiple < 0:
                s = -s
            for _ in range(abs(multiple)):
                cosine, sine = cosine * c - sine * s, sine * c + cosine * s
        return cosine, sine

    # --- the SX operations --------------------------------------------------------------------------------

    def assign(self, a: Quotient) -> Quotient:
        return a

    def assign_first(self, a: Quotient, _: Quotient) -> Quotient:
        return a

    def add(self, a: Quotient, b: Quotient) -> Quotient:
        return a + b

    def sub(self, a: Quotient, b: Quotient) -> Quotient:
        return a - b

    def mul(self, a: Quotient, b: Quotient) -> Quotient:
        return a * b

    def div(self, a: Quotient, b: Quotient) -> Quotient:
        if b.constant() is None:
            self.divisors.setdefault(f"{b.numerator}", self.polynomial(b.numerator))
        return a / b

    def neg(self, a: Quotient) -> Quotient:
        return -a

    def twice(self, a: Quotient) -> Quotient:
        return a + a

    def sq(self, a: Quotient) -> Quotient:
        return a * a

    def inv(self, a: Quotient) -> Quotient:
        return self.div(self.const(1), a)

    def pow(self, a: Quotient, b: Quotient) -> Quotient:
        exponent = b.constant()
        if exponent is None:
            return self.exp(b * self.log(a))
        if exponent.q == 2:
            return self.pow(self.sqrt(a), self.const(int(exponent.p)))
        if exponent.q != 1:
            return self.exp(b * self.log(a))
        result = self.const(1)
        for _ in range(abs(int(exponent.p))):
            result = result * a
        return self.inv(result) if exponent.p < 0 else result

    def sqrt(self, a: Quotient) -> Quotient:
        if a.is_zero():
            return a
        root = self._generic("sqrt", a, 0)
        if a.is_polynomial():
            self._squares[root.generators().pop()] = a.numerator
        return root

    def hypot(self, a: Quotient, b: Quotient) -> Quotient:
        return self.sqrt(a * a + b * b)

    def fabs(self, a: Quotient) -> Quotient:
        """|a|, of which positive factors that are numbers are taken out."""
        value = a.constant()
        if value is not None:
            return self.const(abs(fraction(value)))
        if not a.is_polynomial():
            top, bottom = self.polynomial(a.numerator), self.polynomial(a.denominator)
            return self.fabs(top) / self.fabs(bottom)
        factor = a.numerator.leading_coefficient()
        argument = self.polynomial(a.numerator / factor)
        modulus = self._generic("fabs", argument, 0)
        position = modulus.generators().pop()
        self.moduli.add(position)
        self._squares[position] = argument.numerator * argument.numerator
        return modulus * self.const(abs(fraction(factor)))

    def sign(self, a: Quotient) -> Quotient:
        """|a| / a, where that is asked for."""
        if not self.signs:
            raise UnsupportedOperation("the operation `sign` has no meaning in exact algebra")
        return a if a.is_zero() else self.fabs(a) / a

    def exp(self, a: Quotient) -> Quotient:
        result = self.const(1)
        for unit, multiple in self._multiples("exponent", a):
            factor = self._exp_of_unit(unit)
            for _ in range(abs(multiple)):
                result = result * factor if multiple > 0 else result / factor
        return result

    def _exp_of_unit(self, unit: Quotient) -> Quotient:
        for position in unit.generators():
            atom = self.atoms.get(position)
            if atom and atom.kind == "log" and (unit - self.symbol(position)).is_zero():
                return atom.argument
        return self.polynomial(self._atom("exp", unit))

    def expm1(self, a: Quotient) -> Quotient:
        return self.exp(a) - self.const(1)

    def log(self, a: Quotient) -> Quotient:
        if (a - self.const(1)).is_zero():
            return self.const(0)
        exponent = self._exponent(a)
        return self._generic("log", a, None) if exponent is None else exponent

    def _exponent(self, a: Quotient) -> Quotient | None:
        """b, for a product of powers of exponentials that is exp(b)."""
        total = self.const(0)
        for side, part in ((1, a.numerator), (-1, a.denominator)):
            terms = part.to_dict()
            if len(terms) != 1 or 1 not in terms.values():
                return None
            ((powers, _),) = terms.items()
            for k, power in enumerate(powers):
                if power and (k not in self.atoms or self.atoms[k].kind != "exp"):
                    return None
                if power:
                    total = total + self.atoms[k].argument * self.const(side * int(power))
        return total

    def log1p(self, a: Quotient) -> Quotient:
        return self.log(self.const(1) + a)

    def sin(self, a: Quotient) -> Quotient:
        return self._cos_sin(a)[1]

    def cos(self, a: Quotient) -> Quotient:
        return self._cos_sin(a)[0]

    def tan(self, a: Quotient) -> Quotient:
        cosine, sine = self._cos_sin(a)
        return self.div(sine, cosine)

    def sinh(self, a: Quotient) -> Quotient:
        e = self.exp(a)
        return (e - self.const(1) / e) * self.const(Fraction(1, 2))

    def cosh(self, a: Quotient) -> Quotient:
        e = self.exp(a)
        return (e + self.const(1) / e) * self.const(Fraction(1, 2))

    def _odd(self, kind: str, a: Quotient) -> Quotient:
        if a.is_zero():
            return a
        if a.numerator.leading_coefficient() < 0:
            return -self._generic(kind, -a, 0)
        return self._generic(kind, a, 0)

    def tanh(self, a: Quotient) -> Quotient:
        return self._odd("tanh", a)

    def atan(self, a: Quotient) -> Quotient:
        return self._odd("atan", a)

    def asin(self, a: Quotient) -> Quotient:
        return self._odd("asin", a)

    def acos(self, a: Quotient) -> Quotient:
        return self._generic("acos", a, None)

    def asinh(self, a: Quotient) -> Quotient:
        return self._odd("asinh", a)

    def acosh(self, a: Quotient) -> Quotient:
        return self._generic("acosh", a, None)

    def atanh(self, a: Quotient) -> Quotient:
        return self._odd("atanh", a)

    def erf(self, a: Quotient) -> Quotient:
        return self._odd("erf", a)
