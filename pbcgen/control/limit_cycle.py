"""Motions of the closed loop that go around for ever, so that x* does not attract from everywhere.

Where they may be is looked for by harmonic balance: in a motion ``z* + Re(v exp(i omega t))`` a saturation acts like
the linear function with its first harmonic, whose slope falls with the amplitude. Where the linear loop with such
slopes grows at smaller amplitudes and decays at larger ones there may be a periodic motion that attracts. It is then
looked for in doubles, and proved by :mod:`pbcgen.proof.tube`: what starts near it stays there, and x* is not there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice, pairwise
from typing import TypeAlias

import casadi as ca
import numpy as np
from flint import fmpq
from numpy.typing import NDArray

from pbcgen.control.situation import Situation
from pbcgen.control.whole_loop import WholeLoop
from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.region import Region
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.collocation import Array, Field
from pbcgen.proof.periodic import Tube, period, shoot, tube
from pbcgen.proof.tube import VectorField, along, hull
from pbcgen.symbolic.doubles import Doubles
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.real import Real, approximate, fraction, midpoint, rational
from pbcgen.symbolic.tape import Tape

#: The method of the claim that this refutes.
METHOD = "a tube around a periodic motion that no trajectory leaves, in ball arithmetic"
#: Larger loops are not tried, nor more motions of one loop.
_MOST, _GUESSES = 14, 2
#: The largest argument of a saturation, in powers of ten, and how finely amplitudes are looked at.
_FIRST, _LAST, _PER_DECADE = 0, 8, 4
#: Improvements of the slopes at one amplitude, and of an amplitude.
_ROUNDS, _HALVINGS = 12, 12
_PHASES = np.arange(8) * (2 * np.pi / 8)
_ARC = np.cos((np.arange(64) + 0.5) * (np.pi / 128))

_Complex: TypeAlias = NDArray[np.complex128]
#: The largest argument of a saturation, how fast the motion grows, and the slopes.
_Seen: TypeAlias = tuple[float, float, Array]


def limit_cycle(situation: Situation) -> Claim | str:
    """`globally-asymptotically-stable` REFUTED by a periodic motion; else evidence for one in words, or nothing."""
    if situation.order > _MOST or situation.found["equilibrium"].status is not Status.PROVED:
        return ""
    evidence = ""
    try:
        loop = WholeLoop.of(situation)
        for guess in () if loop is None else islice(_balanced(loop), _GUESSES):
            evidence = evidence or (
                f"harmonic balance suggests a periodic motion of period {2 * np.pi / guess.omega:.3g} s, which was not "
                "proved"
            )
            found = None if loop is None else _proved(situation, loop, guess)
            if found is not None:
                return found
    except (UnsupportedOperation, ZeroDivisionError, np.linalg.LinAlgError):
        return evidence
    return evidence


@dataclass(frozen=True, eq=False)
class _Guess:
    """A motion ``Re(v exp(i omega t))`` around z* that harmonic balance finds."""

    v: _Complex
    omega: float


def _balanced(loop: WholeLoop) -> Iterator[_Guess]:
    """Motions that would attract, the largest first."""
    slopes = _Slopes.of(loop)
    grid = 10.0 ** np.linspace(_FIRST, _LAST, _PER_DECADE * (_LAST - _FIRST) + 1)
    share, seen = np.ones(loop.t.numel()), []  # type: Array, list[_Seen]
    for size in grid:
        state = slopes.settle(size, share)
        if state is None:
            break
        share = state[2]
        seen.append((size, state[0].real, share))
    for smaller, larger in reversed(list(pairwise(seen))):
        if smaller[1] > 0 > larger[1] and (found := _between(slopes, smaller, larger)) is not None:
            yield found


def _between(slopes: _Slopes, smaller: _Seen, larger: _Seen) -> _Guess | None:
    """The motion that neither grows nor decays, between amplitudes that grow and decay."""
    low, high, share, found = smaller[0], larger[0], larger[2], None
    for _ in range(_HALVINGS):
        middle = float(np.sqrt(low * high))
        state = slopes.settle(middle, share)
        if state is None:
            return None
        found = _Guess(state[1], state[0].imag)
        low, high = (middle, high) if state[0].real > 0 else (low, middle)
    return found


@dataclass(frozen=True, eq=False)
class _Slopes:
    """The linear parts of a loop in doubles: of the rate by z and by t, and of the arguments."""

    star: Array
    function: Doubles
    count: int

    @staticmethod
    def of(loop: WholeLoop) -> _Slopes:
        parts = [ca.jacobian(loop.rate, loop.z), ca.jacobian(loop.rate, loop.t), ca.jacobian(loop.arguments, loop.z)]
        star = np.array([approximate(v) for v in loop.star])
        return _Slopes(star, Doubles([loop.z, loop.t], [_at_values(loop, part) for part in parts]), loop.t.numel())

    def settle(self, size: float, share: Array) -> tuple[complex, _Complex, Array] | None:
        """The fastest oscillation, its amplitudes and the slopes, where the largest argument has this size."""
        v: _Complex = np.zeros(len(self.star), dtype=complex)
        value = 0j
        with np.errstate(all="ignore"):
            for _ in range(_ROUNDS):
                places = self.star + (np.exp(1j * _PHASES)[:, None] * v).real
                by_z, by_t, seen = (part.mean(axis=0) for part in self._at(places))
                matrix = by_z + (by_t * share) @ seen
                if not np.all(np.isfinite(matrix)):
                    return None
                values, vectors = np.linalg.eig(matrix)
                turning = [k for k in range(len(values)) if values[k].imag > 1e-6 * abs(values[k])]
                if not turning:
                    return None
                chosen = max(turning, key=lambda k: values[k].real)
                value, v = complex(values[chosen]), vectors[:, chosen]
                largest = np.max(np.abs(seen @ v))
                if not largest > 0:
                    return None
                v = v * (size / largest)
                share = np.sqrt(share * _described(np.abs(seen @ v)))
        return value, v, share

    def _at(self, places: Array) -> list[Array]:
        return self.function.many(places, np.zeros((len(places), self.count)))


def _described(amplitude: Array) -> Array:
    """The slope with which tanh acts on a cosine of this amplitude: its describing function."""
    sizes = np.maximum(amplitude, 1e-9)
    return np.asarray(2 * np.mean(np.tanh(np.outer(sizes, _ARC)) * _ARC, axis=1) / sizes)


def _at_values(loop: WholeLoop, expression: ca.SX) -> ca.SX:
    """The expression with constants and parameters as doubles."""
    for symbols, values in zip(loop.symbols, loop.values, strict=True):
        if values:
            expression = ca.substitute(expression, symbols, ca.DM([approximate(v) for v in values]))
    return expression


# --- proof -----------------------------------------------------------------------------------------------------------


def _proved(situation: Situation, loop: WholeLoop, guess: _Guess) -> Claim | None:
    """The claim by a cycle near a guess."""
    sizes = np.abs(guess.v)
    scale = np.exp2(np.round(np.log2(np.where(sizes > 1e-12 * np.max(sizes), sizes, 1.0))))
    scaled = _Scaled.of(loop, scale)
    turn = -1 if scaled.is_odd() else 1
    lap = 2 * np.pi / guess.omega / (2 if turn < 0 else 1)
    cycle = shoot(scaled.rates, guess.v.real / scale, lap, turn)
    found = None if cycle is None else tube(scaled.rates, scaled.exact, cycle)
    if found is None or not _in_domain(situation, scaled, found, turn):
        return None
    return _claim(situation, scaled, found, turn)


@dataclass(frozen=True, eq=False)
class _Scaled:
    """The loop in coordinates ``y = (z - centre) / scale``, in doubles and exactly; centre is z*, or near it."""

    loop: WholeLoop
    centre: tuple[fmpq, ...]
    scale: Array
    rates: Field
    exact: VectorField

    @staticmethod
    def of(loop: WholeLoop, scale: Array) -> _Scaled:
        n = loop.z.numel()
        centre = tuple(v if isinstance(v, fmpq) else rational(midpoint(v)) for v in loop.star)
        y, middle, size, back = (ca.SX.sym(name, n) for name in ("y", "middle", "size", "back"))
        rate = ca.substitute(loop.closed, loop.z, middle + size * y) * back
        slope = ca.jacobian(rate, y)
        inputs = [y, middle, size, back, *loop.symbols]
        powers = [fmpq(*v.as_integer_ratio()) for v in scale.tolist()]
        constants: list[list[Real]] = [list(centre), powers, [1 / v for v in powers]]
        constants += [list(part) for part in loop.values]
        exact = VectorField(Tape.of(inputs, [rate]), Tape.of(inputs, [slope]), n, constants)
        numbers = [ca.DM([approximate(v) for v in part]) for part in constants]
        parts = [rate, slope]
        for symbol, value in zip(inputs[1:], numbers, strict=True):
            parts = [ca.substitute(part, symbol, value) if symbol.numel() else part for part in parts]
        doubles = Doubles([y], parts)

        def rates(states: Array) -> tuple[Array, Array]:
            value, by = doubles.many(states)
            return value[:, :, 0], by

        return _Scaled(loop, centre, scale, rates, exact)

    def is_odd(self) -> bool:
        """Whether the loop at the opposite state moves the opposite way, exactly."""
        loop, exact = self.loop, [v for part in (self.loop.star, *self.loop.values) for v in part]
        if not all(isinstance(v, fmpq) for v in exact):
            return False
        y, middle = (ca.SX.sym(name, loop.z.numel()) for name in ("y", "middle"))
        both = [ca.substitute(loop.closed, loop.z, middle + side * y) for side in (1, -1)]
        tape = Tape.of([y, middle, *loop.symbols], [both[0] + both[1]])
        names = [f"{k}" for k in range(sum(tape.input_sizes))]
        known = {names[loop.z.numel() + k]: fraction(v) for k, v in enumerate(exact) if isinstance(v, fmpq)}
        try:
            field, (left,) = evaluate(tape, names, known)
        except (UnsupportedOperation, ZeroDivisionError):
            return False
        return all(value.is_zero() for value in left.column(field.const(0)))


def _in_domain(situation: Situation, scaled: _Scaled, found: Tube, turn: int) -> bool:
    """Whether the tube lies inside the stated domain."""
    bounds = Region.stated(situation.plant).bounds
    for lows, highs in map(hull, found.pieces):
        for k, (lo, hi) in enumerate(bounds):
            size, middle = Fraction(scaled.scale[k]), fraction(scaled.centre[k])
            ends = [Fraction(lows[k]), Fraction(highs[k])]
            ends = ends + [-v for v in ends] if turn < 0 else ends
            low, high = middle + size * min(ends), middle + size * max(ends)
            if (lo is not None and low < lo) or (hi is not None and high > hi):
                return False
    return True


def _claim(situation: Situation, scaled: _Scaled, found: Tube, turn: int) -> Claim:
    """What is shown: the motion by its period, a state and how far each state goes."""
    system, names = situation.plant.system, scaled.loop.names
    laps, (shortest, longest) = (2 if turn < 0 else 1), period(found)
    shown = f"{laps * (shortest + longest) / 2:.6g} s"
    middle = np.array([approximate(v) for v in scaled.centre])
    states = np.concatenate([middle + scaled.scale * along(piece) for piece in found.pieces])
    if turn < 0:
        states = np.concatenate([states, 2 * middle - states])
    low, high = states.min(axis=0), states.max(axis=0)
    units = [f" {system.units[name]}" if name in system.units else "" for name in names]
    ends = [f"{name} from {a:.6g} to {b:.6g}{unit}" for name, a, b, unit in zip(names, low, high, units, strict=True)]
    start = {name: f"{v:.15g}" for name, v in zip(names, states[0], strict=True)}
    n = system.n
    evidence = (
        f"the closed loop has a periodic motion, and what starts near it stays there: {', '.join(ends[:n])}, with a "
        f"period of {shown}; {len(found.pieces)} pieces of a tube around {'half of it' if turn < 0 else 'it'} show that"
    )
    return Claim(
        "globally-asymptotically-stable",
        Status.REFUTED,
        "all x",
        METHOD,
        evidence,
        "the claim can only be local; start inside the region of attraction",
        {"period": shown, "x": dict([*start.items()][:n]), "filters": dict([*start.items()][n:]), "range": ends},
    )
