"""The closed loop as a polynomial system in its states and in functions of one argument each, which lie in sectors.

With the deviations x~ of the plant, and gamma and eta affine, the loop is ``zeta' = F(zeta, phi, theta)``, zeta being
(x~, x_c, x_l). An entry of phi is a saturation of the law, or what a function in the plant adds to its value at x*:

    phi = alpha tanh(beta z),      z = gamma~ + x_c or Upsilon eta~ + K_l x_l,      phi / z in [0, alpha beta],
    phi = T(a^T x* + a^T x~ + b) - T(a^T x* + b),      z = a^T x~,      phi / z in the range of the slopes of T.

The last is the mean value theorem: nothing of x* enters, so x* need not be rational where the rest of F is linear.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TypeAlias

import casadi as ca
from flint import fmpq

from pbcgen.control.situation import Situation
from pbcgen.models.gains import Matrix, Vector
from pbcgen.models.laws import DynamicExtension, Integral, Law, NaturalDamping
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.region import undefined
from pbcgen.proof.claim import Status
from pbcgen.proof.nonnegative import Everywhere
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import Row, kernel, reduce_rows
from pbcgen.symbolic.real import fraction, rational

#: Coefficients by the positions of the variables of (zeta, phi, theta), in order.
Polynomial: TypeAlias = dict[tuple[int, ...], fmpq]
#: The least and the largest slope of functions on the whole line; None where slopes are not bounded above.
_SLOPES: dict[str, tuple[int, int | None]] = {
    "tanh": (0, 1),
    "atan": (0, 1),
    "asinh": (0, 1),
    "exp": (0, None),
    "sin": (-1, 1),
    "cos": (-1, 1),
}


@dataclass(frozen=True, eq=False)
class Sector:
    """A function phi of z with ``least <= phi / z <= most``; z is linear in zeta, most None where there is no bound."""

    argument: Polynomial
    least: fmpq
    most: fmpq | None

    @property
    def bounds(self) -> tuple[float, float]:
        """The ends of the sector in double precision, a steep one for none."""
        least = float(fraction(self.least))
        return least, 10 * (1 + abs(least)) if self.most is None else float(fraction(self.most))


@dataclass(frozen=True, eq=False)
class SectorLoop:
    """The loop as polynomials.

    Attributes:
        rates: of zeta, in (zeta, phi, theta).
        sectors: of phi.
        outputs: gamma~ where there are integral terms, theta = alpha tanh(beta psi).
        leaks: ``r / (alpha beta)^2`` of each of these.
        turn: T, where these are other coordinates ``T zeta`` of the states.
    """

    rates: list[Polynomial]
    sectors: list[Sector]
    outputs: list[Polynomial]
    leaks: list[fmpq]
    turn: list[list[fmpq]] | None = None

    @property
    def order(self) -> int:
        """How many states zeta are."""
        return len(self.rates)

    @property
    def size(self) -> int:
        """How many variables (zeta, phi, theta) are."""
        return self.order + len(self.sectors) + len(self.leaks)

    @staticmethod
    def of(situation: Situation) -> SectorLoop | None:
        """None where gamma or eta is not affine, f no such sum, or a filter psi does not leak.

        Raises UnsupportedOperation, ZeroDivisionError for functions that are none of exact arithmetic.
        """
        base, leaks, mechanics = situation.base, _leaks(situation.law), situation.plant.system.mechanical
        if leaks is None or not isinstance(base, DynamicExtension | NaturalDamping):
            return None
        if situation.found["equilibrium"].status is not Status.PROVED:
            return None
        if mechanics is not None and situation.plant.jumps(mechanics.M, mechanics.V, mechanics.D, mechanics.G):
            return None  # f has lost the jumps of M and V
        drift = _Drift.of(situation)
        N = _constant_slope(situation.plant, situation.gamma)
        E = [] if isinstance(base, DynamicExtension) else _constant_slope(situation.plant, situation.eta)
        if drift is None or N is None or E is None:
            return None
        law = _saturations(base, N, E, situation.plant.system.n)
        m, own = situation.plant.system.m, [Sector(_linear(a), *ends) for a, *ends in drift.inner]
        order = situation.plant.system.n + (1 if isinstance(base, DynamicExtension) else 2) * m
        theta = order + len(law) + len(own)
        channels = [[order + k for k in range(j, len(law), m)] + [theta + j] * bool(leaks) for j in range(m)]
        rates = [drift.rate(row, channels, order + len(law)) for row in drift.rows]
        rates += _filters(base, situation.plant.system.n, order)
        return SectorLoop(rates, [*law, *own], [_linear(row) for row in N] if leaks else [], leaks).straight()

    def straight(self) -> SectorLoop:
        """The same in coordinates in which directions that no rate depends on are those of single states.

        Let n_i be a basis of these directions in echelon form with pivots k_i. The coordinates are the pivots, and
        ``zeta_j - sum_i n_i[j] zeta_{k_i}`` for the others: along n_i one pivot moves alone. A rate has the same value
        where the pivots are zero and the other coordinates are as they are.
        """
        rows: dict[object, Row] = {}
        for i, rate in enumerate(self.rates):
            for key, c in rate.items():
                for k in {k for k in key if k < self.order}:
                    rest = list(key)
                    rest.remove(k)
                    entry = rows.setdefault((i, tuple(rest)), {})
                    entry[k] = entry.get(k, fmpq(0)) + c * key.count(k)
        basis: list[Row] = [dict(enumerate(row)) for row in kernel(rows.values(), self.order, fmpq(0), fmpq(1))]
        along = {k: row for k, row in reduce_rows(basis).items() if isinstance(k, int)}
        kept = [{key: c for key, c in rate.items() if not set(key) & along.keys()} for rate in self.rates]
        rates = list(kept)
        turn = [[fmpq(int(i == j)) for j in range(self.order)] for i in range(self.order)]
        for k, row in along.items():
            for j, c in row.items():
                if isinstance(j, int) and j != k and c != 0:
                    turn[j][k] = -c
                    rates[j] = plus(rates[j], {key: -c * v for key, v in kept[k].items()})
        sectors = [replace(sector, argument=_turned(sector.argument, along)) for sector in self.sectors]
        return SectorLoop(rates, sectors, [_turned(output, along) for output in self.outputs], self.leaks, turn)


def _turned(argument: Polynomial, along: Mapping[int, Mapping[object, fmpq]]) -> Polynomial:
    """A linear function in the other coordinates."""
    found = dict(argument)
    for k, row in along.items():
        c = sum((argument.get((j,), fmpq(0)) * v for j, v in row.items() if isinstance(j, int)), fmpq(0))
        found[(k,)] = c
    return {key: c for key, c in found.items() if c != 0}


def plus(a: Polynomial, b: Polynomial) -> Polynomial:
    """The sum."""
    return {key: a.get(key, fmpq(0)) + b.get(key, fmpq(0)) for key in a.keys() | b.keys()}


@dataclass(frozen=True, eq=False)
class _Drift:
    """``x~'`` as polynomials in x~ and in what the law adds to u*, and functions of linear arguments.

    Attributes:
        n: how many states are.
        rows: for each state the terms, by the positions of the symbols x, u and of the functions, and coefficients.
        inner: the arguments of the functions as rows over x, and the ends of their slopes.
    """

    n: int
    rows: list[list[tuple[tuple[int, ...], fmpq]]]
    inner: list[tuple[list[fmpq], fmpq, fmpq | None]]

    @staticmethod
    def of(situation: Situation) -> _Drift | None:
        plant, system, point = situation.plant, situation.plant.system, situation.point
        exact = all(isinstance(v, fmpq) for v in (*point.x, *point.u))
        moved = system.xdot
        if exact:
            star = [ca.vertcat(*[plant.number(fraction(v), alone=True) for v in part]) for part in (point.x, point.u)]
            symbols = ca.vertcat(system.x, system.u)
            moved = ca.substitute(moved, symbols, symbols + ca.vertcat(*star))
        field, (rate,) = plant.exact(moved)
        if undefined(field, Everywhere(), system.n):
            return None  # what cancels in a formula has no value beyond its poles either
        inner = _Inner(field, system.n, system.n + system.m)
        rows = []
        for value in rate.column(field.const(0)):
            row = list(inner.terms(value)) if value.is_polynomial() else [None]
            if any(term is None or (len(term[0]) > 1 and not exact) for term in row):
                return None
            rows.append([term for term in row if term is not None and term[0]])
        return _Drift(system.n, rows, inner.found)

    def rate(
        self, row: Sequence[tuple[tuple[int, ...], fmpq]], channels: Sequence[Sequence[int]], first: int
    ) -> Polynomial:
        """A row with ``-sum`` of the channel's variables for each input; functions stand from ``first`` on."""
        last, found = self.n + len(channels), {}  # type: int, Polynomial
        for used, c in row:
            sides = [
                [k] if k < self.n else list(channels[k - self.n]) if k < last else [first + k - last] for k in used
            ]
            sign = (-1) ** sum(self.n <= k < last for k in used)
            for chosen in product(*sides):
                key = tuple(sorted(chosen))
                found[key] = found.get(key, fmpq(0)) + sign * c
        return found


