"""``pbcgen simulate``: the closed loop, with the continuous law and with the sampled controller."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress
from pbcgen.errors import ModelError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from pbcgen.pipeline import Simulation

_PICTURES = (".pdf", ".png", ".svg")


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("simulate")
    def command(
        model: options.Model,
        plot: Annotated[
            Path | None,
            typer.Option(metavar="FILE", help="Draw the loop: a .png, .svg or .pdf file.", show_default=False),
        ] = None,
        precision: options.PrecisionOption = None,
        sample_period: options.SamplePeriod = None,
        allow: options.Allow = None,
        json: options.Json = False,
    ) -> Outcome:
        """Simulate the closed loop, continuous and sampled."""
        settings = options.Settings(precision, sample_period, options.claims(allow))
        return run(model, settings, plot=plot, json=json)


def run(model: str, settings: options.Settings, *, plot: Path | None = None, json: bool = False) -> Outcome:
    """Simulate a model from its initial state.

    Raises:
        ModelError: the model or an option is not right, or the picture cannot be written.
        NotProved: a claim that code depends on is neither PROVED nor allowed.
        SimulationError: the trajectory does not stay finite.
    """
    from pbcgen import pipeline

    if plot is not None:
        _check_picture(plot)
    with progress("load") as tell:
        simulation = pipeline.simulate(settings.design(model), allow=settings.allow, progress=tell)
        if plot is not None:
            tell("draw")
            _draw(simulation, plot)
    return Outcome(lambda console: _show(console, simulation, plot), _document(simulation, plot) if json else None)


def _check_picture(path: Path) -> None:
    """Raise ModelError for a picture that could not be written, before the simulation rather than after it."""
    if path.suffix.lower() not in _PICTURES:
        raise ModelError(f"`{path}` does not end in {', '.join(_PICTURES)}: choose one of them")
    if not path.parent.is_dir():
        raise ModelError(f"`{path}` cannot be written: there is no directory `{path.parent}`")


def _draw(simulation: Simulation, path: Path) -> None:
    from pbcgen.report.plots import plot_closed_loop, save

    design = simulation.report.design
    title = ": ".join(text for text in (design.name, design.description) if text)
    targets = [signal["target"] for signal in _states(simulation)]
    save(plot_closed_loop(simulation.continuous, simulation.sampled, simulation.intervals, targets, title), path)


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
    """For each input the values that the sampled controller used, and its interval."""
    sampled = simulation.sampled
    return [
        {
            "name": name,
            "unit": unit,
            "smallest": float(sampled.u[:, k].min()),
            "largest": float(sampled.u[:, k].max()),
            "end": float(sampled.u[-1, k]),
            "interval": [float(bound) for bound in simulation.intervals[k]],
        }
        for k, (name, unit) in enumerate(zip(sampled.input_names, sampled.input_units, strict=True))
    ]


def _show(console: Console, simulation: Simulation, plot: Path | None) -> None:
    design, sampled = simulation.report.design, simulation.sampled
    console.print(
        f"{design.name}: {sampled.times[-1]:g} s in steps of {float(design.sample_period):g} s\n", style="bold"
    )
    console.print(_table(["state", "start", "target", "end", "end, continuous law"], _states(simulation)))
    console.print()
    console.print(_table(["input", "smallest", "largest", "end", "limits"], _inputs(simulation)))
    console.print()
    console.print(f"Picture: {plot}" if plot else "Next: add --plot loop.png for a picture", soft_wrap=True)


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


def _figure(value: float | list[float] | None) -> str:
    match value:
        case None:
            return ""
        case list():
            return f"[{', '.join(map(_figure, value))}]"
        case _:
            return f"{value:.5g}"
