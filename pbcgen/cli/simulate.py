"""``pbcgen simulate``: the closed loop, with the continuous law and with the sampled controller."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from pbcgen.pipeline import Simulation


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("simulate")
    def command(
        model: options.Model,
        plot: Annotated[
            Path | None,
            typer.Option(metavar="FILE", help="Draw the loop: a .png, .svg or .pdf file.", show_default=False),
        ] = None,
        duration: Annotated[
            float | None, typer.Option(metavar="T", help="Of the run, seconds.", show_default=False)
        ] = None,
        precision: options.PrecisionOption = None,
        sample_period: options.SamplePeriod = None,
        allow: options.Allow = None,
        json: options.Json = False,
    ) -> Outcome:
        """Simulate the closed loop, continuous and sampled."""
        settings = options.Settings(precision, sample_period, options.claims(allow))
        return run(model, settings, plot=plot, duration=duration, json=json)


def run(
    model: str,
    settings: options.Settings,
    *,
    plot: Path | None = None,
    duration: float | None = None,
    json: bool = False,
) -> Outcome:
    """Simulate a model from its initial state.

    Raises:
        ModelError: the model or an option is not right, or the picture cannot be written.
        NotProved: a claim that code depends on is neither PROVED nor allowed.
        SimulationError: the trajectory does not stay finite.
    """
    from pbcgen import pipeline

    options.check_picture(plot)
    with progress("load") as tell:
        design = settings.design(model)
        if duration is not None:
            design = design.with_(duration=duration)
        simulation = pipeline.simulate(design, allow=settings.allow, progress=tell)
        if plot is not None:
            tell("draw")
            _draw(simulation, plot)
    return Outcome(lambda console: _show(console, simulation, plot), _document(simulation, plot) if json else None)


def _draw(simulation: Simulation, path: Path) -> None:
    from pbcgen.report.plots import Bounds, plot_closed_loop, save

    design = simulation.report.design
    title = ": ".join(text for text in (design.name, design.description) if text)
    targets = [signal["target"] for signal in _states(simulation)]
    bounds = Bounds(simulation.intervals, design.input_set.intervals)
    save(plot_closed_loop(simulation.continuous, simulation.sampled, bounds, targets, title), path)


def _document(simulation: Simulation, plot: Path | None) -> dict[str, Any]:
    design, sampled = simulation.report.design, simulation.sampled
    return {
        "design": design.name,
        "law": design.law.name,
        "precision": design.precision,
        "sample_period": float(design.sample_period),
        "duration": float(sampled.times[-1]),
        "states": _states(simulation),
        "inputs": _inputs(simulation),
        "limits": _rows(simulation),
        "reached": not _late(simulation),
        "remarks": _remarks(simulation),
        "plot": None if plot is None else str(plot),
    }


def _states(simulation: Simulation) -> list[dict[str, Any]]:
    """For each plant state where it starts, shall be and ends, sampled and continuous."""
    continuous, sampled, loop = simulation.continuous, simulation.sampled, simulation.report.loop
    return [
        {
            "name": name,
            "unit": unit,
            "start": float(sampled.x[0, k]),
            "target": None if loop is None else float(loop.x_star[k]),
            "end": float(sampled.x[-1, k]),
            "end_continuous": float(continuous.x[-1, k]),
        }
        for k, (name, unit) in enumerate(zip(sampled.state_names, sampled.state_units, strict=True))
    ]


def _inputs(simulation: Simulation) -> list[dict[str, Any]]:
    """For each input the values that the sampled controller used, the law's interval and the actuator's limits."""
    sampled, limits = simulation.sampled, simulation.report.design.input_set.intervals
    return [
        {
            "name": name,
            "unit": unit,
            "smallest": float(sampled.u[:, k].min()),
            "largest": float(sampled.u[:, k].max()),
            "end": float(sampled.u[-1, k]),
            "interval": [float(bound) for bound in simulation.intervals[k]],
            "limits": [None if bound is None else float(bound) for bound in limits[k]],
        }
        for k, (name, unit) in enumerate(zip(sampled.input_names, sampled.input_units, strict=True))
    ]


def _rows(simulation: Simulation) -> list[dict[str, Any]]:
    """For each row of the actuators' polyhedron its bound and the largest value in the run."""
    from pbcgen.models.limits import row_text

    design, u = simulation.report.design, simulation.sampled.u
    return [
        {
            "limit": row_text(row, design.system.input_names),
            "largest": float(max(u @ [float(a) for a in row])),
            "bound": float(bound),
        }
        for row, bound in zip(design.input_set.A, design.input_set.b, strict=True)
    ]


