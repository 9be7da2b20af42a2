"""Numbers, exact functions and derivatives, with one meaning for every operation of a formula.

A value is an exact rational, a ball that contains a real number, a :class:`Function`, or a :class:`Dual` over any of
these. What is unknown is a ball without bounds, or an exception: never a wrong value.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any

from flint import arb, fmpq, fmpq_mpoly, fmpq_mpoly_ctx, fmpz

from pbcgen.symbolic.plain.outcomes import NotCheckable, require

ODD = {"tanh", "atan", "asinh", "erf", "asin", "atanh", "erfinv"}
#: Functions that increase, and that are nowhere negative, where they are defined.
INCREASING, NONNEGATIVE = ODD | {"exp", "log", "sqrt"}, {"exp", "sqrt", "fabs"}
#: Functions that are analytic on the whole line; others may enter a proof only where they are, or the model has them.
_ENTIRE = {"exp", "sin", "cos", "tanh", "atan", "asinh", "erf"}
_OF_POSITIVE = {"log", "sqrt"}  # analytic where the argument is positive
BOUNDED = {"sin", "cos", "tanh", "erf"}
AT_ZERO = {"exp": 1, "cos": 1} | dict.fromkeys([*ODD, "sin", "sqrt", "fabs"], 0)
_FUNCTIONS = INCREASING | {"sin", "cos", "acos", "acosh"}
#: Functions that are constant but for their jumps.
_JUMPING = {"floor", "sign"}
#: Angles and exponents beyond this multiple of their unit are not expanded.
_MOST_MULTIPLES = 24
#: Polynomials with more terms than this are not factored.
_MOST_FACTORED = 60
#: Functions with more terms than this are not written out.
_MOST_TERMS = 5000


def times(a: Any, b: Any) -> Any:
    """The product; an exact zero in balls is the number zero, which leaves exact sums exact."""
    product = a * b
    return fmpq(0) if isinstance(product, arb) and product == 0 and product.is_exact() else product


def _reciprocal(a: Any) -> Any:
    """``1 / a``; of the number zero nothing is known."""
    return arb("nan") if isinstance(a, fmpq) and a == 0 else fmpq(1) / a


def _jumping(name: str) -> Callable[[Any], Any]:
    """``floor``, or the sign, which is the slope of the absolute value. Beside its jumps it is constant.

    Where it may jump, and at a jump, no derivative of any order is known, and of the value only that it is a number.
    """

    def function(a: Any) -> Any:
        if isinstance(a, Function):
            return a.function(name)
        if isinstance(plain(a), Function):
            return Dual(function(a.value), {})
        value, side = arb(plain(a)), sign(plain(a))
        low = value.floor().unique_fmpz() if name == "floor" else side
        if low is not None and (side if name == "sign" else low < value < low + 1):
            return fmpq(low)
        if isinstance(a, Dual):
            return Dual(function(a.value), dict.fromkeys(a.slope, a.value * arb("nan")))
        return arb(0, arb(2) ** 10**9) if name == "sign" else arb("nan")

    return function


_direction, _floor = _jumping("sign"), _jumping("floor")


def _is_positive(a: Any) -> Any:
    """1 for what is positive, else 0."""
    return (_direction(a) + _direction(a) * _direction(a)) / 2


def _whole(a: Any) -> Any:
    """The integer part."""
    return times(_floor(a), _is_positive(a)) - times(_floor(-a), _is_positive(-a))


def power(a: Any, b: Any) -> Any:
    """``a**b``: by products and a square root if 2b is an integer, else ``exp(b log(a))``."""
    b = b.value if isinstance(b, Dual) and not b.slope else b
    exponent = b.number() if isinstance(b, Function) else b
    if not isinstance(exponent, fmpq):
        return apply("exp", apply("log", a) * b)
    if exponent.q > 2:  # with a fraction below one, so that a**2.7 is a a**1.7
        whole = fmpq(int(exponent.p) // int(exponent.q))
        return power(a, whole) * apply("exp", apply("log", a) * (exponent - whole))
    base = a if exponent.q == 1 else apply("sqrt", a)
    result = prod([base] * abs(int(exponent.p)), start=fmpq(1))
    return 1 / result if exponent < 0 else result


_OPERATIONS: dict[str, Callable[..., Any]] = {
    "assign": lambda a: a,
    "assign_first": lambda a, _: a,
    "add": operator.add,
    "sub": operator.sub,
    "mul": times,
    "div": lambda a, b: times(a, _reciprocal(b)),
    "neg": operator.neg,
    "sq": lambda a: a * a,
    "fabs": lambda a: a.function("fabs") if isinstance(a, Value) else abs(a),
    "twice": lambda a: a + a,
    "inv": _reciprocal,
    "sign": _direction,
    "pow": power,
    "floor": _floor,
    "ceil": lambda a: -_floor(-a),
    "fmod": lambda a, b: a - times(b, _whole(times(a, _reciprocal(b)))),
    "remainder": lambda a, b: a - times(b, _floor(times(a, _reciprocal(b)) + fmpq(1, 2))),
    "lt": lambda a, b: _is_positive(b - a),
    "le": lambda a, b: 1 - _is_positive(a - b),
    "ne": lambda a, b: _direction(a - b) * _direction(a - b),
    "eq": lambda a, b: 1 - apply("ne", a, b),
    "not_": lambda a: 1 - a,
    "and_": times,
    "or_": lambda a, b: a + b - times(a, b),
    "if_else_zero": lambda a, b: fmpq(0) if isinstance(a, fmpq) and a == 0 else times(a, b),
    "copysign": lambda a, b: apply("fabs", a) * _direction(b),
    "fmin": lambda a, b: (a + b - apply("fabs", a - b)) / 2,
    "fmax": lambda a, b: (a + b + apply("fabs", a - b)) / 2,
    "hypot": lambda a, b: apply("sqrt", a * a + b * b),
    "atan2": lambda a, b: apply("atan", a / (apply("hypot", a, b) + b)) * 2,
    "expm1": lambda a: apply("exp", a) - 1,
    "log1p": lambda a: apply("log", a + 1),
    "tan": lambda a: apply("sin", a) / apply("cos", a),
    "sinh": lambda a: (apply("exp", a) - apply("exp", -a)) / 2,
    "cosh": lambda a: (apply("exp", a) + apply("exp", -a)) / 2,
}


class Grow(Exception):
    """A field needs more atoms, or finer units of an angle: start again with these settings."""


def apply(name: str, *values: Any) -> Any:
    """The operation ``name`` of a formula. Raises NotCheckable for one that has no meaning here."""
    if name in _OPERATIONS:
        return _OPERATIONS[name](*values)
    require(name in _FUNCTIONS, f"the operation {name} has no exact meaning", NotCheckable)
    (a,) = values
    if isinstance(a, Value):
        return a.function(name)
    known = _known(name, a)
    return getattr(arb, name)(arb(a)) if known is None else known


def _known(name: str, a: Any) -> fmpq | None:
    """The value of a function at a number, if that is known to be rational."""
    if a == 0 and name in AT_ZERO:
        return fmpq(AT_ZERO[name])
    if name == "log" and a == 1:
        return fmpq(0)
    if name in _JUMPING and a is not None:
        return fmpq(a.floor() if name == "floor" else sign(a))
    if name == "sqrt" and isinstance(a, fmpq) and a > 0:
        root = fmpq(fmpz(a.p).isqrt(), fmpz(a.q).isqrt())
        return root if root * root == a else None
    return None


#: The derivative of each function, from its argument a and its value v.
_SLOPES: dict[str, Callable[[Any, Any], Any]] = {
    "exp": lambda a, v: v,
    "log": lambda a, v: 1 / a,
    "sqrt": lambda a, v: 1 / (v + v),
    "sin": lambda a, v: apply("cos", a),
    "cos": lambda a, v: -apply("sin", a),
    "tanh": lambda a, v: 1 - v * v,
    "atan": lambda a, v: 1 / (a * a + 1),
    "asin": lambda a, v: 1 / apply("sqrt", 1 - a * a),
    "acos": lambda a, v: -1 / apply("sqrt", 1 - a * a),
    "asinh": lambda a, v: 1 / apply("sqrt", a * a + 1),
    "acosh": lambda a, v: 1 / apply("sqrt", a - 1) / apply("sqrt", a + 1),
    "atanh": lambda a, v: 1 / (1 - a * a),
    "erf": lambda a, v: apply("exp", -(a * a)) / apply("sqrt", apply("atan", a * 0 + 1)),
    "erfinv": lambda a, v: apply("exp", v * v) * apply("sqrt", apply("atan", v * 0 + 1)),
    "fabs": lambda a, v: _direction(a),
}


def never_negative(kind: str, a: Any, b: Any, alone: bool) -> Any:
    """``(T(a) - T(b)) (a - b)`` with T increasing, or ``|a| + a``; alone, T(a) or ``1 - T(a)^2``. Or None."""
    if kind == "fabs" and not alone:
        return apply(kind, a) + a
    if kind not in (NONNEGATIVE | BOUNDED if alone else INCREASING):
        return None
    value = apply(kind, a)
    if alone:
        return value if kind in NONNEGATIVE else 1 - value * value
    return (value - apply(kind, b)) * (a - b)


def sign(value: Any) -> int | None:
    """-1, 0 or 1 when the sign of a number is certain, else None."""
    if value > 0 or value < 0:
        return 1 if value > 0 else -1
    return 0 if value == 0 and (isinstance(value, fmpq) or value.is_exact()) else None


def between(lo: Any, hi: Any, t: Any) -> tuple[Any, Any]:
    """(a, b) with b > 0 and ``a / b`` between the ends, one of which may be None, as t runs through all t > 0."""
    return (t + lo if hi is None else hi - t if lo is None else t * hi + lo), (1 if None in (lo, hi) else t + 1)


class Value:
    """The operators that follow from sum, product, negation and inverse."""

    function: Callable[[str], Any]

    def __radd__(self: Any, other: Any) -> Any:
        return self + other

    def __rmul__(self: Any, other: Any) -> Any:
        return self * other

    def __sub__(self: Any, other: Any) -> Any:
        return self + -other

    def __rsub__(self: Any, other: Any) -> Any:
        return -self + other

    def __truediv__(self: Any, other: Any) -> Any:
        return self * (fmpq(1) / other)

    def __rtruediv__(self: Any, other: Any) -> Any:
        return self.inverse() * other


@dataclass(frozen=True, eq=False)
class Function(Value):
    """A quotient of polynomials in the symbols and atoms of a field, in lowest terms."""

    field: Field
    top: fmpq_mpoly
    bottom: fmpq_mpoly

    def __add__(self, other: Any) -> Function:
        b = self.field.lift(other)
        return self.field.quotient(self.top * b.bottom + b.top * self.bottom, self.bottom * b.bottom)

    def __neg__(self) -> Function:
        return Function(self.field, -self.top, self.bottom)

    def __mul__(self, other: Any) -> Function:
        b = self.field.lift(other)
        return self.field.quotient(self.top * b.top, self.bottom * b.bottom)

    def inverse(self) -> Function:
        """The reciprocal; the divisor is noted, for it must not be the zero function in disguise."""
        if not self.top.is_constant() and str(self.top) not in self.field.all_divisors:
            self.field.divisors[str(self.top)] = self.field.all_divisors[str(self.top)] = self.top
        return self.field.quotient(self.bottom, self.top)

    def function(self, name: str) -> Function:
        """The function ``name`` of this one."""
        return self.field.function(name, self)

    @cached_property
    def present(self) -> list[int]:
        """The generators that occur, those of symbols from zero, those of atoms from -1 downwards."""
        degrees = enumerate(zip(self.top.degrees(), self.bottom.degrees(), strict=True), -self.field.pool)
        return [k for k, both in degrees if max(both) > 0]

    @property
    def arguments(self) -> list[Function]:
        """The arguments of the atoms that occur."""
        return [[*self.field.atoms.values()][-1 - k] for k in self.present if k < 0]

    @cached_property
    def used(self) -> set[int]:
        """The symbols that occur, also inside of atoms."""
        return {k for k in self.present if k >= 0}.union(*(a.used for a in self.arguments))

    @cached_property
    def jumps(self) -> bool:
        """Whether a function that jumps occurs, also inside of atoms."""
        kinds = [kind for kind, _, _ in self.field.atoms]
        return any(kinds[-1 - k] in _JUMPING for k in self.present if k < 0) or any(a.jumps for a in self.arguments)

    def number(self) -> fmpq | None:
        """The value of a constant."""
        constant = self.top.is_constant() and self.bottom.is_constant()
        return None if not constant else self.top.leading_coefficient() if self.top else fmpq(0)


class Field:
    """Rational functions over Q of symbols and atoms such as exp(x1), with the atoms' algebraic relations.

    ``sin``, ``cos`` and ``exp`` of sums are expanded by their addition theorems; with ``whole`` angles are left as they
    are. What is zero here is the zero function; a function that is not zero here may still be, when its atoms are
    related in a way not known here.
    """

    def __init__(self, symbols: int, pool: int, units: dict[tuple[bool, str, str], fmpq] | None = None) -> None:
        self.pool, self.closed, self.units, self.whole = pool, False, units or {}, False
        self.ctx = fmpq_mpoly_ctx.get([f"a{k}" for k in range(pool)] + [f"v{k}" for k in range(symbols)], "lex")
        self.generators, self.one = self.ctx.gens(), self.ctx.constant(1)
        self.symbols = [Function(self, g, self.one) for g in self.generators[pool:]]
        self.atoms: dict[tuple[str, str, str], Function] = {}
        self.relations: list[fmpq_mpoly] = []
        self.logarithms: dict[str, fmpq_mpoly] = {}
        self.exponents: dict[str, Function] = {}
        self.divisors: dict[str, fmpq_mpoly] = {}
        self.all_divisors: dict[str, fmpq_mpoly] = {}
        self.nowhere_zero: set[str] = set()
        self.ends: dict[int, tuple[fmpq | None, fmpq | None]] = {}  # symbols stay between these, where signs are asked

    def lift(self, value: Any) -> Function:
        """A number as a function."""
        return value if isinstance(value, Function) else Function(self, self.ctx.constant(fmpq(value)), self.one)

    def quotient(self, top: fmpq_mpoly, bottom: fmpq_mpoly) -> Function:
        """``top / bottom`` with the relations applied, newest atom first. Raises ZeroDivisionError."""
        for relation in reversed(self.relations):
            top, bottom = top % relation, bottom % relation
        if bottom.is_zero():
            raise ZeroDivisionError("division by the zero function")
        require(len(top) + len(bottom) <= _MOST_TERMS, "the functions are too large to be written out", NotCheckable)
        common = bottom if top.is_zero() or bottom.is_constant() else top.gcd(bottom)
        scale = (bottom / common).leading_coefficient()
        return Function(self, top / common / scale, bottom / common / scale)

    def atom(self, kind: str, a: Function) -> Function:
        """The indeterminate for ``kind(a)``; a new one is larger than all before, so that relations reduce it."""
        key = (kind, str(a.top), str(a.bottom))
        if key not in self.atoms:
            known = not self.closed or kind in _ENTIRE or (kind in _OF_POSITIVE and self.positive(a))
            require(known, f"{kind} occurs in a proof but not in the model", NotCheckable)
            modulus = self.atom("fabs", a) if kind == "sign" else self.lift(0)
            if len(self.atoms) == self.pool:
                raise Grow(2 * self.pool, self.units)
            self.atoms[key] = a
            new = self.generators[self.pool - len(self.atoms)]
            if kind in ("sqrt", "fabs") and a.bottom.is_constant():
                self.relations.append(new * new - a.top ** (2 if kind == "fabs" else 1))
            if kind == "sin":
                self.relations.append(new * new + self.atom("cos", a).top ** 2 - 1)
            if kind == "sign":  # times a it is |a|; its square is not one where a = 0
                self.relations += [new * a.top - modulus.top * a.bottom, new * modulus.top * a.bottom - a.top]
            if kind == "exp":
                self.exponents[str(new)] = a
            if kind == "log" and a.bottom.is_constant():
                self.logarithms[str(new)] = a.top
            c = a.top.leading_coefficient() if kind == "exp" else fmpq(0)
            if c > 0 and max(c.p, c.q) <= _MOST_MULTIPLES and str(a.top / c) in self.logarithms:
                self.relations.append(new ** int(c.q) - self.logarithms[str(a.top / c)] ** int(c.p))
        return Function(self, self.generators[self.pool - 1 - list(self.atoms).index(key)], self.one)

    def function(self, name: str, a: Function) -> Function:
        """``name(a)`` in terms of atoms."""
        if name in ("sin", "cos"):
            return self._angle(a)[name == "cos"]
        if name == "exp":
            return prod((power(self.atom("exp", u), fmpq(k)) for u, k in self._multiples(a, False)), start=self.lift(1))
        if (known := _known(name, a.number())) is not None:
            return self.lift(known)
        if name == "log" and len(a.top) == 1 and a.top.leading_coefficient() == a.bottom == 1:
            degrees = zip(self.generators, map(int, a.top.degrees()), strict=True)
            powers = [(self.exponents.get(str(g)), d) for g, d in degrees if d]
            if all(e for e, _ in powers):
                return sum((e * d for e, d in powers if e), self.lift(0))
        if name in ("fabs", "sign"):
            scale = a.top.leading_coefficient()
            return self.lift(abs(scale) if name == "fabs" else sign(scale)) * self.atom(name, a * (1 / scale))
        negative = name in ODD and a.top.leading_coefficient() < 0
        return -self.atom(name, -a) if negative else self.atom(name, a)

    def _multiples(self, a: Function, angle: bool) -> list[tuple[Function, int]]:
        """The argument as a sum of integer multiples of units, one unit for each monomial."""
        if angle and self.whole and a.top:
            return [(-a, -1) if a.top.leading_coefficient() < 0 else (a, 1)]
        parts = []
        for exponents, coefficient in sorted(a.top.to_dict().items()):
            monomial = self.ctx.from_dict({exponents: 1})
            key = (angle, str(monomial), str(a.bottom))
            unit = self.units.setdefault(key, abs(coefficient))
            if (coefficient / unit).q != 1:
                self.units[key] = unit / (coefficient / unit).q
                raise Grow(self.pool, self.units)
            unit = unit if abs(coefficient / unit) <= _MOST_MULTIPLES else abs(coefficient)
            parts.append((self.quotient(monomial * unit, a.bottom), int((coefficient / unit).p)))
        return parts

    def _angle(self, a: Function) -> tuple[Function, Function]:
        sine, cosine = self.lift(0), self.lift(1)
        for unit, count in self._multiples(a, True):
            c, s = self.atom("cos", unit), self.atom("sin", unit) * (1 if count > 0 else -1)
            for _ in range(abs(count)):
                sine, cosine = sine * c + cosine * s, cosine * c - sine * s
        return sine, cosine

    def bounded(self, a: Function) -> bool:
        """Whether only atoms with values in [-1, 1] occur."""
        return bool(self.bound(a, {})[1] < arb("inf"))

    def bound(self, a: Function, ends: Mapping[int, fmpq]) -> tuple[fmpq, Any]:
        """(c, r) with ``abs(a - c) <= r`` where symbols are at most their ends, from atoms with values in [-1, 1]."""
        inner = [fmpq(1) if self._kind(k) in BOUNDED else arb("inf") for k in range(self.pool)]
        size = inner + [ends.get(k, arb("inf")) for k in range(len(self.symbols))]
        terms = a.top.to_dict().items()
        centre = sum((c for e, c in terms if not any(e)), fmpq(0))
        sizes = (prod((s ** int(d) for s, d in zip(size, e, strict=True) if d), start=abs(c)) for e, c in terms)
        return centre, sum(sizes, -abs(centre)) if a.bottom.is_constant() else arb("inf")

    def within(self, k: int, t: fmpq) -> fmpq:
        """A value of symbol k, between its ends if it has any."""
        return operator.truediv(*between(*self.ends[k], abs(t))) if k in self.ends else t

    def everywhere(self, a: fmpq_mpoly) -> int:
        """1 or -1 when the polynomial certainly has this sign everywhere between the ends of its symbols, else 0.

        Outside of atoms these are written by numbers that are positive.
        """
        for k, ends in self.ends.items():
            place, total = self.pool + k, self.one * 0
            degree, (top, bottom) = int(a.degrees()[place]), between(*ends, self.generators[place])
            for exponents, c in a.to_dict().items():
                others, d = tuple(0 if j == place else e for j, e in enumerate(exponents)), int(exponents[place])
                total += self.ctx.from_dict({others: c}) * (self.one * top) ** d * (self.one * bottom) ** (degree - d)
            a = total
        return self._signed(a)

    def _signed(self, a: fmpq_mpoly) -> int:
        """1 or -1 when the polynomial certainly has this sign everywhere, else 0.

        A number is evaluated. Terms that are nowhere negative count as zero or, when they have only exponentials and
        roots of what is positive, as positive; the others must be bounded, and together smaller than the constant.
        """
        if (known := sign(self.at(a, [arb("nan")] * len(self.symbols)))) is not None:
            return known
        for side in (1, -1):
            left, strict, certain = fmpq(0), False, True
            for exponents, coefficient in (a * side).to_dict().items():
                used = [k for k, e in enumerate(exponents) if e]
                present = [(self._kind(k), exponents[k] % 2) for k in used]
                if not present:
                    left += coefficient
                elif coefficient < 0 or any(odd and kind not in NONNEGATIVE for kind, odd in present):
                    left -= abs(coefficient)
                    certain = certain and all(kind in BOUNDED for kind, _ in present)
                else:
                    strict = strict or all(self._above_zero(k) for k in used)
            if certain and (left > 0 or (left == 0 and strict)):
                return side
        if len(a) > _MOST_FACTORED:
            return 0
        for k in (k for k, degree in enumerate(a.degrees()) if degree == 2):  # complete the square
            slope, bend = a.derivative(k), a.derivative(k).derivative(k)
            if (side := self._signed(bend)) and self._signed(2 * bend * a - slope * slope) == 1:
                return side
            break
        content, factors = a.factor() if len(a) > 1 else (0, [])
        if not factors or factors[0][0].total_degree() == a.total_degree():
            return 0
        signs = [self._signed(factor) ** int(times) for factor, times in factors]
        return int(prod(signs, start=1 if content > 0 else -1))

    def positive(self, a: Function) -> bool:
        """Whether a function is certainly positive everywhere."""
        return self.everywhere(a.top) * self.everywhere(a.bottom) == 1

    def has_poles(self, a: Function) -> bool:
        """Whether a divisor in a function, or in the arguments of its atoms, may be zero somewhere."""
        return not self.everywhere(a.bottom) or any(map(self.has_poles, a.arguments))

    def continued(self, functions: list[Function]) -> list[Function]:
        """Functions and derivatives that are continuous wherever they are defined. Raises NotCheckable."""
        jumps = any(kind in _JUMPING for kind, _, _ in self.atoms) and any(a.jumps for a in functions)
        require(not jumps, "a function or its derivative may jump", NotCheckable)
        return functions

    def entire(self, moduli: bool = False) -> bool:
        """Whether everything computed so far is certainly defined and smooth at every state, apart from ``moduli``.

        Their derivatives are functions that jump, of which nothing may be left: see :meth:`continued`.
        """
        known = _ENTIRE | {"fabs", "sign"} if moduli else _ENTIRE
        atoms = [(kind, a) for (kind, _, _), a in self.atoms.items()]
        smooth = all(kind in known or (kind in _OF_POSITIVE and self.positive(a)) for kind, a in atoms)
        unsure = [divisor for key, divisor in self.all_divisors.items() if key not in self.nowhere_zero]
        return smooth and all(self.everywhere(divisor) for divisor in unsure)

    def _above_zero(self, k: int) -> bool:
        """Whether generator k is an exponential, or the root of a function that is positive everywhere."""
        kind = self._kind(k)
        return kind == "exp" or (kind == "sqrt" and self.positive([*self.atoms.values()][self.pool - 1 - k]))

    def _kind(self, k: int) -> str:
        if k - self.pool in self.ends:  # written by a positive number
            return "exp"
        number = self.pool - 1 - k
        return [*self.atoms][number][0] if 0 <= number < len(self.atoms) else ""

    def at(self, polynomial: fmpq_mpoly, point: Sequence[Any]) -> Any:
        """The value of a polynomial in symbols and atoms at numbers for the symbols."""
        values: dict[int, Any] = {self.pool + k: value for k, value in enumerate(point)}
        atoms = dict(zip(range(self.pool - 1, -1, -1), self.atoms.items(), strict=False))
        # Beside functions of states exp(1) is one of these, and no ball.
        zero = next((value * fmpq(0) for value in point if isinstance(plain(value), Function)), fmpq(0))

        def generator(k: int) -> Any:
            if k not in values:
                (kind, _, _), a = atoms[k]
                values[k] = apply(kind, total(a.top) / total(a.bottom) + zero)
            return values[k]

        def total(p: fmpq_mpoly) -> Any:
            terms = p.to_dict().items()
            parts = (prod((power(generator(k), fmpq(e)) for k, e in enumerate(es) if e), start=c) for es, c in terms)
            return sum(parts, fmpq(0))

        return total(polynomial)


@dataclass(frozen=True, eq=False)
class Dual(Value):
    """A value with its partial derivatives by variable; a missing one is zero. Second derivatives: duals of duals."""

    value: Any
    slope: dict[int, Any]

    def _joined(self, other: Any, value: Any, left: Any, right: Any) -> Dual:
        """The result ``value`` of two operands, whose partial derivatives by the operands are left and right."""
        slope = {k: times(left, d) for k, d in self.slope.items()}
        for k, d in other.slope.items() if isinstance(other, Dual) else ():
            slope[k] = slope[k] + times(right, d) if k in slope else times(right, d)
        return Dual(value, slope)

    def _through(self, value: Any, factor: Any) -> Dual:
        return Dual(value, {k: times(factor, d) for k, d in self.slope.items()})

    def __add__(self, other: Any) -> Dual:
        return self._joined(other, self.value + _inside(other), 1, 1)

    def __mul__(self, other: Any) -> Dual:
        return self._joined(other, times(self.value, _inside(other)), _inside(other), self.value)

    def __neg__(self) -> Dual:
        return self._through(-self.value, -1)

    def inverse(self) -> Dual:
        """The reciprocal."""
        value = _reciprocal(self.value)
        return self._through(value, -(value * value))

    def function(self, name: str) -> Dual:
        """The function ``name`` of this value."""
        require(name in _SLOPES, f"the derivative of {name} has no exact meaning", NotCheckable)
        value = apply(name, self.value)
        return self._through(value, _SLOPES[name](self.value, value))


def _inside(value: Any) -> Any:
    return value.value if isinstance(value, Dual) else value


def plain(value: Any) -> Any:
    """A value without its derivatives."""
    while isinstance(value, Dual):
        value = value.value
    return value


def variables(values: Sequence[Any], order: int = 1) -> list[Any]:
    """The values as independent variables for derivatives up to ``order``."""
    duals = list(values)
    for _ in range(order):
        duals = [Dual(value, {k: fmpq(1)}) for k, value in enumerate(duals)]
    return duals


def partial(value: Any, k: int) -> Any:
    """The derivative of a dual by variable k; zero for what depends on no variable."""
    return value.slope.get(k, fmpq(0)) if isinstance(value, Dual) else fmpq(0)
