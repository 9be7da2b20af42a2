"""The linearised loops as functions of the settings, with derivatives, over cells of balls.

A matrix over a cell is its value at the centre plus, for each setting, the derivative over the cell times the distance
(mean value theorem). Entries that move together with a gain, as in a stiff filter, so keep their relation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import casadi as ca
import numpy as np
from flint import arb, arb_mat

from pbcgen.law.graph import LawGraph
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.target_map import TargetMap
from pbcgen.sampling.transition import real_identity
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, approximate, ball, precision, rational, reals
from pbcgen.symbolic.real_matrices import RealMatrix
from pbcgen.symbolic.tape import Tape

Which = Literal["hurwitz", "schur"]


@dataclass(frozen=True, eq=False)
class Jet:
    """A matrix of balls and its derivatives by the settings."""

    value: arb_mat
    slopes: tuple[arb_mat, ...]

    def __add__(self, other: Jet) -> Jet:
        slopes = tuple(a + b for a, b in zip(self.slopes, other.slopes, strict=True))
        return Jet(self.value + other.value, slopes)

    def __sub__(self, other: Jet) -> Jet:
        slopes = tuple(a - b for a, b in zip(self.slopes, other.slopes, strict=True))
        return Jet(self.value - other.value, slopes)

    def __mul__(self, other: Jet) -> Jet:
        pairs = zip(self.slopes, other.slopes, strict=True)
        return Jet(self.value * other.value, tuple(a * other.value + self.value * b for a, b in pairs))

    @property
    def nrows(self) -> int:
        """The number of rows."""
        return int(self.value.nrows())

    @property
    def ncols(self) -> int:
        """The number of columns."""
        return int(self.value.ncols())

    def filled(self, rows: int, columns: int, diagonal: int = 0) -> Jet:
        """A constant of this shape with as many slopes: zero, or a multiple of the identity."""
        value = real_identity(rows) * diagonal if diagonal else arb_mat(rows, columns)
        return Jet(value, tuple(arb_mat(rows, columns) for _ in self.slopes))

    def inverse(self) -> Jet:
        """The inverse. Raises ZeroDivisionError where the matrix may be singular."""
        inverted = self.value.inv() if self.value.nrows() else self.value
        return Jet(inverted, tuple(-(inverted * s * inverted) for s in self.slopes))

    def exp(self) -> Jet:
        """The matrix exponential; its derivative is a block of the exponential of a block matrix."""
        size = self.value.nrows()
        zero = arb_mat(size, size)
        slopes = []
        for s in self.slopes:
            if all(entry == 0 for entry in s.entries()):
                slopes.append(zero)
                continue
            whole = _blocks([[self.value, s], [zero, self.value]]).exp()
            slopes.append(_cut(whole, 0, size, size, 2 * size))
        return Jet(self.value.exp(), tuple(slopes))

    def cut(self, top: int, bottom: int, left: int, right: int) -> Jet:
        """Rows top to bottom and columns left to right, the ends excluded."""
        return Jet(
            _cut(self.value, top, bottom, left, right), tuple(_cut(s, top, bottom, left, right) for s in self.slopes)
        )


def block(rows: Sequence[Sequence[Jet]]) -> Jet:
    """A matrix of matrices."""
    count = len(rows[0][0].slopes)
    slopes = tuple(_blocks([[j.slopes[k] for j in row] for row in rows]) for k in range(count))
    return Jet(_blocks([[j.value for j in row] for row in rows]), slopes)


def _blocks(rows: Sequence[Sequence[arb_mat]]) -> arb_mat:
    lines: list[list[arb]] = []
    for row in rows:
        for i in range(row[0].nrows()):
            lines.append([m[i, j] for m in row for j in range(m.ncols())])
    width = sum(m.ncols() for m in rows[0])
    return arb_mat(lines) if lines and width else arb_mat(len(lines), width)


def _cut(m: arb_mat, top: int, bottom: int, left: int, right: int) -> arb_mat:
    if bottom == top or right == left:
        return arb_mat(bottom - top, right - left)
    return arb_mat([[m[i, j] for j in range(left, right)] for i in range(top, bottom)])


@dataclass(frozen=True, eq=False)
class Loops:
    """Continuous and sampled linearisation of a law at the target, as functions of the settings' values."""

    graph: LawGraph
    period: Fraction
    delay: Fraction
    rest: tuple[Real, ...]
    parameters: tuple[Real, ...]
    constants: tuple[Real, ...]
    tape: Tape
    count: int
    n: int

    @staticmethod
    def of(plant: Plant, point: Point, graph: LawGraph, period: Fraction, delay: Fraction = Fraction(0)) -> Loops:
        """Collect every formula; ``point`` is x* where the target does not move, ``delay`` a share of the period."""
        system, settings = plant.system, graph.settings
        symbols = ca.vertcat(*[s.symbol for s in settings.settings])
        gains = ca.vertcat(*[s.symbol for s in settings.settings if s.group == "gains"])
        rest = ca.SX.sym("rest", system.n + system.m) if settings.moving is None else ca.SX(0, 1)
        formulas = _formulas(plant, graph, period)
        both = ca.vertcat(system.x, system.u)
        moving = settings.moving
        star = rest if moving is None else ca.vertcat(moving.x, moving.u)
        stored = settings.stored
        results = []
        for formula in formulas:
            value = ca.substitute(formula, graph.m, system.measured_expressions) if graph.m.numel() else formula
            if stored:
                kept = ca.vertcat(*[s.symbol for s in stored])
                value = ca.substitute(value, kept, ca.vertcat(*[s.expression for s in stored]))
            results.append(ca.densify(ca.substitute(value, both, star)))
        hidden = ca.SX(0, 1) if moving is None else moving.hidden
        slopes = [ca.densify(_slope(ca.vec(e), moving, gains)) for e in results]
        constants = ca.vertcat(*[symbol for symbol, _ in graph.constants]) if graph.constants else ca.SX(0, 1)
        inputs = [symbols, rest, graph.xi, graph.t, plant.parameter_symbols, constants, hidden]
        return Loops(
            graph,
            period,
            delay,
            (*point.x, *point.u) if moving is None else (),
            tuple(reals(plant.parameter_values)),
            tuple(value for _, value in graph.constants),
            Tape.of(inputs, [*results, *slopes]),
            len(results),
            system.n,
        )

    def at(self, settings: Sequence[Real], period: arb | None = None) -> dict[Which, Jet]:
        """Both matrices over a cell. Raises ZeroDivisionError where the loop equation may be singular.

        With ``period`` the plant is sampled by that, the controller still steps by its own, and the last slope is that
        of the period.
        """
        with precision(BITS):
            parts = self._parts(settings)
            if period is not None:
                parts = [Jet(j.value, (*j.slopes, _zero_like(j.value))) for j in parts]
            A, B, H, N, c_m, c_xi, x_m, x_xi, u_m, u_xi, x_t, u_t, *continuous = parts
            size = N.value.nrows()
            solved = Jet(real_identity(size) + N.value, N.slopes).inverse()
            t_m, t_xi = solved * c_m, solved * c_xi
            X_m, X_xi, U_m, U_xi = x_m + x_t * t_m, x_xi + x_t * t_xi, u_m + u_t * t_m, u_xi + u_t * t_xi
            sampled = self._sampled(A, B, (X_m * H, X_xi, U_m * H, U_xi), period)
            if not continuous:
                return {"hurwitz": A + B * U_m * H, "schur": sampled}
            r_m, r_xi, v_m, v_xi = continuous
            return {"hurwitz": block([[A + B * v_m * H, B * v_xi], [r_m * H, r_xi]]), "schur": sampled}

    def _sampled(self, A: Jet, B: Jet, step: tuple[Jet, Jet, Jet, Jet], period: arb | None) -> Jet:
        """The loop over one period in (x, xi, past inputs, the last one first); push j is that of j samples ago."""
        X_x, X_xi, U_x, U_xi = step
        whole, part = divmod(self.delay, 1)
        Ad, push = self._hold(A, B, Fraction(1), period)
        pushes = {int(whole): push}
        if part:
            _, late = self._hold(A, B, 1 - part, period)
            pushes = {int(whole): late, int(whole) + 1: push - late}
        own = pushes.get(0)
        top = [Ad if own is None else Ad + own * U_x, X_xi.filled(self.n, X_xi.ncols)]
        if own is not None:
            top[1] = own * U_xi
        rows = [top, [X_x, X_xi]]
        m, memory = B.ncols, max(pushes)
        for j in range(1, memory + 1):
            rows[0].append(pushes.get(j, B.filled(self.n, m)))
            rows[1].append(B.filled(X_xi.nrows, m))
            row = [U_x, U_xi] if j == 1 else [B.filled(m, self.n), B.filled(m, X_xi.ncols)]
            rows.append(row + [B.filled(m, m, int(j >= 2 and k == j - 1)) for k in range(1, memory + 1)])
        return block(rows)

    def _parts(self, settings: Sequence[Real]) -> list[Jet]:
        zeros: list[Real] = [ZERO] * self.graph.xi.numel()
        nothing: list[Real] = [ZERO] * self.graph.t.numel()
        moving, own = self.graph.settings.moving, self.graph.settings.targets
        hidden = [] if moving is None else moving.hidden_at(settings[:own])
        inputs = [list(settings), list(self.rest), zeros, nothing, list(self.parameters), list(self.constants), hidden]
        walked = self.tape.walk(REAL, inputs)
        jets = []
        for value, slope in zip(walked[: self.count], walked[self.count :], strict=True):
            rows, columns = value.shape
            flat = slope.dense(ZERO)
            slopes = tuple(
                _matrix([[flat[j * rows + i][k] for j in range(columns)] for i in range(rows)], rows, columns)
                for k in range(len(settings))
            )
            jets.append(Jet(_matrix(value.dense(ZERO), rows, columns), slopes))
        return jets

    def _hold(self, A: Jet, B: Jet, share: Fraction, period: arb | None) -> tuple[Jet, Jet]:
        """``e^{A t}`` and ``int_0^t e^{A s} ds B`` with t a share of the period: blocks of ``exp([[A, B], [0, 0]] t)``.

        Enclosures lose about norm(A) t bits; extra precision pays for them.
        """
        middle = np.array([[approximate(v) for v in row] for row in A.value.tolist()])
        norm = float(np.abs(middle).sum(axis=1).max()) if np.all(np.isfinite(middle)) else 0.0
        m = B.ncols
        with precision(BITS + min(4096, int(3 * norm * float(self.period)))):
            t = ball(rational(share)) * (ball(rational(self.period)) if period is None else period)
            whole = block([[A, B], [A.filled(m, self.n), A.filled(m, m)]])
            slopes = [s * t for s in whole.slopes]
            if period is not None:
                slopes[-1] = whole.value * ball(rational(share))
            held = Jet(whole.value * t, tuple(slopes)).exp()
        return held.cut(0, self.n, 0, self.n), held.cut(0, self.n, self.n, self.n + m)


