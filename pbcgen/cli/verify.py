"""``pbcgen verify``: check a certificate again, without the provers that found it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pbcgen.cli.outcome import Outcome
from pbcgen.cli.terminal import progress
from pbcgen.errors import ModelError, NotProved

if TYPE_CHECKING:
    from rich.console import Console

    from pbcgen.verify.claims import Finding

_WORDS = {"checked": "checked", "fails": "DOES NOT HOLD", "recorded": "NOT CHECKED", "open": "undecided"}
_STYLES = {"checked": "green", "fails": "bold red", "recorded": "yellow", "open": "dim"}


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""

    @app.command("verify")
    def command(
        certificate: Annotated[
            str, typer.Argument(metavar="CERTIFICATE", help="A certificate.json, or a package.", show_default=False)
        ],
        strict: Annotated[
            bool, typer.Option("--strict", help="Let claims that are only recorded count as failed.")
        ] = False,
        json: Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")] = False,
    ) -> Outcome:
        """Check a certificate or a package again. The small checker shares nothing with the provers."""
        return run(certificate, strict=strict, json=json)


def run(certificate: str, *, strict: bool = False, json: bool = False) -> Outcome:
    """Check every claim. Exit code 2 when one does not hold.

    Raises ModelError for a file that is no certificate, or was changed.
    """
    from pbcgen.symbolic.plain.outcomes import Malformed
    from pbcgen.verify.files import verify

    path = Path(certificate)
    if not path.exists():
        raise ModelError(f"there is no file `{certificate}`: give a certificate.json, or the directory of a package")
    try:
        with progress("verify"):
            document, findings = verify(path)
    except Malformed as reason:
        raise ModelError(str(reason)) from None
    failed = {"fails", "recorded"} if strict else {"fails"}
    accepted = not any(finding.outcome in failed for finding in findings)
    return Outcome(
        show=lambda console: _show(console, document, findings, accepted),
        document=_document(document, findings, accepted) if json else None,
        exit_code=0 if accepted else NotProved.exit_code,
    )


def _document(document: Mapping[str, Any], findings: Sequence[Finding], accepted: bool) -> dict[str, Any]:
    return {
        "design": document["design"],
        "model_hash": document["model_hash"],
        "accepted": accepted,
        "checked": sum(f.outcome == "checked" for f in findings),
        "recorded": sum(f.outcome == "recorded" for f in findings),
        "findings": [
            {"claim": f.claim, "status": f.status, "outcome": f.outcome, "reason": f.reason} for f in findings
        ],
    }


def _show(console: Console, document: Mapping[str, Any], findings: Sequence[Finding], accepted: bool) -> None:
    from rich.table import Table
    from rich.text import Text

    console.print(f"{document['design']}: model {document['model_hash'][:16]}...\n", style="bold")
    table = Table.grid(padding=(0, 2, 0, 0))
    for finding in findings:
        outcome = Text(_WORDS[finding.outcome], _STYLES[finding.outcome])
        table.add_row(outcome, finding.status, Text.assemble((finding.claim, "bold"), _because(finding)))
    console.print(table)
    console.print()
    counts = Counter(finding.outcome for finding in findings)
    console.print(f"{counts['checked']} checked, {counts['fails']} do not hold, {counts['open']} undecided.")
    left = counts["recorded"]
    if left:
        console.print(f"{left} recorded and NOT checked: the checker has no means for them.", style="bold yellow")
    verdict, style = ("Accepted.", "bold green") if accepted else ("Not accepted.", "bold red")
    if accepted and left:
        verdict = f"Accepted, but for {left} that nothing here checked (--strict does not accept them)."
    console.print(verdict, style=style)


def _because(finding: Finding) -> str:
    return f": {finding.reason}" if finding.reason else ""
