"""A tube around a closed curve that no trajectory of ``x' = F(x)`` leaves, and that holds a periodic one.

A piece of the tube is ``{c(theta) + W(theta) y : abs(y_i) <= 1}`` for theta in an interval of time, c and the n - 1
columns of W being polynomials. With ``x = c + W y`` the motion is (theta', y'), which solve

    [c' + W' y, W] (theta', y') = F(c + W y).

(1, Lambda y), with numbers Lambda, leaves ``r + E y`` of it, ``r = F(c) - c'`` and ``E = A W - W' - W Lambda``, where A
is a mean of dF/dx over the tube. Let V be a matrix with ``abs(I - V [c' + W' y, W]) <= K``, K X + B <= X and
``B >= abs(V (r, E))``. Then ``abs(theta' - 1)`` and ``abs(y' - Lambda y)`` are at most ``X (1, abs(y))``: where
``theta' > 0``, the ``abs(y_i)`` as functions of theta stay below the solution of a linear system with the same or
larger start, whose matrix has no negative entries off the diagonal (Kamke). It is evaluated from piece to piece, and
must end below what it started with. Then

- the return map takes the section at the end of the last piece, which is compact and convex, into itself, and is
  continuous, because theta' > 0: it has a fixed point (Brouwer), and the trajectory through it is periodic;
- no trajectory leaves the tube, which holds no equilibrium: theta' is zero at one.

r and E, at a fixed y, are analytic in theta. So they are bounded by what they are at Chebyshev's points, times the
Lebesgue constant, and ``4 M rho^(1 - K) / (rho - 1)``, where M bounds them on Bernstein's ellipse of parameter rho
(Trefethen, Approximation Theory, thm. 8.2). F must be analytic there, which its evaluation in complex balls shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, TypeAlias

import numpy as np
from flint import acb, arb, arb_mat
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from pbcgen.symbolic.complex_balls import COMPLEX
from pbcgen.symbolic.real import REAL, ZERO, Real, precision
from pbcgen.symbolic.tape import Tape

Array: TypeAlias = NDArray[np.float64]
Place: TypeAlias = tuple[int, int]
#: A tape, and its inputs behind the state, in balls and in complex balls.
_Prepared: TypeAlias = tuple[Tape, list[list[Any]], list[list[Any]]]

#: Bits of the balls.
_BITS = 96
#: Chebyshev's points at which F and dF/dx are evaluated, and the parameter of the ellipse.
_POINTS, _SLOPE_POINTS, _ELLIPSE = 24, 13, 4.0
#: By how much of its half-length a piece is longer at both ends than what is passed through.
_OVERLAP = 4e-3
#: More than what rounding does to sums of so few products of doubles without signs, and to what is rounded up.
_UP, _ROUNDING, _TINY = 1 + 1e-11, 1e-13, 1e-300
_ROOM = 1 + 1e-6
#: Powers of a matrix in a sum of 2 to this number of them.
_DOUBLINGS = 9
#: Rounds of a bound's improvement, and factors by which bounds may grow in a piece.
_ROUNDS, _FACTORS = 40, (1.3, 2.7)
#: States on a piece for people.
_SAMPLES = 400


@dataclass(frozen=True, eq=False)
class VectorField:
    """F and dF/dx of n states as tapes of the state and of constants, which have these values."""

    rate: Tape
    slope: Tape
    n: int
    constants: Sequence[Sequence[Real]] = ()

    def at(self, state: Sequence[arb]) -> list[Real]:
        """F in balls."""
        tape, values, _ = self._rate
        return tape.walk(REAL, [state, *values])[0].column(ZERO)

    def slopes(self, state: Sequence[arb]) -> arb_mat:
        """dF/dx in balls."""
        tape, values, _ = self._slope
        return arb_mat(tape.walk(REAL, [state, *values])[0].dense(ZERO))

    def beside(self, state: Sequence[acb]) -> tuple[Mapping[Place, acb], Mapping[Place, acb]]:
        """F and dF/dx in complex balls, by the places of their entries."""
        both = [tape.walk(COMPLEX, [state, *values])[0].entries for tape, _, values in (self._rate, self._slope)]
        return both[0], both[1]

    @cached_property
    def _rate(self) -> _Prepared:
        return self._prepared(self.rate)

    @cached_property
    def _slope(self) -> _Prepared:
        return self._prepared(self.slope)

    def _prepared(self, tape: Tape) -> _Prepared:
        """What depends on constants alone is computed once."""
        with precision(_BITS):
            left, held = tape.given(REAL, {k: list(part) for k, part in enumerate(self.constants, 1)})
            empty: list[list[Any]] = [[] for _ in self.constants]
            return left, [*empty, held], [*empty, [acb(v) for v in held]]


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of a tube, as Chebyshev coefficients over its time.

    Attributes:
        duration: in seconds.
        centre: (d + 1, n), c.
        frame: (d + 1, n, n - 1), W.
        rates: (n - 1,), Lambda.
    """

    duration: float
    centre: Array
    frame: Array
    rates: Array


