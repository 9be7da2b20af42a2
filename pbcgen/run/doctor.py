"""What this machine offers: compilers, optional extras, versions."""

from __future__ import annotations

import platform
import shutil
from dataclasses import dataclass
from importlib import metadata

from pbcgen.errors import ToolchainError
from pbcgen.run.toolchain import Compiler, find_compiler, find_zig, run_tool


@dataclass(frozen=True)
class Check:
    """One line of ``pbcgen doctor``.

    Attributes:
        name: what was looked for.
        found: whether it is there and works.
        detail: its version, or how to get it.
        needed_for: what does not work without it.
        required: whether pbcgen as a whole needs it.
    """

    name: str
    found: bool
    detail: str
    needed_for: str
    required: bool = False


_REQUIRED_PACKAGES = (
    ("casadi", "models and simulation"),
    ("sympy", "formulas in reports"),
    ("latex2mathml", "formulas in reports"),
    ("numpy", "numeric work"),
    ("scipy", "numeric work"),
    ("python-flint", "certified arithmetic"),
    ("cffi", "loading the compiled C"),
    ("jinja2", "emitting the C"),
    ("matplotlib", "plots"),
    ("typer", "the command line"),
    ("rich", "tables on the terminal"),
)

_OPTIONAL_PACKAGES = (
    ("ziglang", "compiling without cc and for other processors"),
    ("unicorn", "counting instructions on an emulated processor"),
    ("pyelftools", "sizes and symbols of compiled code"),
    ("clarabel", "proofs by semidefinite programming"),
    ("distributed", "robustness runs on a cluster"),
)

_PROGRAMS = (
    ("arm-none-eabi-gcc", "compiling for Cortex-M with GCC"),
    ("qemu-system-arm", "running Cortex-M code"),
    ("valgrind", "counting instructions on the host"),
)


def diagnose() -> list[Check]:
    """Everything that pbcgen uses, in a fixed order, whether it is present or not."""
    return [
        Check("python", True, platform.python_version(), "everything", required=True),
        *(_package(name, use, required=True) for name, use in _REQUIRED_PACKAGES),
        _default_compiler(),
        _compiler("zig", find_zig(), "compiling without cc", "pip install ziglang"),
        *(_package(name, use, required=False) for name, use in _OPTIONAL_PACKAGES),
        *(_program(name, use) for name, use in _PROGRAMS),
    ]


def _package(name: str, needed_for: str, *, required: bool) -> Check:
    try:
        return Check(name, True, metadata.version(name), needed_for, required)
    except metadata.PackageNotFoundError:
        return Check(name, False, f"not installed: pip install {name}", needed_for, required)


def _default_compiler() -> Check:
    use = "compiling and validating the generated code"
    try:
        return _compiler("C compiler", find_compiler(), use, "")
    except ToolchainError as error:
        return Check("C compiler", False, str(error), use)


def _compiler(name: str, compiler: Compiler | None, needed_for: str, remedy: str) -> Check:
    if compiler is None:
        return Check(name, False, f"not found: {remedy}", needed_for)
    try:
        return Check(name, True, f"{compiler.name}: {compiler.version()}", needed_for)
    except ToolchainError as error:
        return Check(name, False, str(error), needed_for)


def _program(name: str, needed_for: str) -> Check:
    path = shutil.which(name)
    if path is None:
        return Check(name, False, "not found", needed_for)
    try:
        result = run_tool([path, "--version"])
    except ToolchainError as error:
        return Check(name, False, str(error), needed_for)
    lines = (result.stdout or result.stderr).strip().splitlines()
    return Check(name, result.returncode == 0, lines[0] if lines else path, needed_for)
