"""``pbcgen report``: one page that holds model, derivation, verdicts, plots and the C interface."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress
from pbcgen.errors import ModelError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from pbcgen.emit import Package
    from pbcgen.models.design import Design
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
        law: Annotated[
            Path | None,
            typer.Option("--law", metavar="FILE", help="The law that `pbcgen tune -o FILE` wrote."),
        ] = None,
        region: Annotated[
            int,
            typer.Option("--region", metavar="BOXES", help="Look for a region of attraction.", min=0),
        ] = 0,
        target: Annotated[
            list[str] | None,
            typer.Option("--target", metavar="CPU", help="Measure a step there, as in generate.", show_default=False),
        ] = None,
        precision: options.PrecisionOption = None,
        sample_period: options.SamplePeriod = None,
        allow: options.Allow = None,
        json: options.Json = False,
    ) -> Outcome:
        """Write one page with everything. It holds derivation, verdicts, plots and the C interface."""
        settings = options.Settings(precision, sample_period, options.claims(allow))
        wishes = Wishes(before, law, region, tuple(target or ()))
        return run(model, output, settings, wishes, json=json)


@dataclass(frozen=True)
class Wishes:
    """What a page may hold beside the check.

    Attributes:
        before: an earlier design to compare with.
        law: a file with a law that takes the place of the model's; the model's own is then `before`.
        region: boxes to look at for a region of attraction; 0 for none.
        targets: processors to measure a step on.
    """

    before: str | None = None
    law: Path | None = None
    region: int = 0
    targets: tuple[str, ...] = ()


def run(
    model: str, output: Path, settings: options.Settings, wishes: Wishes | None = None, *, json: bool = False
) -> Outcome:
    """Write the page, also of a design that is not proved: then it says why there is no code.

    Raises ModelError for a model or an option that is not right, and for a file that cannot be written.
    """
    from pbcgen import pipeline
    from pbcgen.report.page import page
    from pbcgen.report.sentence import meaning

    wishes = wishes or Wishes()
    _check(output)
    with progress("load") as tell:
        design, earlier = _designs(model, settings, wishes)
        report = pipeline.check(design, progress=tell)
        before = None if earlier is None else pipeline.check(earlier, progress=tell)
        package = _package(report, settings, wishes, tell)
        found = None
        if wishes.region and report.derivation.situation is not None:
            tell("region of attraction")
            found = pipeline.region(report, wishes.region, tell)
        text = page(report, package, before=before, region=found, progress=tell)
        _write(output, text)
    size = len(text.encode())

    def show(console: Console) -> None:
        console.print(meaning(report), style="bold")
        console.print(f"Wrote {output}, {size / 1000:.0f} kB; it needs no network.", soft_wrap=True)
        if package is None:
            console.print("There is no C package in it: the claims that code needs are not all proved.")
        console.print(f"Next: open {output} in a browser, or print it to PDF from there", style="bold", soft_wrap=True)

    return Outcome(show, _document(report, output, size) if json else None)


def _designs(model: str, settings: options.Settings, wishes: Wishes) -> tuple[Design, Design | None]:
    """The design of the page, and the one that it is compared with."""
    from pbcgen.models.loader import load

    design = settings.design(model)
    earlier = None if wishes.before is None else load(wishes.before)
    if wishes.law is None:
        return design, earlier
    return design.with_(law=_law(wishes.law)), earlier or design


def _law(path: Path) -> object:
    """The `law` of a file that `pbcgen tune` wrote."""
    from pbcgen.models.loader import variables

    if not path.is_file():
        raise ModelError(f"there is no file `{path}`")
    found = variables(path)
    if "law" not in found:
        raise ModelError(f"`{path}` has no `law`: give the file that `pbcgen tune -o FILE` wrote")
    return found["law"]


def _package(report: Report, settings: options.Settings, wishes: Wishes, tell: Callable[[str], None]) -> Package | None:
    """The package that `generate` would write, or None while claims are open."""
    from pbcgen import pipeline

    if not report.writable or report.blocking(settings.allow):
        return None
    rendered = pipeline.package(report, allow=settings.allow)
    if not wishes.targets:
        return rendered
    costs = pipeline.measured(report, rendered, wishes.targets, tell)
    return pipeline.package(report, allow=settings.allow, costs=costs)


def _document(report: Report, output: Path, size: int) -> dict[str, Any]:
    return {"page": str(output), "bytes": size, "check": report.as_json()}


def _check(output: Path) -> None:
    """Raise ModelError for a page that could not be written, before the work rather than after it."""
    if output.suffix.lower() not in {".html", ".htm"}:
        raise ModelError(f"`{output}` does not end in .html: a page is an HTML file")
    options.check_place(output)


def _write(output: Path, text: str) -> None:
    try:
        output.write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise ModelError(f"`{output}` cannot be written: {error.strerror}") from error
