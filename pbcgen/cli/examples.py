"""``pbcgen examples``: list, print or copy the built-in models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pbcgen.cli.new import write_new
from pbcgen.cli.outcome import Outcome
from pbcgen.errors import EmitError

if TYPE_CHECKING:
    from rich.console import Console


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("examples")
    def command(
        name: Annotated[str | None, typer.Argument(help="Print this model, or copy only it.")] = None,
        copy: Annotated[
            Path | None,
            typer.Option("--copy", metavar="DIR", help="Copy into this directory, which is made if needed."),
        ] = None,
    ) -> Outcome:
        """List the built-in models, print one, or copy them."""
        return run(name, copy)


def run(name: str | None, directory: Path | None) -> Outcome:
    """List, print or copy.

    Raises:
        ModelError: there is no such model.
        EmitError: a file exists already in the directory, or cannot be written; then nothing was copied.
    """
    from pbcgen import examples

    sources = [examples.path(each) for each in ([name] if name is not None else examples.names())]
    if directory is not None:
        return _copied(sources, directory)
    if name is not None:
        text = sources[0].read_text(encoding="utf-8")
        return Outcome(lambda console: console.print(text, end="", soft_wrap=True))
    return _listed([(each, examples.description(each)) for each in examples.names()])


def _listed(described: Sequence[tuple[str, str]]) -> Outcome:
    def show(console: Console) -> None:
        from rich.table import Table

        table = Table.grid(padding=(0, 2))
        for row in described:
            table.add_row(*row)
        console.print(table)
        console.print("\nNext: pbcgen check rlc, or pbcgen examples rlc --copy . to change one")

    return Outcome(show)


def _copied(sources: Sequence[Path], directory: Path) -> Outcome:
    targets = [directory / source.name for source in sources]
    for target in targets:
        if target.exists():
            raise EmitError(f"{target} exists already, nothing was copied: choose another directory")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EmitError(f"the directory {directory} cannot be made: {error.strerror}") from error
    for source, target in zip(sources, targets, strict=True):
        write_new(target, source.read_text(encoding="utf-8"))

    def show(console: Console) -> None:
        for target in targets:
            console.print(f"copied {target}", soft_wrap=True)
        console.print(f"Next: pbcgen check {targets[0]}", soft_wrap=True)

    return Outcome(show)
