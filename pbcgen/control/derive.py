"""From a design to its derivation: every claim, every derived quantity, and the law as formulas."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from math import isfinite
from time import perf_counter
from typing import Any

import casadi as ca

from pbcgen.control.box import box_claim
from pbcgen.control.sampled import Sampling
from pbcgen.control.saturation import saturation
from pbcgen.control.situation import Situation
from pbcgen.control.stability import StabilityVerdicts, stability
from pbcgen.errors import ModelError, UnsupportedOperation
from pbcgen.law.arithmetic import Precision, Tanh
from pbcgen.law.closed_loop import ClosedLoop, closed_loop
from pbcgen.law.discretisation import Interface, control_law
from pbcgen.law.graph import LawGraph, Needs, build, needs
from pbcgen.law.law import ControlLaw, Signal
from pbcgen.law.measure import Measurement
from pbcgen.law.settings import Settings
from pbcgen.models.design import Design
from pbcgen.models.laws import Law, NaturalDamping, PassiveOutput, PotentialCompensation, base_law, shaping
from pbcgen.models.laws import gains as gains_of
from pbcgen.passivity import passive_output
from pbcgen.passivity.assignable import assignable_set
from pbcgen.passivity.damping_search import Port
from pbcgen.passivity.dissipation import NaturalDampingBounds, assumption_3
from pbcgen.passivity.equilibrium import Equilibrium, complete, input_rank, without_rank
from pbcgen.passivity.other_storage import other_storage
from pbcgen.passivity.passive_output import PassiveOutput as PassiveOutputResult
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.region import Region
from pbcgen.passivity.shaping import (
    HessianVerdict,
    Shape,
    gain_definiteness,
    gradient_condition,
    hessian_conditions,
    shape_at,
)
from pbcgen.passivity.storage import Storage, assumption_1
from pbcgen.passivity.structure import PowerStructure
from pbcgen.passivity.target_map import TargetMap, target_map
from pbcgen.passivity.theta import ThetaVerdict, theta
from pbcgen.proof.claim import CLAIMS, NOT_REACHED, Claim, Status
from pbcgen.symbolic.display import formula
from pbcgen.symbolic.real import approximate, is_finite

Progress = Callable[[str], None] | None


@dataclass(frozen=True, eq=False)
class Derivation:
    """Everything that was derived of a design.

    Attributes:
        design: the design.
        plant: its system as formulas.
        law: the law with resolved gains, or None if eta is missing.
        claims: verdicts in the order of CLAIMS.
        derived: quantities for people and JSON.
        point: x* and u*, or None.
        graph: the law as formulas, or None when it cannot be written.
        interface: names and bounds for the package, or None likewise.
        loop: for simulation, or None likewise.
        timings: seconds of each stage.
        gamma, eta: expressions, or None.
        structure: the power structure that was found, or None.
        bounds: of Assumption 3, or None.
        situation: what the stability claims rest on, or None when they were not reached.
    """

    design: Design
    plant: Plant
    law: Law | None
    claims: tuple[Claim, ...]
    derived: Mapping[str, Any]
    point: Point | None
    graph: LawGraph | None
    interface: Interface | None
    loop: ClosedLoop | None
    timings: Mapping[str, float]
    gamma: ca.SX | None
    eta: ca.SX | None
    structure: PowerStructure | None = None
    bounds: NaturalDampingBounds | None = None
    situation: Situation | None = None

    def __repr__(self) -> str:
        return f"<Derivation of {self.design.name}>"

    def control_law(self, h: Fraction, precision: Precision, tanh: Tanh | None = None) -> ControlLaw | None:
        """The law discretised with sample period h, or None when there is no law to discretise."""
        if self.graph is None or self.interface is None:
            return None
        return control_law(self.graph, self.interface, h, precision, tanh)

    def relaw(self, h: Fraction) -> ControlLaw:
        """The law discretised with another sample period, in double precision."""
        law = self.control_law(h, "double")
        if law is None:
            raise ModelError(f"the design `{self.design.name}` has no law to discretise")
        return law


@dataclass
class _Stages:
    """What the stages have found so far."""

    claims: dict[str, Claim]
    timings: dict[str, float]
    progress: Progress

    def run(self, name: str, stage: Callable[[], Any]) -> Any:
        if self.progress:
            self.progress(name)
        start = perf_counter()
        result = stage()
        self.timings[name] = perf_counter() - start
        return result

    def add(self, *claims: Claim) -> None:
        for claim in claims:
            self.claims[claim.claim] = claim

    def open(self, name: str, why: str, hint: str) -> None:
        self.claims.setdefault(name, Claim(name, Status.UNDECIDED, "at x*", NOT_REACHED, why, hint))


def derive(design: Design, progress: Progress = None, scan: bool = False) -> Derivation:
    """Run every stage as far as the earlier ones allow.

    Raises ModelError for designs that no verdict can describe, such as potential compensation without G = I.
    """
    plant = Plant(design.system)
    _check_compensation(plant, design.law)
    stages = _Stages({}, {}, progress)
    equilibrium: Equilibrium = stages.run("equilibrium", lambda: complete(plant, design))
    storage: Storage = stages.run("assumption-1", lambda: assumption_1(plant))
    stages.add(equilibrium.claim, storage.claim)
    if equilibrium.point is None and (rankless := without_rank(plant)) is not None:
        stages.add(rankless)
    found = stages.run(
        "passive output",
        lambda: passive_output.find(
            plant, storage.structure, storage.proved, storage.by_structure, storage.region, equilibrium.point
        ),
    )
    output = found if isinstance(found, PassiveOutputResult) else None
    stages.add(output.claim if output else found)
    bounds = None
    if output is not None and base_law(design.law).name == NaturalDamping.name:
        bounds = stages.run(
            "natural damping",
            lambda: assumption_3(
                plant, storage.structure, output.gamma, output.matched, storage.proved, Region.stated(plant)
            ),
        )
        stages.add(bounds.claim)
    eta = bounds.eta if bounds is not None else None
    law = _resolve(design, eta)
    numbers: dict[str, Any] = _formulas(plant, output, eta)
    theta_verdict = None
    base = base_law(law)
    if output is not None and bounds is not None and isinstance(base, NaturalDamping):
        port = Port.of(plant, Region.stated(plant), output.gamma, eta)
        theta_verdict = stages.run("theta", lambda: theta(bounds, base, port, storage.structure))
        stages.add(theta_verdict.claim)
    at_target = None
    if equilibrium.point is not None:
        spare = theta_verdict is not None and theta_verdict.strict
        at_target = _AtTarget(plant, design, law, equilibrium.point, output, storage, eta, spare)
        at_target.sampling = Sampling(design.delay, design.jitter, scan)
        numbers |= stages.run("at the target", lambda: at_target.decide(stages))
    numbers |= _bounds_as_numbers(bounds, theta_verdict)
    _fill(stages, design, law, equilibrium, output, at_target.obstacle if at_target else None)
    if equilibrium.point is not None:
        _advise(stages, plant, equilibrium.point)
    ordered = tuple(stages.claims[name] for name in CLAIMS if name in stages.claims)
    graph = at_target.graph if at_target else None
    interface = at_target.interface if at_target else None
    numbers = _known(numbers)
    slowest = numbers.get("spectral_abscissa")
    loop = closed_loop(plant, design, graph, equilibrium.point, slowest) if graph and equilibrium.point else None
    return Derivation(
        design,
        plant,
        law,
        ordered,
        {**_EMPTY, **numbers},
        equilibrium.point,
        graph,
        interface,
        loop,
        stages.timings,
        output.gamma if output else None,
        eta,
        storage.structure,
        bounds,
        at_target.situation if at_target else None,
    )


def _known(value: Any) -> Any:
    """The same, with None for numbers that balls do not enclose: JSON has no NaN."""
    if isinstance(value, dict):
        return {name: _known(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_known(entry) for entry in value]
    return None if isinstance(value, float) and not isfinite(value) else value


_EMPTY: Mapping[str, Any] = {
    "kappa": [],
    "gamma": [],
    "gamma_star": [],
    "eta": [],
    "x_star": [],
    "hessian_min_eigenvalue": None,
    "alpha_beta_min": None,
    "kc_min": None,
    "theta_bound": None,
    "input_intervals": [],
    "spectral_abscissa": None,
    "max_sample_period": None,
}


def _resolve(design: Design, eta: ca.SX | None) -> Law:
    size = None if eta is None else int(eta.numel())
    return design.law.resolve(design.system.m, size)


def _check_compensation(plant: Plant, law: Law) -> None:
    """Law (umec) cancels grad V with u, which takes G = I."""
    mechanics = plant.system.mechanical
    if not isinstance(base_law(law), PotentialCompensation) or mechanics is None:
        return
    size = plant.system.n // 2
    message = "potential-compensation needs G = I (an actuator on every joint): use DynamicExtension for this system"
    if mechanics.G.shape != (size, size):
        raise ModelError(message)
    try:
        field, (difference,) = plant.exact(mechanics.G - ca.SX.eye(size))
    except UnsupportedOperation:
        raise ModelError(message) from None
    if any(not entry.is_zero() for row in difference.dense(field.const(0)) for entry in row):
        raise ModelError(message)


def _formulas(plant: Plant, output: PassiveOutputResult | None, eta: ca.SX | None) -> dict[str, Any]:
    """gamma and eta as text with the parameters' names."""
    result: dict[str, Any] = {"assignable_set": assignable_set(plant)}
    for name, expression in (("gamma", output.gamma if output else None), ("eta", eta)):
        if expression is None or expression.numel() == 0:
            continue
        try:
            field, (values,) = plant.exact(expression, symbolic=True, known=plant.numbers)
        except (UnsupportedOperation, ZeroDivisionError):
            result[name] = [str(e) for e in ca.vertsplit(expression)]
            continue
        result[name] = [formula(v, plant.parameter_positions()) for v in values.column(field.const(0))]
    return result


