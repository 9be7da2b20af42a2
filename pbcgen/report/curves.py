"""The closed loop simulated for a page: the continuous law and the sampled controller on one time grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pbcgen.emit import Package
from pbcgen.errors import ToolchainError
from pbcgen.law.law import ControlLaw
from pbcgen.pipeline import Report
from pbcgen.report.energy import along, lyapunov
from pbcgen.run.simulate import (
    PythonStepper,
    SimulationError,
    Stepper,
    Trajectory,
    simulate_continuous,
    simulate_sampled,
)
from pbcgen.run.wrapper import Controller

Array = NDArray[np.float64]
Progress = Callable[[str], None] | None

#: About how many instants of a long run a page keeps, beside the extremes of the inputs.
_INSTANTS = 900
_BINS = 100

#: A run of more samples than this is cut short.
MOST_SAMPLES = 60_000


@dataclass(frozen=True)
class Run:
    """One simulated loop on the grid of a page; ``energy`` is S_d - S_d(x*), or None."""

    x: Array
    u: Array
    energy: Array | None


@dataclass(frozen=True)
class Curves:
    """What the plots of a page show.

    Attributes:
        times: (N,) seconds.
        continuous: the law in continuous time, or None if it could not be integrated.
        sampled: the controller under a zero-order hold, or None likewise.
        before: the continuous loop of the design that this one is compared with, or None.
        source: what ran as the sampled controller.
        remarks: what the reader must know, such as why a curve is missing.
        full: the whole sampled run, for figures such as settling times, or None.
    """

    times: Array
    continuous: Run | None
    sampled: Run | None
    before: Run | None
    source: str
    remarks: tuple[str, ...]
    full: Trajectory | None


def simulate(
    report: Report, package: Package | None, before: Report | None = None, progress: Progress = None
) -> Curves | None:
    """Run the loop of a checked design; None when there is no law to run."""
    loop, law = report.loop, report.control
    if loop is None or law is None:
        return None
    remarks: list[str] = []
    h = float(report.design.sample_period)
    duration = min(loop.duration, MOST_SAMPLES * h)
    if duration < loop.duration:
        remarks.append(f"The run is cut to {duration:g} s: {MOST_SAMPLES} samples.")
    sampled, source = None, ""
    if progress:
        progress("sampled closed loop")
    try:
        with _controller(law, package) as (stepper, source):
            sampled = simulate_sampled(loop, stepper, report.design.sample_period, duration, delay=report.design.delay)
    except SimulationError as error:
        remarks.append(f"The sampled loop could not be simulated: {error}.")
    times = sampled.times if sampled is not None else np.linspace(0.0, duration, _INSTANTS)
    kept = _instants(times, sampled.u if sampled is not None else np.zeros((len(times), 1)))
    if progress:
        progress("continuous closed loop")
    continuous = _continuous(report, times[kept], remarks, "continuous")
    return Curves(
        times[kept],
        continuous,
        None if sampled is None else _run(report, sampled.x[kept], sampled.xi[kept], sampled.u[kept]),
        None if before is None else _continuous(before, times[kept], remarks, "earlier"),
        source,
        tuple(remarks),
        sampled,
    )


@contextmanager
def _controller(law: ControlLaw, package: Package | None) -> Iterator[tuple[Stepper, str]]:
    """The compiled C where there is a package and a compiler, else the Python step that agrees with it."""
    if package is not None:
        try:
            controller = Controller.of_package(package)
        except ToolchainError:
            pass
        else:
            with controller:
                yield controller, "the generated C"
            return
    yield PythonStepper(law), "the Python step that the C is tested against"


def _continuous(report: Report, times: Array, remarks: list[str], which: str) -> Run | None:
    if report.loop is None:
        remarks.append(f"The {which} design has no law to simulate.")
        return None
    try:
        run = simulate_continuous(report.loop, times)
    except SimulationError as error:
        remarks.append(f"The {which} loop could not be simulated: {error}.")
        return None
    return _run(report, run.x, run.xi, run.u)


def _run(report: Report, x: Array, xi: Array, u: Array) -> Run:
    function = lyapunov(report.derivation)
    return Run(x, u, None if function is None else along(function, x, xi[:, : function.size1_in(1)]))


def _instants(times: Array, u: Array) -> NDArray[np.intp]:
    """Which samples a page keeps: evenly spaced ones, more at the start, and the extremes of every input."""
    count = len(times)
    if count <= _INSTANTS:
        return np.arange(count)
    kept = {*np.linspace(0, count - 1, _INSTANTS).round().astype(int).tolist()}
    kept |= {*np.linspace(0, count // 10, _INSTANTS // 3).round().astype(int).tolist()}
    edges = np.linspace(0, count, _BINS + 1).astype(int)
    for column in u.T:
        for lo, hi in pairwise(edges.tolist()):
            kept |= {int(lo + np.argmin(column[lo:hi])), int(lo + np.argmax(column[lo:hi]))}
    return np.array(sorted(kept), dtype=np.intp)


# --- figures -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SignalFigures:
    """One row of the table of signals; ``levels`` are the target of a state or the limits of an input."""

    name: str
    unit: str
    start: float
    end: float
    smallest: float
    largest: float
    levels: tuple[float, ...]
    settling: float | None
    deviation: float | None


def signal_figures(report: Report, curves: Curves) -> tuple[list[SignalFigures], list[SignalFigures]]:
    """The states and the inputs of the sampled run, or of the continuous one where there is none."""
    run = curves.sampled or curves.continuous
    loop = report.loop
    if run is None or loop is None:
        return [], []
    full = curves.full
    times, x, u = (full.times, full.x, full.u) if full is not None else (curves.times, run.x, run.u)
    other = curves.continuous if curves.sampled is not None else None
    states = [
        _figures(
            n, unit, times, x[:, k], (float(loop.x_star[k]),), _difference(run.x, None if other is None else other.x, k)
        )
        for k, (n, unit) in enumerate(zip(loop.state_names, loop.state_units, strict=True))
    ]
    intervals = () if report.control is None else report.control.intervals
    inputs = [
        _figures(
            n,
            unit,
            times,
            u[:, k],
            tuple(map(float, intervals[k])),
            _difference(run.u, None if other is None else other.u, k),
        )
        for k, (n, unit) in enumerate(zip(loop.input_names, loop.input_units, strict=True))
    ]
    return states, inputs


def _difference(ours: Array, other: Array | None, k: int) -> float | None:
    return None if other is None else float(np.max(np.abs(ours[:, k] - other[:, k])))


def _figures(
    name: str, unit: str, times: Array, values: Array, levels: tuple[float, ...], deviation: float | None
) -> SignalFigures:
    settled = settling_time(times, values, levels[0]) if len(levels) == 1 else None
    return SignalFigures(
        name,
        unit,
        float(values[0]),
        float(values[-1]),
        float(values.min()),
        float(values.max()),
        levels,
        settled,
        deviation,
    )


def settling_time(times: Array, values: Array, target: float, share: float = 0.02) -> float | None:
    """When the signal enters the band of 2 % of its initial distance around the target for good; None if it does not.

    None also for a signal that starts at its target: there is no distance to measure by.
    """
    band = share * abs(float(values[0]) - target)
    if band == 0 or not math.isfinite(band):
        return None
    outside = np.flatnonzero(np.abs(values - target) > band)
    if outside.size == 0:
        return float(times[0])
    return float(times[outside[-1] + 1]) if outside[-1] + 1 < len(times) else None


def saturation_entries(u: Array, lo: float, hi: float, share: float = 0.005) -> int:
    """How often a signal enters the outer bands of its interval, ``share`` of its width at either end.

    tanh reaches its limits only in the limit, so "saturated" needs a band.
    """
    margin = share * (hi - lo)
    inside = (u >= hi - margin) | (u <= lo + margin)
    return int(inside[0]) + int(np.sum(inside[1:] & ~inside[:-1]))
