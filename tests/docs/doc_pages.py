"""Run the code blocks of a page in docs/, in order, in a directory of its own.

    ```python title="name.py"     written to that file
    ```python                     executed; the blocks of one page share their names
    ```c title="name.c"           written to that file
    ```console                    `$ command` lines, each with what it prints on 80 columns; a line `...` is any lines,
                                  `...` at the end of a line for the rest of it

``python tests/docs/doc_pages.py`` writes the outputs of all commands into the pages again, except where a `...` stands.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path.name for path in DOCS.glob("*.md"))

_FENCE = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)
_ELLIPSIS = re.compile(r"^ *\.\.\.\n", re.MULTILINE)
_TAIL = re.escape("...\n")


@dataclass
class Command:
    """A command of a console block with what the page says that it prints, and what it prints."""

    line: str
    expected: str
    printed: str = ""

    @property
    def as_documented(self) -> bool:
        pieces = _ELLIPSIS.split(self.expected.rstrip() + "\n")
        exact = [re.escape(piece).replace(_TAIL, ".*\n") for piece in pieces]
        return re.fullmatch("(?:.*\n)*?".join(exact), self.printed.rstrip() + "\n") is not None

    def as_text(self, refreshed: bool) -> str:
        keep = not refreshed or _ELLIPSIS.search(self.expected)
        output = (self.expected if keep else self.printed).rstrip()
        return f"$ {self.line}\n" + (f"{output}\n" if output else "")


@dataclass
class Page:
    """A page while it is run."""

    name: str
    directory: Path
    names: dict[str, object] = field(default_factory=dict)
    commands: list[Command] = field(default_factory=list)

    @property
    def text(self) -> str:
        return (DOCS / self.name).read_text(encoding="utf-8")

    def run(self) -> None:
        with _in_directory(self.directory):
            for language, title, code in _FENCE.findall(self.text):
                self._block(language, title, code)

    def _block(self, language: str, title: str, code: str) -> None:
        if title:
            Path(title).write_text(code, encoding="utf-8")
        elif language == "python":
            exec(compile(code, f"<{self.name}>", "exec"), self.names)
        elif language == "console":
            for command in commands_of(code):
                command.printed = output_of(command.line)
                self.commands.append(command)

    def refreshed(self) -> str:
        """The text of the page with the outputs of this run."""
        commands = iter(self.commands)

        def block(match: re.Match[str]) -> str:
            language, _, code = match.groups()
            if language != "console":
                return match[0]
            shown = [next(commands).as_text(True) for _ in commands_of(code)]
            return "```console\n" + "\n".join(shown) + "```"

        return _FENCE.sub(block, self.text)


def commands_of(block: str) -> list[Command]:
    parts = re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]
    return [Command(line, expected) for line, _, expected in (part.partition("\n") for part in parts)]


def output_of(line: str) -> str:
    """What a command prints on a terminal of 80 columns. pbcgen runs in this process, which is faster."""
    words = shlex.split(line)
    if words[0] != "pbcgen":
        return _subprocess(words)
    from pbcgen.cli import execute

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed), _environment(COLUMNS="80"):
        execute(words[1:])
    return printed.getvalue()


def _subprocess(words: list[str]) -> str:
    program = sys.executable if words[0] == "python" else words[0]
    run = subprocess.run(
        [program, *words[1:]],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        env={**os.environ, "COLUMNS": "80", "PYTHONPATH": str(ROOT)},
    )
    return run.stdout


@contextlib.contextmanager
def _in_directory(path: Path):
    before = Path.cwd()
    os.chdir(path)
    try:
        yield
    finally:
        os.chdir(before)


@contextlib.contextmanager
def _environment(**values: str):
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)


def main(names: list[str]) -> None:
    sys.path.insert(0, str(ROOT))
    for name in names or PAGES:
        with tempfile.TemporaryDirectory() as directory:
            page = Page(name, Path(directory))
            page.run()
            changed = page.refreshed()
        if changed != page.text:
            (DOCS / name).write_text(changed, encoding="utf-8")
            print(f"{name} rewritten")


if __name__ == "__main__":
    main(sys.argv[1:])
