"""From the formulas of a law to the discretised controller, as data for the emitter and the reference step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca

from pbcgen.law.arithmetic import Precision, Tanh, default_tanh
from pbcgen.law.graph import LawGraph
from pbcgen.law.law import ControlLaw, Fallback, Setter, SetterInput, Signal
from pbcgen.law.settings import Setting, Stored
from pbcgen.law.solves import choose_solves
from pbcgen.models.laws import PotentialCompensation, base_law
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, approximate, enclose, is_finite, precision, undefined, upper
from pbcgen.symbolic.tape import Tape


@dataclass(frozen=True)
class Interface:
    """What the package's interface says beside the formulas."""

    name: str
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    intervals: tuple[tuple[Fraction, Fraction], ...]
    equilibrium_output: tuple[float, ...]
    ranges: Mapping[str, tuple[Fraction, Fraction]]
    rest: tuple[float, ...] = ()


def control_law(
    graph: LawGraph, interface: Interface, h: Fraction, precision: Precision, tanh: Tanh | None = None
) -> ControlLaw:
    """The discretised law as data for the emitter and the reference step."""
    step, stored = graph.discretise(h), graph.stored(h)
    N, c, following, output, start = graph.rounded(*step.parts(), graph.start(h), keep=stored)
    base = base_law(graph.law)
    holds = isinstance(base, PotentialCompensation)
    kept = ca.vertcat(*[s.symbol for s in stored]) if stored else ca.SX(0, 1)
    states = ca.vertcat(graph.xi, kept)
    prepare = Tape.of([graph.m, states], [c, N])
    tanh = tanh or default_tanh(precision)
    bounds = _largest_coefficients(graph, h)
    values = {symbol.name(): value for symbol, value in graph.constants}
    moving = {s.name: len(graph.names) + k for k, s in enumerate(stored)}
    return ControlLaw(
        interface.name,
        graph.law.name,
        precision,
        h,
        interface.inputs,
        interface.outputs,
        (
            *(Signal(name, "", _meaning(name)) for name in graph.names),
            *(Signal(s.name, s.unit, s.meaning) for s in stored),
        ),
        prepare,
        Tape.of([graph.m, states, graph.t], [ca.vertcat(following, kept), output]),
        choose_solves(prepare, precision, tanh, bounds),
        interface.intervals,
        interface.equilibrium_output,
        Fallback.LAST_OUTPUT if holds else Fallback.EQUILIBRIUM,
        interface.ranges,
        tanh,
        kept=tuple(approximate(values[s.symbol.name()]) for s in stored),
        equilibrium_states=tuple(moving.get(str(u)) for u in ca.vertsplit(graph.equilibrium_input)),
        setters=_setters(graph, stored),
        coefficient_bounds=bounds,
        rest=interface.rest,
        start=Tape.of([graph.m, states], [ca.vertcat(start, kept)]),
    )


def _setters(graph: LawGraph, stored: Sequence[Stored]) -> tuple[Setter, ...]:
    """The functions that change what is stored, one for each group of settings."""
    settings, first = graph.settings, len(graph.names)
    result = []
    for group in ("target", "gains"):
        own: list[Setting] = [s for s in settings.settings if s.group == group]
        positions = [k for k, s in enumerate(stored) if s.group == group]
        if not own or not positions:
            continue
        expressions = ca.vertcat(*[stored[k].expression for k in positions])
        if settings.moving is not None:
            expressions = settings.moving.with_numbers(expressions)
        inputs = tuple(SetterInput(Signal(s.name, s.unit), (s.range.lo, s.range.hi), s.value) for s in own)
        compute = Tape.of([ca.vertcat(*[s.symbol for s in own])], [expressions])
        result.append(Setter(group, inputs, tuple(first + k for k in positions), compute))
    return tuple(result)


def _largest_coefficients(graph: LawGraph, h: Fraction) -> dict[int, Fraction]:
    """By channel, a bound of N's diagonal over all measurements and settings, where it is no constant and has one."""
    ranges = {s.symbol.name(): s.range for s in graph.settings.settings if s.group == "gains"}
    if not ranges:
        return {}
    N = ca.diag(graph.discretise(h).N)
    tape = Tape.of([graph.m, graph.xi, ca.vertcat(*[symbol for symbol, _ in graph.constants])], [N])
    unknown: list[list[Real]] = [[undefined()] * graph.m.numel(), [undefined()] * graph.xi.numel()]
    given = [
        enclose(ranges[symbol.name()].lo, ranges[symbol.name()].hi) if symbol.name() in ranges else value
        for symbol, value in graph.constants
    ]
    with precision(BITS):
        entries = tape.walk(REAL, [*unknown, given])[0].dense(ZERO)
    return {k: upper(row[0]) for k, row in enumerate(entries) if is_finite(row[0])}


_STATE_MEANING = {
    "x_c": "state of the filter (dxc) that injects damping",
    "x_l": "state of the filter (dxl) on the naturally damped coordinates",
    "psi": "state of the filter (dpsi) that removes the steady-state error",
}


def _meaning(state: str) -> str:
    return next(meaning for prefix, meaning in _STATE_MEANING.items() if state.startswith(prefix))
