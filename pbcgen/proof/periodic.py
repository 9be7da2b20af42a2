"""Periodic trajectories: found in doubles by shooting, and proved by a tube around them.

Only those that attract are proved: a tube that is entered from all sides. Its frame follows the directions that decay
slowly, which the derivative of the flow over a period has (Floquet). Where steps are large beside a decay, the frame
has the eigenvectors of dF/dx instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np

from pbcgen.proof.collocation import Arc, Array, Field, Rule, arcs
from pbcgen.proof.tube import Motion, Passage, Piece, VectorField, closes, motion, passage, turns

_ROUGH, _FINE = 1e-6, 1e-11
#: What the ends of a lap may be apart.
_CLOSED = 5e-13
_ROUGH_DEGREE, _DEGREE = 6, 12
_STEPS = 16
#: Sizes of tubes along directions that decay slowly, and along others: where F bends within a short time, and else.
_BENT, _SMOOTH = ((6e-8, 4e-10), (1e-7, 3e-10)), ((1e-6, 1e-7), (6e-8, 4e-10))
#: Multipliers over a period that count as slow.
_SLOW = 1e-6
#: Decay over a piece, beyond which a direction is not followed.
_STIFF = 1.5
#: How much the frame may turn in a piece.
_TURN = 0.85
#: Pieces so short beside others are where F bends; the section may be tilted where they are not shorter than that.
_SHORT, _WIDE = 0.01, 0.1


@dataclass(frozen=True, eq=False)
class Cycle:
    """A periodic trajectory in doubles.

    Attributes:
        start: a state on it.
        duration: of the lap, seconds.
        turn: 1, or -1 where the lap leads to the opposite state, half a period away.
        arcs: of the lap.
        lap: the derivative of what the lap leads to, times ``turn``, by the start.
    """

    start: Array
    duration: float
    turn: int
    arcs: tuple[Arc, ...]
    lap: Array


@dataclass(frozen=True, eq=False)
class Tube:
    """What shows that there is a periodic trajectory: the pieces of a tube that closes."""

    pieces: tuple[Piece, ...]
    motions: tuple[Motion, ...]
    passages: tuple[Passage, ...]
    start: Array


def shoot(rates: Field, start: Array, duration: float, turn: int) -> Cycle | None:
    """A periodic trajectory near a start, by Newton's method; None if it finds none.

    Args:
        rates: the vector field.
        start: about a state on it.
        duration: about its period, or half of it where ``turn`` is -1.
        turn: -1 for fields with ``F(-x) = -F(x)`` and a trajectory that is its own image.
    """
    n, rule, tolerance, settled = len(start), Rule.of(_ROUGH_DEGREE), _ROUGH, False
    for _ in range(_STEPS):
        found = list(arcs(rates, rule, start, duration, tolerance))
        if not found or abs(sum(one.duration for one in found) / duration - 1) > 1e-9:
            return None
        lap = turn * reduce(lambda moved, one: one.spread[-1] @ moved, found, np.eye(n))
        first, last = rates(np.array([start, found[-1].states[-1]]))[0]
        left = turn * found[-1].states[-1] - start
        if np.max(np.abs(left)) < 1e-3:
            rule, tolerance = Rule.of(_DEGREE), _FINE
        if np.max(np.abs(left)) < _CLOSED and len(found[0].states) > _DEGREE:
            if settled:
                return Cycle(start, duration, turn, tuple(found), lap)
            # Laps begin where the motion is smooth: what a bend throws up then decays before they end.
            settled, start = True, max(found, key=lambda one: one.duration).states[0]
            continue
        size = np.linalg.norm(first)
        if not size > 0:
            return None  # a rest
        system = np.block([[lap - np.eye(n), turn * last[:, None] / size], [first[None] / size, np.zeros((1, 1))]])
        try:
            move = -np.linalg.solve(system, np.append(left, 0.0))
        except np.linalg.LinAlgError:
            return None
        share = min(1.0, 0.3 / max(np.max(np.abs(move[:n])), 1e-300), 0.2 * duration * size / max(abs(move[n]), 1e-300))
        if not np.isfinite(share):
            return None
        start, duration = start + share * move[:n], duration + share * move[n] / size
    return None


def tube(rates: Field, exact: VectorField, cycle: Cycle) -> Tube | None:
    """A tube around a cycle that no trajectory leaves, or None if none is found."""
    start = _Builder.of(rates, exact, cycle)
    if start is None:
        return None
    for size in _BENT if start.tilts else _SMOOTH:
        found = _along(replace(start, size=size, tilts=[*start.tilts]))
        if found is not None:
            return found
    return None


def _along(builder: _Builder) -> Tube | None:
    """The tube of a size."""
    rates, cycle, covered = builder.rates, builder.cycle, 0.0
    for one in arcs(rates, Rule.of(_DEGREE), cycle.start, cycle.duration, _FINE, builder.fits):
        builder.take(one)
        covered += one.duration
    if abs(covered / cycle.duration - 1) > 1e-9:
        return None
    return builder.closed()


@dataclass(eq=False)
class _Builder:
    """The frame of a tube along the arcs of a cycle.

    The columns are ``v_i - a_i c' / g_i`` with v_i = Phi v_i(0) / g_i for slow directions: the number a_i tilts the
    section, so that where F bends within a short time it is the set on which it bends. Others are made orthogonal.
    """

    rates: Field
    exact: VectorField
    cycle: Cycle
    slow: Array
    grown: Array
    tilt: Array
    tilts: list[tuple[float, Array]]
    rest: Array
    factors: Array
    size: tuple[float, float] = (0.0, 0.0)
    time: float = 0.0
    pieces: list[Piece] = field(default_factory=list, init=False)
    motions: list[Motion] = field(default_factory=list, init=False)
    pending: tuple[Piece, Motion, Array, Array] | None = field(default=None, init=False)

    @staticmethod
    def of(rates: Field, exact: VectorField, cycle: Cycle) -> _Builder | None:
        """None where the cycle does not attract."""
        values, vectors = np.linalg.eig(cycle.lap)
        first = rates(cycle.start[None])[0][0]
        along = int(np.argmin(np.abs(values - 1)))
        others = [k for k in np.argsort(-np.abs(values)) if k != along]
        if abs(values[along] - 1) > 1e-3 or any(abs(values[k]) >= 1 for k in others):
            return None
        columns, sizes = [], []
        for k in others:
            if abs(values[k]) > _SLOW and values[k].imag >= 0:
                parts = [vectors[:, k].real] + ([vectors[:, k].imag] if values[k].imag > 0 else [])
                columns += [v / np.linalg.norm(v) for v in parts]
                sizes += [abs(values[k]) for _ in parts]
        slow = np.array(columns).T.reshape(len(first), -1)
        tilts = _tilts(rates, cycle, slow)
        straight = np.zeros(len(sizes))
        frame = np.column_stack([first / np.linalg.norm(first), slow, np.eye(len(first))])
        rest = np.linalg.qr(frame)[0][:, 1 + slow.shape[1] :]
        return _Builder(rates, exact, cycle, slow, np.ones(len(sizes)), straight, tilts, rest, np.array(sizes))

    def fits(self, one: Arc) -> float:
        """How much longer an arc may be: at least 1 if the piece of the tube along it is proved."""
        while self.tilts and self.time >= self.tilts[0][0]:
            self.tilt = self.tilts.pop(0)[1]
        n, first = one.states.shape[1], self.rates(one.states[:1])[0][0]
        own = self.slow - np.outer(first, self.tilt / self.grown)
        A = self.rates(one.series[:1])[1][0]
        stiff, decays = _stiff(A, one.duration, self.rest.shape[1])
        followed = np.column_stack([own, self.rest[:, : self.rest.shape[1] - stiff.shape[1]]])
        moved = one.spread @ followed
        lengths = np.linalg.norm(np.column_stack([one.spread[-1] @ self.slow, moved[-1, :, own.shape[1] :]]), axis=0)
        logs = np.log(np.maximum(lengths, 1e-300)) / one.duration
        times = (one.rule.points + 1) / 2 * one.duration
        frame = np.zeros((len(times), n, n - 1))
        frame[:, :, : moved.shape[2]] = np.tensordot(one.rule.series, moved * np.exp(-logs * times[:, None, None]), 1)
        frame[0, :, moved.shape[2] :] = stiff
        size = np.full(n - 1, self.size[1])
        size[: own.shape[1]] = self.size[0] * self.grown * self.factors ** (-self.time / self.cycle.duration)
        piece = Piece(one.duration, one.series, frame * size, np.concatenate([logs, decays]))
        turned = turns(piece)
        if turned > _TURN:
            return 0.8 * _TURN / turned
        found = motion(self.exact, piece)
        if found is None:
            return 0.6
        self.pending = piece, found, moved[-1, :, own.shape[1] :], stiff
        return max(1.7, 0.9 * _TURN / turned)

    def take(self, one: Arc) -> None:
        """Go on to the end of the arc that fitted last."""
        assert self.pending is not None
        piece, found, rest, stiff = self.pending
        self.pieces.append(piece)
        self.motions.append(found)
        slow = one.spread[-1] @ self.slow
        lengths = np.linalg.norm(slow, axis=0)
        self.slow, self.grown, self.time = slow / lengths, self.grown * lengths, self.time + one.duration
        first = self.rates(one.states[-1:])[0][0]
        columns = np.column_stack([first, self.slow, rest, stiff])
        columns = columns / np.linalg.norm(columns, axis=0)
        self.rest = np.linalg.qr(columns)[0][:, 1 + slow.shape[1] :]

    def closed(self) -> Tube | None:
        """The tube, if its end leads into its start."""
        turn, following = self.cycle.turn, [*self.pieces[1:], self.pieces[0]]
        signs = [1] * (len(self.pieces) - 1) + [turn]
        last = passage(self.pieces[-1], self.motions[-1], self.pieces[0], 0.0, turn)
        late, passages = 0.0 if last is None else last.late, []
        for piece, found, then, sign in zip(self.pieces, self.motions, following, signs, strict=True):
            one = passage(piece, found, then, late, sign)
            if one is None:
                return None
            late = one.late
            passages.append(one)
        start = closes(passages, self.pieces, self.motions)
        return None if start is None else Tube(tuple(self.pieces), tuple(self.motions), tuple(passages), start)


def period(found: Tube) -> tuple[float, float]:
    """Bounds of the time of a lap, seconds."""
    parts = zip(found.pieces, found.motions, found.passages, strict=True)
    bounds = [(p.duration, p.duration * m.slip / (1 - m.slip) + one.late * 2) for p, m, one in parts]
    time, error = (sum(values) * 1.0 for values in zip(*bounds, strict=True))
    return time - error * 1.01, time + error * 1.01


def _stiff(A: Array, duration: float, most: int) -> tuple[Array, Array]:
    """Unit vectors along which the motion decays within a piece, slowest first, and their rates."""
    values, vectors = np.linalg.eig(A)
    chosen = [k for k in np.argsort(values.real) if values[k].real * duration < -_STIFF][:most]
    columns: list[Array] = []
    for k in chosen:
        if values[k].imag == 0:
            columns.append(vectors[:, k].real)
        elif values[k].imag > 0:
            columns += [vectors[:, k].real, vectors[:, k].imag]
    chosen = chosen[: len(columns)]
    kept = [v / np.linalg.norm(v) for v in columns[: len(chosen)][::-1]]
    return np.array(kept).T.reshape(len(A), -1), values[chosen[::-1]].real


def _tilts(rates: Field, cycle: Cycle, slow: Array) -> list[tuple[float, Array]]:
    """When to tilt the section, and how: so that each slow direction lies in the set on which F bends next."""
    lengths = np.array([one.duration for one in cycle.arcs])
    starts = np.concatenate([[0.0], np.cumsum(lengths)])
    found, before, vectors, grown = [], 0, [slow], [np.ones(slow.shape[1])]
    for one in cycle.arcs:
        moved = one.spread[-1] @ vectors[-1]
        size = np.linalg.norm(moved, axis=0)
        vectors.append(moved / size)
        grown.append(grown[-1] * size)
    for k in _bends(lengths):
        first = rates(cycle.arcs[k].states[:1])[0][0]
        normal = _normal(rates, cycle.arcs[max(0, k - 3) : k + 4], first)
        at = before + int(np.argmax(lengths[before : k + 1]))
        if abs(normal @ first) > 1e-3 * np.linalg.norm(first) * np.linalg.norm(normal):
            found.append((float(starts[at]), grown[k] * (normal @ vectors[k]) / (normal @ first)))
        before = k
    if found:
        behind = before + int(np.argmax(lengths[before:] > _WIDE * np.max(lengths)))
        found.append((float(starts[behind]), np.zeros(slow.shape[1])))
    return found


def _bends(lengths: Array) -> Iterator[int]:
    """The shortest of each run of short pieces."""
    # What is short at the ends of a lap is so for other reasons.
    short = np.append(lengths < _SHORT * np.median(lengths[lengths >= np.median(lengths)]), False)
    first: int | None = None
    for k, inside in enumerate(short):
        if inside and first is None:
            first = k
        if not inside and first is not None:
            if first > 0 and k < len(lengths):
                yield first + int(np.argmin(lengths[first:k]))
            first = None


def _normal(rates: Field, near: tuple[Arc, ...], along: Array) -> Array:
    """The direction in which dF/dx changes most, of those that the trajectory takes part in."""
    total, n = np.zeros((len(along), len(along))), len(along)
    for one in near:
        states = one.states[1::3]
        base = rates(states)[1]
        moved = [(rates(states + 1e-8 * e)[1] - base) / 1e-8 for e in np.eye(n)]
        G = np.stack(moved, axis=-1).reshape(-1, n)
        total += G.T @ G * one.duration**2
    return np.asarray(total @ along)
