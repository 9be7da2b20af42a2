"""The input-affine system that every front end lowers to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from types import MappingProxyType
from typing import Any

import casadi as ca

from pbcgen.errors import ModelError
from pbcgen.models.exact import Number, decimal, exact
from pbcgen.models.expressions import (
    by_name,
    check_finite,
    check_symbols,
    column,
    depends,
    entries,
    names,
    shaped,
    suggestion,
    symbols,
    unique,
)
from pbcgen.models.numbers import is_long, named_numbers
from pbcgen.models.parameters import Parameters
from pbcgen.models.source import Call, users_call

#: Exact bounds of a quantity; None is unbounded.
Interval = tuple[Fraction | None, Fraction | None]

#: What a user may write for an interval.
IntervalLike = tuple[Number | None, Number | None] | Sequence[Number | None]

#: What messages call the functions of a system.
_DRIFT, _INPUT_MATRIX, _STORAGE = "the drift f", "the input matrix g", "the storage S"

#: What a user may write for the measured signals: state names, and named expressions.
MeasuredLike = str | Mapping[str, Any] | Sequence[str | Mapping[str, Any]]


@dataclass(frozen=True, eq=False)
class Mechanics:
    """The parts of a mechanical system (phmec).

    Attributes:
        q, p: positions and momenta, n x 1 symbols.
        M, M_inv: inertia matrix and its inverse, n x n functions of q.
        V: potential energy, a scalar function of q.
        D: diagonal damping matrix, n x n function of (q, p).
        G: input matrix, n x m function of q.
        velocity: M^-1 p, n x 1.
        energy_gradient: the gradient of H = p^T M^-1 p / 2 + V in (q, p), 2n x 1, as it occurs in f.
        factors: pairs (J_i, W_i) with ``M = sum J_i^T W_i J_i``, if M is known to be such a sum.
    """

    q: ca.SX
    p: ca.SX
    M: ca.SX
    M_inv: ca.SX
    V: ca.SX
    D: ca.SX
    G: ca.SX
    velocity: ca.SX
    energy_gradient: ca.SX
    factors: tuple[tuple[ca.SX, ca.SX], ...] = ()


@dataclass(frozen=True, eq=False)
class Brayton:
    """The parts of a Brayton-Moser circuit (BMrlc), (PQtilde).

    Attributes:
        Q: blkdiag(-L, C), n x n.
        P: the mixed potential (POT), or None where it is not known in closed form.
        P_gradient: the gradient of P, n x 1.
        P_hessian: the Hessian of P, n x n.
        Xi: blkdiag(L^-1, C^-1), n x n.
        Q_tilde: P_hessian Xi Q, n x n.
        g_tilde: blkdiag(g_L, g_C), n x m.
        currents: the number of inductors; the first entries of x are their currents.
    """

    Q: ca.SX
    P: ca.SX | None
    P_gradient: ca.SX
    P_hessian: ca.SX
    Xi: ca.SX
    Q_tilde: ca.SX
    g_tilde: ca.SX
    currents: int


@dataclass(frozen=True, eq=False)
class Structure:
    """How f and grad S hang together, as far as a front end knows it by construction.

    Attributes:
        F: n x n with ``f = F(x) grad S(x)``, or None.
        A: n x n with ``grad S(x) = A(x) f(x)``, or None.
        mechanical: the parts of a mechanical system, or None.
        circuit: the parts of a circuit, or None.
    """

    F: ca.SX | None = None
    A: ca.SX | None = None
    mechanical: Mechanics | None = None
    circuit: Brayton | None = None


@dataclass(frozen=True, eq=False, init=False)
class AffineSystem:
    """A physical system ``x' = f(x) + g(x) u`` (afsys) with a storage function S(x).

    Attributes:
        x: state, n x 1 symbols. The symbols' names are the state names.
        u: input, m x 1 symbols.
        f: drift, n x 1.
        g: input matrix, n x m.
        S: storage function, scalar.
        parameters: the constants that occur, with their values.
        domain: exact bounds by state name; a state without entry is unbounded.
        gamma: a known function with gamma' = y, m x 1, or None to have it derived.
        eta: known naturally damped coordinates (Assumption 3), s x 1, or None.
        measured: what the controller reads: expressions in x by name.
        units: units by name of state, input or measured signal.
        name: how reports call the system.
        structure: what a front end knows about f and grad S.
        long_numbers: numbers in the expressions that look like results of a rounded computation.
        call: where the user made it, if in a file.
    """

    x: ca.SX
    u: ca.SX
    f: ca.SX
    g: ca.SX
    S: ca.SX
    parameters: Parameters
    domain: Mapping[str, Interval]
    gamma: ca.SX | None
    eta: ca.SX | None
    measured: Mapping[str, ca.SX]
    units: Mapping[str, str]
    name: str
    structure: Structure | None
    long_numbers: tuple[float, ...]
    call: Call | None

    def __init__(
        self,
        x: Any,
        u: Any,
        f: Any,
        g: Any,
        S: Any,
        *,
        parameters: Parameters | None = None,
        domain: Mapping[str, IntervalLike] | None = None,
        gamma: Any = None,
        eta: Any = None,
        measured: MeasuredLike | None = None,
        units: Mapping[str, str] | None = None,
        name: str = "",
        structure: Structure | None = None,
    ) -> None:
        """Check and store the system; see the class for shapes.

        Args:
            x: SX column, or list of SX symbols.
            u: SX column, or list of SX symbols.
            f: SX column, or list of expressions in x and the parameters.
            g: SX matrix, or list of rows; for m = 1 a column or a list.
            S: scalar expression in x and the parameters.
            parameters: the constants that occur.
            domain: (lo, hi) by state name; None is unbounded.
            gamma: known gamma(x), m entries.
            eta: known eta(x).
            measured: state names and/or named expressions; all states if not given.
            units: units by name of state, input or measured signal.
            name: how reports call the system.
            structure: what is known about f and grad S.

        Raises:
            ModelError: naming what is wrong: a shape, a free symbol, a dependence on u, a name used twice or not
                known, an empty interval, a constant that is not finite, MX in the place of SX.
        """
        x, u, parameters = _variables(x, u, parameters)
        n, m = x.numel(), u.numel()
        signals = _measured(measured, x)
        functions = {
            _DRIFT: shaped(f, (n, 1), _DRIFT),
            _INPUT_MATRIX: shaped(g, (n, m), _INPUT_MATRIX),
            _STORAGE: shaped(S, (1, 1), _STORAGE),
            **{_signal_name(key): value for key, value in signals.items()},
        }
        if gamma is not None:
            functions["gamma"] = shaped(gamma, (m, 1), "gamma")
        if eta is not None:
            functions["eta"] = column(eta, "eta")
        for what, value in functions.items():
            check_symbols(value, (x, parameters.symbols), what, u, "the input")
            check_finite(value, what)
        taken = [*names(x), *names(u), *(key for key in signals if key not in names(x))]
        unique([*taken, *parameters.names])
        own = [*functions][0 if structure is None else 3 :]  # a front end has named the numbers of f, g and S
        named, every = named_numbers([functions[what] for what in own], "c", parameters, taken)
        added = [value for key, value in every.values.items() if key not in parameters]
        functions |= zip(own, named, strict=True)
        if not depends(functions[_STORAGE], x):
            raise ModelError(
                "the storage S does not depend on the state: give the energy, or another function that does not grow "
                "by itself"
            )
        fields = {
            "x": x,
            "u": u,
            "f": functions[_DRIFT],
            "g": functions[_INPUT_MATRIX],
            "S": functions[_STORAGE],
            "parameters": every,
            "domain": MappingProxyType(_domain(by_name(domain, "domain"), names(x))),
            "gamma": functions.get("gamma"),
            "eta": functions.get("eta"),
            "measured": MappingProxyType({key: functions[_signal_name(key)] for key in signals}),
            "units": MappingProxyType(_units(by_name(units, "units"), taken)),
            "name": name,
            "structure": structure,
            "long_numbers": tuple(float(v) for v in added if structure is None and is_long(v)),
            "call": users_call(),
        }
        for key, value in fields.items():
            object.__setattr__(self, key, value)

    @property
    def n(self) -> int:
        """The number of states."""
        return int(self.x.numel())

    @property
    def m(self) -> int:
        """The number of inputs."""
        return int(self.u.numel())

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """The names of the states, in the order of x."""
        return names(self.x)

    @cached_property
    def input_names(self) -> tuple[str, ...]:
        """The names of the inputs, in the order of u."""
        return names(self.u)

    @property
    def measured_names(self) -> tuple[str, ...]:
        """The names of the measured signals, in the order of the controller's input."""
        return tuple(self.measured)

    @property
    def measured_expressions(self) -> ca.SX:
        """The measured signals as an SX column in x and the parameters."""
        return ca.vertcat(*self.measured.values())

    @property
    def xdot(self) -> ca.SX:
        """``f(x) + g(x) u``, n x 1."""
        return self.f + ca.mtimes(self.g, self.u)

    @property
    def mechanical(self) -> Mechanics | None:
        """The parts of a mechanical system, if the model is one."""
        return self.structure.mechanical if self.structure else None

    @property
    def circuit(self) -> Brayton | None:
        """The parts of a circuit, if the model is one."""
        return self.structure.circuit if self.structure else None

    def lower(self) -> AffineSystem:
        """The system itself, so that every front end has this method."""
        return self