@dataclass(frozen=True, eq=False)
class Motion:
    """What holds in a piece: ``abs(theta' - 1) <= slip``, and ``d abs(y) / dt <= matrix abs(y) + push``."""

    matrix: Array
    push: Array
    slip: float


def motion(field: VectorField, piece: Piece) -> Motion | None:
    """Bounds of the motion in a piece, or None if it may turn back, or F is not shown to be analytic."""
    n, size = field.n, _sizes(len(piece.centre), 1 + _OVERLAP)
    by_time = _derivative(len(piece.centre)) * (2 / piece.duration)
    speed = np.tensordot(by_time, piece.centre, 1)
    basis = np.concatenate([speed[:, :, None], piece.frame], axis=2)
    try:
        V = np.linalg.inv(basis[0])
    except np.linalg.LinAlgError:
        return None
    sums = np.tensordot(np.abs(by_time), np.abs(piece.centre), 1), np.tensordot(np.abs(by_time), np.abs(piece.frame), 1)
    parts = np.einsum("ij,kjl->kil", V, basis)
    parts[0] -= np.eye(n)
    whole = np.concatenate([sums[0][:, :, None], np.abs(piece.frame)], axis=2)
    K = np.tensordot(size, np.abs(parts) + _ROUNDING * np.einsum("ij,kjl->kil", np.abs(V), whole), 1)
    K[:, 0] += np.abs(V) @ np.tensordot(size, sums[1], 1).sum(axis=1)
    found = _misfits(field, piece, V, sums)
    if found is None:
        return None
    X = _resolved(K * _UP, found)
    if X is None:
        return None
    slip = float(X[0].sum()) * _UP
    return Motion(np.diag(piece.rates) + X[1:, 1:], X[1:, 0], slip) if slip < 0.1 else None


def _misfits(field: VectorField, piece: Piece, V: Array, sums: tuple[Array, Array]) -> Array | None:
    """Bounds of ``V (r, E)``, n x n."""
    n, degree = field.n, len(piece.centre)
    bound = _on_ellipse(field, piece, V, sums)
    if bound is None:
        return None
    with precision(_BITS):
        left, duration = arb_mat(V.tolist()), arb(piece.duration)
        centre, frame = arb_mat(piece.centre.tolist()), arb_mat(piece.frame.reshape(degree, -1).tolist())
        at, slopes = _points(degree, _POINTS)
        place, speed = at * centre, slopes * centre * (2 / duration)
        rows = [field.at([place[k, i] for i in range(n)]) for k in range(_POINTS)]
        push = _largest((left * (arb_mat(rows) - speed).transpose()).transpose())
        at, slopes = _points(degree, _SLOPE_POINTS)
        place, wide, turning = at * centre, at * frame, slopes * frame * (2 / duration)
        rates, found = arb_mat(np.diag(piece.rates).tolist()), np.zeros((n, n - 1))
        for k in range(_SLOPE_POINTS):
            W, bend = (arb_mat(n, n - 1, [m[k, i] for i in range(n * (n - 1))]) for m in (wide, turning))
            reach = [sum((abs(W[i, j]) for j in range(n - 1)), arb(0)) for i in range(n)]
            A = field.slopes([place[k, i] + arb(0, reach[i].abs_upper()) for i in range(n)])
            E = left * (A * W - bend - W * rates)
            found = np.maximum(found, _entries(E))
    points = np.array([_POINTS, *[_SLOPE_POINTS] * (n - 1)])
    lebesgue = 2 / np.pi * np.log(points + 1) + 1.001
    beyond = 4 * _ELLIPSE ** (1.0 - points) / (_ELLIPSE - 1)
    both = lebesgue * np.column_stack([push, found]) + beyond * bound
    return both * _UP if np.all(np.isfinite(both)) else None


