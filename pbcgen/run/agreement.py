"""How far two correct implementations of one law may differ.

The generated C and the reference step perform the same operations in the same order in IEEE arithmetic, without
contraction. Addition, multiplication, division and square root are then equal to the last bit; tanh, exp, sin and
the like come from two libraries and differ by some units in the last place. :class:`Allowance` carries such a
difference, to first order, through the law:

1. Every library function gets a relative error of at most LIBRARY_ULP; every operation that depends on one may in
   consequence round differently and gets one of ARITHMETIC_ULP.
2. The loop equation ``F = s + N t - c = 0``, t = tanh(s), turns an error r of F, the rounding of F included, into
   ``ds = (I + N T)^-1 r`` with T = diag(1 - t t), and ``dt = T ds + LIBRARY_ULP t``. Channels that are solved together
   share the rounding of the largest of them.
3. The errors of t and of the update's own operations add up in xi and u, weighted by the partial derivatives.

The sums are of absolute values. A real fault is not hidden: where the law is well conditioned the allowance is a few
units in the last place of u.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.law.law import ControlLaw, VectorSolve
from pbcgen.law.rounding import DTYPES
from pbcgen.law.step import ReferenceStep

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from fractions import Fraction

    from pbcgen.symbolic.tape import Tape

Array = NDArray[np.float64]

#: Two libraries may be this far apart, in units in the last place: each is within 2 of the true value (NumPy's
#: vectorised float32 functions claim 4 at the most, glibc's tanhf 2).
LIBRARY_ULP = 6.0

#: An operation on operands that differ may round to the other side: half a unit twice.
ARITHMETIC_ULP = 1.0

#: Roundings of the residual ``(s - c) + N t``, relative to |s| + |N||t| + |c|; the last Newton step brings two more.
_RESIDUAL_ULP = 4.0


class Allowance:
    """Bounds on the differences of xi and u between two implementations of ``law``."""

    def __init__(self, law: ControlLaw) -> None:
        self._law = law
        self._step = ReferenceStep(law)
        self._dtype = DTYPES[law.precision]
        self._epsilon = float(np.finfo(self._dtype).eps)
        m, xi, t = (
            ca.SX.sym(name, size)
            for name, size in (("m", len(law.inputs)), ("xi", len(law.states)), ("t", law.channels))
        )
        loop = _Inexact(self._epsilon)
        c, N = loop.walk(law.prepare, [(m, False), (xi, False)])
        self._residual = ca.Function("residual", [m, xi, t], [loop.spread(c - N @ t)])
        update = _Inexact(self._epsilon)
        result = ca.vertcat(*update.walk(law.update, [(m, False), (xi, False), (t, True)]))
        partial = ca.densify(ca.fabs(update.exact(ca.jacobian(result, t))))
        self._update = ca.Function("update", [m, xi, t], [update.spread(result), partial])

    def __call__(self, measurement: NDArray[Any], xi: NDArray[Any]) -> tuple[Array, Array]:
        """The allowed absolute differences.

        Args:
            measurement: (N, nm), in the precision of the law.
            xi: (N, nxi), the states before the step.

        Returns:
            Bounds for the next state (N, nxi) and for u (N, m); NaN where an input is not finite or a sum overflows.
        """
        m, before = measurement.astype(self._dtype), xi.astype(self._dtype)
        with np.errstate(all="ignore"):
            loop = self._step.loop(m, before)
            c, N, t = (part.astype(float) for part in (loop.c, loop.N, loop.t))
            carried = self._epsilon * np.einsum("kij,kj->ki", np.abs(N), np.abs(t))
            terms = 2 * (self._epsilon * np.abs(c) + carried)
            own = _mapped(self._residual, m, before, t)[0].reshape(c.shape)
            r = own + LIBRARY_ULP * carried + _RESIDUAL_ULP * self._largest_of_block(terms)
            slope = 1 - t * t
            gain = np.abs(_inverse(np.eye(c.shape[1]) + N * slope[:, None, :]))
            dt = slope * np.einsum("kij,kj->ki", gain, r) + LIBRARY_ULP * self._epsilon * np.abs(t)
            own, partial = _mapped(self._update, m, before, t)
            bounds = own[:, :, 0] + np.einsum("kij,kj->ki", partial, dt)
        return bounds[:, : len(self._law.states)], bounds[:, len(self._law.states) :]

    def _largest_of_block(self, terms: Array) -> Array:
        """The terms (N, ns), the largest of its block for channels that are solved together."""
        result = terms.copy()
        for solve in self._law.solves:
            if isinstance(solve, VectorSolve):
                rows = np.array(solve.indices)
                result[:, rows] = terms[:, rows].max(axis=1, keepdims=True)
        return result


def _mapped(function: ca.Function, *columns: NDArray[Any]) -> list[Array]:
    """The outputs of ``function`` for every row of the arguments, each of shape (N, rows, columns)."""
    count = len(columns[0])
    if count == 0:
        return [np.zeros((0, *function.size_out(k))) for k in range(function.n_out())]
    results = function.map(count).call([ca.DM(column.T.astype(float)) for column in columns])
    shaped = []
    for k, result in enumerate(results):
        rows, width = function.size_out(k)
        shaped.append(np.array(result).reshape(rows, count, width).transpose(1, 0, 2))
    return shaped


def _inverse(matrices: Array) -> Array:
    """The inverses, NaN where an entry is not finite or the matrix is singular."""
    result = np.full_like(matrices, np.nan)
    usable = np.all(np.isfinite(matrices), axis=(1, 2))
    usable[usable] &= np.linalg.det(matrices[usable]) != 0
    result[usable] = np.linalg.inv(matrices[usable])
    return result


@dataclass(frozen=True)
class _Value:
    """An expression, and whether two implementations may already disagree on it."""

    expression: ca.SX
    inexact: bool


class _Inexact:
    """Tape algebra over SX in which every result that may be rounded differently carries a factor (1 + delta)."""

    def __init__(self, epsilon: float) -> None:
        self._epsilon = epsilon
        self._deltas: list[ca.SX] = []
        self._sizes: list[float] = []

    def walk(self, tape: Tape, inputs: Sequence[tuple[ca.SX, bool]]) -> list[ca.SX]:
        """The outputs for symbols as inputs, each marked as inexact or not."""
        arguments = [[_Value(vector[k], inexact) for k in range(vector.numel())] for vector, inexact in inputs]
        results = []
        for matrix in tape.walk(self, arguments):
            result = ca.SX(*matrix.shape)
            for (row, column), value in matrix.entries.items():
                result[row, column] = value.expression
            results.append(result)
        return results

    def exact(self, expression: ca.SX) -> ca.SX:
        """The expression without its roundings."""
        if not self._deltas:
            return expression
        deltas = ca.vertcat(*self._deltas)
        return ca.substitute(expression, deltas, ca.SX.zeros(deltas.shape))

    def spread(self, vector: ca.SX) -> ca.SX:
        """The sum of the effects of all roundings on each entry."""
        if not self._deltas:
            return ca.SX.zeros(vector.numel())
        partial = self.exact(ca.jacobian(vector, ca.vertcat(*self._deltas)))
        return ca.densify(ca.fabs(partial) @ ca.DM(self._sizes))

    def const(self, value: Fraction) -> _Value:
        """A literal: both implementations round it to the same number."""
        return _Value(ca.SX(float(value)), False)

    def __getattr__(self, name: str) -> Callable[..., _Value]:
        """The operation ``name`` of the tape; AttributeError if there is none."""
        function = _OPERATIONS.get(name)
        if function is None:
            raise AttributeError(name)
        return lambda *operands: self._apply(name, function, operands)

    def _apply(self, name: str, function: Callable[..., ca.SX], operands: Sequence[_Value]) -> _Value:
        expression = function(*(operand.expression for operand in operands))
        library = name in _LIBRARY
        inexact = library or any(operand.inexact for operand in operands)
        if not library and not (inexact and name in _ROUNDED):
            return _Value(expression, inexact)
        delta = ca.SX.sym("delta")
        self._deltas.append(delta)
        self._sizes.append(self._epsilon * (LIBRARY_ULP if library else ARITHMETIC_ULP))
        return _Value(expression * (1 + delta), inexact=True)


_LIBRARY: Mapping[str, Callable[..., ca.SX]] = {
    "exp": ca.exp,
    "expm1": ca.expm1,
    "log": ca.log,
    "log1p": ca.log1p,
    "pow": ca.power,
    "hypot": ca.hypot,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "asin": ca.asin,
    "acos": ca.acos,
    "atan": ca.atan,
    "atan2": ca.atan2,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "tanh": ca.tanh,
    "asinh": ca.asinh,
    "acosh": ca.acosh,
    "atanh": ca.atanh,
    "erf": ca.erf,
    "erfinv": ca.erfinv,
}

_ROUNDED: Mapping[str, Callable[..., ca.SX]] = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "inv": lambda x: 1 / x,
    "sq": lambda x: x * x,
    "sqrt": ca.sqrt,
}

_OPERATIONS: Mapping[str, Callable[..., ca.SX]] = {
    **_LIBRARY,
    **_ROUNDED,
    "assign": lambda x: x,
    "assign_first": lambda x, _: x,
    "neg": lambda x: -x,
    "twice": lambda x: 2 * x,
    "lt": lambda x, y: x < y,
    "le": lambda x, y: x <= y,
    "eq": lambda x, y: x == y,
    "ne": lambda x, y: x != y,
    "not_": ca.logic_not,
    "and_": ca.logic_and,
    "or_": ca.logic_or,
    "if_else_zero": lambda condition, x: ca.if_else(condition, x, ca.SX(0)),
    "floor": ca.floor,
    "ceil": ca.ceil,
    "fmod": ca.fmod,
    "remainder": ca.remainder,
    "fabs": ca.fabs,
    "sign": ca.sign,
    "copysign": ca.copysign,
    "fmin": ca.fmin,
    "fmax": ca.fmax,
}
