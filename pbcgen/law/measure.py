"""Writing what a law needs in terms of what is measured.

A signal e(x) can be read when it depends on measured states only, or when a constant combination of the measured
expressions leaves a rest that does. Both are exact identities. Affine signals are written as ``sum c_i (m_i - m_i*)``,
so that the difference to the target loses no digits in single precision.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from math import lcm

import casadi as ca
from flint import fmpq

from pbcgen.errors import UnsupportedOperation
from pbcgen.law.settings import Settings
from pbcgen.passivity.plant import Plant, Point
from pbcgen.symbolic.coefficients import Coefficients, Monomial
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.real import BITS, Real, approximate, fraction, precision, rational, text
from pbcgen.symbolic.tape import exact_decimal


@dataclass(frozen=True, eq=False)
class Reading:
    """A signal in terms of the measurement.

    Attributes:
        deviation: ``e - e*`` as SX in the measurement symbols.
        value: e itself, likewise.
        affine: the coefficients by measured name when e is affine in the measured signals, else None.
    """

    deviation: ca.SX
    value: ca.SX
    affine: Mapping[str, Fraction] | None


@dataclass(frozen=True)
class Unreadable:
    """Why a signal cannot be read.

    Attributes:
        signal: its name.
        reason: for the evidence of a verdict.
        direction: v that the sensors do not see but the signal does, if certain.
        hidden: the states that it depends on and that no sensor reads.
    """

    signal: str
    reason: str
    direction: dict[str, str] | None
    hidden: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Measurement:
    """The measured signals as symbols.

    Numbers that are not decimals of double length (an irrational target, say) enter formulas as symbols of
    ``constants``, so that proofs use their enclosures and only the emitted code their rounded values.
    """

    plant: Plant
    point: Point
    symbols: ca.SX
    settings: Settings = field(default_factory=Settings)

    @staticmethod
    def of(plant: Plant, point: Point, settings: Settings | None = None) -> Measurement:
        """One symbol for each measured signal, in the order of the controller's input."""
        names = plant.system.measured_names
        symbols = ca.vertcat(*[ca.SX.sym(name) for name in names])
        return Measurement(plant, point, symbols, settings or Settings())

    @property
    def constants(self) -> list[tuple[ca.SX, Real]]:
        """The symbols in the formulas that stand for numbers, with their exact or enclosed values."""
        return self.settings.constants

    def star(self, signal: ca.SX, value: Real, name: str, unit: str = "") -> ca.SX:
        """The value of a signal e(x, u) at the target, for use in formulas; it moves if the target may."""
        moving = self.settings.star(signal, value, f"{name}_star", unit)
        return self.constant(value) if moving is None else moving

    def constant(self, value: Real) -> ca.SX:
        """A number for use in formulas."""
        if isinstance(value, fmpq) and exact_decimal(approximate(value)) == fraction(value):
            return ca.SX(approximate(value))
        return self._symbol(value)

    def _symbol(self, value: Real) -> ca.SX:
        """A number that CasADi must not compute with: it would round quotients of parameters."""
        symbol = ca.SX.sym(f"constant_{len(self.constants)}")
        self.constants.append((symbol, value))
        return symbol

    def read(self, signal: ca.SX, name: str) -> Reading | Unreadable:
        """Write a scalar signal e(x) in the measurement."""
        try:
            return self._combination(signal, name)
        except (UnsupportedOperation, ZeroDivisionError) as reason:
            if set(_states_of(self.plant, signal)) <= set(self._direct):
                return self._nonlinear(signal, name)
            return Unreadable(name, f"{reason}", None)

    @cached_property
    def _direct(self) -> dict[str, ca.SX]:
        """The states that are measured as such."""
        names = self.plant.system.measured_names
        symbols = dict(zip(names, ca.vertsplit(self.symbols), strict=True))
        return {name: symbols[name] for name in names if name in self.plant.system.state_names}

    def _combination(self, signal: ca.SX, name: str) -> Reading | Unreadable:
        weights = self._weights(signal)
        if weights is None:
            return self._unreadable(signal, name)
        system = self.plant.system
        rest = _rest(signal, weights, system.measured)
        field, (values,) = self.plant.exact(rest)
        value = values.scalar(field.const(0))
        hidden = {k for k, state in enumerate(system.state_names) if state not in self._direct}
        if value.symbols() & hidden:
            return self._unreadable(signal, name)  # its slopes vanish, but it may jump, as q - atan(tan(q)) does
        affine = _affine(value.numerator.to_dict(), field.symbol_count) if value.is_polynomial() else None
        if affine is None or any(field.names[k] not in self._direct for k in affine):
            return self._with_rest(rest, weights, name)
        total = {field.names[k]: fraction(c) for k, c in affine.items()}
        for key, weight in weights.items():
            total[key] = total.get(key, Fraction(0)) + weight
        return self._affine_reading(signal, {k: c for k, c in total.items() if c}, name)

    def _weights(self, signal: ca.SX) -> dict[str, Fraction] | None:
        """Constants c with ``e - sum c_j h_j`` independent of the states that are not measured as such."""
        system = self.plant.system
        hidden = [k for k, name in enumerate(system.state_names) if name not in self._direct]
        expressions = [name for name in system.measured_names if name not in system.state_names]
        if not hidden:
            return {}
        unseen = ca.vertcat(*[system.x[k] for k in hidden])
        stacked = ca.vertcat(signal, *[system.measured[name] for name in expressions])
        field, (jacobian,) = self.plant.exact(ca.jacobian(stacked, unseen))
        zero = field.const(0)
        coefficients = Coefficients(field)
        splits = [[coefficients.split(entry) for entry in row] for row in jacobian.dense(zero)]
        rows: list[Row] = []
        for cells in zip(*splits, strict=True):
            known = [cell for cell in cells if cell is not None]
            if len(known) < len(cells):
                return None
            rows += _equations(expressions, known)
        try:
            solution = particular_solution(reduce_rows(rows), fmpq(0))
        except Inconsistent:
            return None
        return {str(k): fraction(v) for k, v in solution.items() if v != 0}

    def _affine_reading(self, signal: ca.SX, weights: Mapping[str, Fraction], name: str) -> Reading:
        terms = [self.constant(rational(c)) * moved for c, moved in self._moved(weights)]
        deviation = sum(terms[1:], terms[0]) if terms else ca.SX(0)
        (star,) = self._at_target([signal])
        return Reading(deviation, deviation + self.star(signal, star, name), dict(weights))

    def _moved(self, weights: Mapping[str, Fraction]) -> list[tuple[Fraction, ca.SX]]:
        """Each weight with the deviation of its measured signal from the target."""
        system = self.plant.system
        symbols = dict(zip(system.measured_names, ca.vertsplit(self.symbols), strict=True))
        stars = self._at_target([system.measured[name] for name in weights])
        return [
            (c, symbols[name] - self.star(system.measured[name], star, name, system.units.get(name, "")))
            for (name, c), star in zip(weights.items(), stars, strict=True)
        ]

    def _with_rest(self, rest: ca.SX, weights: Mapping[str, Fraction], name: str) -> Reading:
        nonlinear = self._nonlinear(rest, name)
        if not weights:
            return nonlinear
        symbols = dict(zip(self.plant.system.measured_names, ca.vertsplit(self.symbols), strict=True))
        combined = sum((self.constant(rational(c)) * symbols[key] for key, c in weights.items()), ca.SX(0))
        moved = sum((self.constant(rational(c)) * deviation for c, deviation in self._moved(weights)), ca.SX(0))
        return Reading(nonlinear.deviation + moved, nonlinear.value + combined, None)

    def _nonlinear(self, signal: ca.SX, name: str) -> Reading:
        """Substitute measured states; hidden ones, on which the signal does not depend, take their target values."""
        system = self.plant.system
        direct = self._direct
        states = [
            direct[name] if name in direct else self.constant(star)
            for name, star in zip(system.state_names, self.point.x, strict=True)
        ]
        used = {symbol.name() for symbol in ca.symvar(signal)}
        parameters = ca.vertcat(
            *[
                self._symbol(rational(self.plant.values[n])) if n in used else ca.SX(0)
                for n in self.plant.parameter_names
            ]
        )
        value = ca.substitute(signal, system.x, ca.vertcat(*states))
        if self.plant.parameter_names:
            value = ca.substitute(value, self.plant.parameter_symbols, parameters)
        (star,) = self._at_target([signal])
        own = self.star(signal, star, name)
        deviation = value if own.is_zero() else value - own
        return Reading(deviation, value, None)

    def _at_target(self, signals: Sequence[ca.SX]) -> list[Real]:
        return [matrix[0][0] for matrix in self.plant.at(self.point, *signals)]

    def _unreadable(self, signal: ca.SX, name: str) -> Unreadable:
        hidden = [s for s in _states_of(self.plant, signal) if s not in self._direct]
        reason = f"{name} depends on {', '.join(hidden)}, which the measured signals do not give"
        return Unreadable(name, reason, self._blind_direction(signal), tuple(hidden))

    def _blind_direction(self, signal: ca.SX) -> dict[str, str] | None:
        """v with ``grad h v = 0`` for every measured h and ``grad e v != 0`` at x*, in exact or ball arithmetic."""
        system = self.plant.system
        seen, slope = self.plant.at(
            self.point,
            ca.densify(ca.jacobian(system.measured_expressions, system.x)),
            ca.densify(ca.jacobian(signal, system.x)),
        )
        if not all(isinstance(v, fmpq) for row in [*seen, *slope] for v in row):
            return None
        rows: list[Row] = [dict(enumerate(row)) for row in seen]
        rows.append({**dict(enumerate(slope[0])), CONSTANT: fmpq(-1)})
        try:
            with precision(BITS):
                solution = particular_solution(reduce_rows(rows), fmpq(0))
        except Inconsistent:
            return None
        return {s: text(solution.get(k, fmpq(0))) for k, s in enumerate(system.state_names)}


