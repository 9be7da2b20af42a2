"""What pbcgen exports is documented."""

import inspect
import re
from pathlib import Path

import pytest

import pbcgen

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "api.md").read_text(encoding="utf-8")

DIRECTIVE = re.compile(r"^::: (\S+)\n(?:    options:\n(?:      .*\n)*?      members: \[(.*)\]\n)?", re.MULTILINE)

#: Each directive with the members that it shows; all of them where none are named.
SHOWN = {path: re.findall(r"\w+", members) for path, members in DIRECTIVE.findall(PAGE)}


@pytest.mark.parametrize("name", [name for name in pbcgen.__all__ if not name.startswith("_")])
def test_every_export_is_on_the_page(name):
    home = inspect.getmodule(getattr(pbcgen, name)).__name__
    assert f"{home}.{name}" in SHOWN or (home in SHOWN and (not SHOWN[home] or name in SHOWN[home]))


def test_what_the_page_names_exists():
    for path, members in SHOWN.items():
        home, _, last = path.rpartition(".")
        module = __import__(path if members else home, fromlist=["_"])
        for member in members or [last]:
            assert inspect.getdoc(getattr(module, member))
