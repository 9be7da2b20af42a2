"""The SX operations over complex balls, where they are analytic: bounds of functions beside the real line."""

from __future__ import annotations

from fractions import Fraction

from flint import acb, arb, fmpq


def _nothing() -> acb:
    return acb(arb.nan())


def _right(a: acb) -> bool:
    """Whether the ball avoids the cut of logarithms and roots, the numbers that are not positive."""
    return bool(a.real > 0 or a.imag > 0 or a.imag < 0)


class ComplexAlgebra:
    """An :class:`~pbcgen.symbolic.tape.Algebra` of functions analytic in the whole ball.

    A result is finite only if the function is analytic at every operand in the ball: poles and cuts leave nothing
    known. Operations that are not analytic have no meaning.
    """

    title = "complex balls"

    def const(self, value: Fraction) -> acb:
        return acb(fmpq(value.numerator, value.denominator))

    def assign(self, a: acb) -> acb:
        return a

    def add(self, a: acb, b: acb) -> acb:
        return a + b

    def sub(self, a: acb, b: acb) -> acb:
        return a - b

    def mul(self, a: acb, b: acb) -> acb:
        return a * b

    def div(self, a: acb, b: acb) -> acb:
        return a * self.inv(b)

    def neg(self, a: acb) -> acb:
        return -a

    def twice(self, a: acb) -> acb:
        return a + a

    def sq(self, a: acb) -> acb:
        return a * a

    def inv(self, a: acb) -> acb:
        return _nothing() if a.contains(0) else 1 / a

    def pow(self, a: acb, b: acb) -> acb:
        exponent = b.real.unique_fmpz() if b.is_exact() and b.imag == 0 else None
        if exponent is None:
            return (b * self.log(a)).exp()
        power = a ** abs(int(exponent))
        return self.inv(power) if exponent < 0 else power

    def sqrt(self, a: acb) -> acb:
        return a.sqrt() if _right(a) else _nothing()

    def hypot(self, a: acb, b: acb) -> acb:
        return self.sqrt(a * a + b * b)

    def exp(self, a: acb) -> acb:
        return a.exp()

    def expm1(self, a: acb) -> acb:
        return a.exp() - 1

    def log(self, a: acb) -> acb:
        return a.log() if _right(a) else _nothing()

    def log1p(self, a: acb) -> acb:
        return self.log(a + 1)

    def sin(self, a: acb) -> acb:
        return a.sin()

    def cos(self, a: acb) -> acb:
        return a.cos()

    def tan(self, a: acb) -> acb:
        return self.div(a.sin(), a.cos())

    def sinh(self, a: acb) -> acb:
        return a.sinh()

    def cosh(self, a: acb) -> acb:
        return a.cosh()

    def tanh(self, a: acb) -> acb:
        return a.tanh()

    def atan(self, a: acb) -> acb:
        return a.atan() if abs(a.imag) < 1 or not a.real.contains(0) else _nothing()

    def asinh(self, a: acb) -> acb:
        return a.asinh() if abs(a.imag) < 1 or not a.real.contains(0) else _nothing()

    def asin(self, a: acb) -> acb:
        return a.asin() if abs(a.real) < 1 else _nothing()

    def acos(self, a: acb) -> acb:
        return a.acos() if abs(a.real) < 1 else _nothing()

    def atanh(self, a: acb) -> acb:
        return a.atanh() if abs(a.real) < 1 else _nothing()

    def erf(self, a: acb) -> acb:
        return a.erf()


#: The one instance that is needed: it has no state.
COMPLEX = ComplexAlgebra()
