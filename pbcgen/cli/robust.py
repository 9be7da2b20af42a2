"""``pbcgen robust``: thousands of closed loops with what the proof leaves out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import console as make_console
from pbcgen.cli.terminal import indented, name_files, progress
from pbcgen.errors import ModelError

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from rich.console import Console

    from pbcgen.run.robust import Disturbances, Robustness


ExecutorName = Literal["here", "local", "dask"]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("robust")
    def command(
        model: options.Model,
        runs: Annotated[int, typer.Option(help="How many closed loops.")] = 1000,
        seed: Annotated[int, typer.Option(help="Of all runs.")] = 0,
        spread: Annotated[float, typer.Option(help="Parameters are uniform within this share.")] = 0.1,
        spread_of: Annotated[
            list[str] | None, typer.Option(metavar="NAME=SHARE", help="The same for one parameter.", show_default=False)
        ] = None,
        initial: Annotated[float, typer.Option(help="Initial states are uniform within this share.")] = 0.0,
        noise: Annotated[
            list[str] | None, typer.Option(metavar="SENSOR=STD", help="Sensor noise.", show_default=False)
        ] = None,
        quantum: Annotated[
            list[str] | None, typer.Option(metavar="SENSOR=Q", help="Sensor resolution.", show_default=False)
        ] = None,
        friction: Annotated[
            list[str] | None,
            typer.Option(metavar="STATE=C", help="Coulomb friction on a momentum.", show_default=False),
        ] = None,
        stiction: Annotated[
            list[str] | None, typer.Option(metavar="STATE=C", help="Breakaway friction.", show_default=False)
        ] = None,
        stribeck: Annotated[float, typer.Option(help="Speed over which breakaway friction falls.")] = 0.0,
        dead_zone: Annotated[
            list[str] | None, typer.Option(metavar="INPUT=D", help="Dead zone of an actuator.", show_default=False)
        ] = None,
        delay: Annotated[
            float | None, typer.Option(help="Of the input, in samples, in place of the design's.", show_default=False)
        ] = None,
        share: Annotated[float, typer.Option(help="Noise, friction, dead zones and delay vary by this share.")] = 0.0,
        tolerance: Annotated[float, typer.Option(help="A run converges if it ends within this share.")] = 0.05,
        duration: Annotated[
            float | None, typer.Option(metavar="T", help="Of a run, seconds.", show_default=False)
        ] = None,
        executor: Annotated[ExecutorName, typer.Option(help="Where: this process, local processes, Dask.")] = "local",
        workers: Annotated[int | None, typer.Option(help="Local processes.", show_default=False)] = None,
        cluster: Annotated[
            str | None, typer.Option(metavar="ADDRESS", help="Of a Dask scheduler.", show_default=False)
        ] = None,
        output: Annotated[
            Path | None,
            typer.Option("-o", "--output", metavar="FILE", help="Keep results (.npz) and resume.", show_default=False),
        ] = None,
        plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the runs.", show_default=False)] = None,
        allow: options.Allow = None,
        json: options.Json = False,
    ) -> Outcome:
        """Run the generated C against uncertain, noisy, sticky plants."""
        from pbcgen.run.robust import Disturbances

        given = Disturbances(
            spread=spread,
            spreads=_values(spread_of, "--spread-of"),
            initial=initial,
            noise=_values(noise, "--noise"),
            quantum=_values(quantum, "--quantum"),
            friction=_values(friction, "--friction"),
            stiction=_values(stiction, "--stiction"),
            stribeck=stribeck,
            dead_zone=_values(dead_zone, "--dead-zone"),
            delay=delay,
            share=share,
        )
        return run(
            model,
            options.Settings(allow=options.claims(allow)),
            given,
            _executor(executor, workers, cluster),
            runs=runs,
            seed=seed,
            tolerance=tolerance,
            duration=duration,
            output=output,
            plot=plot,
            json=json,
        )


def _values(given: Sequence[str] | None, option: str) -> dict[str, float]:
    """``NAME=VALUE`` several times. Raises ModelError for anything else."""
    result = {}
    for text in given or ():
        name, separator, value = text.partition("=")
        try:
            result[name] = float(value)
        except ValueError:
            separator = ""
        if not separator:
            raise ModelError(f"`{option} {text}` is not understood: NAME=NUMBER was expected")
    return result


@contextlib.contextmanager
def _executor(name: ExecutorName, workers: int | None, cluster: str | None) -> Iterator[Executor | None]:
    """What runs the loops, while it is open; None for this process."""
    from pbcgen.run.robust import dask_executor, local_executor

    if name == "here":
        yield None
    elif name == "local":
        with local_executor(workers) as executor:
            yield executor
    else:
        executor, close = dask_executor(cluster)
        try:
            yield executor
        finally:
            close()


def run(
    model: str,
    settings: options.Settings,
    given: Disturbances,
    opened: AbstractContextManager[Executor | None],
    *,
    runs: int,
    seed: int = 0,
    tolerance: float = 0.05,
    duration: float | None = None,
    output: Path | None = None,
    plot: Path | None = None,
    json: bool = False,
) -> Outcome:
    """Run closed loops with what ``given`` adds to them, on the executor that is open inside ``opened``.

    Raises:
        ModelError: the model or an option is not right.
        NotProved: a claim that code depends on is neither PROVED nor allowed.
        ToolchainError: the C does not compile.
    """
    from pbcgen import pipeline
    from pbcgen.cli.verdicts import too_short
    from pbcgen.report.comparison import plot_robustness
    from pbcgen.report.plots import save
    from pbcgen.run.robust import loops_of, robust

    options.check_picture(plot)
    if output is not None and output.suffix != ".npz":
        raise ModelError(f"`{output}` does not end in .npz: results are kept in this form")
    with progress("load") as tell:
        design = settings.design(model)
        report = pipeline.check(design, progress=tell)
        package = pipeline.package(report, allow=settings.allow)
        assert report.loop is not None
        tell("compile the plant")
        loops = loops_of(design, report.loop, package, given, seed=seed, duration=duration)
    names = [condition.name for condition in design.target.conditions]
    with opened as executor, _bar(runs) as count:
        found = robust(
            loops, runs, executor=executor, tolerance=tolerance, target_names=names, output=output, progress=count
        )
    if plot is not None:
        save(plot_robustness(design, report.loop, found), plot)
    name = design.name or "controller"
    worst = _worst_case(found, design)
    remarks = too_short(report, loops.steps * loops.h) if found.share < 1 else []

    def show(console: Console) -> None:
        _show(console, name, found, worst)
        for remark in remarks:
            console.print(remark)
        name_files(console, Results=output, Picture=plot)

    return Outcome(show, _document(name, found, worst) if json else None)


@contextlib.contextmanager
def _bar(total: int) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on a terminal; nothing in a pipe."""
    target = make_console(stderr=True)
    if not target.is_terminal:
        yield lambda done, of: None
        return
    from rich.progress import Progress

    with Progress(console=target, transient=True) as bar:
        task = bar.add_task("closed loops", total=total)
        yield lambda done, of: bar.update(task, completed=done)