class _Inner:
    """The functions in f that stand alone, times a number, with affine arguments in x."""

    def __init__(self, field: Field, states: int, symbols: int) -> None:
        self.field, self.states, self.symbols = field, states, symbols
        self.found: list[tuple[list[fmpq], fmpq, fmpq | None]] = []
        self.places: dict[int, int] = {}

    def terms(self, value: Quotient) -> Iterator[tuple[tuple[int, ...], fmpq] | None]:
        """The positions of the symbols and functions of each term, and its coefficient; None for any other term."""
        for exponents, c in value.numerator.to_dict().items():
            used = [k for k, e in enumerate(exponents) for _ in range(int(e))]
            if all(k < self.symbols for k in used):
                yield tuple(used), c
            elif len(used) == 1:
                yield self._function(used[0], c)
            else:
                yield None

    def _function(self, k: int, c: fmpq) -> tuple[tuple[int, ...], fmpq] | None:
        """c times a function as a term: one without an argument is a constant."""
        atom = self.field.atoms.get(k)
        row = None if atom is None or atom.kind not in _SLOPES else self._row(atom.argument)
        if atom is None or row is None:
            return None
        if not any(row):
            return (), c
        if k not in self.places:
            least, most = _SLOPES[atom.kind]
            self.places[k] = len(self.found)
            self.found.append((row, fmpq(least), None if most is None else fmpq(most)))
        return (self.symbols + self.places[k],), c

    def _row(self, argument: Quotient) -> list[fmpq] | None:
        """The coefficients of an affine function of x."""
        row = [fmpq(0)] * self.states
        if not argument.is_polynomial():
            return None
        for exponents, c in argument.numerator.to_dict().items():
            used = [k for k, e in enumerate(exponents) for _ in range(int(e))]
            if len(used) > 1 or any(k >= self.states for k in used):
                return None
            for k in used:
                row[k] += c
        return row


