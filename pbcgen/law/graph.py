"""Each law as formulas in the measurement: continuous, and discretised by backward Euler.

With z_c = gamma~ + x_c and E = (I + h R_c K_c)^{-1}, the implicit step of (dxc) is ``x_c+ = E (x_c - h R_c alpha t)``,
``t = tanh(s)``, so the saturated arguments s = beta z_c+ solve ``s + N t = c`` with
``N = diag(beta) E h R_c diag(alpha)`` and ``c = beta (gamma~ + E x_c)``. (dxl) has the diagonal analogue. The law
`passive-output` has no state: there s is the passive output y, which depends on u.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import casadi as ca

from pbcgen.law.compensation import compensated_force
from pbcgen.law.gain_matrices import Implicit
from pbcgen.law.measure import Measurement, Reading, Unreadable
from pbcgen.law.settings import Gain, GainMatrix, Settings, Stored, column, matrix, times
from pbcgen.models.gains import diagonal
from pbcgen.models.laws import Integral, Law, NaturalDamping, PassiveOutput, PotentialCompensation, base_law
from pbcgen.passivity.plant import Plant, Point
from pbcgen.symbolic.real import Real, approximate

#: The filter psi of (dpsi) stops where sech(beta psi) is below the unit roundoff of double precision.
PSI_RANGE = 40


@dataclass(frozen=True, eq=False)
class Discrete:
    """One step with sample period h: N and c of the loop, the next state and u, as SX in (m, xi, t)."""

    N: ca.SX
    c: ca.SX
    next_state: ca.SX
    output: ca.SX

    def parts(self) -> tuple[ca.SX, ...]:
        """All four."""
        return self.N, self.c, self.next_state, self.output


@dataclass(frozen=True, eq=False)
class Saturated:
    """The continuous law as (xi', u) in (m, xi, t) with t = tanh(arguments(m, xi)); all are zero at the target."""

    arguments: ca.SX
    rate: ca.SX
    u: ca.SX


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
        settings: what may change at run time; the symbols of what it stores are among the constants.
        start: h -> the states for which c = 0, as SX in m: the first step then gives the equilibrium input.
        equilibrium_input: u*, numbers and symbols.
        saturated: the continuous law with tanh kept apart; None for `passive-output`.
    """

    law: Law
    m: ca.SX
    xi: ca.SX
    t: ca.SX
    names: tuple[str, ...]
    continuous: tuple[ca.SX, ca.SX]
    discretise: Callable[[Fraction], Discrete]
    constants: tuple[tuple[ca.SX, Real], ...]
    settings: Settings
    start: Callable[[Fraction], ca.SX]
    equilibrium_input: ca.SX
    saturated: Saturated | None = None

    def stored(self, h: Fraction) -> tuple[Stored, ...]:
        """What the running controller keeps of its settings: what the step with sample period h uses."""
        used = ca.vertcat(*[ca.vec(ca.densify(e)) for e in self.discretise(h).parts()])
        return tuple(s for s in self.settings.stored if ca.depends_on(used, s.symbol))

    def rounded(self, *expressions: ca.SX, keep: Sequence[Stored] = ()) -> list[ca.SX]:
        """The expressions with every constant replaced by its nearest double, but for those that are kept."""
        kept = {s.symbol.name() for s in keep}
        constants = [c for c in self.constants if c[0].name() not in kept]
        if not constants:
            return list(expressions)
        symbols = ca.vertcat(*[symbol for symbol, _ in constants])
        values = ca.DM([approximate(value) for _, value in constants])
        return [ca.substitute(e, symbols, values) if e.numel() else e for e in expressions]


@dataclass
class _Part:
    """A group of filter states with its saturated terms, to be stacked with others.

    ``rate`` and ``control`` are formulas in t, which stands for tanh(arguments).
    """

    states: ca.SX
    names: list[str]
    rate: ca.SX
    control: ca.SX
    step: Callable[[Fraction, ca.SX], tuple[ca.SX, ca.SX, ca.SX, ca.SX]]
    start: Callable[[Fraction], ca.SX]
    t: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    arguments: ca.SX = field(default_factory=lambda: ca.SX(0, 1))

    @property
    def channels(self) -> int:
        """The number of saturated arguments."""
        return int(self.t.numel())


def _filter_c(alpha: Sequence[Gain], beta: Sequence[Gain], K_c: GainMatrix, R_c: GainMatrix, deviation: ca.SX) -> _Part:
    """(dxc) and its term of u (uc)."""
    m = len(alpha)
    x_c = ca.SX.sym("x_c", m)
    a, b, tanh = column(alpha), column(beta), ca.SX.sym("t", m)
    rate = -ca.mtimes(matrix(R_c), a * tanh + ca.mtimes(matrix(K_c), x_c))

    def step(h: Fraction, t: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        own = Implicit.of(R_c, K_c, h)
        N = [[times(beta[i], own.push[i][j], alpha[j]) for j in range(m)] for i in range(m)]
        gain = [[times(own.push[i][j], alpha[j]) for j in range(m)] for i in range(m)]
        decayed = ca.mtimes(matrix(own.decay), x_c)
        return matrix(N), b * (deviation + decayed), decayed - ca.mtimes(matrix(gain), t), -a * t

    def start(h: Fraction) -> ca.SX:
        return -ca.mtimes(matrix(Implicit.of(R_c, K_c, h).growth), deviation)

    return _Part(x_c, _numbered("x_c", m), rate, -a * tanh, step, start, tanh, b * (deviation + x_c))


def _filter_l(alpha: Sequence[Gain], beta: Sequence[Gain], K_l: GainMatrix, R_l: GainMatrix, driven: ca.SX) -> _Part:
    """(dxl) and its term of u (ulc); ``driven`` is Upsilon eta~."""
    m = len(alpha)
    x_l = ca.SX.sym("x_l", m)
    a, b = column(alpha), column(beta)
    K = tuple(K_l[i][i] for i in range(m))
    R = tuple(R_l[i][i] for i in range(m))
    argument = b * (driven + column(K) * x_l)

    def step(h: Fraction, t: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        N = [[times(beta[i], K[i], h, R[i], alpha[i]) if i == j else Fraction(0) for j in range(m)] for i in range(m)]
        push = column([times(h, R[i], alpha[i]) for i in range(m)])
        return matrix(N), argument, x_l - push * t, -a * t

    def start(_: Fraction) -> ca.SX:
        return -column([1 / k for k in K]) * driven

    tanh = ca.SX.sym("t", m)
    return _Part(x_l, _numbered("x_l", m), -column(R) * a * tanh, -a * tanh, step, start, tanh, argument)


def _filter_psi(alpha: Sequence[Gain], beta: Sequence[Gain], R_psi: GainMatrix, deviation: ca.SX) -> _Part:
    """(dpsi) with f_psi = -R_psi psi, Psi = diag(alpha beta sech(beta psi)), linearly implicit in the leak."""
    m = len(alpha)
    psi = ca.SX.sym("psi", m)
    a, b = column(alpha), column(beta)
    limit = column([Fraction(PSI_RANGE) / v if isinstance(v, Fraction) else PSI_RANGE / v for v in beta])

    def step(h: Fraction, _: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        E = Implicit.of(R_psi, diagonal([Fraction(1)] * m), h).decay
        push = [times(E[i][i], h, alpha[i], beta[i]) for i in range(m)]  # R_psi is diagonal, and so is E
        moved = ca.mtimes(matrix(E), psi) + column(push) * deviation / ca.cosh(b * psi)
        following = ca.fmax(-limit, ca.fmin(limit, moved))
        empty = ca.SX(0, 1)
        return ca.SX(0, 0), empty, following, -a * ca.tanh(b * following)

    rate = -ca.mtimes(matrix(R_psi), psi) + a * b * deviation / ca.cosh(b * psi)
    return _Part(psi, _numbered("psi", m), rate, -a * ca.tanh(b * psi), step, lambda _: ca.SX(m, 1))


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

    base = base_law(law)
    gamma_reading = read(gamma, lambda i: f"gamma_{i + 1}" if gamma.numel() > 1 else "gamma")
    eta_reading = (
        read(eta, lambda i: f"eta_{i + 1}") if isinstance(base, NaturalDamping) and eta is not None else ca.SX(0, 1)
    )
    potential = drift = ca.SX(0, 1)
    feedthrough = ca.SX(0, 0)
    force = compensated_force(plant.system, base)
    if force is not None:
        potential = read(force, lambda i: f"dV/dq_{i + 1}", absolute=True)
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
    base = base_law(law)
    gain, gain_matrix, system = measurement.settings.gain, measurement.settings.diagonal_gain, measurement.plant.system
    equilibrium_input = ca.vertcat(
        *[
            measurement.star(system.u[i], v, name, system.units.get(name, ""))
            for i, (name, v) in enumerate(zip(system.input_names, point.u, strict=True))
        ]
    )
    if isinstance(base, PassiveOutput):
        return _passive_output(base, measurement, equilibrium_input, read)
    K_c, R_c = gain_matrix("K_c", base.K_c), gain_matrix("R_c", base.R_c)
    if isinstance(base, NaturalDamping):
        alpha, beta = gain("alpha_c", base.alpha_c), gain("beta_c", base.beta_c)
        parts = [_filter_c(alpha, beta, K_c, R_c, read.gamma)]
        alpha, beta = gain("alpha_l", base.alpha_l), gain("beta_l", base.beta_l)
        K_l, R_l = gain_matrix("K_l", base.K_l), gain_matrix("R_l", base.R_l)
        parts.append(_filter_l(alpha, beta, K_l, R_l, ca.mtimes(matrix(base.Upsilon or ()), read.eta)))
    else:
        parts = [_filter_c(gain("alpha", base.alpha), gain("beta", base.beta), K_c, R_c, read.gamma)]
    if isinstance(law, Integral):
        alpha, beta = gain("alpha_psi", law.alpha_psi), gain("beta_psi", law.beta_psi)
        parts.append(_filter_psi(alpha, beta, gain_matrix("R_psi", law.R_psi), read.gamma))
    offset = read.potential if isinstance(base, PotentialCompensation) else equilibrium_input
    return _stack(law, measurement, parts, offset, equilibrium_input)


def _stack(law: Law, measurement: Measurement, parts: list[_Part], offset: ca.SX, equilibrium_input: ca.SX) -> LawGraph:
    xi = ca.vertcat(*[part.states for part in parts])
    t = ca.vertcat(*[part.t for part in parts])
    arguments = ca.vertcat(*[part.arguments for part in parts])
    names = tuple(name for part in parts for name in part.names)
    u = offset + sum((part.control for part in parts[1:]), parts[0].control)
    rate = ca.vertcat(*[part.rate for part in parts])
    saturated = [ca.substitute(e, t, ca.tanh(arguments)) for e in (rate, u)]

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

    def start(h: Fraction) -> ca.SX:
        return ca.vertcat(*[part.start(h) for part in parts])

    return _graph(
        law,
        measurement,
        equilibrium_input,
        xi=xi,
        t=t,
        names=names,
        continuous=(saturated[0], saturated[1]),
        discretise=discretise,
        start=start,
        saturated=Saturated(arguments, rate, u),
    )


def _passive_output(law: PassiveOutput, measurement: Measurement, equilibrium_input: ca.SX, read: Needs) -> LawGraph:
    """(u): ``y + W diag(k_p) tanh(y) = drift + W v`` with ``v = -kappa - alpha tanh(beta gamma~)``."""
    m = len(law.alpha)
    t = ca.SX.sym("t", m)
    gain = measurement.settings.gain
    alpha, beta, k_p = (column(gain(n, v)) for n, v in (("alpha", law.alpha), ("beta", law.beta), ("k_p", law.k_p)))
    shaped = equilibrium_input - alpha * ca.tanh(beta * read.gamma)
    N = ca.mtimes(read.feedthrough, ca.diag(k_p))
    c = read.drift + ca.mtimes(read.feedthrough, shaped)
    output = shaped - k_p * t
    empty = ca.SX(0, 1)
    y = _solved(c, N)
    continuous = (empty, shaped - k_p * ca.tanh(y))
    step = Discrete(N, c, empty, output)
    return _graph(
        law,
        measurement,
        equilibrium_input,
        xi=empty,
        t=t,
        names=(),
        continuous=continuous,
        discretise=lambda h: step,
        start=lambda h: empty,
    )


def _graph(law: Law, measurement: Measurement, equilibrium_input: ca.SX, **formulas: Any) -> LawGraph:
    """The graph with what comes from the measurement. It holds all that was read by then, so this comes last."""
    return LawGraph(
        law=law,
        m=measurement.symbols,
        constants=tuple(measurement.constants),
        settings=measurement.settings,
        equilibrium_input=equilibrium_input,
        **formulas,
    )


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
