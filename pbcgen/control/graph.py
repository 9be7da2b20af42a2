"""Each law as formulas in the measurement: continuous, and discretised by backward Euler.

With z_c = gamma~ + x_c and E = (I + h R_c K_c)^{-1}, the implicit step of (dxc) is ``x_c+ = E (x_c - h R_c alpha t)``,
``t = tanh(s)``, so the saturated arguments s = beta z_c+ solve ``s + N t = c`` with
``N = diag(beta) E h R_c diag(alpha)`` and ``c = beta (gamma~ + E x_c)``. (dxl) has the diagonal analogue. The law
`passive-output` has no state: there s is the passive output y, which depends on u.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import casadi as ca
from flint import fmpq, fmpq_mat

from pbcgen.control.hyperbolic import Tanh, default_tanh
from pbcgen.control.law import ControlLaw, Fallback, Precision, Signal
from pbcgen.control.measure import Measurement, Reading, Unreadable
from pbcgen.control.solves import choose_solves
from pbcgen.models.gains import Matrix, Vector
from pbcgen.models.laws import Integral, Law, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.passivity.plant import Plant, Point
from pbcgen.symbolic.real import Real, approximate, fraction, rational
from pbcgen.symbolic.tape import Tape

#: The filter psi of (dpsi) stops where sech(beta psi) is below the unit roundoff of double precision.
PSI_RANGE = 40


@dataclass(frozen=True, eq=False)
class Discrete:
    """One step with sample period h: N and c of the loop, the next state and u, as SX in (m, xi, t)."""

    N: ca.SX
    c: ca.SX
    next_state: ca.SX
    output: ca.SX


@dataclass(frozen=True, eq=False)
class LawGraph:
    """A law written in the measurement.

    Attributes:
        law: the law with resolved gains.
        m: the measurement symbols.
        xi: the controller state symbols; empty for `passive-output`.
        t: symbols for tanh(s).
        names: of the controller states.
        continuous: (xi', u) as SX in (m, xi).
        discretise: h -> the step.
        constants: symbols in the formulas that stand for numbers, with their exact or enclosed values.
    """

    law: Law
    m: ca.SX
    xi: ca.SX
    t: ca.SX
    names: tuple[str, ...]
    continuous: tuple[ca.SX, ca.SX]
    discretise: Callable[[Fraction], Discrete]
    constants: tuple[tuple[ca.SX, Real], ...]

    def rounded(self, *expressions: ca.SX) -> list[ca.SX]:
        """The expressions with every constant replaced by its nearest double."""
        if not self.constants:
            return list(expressions)
        symbols = ca.vertcat(*[symbol for symbol, _ in self.constants])
        values = ca.DM([approximate(value) for _, value in self.constants])
        return [ca.substitute(e, symbols, values) if e.numel() else e for e in expressions]


@dataclass
class _Part:
    """A group of filter states with its saturated terms, to be stacked with others."""

    states: ca.SX
    names: list[str]
    rate: ca.SX
    control: ca.SX
    step: Callable[[Fraction, ca.SX], tuple[ca.SX, ca.SX, ca.SX, ca.SX]]
    channels: int = field(default=0)


def column(values: Sequence[Fraction]) -> ca.SX:
    """Exact numbers as an SX column of doubles."""
    return ca.SX(ca.DM([float(v) for v in values]))


def matrix(rows: Sequence[Sequence[Fraction]]) -> ca.SX:
    """Exact numbers as a sparse SX matrix of doubles."""
    return ca.sparsify(ca.SX(ca.DM([[float(v) for v in row] for row in rows])))


def exact_inverse(rows: Matrix) -> Matrix:
    """The inverse of a regular matrix of fractions."""
    inverted = fmpq_mat([[rational(v) for v in row] for row in rows]).inv().tolist()
    return tuple(tuple(fraction(fmpq(v)) for v in row) for row in inverted)


def product(a: Matrix, b: Matrix) -> Matrix:
    """The product of matrices of fractions."""
    columns = list(zip(*b, strict=True))
    return tuple(
        tuple(sum((x * y for x, y in zip(row, col, strict=True)), Fraction(0)) for col in columns) for row in a
    )


def scaled(a: Matrix, factor: Fraction) -> Matrix:
    """A matrix of fractions times a number."""
    return tuple(tuple(v * factor for v in row) for row in a)


def identity_plus(a: Matrix) -> Matrix:
    """``I + a``."""
    return tuple(tuple(v + (i == j) for j, v in enumerate(row)) for i, row in enumerate(a))


def _filter_c(alpha: Vector, beta: Vector, K_c: Matrix, R_c: Matrix, deviation: ca.SX) -> _Part:
    """(dxc) and its term of u (uc)."""
    m = len(alpha)
    x_c = ca.SX.sym("x_c", m)
    a, b = column(alpha), column(beta)
    tanh = ca.tanh(b * (deviation + x_c))
    rate = -ca.mtimes(matrix(R_c), a * tanh + ca.mtimes(matrix(K_c), x_c))

    def step(h: Fraction, t: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        E = exact_inverse(identity_plus(scaled(product(R_c, K_c), h)))
        push = scaled(product(E, R_c), h)
        N = tuple(tuple(beta[i] * push[i][j] * alpha[j] for j in range(m)) for i in range(m))
        gain = tuple(tuple(push[i][j] * alpha[j] for j in range(m)) for i in range(m))
        decayed = ca.mtimes(matrix(E), x_c)
        return matrix(N), b * (deviation + decayed), decayed - ca.mtimes(matrix(gain), t), -a * t

    return _Part(x_c, _numbered("x_c", m), rate, -a * tanh, step, m)


def _filter_l(law: NaturalDamping, deviation: ca.SX) -> _Part:
    """(dxl) and its term of u (ulc)."""
    m = len(law.alpha_l)
    x_l = ca.SX.sym("x_l", m)
    a, b = column(law.alpha_l), column(law.beta_l)
    K = tuple(law.K_l[i][i] for i in range(m))
    R = tuple(law.R_l[i][i] for i in range(m))
    driven = ca.mtimes(matrix(law.Upsilon or ()), deviation)
    argument = b * (driven + column(K) * x_l)

    def step(h: Fraction, t: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        N = tuple(
            tuple(law.beta_l[i] * K[i] * h * R[i] * law.alpha_l[i] if i == j else Fraction(0) for j in range(m))
            for i in range(m)
        )
        push = column([h * R[i] * law.alpha_l[i] for i in range(m)])
        return matrix(N), argument, x_l - push * t, -a * t

    tanh = ca.tanh(argument)
    return _Part(x_l, _numbered("x_l", m), -column(R) * a * tanh, -a * tanh, step, m)


def _filter_psi(law: Integral, deviation: ca.SX) -> _Part:
    """(dpsi) with f_psi = -R_psi psi, Psi = diag(alpha beta sech(beta psi)), linearly implicit in the leak."""
    m = len(law.alpha_psi)
    psi = ca.SX.sym("psi", m)
    a, b = column(law.alpha_psi), column(law.beta_psi)
    drive = a * b * deviation / ca.cosh(b * psi)
    limit = column([Fraction(PSI_RANGE) / v for v in law.beta_psi])

    def step(h: Fraction, _: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        E = exact_inverse(identity_plus(scaled(law.R_psi, h)))
        moved = ca.mtimes(matrix(E), psi + float(h) * drive)
        following = ca.fmax(-limit, ca.fmin(limit, moved))
        empty = ca.SX(0, 1)
        return ca.SX(0, 0), empty, following, -a * ca.tanh(b * following)

    rate = -ca.mtimes(matrix(law.R_psi), psi) + drive
    return _Part(psi, _numbered("psi", m), rate, -a * ca.tanh(b * psi), step)


def _numbered(name: str, m: int) -> list[str]:
    return [name] if m == 1 else [f"{name}_{i + 1}" for i in range(m)]


@dataclass(frozen=True, eq=False)
class Needs:
    """What a law reads, in the measurement: deviations from the target, or the signals that could not be read."""

    gamma: ca.SX
    eta: ca.SX
    potential: ca.SX
    drift: ca.SX
    feedthrough: ca.SX
    affine: bool
    missing: tuple[Unreadable, ...]


def needs(plant: Plant, measurement: Measurement, law: Law, gamma: ca.SX, eta: ca.SX | None) -> Needs:
    """Read every signal that the law needs from the measurement."""
    missing: list[Unreadable] = []
    affine = True

    def read(signals: ca.SX, names: Callable[[int], str], absolute: bool = False) -> ca.SX:
        nonlocal affine
        entries = []
        for i, signal in enumerate(ca.vertsplit(signals) if signals.numel() else []):
            reading = measurement.read(signal, names(i))
            if isinstance(reading, Unreadable):
                missing.append(reading)
                continue
            entries.append(_chosen(reading, absolute))
            affine = affine and (absolute or reading.affine is not None)
        return ca.vertcat(*entries) if entries else ca.SX(0, 1)

    base = law.base if isinstance(law, Integral) else law
    gamma_reading = read(gamma, lambda i: f"gamma_{i + 1}" if gamma.numel() > 1 else "gamma")
    eta_reading = (
        read(eta, lambda i: f"eta_{i + 1}") if isinstance(base, NaturalDamping) and eta is not None else ca.SX(0, 1)
    )
    potential = drift = ca.SX(0, 1)
    feedthrough = ca.SX(0, 0)
    if isinstance(base, PotentialCompensation) and plant.system.mechanical is not None:
        mechanics = plant.system.mechanical
        potential = read(ca.gradient(mechanics.V, mechanics.q), lambda i: f"dV/dq_{i + 1}", absolute=True)
    if isinstance(base, PassiveOutput):
        slope = ca.jacobian(gamma, plant.system.x)
        drift = read(ca.mtimes(slope, plant.system.f), lambda i: f"y_{i + 1} at u = 0", absolute=True)
        W = ca.sparsify(ca.mtimes(slope, plant.system.g))
        flat = read(ca.vec(ca.densify(W)), lambda i: "the feedthrough of y", absolute=True)
        m = plant.system.m
        feedthrough = ca.sparsify(ca.reshape(flat, m, m)) if flat.numel() == m * m else ca.SX(m, m)
    return Needs(gamma_reading, eta_reading, potential, drift, feedthrough, affine, tuple(missing))


def _chosen(reading: Reading, absolute: bool) -> ca.SX:
    return reading.value if absolute else reading.deviation


def build(law: Law, measurement: Measurement, point: Point, read: Needs) -> LawGraph:
    """The formulas of a law whose signals can all be read."""
    base = law.base if isinstance(law, Integral) else law
    if isinstance(base, PassiveOutput):
        return _passive_output(base, measurement, point, read)
    if isinstance(base, NaturalDamping):
        parts = [_filter_c(base.alpha_c, base.beta_c, base.K_c, base.R_c, read.gamma), _filter_l(base, read.eta)]
    else:
        parts = [_filter_c(base.alpha, base.beta, base.K_c, base.R_c, read.gamma)]
    if isinstance(law, Integral):
        parts.append(_filter_psi(law, read.gamma))
    equilibrium_input = ca.vertcat(*[measurement.constant(v) for v in point.u])
    offset = read.potential if isinstance(base, PotentialCompensation) else equilibrium_input
    return _stack(law, measurement, parts, offset)


def _stack(law: Law, measurement: Measurement, parts: list[_Part], offset: ca.SX) -> LawGraph:
    xi = ca.vertcat(*[part.states for part in parts])
    t = ca.SX.sym("t", sum(part.channels for part in parts))
    names = tuple(name for part in parts for name in part.names)
    u = offset + sum((part.control for part in parts[1:]), parts[0].control)
    rate = ca.vertcat(*[part.rate for part in parts])

    def discretise(h: Fraction) -> Discrete:
        start, loops, forcings, following = 0, [], [], []
        output = offset
        for part in parts:
            own = t[start : start + part.channels]
            start += part.channels
            N, c, state, term = part.step(h, own)
            loops.append(N)
            forcings.append(c)
            following.append(state)
            output = output + term
        return Discrete(ca.diagcat(*loops), ca.vertcat(*forcings), ca.vertcat(*following), output)

    return LawGraph(law, measurement.symbols, xi, t, names, (rate, u), discretise, tuple(measurement.constants))


def _passive_output(law: PassiveOutput, measurement: Measurement, point: Point, read: Needs) -> LawGraph:
    """(u): ``y + W diag(k_p) tanh(y) = drift + W v`` with ``v = -kappa - alpha tanh(beta gamma~)``."""
    m = len(law.alpha)
    t = ca.SX.sym("t", m)
    equilibrium_input = ca.vertcat(*[measurement.constant(v) for v in point.u])
    shaped = equilibrium_input - column(law.alpha) * ca.tanh(column(law.beta) * read.gamma)
    N = ca.mtimes(read.feedthrough, ca.diag(column(law.k_p)))
    c = read.drift + ca.mtimes(read.feedthrough, shaped)
    output = shaped - column(law.k_p) * t
    empty = ca.SX(0, 1)
    y = _solved(c, N)
    continuous = (empty, shaped - column(law.k_p) * ca.tanh(y))
    step = Discrete(N, c, empty, output)
    return LawGraph(law, measurement.symbols, empty, t, (), continuous, lambda h: step, tuple(measurement.constants))


def _solved(c: ca.SX, N: ca.SX, steps: int = 40) -> ca.SX:
    """s with ``s + N tanh(s) = c`` by unrolled Newton steps, for the continuous reference."""
    if N.nnz() == 0:
        return c
    size = c.numel()
    diagonal = ca.diag(N)
    start = ca.fmax(ca.fabs(c) / (1 + diagonal), ca.fabs(c) - diagonal)
    s = ca.sign(c) * start
    if not _is_diagonal(N):
        steps = 20
    for _ in range(steps):
        t = ca.tanh(s)
        residual = s - c + ca.mtimes(N, t)
        if _is_diagonal(N):
            s = s - residual / (1 + diagonal * (1 - t * t))
        else:
            s = s - ca.solve(ca.SX.eye(size) + ca.mtimes(N, ca.diag(1 - t * t)), residual)
    return s


def _is_diagonal(N: ca.SX) -> bool:
    rows, columns = N.sparsity().get_triplet()
    return all(i == j for i, j in zip(rows, columns, strict=True))


# --- to a ControlLaw ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Interface:
    """What the package's interface says beside the formulas."""

    name: str
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    intervals: tuple[tuple[Fraction, Fraction], ...]
    equilibrium_output: tuple[float, ...]
    ranges: Mapping[str, tuple[Fraction, Fraction]]


def control_law(
    graph: LawGraph, interface: Interface, h: Fraction, precision: Precision, tanh: Tanh | None = None
) -> ControlLaw:
    """The discretised law as data for the emitter and the reference step."""
    step = graph.discretise(h)
    N, c, following, output = graph.rounded(step.N, step.c, step.next_state, step.output)
    base = graph.law.base if isinstance(graph.law, Integral) else graph.law
    holds = isinstance(base, PotentialCompensation)
    prepare = Tape.of([graph.m, graph.xi], [c, N])
    tanh = tanh or default_tanh(precision)
    return ControlLaw(
        interface.name,
        graph.law.name,
        precision,
        h,
        interface.inputs,
        interface.outputs,
        tuple(Signal(name, "", _meaning(name)) for name in graph.names),
        prepare,
        Tape.of([graph.m, graph.xi, graph.t], [following, output]),
        choose_solves(prepare, precision, tanh),
        interface.intervals,
        interface.equilibrium_output,
        Fallback.LAST_OUTPUT if holds else Fallback.EQUILIBRIUM,
        interface.ranges,
        tanh,
    )


_STATE_MEANING = {
    "x_c": "state of the filter (dxc) that injects damping",
    "x_l": "state of the filter (dxl) on the naturally damped coordinates",
    "psi": "state of the filter (dpsi) that removes the steady-state error",
}


def _meaning(state: str) -> str:
    return next(meaning for prefix, meaning in _STATE_MEANING.items() if state.startswith(prefix))
