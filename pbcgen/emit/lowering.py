"""From a control law to the tree of :mod:`pbcgen.emit.program`: all decisions about the C are made here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from pbcgen.emit.expressions import LIBRARY, Graph, Node, Printer, Statement
from pbcgen.emit.identifiers import Scope
from pbcgen.emit.literals import literal
from pbcgen.emit.program import (
    Body,
    Constants,
    FastTanh,
    InputMember,
    OutputMember,
    Program,
    SetterFunction,
    SettingMember,
    StartFunction,
    StateMember,
)
from pbcgen.emit.selftest import self_test
from pbcgen.emit.solves import Coefficients, SolverFunctions, calls_of, constant_mus, t_names_of
from pbcgen.errors import EmitError
from pbcgen.law.arithmetic import Precision
from pbcgen.law.hyperbolic import COSH, DENOMINATOR, DOUBLINGS, FAST_ERROR, FAST_ULP, LIBM_ULP, NUMERATOR
from pbcgen.law.law import (
    ControlLaw,
    Fallback,
    ScalarSolve,
    Setter,
    Signal,
)
from pbcgen.law.rounding import DTYPES, STATE_LIMIT, inward, nearest
from pbcgen.law.step import channels_to_check, check_solves, equilibrium_output, initial_state, setting_bounds
from pbcgen.symbolic.tape import Matrix


@dataclass(frozen=True)
class Extras:
    """Functions that a package has on demand.

    Attributes:
        start: ``<p>_start_at``, a start without a jump.
        selftest: ``<p>_selftest``, a comparison with expected outputs.
    """

    start: bool = False
    selftest: bool = False


def program_of(law: ControlLaw, prefix: str, extras: Extras = Extras()) -> Program:
    """Lower ``law`` to C texts. Raises EmitError for what cannot be written, ValueError for an inconsistent law."""
    if not law.inputs or not law.outputs:
        raise EmitError(f"the law of `{law.name}` has no inputs or no outputs: there is nothing to step")
    check_solves(law)
    scope = _state_scope(law)
    outputs = _outputs(law, scope)
    members = _Members(_inputs(law), outputs, _states(law, outputs, scope))
    setters = tuple(_setter(law, prefix, setter, members) for setter in law.setters)
    functions = SolverFunctions.of(law, prefix, constant_mus(law))
    return Program(
        prefix=prefix,
        constants=constants_of(law.precision),
        sample_period=literal(nearest(law.sample_period, law.precision, "the sample period")),
        inputs=members.inputs,
        outputs=members.outputs,
        states=members.states,
        state_checks=_state_checks(members),
        read=tuple(text for vector in reversed(members.texts()) for text in vector),
        fast_tanh=_fast_tanh(law.precision) if law.tanh == "fast" else None,
        library_ulp=f"{LIBM_ULP[law.precision]:g}",
        fitted_functions=tuple(functions.fitted.values()),
        scalar_functions=tuple(functions.scalar.values()),
        block_functions=tuple(functions.block.values()),
        body=_body(law, prefix, members, functions),
        renamed=_renamed(members, setters),
        setters=setters,
        start=_start(law, prefix, members) if extras.start else None,
        selftest=self_test(law) if extras.selftest else None,
    )


@dataclass(frozen=True)
class _Members:
    """The members of the three structs."""

    inputs: tuple[InputMember, ...]
    outputs: tuple[OutputMember, ...]
    states: tuple[StateMember, ...]

    @property
    def memory(self) -> tuple[StateMember, ...]:
        """The controller states xi."""
        return tuple(member for member in self.states if member.is_memory)

    def texts(self) -> list[list[str]]:
        """M and xi in C."""
        return [
            [f"input->{member.c_name}" for member in self.inputs],
            [f"state->{member.c_name}" for member in self.memory],
        ]

    def arguments(self, graph: Graph) -> list[list[Node]]:
        """M and xi as the step reads them."""
        return [[graph.name(text) for text in vector] for vector in self.texts()]


def constants_of(precision: Precision) -> Constants:
    """The notation of ``precision``."""

    def real(text: str) -> str:
        return literal(nearest(Fraction(text), precision))

    return Constants(
        real=precision,
        f="f" if precision == "float" else "",
        zero=real("0"),
        half=real("0.5"),
        one=real("1"),
        largest=literal(np.finfo(DTYPES[precision]).max),
        four=real("4"),
        state_limit=literal(nearest(STATE_LIMIT[precision], precision)),
        square_limit=literal(nearest(STATE_LIMIT[precision] ** 2, precision)),
        erfinv_small=real("0.05"),
        erfinv_slope=real("0.88622692545275801365"),
        erfinv_shift=real("4.3307467508"),
        erfinv_scale=real("13.605442177"),
    )


def _inputs(law: ControlLaw) -> tuple[InputMember, ...]:
    scope = Scope()
    return tuple(InputMember(s, scope.claim(s.name), law.ranges.get(s.name)) for s in law.inputs)


def _state_scope(law: ControlLaw) -> dict[str, str]:
    """The C names of the controller's states; held outputs have the first choice."""
    scope = Scope()
    if law.fallback is Fallback.LAST_OUTPUT:
        outputs = Scope()
        scope.taken |= {f"last_{outputs.claim(signal.name)}" for signal in law.outputs}
    return {signal.name: scope.claim(signal.name) for signal in law.states}


