"""Closed loops in compiled code: the generated controller with a plant printed beside it, run case by case.

What a worker process needs: it imports no CasADi, compiles the source once and keeps the library loaded.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from cffi import FFI
from numpy.typing import NDArray

from pbcgen.errors import ToolchainError
from pbcgen.run.toolchain import find_compiler

Array = NDArray[np.float64]

#: Speed without a change of rounding: contraction off as in every other build, no errno, no traps.
FLAGS = (
    "-std=c99",
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=off",
    "-fPIC",
    "-shared",
)

_DECLARATIONS = """
size_t loops_sizes(int which);
void loops_run(const double *cases, const uint64_t *seeds, size_t count, double h, long steps, int substeps,
    double band, double *outcomes);
void loops_trace(const double *one, uint64_t seed, double h, long steps, int substeps, double band, double *outcome,
    double *trace, long stride);
"""


@dataclass(frozen=True)
class Scale:
    """How far a value is drawn from its nominal one: uniform in ``value (1 +- share)`` or ``value +- width``."""

    value: float
    share: float = 0.0
    width: float = 0.0

    def at(self, number: float) -> float:
        """The value for a number in [-1, 1]."""
        return self.value * (1 + self.share * number) + self.width * number


@dataclass(frozen=True)
class Loops:
    """A family of closed loops, ready to be sent to another process.

    Attributes:
        files: C sources by name; ``loops.c`` includes the controller's source.
        n, m, measured, parameters, targets, frictions: sizes, as in the C.
        varied: what each entry of a case is drawn from, in the order of the C struct.
        h: sample period. steps: sample periods in a run. substeps: plant steps in each.
        band: share of the initial error within which a signal counts as settled.
        seed: of the whole family; run k has its own stream that depends on seed and k only.
    """

    files: tuple[tuple[str, str], ...]
    n: int
    m: int
    measured: int
    parameters: int
    targets: int
    frictions: int
    varied: tuple[Scale, ...]
    h: float
    steps: int
    substeps: int
    band: float
    seed: int

    @property
    def digest(self) -> str:
        """Identifies everything that the results depend on, the number of runs apart."""
        return hashlib.sha256(repr(self).encode()).hexdigest()

    @property
    def columns(self) -> int:
        """Numbers in one outcome: settling, overshoot, final and scale of each target, last state, status."""
        return 2 + 2 * self.targets + self.n + 1

    def case(self, run: int) -> tuple[Array, int]:
        """The numbers of one run, and the seed of its sensor noise. Run 0 is nominal."""
        stream = np.random.Generator(np.random.Philox(key=[self.seed, run]))
        numbers = stream.uniform(-1.0, 1.0, len(self.varied))
        noise = int(stream.integers(0, 2**63))
        if run == 0:
            numbers = np.zeros(len(self.varied))
        return np.array([scale.at(float(v)) for scale, v in zip(self.varied, numbers, strict=True)]), noise


def run_loops(loops: Loops, runs: Sequence[int]) -> Array:
    """The outcomes of some runs, one row each (len(runs), columns). Raises ToolchainError if the C does not compile."""
    ffi, library = _library(loops.files)
    cases = [loops.case(run) for run in runs]
    block = np.ascontiguousarray([case for case, _ in cases])
    seeds = np.array([seed for _, seed in cases], dtype=np.uint64)
    outcomes = np.zeros((len(runs), loops.columns))
    _check_sizes(library, loops, block.shape[1])
    library.loops_run(
        ffi.from_buffer("double[]", block),
        ffi.from_buffer("uint64_t[]", seeds),
        len(runs),
        loops.h,
        loops.steps,
        loops.substeps,
        loops.band,
        ffi.from_buffer("double[]", outcomes, require_writable=True),
    )
    return outcomes


def trace(loops: Loops, run: int, rows: int = 1000) -> Array:
    """One run over time: about so many rows of t, the states and the inputs."""
    ffi, library = _library(loops.files)
    case, seed = loops.case(run)
    stride = max(1, loops.steps // rows)
    result = np.zeros((loops.steps // stride + 1, 1 + loops.n + loops.m))
    outcome = np.zeros(loops.columns)
    _check_sizes(library, loops, len(case))
    library.loops_trace(
        ffi.from_buffer("double[]", case),
        seed,
        loops.h,
        loops.steps,
        loops.substeps,
        loops.band,
        ffi.from_buffer("double[]", outcome, require_writable=True),
        ffi.from_buffer("double[]", result, require_writable=True),
        stride,
    )
    return result


def _check_sizes(library: Any, loops: Loops, width: int) -> None:
    if int(library.loops_sizes(0)) != width or int(library.loops_sizes(1)) != loops.columns:
        raise ToolchainError("the layout of the compiled loops is not the expected one: this is a defect in pbcgen")


@cache
def _library(files: tuple[tuple[str, str], ...]) -> tuple[FFI, Any]:
    """The loaded library of some sources; compiled once in each process."""
    ffi = FFI()
    ffi.cdef(_DECLARATIONS)
    with tempfile.TemporaryDirectory(prefix="pbcgen-") as name:
        directory = Path(name)
        for file, text in files:
            (directory / file).write_text(text, encoding="utf-8")
        library = find_compiler().compile_shared([directory / "loops.c"], directory, FLAGS)
        try:
            return ffi, ffi.dlopen(str(library.resolve()))
        except OSError as error:
            raise ToolchainError(f"`{library.name}` was compiled but cannot be loaded: {error}") from error