def _constant_slope(plant: Plant, function: ca.SX | None) -> list[list[fmpq]] | None:
    """The Jacobian of an affine function, or None."""
    if function is None:
        return None
    field, (values, slope) = plant.exact(function, ca.jacobian(function, plant.system.x))
    if not all(v.is_polynomial() for row in values.dense(field.const(0)) for v in row):
        return None
    inner = [*(atom.argument for atom in field.atoms.values()), *field.divisors.values()]
    if any(k < plant.system.n for part in inner for k in part.symbols()):
        return None
    rows = [[entry.constant() for entry in row] for row in slope.dense(field.const(0))]
    exact = [[v for v in row if v is not None] for row in rows]
    return exact if all(len(a) == len(b) for a, b in zip(rows, exact, strict=True)) else None


def _saturations(
    base: DynamicExtension | NaturalDamping, N: Sequence[Sequence[fmpq]], E: Sequence[Sequence[fmpq]], n: int
) -> list[Sector]:
    """``alpha_c tanh(beta_c z_c)``, then ``alpha_l tanh(beta_l z_l)``."""
    m = len(N)
    if isinstance(base, DynamicExtension):
        return _sectors([_linear(row) | {(n + i,): fmpq(1)} for i, row in enumerate(N)], base.alpha, base.beta)
    arguments = []
    for i, weights in enumerate(base.Upsilon or ()):
        seen = [sum((rational(w) * row[k] for w, row in zip(weights, E, strict=True)), fmpq(0)) for k in range(n)]
        arguments.append(_linear(seen) | {(n + m + j,): rational(v) for j, v in enumerate(base.K_l[i]) if v})
    first = _sectors([_linear(row) | {(n + i,): fmpq(1)} for i, row in enumerate(N)], base.alpha_c, base.beta_c)
    return [*first, *_sectors(arguments, base.alpha_l, base.beta_l)]


def _sectors(arguments: Sequence[Polynomial], alpha: Vector, beta: Vector) -> list[Sector]:
    return [Sector(z, fmpq(0), rational(a * b)) for z, a, b in zip(arguments, alpha, beta, strict=True)]


def _filters(base: DynamicExtension | NaturalDamping, n: int, order: int) -> list[Polynomial]:
    """``x_c' = -R_c (phi_c + K_c x_c)`` and ``x_l' = -R_l phi_l``."""
    R, K = ([[rational(v) for v in row] for row in gain] for gain in (base.R_c, base.K_c))
    m, rates = len(R), []
    for row in R:
        own: Polynomial = {(order + j,): -v for j, v in enumerate(row)}
        own |= {(n + j,): -sum((v * K[i][j] for i, v in enumerate(row)), fmpq(0)) for j in range(m)}
        rates.append(own)
    slow: Matrix = () if isinstance(base, DynamicExtension) else base.R_l
    for slow_row in slow:
        rates.append({(order + m + j,): -rational(v) for j, v in enumerate(slow_row) if v})
    return rates


def _leaks(law: Law) -> list[fmpq] | None:
    """``r / (alpha beta)^2`` for each filter psi; None where one does not leak by itself. Without filters: nothing."""
    if not isinstance(law, Integral):
        return []
    gains = enumerate(zip(law.alpha_psi, law.beta_psi, law.R_psi, strict=True))
    found = [(row[i] / (a * b) ** 2, any(v for j, v in enumerate(row) if j != i)) for i, (a, b, row) in gains]
    return None if any(leak <= 0 or mixed for leak, mixed in found) else [rational(leak) for leak, _ in found]


def _linear(row: Sequence[fmpq]) -> Polynomial:
    return {(k,): v for k, v in enumerate(row) if v != 0}
