"""The small typed tree between a control law and the templates: every text that they need, in loops they can run.

The names of the fields are those that the templates use.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from pbcgen.emit.expressions import Statement
from pbcgen.law.law import Signal


@dataclass(frozen=True)
class Constants:
    """The notation of a precision: its C type, the suffix of math functions, literals that the templates use."""

    real: str
    f: str
    zero: str
    half: str
    one: str
    four: str
    largest: str
    state_limit: str
    square_limit: str
    erfinv_small: str
    erfinv_slope: str
    erfinv_shift: str
    erfinv_scale: str


@dataclass(frozen=True)
class InputMember:
    """A measurement. ``range`` is its declared range, or None."""

    signal: Signal
    c_name: str
    range: tuple[Fraction, Fraction] | None


@dataclass(frozen=True)
class OutputMember:
    """An actuator signal: its bounds, its fallback and the local variable of its unclamped value."""

    signal: Signal
    c_name: str
    macro: str
    interval: tuple[Fraction, Fraction]
    low: str
    high: str
    equilibrium: str
    fallback: str
    next: str


@dataclass(frozen=True)
class StateMember:
    """A number that the controller keeps.

    ``role`` is "state", "setting" for one that only setters change, "held output" for one kept as a fallback.
    """

    signal: Signal
    c_name: str
    initial: str
    next: str
    role: str

    @property
    def is_memory(self) -> bool:
        """Whether the law reads it."""
        return self.role != "held output"


@dataclass(frozen=True)
class ScalarFunction:
    """The C function of scalar solves with this number of Newton steps."""

    name: str
    iterations: int
    error_bound: str


@dataclass(frozen=True)
class FittedPiece:
    """One piece of a fitted function: where it begins, how long it is, its coefficients from the highest down."""

    knot: str
    length: str
    numerator: tuple[str, ...]
    denominator: tuple[str, ...]


@dataclass(frozen=True)
class FittedFunction:
    """The C function of scalar solves for one mu, by a fit; see :mod:`pbcgen.law.fitted`.

    ``correction`` has coefficients from the highest down, or there are pieces; ``origin`` is what c^2 is subtracted
    from in the first piece, empty for nothing.
    """

    name: str
    mu: str
    correction: tuple[str, ...]
    pieces: tuple[FittedPiece, ...]
    origin: str
    error_bound: str


@dataclass(frozen=True)
class FastTanh:
    """Coefficients of the rational tanh from the highest down, for Q without that; its error.

    ``cosh`` has those of 2 (cosh(z) - 1) in x = z 2^doublings; it is empty where cosh comes from the math library.
    """

    numerator: tuple[str, ...]
    denominator: tuple[str, ...]
    ulp: str
    error: str
    cosh: tuple[str, ...]
    doublings: int


@dataclass(frozen=True)
class BlockFunction:
    """The C function of block solves of this size."""

    name: str
    size: int
    iterations: int
    tolerance: str


@dataclass(frozen=True)
class ScalarCall:
    """``t = function(arguments)``: mu and c, or c alone where the function knows mu."""

    t: str
    function: str
    arguments: tuple[str, ...]


@dataclass(frozen=True)
class BlockCall:
    """``function(n, c, t)`` with the arrays n = ``entries`` (by rows) and c = ``right_side``."""

    t: str
    n: str
    c: str
    function: str
    size: int
    entries: tuple[str, ...]
    right_side: tuple[str, ...]


@dataclass(frozen=True)
class Body:
    """The middle of the step: prepare, solve, update.

    ``prepare_checks`` are C conditions that must hold; ``results`` are the variables that must be finite in the end.
    """

    prepare: tuple[Statement, ...]
    prepare_checks: tuple[str, ...]
    scalars: tuple[ScalarCall, ...]
    blocks: tuple[BlockCall, ...]
    update: tuple[Statement, ...]
    results: tuple[str, ...]
    helpers: frozenset[str]


@dataclass(frozen=True)
class SettingMember:
    """A number that the caller may set: its bounds as macros and literals.

    ``clamp`` are the bounds to clamp an accepted value to, where they are not those that are accepted.
    """

    signal: Signal
    c_name: str
    macro: str
    interval: tuple[Fraction, Fraction]
    low: str
    high: str
    start: str
    clamp: tuple[str, str] | None


@dataclass(frozen=True)
class SetterFunction:
    """``<p>_set_<group>``: what it is given, the statements, and what it stores (member, expression)."""

    group: str
    inputs: tuple[SettingMember, ...]
    body: tuple[Statement, ...]
    stores: tuple[tuple[str, str], ...]
    helpers: frozenset[str]


@dataclass(frozen=True)
class StartFunction:
    """``<p>_start_at``: the statements, and what it stores (member, expression)."""

    body: tuple[Statement, ...]
    stores: tuple[tuple[str, str], ...]
    helpers: frozenset[str]


@dataclass(frozen=True)
class SelfTest:
    """``<p>_selftest``: rows of measurements, expected outputs and tolerances."""

    measurements: tuple[tuple[str, ...], ...]
    expected: tuple[tuple[str, ...], ...]
    tolerances: tuple[str, ...]


@dataclass(frozen=True)
class Program:
    """All C texts of one package.

    ``read`` are the numbers that a step reads: states and inputs. ``library_ulp`` is the error of the math library's
    tanh.
    """

    prefix: str
    constants: Constants
    sample_period: str
    inputs: tuple[InputMember, ...]
    outputs: tuple[OutputMember, ...]
    states: tuple[StateMember, ...]
    state_checks: tuple[str, ...]
    read: tuple[str, ...]
    fast_tanh: FastTanh | None
    library_ulp: str
    fitted_functions: tuple[FittedFunction, ...]
    scalar_functions: tuple[ScalarFunction, ...]
    block_functions: tuple[BlockFunction, ...]
    body: Body
    renamed: tuple[tuple[str, str], ...]
    setters: tuple[SetterFunction, ...] = ()
    start: StartFunction | None = None
    selftest: SelfTest | None = None

    @property
    def upper(self) -> str:
        """The prefix of macros and status names."""
        return self.prefix.upper()

    @property
    def holds(self) -> bool:
        """Whether the last valid output is kept as the fallback."""
        return any(not member.is_memory for member in self.states)

    @property
    def moves(self) -> bool:
        """Whether the fallback of some output is a setting of the state."""
        return not self.holds and any(member.fallback.startswith("state->") for member in self.outputs)

    @property
    def helpers(self) -> frozenset[str]:
        """Functions of the package that the printed code calls."""
        start = self.start.helpers if self.start else frozenset()
        own = self.body.helpers.union(start, *(setter.helpers for setter in self.setters))
        return own | {"cut_ratio"} if self.fast_tanh and ("tanh" in own or self.fitted_functions) else own