def _outputs(law: ControlLaw, state_names: Mapping[str, str]) -> tuple[OutputMember, ...]:
    scope, macros = Scope(), Scope()
    members = []
    positions = law.equilibrium_states or (None,) * len(law.outputs)
    rows = zip(law.outputs, law.intervals, equilibrium_output(law), positions, strict=True)
    for signal, interval, equilibrium, position in rows:
        name = scope.claim(signal.name)
        low, high = inward(interval, law.precision, f"the interval of `{signal.name}`")
        fallback = literal(equilibrium)
        if law.fallback is Fallback.LAST_OUTPUT:
            fallback = f"state->last_{name}"
        elif position is not None:
            fallback = f"state->{state_names[law.states[position].name]}"
        members.append(
            OutputMember(
                signal=signal,
                c_name=name,
                macro=macros.claim(name.strip("_").upper()),
                interval=interval,
                low=literal(low),
                high=literal(high),
                equilibrium=literal(equilibrium),
                fallback=fallback,
                next=f"out_{name}",
            )
        )
    return tuple(members)


def _states(law: ControlLaw, outputs: Sequence[OutputMember], names: Mapping[str, str]) -> tuple[StateMember, ...]:
    """The controller states and, where the law holds its last output, the outputs."""
    held = []
    if law.fallback is Fallback.LAST_OUTPUT:
        for output in outputs:
            name = f"last_{output.c_name}"
            signal = Signal(name, output.signal.unit, "last valid output")
            held.append(StateMember(signal, name, output.equilibrium, f"output->{output.c_name}", "held output"))
    memory = []
    first = len(law.states) - len(law.kept)
    for k, (signal, value) in enumerate(zip(law.states, initial_state(law), strict=True)):
        role = "state" if k < first else "setting"
        memory.append(StateMember(signal, names[signal.name], literal(value), f"next_{names[signal.name]}", role))
    return (*memory, *held)


def _state_checks(members: _Members) -> tuple[str, ...]:
    """The state's numbers that must be bounded."""
    return tuple(f"state->{state.c_name}" for state in members.memory)


def _fast_tanh(precision: Precision) -> FastTanh:
    def texts(coefficients: Sequence[float]) -> tuple[str, ...]:
        return tuple(literal(DTYPES[precision](value)) for value in reversed(coefficients))

    return FastTanh(
        texts(NUMERATOR[precision]),
        texts(DENOMINATOR[precision]),
        f"{FAST_ULP[precision]:g}",
        f"{FAST_ERROR[precision]:g}",
        texts(COSH) if precision == "float" else (),
        DOUBLINGS,
    )


def _renamed(members: _Members, setters: Sequence[SetterFunction]) -> tuple[tuple[str, str], ...]:
    everything: tuple[InputMember | OutputMember | StateMember | SettingMember, ...] = (
        *members.inputs,
        *members.outputs,
        *members.states,
        *(member for setter in setters for member in setter.inputs),
    )
    return tuple(sorted({(m.signal.name, m.c_name) for m in everything if m.signal.name != m.c_name}))


def _body(law: ControlLaw, prefix: str, members: _Members, functions: SolverFunctions) -> Body:
    graph = Graph()
    zero = graph.const(Fraction(0))
    t_names = t_names_of(law)
    c, N = law.prepare.walk(graph, members.arguments(graph))
    coefficients = Coefficients.of(law, prefix, N, zero)
    prepare_roots = {f"c{i}": root for i, root in enumerate(c.column(zero))} | coefficients.roots
    update_roots = _update_roots(law, graph, members, t_names)
    early = _library_calls(graph, list(update_roots.values()), t_names) if law.channels else []
    printer = Printer(graph, law.precision, prefix, [*prepare_roots.values(), *update_roots.values()], early)
    called, _ = printer.stage(early)
    scalars, blocks = calls_of(law, functions, coefficients.texts, t_names)
    return Body(
        prepare=(*called, *_named_stage(printer, prepare_roots)),
        prepare_checks=(
            *(f"{prefix}_is_finite(c{i})" for solve in law.solves for i in channels_to_check(solve)),
            *coefficients.checks,
        ),
        scalars=scalars,
        blocks=blocks,
        update=_named_stage(printer, update_roots),
        results=tuple(name for name, root in update_roots.items() if not _is_limited(root)),
        helpers=printer.helpers | _tanh_functions(law),
    )


