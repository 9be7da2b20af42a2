"""The controller as data: what `emit` prints and the reference step runs.

One step of every law has the same form. With the measurement ``m``, the controller state ``xi`` and ``t = tanh(s)``:

1. *prepare*   ``c = c(m, xi)`` and ``N = N(m)``;
2. *solve*     ``s + N tanh(s) = c`` (one solution: N is a product of positive definite and positive diagonal factors);
3. *update*    ``xi <- X(m, xi, t)`` and ``u = U(m, xi, t)``, then u is clamped to its interval.

The saturated arguments s are the arguments of the tanh terms of the law, at the *updated* controller state: step 2
is backward Euler for the stiff filters x_c, x_l, and the algebraic loop of the law `passive-output`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from fractions import Fraction

from pbcgen.law.arithmetic import Precision, Tanh
from pbcgen.symbolic.tape import Tape


@dataclass(frozen=True)
class Signal:
    """A scalar that crosses the interface: an input, an output or a state of the controller."""

    name: str
    unit: str = ""
    description: str = ""


@dataclass(frozen=True)
class Piece:
    """A rational function P/Q of what lies between ``knot`` and ``knot + length``; coefficients from the constant up.

    Attributes:
        numerator: of P.
        denominator: of Q, without that of the highest power, which is 1.
    """

    knot: float
    length: float
    numerator: tuple[float, ...]
    denominator: tuple[float, ...]


@dataclass(frozen=True)
class Fit:
    """t as a function of c, off by at most ``error_bound`` for every c; see :mod:`pbcgen.law.fitted`.

    Attributes:
        correction: coefficients of p(T^2), from the constant up; empty if there are pieces.
        pieces: the first one from zero, odd; the others where their knots say.
    """

    correction: tuple[float, ...]
    pieces: tuple[Piece, ...]
    error_bound: float


@dataclass(frozen=True)
class ScalarSolve:
    """Channel ``index``: ``s + mu tanh(s) = c`` with ``mu = N[index, index] >= 0``.

    With ``fit``: t is a function of c, for the mu that N holds as a constant. Otherwise Newton's method from
    ``max(r/(1+mu), r-mu)`` for ``r = abs(c)``: ``iterations`` steps leave an error of at most ``error_bound`` in s for
    every c. Both bounds are for exact arithmetic.
    """

    index: int
    iterations: int
    error_bound: float
    fit: Fit | None = None


@dataclass(frozen=True)
class VectorSolve:
    """Channels ``indices``: ``s + N tanh(s) = c`` with a full block N, by damped Newton steps.

    A residual above ``tolerance * (1 + max|c|)`` after ``iterations`` steps is reported in the status; u stays in its
    interval all the same. For N up to 100 with condition 1000, 15 steps were enough in each of 10^5 random cases.
    """

    indices: tuple[int, ...]
    iterations: int
    tolerance: float


class Fallback(Enum):
    """What a step outputs when an input is not a finite number."""

    EQUILIBRIUM = "the equilibrium input -kappa"
    LAST_OUTPUT = "the last valid output"


@dataclass(frozen=True)
class SetterInput:
    """A number that the caller may set, its exact bounds, and its value at the start."""

    signal: Signal
    range: tuple[Fraction, Fraction]
    value: Fraction


@dataclass(frozen=True)
class Setter:
    """A function of the package that changes numbers which the state stores.

    Attributes:
        group: ``target`` or ``gains``.
        inputs: what the caller gives.
        states: positions of the stored numbers among the states.
        compute: tape from the inputs to the stored numbers.
    """

    group: str
    inputs: tuple[SetterInput, ...]
    states: tuple[int, ...]
    compute: Tape


@dataclass(frozen=True)
class ControlLaw:
    """A discretised saturated controller.

    Attributes:
        name: the design's name.
        law: one of the law names (``dynamic-extension``, ...).
        precision: the arithmetic of the generated code.
        sample_period: h in seconds, exact.
        inputs: the measured signals, in the order of m.
        outputs: the actuator signals, in the order of u.
        states: the controller states, in the order of xi: those of the filters, which start at zero, then the numbers
            that setters change.
        prepare: tape with inputs (m, xi) and outputs (c: ns x 1, N: ns x ns sparse).
        update: tape with inputs (m, xi, t) and outputs (next xi, u). ``u`` is not yet clamped.
        solves: which rows of the loop equation are solved together; they partition 0..ns-1.
        intervals: exact bounds [lo, hi] of each u. The emitted clamp rounds them inward.
        equilibrium_output: -kappa, inside ``intervals``; also the initial "last valid output".
        fallback: the output for non-finite inputs.
        ranges: for each input the declared range (lo, hi), where there is one; documentation, not a check.
        tanh: how the code computes tanh; see :mod:`pbcgen.law.hyperbolic`.
        kept: the first values of the last states, which a step does not change.
        equilibrium_states: for each output the position of -kappa among the states, or None where it is a constant.
        setters: the functions that change the kept states.
        coefficient_bounds: bounds of N[i, i], by channel, where it is computed and bounded.
        rest: the measurements at the target.
        start: tape (m, xi) -> the xi from which a step at m gives the equilibrium input; None if there is none.
    """

    name: str
    law: str
    precision: Precision
    sample_period: Fraction
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    states: tuple[Signal, ...]
    prepare: Tape
    update: Tape
    solves: tuple[ScalarSolve | VectorSolve, ...]
    intervals: tuple[tuple[Fraction, Fraction], ...]
    equilibrium_output: tuple[float, ...]
    fallback: Fallback
    ranges: Mapping[str, tuple[Fraction, Fraction]] = field(default_factory=dict)
    tanh: Tanh = "libm"
    kept: tuple[float, ...] = ()
    equilibrium_states: tuple[int | None, ...] = ()
    setters: tuple[Setter, ...] = ()
    coefficient_bounds: Mapping[int, Fraction] = field(default_factory=dict)
    rest: tuple[float, ...] = ()
    start: Tape | None = None

    @property
    def initial(self) -> tuple[float, ...]:
        """The first value of every state."""
        return (0.0,) * (len(self.states) - len(self.kept)) + self.kept

    @property
    def moves(self) -> bool:
        """Whether the equilibrium input of some output is a state."""
        return any(position is not None for position in self.equilibrium_states)

    @property
    def channels(self) -> int:
        """The number ns of saturated arguments."""
        return self.prepare.outputs[0].shape[0]
