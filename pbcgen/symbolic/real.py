"""Real numbers that are either exact rationals or enclosures (balls), and the tape's meaning over them.

A number stays an exact ``fmpq`` as long as the operations allow it and becomes an ``arb`` ball otherwise, so a value
that touches a limit exactly is recognised as touching it. A ball always contains the true value. An operation that
is undefined or discontinuous at its operand gives a ball that is not finite, never a wrong value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from functools import wraps
from typing import ParamSpec, TypeAlias, TypeVar

from flint import acb, acb_mat, arb, ctx, fmpq, fmpz

Real: TypeAlias = fmpq | arb

ZERO = fmpq(0)
ONE = fmpq(1)

#: Bits of the enclosures at x*: about 100 decimal digits.
BITS = 333

P = ParamSpec("P")
T = TypeVar("T")


@contextmanager
def precision(bits: int) -> Iterator[None]:
    """Work with balls of ``bits`` bits inside the block."""
    before = ctx.prec
    ctx.prec = bits
    try:
        yield
    finally:
        ctx.prec = before


def in_high_precision(function: Callable[P, T]) -> Callable[P, T]:
    """Let a function work with balls of at least BITS bits, whatever the caller's precision."""

    @wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        with precision(max(ctx.prec, BITS)):
            return function(*args, **kwargs)

    return wrapped


def rational(value: Fraction | int) -> fmpq:
    """A Fraction as an exact number."""
    return fmpq(value.numerator, value.denominator)


def fraction(value: fmpq) -> Fraction:
    """An exact number as a Fraction."""
    return Fraction(int(value.p), int(value.q))


def ball(value: Real) -> arb:
    """The number as a ball of the current precision."""
    return value if isinstance(value, arb) else arb(value)


def undefined() -> arb:
    """The enclosure of a value about which nothing is known."""
    return arb.nan()


def is_finite(value: Real) -> bool:
    """Whether the enclosure bounds the value."""
    return not isinstance(value, arb) or value.is_finite()


def sign(value: Real) -> int | None:
    """-1, 0 or 1 when the sign is certain, else None."""
    if isinstance(value, arb):
        if value > 0:
            return 1
        if value < 0:
            return -1
        return 0 if value.is_exact() and value == 0 else None
    return int(value > 0) - int(value < 0)


def midpoint(value: Real) -> Fraction:
    """A rational inside the enclosure (ValueError if it is not finite)."""
    if not isinstance(value, arb):
        return fraction(value)
    if not value.is_finite():
        raise ValueError("the enclosure is not finite")
    mantissa, exponent = value.mid().man_exp()
    return _dyadic(int(mantissa), int(exponent))


def _dyadic(mantissa: int, exponent: int) -> Fraction:
    """``mantissa * 2**exponent`` (OverflowError when it would fill the memory)."""
    if abs(exponent) > 10**6:
        raise OverflowError("a number beyond 2**(10**6) occurred")
    return Fraction(mantissa) * Fraction(2) ** exponent


def lower(value: Real) -> Fraction:
    """A rational lower bound."""
    return midpoint(value) - radius(value)


def upper(value: Real) -> Fraction:
    """A rational upper bound."""
    return midpoint(value) + radius(value)


def radius(value: Real) -> Fraction:
    """A rational bound of the distance between the value and :func:`midpoint`; zero for exact numbers."""
    if not isinstance(value, arb):
        return Fraction(0)
    mantissa, exponent = value.rad().man_exp()
    return _dyadic(int(mantissa), int(exponent))


def enclose(lo: Fraction, hi: Fraction) -> arb:
    """A ball that contains [lo, hi]."""
    return arb(rational(lo)).union(arb(rational(hi)))


def approximate(value: Real) -> float:
    """The nearest double to the midpoint; infinite beyond the range of doubles, NaN if nothing is known."""
    if not is_finite(value):
        return float("nan")
    if isinstance(value, arb):
        return float(value.mid())
    if value == 0:
        return 0.0
    try:
        return float(fraction(value))
    except OverflowError:
        return float("inf") * (1 if value > 0 else -1)


