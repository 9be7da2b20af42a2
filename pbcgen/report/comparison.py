"""Plots of robustness runs, and of a loop before and after tuning."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pbcgen.law.closed_loop import ClosedLoop
from pbcgen.models.design import Design
from pbcgen.report.plots import COLOURS, STYLE
from pbcgen.run.robust import Robustness
from pbcgen.run.trajectories import trace
from pbcgen.tuning.trial import BAND, Run, response

Array = NDArray[np.float64]


#: Runs beside the nominal and the worst one that are drawn.
_DRAWN = 60


def plot_tuning(design: Design, before: Run, after: Run) -> Figure:
    """The target signals and the inputs of two trial runs of a design: with its own gains, and with others.

    The target signals are drawn as errors, with the band in which they count as settled.
    """
    names, inputs = [c.name for c in design.target.conditions], design.system.input_names
    runs = [
        (run, label, colour, response(run).settling)
        for run, label, colour in ((before, "before", COLOURS[1]), (after, "after", COLOURS[0]))
    ]
    with mpl.rc_context(STYLE):
        figure = _figure(f"{design.name}: before and after tuning")
        for k, name in enumerate(names):
            axes = figure.add_subplot(len(names), 2, 2 * k + 1)
            width = BAND * max(abs(before.errors[0, k]), 1e-300)
            axes.axhspan(-width, width, color="#808080", alpha=0.15, linewidth=0)
            for run, label, colour, settling in runs:
                settled = bool(np.isfinite(settling))
                legend = f"{label}: settled at {settling:.4g} s" if settled else f"{label}: not settled"
                axes.plot(run.times, run.errors[:, k], color=colour, label=legend, linewidth=1.8)
                if settled:
                    axes.axvline(settling, color=colour, linestyle=":", linewidth=1.2)
            axes.set_ylabel(f"error of {name}")
            axes.margins(x=0)
            axes.legend(loc="best")
        axes.set_xlabel("time [s]")
        for k, name in enumerate(inputs):
            axes = figure.add_subplot(len(inputs), 2, 2 * k + 2)
            for run, _, colour, _ in runs:
                axes.step(run.times[:-1], run.inputs[:, k], color=colour, linewidth=1.4, where="post")
            for bound in design.input_set.intervals[k]:
                if bound is not None:
                    axes.axhline(float(bound), color="#808080", linestyle="--", linewidth=1.2)
            axes.set_ylabel(name)
            axes.margins(x=0)
        axes.set_xlabel("time [s]")
    return figure


def plot_robustness(design: Design, loop: ClosedLoop, found: Robustness) -> Figure:
    """Some runs over time with the worst one on top, and how all runs end."""
    wanted = [c.name for c in design.target.conditions if c.name in loop.state_names][:4] or loop.state_names[:3]
    count = len(found.outcomes)
    nominal, *others, worst = [trace(found.loops, k) for k in [*range(min(count, _DRAWN)), found.worst]]
    with mpl.rc_context(STYLE):
        figure = _figure(f"{design.name}: {100 * found.share:.4g} % of {count} runs converge")
        grid = figure.add_gridspec(2, 2 * len(wanted), height_ratios=[1.4, 1])
        for k, name in enumerate(wanted):
            axes, state = figure.add_subplot(grid[0, 2 * k : 2 * k + 2]), loop.state_names.index(name)
            for run in others:
                axes.plot(run[:, 0], run[:, 1 + state], color=COLOURS[0], alpha=0.15, linewidth=1.0)
            axes.plot(worst[:, 0], worst[:, 1 + state], color=COLOURS[1], linewidth=1.8, label="worst run")
            axes.plot(nominal[:, 0], nominal[:, 1 + state], color="black", linewidth=1.8, label="nominal run")
            axes.axhline(float(loop.x_star[state]), color="#808080", linestyle="-.", linewidth=1.1, label="target")
            unit = loop.state_units[state]
            axes.set_ylabel(f"{name} [{unit}]" if unit else name)
            axes.set_xlabel("time [s]")
            axes.margins(x=0)
            axes.legend(loc="best")
        _ends(figure.add_subplot(grid[1, : len(wanted)]), found.relative, found.tolerance)
        _times(figure.add_subplot(grid[1, len(wanted) :]), found.settling)
    return figure


def _figure(title: str) -> Figure:
    figure = Figure(figsize=(16, 9), dpi=100, layout="constrained")
    figure.suptitle(title, fontsize=15, x=0.012, ha="left")
    return figure


def _ends(axes: mpl.axes.Axes, relative: Array, tolerance: float) -> None:
    """How many runs end within an error, as a curve."""
    finite = np.sort(np.clip(np.where(np.isfinite(relative), relative, 1e3), 1e-9, 1e3))
    axes.step(finite, np.arange(1, len(finite) + 1) / len(finite), where="post", color=COLOURS[0])
    axes.axvline(tolerance, color=COLOURS[1], linestyle=":", linewidth=1.6, label=f"tolerance {tolerance:g}")
    axes.set_xscale("log")
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("final error as a share of the initial one")
    axes.set_ylabel("share of runs below")
    axes.legend(loc="best")


def _times(axes: mpl.axes.Axes, settling: Array) -> None:
    """When the runs settle."""
    finite = settling[np.isfinite(settling)]
    if len(finite):
        axes.hist(finite, bins=max(5, min(40, len(finite) // 5)), color=COLOURS[0], alpha=0.8)
    missing = len(settling) - len(finite)
    axes.set_xlabel(
        "settling time, 2 % of the initial error [s]" + (f"; {missing} runs do not settle" if missing else "")
    )
    axes.set_ylabel("runs")
