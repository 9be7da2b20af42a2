"""``pbcgen check``: derive the controller and say what is proved."""

from __future__ import annotations

from typing import Annotated

import typer

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress
from pbcgen.errors import NotProved


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("check")
    def command(
        model: options.Model,
        sampled_scan: Annotated[
            bool, typer.Option("--sampled-scan", help="Prove the range of stable sample periods to its end.")
        ] = False,
        delay: Annotated[
            str | None,
            typer.Option(metavar="SAMPLES", help="In place of the design's delay: 0 to 2.", show_default=False),
        ] = None,
        jitter: Annotated[
            str | None,
            typer.Option(metavar="SHARE", help="In place of the design's jitter: 0.1.", show_default=False),
        ] = None,
        for_all_parameters: Annotated[
            bool,
            typer.Option("--for-all-parameters", help="Say too what holds for all positive values of the parameters."),
        ] = False,
        json: options.Json = False,
    ) -> Outcome:
        """Derive the controller, and say what is proved of it."""
        return run(
            model, scan=sampled_scan, delay=delay, jitter=jitter, for_all_parameters=for_all_parameters, json=json
        )


def run(
    model: str,
    *,
    scan: bool = False,
    delay: str | None = None,
    jitter: str | None = None,
    for_all_parameters: bool = False,
    json: bool = False,
) -> Outcome:
    """Check a model. Exit code 2 when a claim that code depends on is not PROVED.

    Raises ModelError for a model that is not right.
    """
    from pbcgen import pipeline
    from pbcgen.cli.verdicts import show_report
    from pbcgen.models.loader import load

    with progress("load") as tell:
        asked = {name: value for name, value in {"delay": delay, "jitter": jitter}.items() if value is not None}
        report = pipeline.check(load(model).with_(**asked), progress=tell, scan=scan)
        wide = pipeline.for_all_parameters(report) if for_all_parameters else None
    more = {} if wide is None else {"for_all_parameters": [claim.as_json() for claim in wide]}
    return Outcome(
        show=lambda console: show_report(console, report, model, wide),
        document=report.as_json() | more if json else None,
        exit_code=0 if report.emittable else NotProved.exit_code,
    )
