"""Compiles a rendered package and calls it through cffi, for the tests of this folder."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from typing import TYPE_CHECKING

import cffi
import numpy as np

from pbcgen.law.step import StepStatus

if TYPE_CHECKING:
    from pathlib import Path

    from pbcgen.emit import Package
    from pbcgen.law.law import ControlLaw

WARNINGS = (
    *("-pedantic", "-Wall", "-Wextra", "-Werror", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Wcast-qual"),
    *("-Wmissing-prototypes", "-Wundef"),
)
ZIG = [sys.executable, "-m", "ziglang", "cc"]


def compiler() -> list[str]:
    """The command of a C compiler."""
    return [found] if (found := shutil.which("cc")) else ZIG


def run(command: list[str], **options: object) -> str:
    """Standard output of a command; its standard error when it fails."""
    result = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert result.returncode == 0, f"{' '.join(command)}\n{result.stdout}{result.stderr}"
    return result.stdout


class Compiled:
    """The step of a compiled package on NumPy arrays."""

    def __init__(self, law: ControlLaw, package: Package, directory: Path) -> None:
        package.write(directory / "package")
        library = directory / f"{package.prefix}.so"
        source = directory / "package" / f"{package.prefix}.c"
        flags = ["-std=c99", "-O1", "-ffp-contract=off", "-shared", "-fPIC"]
        run([*compiler(), *flags, *WARNINGS, str(source), "-o", str(library), "-lm"])
        self.ffi = cffi.FFI()
        self.ffi.cdef(_declarations(package.files[f"{package.prefix}.h"]))
        self.lib = self.ffi.dlopen(str(library))
        self.prefix = package.prefix
        self.dtype = np.dtype(np.float32 if law.precision == "float" else np.float64)
        self.sizes = [self.ffi.sizeof(f"{self.prefix}_{kind}_t") // self.dtype.itemsize for kind in ("state", "output")]

    def initial_state(self) -> np.ndarray:
        state = np.full(self.sizes[0], np.nan, self.dtype)
        self._call("init", self._pointer("state", state))
        return state

    def step(self, m: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(next state, u, status) for each row of m and state."""
        m = np.ascontiguousarray(m, self.dtype)
        state = np.array(state, self.dtype, order="C")
        u = np.full((len(m), self.sizes[1]), np.nan, self.dtype)
        status = np.empty(len(m), np.int32)
        for k in range(len(m)):
            status[k] = self._call(
                "step", self._pointer("state", state[k]), self._pointer("input", m[k]), self._pointer("output", u[k])
            )
        return state, u, status

    def step_null(self, missing: str) -> tuple[np.ndarray, int]:
        """(output, status) of a step with one null pointer."""
        u = np.full(self.sizes[1], np.nan, self.dtype)
        arguments = {
            "state": self._pointer("state", self.initial_state()),
            "input": self._pointer("input", np.zeros(64, self.dtype)),
            "output": self._pointer("output", u),
        }
        status = self._call("step", *(self.ffi.NULL if n == missing else a for n, a in arguments.items()))
        return u, StepStatus(status)

    def _pointer(self, kind: str, row: np.ndarray) -> object:
        return self.ffi.cast(f"{self.prefix}_{kind}_t *", row.ctypes.data)

    def _call(self, name: str, *arguments: object) -> int:
        return getattr(self.lib, f"{self.prefix}_{name}")(*arguments)


def _declarations(header: str) -> str:
    """The header without preprocessor lines, comments and the C++ bracket."""
    text = re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL)
    text = re.sub(r"#ifdef __cplusplus.*?#endif", "", text, flags=re.DOTALL)
    return "\n".join(line for line in text.splitlines() if not line.startswith("#"))
