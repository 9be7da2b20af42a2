"""Pictures of the closed loop, continuous and sampled."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from pbcgen.errors import ModelError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from fractions import Fraction

    from matplotlib.axes import Axes
    from matplotlib.gridspec import SubplotSpec

    from pbcgen.run.simulate import Trajectory

Array = NDArray[np.float64]

#: The palette of Okabe and Ito without its yellow: told apart by colour-blind readers, and on white paper.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")

#: How every picture looks.
STYLE: dict[Any, Any] = {
    "font.size": 11.0,
    "axes.titlesize": 11.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "axes.edgecolor": "#808080",
    "xtick.color": "#404040",
    "ytick.color": "#404040",
    "legend.frameon": False,
    "svg.hashsalt": "pbcgen",
    "svg.fonttype": "path",
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": True,
}

#: Curves of one unit share a panel unless one is this much larger than another.
_SCALE_RATIO = 20.0
_LEVEL_COLOUR = "#606060"
_LIMIT_COLOUR = "#b00020"

#: Limits that are farther from the law's interval than so many times its width are not drawn.
_FAR = 1.0
_LINES_PER_PANEL = 4

#: So many characters of a label stand beside a panel.
_LABEL_WIDTH = 32
_METADATA: dict[str, dict[str, None]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
    ".pdf": {"CreationDate": None, "ModDate": None, "Creator": None, "Producer": None},
}


@dataclass(frozen=True)
class Bounds:
    """Where the inputs stay, and where they must.

    Attributes:
        law: the interval in which the law keeps each input.
        actuator: what its actuator can do; None is unbounded.
    """

    law: Sequence[tuple[Fraction, Fraction]]
    actuator: Sequence[tuple[Fraction | None, Fraction | None]]


@dataclass(frozen=True)
class Panel:
    """Signals that share an axis.

    Attributes:
        columns: which columns of x or u.
        names: of these signals.
        unit: that they share.
        levels: horizontal lines for each of these signals: targets, or where the law keeps an input.
        held: whether the sampled signal is constant between samples.
        limits: of the actuators, likewise.
    """

    columns: tuple[int, ...]
    names: tuple[str, ...]
    unit: str
    levels: tuple[tuple[float, ...], ...]
    held: bool
    limits: tuple[tuple[float, ...], ...] = ()


def plot_closed_loop(
    continuous: Trajectory,
    sampled: Trajectory,
    bounds: Bounds,
    targets: Sequence[float | None],
    title: str,
) -> Figure:
    """States above, inputs below; the continuous law as a pale band, the sampled one as a line on it.

    Args:
        continuous: the loop with the law in continuous time.
        sampled: the loop with the sampled controller; the same signals.
        bounds: of each input: the law's drawn dashed, the actuator's dotted.
        targets: the equilibrium of each state, drawn dash-dotted; None for no line.
        title: above the panels.

    Returns:
        A figure of 1600 x 900 pixels, tied to no window and to no global state.
    """
    levels = [() if target is None else (float(target),) for target in targets]
    always = [(float(lo), float(hi)) for lo, hi in bounds.law]
    limits = [tuple(float(end) for end in pair if end is not None) for pair in bounds.actuator]
    states = panels(sampled.x, sampled.state_names, sampled.state_units, levels, held=False)
    inputs = panels(sampled.u, sampled.input_names, sampled.input_units, always, held=True, limits=limits)
    unit, factor = _time_unit(float(max(continuous.times[-1], sampled.times[-1])))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(16, 9), dpi=100, layout="constrained")
        figure.suptitle(title, fontsize=15, x=0.012, ha="left")
        for panel, place in zip([*states, *inputs], _places(figure, len(states), len(inputs)), strict=True):
            axes = figure.add_subplot(place)
            before, after = (continuous.u, sampled.u) if panel.held else (continuous.x, sampled.x)
            _draw(axes, panel, (continuous.times * factor, before), (sampled.times * factor, after))
            axes.set_xlabel(f"time [{unit}]")
        _explain(figure)
    return figure


def save(figure: Figure, path: Path | str) -> None:
    """Write the figure as PNG, SVG or PDF, after the suffix of ``path``; equal figures give equal bytes.

    Raises ModelError for another suffix or a path that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _METADATA:
        raise ModelError(f"`{path}` does not end in {', '.join(sorted(_METADATA))}: choose one of them")
    try:
        with mpl.rc_context(STYLE):
            figure.savefig(path, metadata=_METADATA[suffix])
    except OSError as error:
        raise ModelError(f"`{path}` cannot be written: {error.strerror}") from error


