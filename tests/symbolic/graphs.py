"""Random SX graphs, and the value of an exact function at a rational point."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import REAL, ZERO, Real, rational

#: Operations that are analytic where they are defined, and the modulus, so that every interpretation has them.
ANALYTIC_UNARY = {
    "neg": lambda a: -a,
    "twice": lambda a: 2 * a,
    "sq": lambda a: a * a,
    "inv": lambda a: 1 / a,
    "exp": ca.exp,
    "expm1": ca.expm1,
    "log": ca.log,
    "log1p": ca.log1p,
    "sqrt": ca.sqrt,
    "fabs": ca.fabs,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "asin": ca.asin,
    "acos": ca.acos,
    "atan": ca.atan,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "tanh": ca.tanh,
    "asinh": ca.asinh,
    "acosh": ca.acosh,
    "atanh": ca.atanh,
    "erf": ca.erf,
    "cube": lambda a: a**3,
    "power": lambda a: a**2.5,
    "reciprocal power": lambda a: a**-2,
}
ANALYTIC_BINARY = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "pow": lambda a, b: a**b,
    "hypot": ca.hypot,
}
OTHER_UNARY = {
    "sign": ca.sign,
    "floor": ca.floor,
    "ceil": ca.ceil,
    "not": ca.logic_not,
    "erfinv": ca.erfinv,
}
OTHER_BINARY = {
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "atan2": ca.atan2,
    "fmod": ca.fmod,
    "remainder": ca.remainder,
    "copysign": ca.copysign,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "and": ca.logic_and,
    "or": ca.logic_or,
    "choose": lambda a, b: ca.if_else(a > b, a + 1, b * 2),
}
UNARY = {**ANALYTIC_UNARY, **OTHER_UNARY}
BINARY = {**ANALYTIC_BINARY, **OTHER_BINARY}

#: Points at which nothing in the graphs below cancels by accident.
POINTS = [
    (Fraction(1, 3), Fraction(5, 7), Fraction(-2, 5)),
    (Fraction(13, 10), Fraction(-7, 9), Fraction(1, 8)),
    (Fraction(-4, 11), Fraction(2, 13), Fraction(9, 4)),
]


@st.composite
def graphs(draw, unary, binary, size=8):
    """(symbols, expression) with shared subexpressions."""
    x = [ca.SX.sym(name) for name in ("a", "b", "c")]
    pool = [*x, ca.SX(draw(st.sampled_from([0.5, 2, -3, 0.1, 7])))]
    for _ in range(draw(st.integers(1, size))):
        pick = st.integers(0, len(pool) - 1)
        if draw(st.booleans()):
            pool.append(unary[draw(st.sampled_from(sorted(unary)))](pool[draw(pick)]))
        else:
            pool.append(binary[draw(st.sampled_from(sorted(binary)))](pool[draw(pick)], pool[draw(pick)]))
    expression = pool[-1] + pool[draw(st.integers(0, len(pool) - 1))]
    assume(_constants_are_finite(expression))
    return ca.vertcat(*x), expression


def _constants_are_finite(expression: ca.SX) -> bool:
    function = ca.Function("f", [], [expression], {"allow_free": True})
    codes = range(function.n_instructions())
    return all(
        np.isfinite(function.instruction_constant(k)) for k in codes if function.instruction_id(k) == ca.OP_CONST
    )


def value(function: Quotient, symbols: list[Real]) -> Real:
    """An exact function at a point: its atoms are evaluated in exact numbers and balls."""
    generators: dict[int, Real] = dict(enumerate(symbols))

    def generator(k: int) -> Real:
        if k not in generators:
            atom = function.field.atoms[k]
            generators[k] = getattr(REAL, atom.kind)(value(atom.argument, symbols))
        return generators[k]

    def polynomial(p) -> Real:
        total: Real = ZERO
        for exponents, coefficient in p.to_dict().items():
            term: Real = coefficient
            for k, exponent in enumerate(exponents):
                if exponent:
                    term = REAL.mul(term, REAL.pow(generator(k), rational(int(exponent))))
            total = REAL.add(total, term)
        return total

    return REAL.div(polynomial(function.numerator), polynomial(function.denominator))
