"""The command line: one file per command, each with `register` (its options) and `run` (what it does).

    options    the arguments that several commands share
    outcome    what a command ends with: an exit code, and a result for people or for programs
    terminal   consoles, the JSON document, progress
    verdicts   the verdict table

Exit codes: 0 done, 1 usage or bad model, 2 a claim failed, 3 the generated code did not compile or validate.
"""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated

import typer

import pbcgen
from pbcgen.cli import (
    check,
    doctor,
    examples,
    generate,
    new,
    region,
    report,
    robust,
    simulate,
    terminal,
    tune,
    validate,
    verify,
)
from pbcgen.cli.outcome import Outcome
from pbcgen.errors import PbcgenError

#: Set to 1, it adds the traceback to the message about an unexpected error.
DEBUG_VARIABLE = "PBCGEN_DEBUG"

_COMMANDS = (new, examples, check, tune, generate, validate, simulate, robust, region, report, verify, doctor)


def main() -> None:
    """Entry point of ``pbcgen`` and ``python -m pbcgen``: run the command line and end the process."""
    terminal.accept_any_text()
    sys.exit(execute(sys.argv[1:]))


def execute(arguments: Sequence[str]) -> int:
    """Run one command line and print its result or its error; returns the exit code."""
    as_json = "--json" in arguments
    # What models and libraries print must not mix with the document.
    aside = contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext()
    try:
        with aside:
            result = application()(args=list(arguments), prog_name="pbcgen", standalone_mode=False)
    except Exception as error:
        message, code = _explanation(error)
        terminal.print_error(message, error.place if isinstance(error, PbcgenError) else None)
        if as_json:
            terminal.print_document({"error": message, "exit_code": code})
        return code
    if isinstance(result, Outcome):
        terminal.deliver(result)
        return result.exit_code
    return int(result or 0)


def application() -> typer.Typer:
    """The command line with all commands."""
    app = typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": terminal.WIDEST},
    )
    app.callback(invoke_without_command=True)(_root)
    for command in _COMMANDS:
        command.register(app)
    return app


def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    """From a CasADi model of a physical system to a proved, saturated passivity-based controller in C.

    MODEL is a Python file, file.py:design, or a built-in name (`pbcgen examples`). Start with
    `pbcgen new NAME` or `pbcgen check rlc`.
    """
    if version:
        print(f"pbcgen {pbcgen.__version__}")
        raise typer.Exit()
    if context.invoked_subcommand is None:
        print(context.get_help())


def _explanation(error: Exception) -> tuple[str, int]:
    """The message for the user and the exit code."""
    if isinstance(error, PbcgenError):
        return str(error), error.exit_code
    if isinstance(error, typer.TyperException):
        return f"{error.format_message()}{_where_help_is(error)}", 1
    if isinstance(error, typer.Abort):
        return "stopped", 1
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"`{error.filename}` cannot be read or written: {error.strerror}", 1
    return _defect(error), 1


def _where_help_is(error: typer.TyperException) -> str:
    context = getattr(error, "ctx", None)
    return f" Try `{context.command_path} --help`." if context is not None else ""


def _defect(error: Exception) -> str:
    """The message for an error that pbcgen did not expect."""
    kind = f"{type(error).__name__}: {error}".strip().removesuffix(":")
    message = f"this is a defect in pbcgen, not in your model: {kind}"
    if os.environ.get(DEBUG_VARIABLE) == "1":
        return f"{message}\n{''.join(traceback.format_exception(error)).rstrip()}"
    return f"{message}\nPlease report it with the model and what `{DEBUG_VARIABLE}=1 pbcgen ...` prints."
