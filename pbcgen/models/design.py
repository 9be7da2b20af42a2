"""A design: one controller task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, Protocol, get_args

from pbcgen.errors import ModelError
from pbcgen.models import ranges
from pbcgen.models.exact import Number, exact, positive
from pbcgen.models.expressions import by_name, suggestion
from pbcgen.models.laws import Integral, Law, PotentialCompensation
from pbcgen.models.limits import InputSet, Limits
from pbcgen.models.ranges import Range, RangeLike
from pbcgen.models.source import Call, called_by_user, users_call
from pbcgen.models.target import Target, TargetLike, in_order, target_of

if TYPE_CHECKING:
    from pbcgen.models.affine import AffineSystem

Precision = Literal["float", "double"]


class Model(Protocol):
    """What a front end is: something that lowers to an input-affine system."""

    def lower(self) -> AffineSystem:
        """The system."""
        ...


@dataclass(frozen=True, eq=False, init=False)
class Design:
    """A system, a target, a law with gains, limits, and how the controller runs.

    Attributes:
        model: the model as the user wrote it.
        system: the model as an input-affine system.
        target: where it shall rest.
        law: the control law with its gains, as given; ``law.resolve(m, s)`` has full shapes.
        limits: actuator limits, or None.
        sample_period: h in seconds, exact.
        delay: from the measurement to the moment when the output acts, in sample periods: 0 to 2, whole or not.
        jitter: the periods vary within ``h (1 - jitter)`` and ``h (1 + jitter)`` from step to step; below 1.
        precision: the arithmetic of the generated code.
        name: how files and reports call the design; None until the loader fills it in.
        near: approximate values by state name that choose among several completions of the target.
        initial: x(0) of simulations, n values.
        duration: length of simulations in seconds; None leaves it to the slowest mode of the closed loop.
        description: a sentence for reports.
        call: where the user made it, if in a file.
        target_box: ranges of the conditions of the target that the C may change (``<p>_set_target``).
        gain_ranges: ranges of the gains that the C may change (``<p>_set_gains``), one for each input.
    """

    model: Model
    system: AffineSystem
    target: Target
    law: Law
    limits: Limits | None
    sample_period: Fraction
    delay: Fraction
    jitter: Fraction
    precision: Precision
    name: str | None
    near: Mapping[str, Fraction]
    initial: tuple[Fraction, ...]
    duration: Fraction | None
    description: str
    call: Call | None
    target_box: Mapping[str, Range]
    gain_ranges: Mapping[str, tuple[Range, ...]]

    def __init__(
        self,
        system: Model,
        target: TargetLike,
        law: Law,
        *,
        limits: Limits | None = None,
        sample_period: Number,
        delay: Number = 0,
        jitter: Number = 0,
        precision: Precision = "float",
        name: str | None = None,
        near: Mapping[str, Number] | None = None,
        initial: Mapping[str, Number] | Sequence[Number] | None = None,
        duration: Number | None = None,
        description: str = "",
        target_box: Mapping[str, Sequence[Number]] | None = None,
        gain_ranges: Mapping[str, RangeLike] | None = None,
    ) -> None:
        """Check and store the design.

        Args:
            system: AffineSystem, Mechanical or Circuit.
            target: x* as n values, values by name of state or measured signal, or ``{name: (expression, value)}``.
            law: one of the laws.
            limits: actuator limits.
            sample_period: h in seconds, positive.
            delay: of the output, in sample periods, 0 to 2; the sampled loop is proved with it.
            jitter: the share of h by which periods vary; the sampled loop is proved for all sequences of them.
            precision: "float" or "double".
            name: how files and reports call the design.
            near: approximate values by state name.
            initial: x(0), by state name (others are 0) or n values.
            duration: length of simulations in seconds, positive; five time constants of the slowest mode by default.
            description: a sentence for reports.
            target_box: ``{name: (lowest, highest)}`` for conditions of the target that the running controller may
                change; the claims that code needs are proved for the whole box.
            gain_ranges: ``{gain: (lowest, highest)}``, or a list of pairs, one for each input, for gains likewise.

        Raises:
            ModelError: naming the entry that is wrong and what was expected.
        """
        if not callable(getattr(system, "lower", None)):
            raise ModelError(f"the system is a {type(system).__name__}: AffineSystem, Mechanical or Circuit expected")
        if precision not in get_args(Precision):
            raise ModelError(f"the precision is {precision!r}: 'float' or 'double' was expected")
        lowered = system.lower()
        _check_law(law, lowered)
        _check_limits(limits, lowered)
        wanted = target_of(target, lowered)
        values = {
            "model": system,
            "system": lowered,
            "target": wanted,
            "law": law,
            "limits": limits,
            "sample_period": positive(sample_period, "the sample period"),
            "delay": _delay(delay),
            "jitter": _jitter(jitter),
            "precision": precision,
            "name": name,
            "near": MappingProxyType(_by_state(by_name(near, "near"), lowered, "near")),
            "initial": _initial(initial, lowered),
            "duration": None if duration is None else positive(duration, "the duration"),
            "description": description,
            "call": users_call(),
            "target_box": MappingProxyType(ranges.target_box(target_box, wanted)),
            "gain_ranges": MappingProxyType(ranges.gain_ranges(gain_ranges, law, lowered.m)),
        }
        for key, value in values.items():
            object.__setattr__(self, key, value)

    @property
    def input_set(self) -> InputSet:
        """The limits in the order of u; unbounded where none were given."""
        return (self.limits or Limits()).resolve(self.system.input_names)

    def with_(self, **changes: Any) -> Design:
        """A copy with some arguments of the constructor changed."""
        arguments = {
            "system": self.model,
            "target": self.target,
            "law": self.law,
            "limits": self.limits,
            "sample_period": self.sample_period,
            "delay": self.delay,
            "jitter": self.jitter,
            "precision": self.precision,
            "name": self.name,
            "near": self.near,
            "initial": self.initial,
            "duration": self.duration,
            "description": self.description,
            "target_box": {name: (r.lo, r.hi) for name, r in self.target_box.items()},
            "gain_ranges": {name: [(r.lo, r.hi) for r in rs] for name, rs in self.gain_ranges.items()},
        }
        for name in changes:
            if name not in arguments:
                raise ModelError(f"a design has no `{name}`: {suggestion(name, arguments)}")
        changed = Design(**{**arguments, **changes})
        if not called_by_user():
            object.__setattr__(changed, "call", self.call)
        return changed


def _delay(given: Number) -> Fraction:
    delay = exact(given, "the delay")
    if not 0 <= delay <= 2:
        raise ModelError(f"the delay is {float(delay):g} samples: 0 to 2 samples were expected")
    return delay


def _jitter(given: Number) -> Fraction:
    jitter = exact(given, "the jitter")
    if not 0 <= jitter < 1:
        raise ModelError(f"the jitter is {float(jitter):g}: a share of the sample period below 1 was expected")
    return jitter


def _check_law(law: object, system: AffineSystem) -> None:
    if not isinstance(law, Law):
        raise ModelError(f"the law is {law!r}: one of pbcgen's laws was expected, such as DynamicExtension(...)")
    if isinstance(law, PotentialCompensation | Integral) and system.mechanical is None:
        raise ModelError(f"the law `{law.name}` is for mechanical systems: build the model with Mechanical")
    law.resolve(system.m)


def _check_limits(limits: object, system: AffineSystem) -> None:
    if limits is None:
        return
    if not isinstance(limits, Limits):
        raise ModelError(f"limits is a {type(limits).__name__}: Limits(...) was expected")
    limits.resolve(system.input_names).check(system.input_names)


def _by_state(values: Mapping[str, Number], system: AffineSystem, what: str) -> dict[str, Fraction]:
    for name in values:
        if name not in system.state_names:
            raise ModelError(f"{what} names `{name}`, which is not a state: {suggestion(name, system.state_names)}")
    return {name: exact(value, f"{what} `{name}`") for name, value in values.items()}


def _initial(initial: Mapping[str, Number] | Sequence[Number] | None, system: AffineSystem) -> tuple[Fraction, ...]:
    if initial is None:
        initial = {}
    elif not isinstance(initial, Mapping):
        initial = in_order(initial, system, "the initial state")
    values = _by_state(initial, system, "the initial state")
    return tuple(values.get(name, Fraction(0)) for name in system.state_names)
