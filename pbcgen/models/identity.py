"""The identity of a design: a deterministic text of everything that decides the controller, and its hash."""

from __future__ import annotations

import hashlib
from fractions import Fraction
from typing import TYPE_CHECKING

from pbcgen.models.laws import Integral, Law, gains
from pbcgen.symbolic.tape import Constant, Input, Instruction, Operation, Tape

if TYPE_CHECKING:
    from collections.abc import Iterator

    import casadi as ca

    from pbcgen.models.affine import AffineSystem, Interval
    from pbcgen.models.design import Design


def canonical_text(design: Design) -> str:
    """Expressions as numbered instructions, and every exact value, one a line.

    The name, the description, the initial state and the duration are left out: they do not change the controller.
    """
    return "\n".join(_lines(design)) + "\n"


def model_hash(design: Design) -> str:
    """SHA-256 of :func:`canonical_text`, in hexadecimal."""
    return hashlib.sha256(canonical_text(design).encode()).hexdigest()


def _lines(design: Design) -> Iterator[str]:
    system = design.system
    yield "pbcgen design 1"
    yield f"states {' '.join(system.state_names)}"
    yield f"inputs {' '.join(system.input_names)}"
    yield f"measured {' '.join(system.measured_names)}"
    yield from (f"unit {name} {unit!r}" for name, unit in system.units.items())
    yield from (f"parameter {name} = {value}" for name, value in system.parameters.values.items())
    yield from (f"domain {name} {_interval(bounds)}" for name, bounds in system.domain.items())
    yield from _expressions(design)
    yield from (f"target {c.name} = {c.value}" for c in design.target.conditions)
    yield from (f"near {name} = {design.near[name]}" for name in system.state_names if name in design.near)
    yield from _law(design.law)
    yield from (f"adjustable target {name} {r.lo} {r.hi}" for name, r in design.target_box.items())
    for name, ranges in design.gain_ranges.items():
        yield from (f"adjustable gain {name} {i + 1} {r.lo} {r.hi}" for i, r in enumerate(ranges))
    yield from _limits(design)
    yield f"sample period {design.sample_period}"
    if design.delay:
        yield f"delay {design.delay}"
    if design.jitter:
        yield f"jitter {design.jitter}"
    yield f"precision {design.precision}"


def _law(law: Law) -> Iterator[str]:
    base = f" on {law.base.name}" if isinstance(law, Integral) else ""
    yield f"law {law.name}{base}"
    for name, value in gains(law).items():
        yield f"gain {name} = {_numbers(value)}"


def _limits(design: Design) -> Iterator[str]:
    allowed = design.input_set
    for name, bounds in zip(design.system.input_names, allowed.intervals, strict=True):
        yield f"limit {name} {_interval(bounds)}"
    for row, bound in zip(allowed.A, allowed.b, strict=True):
        yield f"limit {_numbers(row)} u <= {bound}"


def _expressions(design: Design) -> Iterator[str]:
    named = _named_expressions(design.system)
    named |= {f"target {c.name}": c.expression for c in design.target.conditions}
    tape = Tape.of([design.system.x, design.system.parameters.symbols], list(named.values()))
    for position, instruction in enumerate(tape.instructions):
        yield f"  {position} {_instruction(instruction)}"
    for name, matrix in zip(named, tape.outputs, strict=True):
        entries = " ".join(f"{row},{col}:{at}" for (row, col), at in sorted(matrix.entries.items()))
        yield f"{name} {matrix.shape[0]}x{matrix.shape[1]} {entries}".rstrip()


def _named_expressions(system: AffineSystem) -> dict[str, ca.SX]:
    named = {"f": system.f, "g": system.g, "S": system.S, "measurement": system.measured_expressions}
    if system.gamma is not None:
        named["gamma"] = system.gamma
    if system.eta is not None:
        named["eta"] = system.eta
    return named


def _instruction(instruction: Instruction) -> str:
    match instruction:
        case Constant(value):
            return f"constant {value}"
        case Input(argument, index):
            return f"{('state', 'parameter')[argument]} {index}"
        case Operation(name, operands):
            return f"{name} {' '.join(str(operand) for operand in operands)}"


def _interval(bounds: Interval) -> str:
    return " ".join("unbounded" if bound is None else str(bound) for bound in bounds)


def _numbers(value: object) -> str:
    if isinstance(value, Fraction):
        return str(value)
    if isinstance(value, tuple):
        return f"[{' '.join(_numbers(entry) for entry in value)}]"
    raise TypeError(f"{value!r} is no number")
