"""``pbcgen report``: one page that holds model, derivation, verdicts, plots and the C interface."""

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

    from pbcgen.pipeline import Report


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("report")
    def command(
        model: options.Model,
        output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="The page, an .html file.")],
        before: Annotated[
            str | None,
            typer.Option("--before", metavar="MODEL", help="Compare with this earlier design.", show_default=False),
        ] = None,
        precision: options.PrecisionOption = None,
        sample_period: options.SamplePeriod = None,
        allow: options.Allow = None,
        json: options.Json = False,
    ) -> Outcome:
        """Write one self-contained page: derivation, verdicts, plots, the C interface."""
        settings = options.Settings(precision, sample_period, options.claims(allow))
        return run(model, output, settings, before=before, json=json)


def run(
    model: str, output: Path, settings: options.Settings, *, before: str | None = None, json: bool = False
) -> Outcome:
    """Write the page, also of a design that is not proved: then it says why there is no code.

    Raises ModelError for a model or an option that is not right, and for a file that cannot be written.
    """
    from pbcgen import pipeline
    from pbcgen.models.loader import load
    from pbcgen.report.page import page, verdict

    _check(output)
    with progress("load") as tell:
        report = pipeline.check(settings.design(model), progress=tell)
        earlier = None if before is None else pipeline.check(load(before), progress=tell)
        generated = None
        if report.control is not None and not report.blocking(settings.allow):
            generated = pipeline.package(report, allow=settings.allow)
        text = page(report, generated, before=earlier, progress=tell)
        _write(output, text)
    size = len(text.encode())

    def show(console: Console) -> None:
        console.print(verdict(report), style="bold")
        console.print(f"Wrote {output}, {size / 1000:.0f} kB; it needs no network.", soft_wrap=True)
        if generated is None:
            console.print("There is no C package in it: the claims that code needs are not all proved.")
        console.print(f"Next: open {output} in a browser, or print it to PDF from there", style="bold", soft_wrap=True)

    return Outcome(show, _document(report, output, size) if json else None)


def _document(report: Report, output: Path, size: int) -> dict[str, Any]:
    return {"page": str(output), "bytes": size, "check": report.as_json()}


def _check(output: Path) -> None:
    """Raise ModelError for a page that could not be written, before the work rather than after it."""
    if output.suffix.lower() not in {".html", ".htm"}:
        raise ModelError(f"`{output}` does not end in .html: a page is an HTML file")
    if not output.parent.is_dir():
        raise ModelError(f"`{output}` cannot be written: there is no directory `{output.parent}`")


def _write(output: Path, text: str) -> None:
    try:
        output.write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise ModelError(f"`{output}` cannot be written: {error.strerror}") from error
