"""The reference step: the algorithm of the generated C, in NumPy, for a batch of steps at once.

This page is the specification of one step; ``templates/`` holds the same algorithm in C. Both use the constants of
:mod:`pbcgen.law.rounding` and the same order of operations, so that they differ only by what the two math
libraries differ (tanh, sin, ...), a few units in the last place.

One step
--------
1. A state that is not finite, or whose sum of squares is above STATE_LIMIT^2, is set to its initial value; the status
   is then at least STATE_RESET. Numbers that a setter may change are states that start at the declared values.
2. Measurements of which one is not finite, or whose sum of squares is above STATE_LIMIT^2: the output is the fallback
   of the law, the state is kept, INVALID_INPUT.
3. *prepare*: c and N. Unless a computed N is finite and a computed mu >= 0, and c is finite for a block or a channel
   without a fit or a Newton step: fallback output, state kept, OUT_OF_RANGE.
4. *solve*: t = tanh(s), see below. Where c was not checked, an infinite or undefined c gives t = NaN, which the next
   check sees.
5. *update*: the next state and u. Unless the sum of all their squares is at most STATE_LIMIT^2: fallback output,
   state kept, OUT_OF_RANGE.
6. u is clamped to its interval, rounded inward to the precision; by comparisons, so that no bit pattern escapes.

If several statuses apply, the largest is returned. A fallback to the last valid output uses the equilibrium output in
place of a held value that is not in its interval. The C tests first whether the sum of all the squares of state and
measurements is at most STATE_LIMIT^2, and looks for the reason only if it is not: the sum is above that limit, or NaN,
whenever 1 or 2 applies.

tanh and cosh are the math library's or those of :mod:`pbcgen.law.hyperbolic`, as the law says.

Scalar solve: s + mu tanh(s) = c
--------------------------------
For a constant mu in float t is a fitted function of c, see :mod:`pbcgen.law.fitted`. Otherwise:

With r = abs(c) the root is right of s_0 = max(r/(1 + mu), r - mu), where s -> s + mu tanh(s) is concave and increasing:
Newton's method ``s <- s - ((s - r) + mu t) / (1 + mu (1 - t t))``, t = tanh(s), increases monotonically to it. It makes
a constant number of steps, tanh is evaluated once more at the end, and the result takes the sign of c. ``(s - r)`` is
summed first: it is exact or harmless for r up to the largest finite number, where ``s + mu t`` could overflow.

Block solve: s + N tanh(s) = c
------------------------------
Newton's method; I + N diag(1 - t t) is nonsingular for every s. The start is s_0 of the scalar solve for each diagonal
entry of N. Far from the root a full step can throw a component from one saturation of tanh deep into the other, and
back; so a step is cut to the point where the first such component has gone 1 beyond zero. (A line search on the norm of
the residual stalls on stiff, badly conditioned N, where this rule does not.) The residual is measured in the maximum
norm, which cannot overflow by squaring. The first iterate with ``max|residual| <= tolerance (1 + max|c|)`` makes one
more step, kept if it is better, which takes the error to rounding level. The linear solve is elimination with partial
pivoting (the first largest pivot).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbcgen.law.arithmetic import Precision
from pbcgen.law.fitted import fitted
from pbcgen.law.hyperbolic import fast_tanh
from pbcgen.law.law import ControlLaw, Fallback, Fit, ScalarSolve, SetterInput, VectorSolve
from pbcgen.law.numpy_algebra import NumpyAlgebra
from pbcgen.law.rounding import DTYPES, STATE_LIMIT, inward, nearest

if TYPE_CHECKING:
    from collections.abc import Callable

Array = NDArray[Any]


class StepStatus(IntEnum):
    """What a step reports, in order of severity; the values are those of the C enumeration."""

    OK = 0
    NOT_CONVERGED = 1
    STATE_RESET = 2
    OUT_OF_RANGE = 3
    INVALID_INPUT = 4
    INVALID_ARGUMENT = 5
    INVALID_SETTING = 6


@dataclass(frozen=True)
class Loop:
    """The loop equations ``s + N tanh(s) = c`` of a batch of steps, solved.

    Attributes:
        c: (batch, ns). N: (batch, ns, ns). t: tanh(s), (batch, ns).
        converged: (batch,) whether every block met its tolerance.
        in_range: (batch,) whether c and N passed the checks of step 3.
    """

    c: Array
    N: Array
    t: Array
    converged: NDArray[np.bool_]
    in_range: NDArray[np.bool_]


class ReferenceStep:
    """One controller step for a batch of measurements and states, in the precision of the law.

    Raises EmitError if a constant of the law does not fit the precision, and ValueError if its solves do not
    partition its channels.
    """

    def __init__(self, law: ControlLaw) -> None:
        check_solves(law)
        self.law = law
        self.dtype = DTYPES[law.precision]
        bounds = [inward(interval, law.precision, "the interval") for interval in law.intervals]
        self.low: Array = np.array([low for low, _ in bounds], self.dtype)
        self.high: Array = np.array([high for _, high in bounds], self.dtype)
        self.equilibrium: Array = np.array(equilibrium_output(law), self.dtype)
        self.initial: Array = np.array(initial_state(law), self.dtype)
        self._algebra = NumpyAlgebra(law.precision, law.tanh)
        self._limit = nearest(STATE_LIMIT[law.precision] ** 2, law.precision)
        self._tanh = tanh_of(law)

    def __call__(
        self, measurement: Array, xi: Array, last_output: Array | None = None
    ) -> tuple[Array, Array, NDArray[np.int32]]:
        """The next state, the clamped output and the status.

        Args:
            measurement: m, shape (batch, nm) or (nm,).
            xi: the controller state, shape (batch, nxi) or (nxi,).
            last_output: the previous output, shape (batch, nu) or (nu,); the equilibrium output if absent. It
                is the output of an invalid step when the fallback is the last valid output.

        Returns:
            (xi_next, u, status) of shapes (batch, nxi), (batch, nu), (batch,), without the batch axis if
            ``measurement`` has none. ``status`` holds :class:`StepStatus` values.
        """
        single = np.ndim(measurement) == 1
        m = np.atleast_2d(np.asarray(measurement, self.dtype))
        batch = len(m)
        state = np.broadcast_to(np.asarray(xi, self.dtype), (batch, len(self.law.states))).copy()
        held = self.equilibrium if last_output is None else np.asarray(last_output, self.dtype)
        held = np.broadcast_to(held, (batch, len(self.law.outputs))).copy()
        with np.errstate(all="ignore"):
            result = self._step(m, state, held)
        return (result[0][0], result[1][0], result[2][0]) if single else result

    def _step(self, m: Array, xi: Array, held: Array) -> tuple[Array, Array, NDArray[np.int32]]:
        status = np.zeros(len(m), np.int32)
        corrupted = ~(_sum_of_squares(xi) <= self._limit)
        xi[corrupted] = self.initial
        if self.law.fallback is Fallback.LAST_OUTPUT:
            held = np.where((held >= self.low) & (held <= self.high), held, self.equilibrium)
            held[corrupted] = self.equilibrium
        else:
            held[:] = self.equilibrium
            for k, position in enumerate(self.law.equilibrium_states):
                if position is not None:
                    held[:, k] = clamped(xi[:, position], self.low[k], self.high[k])
        _raise_to(status, corrupted, StepStatus.STATE_RESET)

        next_xi, u, converged, in_range = self._evaluate(m, xi)
        _raise_to(status, ~converged, StepStatus.NOT_CONVERGED)
        _raise_to(status, ~in_range, StepStatus.OUT_OF_RANGE)
        invalid = ~(_sum_of_squares(m) <= self._limit)
        _raise_to(status, invalid, StepStatus.INVALID_INPUT)
        keep = (invalid | ~in_range)[:, None]
        u = clamped(u, self.low, self.high)
        return np.where(keep, xi, next_xi), np.where(keep, held, u), status

    def _evaluate(self, m: Array, xi: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Prepare, solve and update: (next xi, u, converged, in range)."""
        loop = self.loop(m, xi)
        next_xi, u = self._walk(self.law.update, len(m), m, xi, loop.t)
        moved = next_xi[:, : len(self.law.states) - len(self.law.kept), 0]
        in_range = loop.in_range & (_sum_of_squares(np.hstack([moved, u[:, :, 0]])) <= self._limit)
        return next_xi[:, :, 0], u[:, :, 0], loop.converged, in_range

    def loop(self, m: Array, xi: Array) -> Loop:
        """Prepare and solve, for arrays (batch, nm) and (batch, nxi) in the precision of the law."""
        c, N = self._walk(self.law.prepare, len(m), m, xi)
        checked = [i for solve in self.law.solves for i in channels_to_check(solve)]
        in_range = np.all(np.isfinite(c[:, checked, 0]), axis=1) & np.all(np.isfinite(N), axis=(1, 2))
        t = np.zeros((len(m), self.law.channels), self.dtype)
        converged = np.ones(len(m), np.bool_)
        for solve in self.law.solves:
            if isinstance(solve, ScalarSolve):
                mu = N[:, solve.index, solve.index]
                in_range &= mu >= 0
                t[:, solve.index] = solve_scalar(mu, c[:, solve.index, 0], solve.iterations, self._tanh, solve.fit)
            else:
                rows = np.array(solve.indices)
                t[:, rows], ok = solve_block(N[:, rows[:, None], rows], c[:, rows, 0], solve, self._tanh)
                converged &= ok
        return Loop(c[:, :, 0], N, t, converged, in_range)

    def set(self, group: str, xi: Array, values: Array) -> tuple[Array, StepStatus]:
        """The state (nxi,) after the caller has set a target or gains, and the status, as ``<p>_set_<group>``."""
        setter = next(s for s in self.law.setters if s.group == group)
        given = np.array(values, self.dtype)
        for k, item in enumerate(setter.inputs):
            accepted, proved = setting_bounds(item, self.law.precision)
            if not accepted[0] <= given[k] <= accepted[1]:
                return xi, StepStatus.INVALID_SETTING
            given[k] = min(max(given[k], proved[0]), proved[1])
        with np.errstate(all="ignore"):
            (stored,) = self._walk(setter.compute, 1, given[None, :])
            if not _sum_of_squares(stored[:, :, 0])[0] <= self._limit:
                return xi, StepStatus.OUT_OF_RANGE
        result = np.array(xi, self.dtype)
        result[list(setter.states)] = stored[0, :, 0]
        return result, StepStatus.OK

    def start(self, xi: Array, measurement: Array) -> tuple[Array, StepStatus]:
        """The state (nxi,) of a bumpless start, and the status, as ``<p>_start_at``."""
        assert self.law.start is not None
        m, state = np.asarray(measurement, self.dtype), np.array(xi, self.dtype)
        with np.errstate(all="ignore"):
            if not _sum_of_squares(m[None, :])[0] <= self._limit:
                return state, StepStatus.INVALID_INPUT
            (started,) = self._walk(self.law.start, 1, m[None, :], state[None, :])
            own = started[:, : len(self.law.states) - len(self.law.kept), 0]
            if not _sum_of_squares(own)[0] <= self._limit:
                return state, StepStatus.OUT_OF_RANGE
        state[: own.shape[1]] = own[0]
        return state, StepStatus.OK

    def _walk(self, tape: Any, batch: int, *inputs: Array) -> list[Array]:
        """The outputs of a tape as arrays of shape (batch, rows, columns)."""
        outputs = tape.walk(self._algebra, [list(argument.T) for argument in inputs])
        arrays = []
        for matrix in outputs:
            array = np.zeros((batch, *matrix.shape), self.dtype)
            for (row, column), value in matrix.entries.items():
                array[:, row, column] = value
            arrays.append(array)
        return arrays