#: A state that ends farther from its target than this share of its largest distance has not arrived.
_ARRIVED = 0.02


def _late(simulation: Simulation) -> list[tuple[str, float]]:
    """The states that have not arrived at the end, with what is left as a share of their largest distance."""
    from pbcgen.run.simulate import remaining

    assert simulation.report.loop is not None
    left = remaining(simulation.sampled, simulation.report.loop.x_star)
    return [(n, float(v)) for n, v in zip(simulation.sampled.state_names, left, strict=True) if v > _ARRIVED]


def _remarks(simulation: Simulation) -> list[str]:
    """What the table does not show: whether x* is reached, and how long that takes."""
    from pbcgen.cli.verdicts import too_short

    report, late = simulation.report, _late(simulation)
    lines = []
    if late:
        states = ", ".join(f"{name} by {100 * share:.2g} %" for name, share in late)
        lines.append(f"x* is not reached at the end: {states} of the largest distance.")
    lines += too_short(report, float(simulation.sampled.times[-1]), share=2 if late else 1)
    return lines or [f"x* is reached: every state ends within {100 * _ARRIVED:g} % of its largest distance."]


def _show(console: Console, simulation: Simulation, plot: Path | None) -> None:
    design, sampled = simulation.report.design, simulation.sampled
    late = f", outputs {float(design.delay):g} steps late" if design.delay else ""
    console.print(
        f"{design.name}: {sampled.times[-1]:g} s in steps of {float(design.sample_period):g} s{late}\n", style="bold"
    )
    console.print(_table(["state", "start", "target", "end", "end, continuous law"], _states(simulation)))
    console.print()
    console.print(_table(["input", "smallest", "largest", "end", "always in", "limits"], _with_rows(simulation)))
    for row in _rows(simulation):
        console.print(f"{row['limit']}: at most {row['largest']:.5g}, limit {row['bound']:.5g}", highlight=False)
    console.print()
    for line in _remarks(simulation):
        console.print(line, highlight=False)
    console.print()
    console.print(f"Picture: {plot}" if plot else "Next: add --plot loop.png for a picture", soft_wrap=True)


def _with_rows(simulation: Simulation) -> list[dict[str, Any]]:
    """The inputs; those without limits of their own that share a limit with others are sent to the rows below."""
    shared = [any(column) for column in zip(*simulation.report.design.input_set.A, strict=True)]
    inputs = _inputs(simulation)
    for signal, below in zip(inputs, shared or [False] * len(inputs), strict=True):
        if below and signal["limits"] == [None, None]:
            signal["limits"] = "see below"
    return inputs


def _table(headers: list[str], signals: list[dict[str, Any]]) -> Table:
    """One row for each signal; after its name and unit its figures."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for k, header in enumerate(headers):
        table.add_column(header, justify="right" if k else "left")
    for signal in signals:
        name, unit, *figures = signal.values()
        table.add_row(f"{name} [{unit}]" if unit else name, *map(_figure, figures))
    return table


def _figure(value: float | str | list[float | None] | None) -> str:
    match value:
        case str():
            return value
        case None:
            return ""
        case [None, None]:
            return "none"
        case [low, None]:
            return f">= {_figure(low)}"
        case [None, high]:
            return f"<= {_figure(high)}"
        case list():
            return f"[{', '.join(map(_figure, value))}]"
        case _:
            return f"{value:.5g}"
