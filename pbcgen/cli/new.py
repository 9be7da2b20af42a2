"""``pbcgen new``: a commented model to start from."""

from __future__ import annotations

import keyword
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pbcgen.cli.outcome import Outcome
from pbcgen.errors import EmitError, ModelError

if TYPE_CHECKING:
    from rich.console import Console


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("new")
    def command(name: Annotated[str, typer.Argument(help="Name of the design; the file is NAME.py.")]) -> Outcome:
        """Write NAME.py, a commented model to start from."""
        return run(name)


def run(name: str) -> Outcome:
    """Write the model into the current directory.

    Raises:
        ModelError: the name cannot be that of a Python module.
        EmitError: the file exists or cannot be written.
    """
    from pbcgen.emit.templating import fill

    if not name.isidentifier() or keyword.iskeyword(name) or not name.isascii():
        raise ModelError(f"`{name}` cannot be the name of a design: use letters, digits and _, for example `my_pump`")
    path = Path(f"{name}.py")
    write_new(path, fill("model.py.j2", {"name": name}))

    def show(console: Console) -> None:
        console.print(f"{path} holds a pendulum with a motor: change it into your system.")
        console.print(f"Next: pbcgen check {path}", soft_wrap=True)

    return Outcome(show)


def write_new(path: Path, text: str) -> None:
    """Write a file that does not exist yet. Raises EmitError if it does, or cannot be written."""
    try:
        with path.open("x", encoding="utf-8", newline="\n") as stream:
            stream.write(text)
    except FileExistsError:
        raise EmitError(f"{path} exists already, nothing was written: move it away or choose another name") from None
    except OSError as error:
        raise EmitError(f"{path} cannot be written: {error.strerror}") from error
