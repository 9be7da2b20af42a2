"""The plant printed as C beside the generated controller, integrated by ROS2, a linearly implicit method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from jinja2 import Template

from pbcgen.emit.expressions import Graph, Printer, Statement
from pbcgen.emit.literals import literal
from pbcgen.emit.templating import templates_in
from pbcgen.errors import UnsupportedOperation
from pbcgen.law.closed_loop import ROS2
from pbcgen.run.wrapper import Interface
from pbcgen.symbolic.tape import Tape

if TYPE_CHECKING:
    from pbcgen.law.closed_loop import ClosedLoop
    from pbcgen.models.design import Design


@dataclass(frozen=True)
class _Function:
    """A C function of (x, u, p): its statements, and the text of each result."""

    name: str
    statements: tuple[Statement, ...]
    results: tuple[tuple[int, str], ...]


def loops_source(design: Design, loop: ClosedLoop, interface: Interface, frictions: Sequence[str]) -> str:
    """The C that runs closed loops of the plant with the package, whose source it includes.

    Args:
        design: the system and its target.
        loop: the equilibrium.
        interface: of the package.
        frictions: the states on which dry friction acts.

    Raises UnsupportedOperation if the model has an operation without a C form.
    """
    system = design.system
    momenta = [system.state_names.index(name) for name in frictions]
    storage = _gradient(design)
    speeds = [e for k in momenta for e in (storage[k], ca.gradient(storage[k], system.x[k]))]
    errors = [c.expression - float(c.value) for c in design.target.conditions]
    functions = [
        _printed(design, "plant_field", system.xdot),
        _printed(design, "plant_jacobian", ca.vec(ca.densify(ca.jacobian(system.xdot, system.x)).T)),
        _printed(design, "plant_sensors", system.measured_expressions),
        _printed(design, "plant_errors", ca.vertcat(*errors)),
    ]
    if momenta:
        functions.append(_printed(design, "plant_speeds", ca.vertcat(*speeds)))
    return _template().render(
        prefix=interface.prefix,
        scalar=interface.precision,
        n=system.n,
        m=system.m,
        measured=len(system.measured_names),
        parameters=len(system.parameters),
        targets=len(errors),
        frictions=len(momenta),
        friction_rows=momenta,
        functions=functions,
        inputs=interface.inputs,
        outputs=interface.outputs,
        x_star=[literal(np.float64(v)) for v in loop.x_star],
        u_star=[literal(np.float64(v)) for v in loop.u_star],
        gamma=repr(ROS2),
    )


@cache
def _template() -> Template:
    return templates_in(Path(__file__).parent).get_template("loops.c.j2")


def _gradient(design: Design) -> list[ca.SX]:
    """dS/dx; for a mechanical system the speeds are its entries at the momenta."""
    mechanics = design.system.mechanical
    gradient = mechanics.energy_gradient if mechanics is not None else ca.gradient(design.system.S, design.system.x)
    return list(ca.vertsplit(ca.densify(gradient)))


def _printed(design: Design, name: str, expression: ca.SX) -> _Function:
    """A function (x, u, p) -> out; entries that are zero for every argument are written too."""
    system = design.system
    parameters = ca.SX(system.parameters.symbols)
    tape = Tape.of([system.x, system.u, parameters], [ca.densify(ca.vec(expression))])
    graph = Graph()
    sizes = (("x", system.n), ("u", system.m), ("p", len(system.parameters)))
    inputs = [[graph.name(f"{letter}[{k}]") for k in range(count)] for letter, count in sizes]
    try:
        (outputs,) = tape.walk(graph, inputs)
    except UnsupportedOperation as error:
        raise UnsupportedOperation(f"the plant cannot be written in C: {error}") from error
    roots = outputs.column(graph.const(Fraction(0)))
    printer = Printer(graph, "double", "plant", roots)
    unknown = printer.helpers - {"tanh", "cosh"}
    if unknown:
        raise UnsupportedOperation(f"the plant cannot be written in C: it needs `{min(unknown)}`")
    statements, texts = printer.stage(roots)
    return _Function(name, statements, tuple(enumerate(texts)))
