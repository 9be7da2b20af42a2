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
from pbcgen.proof.claim import Claim, Status

if TYPE_CHECKING:
    from rich.console import Console

    from pbcgen.pipeline import Report

_STYLES = {Status.PROVED: "green", Status.REFUTED: "bold red", Status.UNDECIDED: "bold yellow"}

#: Room for the longest claim; the domain stands behind it.
_CLAIM_WIDTH = 30

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


def show_report(console: Console, report: Report, model: str) -> None:
    """Print the report; ``model`` is how the user called it."""
    console.print(f"{report.design.name}: law {report.design.law.name}, h = {_seconds(report)}", style="bold")
    console.print()
    console.print(verdict_table(report.claims))
    console.print()
    console.print(derived_table(report))
    console.print()
    console.print(meaning(report), style="bold green" if report.emittable else "bold red")
    for line in next_steps(report, shlex.quote(model)):
        console.print(line, soft_wrap=True)


def verdict_table(claims: Iterable[Claim]) -> Table:
    """One row for each claim: its verdict, then name and domain with method and evidence below, and a hint.

    A hint that several claims share is given once.
    """
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold", expand=False)
    table.add_column("verdict", no_wrap=True)
    table.add_column(f"{'claim':{_CLAIM_WIDTH}}  where it holds, and why")
    given: set[str] = {""}
    for claim in claims:
        hint = "" if claim.status is Status.PROVED or claim.hint in given else claim.hint
        given.add(hint)
        table.add_row(Text(str(claim.status), _STYLES[claim.status]), _description(claim, hint))
    return table


def _description(claim: Claim, hint: str) -> Text:
    text = Text()
    text.append(f"{claim.claim:{_CLAIM_WIDTH}}", "bold")
    text.append(f"  {claim.domain}\n")
    text.append(": ".join(part for part in (claim.method, claim.evidence) if part), "dim")
    if hint:
        text.append(f"\nhint: {hint}", "yellow")
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


def meaning(report: Report) -> str:
    """The verdicts in one sentence."""
    if report.emittable and "globally-asymptotically-stable" in _proved(report):
        return "Proved: the loop settles at x* from everywhere, sampled from nearby, within its limits."
    if report.emittable:
        return "Proved: from nearby the loop settles at x*, sampled too, within its limits."
    blocking = report.blocking()
    if not blocking:
        return "No code: the derivation stopped before it had a controller."
    refuted = [c for c in blocking if c.status is Status.REFUTED]
    return f"No code: {' and '.join(f'{c.claim} is {c.status}' for c in refuted or blocking)}."


def _proved(report: Report) -> set[str]:
    return {claim.claim for claim in report.claims if claim.status is Status.PROVED}


def next_steps(report: Report, model: str) -> list[str]:
    """The commands to go on with; ``--allow`` is offered for what is open, not for what is refuted."""
    if report.emittable:
        return [f"Next: pbcgen generate {model} -o {report.design.name}_c"]
    lines = [f"Next: change the model as the hints say, then pbcgen check {model}"]
    blocking = report.blocking()
    if report.control is not None and blocking and all(c.status is Status.UNDECIDED for c in blocking):
        allowed = " ".join(f"--allow {c.claim}" for c in blocking)
        lines.append(f"  or go on without a proof: pbcgen generate {model} -o {report.design.name}_c {allowed}")
    return lines


def _seconds(report: Report) -> str:
    return f"{float(report.design.sample_period):g} s, {report.design.precision}"
