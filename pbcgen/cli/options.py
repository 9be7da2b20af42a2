"""Arguments and options that several commands share."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pbcgen.errors import ModelError
from pbcgen.law.arithmetic import Precision, Tanh

if TYPE_CHECKING:
    from pbcgen.models.design import Design

Model = Annotated[
    str,
    typer.Argument(metavar="MODEL", help="A Python file, file.py:design, or a built-in name.", show_default=False),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
PrecisionOption = Annotated[
    Precision | None,
    typer.Option("--precision", help="Arithmetic of the C, in place of the design's.", show_default=False),
]
SamplePeriod = Annotated[
    str | None,
    typer.Option(
        "--sample-period", metavar="H", help="Seconds, in place of the design's: 1e-3 or 1/3000.", show_default=False
    ),
]
Allow = Annotated[
    list[str] | None,
    typer.Option(
        "--allow",
        metavar="CLAIM",
        help="Go on although this claim is not proved; can be given several times.",
        show_default=False,
    ),
]
TanhOption = Annotated[
    Tanh | None,
    typer.Option(
        "--tanh",
        help="A rational tanh, or the math library's; by default fast in float and libm in double.",
        show_default=False,
    ),
]


_PICTURES = (".pdf", ".png", ".svg")


def check_picture(path: Path | None) -> None:
    """Raise ModelError for a picture that could not be drawn, before the work rather than after it."""
    if path is None:
        return
    if path.suffix.lower() not in _PICTURES:
        raise ModelError(f"`{path}` does not end in {', '.join(_PICTURES)}: choose one of them")
    check_place(path)


def check_place(path: Path) -> None:
    """Raise ModelError for a file that could not be written, because there is no such directory."""
    if not path.parent.is_dir():
        raise ModelError(f"`{path}` cannot be written: there is no directory `{path.parent}`")


@dataclass(frozen=True)
class Settings:
    """What the options change for one run.

    Attributes:
        precision: in place of the design's, or None.
        sample_period: in seconds, as the user wrote it, in place of the design's, or None.
        allow: claims that need not be proved.
        tanh: in place of the precision's default, or None.
    """

    precision: Precision | None = None
    sample_period: str | None = None
    allow: tuple[str, ...] = ()
    tanh: Tanh | None = None

    def design(self, model: str) -> Design:
        """The design that MODEL names, changed. Raises ModelError for a model or a sample period that is not right."""
        from pbcgen.models.loader import load

        changes = {"precision": self.precision, "sample_period": self.sample_period}
        given = {name: value for name, value in changes.items() if value is not None}
        loaded = load(model)
        return loaded.with_(**given) if given else loaded

    def as_options(self) -> str:
        """The same as text, to be put behind a command."""
        words = [f"--precision {self.precision}"] if self.precision else []
        words += [f"--sample-period {shlex.quote(self.sample_period)}"] if self.sample_period else []
        words += [f"--tanh {self.tanh}"] if self.tanh else []
        words += [f"--allow {claim}" for claim in self.allow]
        return "".join(f" {word}" for word in words)


def claims(names: Sequence[str] | None) -> tuple[str, ...]:
    """The claims of ``--allow``, each once. Raises ModelError for a name that is no claim."""
    from pbcgen.models.expressions import suggestion
    from pbcgen.proof.claim import CLAIMS

    for name in names or ():
        if name not in CLAIMS:
            raise ModelError(f"`--allow {name}` names no claim: {suggestion(name, CLAIMS)}")
    return tuple(dict.fromkeys(names or ()))