def _on_ellipse(field: VectorField, piece: Piece, V: Array, sums: tuple[Array, Array]) -> Array | None:
    """Bounds of ``V (r, E)`` on the ellipse, n x n, or None where F is not analytic."""
    found = _around(field, piece)
    if found is None:
        return None
    (F, A), sizes = found, _on_axis(len(piece.centre))
    reach = np.tensordot(sizes, np.abs(piece.frame), 1)
    push = F + sizes @ sums[0]
    drift = A @ reach + np.tensordot(sizes, sums[1], 1) + reach * np.abs(piece.rates)
    return _finite(np.abs(V) @ np.column_stack([push, drift]) * _UP)


def _around(field: VectorField, piece: Piece) -> tuple[Array, Array] | None:
    """Bounds of F and dF/dx on the ellipse, and in the tube about it; None where F is not analytic."""
    n, sizes = field.n, _on_axis(len(piece.centre))
    reach = np.tensordot(sizes, np.abs(piece.frame), 1).sum(axis=1)
    radius = (sizes[1:] @ np.abs(piece.centre[1:]) + reach) * _UP
    F, A = np.zeros(n), np.zeros((n, n))
    with precision(_BITS):
        place = [acb(arb(m, r), arb(0, r)) for m, r in zip(piece.centre[0].tolist(), radius.tolist(), strict=True)]
        rate, slope = field.beside(place)
        for (i, _), v in rate.items():
            F[i] = _upper(v)
        for at, v in slope.items():
            A[at] = _upper(v)
    return (F, A) if np.all(np.isfinite(F)) and np.all(np.isfinite(A)) else None


def _on_axis(count: int) -> Array:
    """Bounds of Chebyshev's polynomials on the ellipse of the interval with its overlap."""
    powers = (_ELLIPSE * (1 + _OVERLAP) ** 2) ** np.arange(count)
    return np.asarray((powers + 1 / powers) / 2 * _UP)


def _upper(value: Any) -> float:
    """A double that the modulus does not exceed."""
    return float(value.abs_upper()) * _UP + _TINY


def _entries(matrix: arb_mat) -> Array:
    """Bounds of the moduli of the entries."""
    return np.array([[_upper(v) for v in row] for row in matrix.tolist()])


def _largest(matrix: arb_mat) -> Array:
    """Bounds of the moduli in each column."""
    return np.asarray(_entries(matrix).max(axis=0))


def _sizes(count: int, end: float) -> Array:
    """Bounds of Chebyshev's polynomials up to ``end``, which is at least one."""
    return np.asarray(np.cosh(np.arange(count) * np.arccosh(end)) * _UP)


@lru_cache(16)
def _derivative(count: int) -> Array:
    """What takes the coefficients of a sum of Chebyshev's polynomials to those of its derivative: integers."""
    D = np.zeros((count, count))
    D[:-1] = chebyshev.chebder(np.eye(count), axis=0)
    return D


@lru_cache(16)
def _points(count: int, points: int) -> tuple[arb_mat, arb_mat]:
    """Chebyshev's polynomials, and their derivatives, at Chebyshev's points of the interval with its overlap."""
    with precision(2 * _BITS):
        rows = []
        for k in range(points):
            x = (arb.pi() * (2 * k + 1) / (2 * points)).cos() * arb(1 + _OVERLAP)
            row = [arb(1), x]
            while len(row) < count:
                row.append(2 * x * row[-1] - row[-2])
            rows.append(row[:count])
        at = arb_mat(rows)
        return at, at * arb_mat(_derivative(count).tolist())


