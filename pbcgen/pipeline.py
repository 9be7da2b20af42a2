"""The stages from a design to validated C, one function each.

check     design  -> Report      verdicts, derived quantities, the discretised law
generate  design  -> Generated   the C files, when the claims allow it
validate  design  -> Validation  the compiled C against the Python step and the continuous reference
simulate  design  -> Simulation  the closed loop, continuous and sampled
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from pbcgen.certify.certificate import certificate as write_certificate
from pbcgen.control.derive import Derivation, derive
from pbcgen.emit import Extras, Package, Provenance, render
from pbcgen.errors import EmitError, ModelError, NotProved
from pbcgen.law.arithmetic import Tanh, default_tanh
from pbcgen.law.closed_loop import ClosedLoop
from pbcgen.law.law import ControlLaw
from pbcgen.law.solves import with_tanh
from pbcgen.models.design import Design
from pbcgen.models.identity import model_hash
from pbcgen.models.source import located
from pbcgen.proof.claim import ELSEWHERE, EMISSION_CLAIMS, NOT_REACHED, Claim, Status

if TYPE_CHECKING:
    from pbcgen.control.attraction import Region
    from pbcgen.emit.step_cost import StepCost
    from pbcgen.run.simulate import Trajectory
    from pbcgen.run.validate import Validation

Progress = Callable[[str], None] | None


@dataclass(frozen=True)
class Report:
    """What `check` found.

    Attributes:
        design: the design that was checked.
        claims: one verdict for each claim that concerns the law, in the order of CLAIMS.
        derived: the keys of the JSON document's ``derived`` (kappa, gamma, ...); formulas as strings.
        unfitted: the discretised law before its loop equation is fitted; None if there is no law, or if it cannot be
            computed in the precision of the code.
        loop: plant and continuous law for simulation, or None when the derivation stopped before it.
        model_hash: SHA-256 of the canonical text of the design.
        timings: seconds of each stage.
        derivation: what the claims rest on, with formulas and matrices.
        unwritable: why the law cannot be computed in the precision of the code; empty if it can.
        tanh: how the code computes tanh; None for what the precision suggests.
    """

    design: Design
    claims: tuple[Claim, ...]
    derived: Mapping[str, Any]
    unfitted: ControlLaw | None
    loop: ClosedLoop | None
    model_hash: str
    timings: Mapping[str, float]
    derivation: Derivation
    unwritable: str = ""
    tanh: Tanh | None = None

    @cached_property
    def control(self) -> ControlLaw | None:
        """The discretised law, or None; made when it is asked for, since fitting its loop equation takes a while."""
        if self.unfitted is None:
            return None
        return with_tanh(self.unfitted, self.tanh or default_tanh(self.design.precision))

    @property
    def writable(self) -> bool:
        """Whether there is a law that can be computed in the precision of the code."""
        return self.unfitted is not None

    def __repr__(self) -> str:
        proved = sum(c.status is Status.PROVED for c in self.claims)
        return f"<Report of {self.design.name}: {proved} of {len(self.claims)} claims PROVED>"

    def blocking(self, allow: Sequence[str] = ()) -> tuple[Claim, ...]:
        """The claims that forbid code: not PROVED and not allowed by name."""
        return tuple(
            c
            for c in self.claims
            if c.claim in EMISSION_CLAIMS and c.status is not Status.PROVED and c.claim not in allow
        )

    @property
    def emittable(self) -> bool:
        """Whether code may be generated without ``--allow``."""
        return self.writable and not self.blocking()

    def as_json(self) -> dict[str, Any]:
        """The document of ``pbcgen check --json``."""
        return {
            "design": self.design.name,
            "law": self.design.law.name,
            "claims": [c.as_json() for c in self.claims],
            "derived": dict(self.derived),
            "emittable": self.emittable,
            "timings": dict(self.timings),
        }


@dataclass(frozen=True)
class Generated:
    """A package, the report that it rests on, and where it was written."""

    package: Package
    report: Report
    directory: Path


@dataclass(frozen=True)
class Simulation:
    """The closed loop from the design's initial state.

    Attributes:
        continuous: the law of the paper.
        sampled: the generated C under zero-order hold.
        intervals: of the inputs, from the law.
        report: the check.
    """

    continuous: Trajectory
    sampled: Trajectory
    intervals: tuple[tuple[Fraction, Fraction], ...]
    report: Report


def for_all_parameters(report: Report) -> tuple[Claim, ...]:
    """What holds for all positive values of the parameters, see :mod:`pbcgen.parametric.all_parameters`.

    Raises ModelError for a model without parameters.
    """
    from pbcgen.parametric.all_parameters import for_all_parameters as decide

    return decide(report.derivation)


def check(design: Design, progress: Progress = None, scan: bool = False) -> Report:
    """Derive and decide everything that can be said of the design. Raises ModelError for an inconsistent model.

    With ``scan`` the range of stable sample periods is proved to its end, however long that takes.
    """
    start = perf_counter()
    try:
        derivation = derive(design, progress, scan)
    except ModelError as error:
        raise located(error, design.call, design.system.call) from error.__cause__
    timings = {**derivation.timings, "total": perf_counter() - start}
    unfitted, unwritable = None, ""
    try:
        unfitted = derivation.control_law(design.sample_period, design.precision, "libm")
    except EmitError as error:
        unwritable = str(error)
    return Report(
        design,
        derivation.claims,
        derivation.derived,
        unfitted,
        derivation.loop,
        model_hash(design),
        {name: round(seconds, 6) for name, seconds in timings.items()},
        derivation,
        unwritable,
    )


def region(report: Report, boxes: int | None = None, progress: Progress = None) -> Region:
    """The largest level set of the Lyapunov function that is certified to be attracted to x*.

    ``boxes`` limits the search; the same budget gives the same region.

    Raises ModelError when the derivation stopped before there was a closed loop.
    """
    from pbcgen.control.attraction import BOXES, attracted_level_set

    found = attracted_level_set(report.derivation, boxes or BOXES, progress)
    if found is None:
        raise ModelError(f"`{report.design.name}` has no closed loop to find a region for: see `pbcgen check`")
    return found


def package(
    report: Report,
    *,
    prefix: str | None = None,
    allow: Sequence[str] = (),
    costs: Sequence[StepCost] = (),
    extras: Extras | None = None,
) -> Package:
    """The C package of a checked design. Raises NotProved when a claim that it needs is open.

    ``costs`` are what a step of it takes on targets, ``extras`` functions on demand.
    """
    blocking = report.blocking(allow)
    if report.unwritable:
        raise EmitError(f"no code for `{report.design.name}`: {report.unwritable}")
    if blocking or report.control is None:
        raise NotProved(_refusal(report, blocking))
    allowed = tuple(sorted(c.claim for c in report.claims if c.claim in allow and c.status is not Status.PROVED))
    provenance = Provenance(
        report.model_hash,
        tuple((c.claim, str(c.status), c.domain) for c in report.claims),
        allowed,
        derived=report.derived,
        delay=report.design.delay,
        jitter=report.design.jitter,
    )
    return render(report.control, provenance, prefix, {"certificate.json": certificate(report)}, costs, extras)


def measured(report: Report, rendered: Package, names: Sequence[str], progress: Progress = None) -> list[StepCost]:
    """What a step of the package costs on the targets of these names. Raises ToolchainError if a tool is missing."""
    from pbcgen.run.emulate import measure
    from pbcgen.run.targets import target

    assert report.control is not None
    assert report.loop is not None
    costs = []
    for name in dict.fromkeys(names):
        if progress:
            progress(f"emulate {name}")
        costs.append(measure(report.control, rendered.files, report.loop, target(name)))
    return costs


def _with_tanh(report: Report, tanh: Tanh | None) -> Report:
    """The report with another tanh in its law."""
    return report if tanh is None else replace(report, tanh=tanh)


def certificate(report: Report) -> str:
    """What `pbcgen verify` needs to check every verdict again, as JSON; the same for the same design."""
    return json.dumps(write_certificate(report.derivation), indent=1, sort_keys=True, ensure_ascii=True) + "\n"


def _hints(report: Report, blocking: Sequence[Claim]) -> list[str]:
    """The hints of the claims that block, and of those that these hints send to, in the order of the claims."""
    sent = " ".join(c.hint for c in blocking)
    shown = [c for c in report.claims if c in blocking or (c.status is not Status.PROVED and c.claim in sent)]
    hints = dict.fromkeys(c.hint for c in shown if c.hint)
    own = [hint for hint in hints if not hint.startswith(ELSEWHERE)]
    return own or list(hints)


def _refusal(report: Report, blocking: Sequence[Claim]) -> str:
    lines = [f"no code for `{report.design.name}`: these claims are not PROVED"]
    lines += [f"  {c.claim} is {c.status}: {c.evidence}" for c in blocking if c.method != NOT_REACHED]
    if skipped := [c.claim for c in blocking if c.method == NOT_REACHED]:
        lines.append(f"  not reached: {', '.join(skipped)}")
    lines += [f"  hint: {hint}" for hint in _hints(report, blocking)]
    if not blocking or any(c.claim in ("equilibrium", "measurability") for c in blocking):
        lines.append("  without them there is no law to emit, so --allow does not help")
    else:
        lines.append("  to emit all the same, name them: " + " ".join(f"--allow {c.claim}" for c in blocking))
    return "\n".join(lines)


def generate(
    design: Design,
    directory: Path,
    *,
    prefix: str | None = None,
    allow: Sequence[str] = (),
    tanh: Tanh | None = None,
    targets: Sequence[str] = (),
    extras: Extras | None = None,
    progress: Progress = None,
) -> Generated:
    """Check the design and write its C package.

    Args:
        design: the controller.
        directory: new, empty, or with an earlier version of the package.
        prefix: of the C names.
        allow: claims that need not be proved.
        tanh: in place of the precision's default.
        extras: functions on demand: a bumpless start, a self-test.
        targets: processors on which the cost of a step is measured, for README and manifest.
        progress: called with the name of each stage.

    Raises:
        ToolchainError: a target is unknown, or its tools are missing.
        NotProved: a claim that code needs is neither PROVED nor allowed.
        EmitError: the directory holds files of others, or a constant does not fit the precision.
        ModelError: the model is inconsistent.
    """
    report = _with_tanh(check(design, progress), tanh)
    rendered = package(report, prefix=prefix, allow=allow, extras=extras)
    if targets:
        costs = measured(report, rendered, targets, progress)
        rendered = package(report, prefix=prefix, allow=allow, costs=costs, extras=extras)
    rendered.write(directory)
    return Generated(rendered, report, directory)


def validate(
    design: Design,
    *,
    allow: Sequence[str] = (),
    tanh: Tanh | None = None,
    progress: Progress = None,
    steps: int = 2_000,
) -> Validation:
    """Compile the C of the design and test it over so many sample periods; see :func:`pbcgen.run.validate.validate`."""
    from pbcgen.run.validate import validate as run

    _require_start(design)
    report = _with_tanh(check(design, progress), tanh)
    rendered = package(report, allow=allow)
    assert report.control is not None
    assert report.loop is not None
    return run(report.control, rendered, report.loop, report.derivation.relaw, progress=progress, steps=steps)


def _require_start(design: Design) -> None:
    """Raise ModelError for a run that would begin where the model is not stated."""
    system = design.system
    for name, value in zip(system.state_names, design.initial, strict=True):
        lo, hi = system.domain.get(name, (None, None))
        if (lo is not None and value < lo) or (hi is not None and value > hi):
            ends = f"[{float('-inf') if lo is None else float(lo):g}, {float('inf') if hi is None else float(hi):g}]"
            raise ModelError(
                f"the run would begin at {name} = {float(value):g}, outside of its domain {ends}: give a start "
                f"inside by initial={{{name!r}: ...}}"
            )


def simulate(design: Design, *, allow: Sequence[str] = (), progress: Progress = None) -> Simulation:
    """Run the closed loop with the continuous law and with the generated C."""
    import numpy as np

    from pbcgen.run.simulate import simulate_continuous, simulate_sampled
    from pbcgen.run.wrapper import Controller

    _require_start(design)
    report = check(design, progress)
    rendered = package(report, allow=allow)
    assert report.control is not None
    assert report.loop is not None
    times = np.linspace(0.0, report.loop.duration, 2001)
    if progress:
        progress("continuous closed loop")
    continuous = simulate_continuous(report.loop, times)
    if progress:
        progress("sampled closed loop")
    with Controller.of_package(rendered) as controller:
        sampled = simulate_sampled(
            report.loop, controller, design.sample_period, report.loop.duration, delay=design.delay
        )
    return Simulation(continuous, sampled, report.control.intervals, report)