def text(value: Real, digits: int = 12) -> str:
    """The number for a human reader: exact if it is short, as a decimal or as p/q; else rounded."""
    if isinstance(value, arb):
        return f"{approximate(value) or 0.0:.{digits}g}" if value.is_finite() else "undefined"
    shown = f"{float(fraction(value)):.{digits}g}"
    return shown if Fraction(shown) == fraction(value) or len(str(value)) > max(digits, 7) else str(value)


def _monotone(function: Callable[[arb], arb], value: Real) -> arb:
    """An increasing function of an enclosure, from its endpoints: tight for wide balls."""
    argument = ball(value)
    if not argument.is_finite():
        return undefined()
    if argument.is_exact() or argument.rel_accuracy_bits() > ctx.prec // 2:
        return function(argument)
    return function(argument.lower()).union(function(argument.upper()))


class RealAlgebra:
    """The SX operations over exact rationals and balls (an :class:`~pbcgen.symbolic.tape.Algebra`).

    Discontinuous operations give an undefined enclosure at their jump, so a derivative taken there is never trusted.
    """

    title = "ball arithmetic"

    def const(self, value: Fraction) -> Real:
        return rational(value)

    def assign(self, a: Real) -> Real:
        return a

    def assign_first(self, a: Real, _: Real) -> Real:
        return a

    def add(self, a: Real, b: Real) -> Real:
        return a + b

    def sub(self, a: Real, b: Real) -> Real:
        return a - b

    def mul(self, a: Real, b: Real) -> Real:
        if a is b:
            return self.sq(a)
        if (isinstance(a, fmpq) and a == 0) or (isinstance(b, fmpq) and b == 0):
            return ZERO if is_finite(a) and is_finite(b) else undefined()
        return a * b

    def div(self, a: Real, b: Real) -> Real:
        if sign(b) in (None, 0):
            return undefined()
        if isinstance(a, fmpq) and a == 0:
            return ZERO if is_finite(b) else undefined()
        return a / b

    def neg(self, a: Real) -> Real:
        return -a

    def twice(self, a: Real) -> Real:
        return a + a

    def sq(self, a: Real) -> Real:
        if isinstance(a, fmpq):
            return a * a
        square = a * a
        return square if sign(a) is not None else square.nonnegative_part() if square.is_finite() else square

    def inv(self, a: Real) -> Real:
        return self.div(ONE, a)

    def pow(self, a: Real, b: Real) -> Real:
        if isinstance(b, fmpq) and b.q == 1:
            return self._integer_power(a, int(b.p))
        if sign(a) == 1:
            return (ball(b) * ball(a).log()).exp()
        return undefined()  # also for a = 0: there is no value on its left, so a derivative there means nothing

    def _integer_power(self, a: Real, exponent: int) -> Real:
        if exponent < 0:
            return self.inv(self._integer_power(a, -exponent))
        if exponent == 0:
            return ONE
        if exponent % 2 == 0:
            return self._integer_power(self.sq(a), exponent // 2)
        return self.mul(a, self._integer_power(a, exponent - 1)) if exponent > 1 else a

    def sqrt(self, a: Real) -> Real:
        if isinstance(a, fmpq) and a >= 0:
            root = fmpq(fmpz(a.p).isqrt(), fmpz(a.q).isqrt())
            if root * root == a:
                return root
        return undefined() if sign(a) in (None, -1) else _monotone(arb.sqrt, a)

    def hypot(self, a: Real, b: Real) -> Real:
        return self.sqrt(self.add(self.sq(a), self.sq(b)))

    def exp(self, a: Real) -> Real:
        return ONE if self._is_zero(a) else _monotone(arb.exp, a)

    def expm1(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else _monotone(arb.expm1, a)

    def log(self, a: Real) -> Real:
        if sign(a) != 1:
            return undefined()
        return ZERO if isinstance(a, fmpq) and a == 1 else _monotone(arb.log, a)

    def log1p(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else self.log(self.add(ONE, a))

    def sin(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else ball(a).sin()

    def cos(self, a: Real) -> Real:
        return ONE if self._is_zero(a) else ball(a).cos()

    def tan(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else ball(a).tan()

    def asin(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else ball(a).asin()

    def acos(self, a: Real) -> Real:
        return ball(a).acos()

    def atan(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else _monotone(arb.atan, a)

    def atan2(self, a: Real, b: Real) -> Real:
        if sign(b) == 1:
            return self.atan(self.div(a, b))
        return undefined() if sign(a) in (None, 0) else arb.atan2(ball(a), ball(b))

    def sinh(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else _monotone(arb.sinh, a)

    def cosh(self, a: Real) -> Real:
        return ONE if self._is_zero(a) else _monotone(arb.cosh, self.fabs(a))

    def tanh(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else _monotone(arb.tanh, a)

    def asinh(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else _monotone(arb.asinh, a)

    def acosh(self, a: Real) -> Real:
        return ball(a).acosh()

    def atanh(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else ball(a).atanh()

    def erf(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else _monotone(arb.erf, a)

    def erfinv(self, a: Real) -> Real:
        return ZERO if self._is_zero(a) else ball(a).erfinv()

    def fabs(self, a: Real) -> Real:
        if isinstance(a, fmpq):
            return abs(a)
        return abs(a) if sign(a) is not None else abs(a).nonnegative_part() if a.is_finite() else undefined()

    def sign(self, a: Real) -> Real:
        certain = sign(a)
        return undefined() if certain in (None, 0) else fmpq(certain)

    def copysign(self, a: Real, b: Real) -> Real:
        return self.mul(self.fabs(a), self.sign(b))

    def fmin(self, a: Real, b: Real) -> Real:
        if isinstance(a, fmpq) and isinstance(b, fmpq):
            return min(a, b)
        return ball(a).min(ball(b))

    def fmax(self, a: Real, b: Real) -> Real:
        if isinstance(a, fmpq) and isinstance(b, fmpq):
            return max(a, b)
        return ball(a).max(ball(b))

    def floor(self, a: Real) -> Real:
        lo, hi = (lower(a), upper(a)) if is_finite(a) else (Fraction(0), Fraction(2))
        inside = lo // 1 == hi // 1 and lo % 1 != 0
        return fmpq(lo // 1) if inside else undefined()

    def ceil(self, a: Real) -> Real:
        return self.neg(self.floor(self.neg(a)))

    def fmod(self, a: Real, b: Real) -> Real:
        quotient = self.div(a, b)
        certain = sign(quotient)
        if certain in (None, 0):
            return undefined()
        whole = self.floor(quotient) if certain == 1 else self.ceil(quotient)
        return self.sub(a, self.mul(b, whole))

    def remainder(self, a: Real, b: Real) -> Real:
        whole = self.floor(self.add(self.div(a, b), fmpq(1, 2)))
        return self.sub(a, self.mul(b, whole))

    def lt(self, a: Real, b: Real) -> Real:
        certain = sign(self.sub(a, b))
        return undefined() if certain in (None, 0) else fmpq(int(certain < 0))

    le = lt

    def eq(self, a: Real, b: Real) -> Real:
        return undefined() if sign(self.sub(a, b)) in (None, 0) else ZERO

    def ne(self, a: Real, b: Real) -> Real:
        return self.not_(self.eq(a, b))

    def not_(self, a: Real) -> Real:
        certain = sign(a)
        return undefined() if certain is None else fmpq(int(certain == 0))

    def and_(self, a: Real, b: Real) -> Real:
        signs = (sign(a), sign(b))
        if 0 in signs:
            return ZERO
        return undefined() if None in signs else ONE

    def or_(self, a: Real, b: Real) -> Real:
        return self.not_(self.and_(self.not_(a), self.not_(b)))

    def if_else_zero(self, condition: Real, a: Real) -> Real:
        certain = sign(condition)
        if certain is None:
            return undefined()
        return a if certain else ZERO

    @staticmethod
    def _is_zero(a: Real) -> bool:
        return isinstance(a, fmpq) and a == 0


#: The one instance that is needed: it has no state.
REAL = RealAlgebra()


def near_eigenvalues(matrix: acb_mat) -> list[acb]:
    """Eigenvalues of a square matrix without bounds, at the precision that is set.

    FLINT ends the QR iteration after 14 n + bits / 10 turns and does not say whether it has converged. Eigenvalues that
    coincide without eigenvectors of their own need more.
    """
    turns = 10 * (14 * matrix.nrows() + ctx.prec)
    return list(matrix.eig(algorithm="approx", maxiter=turns))


def reals(values: Sequence[Fraction]) -> list[Real]:
    """Fractions as exact numbers."""
    return [rational(v) for v in values]