def initial_state(law: ControlLaw) -> tuple[np.float32 | np.float64, ...]:
    """The first value of every state in the precision of the law. Raises EmitError for one that does not fit."""
    names = [signal.name for signal in law.states]
    return tuple(
        nearest(Fraction(value), law.precision, f"the initial value of `{name}`")
        for name, value in zip(names, law.initial, strict=True)
    )


Bounds = tuple[np.float32 | np.float64, np.float32 | np.float64]


def setting_bounds(item: SetterInput, precision: Precision) -> tuple[Bounds, Bounds]:
    """What a setter accepts, the nearest numbers to the bounds of the range, and what it computes with, inside it.

    So the bounds can be written as in the model, and a bound that rounds outward is moved by a unit in the last place.
    """
    what = f"the range of `{item.signal.name}`"
    low, high = (nearest(bound, precision, what) for bound in item.range)
    return (low, high), inward(item.range, precision, what)


def clamped(values: Array, low: Array, high: Array) -> Array:
    """The values in [low, high]; NaN gives low."""
    result: Array = np.where(values >= low, np.where(values <= high, values, high), low)
    return result


def equilibrium_output(law: ControlLaw) -> tuple[np.float32 | np.float64, ...]:
    """-kappa in the precision of the law, moved into the emitted interval if rounding took it out."""
    result = []
    for signal, value, interval in zip(law.outputs, law.equilibrium_output, law.intervals, strict=True):
        low, high = inward(interval, law.precision, f"the interval of `{signal.name}`")
        rounded = nearest(Fraction(value), law.precision, f"the equilibrium value of `{signal.name}`")
        result.append(min(max(rounded, low), high))
    return tuple(result)