def _bounds_as_numbers(bounds: NaturalDampingBounds | None, verdict: ThetaVerdict | None) -> dict[str, Any]:
    result: dict[str, Any] = {}
    if bounds is not None and bounds.Lambda_l is not None and bounds.Lambda_c is not None:
        result["Lambda_l"] = [approximate(v) for v in bounds.Lambda_l]
        result["Lambda_c"] = [approximate(v) for v in bounds.Lambda_c]
    if verdict is not None:
        result["theta_bound"] = verdict.smallest
    return result


class _AtTarget:
    """The stages that need x*."""

    def __init__(
        self,
        plant: Plant,
        design: Design,
        law: Law,
        point: Point,
        output: PassiveOutputResult | None,
        storage: Storage,
        eta: ca.SX | None,
        spare: bool,
    ) -> None:
        self.plant, self.design, self.law, self.point = plant, design, law, point
        self.output, self.storage, self.eta, self.spare = output, storage, eta, spare
        self.sampling = Sampling()
        self.graph: LawGraph | None = None
        self.interface: Interface | None = None
        self.situation: Situation | None = None
        self.obstacle: tuple[str, str] | None = None

    def decide(self, stages: _Stages) -> dict[str, Any]:
        """Add the claims at x* and return the derived numbers."""
        system = self.plant.system
        stages.add(input_rank(self.plant, self.point))
        numbers: dict[str, Any] = {
            "x_star": [approximate(v) for v in self.point.x],
            "kappa": [-approximate(v) or 0.0 for v in self.point.u],
        }
        if self.output is None:
            return numbers
        eta = ca.SX(0, 1) if self.eta is None else self.eta
        gamma_star, *others = self.plant.at(self.point, self.output.gamma, eta, system.measured_expressions)
        if not all(is_finite(row[0]) for part in (gamma_star, *others) for row in part):
            self.obstacle = (
                "gamma, eta or a measured signal has no value at x*, or jumps there",
                "give functions that are smooth at x*, or choose another target",
            )
            return numbers
        numbers["gamma_star"] = [approximate(row[0]) for row in gamma_star]
        numbers |= self._shape(stages)
        limits = saturation(self.plant, self.design, self.law, self.point)
        stages.add(limits.claim)
        numbers["input_intervals"] = [
            None if r is None else [approximate(r.lo), approximate(r.hi)] for r in limits.ranges
        ]
        moving = target_map(self.plant, self.design, self.point) if self.design.target_box else None
        explicit = moving if isinstance(moving, TargetMap) else None
        settings = Settings.of(self.design, self.law, explicit)
        measurement = Measurement.of(self.plant, self.point, settings)
        read = needs(self.plant, measurement, self.law, self.output.gamma, self.eta)
        stages.add(self._measurability(read))
        intervals = limits.intervals(self.design)
        lacks_eta = isinstance(base_law(self.law), NaturalDamping) and self.eta is None
        if read.missing or lacks_eta:
            return numbers
        loops = isinstance(base_law(self.law), PassiveOutput) and read.feedthrough.nnz() > 0
        if loops and stages.claims["passive-output"].status is not Status.PROVED:
            self.obstacle = (
                "y = gamma' depends on u and is not proved passive: the algebraic loop of the law may not be solvable",
                "mend the claim `passive-output`, or use DynamicExtension, which has no such loop",
            )
            return numbers
        graph = self.graph = build(self.law, measurement, self.point, read)
        situation = self.situation = self._situation(stages)
        verdicts: StabilityVerdicts = stages.run(
            "stability", lambda: stability(situation, self.design.sample_period, self.sampling)
        )
        stages.add(*verdicts.claims)
        if self.design.target_box or self.design.gain_ranges:
            box = stages.run("settings", lambda: box_claim(situation, graph, self.design, moving, self.sampling))
            stages.add(box.claim)
            intervals = box.intervals(self.design, intervals)
            if intervals is not None:
                numbers["input_intervals"] = [[float(lo), float(hi)] for lo, hi in intervals]
        if intervals is not None and all(lo < hi for lo, hi in intervals):
            self.interface = _interface(self.plant, self.design, self.point, intervals)
        numbers["spectral_abscissa"] = verdicts.spectral_abscissa
        numbers["spectral_radius"] = verdicts.spectral_radius
        numbers["max_sample_period"] = verdicts.max_sample_period
        numbers["sample_periods"] = dict(verdicts.sampled)
        numbers["state_names"] = list(system.state_names)
        return numbers

    def _situation(self, stages: _Stages) -> Situation:
        assert self.output is not None
        return Situation(
            self.plant,
            self.point,
            self.law,
            self.output.gamma,
            self.eta,
            self._structure(),
            self.spare,
            stages.claims,
        )

    def _structure(self) -> PowerStructure | None:
        """The power structure, if it proves Assumption 1 and gives gamma."""
        proved = self.output is not None and self.output.matched and self.storage.proved
        return self.storage.structure if proved else None

    def _shape(self, stages: _Stages) -> dict[str, Any]:
        assert self.output is not None
        shape: Shape = shape_at(self.plant, self.point, self.output.gamma, self.law)
        output = None if isinstance(base_law(self.law), PotentialCompensation) else self.output.claim
        stages.add(gradient_condition(self.plant, self.point, shape, self._structure(), output))
        term = shaping(self.law)
        verdict: HessianVerdict = hessian_conditions(self.plant, shape, term.stiffness, term.K_c)
        stages.add(verdict.hessian)
        matrices = {k: v for k, v in gains_of(self.law).items() if k in ("K_c", "R_c", "K_l", "R_l")}
        if matrices:
            stages.add(gain_definiteness(matrices))  # type: ignore[arg-type]
        if term.K_c is not None:
            stages.add(verdict.kc)
        minimum = verdict.alpha_beta_min
        return {
            "hessian_min_eigenvalue": verdict.smallest_eigenvalue,
            "alpha_beta_min": None if minimum is None else list(minimum) if len(minimum) > 1 else minimum[0],
            "kc_min": verdict.kc_min if term.K_c is not None else None,
        }

    def _measurability(self, read: Needs) -> Claim:
        names = ", ".join(self.plant.system.measured_names)
        if isinstance(base_law(self.law), NaturalDamping) and self.eta is None:
            return Claim(
                "measurability",
                Status.UNDECIDED,
                "all x",
                "exact linear algebra",
                "no eta was found, so there is nothing to measure",
                "mend assumption-3 first, or give eta=... with the model",
            )
        if not read.missing:
            return Claim(
                "measurability",
                Status.PROVED,
                "all x",
                "exact identities",
                f"the law is a function of the measured signals {names}",
            )
        first = read.missing[0]
        status = Status.REFUTED if first.direction else Status.UNDECIDED
        missing = ", ".join(f'"{name}"' for name in first.hidden)
        hint = (
            f"declare {missing} in `measured` if there is a sensor"
            if missing
            else f"measure what {first.signal} depends on"
        ) + ", or use a law that does not need it"
        counterexample = {"signal": first.signal, "direction": first.direction} if first.direction else None
        return Claim("measurability", status, "all x", "exact identities", first.reason, hint, counterexample)