def panels(
    values: Array,
    names: Sequence[str],
    units: Sequence[str],
    levels: Sequence[tuple[float, ...]],
    *,
    held: bool,
    limits: Sequence[tuple[float, ...]] = (),
) -> list[Panel]:
    """Signals of one unit and of like size together, in the order in which they first appear."""
    sizes = [
        max(float(np.max(np.abs(values[:, k]), initial=0.0)), *map(abs, levels[k]), 0.0) for k in range(len(names))
    ]
    groups: list[list[int]] = []
    for k, unit in enumerate(units):
        for group in groups:
            alike = all(max(sizes[k], sizes[j]) <= _SCALE_RATIO * min(sizes[k], sizes[j]) for j in group)
            if units[group[0]] == unit and alike and len(group) < _LINES_PER_PANEL:
                group.append(k)
                break
        else:
            groups.append([k])
    return [
        Panel(
            tuple(g),
            tuple(names[k] for k in g),
            units[g[0]],
            tuple(tuple(levels[k]) for k in g),
            held,
            tuple(tuple(limits[k]) for k in g) if limits else (),
        )
        for g in groups
    ]


def _places(figure: Figure, states: int, inputs: int) -> list[SubplotSpec]:
    """The cells: states in rows of at most three, all inputs in one taller row below."""
    across = min(states, 3 if states % 2 or states > 4 else 2)
    down = math.ceil(states / max(across, 1))
    outer = figure.add_gridspec(2 if down else 1, 1, height_ratios=[down, 1.15] if down else [1])
    cells: list[SubplotSpec] = []
    if down:
        columns = math.lcm(across, states - across * (down - 1))
        upper = outer[0].subgridspec(down, columns)
        for k in range(states):
            row, column = divmod(k, across)
            width = columns // (across if row < down - 1 else states - across * (down - 1))
            cells.append(upper[row, column * width : (column + 1) * width])
    lower = outer[-1].subgridspec(1, max(inputs, 1))
    return [*cells, *(lower[0, k] for k in range(inputs))]


def _draw(axes: Axes, panel: Panel, continuous: tuple[Array, Array], sampled: tuple[Array, Array]) -> None:
    """One panel: for each signal a pale band, a line on it, and its levels."""
    style = "steps-post" if panel.held else "default"
    shared = len(set(panel.levels)) == 1
    for name, column, levels, colour in zip(panel.names, panel.columns, panel.levels, COLOURS, strict=False):
        axes.plot(continuous[0], continuous[1][:, column], color=colour, alpha=0.3, linewidth=5.0)
        axes.plot(sampled[0], sampled[1][:, column], color=colour, linewidth=1.4, drawstyle=style, label=_plain(name))
        for level in () if shared and name != panel.names[0] else levels:
            axes.axhline(
                level,
                color=_LEVEL_COLOUR if shared else colour,
                linewidth=1.1,
                linestyle="--" if panel.held else "-.",
                zorder=1,
            )
    _draw_limits(axes, panel)
    axes.margins(x=0, y=0.08)
    label = f"{', '.join(panel.names)} [{panel.unit}]" if panel.unit else ", ".join(panel.names)
    axes.set_ylabel(_plain(textwrap.fill(label, _LABEL_WIDTH)))
    if len(panel.names) > 1:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), borderaxespad=0.0, ncols=len(panel.names))


def _draw_limits(axes: Axes, panel: Panel) -> None:
    """What the actuators can do, dotted; limits far beyond the law's interval would flatten the curves."""
    inside = [v for levels in panel.levels for v in levels] or [0.0]
    room = _FAR * (max(inside) - min(inside))
    near = {v for limits in panel.limits for v in limits if min(inside) - room <= v <= max(inside) + room}
    for limit in sorted(near):
        axes.axhline(limit, color=_LIMIT_COLOUR, linewidth=1.8, linestyle=":", zorder=2)


def _explain(figure: Figure) -> None:
    """The legend of line styles, below the panels."""
    dark = "#404040"
    handles = [
        Line2D([], [], color=dark, alpha=0.3, linewidth=5.0, label="continuous law"),
        Line2D([], [], color=dark, linewidth=1.4, label="sampled controller"),
        Line2D([], [], color=_LEVEL_COLOUR, linewidth=1.1, linestyle="-.", label="target"),
        Line2D([], [], color=_LEVEL_COLOUR, linewidth=1.1, linestyle="--", label="the input is always within"),
    ]
    if any(line.get_linestyle() == ":" for axes in figure.axes for line in axes.lines):
        handles.append(Line2D([], [], color=_LIMIT_COLOUR, linewidth=1.8, linestyle=":", label="limit of the actuator"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def _time_unit(duration: float) -> tuple[str, float]:
    """The unit for a time axis of this many seconds, and how many of it make a second."""
    if duration >= 0.5:
        return "s", 1.0
    return ("ms", 1e3) if duration >= 5e-4 else ("µs", 1e6)


def _plain(text: str) -> str:
    """The text with Matplotlib's formula sign taken literally."""
    return text.replace("$", r"\$")