def _zero_like(matrix: arb_mat) -> arb_mat:
    return arb_mat(matrix.nrows(), matrix.ncols())


def _matrix(rows: RealMatrix, height: int, width: int) -> arb_mat:
    return arb_mat([[ball(v) for v in row] for row in rows]) if height and width else arb_mat(height, width)


def _slope(column: ca.SX, moving: TargetMap | None, gains: ca.SX) -> ca.SX:
    """The derivative by all settings, targets first."""
    by_gains = ca.jacobian(column, gains) if gains.numel() else ca.SX(column.numel(), 0)
    return by_gains if moving is None else ca.horzcat(moving.slope(column), by_gains)


def _formulas(plant: Plant, graph: LawGraph, period: Fraction) -> list[ca.SX]:
    """A, B, H of the plant; N and the slopes of one step; those of the continuous law, where tanh has slope one."""
    system, step = plant.system, graph.discretise(period)
    formulas = [
        ca.jacobian(system.xdot, system.x),
        system.g,
        ca.jacobian(system.measured_expressions, system.x),
        step.N,
    ]
    formulas += [ca.jacobian(e, v) for e in (step.c, step.next_state, step.output) for v in (graph.m, graph.xi)]
    formulas += [ca.jacobian(e, graph.t) for e in (step.next_state, step.output)]
    if graph.saturated is not None:
        law = graph.saturated
        for part in (law.rate, law.u):
            by_t = ca.jacobian(part, graph.t)
            formulas += [
                ca.jacobian(part, v) + ca.mtimes(by_t, ca.jacobian(law.arguments, v)) for v in (graph.m, graph.xi)
            ]
    return formulas
