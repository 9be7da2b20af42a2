"""``pbcgen validate``: the compiled C against the Python step, the continuous law and its limits."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import TYPE_CHECKING

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress
from pbcgen.errors import ToolchainError

if TYPE_CHECKING:
    import typer
    from rich.console import Console

    from pbcgen.run.validate import Agreement, Convergence, Validation


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("validate")
    def command(
        model: options.Model,
        precision: options.PrecisionOption = None,
        sample_period: options.SamplePeriod = None,
        allow: options.Allow = None,
        json: options.Json = False,
    ) -> Outcome:
        """Compare the compiled C with the model."""
        return run(model, options.Settings(precision, sample_period, options.claims(allow)), json=json)


def run(model: str, settings: options.Settings, *, json: bool = False) -> Outcome:
    """Validate the C of a model. Exit code 3 when a test fails.

    Raises:
        ModelError: the model or an option is not right.
        NotProved: a claim that code depends on is neither PROVED nor allowed.
        ToolchainError: there is no compiler, or the C does not compile.
    """
    from pbcgen import pipeline

    with progress("load") as tell:
        validation = pipeline.validate(settings.design(model), allow=settings.allow, progress=tell)
    return Outcome(
        show=lambda console: _show(console, validation, f"{shlex.quote(model)}{settings.as_options()}"),
        document=validation.as_json() if json else None,
        exit_code=0 if validation.passed else ToolchainError.exit_code,
    )


def _show(console: Console, validation: Validation, model: str) -> None:
    from rich.table import Table
    from rich.text import Text

    title = f"{validation.design}: {validation.precision}, h = {float(validation.sample_period):g} s"
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0))
    for header in ("test", "", "figures"):
        table.add_column(header)
    for test, passed, figures in _rows(validation):
        table.add_row(test, Text("passed" if passed else "FAILED", "green" if passed else "bold red"), figures)
    console.print(table)
    console.print()
    if validation.passed:
        console.print("The C computes what the Python step computes, and follows the continuous law.", style="bold")
        console.print(f"Next: pbcgen simulate {model} --plot loop.png", soft_wrap=True)
    else:
        console.print("The C did not validate: do not use it.", style="bold red")
        console.print(f"Next: pbcgen validate {model} --json shows all figures, the worst sample among them")


def _rows(validation: Validation) -> Iterator[tuple[str, bool, str]]:
    yield "C against Python", validation.agreement.passed, _agreement(validation.agreement)
    yield "sampled against continuous", validation.convergence.passed, _convergence(validation.convergence)
    for output in validation.outputs:
        low, high = (float(bound) for bound in output.interval)
        figures = f"{output.smallest:.6g} to {output.largest:.6g} in [{low:.6g}, {high:.6g}]"
        yield f"limits of {output.name}", output.passed, f"{figures}, {output.samples} values"


def _agreement(agreement: Agreement) -> str:
    lines = [
        f"closed loop, {agreement.trajectory_samples} steps: "
        f"u {agreement.trajectory_u_ulp:.1f} ulp, state {agreement.trajectory_xi_ulp:.1f} ulp",
        f"random and special, {agreement.samples} steps: u {agreement.u_ulp:.3g} ulp, state {agreement.xi_ulp:.3g} ulp",
        f"at most {agreement.share:.0%} of the error that rounding explains",
    ]
    if agreement.status_mismatches:
        lines.append(f"{agreement.status_mismatches} steps return another status")
    return "\n".join(lines)


def _convergence(convergence: Convergence) -> str:
    errors = ", ".join(f"{error:.2e}" for error in convergence.errors)
    return f"error at h, h/2, h/4: {errors}\n{convergence.note}"
