"""Where a command writes: its result to standard output, errors and progress to standard error."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbcgen.models.exact import plain

if TYPE_CHECKING:
    from rich.console import Console

    from pbcgen.cli.outcome import Outcome
    from pbcgen.errors import Place

#: Text is set no wider than this, for the sake of its readers.
WIDEST = 100

_PROGRESS_AFTER = 1.0


def accept_any_text() -> None:
    """Print a question mark for a character that the terminal's encoding lacks, rather than fail."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def deliver(outcome: Outcome) -> None:
    """Print a result. A reader that closes the pipe early has read enough."""
    try:
        if outcome.document is None:
            print(_rendered(outcome), end="")
        else:
            print_document(outcome.document)
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _rendered(outcome: Outcome) -> str:
    """The text for people, without the blanks that fill up the rows of its tables."""
    target = console()
    with target.capture() as captured:
        outcome.show(target)
    return re.sub(r" +$", "", captured.get(), flags=re.MULTILINE)


def print_document(document: Mapping[str, Any]) -> None:
    """Print one JSON document to standard output."""
    print(json.dumps(plain(document), indent=2, allow_nan=False))


def print_error(message: str, place: Place | None = None) -> None:
    """Print the message of an error to standard error, and below it the line of the user's file that it is about."""
    target = console(stderr=True)
    target.print("Error:", style="bold red", end=" ")
    target.print(_folded(message, target.width) if target.is_terminal else message, soft_wrap=True)
    if place is not None and place.text:
        target.print(f"{place.line:>6} | ", style="dim", end="")
        target.print(place.text, style="cyan", soft_wrap=True)


def _folded(message: str, width: int) -> str:
    """The lines of a message no wider than the terminal, what follows in a line further in than its start."""
    wrap = textwrap.TextWrapper(width, break_long_words=False, break_on_hyphens=False)
    folded = []
    for k, line in enumerate(message.splitlines()):
        indent = line[: len(line) - len(line.lstrip())] if k else " " * len("Error: ")
        wrap.initial_indent, wrap.subsequent_indent = indent, indent + "  " if k else "  "
        folded.append(wrap.fill(line.strip()) if k else wrap.fill(line.strip()).lstrip())
    return "\n".join(folded)


def console(*, stderr: bool = False) -> Console:
    """A console that takes text as it is: no markup, no highlighting, no escape sequences in a pipe."""
    from rich.console import Console

    made = Console(stderr=stderr, markup=False, highlight=False, emoji=False)
    made.width = min(made.width, WIDEST)
    return made


def indented(target: Console, text: str) -> None:
    """Print text two columns in, on as many lines as it takes."""
    from rich.padding import Padding

    target.print(Padding(text, (0, 0, 0, 2)), highlight=False)


def name_files(target: Console, **files: Path | None) -> None:
    """Say where the files are that were written, each behind what it holds."""
    for what, path in files.items():
        if path is not None:
            target.print(f"{what}: {path}", soft_wrap=True)


@contextlib.contextmanager
def progress(stage: str) -> Iterator[Callable[[str], None]]:
    """A spinner with the name of the stage, on a terminal and after the first second.

    Yields a function that changes the name.
    """
    target = console(stderr=True)
    if not target.is_terminal:
        yield lambda stage: None
        return
    status = target.status(f"{stage} ...")
    delay = threading.Timer(_PROGRESS_AFTER, status.start)
    delay.daemon = True
    delay.start()
    try:
        yield lambda stage: status.update(f"{stage} ...")
    finally:
        delay.cancel()
        delay.join()
        status.stop()
