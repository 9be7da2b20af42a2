"""What the plots of a page show, as data for the script that draws them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.control.attraction import Region
from pbcgen.pipeline import Report
from pbcgen.report.curves import Curves, Run
from pbcgen.report.plots import Panel, panels

Array = NDArray[np.float64]

_DIGITS = 6
_PORTRAITS = 3

#: How a run is drawn: what the legend says, and the style that the script knows.
_RUNS = (("continuous", "continuous", "band"), ("sampled", "sampled", "line"), ("before", "before", "dash"))


def plot_data(report: Report, curves: Curves, region: Region | None = None) -> dict[str, Any]:
    """A JSON-able document: the time grid, panels over time, phase portraits with the region of attraction."""
    columns = _Columns({})
    over_time = [*_signals(report, curves, columns), *_energy(curves, columns)]
    for k, panel in enumerate(over_time):
        panel["id"] = f"plot-{k + 1}"
    portraits = list(_portraits(report, curves, columns, region))
    for k, panel in enumerate(portraits):
        panel["id"] = f"portrait-{k + 1}"
    return {"times": rounded(curves.times), "columns": columns.values, "panels": over_time, "portraits": portraits}


@dataclass(frozen=True)
class _Columns:
    """The curves by name; panels refer to them, so that each is stored once."""

    values: dict[str, list[float | None]]

    def add(self, name: str, values: Array) -> str:
        """Keep a curve and return its name."""
        if name not in self.values:
            self.values[name] = rounded(values)
        return name


def rounded(values: Array) -> list[float | None]:
    """Numbers of six digits, without the noise below; what is not finite is null."""
    return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in values.tolist()]


def _runs(curves: Curves) -> Iterator[tuple[str, str, Run]]:
    for field, label, style in _RUNS:
        run = getattr(curves, field)
        if run is not None:
            yield label, style, run


def _signals(report: Report, curves: Curves, columns: _Columns) -> Iterator[dict[str, Any]]:
    shown = curves.sampled or curves.continuous
    loop, law = report.loop, report.control
    if shown is None or loop is None or law is None:
        return
    targets = [(float(v),) for v in loop.x_star]
    limits = [(float(lo), float(hi)) for lo, hi in law.intervals]
    for panel in panels(shown.x, loop.state_names, loop.state_units, targets, held=False):
        yield _panel(panel, curves, columns, "x", "target")
    for panel in panels(shown.u, loop.input_names, loop.input_units, limits, held=True):
        yield _panel(panel, curves, columns, "u", "bound")


def _panel(panel: Panel, curves: Curves, columns: _Columns, field: str, level: str) -> dict[str, Any]:
    series = []
    for colour, (name, k) in enumerate(zip(panel.names, panel.columns, strict=True)):
        for label, style, run in _runs(curves):
            step = field == "u" and style == "line"
            values = columns.add(f"{label} {field}{k}", getattr(run, field)[:, k])
            series.append(
                {"label": f"{name} {label}", "style": "step" if step else style, "colour": colour, "y": values}
            )
    drawn = set()
    for colour, (name, levels) in enumerate(zip(panel.names, panel.levels, strict=True)):
        for value in levels:
            if value not in drawn:
                drawn.add(value)
                own = any(value not in others for others in panel.levels)
                label = f"{level} of {name}: {value:.6g}" if own else f"{level} {value:.6g}"
                series.append({"label": label, "style": level, "colour": colour, "y": value})
    names = ", ".join(panel.names)
    return {
        "title": f"{names} [{panel.unit}]" if panel.unit else names,
        "kind": "inputs" if field == "u" else "states",
        "series": series,
        "alt": _description(panel, curves, field),
    }


def _description(panel: Panel, curves: Curves, field: str) -> str:
    """What the picture shows, for those who do not see it."""
    run = curves.sampled or curves.continuous
    assert run is not None
    values = getattr(run, field)
    parts = [
        f"{name} starts at {values[0, k]:.4g}, ends at {values[-1, k]:.4g}, stays between {values[:, k].min():.4g} "
        f"and {values[:, k].max():.4g}"
        for name, k in zip(panel.names, panel.columns, strict=True)
    ]
    return f"Over {curves.times[-1]:g} s: " + "; ".join(parts) + "."


def _energy(curves: Curves, columns: _Columns) -> Iterator[dict[str, Any]]:
    series = [
        {"label": label, "style": style, "colour": 0, "y": columns.add(f"{label} energy", run.energy)}
        for label, style, run in _runs(curves)
        if run.energy is not None
    ]
    if not series:
        return
    energy = next(run.energy for _, _, run in _runs(curves) if run.energy is not None)
    yield {
        "title": "Lyapunov function S_d - S_d(x*), logarithmic",
        "kind": "energy",
        "series": series,
        "alt": f"The Lyapunov function falls from {energy[0]:.4g} to {energy[-1]:.4g}.",
    }


# --- phase portraits ---------------------------------------------------------------------------------------------


def _portraits(report: Report, curves: Curves, columns: _Columns, region: Region | None) -> Iterator[dict[str, Any]]:
    loop = report.loop
    if loop is None or (curves.sampled or curves.continuous) is None:
        return
    names = loop.state_names
    for i, j in coordinate_pairs(report)[:_PORTRAITS]:
        outline = [] if region is None else region_outline(report, region, i, j)
        series = [
            {
                "label": label,
                "style": style,
                "colour": 0,
                "x": columns.add(f"{label} x{i}", run.x[:, i]),
                "y": columns.add(f"{label} x{j}", run.x[:, j]),
            }
            for label, style, run in _runs(curves)
        ]
        runs = [run.x for _, _, run in _runs(curves)]
        alt = f"The path of ({names[i]}, {names[j]}) from the start, marked by a ring, to x*, marked by a cross"
        yield {
            "title": f"{names[j]} over {names[i]}",
            "x_title": _with_unit(names[i], loop.state_units[i]),
            "y_title": _with_unit(names[j], loop.state_units[j]),
            "series": series,
            "region": outline,
            "target": [float(loop.x_star[i]), float(loop.x_star[j])],
            "x_range": _range([loop.x_star[[i]], *(x[:, i] for x in runs), *(np.array(line[0]) for line in outline)]),
            "y_range": _range([loop.x_star[[j]], *(x[:, j] for x in runs), *(np.array(line[1]) for line in outline)]),
            "alt": alt + (", inside the shaded region of attraction." if outline else "."),
        }


def coordinate_pairs(report: Report) -> list[tuple[int, int]]:
    """Pairs of states whose picture tells the motion: position and momentum, or the target and what drives it."""
    system = report.design.system
    names = system.state_names
    if system.mechanical is not None:
        half = system.n // 2
        return [(k, half + k) for k in range(half)]
    pairs = []
    for condition in report.design.target.conditions:
        if condition.name not in names:
            continue
        i = names.index(condition.name)
        drivers = [j for j in range(system.n) if j != i and ca.depends_on(system.f[i], system.x[j])]
        pairs += [(i, j) for j in drivers[:1]]
    return pairs


def region_outline(report: Report, region: Region, i: int, j: int, count: int = 81) -> list[list[list[float | None]]]:
    """The cut of a region of attraction with the plane of two states through x*, as closed lines [xs, ys]."""
    from contourpy import contour_generator

    if report.loop is None or region.height is None or not region.box:
        return []
    names = report.loop.state_names
    axes = [np.linspace(*region.box[names[k]], count) for k in (i, j)]
    point = report.loop.x_star.copy()
    heights = np.empty((count, count))
    for row, second in enumerate(axes[1]):
        for column, first in enumerate(axes[0]):
            point[i], point[j] = first, second
            heights[row, column] = region.height(point.tolist())
    lines = contour_generator(axes[0], axes[1], heights).lines(region.level)
    return [[rounded(np.asarray(line)[:, 0]), rounded(np.asarray(line)[:, 1])] for line in lines]


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _range(values: Sequence[Array]) -> list[float]:
    lo, hi = min(float(np.nanmin(v)) for v in values), max(float(np.nanmax(v)) for v in values)
    margin = 0.05 * (hi - lo) or 1.0
    return [float(f"{lo - margin:.4g}"), float(f"{hi + margin:.4g}")]
