"""``pbcgen robust``: thousands of closed loops with what the proof leaves out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import console as make_console
from pbcgen.cli.terminal import indented
from pbcgen.errors import ModelError

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from rich.console import Console

    from pbcgen.run.robust import Disturbances, Robustness

_PICTURES = (".pdf", ".png", ".svg")
_DRAWN = 60

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
            spread,
            _values(spread_of, "--spread-of"),
            initial,
            _values(noise, "--noise"),
            _values(quantum, "--quantum"),
            _values(friction, "--friction"),
            _values(stiction, "--stiction"),
            stribeck,
            _values(dead_zone, "--dead-zone"),
            delay,
            share,
        )
        where = _Where(executor, workers, cluster)
        settings = options.Settings(None, None, options.claims(allow))
        how = {"runs": runs, "seed": seed, "tolerance": tolerance, "duration": duration}
        return run(model, settings, given, how, where, output=output, plot=plot, json=json)


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


class _Where:
    """Which executor, opened as a context."""

    def __init__(self, name: ExecutorName, workers: int | None, cluster: str | None) -> None:
        self.name, self.workers, self.cluster = name, workers, cluster

    @contextlib.contextmanager
    def open(self) -> Iterator[Executor | None]:
        from pbcgen.run.robust import dask_executor, local_executor

        if self.name == "here":
            yield None
        elif self.name == "local":
            with local_executor(self.workers) as executor:
                yield executor
        else:
            executor, close = dask_executor(self.cluster)
            try:
                yield executor
            finally:
                close()


def run(
    model: str,
    settings: options.Settings,
    given: Disturbances,
    how: dict[str, Any],
    where: _Where,
    *,
    output: Path | None = None,
    plot: Path | None = None,
    json: bool = False,
) -> Outcome:
    """Run closed loops.

    Raises:
        ModelError: the model or an option is not right.
        NotProved: a claim that code depends on is neither PROVED nor allowed.
        ToolchainError: the C does not compile.
    """
    from pbcgen import pipeline
    from pbcgen.cli.verdicts import too_short
    from pbcgen.run.robust import loops_of, robust

    if plot is not None and (plot.suffix.lower() not in _PICTURES or not plot.parent.is_dir()):
        raise ModelError(f"`{plot}` cannot be drawn: a .png, .svg or .pdf in an existing directory was expected")
    if output is not None and output.suffix != ".npz":
        raise ModelError(f"`{output}` does not end in .npz: results are kept in this form")
    design = settings.design(model)
    report = pipeline.check(design)
    package = pipeline.package(report, allow=settings.allow)
    assert report.loop is not None
    loops = loops_of(design, report.loop, package, given, seed=how["seed"], duration=how["duration"])
    names = [condition.name for condition in design.target.conditions]
    with where.open() as executor, _bar(how["runs"]) as tell:
        found = robust(
            loops,
            how["runs"],
            executor=executor,
            tolerance=how["tolerance"],
            target_names=names,
            output=output,
            progress=tell,
        )
    if plot is not None:
        _draw(found, report, plot)
    name = design.name or "controller"
    worst = _worst_case(found, design)
    document = _document(name, found, worst) if json else None
    remarks = too_short(report, loops.steps * loops.h) if found.share < 1 else []
    return Outcome(lambda console: _show(console, name, found, worst, [*remarks, *_files(output, plot)]), document)


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


def _draw(found: Robustness, report: Any, path: Path) -> None:
    from pbcgen.report.comparison import plot_robustness
    from pbcgen.report.plots import save
    from pbcgen.run.trajectories import trace

    design, loop = report.design, report.loop
    wanted = [c.name for c in design.target.conditions if c.name in loop.state_names][:4] or list(loop.state_names[:3])
    columns = [1 + loop.state_names.index(name) for name in wanted]
    targets = [float(loop.x_star[c - 1]) for c in columns]
    count = len(found.outcomes)
    shown = [0, *range(1, min(count, _DRAWN)), found.worst]
    runs = [trace(found.loops, k) for k in shown]
    title = f"{design.name}: {100 * found.share:.4g} % of {count} runs converge"
    figure = plot_robustness(runs, columns, wanted, targets, found.relative, found.settling, found.tolerance, title)
    save(figure, path)


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
        "settling": {"median": _median(found.settling), "worst": float(found.settling.max())},
        "overshoot": {"median": _median(found.overshoot), "worst": float(found.overshoot.max())},
        "final": {
            target: {"mean": float(abs(found.final[:, k]).mean()), "worst": float(abs(found.final[:, k]).max())}
            for k, target in enumerate(found.target_names)
        },
        "worst": worst,
    }


def _median(values: Any) -> float:
    import numpy as np

    return float(np.median(values))


def _settling(found: Robustness) -> str:
    """The settling times of the runs that settle, and how many do not."""
    settled = [float(t) for t in found.settling if t < float("inf")]
    late = len(found.settling) - len(settled)
    if not settled:
        return "settling time: no run settles within 2 % of the initial error"
    middle = sorted(settled)[len(settled) // 2]
    open_runs = f"; {late} runs do not settle" if late else ""
    return f"settling time (2 %): median {middle:.4g} s, worst {max(settled):.4g} s{open_runs}"


def _files(output: Path | None, plot: Path | None) -> list[str]:
    return [f"{what}: {path}" for path, what in ((output, "Results"), (plot, "Picture")) if path is not None]


def _show(console: Console, name: str, found: Robustness, worst: dict[str, Any], remarks: Sequence[str]) -> None:
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
    for remark in remarks:
        console.print(remark, soft_wrap=remark.startswith(("Results", "Picture")), highlight=False)
