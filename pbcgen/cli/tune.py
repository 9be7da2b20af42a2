"""``pbcgen tune``: gains from limits, sample period and a wish."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import indented, name_files, progress
from pbcgen.errors import EmitError, NotProved

if TYPE_CHECKING:
    from rich.console import Console

    from pbcgen.models.laws import Law
    from pbcgen.tuning.trial import Response
    from pbcgen.tuning.tune import Attempt, Tuning
    from pbcgen.tuning.tuning_problem import Wish

RouteOption = Literal["lyapunov", "linearisation", "both"]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("tune")
    def command(
        model: options.Model,
        route: Annotated[
            RouteOption, typer.Option(help="Which proof the gains must have: lyapunov, linearisation or both tried.")
        ] = "both",
        settling: Annotated[
            float | None, typer.Option(metavar="T", help="Wished settling time (2 %), seconds.", show_default=False)
        ] = None,
        overshoot: Annotated[
            float | None, typer.Option(metavar="P", help="Largest overshoot: 0.05.", show_default=False)
        ] = None,
        damping: Annotated[
            float | None, typer.Option(metavar="Z", help="Least damping ratio of the modes.", show_default=False)
        ] = None,
        margin: Annotated[str, typer.Option(metavar="M", help="Stable with M times the sample period too.")] = "1.5",
        seed: Annotated[int, typer.Option(help="Of the search.")] = 0,
        effort: Annotated[int, typer.Option(help="About how many trial runs for each route.")] = 600,
        output: Annotated[
            Path | None,
            typer.Option("-o", "--output", metavar="FILE", help="Write the law as Python.", show_default=False),
        ] = None,
        plot: Annotated[
            Path | None, typer.Option(metavar="FILE", help="Draw before and after.", show_default=False)
        ] = None,
        sample_period: options.SamplePeriod = None,
        json: options.Json = False,
    ) -> Outcome:
        """Choose gains, and prove them. They come from limits, sample period and a wish."""
        from pbcgen.models.exact import positive
        from pbcgen.tuning.tuning_problem import Route, Wish

        routes: tuple[Route, ...] = ("lyapunov", "linearisation") if route == "both" else (route,)
        wish = Wish(routes, settling, overshoot, damping, positive(margin, "--margin"), seed, effort)
        settings = options.Settings(sample_period=sample_period)
        return run(model, settings, wish, output=output, plot=plot, json=json)


def run(
    model: str,
    settings: options.Settings,
    wish: Wish,
    *,
    output: Path | None = None,
    plot: Path | None = None,
    json: bool = False,
) -> Outcome:
    """Tune a model; exit code 2 when the wish is not met.

    Raises:
        ModelError: the model or an option is not right.
        NotProved: no gains were found that pass.
        EmitError: the output exists already.
    """
    from pbcgen.tuning.tune import tune

    options.check_picture(plot)
    if output is not None and output.exists():
        raise EmitError(f"`{output}` exists already: choose another file")
    with progress("load") as tell:
        design = settings.design(model)
        tuning = tune(design, wish, tell)
        if plot is not None:
            tell("draw")
            _draw(tuning, design, plot)
    if output is not None:
        output.write_text(_file(tuning), encoding="utf-8")
    return Outcome(
        lambda console: _show(console, tuning, output, plot),
        _document(tuning) if json else None,
        NotProved.exit_code if tuning.chosen.unmet else 0,
    )


def _file(tuning: Tuning) -> str:
    from pbcgen.tuning.gain_space import expression

    law = expression(tuning.design.law)
    names = sorted({word.split("(")[0].strip() for word in law.splitlines() if word.rstrip().endswith("(")})
    title = f'"""Gains found by pbcgen tune for `{tuning.design.name}`."""'
    return f"{title}\n\nfrom pbcgen import {', '.join(names)}\n\nlaw = {law}\n"


def _draw(tuning: Tuning, design: Any, path: Path) -> None:
    from pbcgen.control.derive import derive
    from pbcgen.report.comparison import plot_tuning
    from pbcgen.report.plots import save
    from pbcgen.tuning.trial import Trial

    found = derive(design)
    assert found.point is not None
    assert found.gamma is not None
    assert found.law is not None
    trial = Trial(found.plant, found.point, found.gamma, found.eta, design, found.law)
    after = tuning.design.law.resolve(design.system.m, None if found.eta is None else int(found.eta.numel()))
    save(plot_tuning(design, *(trial.run(law, tuning.duration) for law in (found.law, after))), path)


def _document(tuning: Tuning) -> dict[str, Any]:
    return {
        "design": tuning.design.name,
        "law": tuning.design.law.name,
        "route": tuning.chosen.route,
        "unmet": list(tuning.chosen.unmet),
        "gains": _gains(tuning.design.law),
        "before": _response(tuning.before),
        "attempts": [_attempt(attempt) for attempt in tuning.attempts],
        "amplitudes": [str(v) for v in tuning.amplitudes],
        "limits": [{"limit": room.limit, "room": float(room.room)} for room in tuning.limits],
    }


def _response(found: Response | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {"settling": found.settling, "overshoot": found.overshoot, "final": found.final}


def _gains(law: Law) -> dict[str, Any]:
    from pbcgen.tuning.gain_space import shown_gains

    return {
        name: [[str(v) for v in row] if isinstance(row, tuple) else str(row) for row in values]
        for name, values in shown_gains(law).items()
    }


def _attempt(attempt: Attempt) -> dict[str, Any]:
    return {
        "route": attempt.route,
        "gains": None if attempt.law is None else _gains(attempt.law),
        "unmet": list(attempt.unmet),
        "response": _response(attempt.response),
        "spectral_abscissa": attempt.abscissa,
        "spectral_radius": attempt.radius,
        "lowest_abscissa": attempt.floor,
        "active": list(attempt.active),
        "notes": list(attempt.notes),
        "claims": [c.as_json() for c in attempt.claims],
    }


def _show(console: Console, tuning: Tuning, output: Path | None, plot: Path | None) -> None:
    from pbcgen.tuning.gain_space import expression

    console.print(f"{tuning.design.name}: gains for law {tuning.design.law.name}", style="bold")
    console.print(f"before: {_figures(tuning.before)}")
    for attempt in tuning.attempts:
        mark = "chosen" if attempt is tuning.chosen else "not chosen" if attempt.law is not None else "no gains"
        console.print(f"\nroute {attempt.route} ({mark})", style="bold")
        if attempt.response is not None and attempt.abscissa is not None:
            indented(console, f"{_figures(attempt.response)}, spectral abscissa {attempt.abscissa:.4g} 1/s")
        if attempt is not tuning.chosen and attempt.law is not None and attempt.law == tuning.chosen.law:
            indented(console, "the same gains as on the route that was chosen")
            continue
        for line in attempt.active:
            indented(console, f"active: {line}")
        for line in attempt.notes:
            indented(console, line)
    console.print()
    for line in tuning.chosen.unmet:
        console.print(f"NOT MET: {line}", style="bold red", soft_wrap=True)
    console.print(f"law={expression(tuning.design.law)},", style="green")
    name_files(console, Law=output, Picture=plot)
    if tuning.chosen.unmet:
        console.print(
            "These gains are proved, but the wish is not met: wish for less, give wider limits, or try --effort"
        )
    console.print(
        "\nNext: put the law into the model file, then pbcgen check, and pbcgen robust for noise and friction",
        soft_wrap=True,
    )


def _figures(found: Response) -> str:
    settled = f"settles in {found.settling:.4g} s" if found.settling < float("inf") else "does not settle"
    left = 100 * found.final if found.final > 1e-8 else 0.0
    return f"{settled}, overshoot {100 * found.overshoot:.3g} %, final error {left:.2g} %"
