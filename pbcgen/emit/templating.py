"""The Jinja2 environment: one, cached, strict about undefined names."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import jinja2

import pbcgen
from pbcgen.errors import EmitError


@cache
def environment() -> jinja2.Environment:
    """The environment of all templates."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(template_directory(), encoding="utf-8"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        newline_sequence="\n",
        autoescape=False,
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
    """The text of a template."""
    return environment().get_template(template).render(context)
