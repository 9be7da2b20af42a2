"""``pbcgen region``: from which states the closed loop certainly settles at x*."""

from __future__ import annotations

from math import isinf
from typing import TYPE_CHECKING, Annotated

import typer

from pbcgen.cli import options
from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress
from pbcgen.errors import NotProved

if TYPE_CHECKING:
    from rich.console import Console

    from pbcgen.control.attraction import Region
    from pbcgen.control.ellipsoid import Ellipsoid


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("region")
    def command(
        model: options.Model,
        boxes: Annotated[int, typer.Option(help="How many boxes of states to look at.", min=1)] = 20_000,
        json: options.Json = False,
    ) -> Outcome:
        """Certify from which states the loop settles. A level set of the Lyapunov function, else an ellipsoid."""
        return run(model, boxes=boxes, json=json)


def run(model: str, *, boxes: int = 20_000, json: bool = False) -> Outcome:
    """Find a region for a model. Exit code 2 when none was certified.

    Raises ModelError for a model that is not right, or without a closed loop.
    """
    from pbcgen import pipeline
    from pbcgen.models.loader import load
    from pbcgen.proof.claim import Status

    with progress("load") as tell:
        report = pipeline.check(load(model), progress=tell)
        tell("region of attraction")
        found = pipeline.region(report, boxes, tell)
        ellipsoid = None
        if found.status is not Status.PROVED:
            from pbcgen.control.ellipsoid import certified_ellipsoid

            tell("ellipsoid of the linearised loop")
            ellipsoid = certified_ellipsoid(report.derivation)
    starts = report.loop is not None and found.contains(list(report.loop.initial), at_zero=True)
    document = {
        "design": report.design.name,
        "region_of_attraction": found.as_json(),
        "ellipsoid": None if ellipsoid is None else ellipsoid.as_json(),
    }
    proved = found.status is Status.PROVED or ellipsoid is not None
    return Outcome(
        show=lambda console: _show(console, str(report.design.name), found, ellipsoid, starts),
        document=document if json else None,
        exit_code=0 if proved else NotProved.exit_code,
    )


def _show(console: Console, name: str, found: Region, ellipsoid: Ellipsoid | None, starts: bool) -> None:
    if ellipsoid is not None:
        console.print(f"{name}: region of attraction PROVED")
        console.print(ellipsoid.sentence, highlight=False)
        console.print(f"No level set of the storage: {found.evidence}.", highlight=False)
        return
    console.print(f"{name}: region of attraction {found.status}")
    console.print(found.evidence, highlight=False)
    if found.box:
        console.print()
        for state, (lo, hi) in found.box.items():
            console.print(f"  {state} in [{lo:.6g}, {hi:.6g}]", highlight=False)
        console.print()
        within = "" if isinf(found.level) else " whose height V - V(x*), the filters counted, is within the level"
        settles = f"From every state of this box{within}, the law in continuous time settles at x*."
        console.print(settles, highlight=False)
        where = "inside" if starts else "not inside; it may settle all the same"
        console.print(f"The initial state of the design, with the filters at zero, is {where}.", highlight=False)
