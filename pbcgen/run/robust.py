"""Thousands of closed loops of the generated C with what the proof leaves out: uncertainty, noise, friction, delay.

The plant is printed as C (:mod:`pbcgen.run.loops_source`); one run of a stiff plant costs a few milliseconds. Runs are
spread over any :class:`concurrent.futures.Executor`. Run k depends on the seed and on k only, so neither the number of
workers nor an interruption changes a result.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbcgen.errors import ModelError
from pbcgen.models.expressions import suggestion
from pbcgen.run.loops_source import loops_source
from pbcgen.run.trajectories import Loops, Scale, run_loops, trace
from pbcgen.run.wrapper import Interface

if TYPE_CHECKING:
    from pbcgen.emit import Package
    from pbcgen.law.closed_loop import ClosedLoop
    from pbcgen.models.design import Design

Array = NDArray[np.float64]
Progress = Callable[[int, int], None] | None

#: Relative error of the nominal run at which the number of plant steps is accepted.
_ACCURACY = 1e-3

_MOST_SUBSTEPS = 256


@dataclass(frozen=True)
class Disturbances:
    """What is added to the ideal loop.

    Attributes:
        spread: every parameter of the plant is uniform within this share of its value.
        spreads: the same for single parameters by name, in place of ``spread``.
        initial: every nonzero initial state is uniform within this share of its value.
        noise: standard deviation of a sensor by measured name.
        quantum: resolution of a sensor by measured name.
        friction: Coulomb friction by state: the force that acts on this momentum (or other state), in its unit per
            second, against the derivative of the storage by it. stiction: breakaway friction likewise, at least that;
            stribeck: the speed over which it falls to the Coulomb level.
        dead_zone: half width by input name: the actuator gives u less this, and nothing within.
        delay: of the input in samples, 0 to 2; None for the design's.
        share: friction, stiction, dead zones, noise and delay vary by this share from run to run.
    """

    spread: float = 0.0
    spreads: Mapping[str, float] = field(default_factory=dict)
    initial: float = 0.0
    noise: Mapping[str, float] = field(default_factory=dict)
    quantum: Mapping[str, float] = field(default_factory=dict)
    friction: Mapping[str, float] = field(default_factory=dict)
    stiction: Mapping[str, float] = field(default_factory=dict)
    stribeck: float = 0.0
    dead_zone: Mapping[str, float] = field(default_factory=dict)
    delay: float | None = None
    share: float = 0.0


@dataclass(frozen=True)
class Robustness:
    """What the runs showed.

    Attributes:
        outcomes: one row for each run; see the properties.
        loops: what was run. tolerance: a run converges if every target signal ends within this share of its
            initial error.
        target_names: of the target signals.
    """

    outcomes: Array
    loops: Loops
    tolerance: float
    target_names: tuple[str, ...]

    @property
    def settling(self) -> Array:
        """(runs,) seconds; infinity where a signal has not settled."""
        return self.outcomes[:, 0]

    @property
    def overshoot(self) -> Array:
        """(runs,) the largest excursion beyond the target as a share of the initial error."""
        return self.outcomes[:, 1]

    @property
    def final(self) -> Array:
        """(runs, targets) mean error over the last tenth of the run, in the unit of the signal."""
        return self.outcomes[:, 2 : 2 + self.loops.targets]

    @property
    def relative(self) -> Array:
        """(runs,) the largest final error as a share of the initial one; infinity where the run did not stay finite."""
        scale = self.outcomes[:, 2 + self.loops.targets : 2 + 2 * self.loops.targets]
        with np.errstate(invalid="ignore", divide="ignore"):
            worst = np.max(np.abs(self.final) / scale, axis=1)
        return np.where(np.isfinite(worst), worst, np.inf)

    @property
    def converged(self) -> NDArray[np.bool_]:
        """(runs,) whether each run ended at its target."""
        return self.relative <= self.tolerance

    @property
    def share(self) -> float:
        """The share of runs that converge."""
        return float(np.mean(self.converged))

    @property
    def worst(self) -> int:
        """The run that ends farthest from its target; among equals the slowest."""
        return int(np.lexsort((np.where(np.isfinite(self.settling), self.settling, 1e300), self.relative))[-1])


def loops_of(
    design: Design,
    loop: ClosedLoop,
    package: Package,
    disturbances: Disturbances | None = None,
    *,
    seed: int = 0,
    duration: float | None = None,
    substeps: int | None = None,
) -> Loops:
    """Print the plant, and collect everything that a worker needs.

    Args:
        design: the system with its parameters, target and initial state.
        loop: the equilibrium of the design, from its check.
        package: the generated controller.
        disturbances: what is added.
        seed: of all runs.
        duration: of a run, seconds; that of simulations by default.
        substeps: plant steps in a sample period; as many as the nominal run needs by default.

    Raises:
        ModelError: a disturbance names an unknown signal, or is negative.
        UnsupportedOperation: the model has an operation without a C form.
        ToolchainError: the C does not compile.
    """
    given = disturbances or Disturbances()
    delay = float(design.delay) if given.delay is None else given.delay
    _check(design, given)
    interface = Interface.of_manifest(package.files["manifest.json"])
    frictions = tuple(dict.fromkeys([*given.friction, *given.stiction]))
    source = loops_source(design, loop, interface, frictions)
    names = (f"{interface.prefix}.c", f"{interface.prefix}.h")
    files = (("loops.c", source), *((name, package.files[name]) for name in names))
    steps = max(1, round((duration or loop.duration) / float(design.sample_period)))
    made = Loops(
        files,
        design.system.n,
        design.system.m,
        len(design.system.measured_names),
        len(design.system.parameters),
        len(design.target.conditions),
        len(frictions),
        tuple(_varied(design, given, frictions, delay)),
        float(design.sample_period),
        steps,
        substeps or 1,
        0.02,
        seed,
    )
    return made if substeps else _fine_enough(made, 4 if delay % 1 else 1)


def _fine_enough(loops: Loops, least: int) -> Loops:
    """The loops with so many plant steps that twice as many change the nominal run little."""
    quiet = replace(loops, varied=_without_noise(loops))
    count = least
    coarse = trace(replace(quiet, substeps=count), 0)
    while count < _MOST_SUBSTEPS:
        fine = trace(replace(quiet, substeps=2 * count), 0)
        states = slice(1, 1 + loops.n)
        scale = np.maximum(np.max(np.abs(fine[:, states]), axis=0), 1e-300)
        with np.errstate(invalid="ignore"):
            error = np.max(np.abs(coarse[:, states] - fine[:, states]) / scale)
        # A method of second order: the finer run is four times as good.
        if error * 4 / 3 <= _ACCURACY:
            return replace(loops, substeps=count)
        coarse, count = fine, 2 * count
    return replace(loops, substeps=count)


def _without_noise(loops: Loops) -> tuple[Scale, ...]:
    """Noise, resolution and dry friction off: they make runs with different steps differ for good reason."""
    start, sensors, rubbing = loops.n + max(loops.parameters, 1), 2 * loops.measured, 3 * max(loops.frictions, 1)
    silent = range(start, start + sensors + rubbing)
    return tuple(Scale(0.0) if k in silent else scale for k, scale in enumerate(loops.varied))


def _varied(design: Design, given: Disturbances, frictions: Sequence[str], delay: float) -> list[Scale]:
    """What each entry of a case is drawn from, in the order of case_t."""
    system = design.system
    share = given.share
    varied = [Scale(float(v), given.initial) for v in design.initial]
    varied += [
        Scale(float(value), given.spreads.get(name, given.spread)) for name, value in system.parameters.values.items()
    ] or [Scale(0.0)]
    varied += [Scale(given.noise.get(name, 0.0), share) for name in system.measured_names]
    varied += [Scale(given.quantum.get(name, 0.0)) for name in system.measured_names]
    coulomb = [given.friction.get(name, given.stiction.get(name, 0.0)) for name in frictions]
    breakaway = [max(given.stiction.get(name, 0.0), level) for name, level in zip(frictions, coulomb, strict=True)]
    for levels in (coulomb, breakaway):
        varied += [Scale(level, share) for level in levels] or [Scale(0.0)]
    varied += [Scale(given.stribeck) for _ in frictions] or [Scale(0.0)]
    varied += [Scale(given.dead_zone.get(name, 0.0), share) for name in system.input_names]
    return [*varied, Scale(delay, share if delay * (1 + share) <= 2 else 0.0)]


def _check(design: Design, given: Disturbances) -> None:
    system = design.system
    known = {
        "spreads": tuple(system.parameters),
        "noise": system.measured_names,
        "quantum": system.measured_names,
        "friction": system.state_names,
        "stiction": system.state_names,
        "dead_zone": system.input_names,
    }
    for kind, names in known.items():
        for name, value in getattr(given, kind).items():
            if name not in names:
                raise ModelError(f"the {kind} of `{name}`: {suggestion(name, names)}")
            if not (math.isfinite(value) and value >= 0):
                raise ModelError(f"the {kind} of `{name}` is {value}: a number of at least 0 was expected")
    if given.delay is not None and not 0 <= given.delay <= 2:
        raise ModelError(f"the delay is {given.delay:g} samples: 0 to 2 were expected")
    for kind in ("spread", "initial", "share"):
        if not 0 <= getattr(given, kind) < 1:
            raise ModelError(f"the {kind} is {getattr(given, kind):g}: a share below 1 was expected")


def robust(
    loops: Loops,
    runs: int,
    *,
    executor: Executor | None = None,
    tolerance: float = 0.05,
    target_names: Sequence[str] = (),
    output: Path | None = None,
    chunk: int | None = None,
    progress: Progress = None,
) -> Robustness:
    """Run closed loops 0 .. runs - 1; run 0 is nominal.

    Args:
        loops: from :func:`loops_of`.
        runs: how many.
        executor: where to run them; in this process by default. It is not shut down.
        tolerance: share of the initial error within which a run must end to count as converged.
        target_names: for tables and plots.
        output: an .npz file for the outcomes. If it exists and belongs to the same loops, its runs are not repeated.
        chunk: runs in one task.
        progress: told after each chunk how many of all runs are done.

    Raises:
        ModelError: the file belongs to other loops, or cannot be written.
        ToolchainError: the C does not compile.
    """
    if runs < 1:
        raise ModelError(f"{runs} runs were asked for: at least 1 was expected")
    outcomes = np.full((runs, loops.columns), np.nan)
    done = np.zeros(runs, dtype=bool)
    if output is not None and output.exists():
        _resume(output, loops, outcomes, done)
    left = [int(k) for k in np.nonzero(~done)[0]]
    size = chunk or max(1, min(100, math.ceil(len(left) / 40)))
    chunks = [left[k : k + size] for k in range(0, len(left), size)]
    try:
        for rows, found in _results(loops, chunks, executor):
            outcomes[rows], done[rows] = found, True
            if output is not None:
                _save(output, loops, outcomes, done)
            if progress is not None:
                progress(int(done.sum()), runs)
    finally:
        if output is not None and done.any():
            _save(output, loops, outcomes, done)
    return Robustness(outcomes, loops, tolerance, tuple(target_names))


def _results(loops: Loops, chunks: Sequence[list[int]], executor: Executor | None) -> Any:
    if executor is None:
        for rows in chunks:
            yield rows, run_loops(loops, rows)
        return
    pending = {executor.submit(run_loops, loops, rows): rows for rows in chunks}
    try:
        for future in as_completed(pending):
            yield pending[future], future.result()
    finally:
        for future in pending:
            future.cancel()


def _resume(path: Path, loops: Loops, outcomes: Array, done: NDArray[np.bool_]) -> None:
    try:
        with np.load(path, allow_pickle=False) as stored:
            digest, rows, before = str(stored["digest"]), stored["runs"], stored["outcomes"]
    except (OSError, ValueError, KeyError) as error:
        raise ModelError(f"`{path}` holds no results of robustness runs: choose another file") from error
    if digest != loops.digest:
        raise ModelError(f"`{path}` holds results of another design, seed or disturbance: choose another file")
    keep = rows < len(done)
    outcomes[rows[keep]], done[rows[keep]] = before[keep], True


def _save(path: Path, loops: Loops, outcomes: Array, done: NDArray[np.bool_]) -> None:
    """Write the file anew under another name and put it in place, so that it is always complete."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.npz")
    try:
        np.savez_compressed(temporary, digest=np.array(loops.digest), runs=np.nonzero(done)[0], outcomes=outcomes[done])
        temporary.replace(path)
    except OSError as error:
        raise ModelError(f"`{path}` cannot be written: {error.strerror}") from error


def local_executor(workers: int | None = None) -> Executor:
    """Processes on this machine; they start afresh, so no thread of this process can disturb them."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    return ProcessPoolExecutor(workers or os.cpu_count() or 1, mp_context=multiprocessing.get_context("spawn"))


def dask_executor(address: str | None = None) -> tuple[Executor, Callable[[], None]]:
    """A Dask cluster as an executor, and what closes it: the cluster at an address, else one on this machine.

    Raises ModelError if dask.distributed is not installed or the address does not answer.
    """
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        raise ModelError("`--executor dask` needs dask.distributed: pip install 'pbcgen[dask]'") from error
    options: dict[str, Any] = {"timeout": "20s"} if address else {"processes": True, "dashboard_address": None}
    try:
        client = distributed.Client(*([address] if address else []), **options)
    except (OSError, TimeoutError) as error:
        raise ModelError(f"no Dask cluster answers at `{address}`: {error}") from error
    return client.get_executor(), client.close
