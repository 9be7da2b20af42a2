"""The closed loop integrated: with the continuous law, and with the sampled controller under a zero-order hold."""

from __future__ import annotations

import contextlib
import io
import math
import re
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pbcgen.errors import PbcgenError
from pbcgen.law.step import ReferenceStep

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbcgen.law.closed_loop import ClosedLoop
    from pbcgen.law.law import ControlLaw

Array = NDArray[np.float64]


class SimulationError(PbcgenError):
    """The integrator gave up, or the closed loop left the finite numbers."""


@dataclass(frozen=True)
class Tolerance:
    """Accuracy of the integration.

    Attributes:
        relative: error against the present value of a state.
        absolute: error against the scale of a state: about the largest value that it takes.
    """

    relative: float = 1e-10
    absolute: float = 1e-12


@dataclass(frozen=True)
class Trajectory:
    """The closed loop over time.

    Attributes:
        times: (N,) in seconds.
        x: plant states (N, n). xi: controller states (N, nxi). u: inputs of the plant (N, m). In a sampled
            trajectory row k holds the controller state and the output after the step at ``times[k]``; that
            output acts until ``times[k+1]``, or with a delay so much later.
        state_names: one name for each column.
        controller_states: likewise.
        input_names: likewise.
        state_units: their units; empty where unknown.
        input_units: likewise.
    """

    times: Array
    x: Array
    xi: Array
    u: Array
    state_names: tuple[str, ...]
    controller_states: tuple[str, ...]
    input_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_units: tuple[str, ...]


def remaining(trajectory: Trajectory, x_star: ArrayLike) -> Array:
    """(n,) how far each state ends from x*, as a share of the largest distance that it had; 0 if it had none."""
    distance = np.abs(trajectory.x - np.asarray(x_star, dtype=float))
    largest = np.max(distance, axis=0)
    # A distance at the rounding of single precision is none.
    noise = 1e-6 * np.maximum(np.max(np.abs(trajectory.x), axis=0), 1e-30)
    return np.where(largest > noise, distance[-1] / np.maximum(largest, 1e-300), 0.0)


class Stepper(Protocol):
    """A controller that is advanced by one sample period at a time: the compiled C or the Python step."""

    def reset(self) -> None:
        """Start again from the initial state."""
        ...

    def advance(self, measurement: ArrayLike) -> NDArray[Any]:
        """The output u (m,) for the measurement (nm,)."""
        ...

    @property
    def xi(self) -> NDArray[Any]:
        """The controller state (nxi,), perhaps followed by other memory."""
        ...


class PythonStepper:
    """The reference step as a controller with memory."""

    def __init__(self, law: ControlLaw) -> None:
        self._step = ReferenceStep(law)
        self.reset()

    def reset(self) -> None:
        """Set the state to zero."""
        self._xi: NDArray[Any] = self._step.initial.copy()
        self._held: NDArray[Any] | None = None

    def advance(self, measurement: ArrayLike) -> NDArray[Any]:
        """The output u (m,) for the measurement (nm,)."""
        self._xi, self._held, _ = self._step(np.asarray(measurement, self._step.dtype), self._xi, self._held)
        return self._held

    @property
    def xi(self) -> NDArray[Any]:
        """The controller state (nxi,)."""
        return self._xi


def simulate_continuous(loop: ClosedLoop, times: ArrayLike, tolerance: Tolerance | None = None) -> Trajectory:
    """The closed loop with the law in continuous time.

    Args:
        loop: plant and law.
        times: (N,), increasing, seconds; the run starts at time 0 from ``loop.initial`` with xi = 0.
        tolerance: of CVODES.

    Returns:
        The trajectory at ``times``.

    Raises:
        SimulationError: CVODES fails; the message names the time that it reached.
    """
    grid = np.atleast_1d(np.asarray(times, dtype=float))
    if grid.ndim != 1 or grid.size == 0 or not np.all(np.isfinite(grid)) or grid[0] < 0 or np.any(np.diff(grid) <= 0):
        raise SimulationError("the times of a simulation must be finite, increasing and not negative")
    nx = len(loop.initial)
    flow = _continuous_flow(loop, _scales(loop, float(grid[-1])), grid, tolerance or Tolerance())
    states = flow.follow(_start(loop))
    outputs = loop.controller.map(len(grid))(states[:nx], states[nx:])[1]
    return _trajectory(loop, grid, states[:nx].T, states[nx:].T, np.array(outputs).T)


