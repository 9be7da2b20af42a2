"""``pbcgen doctor``: what this machine offers."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress

if TYPE_CHECKING:
    from collections.abc import Sequence

    import typer
    from rich.console import Console

    from pbcgen.run.doctor import Check


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("doctor")
    def command(json: options.Json = False) -> Outcome:
        """List compilers, optional extras and versions."""
        return run(json=json)


def run(*, json: bool = False) -> Outcome:
    """Look at the machine. Exit code 1 when something is missing that everything needs."""
    import pbcgen
    from pbcgen.run.doctor import diagnose

    with progress("look for compilers"):
        checks = diagnose()
    document = {"pbcgen": pbcgen.__version__, "checks": [asdict(check) for check in checks]}
    return Outcome(
        show=lambda console: _show(console, checks),
        document=document if json else None,
        exit_code=1 if any(check.required and not check.found for check in checks) else 0,
    )


def _show(console: Console, checks: Sequence[Check]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for header in ("", "", "version, or what to do", "for"):
        table.add_column(header)
    for check in checks:
        table.add_row(Text(*_verdict(check)), check.name, check.detail, check.needed_for)
    console.print(table)
    console.print()
    missing = [check.name for check in checks if check.required and not check.found]
    compiler = any(check.found for check in checks if check.name in {"C compiler", "zig"})
    if missing:
        console.print(f"pbcgen cannot work without {', '.join(missing)}.", style="bold red")
    elif compiler:
        console.print("Everything is there to check, generate and validate.", style="bold")
    else:
        console.print("Checking and generating work; to validate, pip install ziglang.", style="bold yellow")


def _verdict(check: Check) -> tuple[str, str]:
    """A word and its style."""
    if check.found:
        return "found", "green"
    return ("MISSING", "bold red") if check.required else ("absent", "yellow")