def check_solves(law: ControlLaw) -> None:
    """Raise ValueError unless the solves partition the channels and N couples no two solves."""
    groups = [(s.index,) if isinstance(s, ScalarSolve) else s.indices for s in law.solves]
    if sorted(i for group in groups for i in group) != list(range(law.channels)):
        raise ValueError(f"the solves {groups} do not partition the {law.channels} channels")
    group_of = {i: k for k, group in enumerate(groups) for i in group}
    for row, column in law.prepare.outputs[1].entries:
        if group_of[row] != group_of[column]:
            raise ValueError(f"N[{row}, {column}] couples channels that are solved separately")


def channels_to_check(solve: ScalarSolve | VectorSolve) -> tuple[int, ...]:
    """The channels whose c must be checked before the solve: without a residual nothing carries NaN on."""
    if isinstance(solve, VectorSolve):
        return solve.indices
    return () if solve.fit or solve.iterations else (solve.index,)


def tanh_of(law: ControlLaw) -> Callable[[Array], Array]:
    """The tanh that the law computes with, on arrays."""
    return fast_tanh if law.tanh == "fast" else np.tanh


def solve_scalar(
    mu: Array, c: Array, iterations: int, tanh: Callable[[Array], Array] = np.tanh, fit: Fit | None = None
) -> Array:
    """tanh(s) of ``s + mu tanh(s) = c``, elementwise; mu >= 0. See the module's text."""
    if fit is not None:
        return fitted(fit, c)
    one = c.dtype.type(1)
    r = np.abs(c)
    s = scalar_start(mu, r)
    t = tanh(s)
    for _ in range(iterations):
        s = s - ((s - r) + mu * t) / (one + mu * (one - t * t))
        t = tanh(s)
    result: Array = np.where(c < 0, -t, t)
    return result