@dataclass(frozen=True, eq=False)
class Passage:
    """From the start of a piece to that of the next one: ``abs(y)`` becomes at most ``matrix abs(y) + push``.

    Attributes:
        matrix, push: without negative entries.
        late: seconds by which the next piece may be entered before or after its start.
    """

    matrix: Array
    push: Array
    late: float


def passage(piece: Piece, found: Motion, following: Piece, late: float, turn: int) -> Passage | None:
    """How the tube goes on, or None if the next piece may be missed.

    Args:
        piece: what is left.
        found: the motion there.
        following: what is entered.
        late: seconds by which the piece may have been entered before or after its start.
        turn: -1 where what is entered is the following piece with the opposite sign.
    """
    n, ends = len(found.push) + 1, _ends(len(piece.centre)) * turn
    starts, by_time = _ends(len(following.centre), -1.0), _derivative(len(following.centre)) * (2 / following.duration)
    basis = np.column_stack([starts @ by_time @ following.centre, np.tensordot(starts, following.frame, 1)])
    try:
        V = np.linalg.inv(basis)
    except np.linalg.LinAlgError:
        return None
    size = np.abs(V)
    both = [np.abs(part).sum(axis=0) for part in (piece.centre, following.centre, piece.frame)]
    jump = np.abs(V @ (ends @ piece.centre - starts @ following.centre)) + _ROUNDING * size @ (both[0] + both[1])
    turned = np.abs(V @ np.tensordot(ends, piece.frame, 1)) + _ROUNDING * size @ both[2]
    most = 2 * float(jump[0] + turned[0].sum()) + _TINY
    rate, stretch = np.abs(by_time), _sizes(len(following.centre), 1 + _OVERLAP)
    bend = stretch @ rate @ rate @ np.abs(following.centre)
    turning = np.tensordot(stretch @ rate, np.abs(following.frame), 1)
    sums = np.column_stack([(rate @ np.abs(following.centre)).sum(axis=0), np.abs(following.frame).sum(axis=0)])
    K = np.abs(np.eye(n) - V @ basis) + _ROUNDING * size @ sums
    K += size @ np.column_stack([bend * most + turning.sum(axis=1), turning * most])
    X = _resolved(K, np.column_stack([jump, turned]))
    grown = _grown(piece, found, late)
    if X is None or grown is None or X[0].sum() > most or most > _OVERLAP * following.duration / 2:
        return None
    return Passage(X[1:, 1:] @ grown[:, :-1] * _UP, (X[1:, 1:] @ grown[:, -1] + X[1:, 0]) * _UP, most)


def _grown(piece: Piece, found: Motion, late: float) -> Array | None:
    """Bounds of what (y, 1) becomes through a piece, n - 1 x n."""
    n = len(found.push) + 1
    with precision(_BITS):
        time = arb(piece.duration, late)
        matrix = arb_mat(n, n, [arb(v) * time for row in _by_theta(found) for v in row])
        grown = matrix.exp()
        return _finite(np.array([[_upper(grown[i, j]) for j in range(n)] for i in range(n - 1)]))


def _by_theta(found: Motion) -> list[list[float]]:
    """The linear system by theta, with a last variable that is one."""
    whole = np.column_stack([found.matrix, found.push])
    slower = np.where(whole > 0, whole / (1 - found.slip) * _UP, whole / (1 + found.slip) / _UP)
    return [*slower.tolist(), [0.0] * len(whole[0])]


