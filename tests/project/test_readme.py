"""What README.md shows is what happens: its models load, its commands print what it says.

A ```python block is a file that is named in its first line. A ```console block is a list of commands (`$ ...`), each
with its output on a terminal of 80 columns; a line `...` stands for any lines.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def commands():
    """(command, expected output) of every console block, in order."""
    for block in blocks("console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, output = part.partition("\n")
            yield command, output


def run(command, directory):
    words = shlex.split(command)
    assert words[0] == "pbcgen", command
    return subprocess.run(
        [sys.executable, "-m", *words],
        cwd=directory,
        env={**os.environ, "COLUMNS": "80"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    ).stdout


def matches(expected, printed):
    """Whether the lines agree, `...` standing for any."""
    pieces = re.split(r"^ *\.\.\.\n", expected.rstrip() + "\n", flags=re.MULTILINE)
    return re.fullmatch("(?:.*\n)*?".join(map(re.escape, pieces)), printed.rstrip() + "\n") is not None


@pytest.mark.system
def test_the_commands_print_what_the_readme_shows(tmp_path):
    for block in blocks("python"):
        (tmp_path / block.partition("\n")[0].removeprefix("# ")).write_text(block, encoding="utf-8")
    assert any(tmp_path.iterdir())
    seen = 0
    for command, expected in commands():
        printed = run(command, tmp_path)
        assert matches(expected, printed), f"$ {command}\n{printed}"
        seen += 1
    assert seen >= 4


def test_every_link_leads_to_a_file():
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target


def test_every_make_target_it_names_exists():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^ {4}make ([a-z]+)", README, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