def _worst_case(found: Robustness, design: Any) -> dict[str, Any]:
    """What the worst run was given: parameters, and initial state."""
    case, _ = found.loops.case(found.worst)
    n, names = found.loops.n, tuple(design.system.parameters)
    return {
        "run": found.worst,
        "final_relative": float(found.relative[found.worst]),
        "settling": float(found.settling[found.worst]),
        "parameters": dict(zip(names, case[n : n + len(names)].tolist(), strict=True)),
        "initial": dict(zip(design.system.state_names, case[:n].tolist(), strict=True)),
    }


def _document(name: str, found: Robustness, worst: dict[str, Any]) -> dict[str, Any]:
    return {
        "design": name,
        "runs": len(found.outcomes),
        "seed": found.loops.seed,
        "converged": found.share,
        "tolerance": found.tolerance,
        "substeps": found.loops.substeps,
        "settling": {"median": median(found.settling.tolist()), "worst": float(found.settling.max())},
        "overshoot": {"median": median(found.overshoot.tolist()), "worst": float(found.overshoot.max())},
        "final": {
            target: {"mean": float(abs(found.final[:, k]).mean()), "worst": float(abs(found.final[:, k]).max())}
            for k, target in enumerate(found.target_names)
        },
        "worst": worst,
    }


def _settling(found: Robustness) -> str:
    """The settling times of the runs that settle, and how many do not."""
    settled = [float(t) for t in found.settling if t < float("inf")]
    late = len(found.settling) - len(settled)
    if not settled:
        return "settling time: no run settles within 2 % of the initial error"
    open_runs = f"; {late} runs do not settle" if late else ""
    return f"settling time (2 %): median {median(settled):.4g} s, worst {max(settled):.4g} s{open_runs}"


def _show(console: Console, name: str, found: Robustness, worst: dict[str, Any]) -> None:
    console.print(f"{name}: {100 * found.share:.4g} % of {len(found.outcomes)} runs converge", style="bold")
    console.print(f"(within {100 * found.tolerance:g} % of the initial error; seed {found.loops.seed})\n")
    for k, target in enumerate(found.target_names):
        errors = abs(found.final[:, k])
        console.print(f"final error of {target}: mean {errors.mean():.4g}, worst {errors.max():.4g}")
    console.print(_settling(found))
    console.print(
        f"worst run: number {worst['run']}, ends at {100 * worst['final_relative']:.4g} % of the initial error"
    )
    if worst["parameters"]:
        values = ", ".join(f"{name} = {value:.4g}" for name, value in worst["parameters"].items())
        indented(console, f"with {values}")
