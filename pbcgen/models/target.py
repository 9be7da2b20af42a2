"""Where the system shall rest, as the user asks for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi as ca

from pbcgen.errors import ModelError
from pbcgen.models.affine import AffineSystem
from pbcgen.models.exact import Number, exact
from pbcgen.models.expressions import check_finite, check_symbols, depends, entries, shaped, suggestion


@dataclass(frozen=True, eq=False)
class Condition:
    """One requirement on x*: ``expression(x*) = value``."""

    name: str
    expression: ca.SX
    value: Fraction


@dataclass(frozen=True, eq=False)
class Target:
    """Where the system shall rest.

    Attributes:
        conditions: what the user asked for, one condition for each state or expression.
        full: x* when the conditions give every state (for a mechanical system: every position), else None.
    """

    conditions: tuple[Condition, ...]
    full: tuple[Fraction, ...] | None = None


#: What a user may write for a target: all n values (None leaves one open), values by state or measured name, or a
#: new name with a pair (expression, value).
TargetLike = Target | Sequence[Number | None] | Mapping[str, Any]


def target_of(target: TargetLike, system: AffineSystem) -> Target:
    """The target that a user wrote for a system.

    Raises ModelError for a name or an expression that is not the system's, and where nothing is asked for.
    """
    if isinstance(target, Target):
        conditions = [_condition(c.name, (c.expression, c.value), system) for c in target.conditions]
        return Target(tuple(conditions), _full(conditions, system))
    if isinstance(target, Mapping):
        items = dict(target)
    elif isinstance(target, Sequence) and not isinstance(target, str):
        items = {name: value for name, value in in_order(target, system, "the target").items() if value is not None}
    else:
        raise ModelError(f"the target is {target!r}: values in the order of the states, or a mapping, was expected")
    if not items:
        raise ModelError("the target is empty: give at least one value that x* shall have")
    conditions = [_condition(name, value, system) for name, value in items.items()]
    return Target(tuple(conditions), _full(conditions, system))


def _condition(name: object, value: Any, system: AffineSystem) -> Condition:
    states = dict(zip(system.state_names, entries(system.x), strict=True))
    signals = {**states, **system.measured}
    what = f"the target `{name}`"
    if isinstance(value, tuple | list):
        if len(value) != 2:
            raise ModelError(f"{what} is {value!r}: a pair (expression, value) was expected")
        expression, number = shaped(value[0], (1, 1), what), value[1]
        if name in states and not ca.is_equal(expression, states[str(name)]):
            raise ModelError(f"{what} has the name of a state but another expression: rename it")
    elif name in signals:
        expression, number = signals[str(name)], value
    else:
        raise ModelError(
            f"{what} is neither a state nor a measured signal: {suggestion(name, signals)} "
            "(for another quantity give a pair (expression, value))"
        )
    check_symbols(expression, (system.x, system.parameters.symbols), what, system.u, "the input")
    check_finite(expression, what)
    if not depends(expression, system.x):
        raise ModelError(f"{what} does not depend on the state: it cannot be controlled")
    return Condition(str(name), expression, exact(number, what))


def _full(conditions: Sequence[Condition], system: AffineSystem) -> tuple[Fraction, ...] | None:
    """All of x* if the conditions name every state; at rest the momenta of a mechanical system are zero."""
    values = {c.name: c.value for c in conditions}
    if system.mechanical is not None:
        momenta = {entry.name(): Fraction(0) for entry in entries(system.mechanical.p)}
        values = {**momenta, **values}
    if any(name not in values for name in system.state_names):
        return None
    return tuple(values[name] for name in system.state_names)


def in_order(values: Sequence[Any], system: AffineSystem, what: str) -> dict[str, Any]:
    """Values by state name from a sequence of n (for a mechanical system also of the positions only).

    Raises ModelError, which calls the sequence ``what``, for another number of values.
    """
    lengths = [system.n] if system.mechanical is None else [system.n, system.n // 2]
    if len(values) not in lengths:
        expected = " or ".join(str(length) for length in lengths)
        raise ModelError(f"{what} has {len(values)} values: {expected} were expected ({', '.join(system.state_names)})")
    return dict(zip(system.state_names, values, strict=False))
