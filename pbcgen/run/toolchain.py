"""The C compiler: which one there is, and how it is called."""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pbcgen.errors import ToolchainError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

#: The diagnostics that the generated code must pass, each of them an error.
STRICT_WARNINGS = (
    "-std=c99",
    "-pedantic",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wdouble-promotion",
    "-Wshadow",
    "-Werror",
)

#: How the package is compiled on the host. Without contraction a*b+c is rounded twice, as in the Python step.
STRICT_FLAGS = (*STRICT_WARNINGS, "-O2", "-ffp-contract=off", "-fPIC", "-shared")

_LINES_OF_OUTPUT = 12
_TIME_LIMIT = 300.0


@dataclass(frozen=True)
class Compiler:
    """A C compiler as a command.

    Attributes:
        name: how a user knows it: ``cc``, ``zig`` or the text of ``$CC``.
        arguments: the words that every call starts with.
    """

    name: str
    arguments: tuple[str, ...]

    def command(self, sources: Sequence[Path], output: Path, flags: Sequence[str] = STRICT_FLAGS) -> list[str]:
        """The command line that compiles ``sources`` into ``output``; the maths library comes last."""
        return [*self.arguments, *flags, "-o", str(output), *map(str, sources), "-lm"]

    def version(self) -> str:
        """The first line of ``--version``. Raises ToolchainError if the compiler does not start."""
        result = run_tool([*self.arguments, "--version"])
        lines = (result.stdout or result.stderr).strip().splitlines()
        if result.returncode != 0 or not lines:
            raise ToolchainError(f"the compiler `{self.name}` does not answer to --version: {_head(result.stderr)}")
        return lines[0]

    def compile_shared(
        self, sources: Sequence[Path], directory: Path, flags: Sequence[str] = STRICT_FLAGS, name: str | None = None
    ) -> Path:
        """Compile ``sources`` into a shared library in ``directory``.

        Args:
            sources: C files.
            directory: where the library goes; it must exist.
            flags: compiler flags, ``-shared`` among them.
            name: the library's name without prefix and suffix; the stem of the first source by default.

        Returns:
            The path of the library.

        Raises:
            ToolchainError: the compiler is missing or rejects a source; the message quotes its first lines.
        """
        library = directory / f"lib{name or sources[0].stem}{library_suffix()}"
        result = run_tool(self.command(sources, library, flags))
        if result.returncode != 0:
            files = ", ".join(f"`{source.name}`" for source in sources)
            raise ToolchainError(f"{files} did not compile with `{self.name}`:\n{_head(result.stderr)}")
        return library


def find_compiler(environment: Mapping[str, str] | None = None) -> Compiler:
    """The compiler to use: ``$CC`` where it is set, else ``cc``, else zig from the Python package ``ziglang``.

    Raises ToolchainError if ``$CC`` names a program that does not exist, or if there is none of the three.
    """
    environment = os.environ if environment is None else environment
    choice = environment.get("CC", "").strip()
    path = environment.get("PATH")
    if choice:
        words = tuple(shlex.split(choice))
        if shutil.which(words[0], path=path) is None:
            raise ToolchainError(f"CC is `{choice}`, and there is no program `{words[0]}`: correct or unset CC")
        return Compiler(choice, words)
    if (found := shutil.which("cc", path=path)) is not None:
        return Compiler("cc", (found,))
    if (zig := find_zig()) is not None:
        return zig
    raise ToolchainError("no C compiler was found: install one as `cc`, or `pip install ziglang`, or set CC")


def find_zig() -> Compiler | None:
    """The C compiler inside the Python package ``ziglang``, if that is installed."""
    if importlib.util.find_spec("ziglang") is None:
        return None
    return Compiler("zig", (sys.executable, "-m", "ziglang", "cc"))


def library_suffix() -> str:
    """The suffix of a shared library on this system."""
    return ".dylib" if sys.platform == "darwin" else ".so"


def run_tool(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a program to its end, without a shell. Raises ToolchainError if it does not start or does not end."""
    try:
        return subprocess.run(
            list(command), capture_output=True, text=True, errors="replace", timeout=_TIME_LIMIT, check=False
        )
    except OSError as error:
        raise ToolchainError(f"`{command[0]}` does not start: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise ToolchainError(f"`{command[0]}` did not end within {_TIME_LIMIT:g} s") from error


def _head(text: str) -> str:
    """The first lines of a compiler's output."""
    lines = text.strip().splitlines()
    more = [f"... and {len(lines) - _LINES_OF_OUTPUT} more lines"] if len(lines) > _LINES_OF_OUTPUT else []
    return "\n".join(lines[:_LINES_OF_OUTPUT] + more) or "(no output)"