def _library_calls(graph: Graph, roots: Sequence[Node], t_names: Sequence[str]) -> list[Node]:
    """Calls of the math library that need no t: made first, while few numbers wait on the stack for their return."""
    late: set[int] = set()
    calls = []
    for node in graph.reachable(roots):  # operands first
        if node.text in t_names or any(id(operand) in late for operand in node.operands):
            late.add(id(node))
        elif node.operation in LIBRARY:
            calls.append(node)
    return calls


def _is_limited(node: Node) -> bool:
    """Whether a value is cut to an interval that is small beside the limit of the state, so that no check can fail."""
    bound = node.operands[1].value if node.operation == "limit" else None
    return bound is not None and bound <= 2**32


def _tanh_functions(law: ControlLaw) -> set[str]:
    """``tanh``, if a solve calls it."""
    fits = [solve.fit if isinstance(solve, ScalarSolve) else None for solve in law.solves]
    return set() if all(fit and fit.pieces for fit in fits) else {"tanh"}


def _update_roots(law: ControlLaw, graph: Graph, members: _Members, t_names: Sequence[str]) -> dict[str, Node]:
    """The next states and the unclamped outputs, by local variable."""
    zero = graph.const(Fraction(0))
    t = [graph.name(name) for name in t_names]
    next_xi, u = law.update.walk(graph, [*members.arguments(graph), t])
    following = zip(members.memory, next_xi.column(zero), strict=True)
    roots = {member.next: root for member, root in following if member.role == "state"}
    return roots | dict(zip([member.next for member in members.outputs], u.column(zero), strict=True))


def _setter(law: ControlLaw, prefix: str, setter: Setter, members: _Members) -> SetterFunction:
    """The function that changes what the state stores."""
    scope, macros = Scope(), Scope({member.macro for member in members.outputs})
    inputs = []
    for item in setter.inputs:
        name = scope.claim(item.signal.name)
        accepted, proved = setting_bounds(item, law.precision)
        clamp = None if accepted == proved else (literal(proved[0]), literal(proved[1]))
        low, high = accepted
        start = nearest(item.value, law.precision, f"the value of `{item.signal.name}`")
        macro = macros.claim(f"{setter.group}_{name.strip('_')}".upper())
        inputs.append(
            SettingMember(item.signal, name, macro, item.range, literal(low), literal(high), literal(start), clamp)
        )
    graph = Graph()
    arguments = [
        graph.name(f"given_{member.c_name}" if member.clamp else f"{setter.group}->{member.c_name}")
        for member in inputs
    ]
    (stored,) = setter.compute.walk(graph, [arguments])
    body, stores, helpers = _storing(law, prefix, graph, [members.states[k] for k in setter.states], stored)
    return SetterFunction(setter.group, tuple(inputs), body, stores, helpers)


def _start(law: ControlLaw, prefix: str, members: _Members) -> StartFunction | None:
    """The function that starts the controller without a jump; None for a law without filters."""
    own = [(k, member) for k, member in enumerate(members.states) if member.role == "state"]
    if law.start is None or not own:
        return None
    graph = Graph()
    (started,) = law.start.walk(graph, members.arguments(graph))
    zero = graph.const(Fraction(0))
    rows = Matrix((len(own), 1), {(k, 0): started.column(zero)[k] for k, _ in own})
    return StartFunction(*_storing(law, prefix, graph, [member for _, member in own], rows))


def _storing(
    law: ControlLaw, prefix: str, graph: Graph, targets: Sequence[StateMember], values: Matrix[Node]
) -> tuple[tuple[Statement, ...], tuple[tuple[str, str], ...], frozenset[str]]:
    """Statements that compute values, (member, local variable) of each, and the helpers they call."""
    roots = dict(zip([f"new_{t.c_name}" for t in targets], values.column(graph.const(Fraction(0))), strict=True))
    printer = Printer(graph, law.precision, prefix, list(roots.values()))
    body = _named_stage(printer, roots)
    return body, tuple((t.c_name, root) for t, root in zip(targets, roots, strict=True)), printer.helpers


def _named_stage(printer: Printer, roots: Mapping[str, Node]) -> tuple[Statement, ...]:
    """Statements that end by giving each root its name."""
    statements, texts = printer.stage(list(roots.values()))
    return (*statements, *(Statement(name, text) for name, text in zip(roots, texts, strict=True)))