def simulate_sampled(
    loop: ClosedLoop,
    controller: Stepper,
    h: Fraction | float,
    duration: float,
    tolerance: Tolerance | None = None,
    *,
    delay: Fraction = Fraction(0),
    progress: Callable[[float], None] | None = None,
) -> Trajectory:
    """The closed loop as firmware runs it: measure, step the controller, hold u for the sample period h.

    The controller is reset first. Between the samples the plant is integrated by CVODES, restarted at each sample
    because u jumps there.

    Args:
        loop: the plant and what is measured.
        controller: the compiled C, or :class:`PythonStepper`.
        h: sample period in seconds.
        duration: in seconds; the last sample is at the last multiple of h within it.
        tolerance: of CVODES.
        delay: of the output, in sample periods; the plant's input is the equilibrium's before the first one acts.
        progress: called now and then with the share of the run that is done.

    Returns:
        The trajectory at the samples 0, h, 2h, ...

    Raises:
        SimulationError: CVODES fails, or the state is no longer finite; the message names the time reached.
    """
    period = Fraction(h)
    if period <= 0:
        raise SimulationError(f"the sample period is {float(period):g} s: it must be positive")
    count = math.floor(Fraction(duration) / period + Fraction(1, 10**9))
    nx, nu = len(loop.initial), len(loop.u_star)
    scales = _scales(loop, count * float(period))[:nx]
    holds = _held_flows(loop, period, delay, scales, tolerance or Tolerance())
    controller.reset()
    xs = np.zeros((count + 1, nx))
    us = np.zeros((count + 1, nu))
    xis = np.zeros((count + 1, len(loop.controller_states)))
    xs[0] = loop.initial
    for k in range(count + 1):
        us[k] = controller.advance(np.asarray(loop.measure(xs[k]), dtype=float).ravel())
        xis[k] = controller.xi[: xis.shape[1]]
        if k < count:
            xs[k + 1], time = xs[k], k * float(period)
            for ago, length, hold in holds:
                xs[k + 1] = hold.follow(xs[k + 1], us[k - ago] if k >= ago else loop.u_star, time)[:, 0]
                time += length
        if progress is not None and k % 100 == 0:
            progress(k / max(count, 1))
    return _trajectory(loop, np.array([float(k * period) for k in range(count + 1)]), xs, xis, us)


class _Flow:
    """The solution of z' = field(z, p) on a time grid, in coordinates in which every state is of order one."""

    def __init__(self, z: ca.SX, p: ca.SX, field: ca.SX, *, scales: Array, grid: Array, tolerance: Tolerance) -> None:
        normal = ca.SX.sym("normal", z.numel())
        scaled = ca.substitute(field, z, scales * normal) / scales
        options = {
            "abstol": tolerance.absolute,
            "reltol": tolerance.relative,
            "max_num_steps": 50_000,
        }
        self._scales = scales
        self._solve = ca.integrator(
            "flow", "cvodes", {"x": normal, "p": p, "ode": scaled}, 0.0, [float(t) for t in grid], options
        )

    def follow(self, start: Array, p: ArrayLike = (), time: float = 0.0) -> Array:
        """The states (n, N) on the grid; ``time`` is when ``start`` holds. Raises SimulationError."""
        log = io.StringIO()
        try:
            with contextlib.redirect_stderr(log), contextlib.redirect_stdout(log):
                states = np.array(self._solve(x0=start / self._scales, p=ca.DM(np.asarray(p, dtype=float)))["xf"])
        except RuntimeError as error:
            raise SimulationError(_failure(f"{log.getvalue()}\n{error}", time)) from error
        if not np.all(np.isfinite(states)):
            raise SimulationError(f"the closed loop left the finite numbers after t = {time:.6g} s")
        return states * self._scales[:, None]