def _rest(signal: ca.SX, weights: Mapping[str, Fraction], measured: Mapping[str, ca.SX]) -> ca.SX:
    """``e - sum c_j h_j`` with integers in the place of fractions, so that it is exact as a graph of doubles."""
    if not weights:
        return signal
    common = lcm(*[c.denominator for c in weights.values()])
    total = signal * float(common)
    for name, weight in weights.items():
        total = total - float(weight * common) * measured[name]
    return total / float(common)


def _equations(names: Sequence[str], cells: Sequence[Mapping[Monomial, Quotient]]) -> list[Row]:
    """``sum c_j cell_j = cell_0``, one equation for each power product, for the numbers c_j of these names."""
    signal, *others = cells
    rows: list[Row] = []
    for product in sorted({product for cell in cells for product in cell}):
        row: Row = {name: cell[product].constant() for name, cell in zip(names, others, strict=True) if product in cell}
        if product in signal:
            row[CONSTANT] = -_plain(signal[product].constant())
        rows.append(row)
    return rows


def _plain(value: fmpq | None) -> fmpq:
    if value is None:
        raise UnsupportedOperation("a coefficient is not a number")
    return value


def _states_of(plant: Plant, signal: ca.SX) -> list[str]:
    return [name for k, name in enumerate(plant.system.state_names) if ca.depends_on(signal, plant.system.x[k])]


def _affine(terms: Mapping[tuple[int, ...], fmpq], symbols: int) -> dict[int, fmpq] | None:
    """Coefficients of an affine polynomial in symbols, without its constant term; None if it is not affine."""
    result: dict[int, fmpq] = {}
    for exponents, coefficient in terms.items():
        used = [k for k, e in enumerate(exponents) if e]
        if not used:
            continue
        if len(used) > 1 or exponents[used[0]] != 1 or used[0] >= symbols:
            return None
        result[used[0]] = coefficient
    return result
