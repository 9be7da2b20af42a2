"""Plots of robustness runs, and of a loop before and after tuning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pbcgen.report.plots import COLOURS

Array = NDArray[np.float64]


def _rc() -> Any:
    return dict(_STYLE)


_STYLE = {"font.size": 12, "axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False}


def plot_tuning(
    before: tuple[Array, Array],
    after: tuple[Array, Array],
    names: Sequence[str],
    band: float,
    settling: tuple[float, float],
    title: str,
    inputs: tuple[Array, Array],
    input_names: Sequence[str],
    limits: Sequence[tuple[float | None, float | None]],
) -> Figure:
    """The target signals and the inputs before and after tuning.

    Args:
        before: times (N,) in seconds and errors (N, k) of the target signals.
        after: the same with the new gains.
        names: of the signals.
        band: share of the initial error that counts as settled.
        settling: times before and after, seconds; infinity where there is none.
        title: above the panels.
        inputs: (N - 1, m) before and after: held over each sample period.
        input_names: m names.
        limits: (lo, hi) of each input; None is unbounded.
    """
    runs = tuple(zip((before, after), inputs, ("before", "after"), (COLOURS[1], COLOURS[0]), settling, strict=True))
    count = len(names)
    with mpl.rc_context(rc=_rc()):
        figure = Figure(figsize=(16, 9), dpi=100, layout="constrained")
        figure.suptitle(title, fontsize=15, x=0.012, ha="left")
        for k, name in enumerate(names):
            axes = figure.add_subplot(count, 2, 2 * k + 1)
            width = band * max(abs(before[1][0, k]), 1e-300)
            axes.axhspan(-width, width, color="#808080", alpha=0.15, linewidth=0)
            for (times, errors), _, label, colour, end in runs:
                legend = f"{label}: settled at {end:.4g} s" if np.isfinite(end) else f"{label}: not settled"
                axes.plot(times, errors[:, k], color=colour, label=legend, linewidth=1.8)
                if np.isfinite(end):
                    axes.axvline(end, color=colour, linestyle=":", linewidth=1.2)
            axes.set_ylabel(f"error of {name}")
            axes.margins(x=0)
            axes.legend(loc="best")
        axes.set_xlabel("time [s]")
        for k, name in enumerate(input_names):
            axes = figure.add_subplot(len(input_names), 2, 2 * k + 2)
            for (times, _), u, _, colour, _ in runs:
                axes.step(times[:-1], u[:, k], color=colour, linewidth=1.4, where="post")
            for bound in limits[k]:
                if bound is not None:
                    axes.axhline(bound, color="#808080", linestyle="--", linewidth=1.2)
            axes.set_ylabel(name)
            axes.margins(x=0)
        axes.set_xlabel("time [s]")
    return figure


def plot_robustness(
    runs: Sequence[Array],
    columns: Sequence[int],
    names: Sequence[str],
    targets: Sequence[float],
    relative: Array,
    settling: Array,
    tolerance: float,
    title: str,
) -> Figure:
    """Some runs over time with the worst one on top, and how all runs end.

    Args:
        runs: rows of t and states; the first is the nominal run, the last the worst.
        columns: the states to draw, as columns of the runs. names, targets: of these states.
        names: of these states.
        targets: of these states.
        relative: final error of every run as a share of the initial one.
        settling: of every run, seconds.
        tolerance: share within which a run counts as converged.
        title: above the panels.
    """
    with mpl.rc_context(rc=_rc()):
        figure = Figure(figsize=(16, 9), dpi=100, layout="constrained")
        figure.suptitle(title, fontsize=15, x=0.012, ha="left")
        grid = figure.add_gridspec(2, 2 * max(1, len(columns)), height_ratios=[1.4, 1])
        width = 2
        for k, (column, name, target) in enumerate(zip(columns, names, targets, strict=True)):
            axes = figure.add_subplot(grid[0, k * width : (k + 1) * width])
            for run in runs[1:-1]:
                axes.plot(run[:, 0], run[:, column], color=COLOURS[0], alpha=0.15, linewidth=1.0)
            axes.plot(runs[-1][:, 0], runs[-1][:, column], color=COLOURS[1], linewidth=1.8, label="worst run")
            axes.plot(runs[0][:, 0], runs[0][:, column], color="black", linewidth=1.8, label="nominal run")
            axes.axhline(target, color="#808080", linestyle="-.", linewidth=1.1, label="target")
            axes.set_ylabel(name)
            axes.set_xlabel("time [s]")
            axes.margins(x=0)
            axes.legend(loc="best")
        half = max(1, len(columns))
        _ends(figure.add_subplot(grid[1, :half]), relative, tolerance)
        _times(figure.add_subplot(grid[1, half:]), settling)
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
        axes.hist(finite, bins=40, color=COLOURS[0], alpha=0.8)
    missing = len(settling) - len(finite)
    axes.set_xlabel(
        "settling time, 2 % of the initial error [s]" + (f"; {missing} runs do not settle" if missing else "")
    )
    axes.set_ylabel("runs")