def _start(loop: ClosedLoop) -> Array:
    """(x, xi) at the beginning of a run."""
    return np.concatenate([loop.initial, np.zeros(len(loop.controller_states))])


def _continuous_flow(loop: ClosedLoop, scales: Array, grid: Array, tolerance: Tolerance) -> _Flow:
    """The closed loop with the law in continuous time, in (x, xi)."""
    nx, nz = len(loop.initial), len(scales)
    z = ca.SX.sym("z", nz)
    x, xi = ca.vertsplit(z, [0, nx, nz])
    rate, u = loop.controller(x, xi)
    return _Flow(z, ca.SX(0, 1), ca.vertcat(loop.plant(x, u), rate), scales=scales, grid=grid, tolerance=tolerance)


def _held_flows(
    loop: ClosedLoop, period: Fraction, delay: Fraction, scales: Array, tolerance: Tolerance
) -> list[tuple[int, float, _Flow]]:
    """The parts of a sample period: how many steps ago the output was made that acts in it, its length, the plant."""
    x, u = ca.SX.sym("x", len(loop.initial)), ca.SX.sym("u", len(loop.u_star))
    whole, part = divmod(delay, 1)
    # The output of `whole + 1` steps ago acts until the later one takes over.
    shares = [(int(whole) + 1, part * period), (int(whole), (1 - part) * period)]
    return [
        (
            ago,
            float(length),
            _Flow(x, u, loop.plant(x, u), scales=scales, grid=np.array([float(length)]), tolerance=tolerance),
        )
        for ago, length in shares
        if length
    ]


def _failure(log: str, start: float) -> str:
    """What CVODES and CasADi wrote, in one sentence with the time that was reached."""
    times = re.findall(r"At t = ([-+0-9.eE]+[0-9])", log)
    reached = f"at t = {start + float(times[-1]):.6g} s" if times else f"after t = {start:.6g} s"
    flag = re.search(r"CV_[A-Z_]+", log)
    reason = f" ({flag.group()})" if flag else ""
    if flag is not None and flag.group() == "CV_TOO_MUCH_WORK":
        return (
            f"the integration of the closed loop stopped {reached}{reason}: the loop is too fast for the simulation, as"
            " with a law so steep (a large beta) that it switches like a relay; lower beta or the plant's fastest rate"
        )
    return (
        f"the integration of the closed loop stopped {reached}{reason}: the trajectory leaves the model's domain there"
        " or grows without bound; check the sample period and the initial state"
    )


def _scales(loop: ClosedLoop, duration: float) -> Array:
    """For each state of the closed loop (x, xi) a power of two near the largest value in a rough continuous run."""
    start = _start(loop)
    largest = np.maximum(np.abs(start), np.abs(np.concatenate([loop.x_star, np.zeros(len(loop.controller_states))])))
    if duration > 0:
        grid = np.linspace(0.0, duration, 201)[1:]
        pilot = _continuous_flow(loop, np.ones(len(start)), grid, Tolerance(1e-6, 1e-15))
        largest = np.maximum(largest, np.abs(pilot.follow(start)).max(axis=1))
    return np.exp2(np.round(np.log2(np.where(largest > 1e-100, largest, 1.0))))


def _trajectory(loop: ClosedLoop, times: Array, x: Array, xi: Array, u: Array) -> Trajectory:
    return Trajectory(
        times=times,
        x=x,
        xi=xi,
        u=u,
        state_names=loop.state_names,
        controller_states=loop.controller_states,
        input_names=loop.input_names,
        state_units=loop.state_units,
        input_units=loop.input_units,
    )