def scalar_start(mu: Array, r: Array) -> Array:
    """max(r/(1 + mu), r - mu): left of the root for r, mu >= 0."""
    a = r / (r.dtype.type(1) + mu)
    b = r - mu
    start: Array = np.where(a > b, a, b)
    return start


def solve_block(
    N: Array, c: Array, solve: VectorSolve, tanh: Callable[[Array], Array] = np.tanh
) -> tuple[Array, NDArray[np.bool_]]:
    """tanh(s) of ``s + N tanh(s) = c`` and whether the residual met its limit. N: (batch, m, m), c: (batch, m)."""
    real = c.dtype.type
    r = np.abs(c)
    s = np.where(c < 0, real(-1), real(1)) * scalar_start(np.abs(np.einsum("kii->ki", N)), r)
    limit = nearest(Fraction(solve.tolerance), _precision_of(c)) * (real(1) + np.max(r, axis=1, initial=0))
    t, F, norm = _residual(N, c, s, tanh)
    active = np.ones(len(c), np.bool_)
    for _ in range(solve.iterations):
        is_last = norm <= limit
        d, regular = _newton_direction(N, t, F)
        active &= regular
        s = np.where(active[:, None], s - _cut(s, d)[:, None] * d, s)
        t_next, F_next, norm_next = _residual(N, c, s, tanh)
        keep = active & (~is_last | (norm_next < norm))
        t[keep], F[keep], norm[keep] = t_next[keep], F_next[keep], norm_next[keep]
        active &= ~is_last
        if not active.any():
            break
    return t, norm <= limit


