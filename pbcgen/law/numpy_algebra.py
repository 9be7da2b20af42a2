"""The operations of the tape on NumPy values of one precision, as the generated code computes them."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np

from pbcgen.law.arithmetic import Precision, Tanh
from pbcgen.law.hyperbolic import fast_cosh, fast_tanh
from pbcgen.law.rounding import DTYPES, nearest


class NumpyAlgebra:
    """SX operations on NumPy values of one precision. Comparisons and logic give 0 and 1."""

    def __init__(self, precision: Precision, tanh: Tanh = "libm") -> None:
        self._precision = precision
        self._dtype = DTYPES[precision]
        self._operations = _OPERATIONS | _fast_operations(precision, tanh)

    def const(self, value: Fraction) -> Any:
        """The nearest number of the precision; EmitError if it overflows or vanishes."""
        return nearest(value, self._precision)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """The operation ``name`` of the tape; AttributeError if there is none."""
        function = self._operations.get(name)
        if function is None:
            raise AttributeError(name)
        dtype = self._dtype

        def apply(*operands: Any) -> Any:
            return np.asarray(function(*operands)).astype(dtype, copy=False)

        return apply


def _fast_operations(precision: Precision, tanh: Tanh) -> dict[str, Callable[..., Any]]:
    """The operations that do not come from the math library."""
    if tanh == "libm":
        return {}
    return {"tanh": fast_tanh} | ({"cosh": fast_cosh} if precision == "float" else {})


def _sign(x: Any) -> Any:
    """-1, 0 or 1; NaN and the zeros as they are."""
    return np.where(x < 0, -1, np.where(x > 0, 1, x))


def _remainder(x: float, y: float) -> float:
    """C's ``remainder``: x - n y with n the integer nearest to x/y; exact, NaN where it has no value."""
    try:
        return math.remainder(x, y)
    except ValueError:
        return math.nan


def _special(name: str, x: Any) -> Any:
    """A function of scipy.special, which takes as long to import as CasADi: few laws have one."""
    from scipy import special

    return getattr(special, name)(x)


_OPERATIONS: dict[str, Callable[..., Any]] = {
    "assign": lambda x: x,
    "assign_first": lambda x, _: x,
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "inv": lambda x: 1 / x,
    "sq": lambda x: x * x,
    "twice": lambda x: x + x,
    "exp": np.exp,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "pow": np.power,
    "sqrt": np.sqrt,
    "hypot": np.hypot,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "erf": lambda x: _special("erf", x),
    "erfinv": lambda x: _special("erfinv", x),
    "lt": np.less,
    "le": np.less_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "not_": lambda x: x == 0,
    "and_": np.logical_and,
    "or_": np.logical_or,
    "if_else_zero": lambda condition, x: np.where(condition != 0, x, 0),
    "floor": np.floor,
    "ceil": np.ceil,
    "fmod": np.fmod,
    "remainder": np.vectorize(_remainder, otypes=[np.float64]),
    "fabs": np.abs,
    "sign": _sign,
    "copysign": np.copysign,
    "fmin": np.fmin,
    "fmax": np.fmax,
}
