"""The reference designs, written as a user would write them; ``pbcgen.load`` takes their names."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING

from pbcgen.errors import ModelError
from pbcgen.models.expressions import suggestion
from pbcgen.models.loader import BUILT_IN_DIRECTORY, built_in_names

if TYPE_CHECKING:
    from pathlib import Path


def names() -> tuple[str, ...]:
    """The names of the built-in models, sorted."""
    return built_in_names()


def path(name: str) -> Path:
    """The file of a built-in model. Raises ModelError for an unknown name."""
    if name not in names():
        raise ModelError(f"there is no built-in model `{name}`: {suggestion(name, names())}")
    return BUILT_IN_DIRECTORY / f"{name}.py"


def description(name: str) -> str:
    """What a built-in model is, in one line. Raises ModelError for an unknown name."""
    text = ast.get_docstring(ast.parse(path(name).read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]
