"""``pbcgen generate``: check, then write the C package."""

from __future__ import annotations

import json as json_format
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress
from pbcgen.proof.claim import Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from pbcgen.pipeline import Generated


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("generate")
    def command(
        model: options.Model,
        directory: Annotated[
            Path,
            typer.Option("-o", "--output", metavar="DIR", help="A new or empty directory for the package."),
        ],
        precision: options.PrecisionOption = None,
        prefix: Annotated[
            str | None, typer.Option("--prefix", metavar="NAME", help="Prefix of all C names.", show_default=False)
        ] = None,
        sample_period: options.SamplePeriod = None,
        allow: options.Allow = None,
        tanh: options.TanhOption = None,
        target: Annotated[
            list[str] | None,
            typer.Option(
                "--target",
                metavar="CPU",
                help="Measure a step on this emulated processor: cortex-m4f, cortex-m0 or rv32imafc. Repeatable.",
                show_default=False,
            ),
        ] = None,
        bumpless: Annotated[
            bool,
            typer.Option("--bumpless", help="Add <p>_start_at: a start at the first measurement without a jump."),
        ] = False,
        selftest: Annotated[
            bool, typer.Option("--selftest", help="Add <p>_selftest: a run against expected outputs.")
        ] = False,
        json: options.Json = False,
    ) -> Outcome:
        """Check the model, then write the C package."""
        settings = options.Settings(precision, sample_period, options.claims(allow), tanh)
        return run(
            model,
            directory,
            settings,
            prefix=prefix,
            targets=target or (),
            bumpless=bumpless,
            selftest=selftest,
            json=json,
        )


def run(
    model: str,
    directory: Path,
    settings: options.Settings,
    *,
    prefix: str | None = None,
    targets: Sequence[str] = (),
    bumpless: bool = False,
    selftest: bool = False,
    json: bool = False,
) -> Outcome:
    """Write the package.

    Raises:
        ToolchainError: a target is unknown, or its tools are missing.
        ModelError: the model or an option is not right.
        NotProved: a claim that code depends on is neither PROVED nor allowed.
        EmitError: the directory holds other files, or the controller cannot be written in C.
    """
    from pbcgen import pipeline
    from pbcgen.emit import Extras

    with progress("load") as tell:
        design = settings.design(model)
        generated = pipeline.generate(
            design,
            directory,
            prefix=prefix,
            allow=settings.allow,
            tanh=settings.tanh,
            targets=targets,
            extras=Extras(start=bumpless, selftest=selftest),
            progress=tell,
        )
    return Outcome(lambda console: _show(console, generated, model, settings), _document(generated) if json else None)


def _document(generated: Generated) -> dict[str, Any]:
    files = {name: len(text.encode()) for name, text in generated.package.files.items()}
    return {
        "directory": str(generated.directory),
        "prefix": generated.package.prefix,
        "files": files,
        "memory": _memory(generated),
        "figures": _manifest(generated)["figures"],
        "renamed": dict(generated.package.renamed),
        "check": generated.report.as_json(),
    }


def _memory(generated: Generated) -> dict[str, int]:
    """Sizes in bytes, as the manifest states them."""
    sizes: dict[str, int] = _manifest(generated)["memory"]
    return sizes


def _manifest(generated: Generated) -> dict[str, Any]:
    document: dict[str, Any] = json_format.loads(generated.package.files["manifest.json"])
    return document


def _show(console: Console, generated: Generated, model: str, settings: options.Settings) -> None:
    from rich.table import Table

    package = generated.package
    files = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    files.add_column(f"{generated.directory}/")
    files.add_column("bytes", justify="right")
    for name, text in package.files.items():
        files.add_row(name, f"{len(text.encode())}")
    console.print(files)
    console.print()
    memory = _memory(generated)
    console.print(
        f"Memory: state {memory['state_bytes']} bytes, input {memory['input_bytes']}, output {memory['output_bytes']}; "
        f"heap {memory['heap_bytes']}, writable static data {memory['writable_static_bytes']}."
    )
    for f in _manifest(generated)["figures"]:
        console.print(
            f"{f['target']}: {f['mean']} instructions a step, {f['worst']} at the most; "
            f"code {f['text']} bytes, stack {f['stack']}."
        )
    for python, c in package.renamed:
        console.print(f"Renamed for C: {python} is {c}.")
    for claim in generated.report.claims:
        if claim.claim in settings.allow and claim.status is not Status.PROVED:
            console.print(f"NOT PROVED, allowed by you: {claim.claim}. The header says so.", style="bold yellow")
    console.print(f"Next: pbcgen validate {shlex.quote(model)}{settings.as_options()}", style="bold", soft_wrap=True)