def _cut(s: Array, d: Array) -> Array:
    """The factor of the step -d: at most 1, and no component of s changes sign to beyond -1 or 1."""
    one = s.dtype.type(1)
    crosses = ((s > 0) & (s - d < -one)) | ((s < 0) & (s - d > one))
    bound = np.divide(np.abs(s) + one, np.abs(d), out=np.ones_like(s), where=crosses)
    cut: Array = np.min(bound, axis=1, initial=1)
    return cut


def _residual(N: Array, c: Array, s: Array, tanh: Callable[[Array], Array]) -> tuple[Array, Array, Array]:
    """Values t = tanh(s), F = (s - c) + N t summed in order, and max|F| (the largest number if F is not finite)."""
    t = tanh(s)
    F = s - c
    for j in range(s.shape[1]):
        F = F + N[:, :, j] * t[:, j, None]
    largest = np.finfo(s.dtype).max
    return t, F, np.max(np.where(np.isfinite(F), np.abs(F), largest), axis=1, initial=0)


def _newton_direction(N: Array, t: Array, F: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The d with (I + N diag(1 - t t)) d = F, and whether every pivot was nonzero."""
    real = t.dtype.type
    m = t.shape[1]
    A = N * (real(1) - t * t)[:, None, :]
    A[:, range(m), range(m)] += real(1)
    d = F.copy()
    rows = np.arange(len(t))
    regular = np.ones(len(t), np.bool_)
    for k in range(m):
        pivot = k + np.argmax(np.abs(A[:, k:, k]), axis=1)
        A[rows, k], A[rows, pivot] = A[rows, pivot], A[rows, k].copy()
        d[rows, k], d[rows, pivot] = d[rows, pivot], d[rows, k].copy()
        regular &= np.abs(A[:, k, k]) > 0
        for i in range(k + 1, m):
            factor = A[:, i, k] / A[:, k, k]
            A[:, i, k + 1 :] -= factor[:, None] * A[:, k, k + 1 :]
            d[:, i] -= factor * d[:, k]
    for k in reversed(range(m)):
        for j in range(k + 1, m):
            d[:, k] -= A[:, k, j] * d[:, j]
        d[:, k] /= A[:, k, k]
    return d, regular


def _sum_of_squares(rows: Array) -> Array:
    """The sum of each row's squares, from the first entry to the last."""
    total: Array = np.zeros(len(rows), rows.dtype)
    for column in rows.T:
        total = total + column * column
    return total


def _precision_of(array: Array) -> Precision:
    return "float" if array.dtype == np.float32 else "double"


def _raise_to(status: NDArray[np.int32], where: NDArray[np.bool_], level: StepStatus) -> None:
    """Raise the status to ``level`` where it is lower."""
    status[where] = np.maximum(status[where], level)