def _variables(x: Any, u: Any, parameters: Parameters | None) -> tuple[ca.SX, ca.SX, Parameters]:
    if parameters is None:
        parameters = Parameters()
    if not isinstance(parameters, Parameters):
        raise ModelError(f"parameters is a {type(parameters).__name__}: a pbcgen.Parameters(...) was expected")
    x, u = symbols(x, "the state x"), symbols(u, "the input u")
    for value, what in ((x, "state x"), (u, "input u")):
        if value.numel() == 0:
            raise ModelError(f"the {what} is empty")
    if u.numel() > x.numel():
        raise ModelError(f"there are {u.numel()} inputs and only {x.numel()} states: g cannot have full column rank")
    return x, u, parameters


def _measured(measured: MeasuredLike | None, x: ca.SX) -> dict[str, ca.SX]:
    states = dict(zip(names(x), entries(x), strict=True))
    if measured is None:
        return states
    items = [measured] if isinstance(measured, str | Mapping) else measured
    if not isinstance(items, Iterable):
        raise ModelError(f"`measured` is {measured!r}: names of states, or a mapping of name to expression, expected")
    signals: dict[str, ca.SX] = {}
    for item in items:
        for name, value in item.items() if isinstance(item, Mapping) else [(item, None)]:
            if name in signals:
                raise ModelError(f"the signal `{name}` is measured twice")
            signals[name] = _signal(name, value, states)
    if not signals:
        raise ModelError("nothing is measured: name at least one state or expression in `measured`")
    return signals


