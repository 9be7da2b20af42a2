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
        tanh: options.TanhOption = None,
        json: options.Json = False,
    ) -> Outcome:
        """Compare the compiled C with the model."""
        return run(model, options.Settings(precision, sample_period, options.claims(allow), tanh), json=json)


def run(model: str, settings: options.Settings, *, json: bool = False) -> Outcome:
    """Validate the C of a model. Exit code 3 when a test fails.

    Raises:
        ModelError: the model or an option is not right.
        NotProved: a claim that code depends on is neither PROVED nor allowed.
        ToolchainError: there is no compiler, or the C does not compile.
    """
    from pbcgen import pipeline

    with progress("load") as tell:
        validation = pipeline.validate(settings.design(model), allow=settings.allow, tanh=settings.tanh, progress=tell)
    return Outcome(
        show=lambda console: _show(console, validation, f"{shlex.quote(model)}{settings.as_options()}"),
        document=validation.as_json() if json else None,
        exit_code=0 if validation.passed else ToolchainError.exit_code,
    )


def _show(console: Console, validation: Validation, model: str) -> None:
    from rich.table import Table
    from rich.text import Text

    period = float(validation.sample_period)
    console.print(f"{validation.design}: the C in {validation.precision}, h = {period:g} s\n", style="bold")
    table = Table.grid(padding=(0, 2, 0, 0))
    for passed, test, figures in _rows(validation):
        verdict = Text("passed" if passed else "FAILED", "green" if passed else "bold red")
        table.add_row(verdict, Text.assemble((test, "bold"), *(f"\n{line}" for line in figures)))
    console.print(table)
    console.print()
    if validation.passed:
        console.print(
            "The C computes what the Python step computes, and follows the continuous law.", style="bold green"
        )
        console.print(f"Next: pbcgen simulate {model} --plot loop.png", soft_wrap=True)
    else:
        console.print("The C did not validate: do not use it.", style="bold red")
        console.print(
            f"Next: pbcgen validate {model} --json for all figures, the worst step among them", soft_wrap=True
        )


def _rows(validation: Validation) -> Iterator[tuple[bool, str, list[str]]]:
    yield validation.agreement.passed, "C against the Python step", _agreement(validation.agreement)
    yield validation.convergence.passed, "sampled against the continuous loop", _convergence(validation.convergence)
    for output in validation.outputs:
        low, high = (float(bound) for bound in output.interval)
        figures = f"{output.smallest:.6g} to {output.largest:.6g} in [{low:.6g}, {high:.6g}], {output.samples} values"
        yield output.passed, f"{output.name} in its interval", [figures]
    if validation.settings is not None:
        found = validation.settings
        figures = f"{found.samples} set, {found.refused} of them refused; what is stored differs by {found.ulp:.3g} ulp"
        yield found.passed, "targets and gains as in Python", [figures]


def _agreement(agreement: Agreement) -> list[str]:
    lines = [
        f"closed loop, {agreement.trajectory_samples} steps: "
        f"u {agreement.trajectory_u_ulp:.3g} ulp, state {agreement.trajectory_xi_ulp:.3g} ulp",
        f"random and special inputs, {agreement.samples} steps: u {agreement.u_ulp:.3g} ulp, "
        f"state {agreement.xi_ulp:.3g} ulp",
        f"at most {agreement.share:.2g} of the difference that rounding can make"
        if agreement.share
        else "equal to the last bit",
    ]
    if agreement.status_mismatches:
        lines.append(f"{agreement.status_mismatches} steps return another status")
    return lines


def _convergence(convergence: Convergence) -> list[str]:
    errors = ", ".join(f"{error:.2e}" for error in convergence.errors)
    return [f"error at h, h/2, h/4: {errors}", convergence.note]
