"""The report of a check on a terminal: verdicts, derived quantities, what they mean and what to do next."""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from pbcgen.models.exact import decimal
from pbcgen.models.source import deciding_line
from pbcgen.proof.claim import ELSEWHERE, Claim, Status
from pbcgen.report.sentence import meaning, not_reached

if TYPE_CHECKING:
    from rich.console import Console

    from pbcgen.errors import Place
    from pbcgen.pipeline import Report

_STYLES = {Status.PROVED: "green", Status.REFUTED: "bold red", Status.UNDECIDED: "bold yellow"}

#: Room for the longest claim; the domain stands behind it.
_CLAIM_WIDTH = 30

#: The user's line below a hint is no longer than this.
_LINE_WIDTH = 66

#: A line of x* is no longer than this, so that it stands beside its name on 80 columns.
_POINT_WIDTH = 50

#: The derived quantities that are single numbers or lists: key of the JSON document, what it is called here.
_QUANTITIES = (
    ("kappa", "kappa"),
    ("gamma", "gamma"),
    ("gamma_star", "gamma at x*"),
    ("eta", "eta"),
    ("hessian_min_eigenvalue", "least Hessian eigenvalue"),
    ("alpha_beta_min", "alpha beta must exceed"),
    ("kc_min", "K_c must exceed"),
    ("theta_bound", "bound of Theta"),
    ("spectral_abscissa", "spectral abscissa [1/s]"),
    ("max_sample_period", "largest sample period [s]"),
)


def show_report(console: Console, report: Report, model: str, wide: Sequence[Claim] | None = None) -> None:
    """Print the report; ``model`` is how the user called it, ``wide`` what holds for all positive parameters."""
    console.print(f"{report.design.name}: law {report.design.law.name}, h = {_seconds(report)}", style="bold")
    console.print()
    console.print(verdict_table(report))
    console.print()
    if any(True for _ in _derived(report)):
        console.print(derived_table(report))
        console.print()
    if wide is not None:
        _show_for_all_parameters(console, report, wide)
    console.print(meaning(report), style="bold green" if report.emittable else "bold red")
    for line in next_steps(report, shlex.quote(model)):
        console.print(line, soft_wrap=True)


def _show_for_all_parameters(console: Console, report: Report, claims: Sequence[Claim]) -> None:
    """Print what was decided for all positive values of the parameters."""
    parameters = report.design.system.parameters
    names = ", ".join(name for name in parameters.names if name not in parameters.numbers)
    console.print(f"for all positive {names}; gains and target as they are", style="bold")
    console.print()
    console.print(verdict_table(report, claims))
    console.print("This asks more than the check at the values, and lets no code out.")
    console.print()


def verdict_table(report: Report, claims: Sequence[Claim] | None = None) -> Table:
    """Rows of a verdict, the claims that have it with their domains, method and evidence, a hint, and the user's line.

    Claims that were decided alike share a row. A hint that several rows share is given once. What was not reached
    stands at the end. ``claims`` are those of the report if they are not given.
    """
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold", expand=False)
    table.add_column("verdict", no_wrap=True)
    table.add_column(f"{'claim':{_CLAIM_WIDTH}}  where it holds, and why")
    given: set[str] = {""}
    for alike in _decided_alike(report.claims if claims is None else claims):
        first = alike[0]
        hints = dict.fromkeys(c.hint for c in alike if c.status is not Status.PROVED and c.hint not in given)
        given.update(hints)
        own = any(not hint.startswith(ELSEWHERE) for hint in hints)
        place = deciding_line(first.claim, report.design.call, report.design.system.call) if own else None
        table.add_row(Text(str(first.status), _STYLES[first.status]), _description(alike, hints, place))
    return table


def _decided_alike(claims: Sequence[Claim]) -> list[list[Claim]]:
    """The claims in their order, those that were not reached last; together where method and evidence are the same."""
    rows: dict[tuple[str, ...], list[Claim]] = {}
    for claim in sorted(claims, key=not_reached):
        rows.setdefault((str(claim.status), claim.method, claim.evidence), []).append(claim)
    return list(rows.values())


