"""``pbcgen check``: derive the controller and say what is proved."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress
from pbcgen.errors import NotProved

if TYPE_CHECKING:
    import typer


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("check")
    def command(model: options.Model, json: options.Json = False) -> Outcome:
        """Derive the controller, and say what is proved of it."""
        return run(model, json=json)


def run(model: str, *, json: bool = False) -> Outcome:
    """Check a model. Exit code 2 when a claim that code depends on is not PROVED.

    Raises ModelError for a model that is not right.
    """
    from pbcgen import pipeline
    from pbcgen.cli.verdicts import show_report
    from pbcgen.models.loader import load

    with progress("load") as tell:
        report = pipeline.check(load(model), progress=tell)
    return Outcome(
        show=lambda console: show_report(console, report, model),
        document=report.as_json() if json else None,
        exit_code=0 if report.emittable else NotProved.exit_code,
    )