def _signal_name(key: str) -> str:
    return f"the measured signal `{key}`"


def _signal(name: object, value: Any, states: Mapping[str, ca.SX]) -> ca.SX:
    if not isinstance(name, str):
        raise ModelError(f"`measured` contains {name!r}: names of states, or a mapping of name to expression, expected")
    if value is None:
        if name not in states:
            raise ModelError(f"the measured signal `{name}` is not a state: {suggestion(name, states)}")
        return states[name]
    signal = shaped(value, (1, 1), f"the measured signal `{name}`")
    if name in states and not ca.is_equal(signal, states[name]):
        raise ModelError(f"the measured signal `{name}` has the name of a state but another value: rename it")
    return signal


def _domain(domain: Mapping[str, IntervalLike], states: Sequence[str]) -> dict[str, Interval]:
    for name in domain:
        if name not in states:
            raise ModelError(f"the domain bounds `{name}`, which is not a state: {suggestion(name, states)}")
    return {name: interval(domain[name], f"the domain of `{name}`") for name in states if name in domain}


def interval(bounds: IntervalLike, what: str) -> Interval:
    """The exact interval (lo, hi) with lo < hi; None is unbounded.

    Raises:
        ModelError: for anything else, naming ``what``.
    """
    if isinstance(bounds, str) or not isinstance(bounds, Sequence) or len(bounds) != 2:
        raise ModelError(f"{what} is {bounds!r}: a pair (lo, hi) was expected, with None for no bound")
    lo = None if bounds[0] is None else exact(bounds[0], f"the lower bound of {what}")
    hi = None if bounds[1] is None else exact(bounds[1], f"the upper bound of {what}")
    if lo is not None and hi is not None and lo >= hi:
        raise ModelError(f"{what} is empty: its lower bound {decimal(lo)} is not below its upper bound {decimal(hi)}")
    return lo, hi


def _units(units: Mapping[str, str], known: Sequence[str]) -> dict[str, str]:
    for name, unit in units.items():
        if name not in known:
            raise ModelError(f"units names `{name}`, which is no state, input or signal: {suggestion(name, known)}")
        if not isinstance(unit, str):
            raise ModelError(f"the unit of `{name}` is {unit!r}: a text was expected, such as 'V'")
    return {name: units[name] for name in known if name in units}