def stays(piece: Piece, found: Motion, start: Array) -> bool:
    """Whether ``abs(y)`` stays below one in a piece, from a start.

    It is below a vector that grows by some factor, or below what it would be if nothing decayed.
    """
    system = np.array(_by_theta(found)[:-1])
    matrix, push, decay = system[:, :-1], system[:, -1], np.minimum(np.diag(system), 0.0)
    for factor in _FACTORS:
        grow, bound = np.log(factor) / piece.duration, start * _ROOM + _TINY
        with np.errstate(all="ignore"):
            for _ in range(_ROUNDS):
                pulled = matrix @ bound + push - decay * bound
                bound = np.maximum(bound, pulled * _ROOM / (grow - decay))
            slack = _ROUNDING * (np.abs(matrix) @ bound + push)
            if np.all(matrix @ bound + push + slack <= grow * bound) and np.all(bound * factor * 1.01 < 1):
                return True
    still = replace(found, matrix=found.matrix - np.diag(np.minimum(np.diag(found.matrix), 0.0)))
    grown = _grown(piece, still, piece.duration * _OVERLAP)
    return grown is not None and bool(np.all((grown[:, :-1] @ start + grown[:, -1]) * _UP < 1))


def closes(passages: Sequence[Passage], pieces: Sequence[Piece], motions: Sequence[Motion]) -> Array | None:
    """The ``abs(y)`` at the start of the first piece that a lap makes no larger, or None; late as the last passage."""
    matrix, push = np.eye(len(passages[0].push)), np.zeros(len(passages[0].push))
    for one in passages:
        matrix, push = one.matrix @ matrix, one.matrix @ push + one.push
    try:
        start = np.asarray(np.linalg.solve(np.eye(len(push)) - matrix, push) * 1.01, dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    if not np.all(start > 0):
        return None
    y = start
    for one, piece, found in zip(passages, pieces, motions, strict=True):
        if not stays(piece, found, y):
            return None
        y = (one.matrix @ y + one.push) * _UP
    return start if np.all(y <= start) else None


def _resolved(K: Array, found: Array) -> Array | None:
    """X with ``K X + B <= X``, or None if the spectral radius of K is not below one.

    ``(1 + K) (1 + K^2) (1 + K^4) ...`` has no differences, so that its small entries are good too.
    """
    power, total = K * _ROOM, np.eye(len(K))
    for _ in range(_DOUBLINGS):
        total, power = total + total @ power, power @ power
    X: Array = total @ found * _ROOM + _TINY
    return X if np.all(np.isfinite(X)) and np.all((K @ X + found) * _UP <= X) else None


def _finite(values: NDArray[np.floating[Any]]) -> Array | None:
    return np.asarray(values, dtype=np.float64) if np.all(np.isfinite(values)) else None


@lru_cache(16)
def _ends(count: int, side: float = 1.0) -> Array:
    """Chebyshev's polynomials at an end of the interval."""
    return np.asarray(side ** np.arange(count), dtype=np.float64)


def turns(piece: Piece) -> float:
    """About how much the frame turns in a piece: it must be below one."""
    by_time = _derivative(len(piece.centre)) * (2 / piece.duration)
    basis = np.concatenate([np.tensordot(by_time, piece.centre, 1)[:, :, None], piece.frame], axis=2)
    try:
        parts = np.einsum("ij,kjl->kil", np.linalg.inv(basis[0]), basis[1:])
    except np.linalg.LinAlgError:
        return float("inf")
    K = np.tensordot(_sizes(len(basis), 1 + _OVERLAP)[1:], np.abs(parts), 1)
    return float(np.max(np.abs(np.linalg.eigvals(K)))) if np.all(np.isfinite(K)) else float("inf")


def analytic(field: VectorField, piece: Piece) -> bool:
    """Whether F is shown to be analytic about a piece."""
    return _around(field, piece) is not None


def hull(piece: Piece) -> tuple[Array, Array]:
    """The least and the largest value of each state in a piece of the tube."""
    sizes = _sizes(len(piece.centre), 1 + _OVERLAP)
    reach = sizes[1:] @ np.abs(piece.centre[1:]) + np.tensordot(sizes, np.abs(piece.frame), 1).sum(axis=1)
    reach = reach * _UP + _ROUNDING * np.abs(piece.centre[0])
    return piece.centre[0] - reach, piece.centre[0] + reach


def along(piece: Piece) -> Array:
    """States on the centre of a piece in doubles, the start first."""
    times, degree = np.linspace(-1.0, 1.0, _SAMPLES), len(piece.centre) - 1
    return np.asarray(chebyshev.chebvander(times, degree) @ piece.centre)