def _description(claims: Sequence[Claim], hints: Iterable[str], place: Place | None) -> Text:
    first, text = claims[0], Text()
    if not_reached(first) and len(claims) > 1:
        text.append(f"{', '.join(c.claim for c in claims)}\n", "bold")
    else:
        for claim in claims:
            text.append(f"{claim.claim:{_CLAIM_WIDTH}}", "bold")
            text.append(f"  {claim.domain}\n")
    why = ": ".join(part for part in (first.method, first.evidence) if part)
    text.append(why, "dim" if first.status is Status.PROVED or not_reached(first) else None)
    for hint in hints:
        text.append(f"\nhint: {hint}", "yellow")
    if place is not None:
        text.append("\n" + textwrap.shorten(f"{place}: {place.text}", _LINE_WIDTH, placeholder=" ..."), "cyan")
    return text


def derived_table(report: Report) -> Table:
    """What was derived: the equilibrium, the functions of the law, the bounds on its gains."""
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(style="bold")
    table.add_column()
    for name, value in _derived(report):
        table.add_row(name, value)
    return table


def _derived(report: Report) -> Iterator[tuple[str, str]]:
    derived = report.derived
    x_star = derived.get("x_star") or ()
    if x_star:
        yield "x*", _named(report.design.system.state_names, x_star)
    for key, name in _QUANTITIES:
        if derived.get(key) not in (None, [], ()):
            yield name, _figure(derived[key])
    for name, interval in zip(report.design.system.input_names, derived.get("input_intervals") or (), strict=False):
        yield f"{name} is always in", f"[{_figure(interval)}]"


def _named(names: Sequence[str], values: Sequence[Any]) -> str:
    """One assignment after the other; a line ends only between two of them."""
    pairs = (f"{name} = {_figure(value)}" for name, value in zip(names, values, strict=True))
    together = ", ".join(pair.replace(" ", "\0") for pair in pairs)
    return textwrap.fill(together, _POINT_WIDTH, break_long_words=False).replace("\0", " ")


def _figure(value: Any) -> str:
    """A number in six digits, a formula as it is, a list with commas."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_figure(item)}" for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(f"[{_figure(item)}]" if isinstance(item, (list, tuple)) else _figure(item) for item in value)
    if isinstance(value, Fraction):
        return decimal(value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def next_steps(report: Report, model: str) -> list[str]:
    """The commands to go on with; ``--allow`` is offered for what is open, not for what is refuted."""
    if report.emittable:
        return [f"Next: pbcgen generate {model} -o {report.design.name}_c"]
    lines = [f"Next: change the model as the hints say, then pbcgen check {model}"]
    blocking = report.blocking()
    if report.writable and blocking and all(c.status is Status.UNDECIDED for c in blocking):
        allowed = " ".join(f"--allow {c.claim}" for c in blocking)
        lines.append(f"  or go on without a proof: pbcgen generate {model} -o {report.design.name}_c {allowed}")
    return lines


def too_short(report: Report, length: float, share: float = 2) -> list[str]:
    """A remark if a run of so many seconds ends within ``1 / share`` time constants of the slowest mode."""
    abscissa = report.derived["spectral_abscissa"]
    if abscissa is None or abscissa >= 0 or -share / abscissa <= length:
        return []
    seconds = f"{float(f'{-5 / abscissa:.2g}'):g}"
    return [
        f"The slowest mode has a time constant of {-1 / abscissa:.3g} s: add --duration {seconds}, or duration="
        f"{seconds} to the design, to see it settle."
    ]


def _seconds(report: Report) -> str:
    design = report.design
    late = f", delay {float(design.delay):g} h" if design.delay else ""
    varied = f", jitter {100 * float(design.jitter):g} %" if design.jitter else ""
    return f"{float(design.sample_period):g} s{late}{varied}, {design.precision}"