def _interface(
    plant: Plant, design: Design, point: Point, intervals: tuple[tuple[Fraction, Fraction], ...]
) -> Interface:
    system = design.system
    units = system.units
    inputs = tuple(Signal(name, units.get(name, ""), "measured") for name in system.measured_names)
    outputs = tuple(Signal(name, units.get(name, ""), "actuator") for name in system.input_names)
    ranges = {
        name: (lo, hi)
        for name, (lo, hi) in system.domain.items()
        if name in system.measured and lo is not None and hi is not None
    }
    equilibrium = tuple(
        min(max(approximate(u), float(lo)), float(hi)) for u, (lo, hi) in zip(point.u, intervals, strict=True)
    )
    (measured,) = plant.at(point, system.measured_expressions)
    rest = tuple(approximate(row[0]) for row in measured)
    return Interface(design.name or "controller", inputs, outputs, intervals, equilibrium, ranges, rest)


def _advise(stages: _Stages, plant: Plant, point: Point) -> None:
    """Names a storage that would do, where the given one is what fails."""
    for name in ("passive-output", "gradient-condition", "measurability"):
        claim = stages.claims[name]
        if claim.status is Status.PROVED:
            continue
        found = other_storage(plant, point, readable=name == "measurability")
        if found is not None:
            other = f"; or {claim.hint}" if name == "measurability" else ""
            stages.claims[name] = replace(claim, hint=f"take another storage, such as {found}{other}")
        return


def _fill(
    stages: _Stages,
    design: Design,
    law: Law,
    equilibrium: Equilibrium,
    output: PassiveOutputResult | None,
    obstacle: tuple[str, str] | None,
) -> None:
    """Claims that were not reached are UNDECIDED with the reason."""
    if equilibrium.point is None:
        why, hint = "there is no equilibrium to work at", equilibrium.claim.hint or "mend the claim `equilibrium`"
    elif output is None:
        why, hint = "there is no gamma to work with", "mend the claim `passive-output`"
    else:
        unreadable = "the law cannot be written in the measured signals", "mend the claim `measurability`"
        why, hint = obstacle or unreadable
    base = base_law(law)
    skipped = set() if design.target_box or design.gain_ranges else {"adjustable"}
    if not isinstance(base, NaturalDamping):
        skipped |= {"assumption-3", "theta"}
    if isinstance(base, PassiveOutput):
        skipped |= {"gain-definiteness", "kc-bound"}
    for name in CLAIMS:
        if name not in skipped:
            stages.open(name, why, hint)
