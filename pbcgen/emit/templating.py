"""Jinja2 as the project uses it: strict about undefined names, and with line ends that do not depend on the machine."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import jinja2

import pbcgen
from pbcgen.errors import EmitError


def templates_in(folder: Path, *, html: bool = False) -> jinja2.Environment:
    """A new environment for the templates of a folder; for HTML what is put in is escaped."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder, encoding="utf-8"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        newline_sequence="\n",
        autoescape=html,
    )


def template_directory() -> Path:
    """``pbcgen/templates`` in an installed wheel, ``templates`` beside the package in a checkout.

    Raises EmitError if neither exists.
    """
    package = Path(pbcgen.__file__).parent
    for candidate in (package / "templates", package.parent / "templates"):
        if (candidate / "source.c.j2").is_file():
            return candidate
    raise EmitError(f"the templates of pbcgen are missing beside {package}: install pbcgen again")


def fill(template: str, context: dict[str, Any]) -> str:
    """The text of a template of the C package."""
    return _package().get_template(template).render(context)


@cache
def _package() -> jinja2.Environment:
    return templates_in(template_directory())
