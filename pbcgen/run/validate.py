"""Three tests of a generated controller: against the Python step, against the continuous law, against its limits."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbcgen.emit.package import Provenance, render
from pbcgen.errors import ToolchainError
from pbcgen.law.law import Fallback
from pbcgen.law.step import ReferenceStep, StepStatus
from pbcgen.models.exact import plain
from pbcgen.run.agreement import Allowance
from pbcgen.run.questions import memory, questions
from pbcgen.run.simulate import (
    Stepper,
    Tolerance,
    Trajectory,
    simulate_continuous,
    simulate_sampled,
)
from pbcgen.run.wrapper import Controller

if TYPE_CHECKING:
    from pbcgen.emit.package import Package
    from pbcgen.law.closed_loop import ClosedLoop
    from pbcgen.law.law import ControlLaw, Setter

Array = NDArray[Any]

#: The error must fall with at least this order when h is halved. First order is what the method has; a bias that
#: does not vanish with h pulls the observed order below 1.
LEAST_ORDER = 0.75

#: What C and Python store of a setting may differ by so many units in the last place: their math libraries do.
SETTINGS_ULP = 64.0

#: An ulp of a stored number is at least that of this share of the largest setting: numbers near zero are differences.
_SETTING_SCALE = 1e-2

#: Multiple of the integrator's relative tolerance below which an error says nothing of the sampling.
_FLOOR = 1000.0


@dataclass(frozen=True)
class Agreement:
    """The C against the Python step, from equal measurements and states.

    An error in ulp is ``abs(C - Python) / (eps * max(abs(Python), scale))``, where eps is the machine epsilon of the
    precision (2^-23 or 2^-52) and the scale is half the width of its interval for an entry of u, and the largest
    absolute value on the trajectory for an entry of xi. What is allowed follows from the law, entry by entry and
    sample by sample: see :mod:`pbcgen.run.agreement`.

    Attributes:
        samples: number of random and special inputs.
        trajectory_samples: number of inputs taken from the closed loop.
        u_ulp, xi_ulp: the largest errors, over the samples whose solution converged.
        trajectory_u_ulp, trajectory_xi_ulp: the same over the closed-loop trajectory alone.
        share: the largest quotient of an error and what is allowed for it; at most 1 to pass.
        status_mismatches: samples for which the statuses differ.
        not_converged: samples that both report as not converged, whose values are not compared.
        worst: the sample with the largest share.
        passed: share <= 1 and no status mismatch.
    """

    samples: int
    trajectory_samples: int
    u_ulp: float
    xi_ulp: float
    trajectory_u_ulp: float
    trajectory_xi_ulp: float
    share: float
    status_mismatches: int
    not_converged: int
    worst: Mapping[str, Any]
    passed: bool


@dataclass(frozen=True)
class Convergence:
    """The sampled loop against the continuous one for h, h/2 and h/4, in double precision.

    The error of a state is the mean over the common sample times of ``abs(sampled - continuous)``, divided by the
    largest absolute value of that state on the continuous trajectory; the mean counts a switch of u that comes
    one sample late as what it is, an error of order h. The error of a run is that of its worst state.

    Attributes:
        horizon: simulated time in seconds.
        periods: the sample periods in seconds.
        errors: one for each period.
        maximum_errors: the same with the maximum over time in place of the mean.
        state_errors: for each period one error for each state.
        orders: log2 of the quotients of consecutive errors.
        floor: an error below is not told from the integrator's.
        passed: the last order is at least LEAST_ORDER, or the last error is below the floor.
        note: what decided, in words.
    """

    horizon: float
    periods: tuple[float, ...]
    errors: tuple[float, ...]
    maximum_errors: tuple[float, ...]
    state_errors: tuple[tuple[float, ...], ...]
    orders: tuple[float, ...]
    floor: float
    passed: bool
    note: str


@dataclass(frozen=True)
class OutputRange:
    """One output against its exact interval, over every run and every random input.

    Attributes:
        name: the output.
        interval: the exact bounds.
        smallest, largest: of all values (NaN if one of them is NaN).
        samples: how many values.
        passed: every value lies in the interval, compared as rational numbers.
    """

    name: str
    interval: tuple[Fraction, Fraction]
    smallest: float
    largest: float
    samples: int
    passed: bool


@dataclass(frozen=True)
class SettingsCheck:
    """What the C stores after targets and gains were set, against the Python step.

    Attributes:
        samples: how many were set: corners, random ones, and ones that must be refused.
        refused: how many of them both refused, leaving the state as it was.
        ulp: the largest difference of a stored number, in units of the last place of the largest on its way.
        mismatches: samples for which the statuses differ, or a refused one changed the state.
        passed: no mismatch, and at most SETTINGS_ULP.
    """

    samples: int
    refused: int
    ulp: float
    mismatches: int
    passed: bool


@dataclass(frozen=True)
class Validation:
    """The tests of one controller; ``settings`` only where there are any."""

    design: str
    precision: str
    sample_period: Fraction
    seed: int
    agreement: Agreement
    convergence: Convergence
    outputs: tuple[OutputRange, ...]
    settings: SettingsCheck | None = None

    @property
    def passed(self) -> bool:
        """Whether all tests passed."""
        settings = self.settings is None or self.settings.passed
        return settings and self.agreement.passed and self.convergence.passed and all(o.passed for o in self.outputs)

    def as_json(self) -> dict[str, Any]:
        """All figures, ready for ``json.dumps``; numbers that are not finite become null."""
        return {
            "design": self.design,
            "precision": self.precision,
            "sample_period": float(self.sample_period),
            "seed": self.seed,
            "passed": self.passed,
            "agreement": plain(asdict(self.agreement)),
            "convergence": plain(asdict(self.convergence)),
            "outputs": [plain(asdict(output)) for output in self.outputs],
        } | ({} if self.settings is None else {"settings": plain(asdict(self.settings))})


def validate(
    law: ControlLaw,
    package: Package,
    loop: ClosedLoop,
    relaw: Callable[[Fraction], ControlLaw],
    *,
    seed: int = 0,
    samples: int = 20_000,
    steps: int = 2_000,
    progress: Callable[[str], None] | None = None,
) -> Validation:
    """Compile the package and run the three tests.

    Args:
        law: the law that the package was rendered from.
        package: its C.
        loop: plant and continuous law.
        relaw: h -> the same law discretised with the sample period h, in double precision.
        seed: of the random inputs.
        samples: number of random and special inputs, at least.
        steps: the simulations last this many sample periods of the law, or ``loop.duration`` if that is shorter.
        progress: called with the name of each stage.

    Returns:
        The figures and verdicts of the tests.

    Raises:
        SimulationError: a simulation cannot be carried out.
        ToolchainError: there is no compiler, the C does not compile, or it does not belong to ``law``.
    """
    tell = progress or (lambda stage: None)
    tell("compile")
    with ExitStack() as open_controllers:

        def compiled(rendered: Package) -> Controller:
            return open_controllers.enter_context(Controller.of_package(rendered))

        return validate_controller(
            law,
            compiled(package),
            loop,
            lambda h: compiled(render(relaw(h), Provenance("", ()))),
            seed=seed,
            samples=samples,
            steps=steps,
            progress=progress,
        )


def validate_controller(
    law: ControlLaw,
    controller: Controller,
    loop: ClosedLoop,
    stepper: Callable[[Fraction], Stepper],
    *,
    seed: int = 0,
    samples: int = 20_000,
    steps: int = 2_000,
    progress: Callable[[str], None] | None = None,
) -> Validation:
    """Like :func:`validate`, for C that is compiled already.

    ``stepper`` gives the controller for a sample period h, in double precision; each is used before the next is made.
    """
    _held_outputs(law, controller)
    tell = progress or (lambda stage: None)
    h = law.sample_period
    count = max(min(steps, math.floor(Fraction(loop.duration) / h)), 1)
    tell("sampled closed loop")
    run = simulate_sampled(loop, controller, h, float(count * h))
    tell("C against Python")
    agreement, u_random = compare(law, controller, loop, run, seed=seed, samples=samples)
    tell("sampled against continuous")
    convergence, runs = observe_order(loop, stepper, h, count)
    tell("limits")
    outputs = check_limits(law, [u_random, run.u, *(sampled.u for sampled in runs)])
    settings = check_settings(law, controller, np.random.default_rng(seed)) if law.setters else None
    return Validation(law.name, law.precision, h, seed, agreement, convergence, outputs, settings)


def compare(
    law: ControlLaw,
    controller: Controller,
    loop: ClosedLoop,
    run: Trajectory,
    *,
    seed: int = 0,
    samples: int = 20_000,
) -> tuple[Agreement, Array]:
    """Test (1): the C against the Python step; also returns every u of the C (N, m).

    Raises ToolchainError if the signals of the C are not those of the law.
    """
    step = ReferenceStep(law)
    held = _held_outputs(law, controller)
    before, on_run = questions(law, loop, run, generator=np.random.default_rng(seed), samples=samples)
    c = _Answer(*controller.step_many(before.m, np.hstack([before.xi, before.last[:, :held]])))
    xi, u, status = step(before.m, before.xi, before.last if held else None)
    python = _Answer(np.hstack([xi, u[:, :held]]), u, status)
    compared = python.status != StepStatus.NOT_CONVERGED
    reset = (python.status == StepStatus.STATE_RESET)[:, None]
    xi_allowed, u_allowed = Allowance(law)(before.m, np.where(reset, step.initial, before.xi))
    allowed = np.hstack([u_allowed, xi_allowed, u_allowed[:, :held]])
    halves = np.array([float(hi - lo) / 2 for lo, hi in law.intervals])
    scale = np.concatenate([halves, np.abs(memory(law, run)).max(axis=0), halves[:held]])
    unit = np.maximum(np.abs(python.values.astype(float)), scale) * float(np.finfo(step.dtype).eps)
    error = _difference(c.values, python.values)
    ulp, share = _quotient(error, unit), _quotient(error, _allowed(allowed, python.values))
    share[~compared] = 0.0
    mismatches = int(np.sum(c.status != python.status))
    width = len(law.outputs)
    worst = int(np.argmax(share.max(axis=1)))
    agreement = Agreement(
        samples=int(np.sum(~on_run)),
        trajectory_samples=int(np.sum(on_run)),
        u_ulp=_largest(ulp[compared, :width]),
        xi_ulp=_largest(ulp[compared, width:]),
        trajectory_u_ulp=_largest(ulp[compared & on_run, :width]),
        trajectory_xi_ulp=_largest(ulp[compared & on_run, width:]),
        share=_largest(share),
        status_mismatches=mismatches,
        not_converged=int(np.sum(~compared)),
        worst={
            "measurement": before.m[worst].tolist(),
            "state": before.xi[worst].tolist(),
            "u_c": c.u[worst].tolist(),
            "u_python": python.u[worst].tolist(),
            "xi_c": c.xi[worst].tolist(),
            "xi_python": python.xi[worst].tolist(),
        },
        passed=bool(_largest(share) <= 1.0 and mismatches == 0),
    )
    return agreement, c.u


def observe_order(
    loop: ClosedLoop, stepper: Callable[[Fraction], Stepper], h: Fraction, count: int
) -> tuple[Convergence, tuple[Trajectory, ...]]:
    """Test (2): the error of the sampled loop over ``count`` periods h, for h, h/2, h/4; also returns the runs."""
    tolerance = Tolerance()
    continuous = simulate_continuous(loop, [float(k * h) for k in range(1, count + 1)], tolerance)
    largest = np.abs(continuous.x).max(axis=0)
    scale = np.where(largest > 0, largest, 1.0)
    runs, means, maxima = [], [], []
    for divisor in (1, 2, 4):
        period = h / divisor
        run = simulate_sampled(loop, stepper(period), period, float(count * h), tolerance)
        error = np.abs(run.x[divisor::divisor] - continuous.x) / scale
        runs.append(run)
        means.append(error.mean(axis=0))
        maxima.append(float(error.max()))
    errors = [float(mean.max()) for mean in means]
    # The integrator starts anew in every period and may be off by its tolerance each time.
    floor = max(_FLOOR, 4.0 * count) * tolerance.relative
    orders = tuple(_order(coarse, fine) for coarse, fine in itertools.pairwise(errors))
    passed, note = _judge(errors, orders, floor)
    convergence = Convergence(
        horizon=float(count * h),
        periods=tuple(float(h / divisor) for divisor in (1, 2, 4)),
        errors=tuple(errors),
        maximum_errors=tuple(maxima),
        state_errors=tuple(tuple(mean.tolist()) for mean in means),
        orders=orders,
        floor=floor,
        passed=passed,
        note=note,
    )
    return convergence, tuple(runs)


def check_limits(law: ControlLaw, outputs: Sequence[Array]) -> tuple[OutputRange, ...]:
    """Test (3): each u (N, m) of ``outputs`` in its interval, as rational numbers."""
    result = []
    for k, (signal, interval) in enumerate(zip(law.outputs, law.intervals, strict=True)):
        smallest = min(float(np.min(u[:, k])) for u in outputs)
        largest = max(float(np.max(u[:, k])) for u in outputs)
        finite = all(bool(np.all(np.isfinite(u[:, k]))) for u in outputs)
        passed = finite and interval[0] <= Fraction(smallest) and Fraction(largest) <= interval[1]
        if not finite:
            smallest = largest = math.nan
        result.append(OutputRange(signal.name, interval, smallest, largest, sum(map(len, outputs)), passed))
    return tuple(result)


def check_settings(law: ControlLaw, controller: Controller, generator: np.random.Generator) -> SettingsCheck:
    """Set corners, random values and refused ones in C and in Python, and compare what is stored."""
    step = ReferenceStep(law)
    epsilon = float(np.finfo(step.dtype).eps)
    samples = refused = mismatches = 0
    ulp = 0.0
    for setter in law.setters:
        names = [item.signal.name for item in setter.inputs]
        for values in _settings(setter, generator):
            controller.reset()
            before = controller.xi.copy()
            own = before[: len(law.states)]
            expected, status = step.set(setter.group, own, np.array(values))
            given = dict(zip(names, values, strict=True))
            found = controller.set_target(**given) if setter.group == "target" else controller.set_gains(**given)
            samples += 1
            same = controller.interface.statuses.index(found) == list(StepStatus).index(status)
            if status is StepStatus.OK:
                after = controller.xi[: len(law.states)]
                scale = np.maximum(np.abs(expected.astype(float)), max(abs(v) for v in values) * _SETTING_SCALE)
                ulp = max(ulp, _largest(_quotient(_difference(after, expected), epsilon * scale)))
            else:
                refused += 1
                same = same and np.array_equal(controller.xi, before, equal_nan=True)
            mismatches += not same
    controller.reset()
    return SettingsCheck(samples, refused, ulp, mismatches, mismatches == 0 and ulp <= SETTINGS_ULP)


def _settings(setter: Setter, generator: np.random.Generator) -> list[list[float]]:
    """Corners (of few settings), random points inside, and points with one value outside or special."""
    bounds = [(float(item.range[0]), float(item.range[1])) for item in setter.inputs]
    middle = [float(item.value) for item in setter.inputs]
    rows = [list(corner) for corner in itertools.islice(itertools.product(*bounds), 64)]
    rows += [[float(generator.uniform(lo, hi)) for lo, hi in bounds] for _ in range(200)]
    for k, (lo, hi) in enumerate(bounds):
        width = hi - lo
        for value in (lo - width / 100, hi + width / 100, math.nan, math.inf, -math.inf):
            rows.append([*middle[:k], value, *middle[k + 1 :]])
    return rows


def _order(coarse: float, fine: float) -> float:
    return math.log2(coarse / fine) if coarse > 0 and fine > 0 else math.nan


def _judge(errors: Sequence[float], orders: Sequence[float], floor: float) -> tuple[bool, str]:
    if not all(math.isfinite(error) for error in errors):
        return False, "the sampled loop left the finite numbers"
    if errors[-1] <= floor:
        return True, f"the error {errors[-1]:.2g} is at the accuracy of the integration: no order to be seen"
    if orders[-1] >= LEAST_ORDER:
        return True, f"the error falls with order {orders[-1]:.2f}"
    return False, f"the error falls with order {orders[-1]:.2f} only: it does not vanish with the sample period"


@dataclass(frozen=True)
class _Answer:
    """Results of N steps: the memory (N, nxi) with the held outputs, u (N, m), statuses (N,)."""

    xi: Array
    u: Array
    status: Array

    @property
    def values(self) -> Array:
        """U and the memory side by side."""
        return np.hstack([self.u, self.xi])


def _held_outputs(law: ControlLaw, controller: Controller) -> int:
    """How many outputs the C keeps as its fallback. Raises ToolchainError if the C is not that of the law."""
    interface = controller.interface
    names = [[member.name for member in members] for members in (interface.inputs, interface.outputs, interface.states)]
    held = len(law.outputs) if law.fallback is Fallback.LAST_OUTPUT else 0
    expected = [[signal.name for signal in signals] for signals in (law.inputs, law.outputs, law.states)]
    fits = names[:2] == expected[:2] and names[2][: len(law.states)] == expected[2]
    if not fits or len(names[2]) != len(law.states) + held or interface.precision != law.precision:
        raise ToolchainError(
            f"the C `{interface.prefix}` does not belong to the law of `{law.name}`: generate it again"
        )
    return held


def _difference(a: Array, b: Array) -> Array:
    """abs(a - b) in double; 0 where both are the same special value, infinite where only one is special."""
    with np.errstate(all="ignore"):
        error = np.abs(a.astype(float) - b.astype(float))
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    return np.where(same, 0.0, np.where(np.isnan(error), np.inf, error))


def _allowed(bound: Array, value: Array) -> Array:
    """The bound with the rounding of the result; where there is no bound, a few units in the last place.

    The smallest normal number is added: below it an ulp is no longer proportional to the value.
    """
    limits = np.finfo(value.dtype)
    rounding = np.abs(value.astype(float)) * float(limits.eps) + float(limits.tiny)
    allowed: Array = np.where(np.isfinite(bound), bound + rounding, 8 * rounding)
    return allowed


def _quotient(error: Array, unit: Array) -> Array:
    """The quotient; 0 for no error, infinite for an error against an empty unit."""
    with np.errstate(all="ignore"):
        quotient = error / unit
    return np.where(error == 0, 0.0, np.where(np.isnan(quotient), np.inf, quotient))


def _largest(values: Array) -> float:
    return float(values.max()) if values.size else 0.0
