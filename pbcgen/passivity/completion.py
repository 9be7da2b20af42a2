"""The equations of an equilibrium under a target: what follows linearly, and a search for the rest.

What linear elimination over the rationals gives is exact. The other unknowns are found by Newton's method from many
starts and enclosed by Krawczyk's test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np
from flint import arb, fmpq, fmpq_mpoly
from numpy.typing import NDArray

from pbcgen.models.design import Design
from pbcgen.passivity.assignable import greedy_rows, residual_of
from pbcgen.passivity.construction import drift_by_construction
from pbcgen.passivity.plant import Plant, Point
from pbcgen.proof.newton import Search, System, find_zeros, krawczyk, polish
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT, Row, determined, reduce_rows
from pbcgen.symbolic.real import Real, fraction, lower, midpoint, rational, upper

#: Equations with more terms are not searched for powers of a linear function.
_MOST_TERMS = 200
#: Coordinates of an equilibrium with a larger denominator are not taken for rationals.
_LARGEST_DENOMINATOR = 10**9


@dataclass(frozen=True)
class Equations:
    """Square or not: residuals in (x, u) with the rationals already known."""

    plant: Plant
    names: tuple[str, ...]
    expressions: ca.SX
    labels: tuple[str, ...]

    @staticmethod
    def of(plant: Plant, design: Design) -> Equations:
        """``f + g u = 0`` and the conditions of the design's target."""
        system = plant.system
        conditions = design.target.conditions
        residuals = ca.vertcat(_at_rest(plant), *[residual_of(c) for c in conditions])
        labels = (*[f"d{n}/dt" for n in system.state_names], *[f"target {c.name}" for c in conditions])
        return Equations(plant, (*system.state_names, *system.input_names), residuals, labels)


def _at_rest(plant: Plant) -> ca.SX:
    """What is zero exactly where ``f + g u`` is: for a mechanical system p and ``G u - grad V``, without M^-1."""
    system, mechanics = plant.system, plant.system.mechanical
    if mechanics is None or not (plant.gradient_is_exact and drift_by_construction(system)):
        return system.xdot
    return ca.vertcat(mechanics.p, ca.mtimes(mechanics.G, system.u) - ca.gradient(mechanics.V, mechanics.q))


def linear_consequences(equations: Equations) -> dict[str, Fraction]:
    """The unknowns that linear equations over the rationals determine, found in rounds. Raises Inconsistent."""
    known: dict[str, Fraction] = {}
    while True:
        field, (residuals,) = equations.plant.exact(equations.expressions, known=known)
        rows = [
            row
            for quotient in residuals.column(field.const(0))
            if (row := _linear_row(quotient, equations.names)) is not None
        ]
        values = {str(k): fraction(v) for k, v in determined(reduce_rows(rows), fmpq(0)).items()}
        if not values:
            return known
        known |= values


def _linear_row(quotient: Quotient, names: Sequence[str]) -> Row | None:
    """The equation ``numerator = 0`` as a row when it is linear in the unknowns with rational coefficients.

    A power of a linear function, as a cubic spring leaves at rest, is zero where the function is.
    """
    row: Row = {}
    for exponents, coefficient in _base(quotient.numerator).to_dict().items():
        used = [k for k, e in enumerate(exponents) if e]
        if not used:
            row[CONSTANT] = coefficient
        elif len(used) == 1 and exponents[used[0]] == 1 and used[0] < len(names):
            row[names[used[0]]] = coefficient
        else:
            return None
    return row


def _base(numerator: fmpq_mpoly) -> fmpq_mpoly:
    """p for a numerator that is a constant times a power of p, else the numerator."""
    if len(numerator) > _MOST_TERMS or numerator.total_degree() < 2:
        return numerator
    _, factors = numerator.factor_squarefree()
    return factors[0][0] if len(factors) == 1 else numerator


def point_of(plant: Plant, values: Mapping[str, Real]) -> Point:
    """The point with these values of states and inputs by name."""
    system = plant.system
    return Point(tuple(values[n] for n in system.state_names), tuple(values[n] for n in system.input_names))


@dataclass(frozen=True)
class SquareSystem:
    """As many of the remaining equations as unknowns, chosen with independent gradients."""

    plant: Plant
    known: Mapping[str, Fraction]
    unknown: tuple[str, ...]
    expressions: ca.SX
    jacobian: ca.SX
    search: Search
    rows: tuple[int, ...]

    @staticmethod
    def choose(
        plant: Plant, design: Design, equations: Equations, known: Mapping[str, Fraction], unknown: list[str]
    ) -> SquareSystem | None:
        """The square system in the unknown names, or None when the equations do not determine them."""
        symbols = ca.vertcat(plant.system.x, plant.system.u)
        wanted = ca.vertcat(*[symbols[equations.names.index(name)] for name in unknown])
        jacobian = ca.jacobian(equations.expressions, wanted)
        search = _search_box(plant, design, unknown)
        rows = _independent_rows(plant, jacobian, equations.names, known, unknown, search)
        if len(rows) < len(unknown):
            return None
        return SquareSystem(
            plant,
            known,
            tuple(unknown),
            equations.expressions[rows],
            jacobian[rows, :],
            search,
            tuple(rows),
        )

    def zeros(self) -> list[NDArray[np.float64]]:
        """Zeros in doubles, by Newton's method from the starts of the search."""
        function = self.plant.doubles(self.expressions, self.jacobian)

        def system(z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            value, jacobian = function(*self._numbers(z))
            return value.ravel(), jacobian

        return find_zeros(system, self.search)

    def enclose(self, zero: NDArray[np.float64]) -> Point | None:
        """Balls around a zero that hold exactly one, by Krawczyk's test, or its coordinates; None if that fails."""
        tape = self.plant.tape(self.expressions, self.jacobian)

        def system(z: list[Real]) -> tuple[list[Real], list[list[Real]]]:
            point = self._point(z)
            value, jacobian = self.plant.walk(tape, point.x, point.u)
            return [row[0] for row in value], jacobian

        centre = polish(system, zero.tolist())
        balls = None if centre is None else krawczyk(system, centre)
        return None if balls is None or centre is None else self._point(_with_rationals(system, centre, balls))

    def _point(self, z: list[Real]) -> Point:
        values = {name: rational(value) for name, value in self.known.items()} | dict(zip(self.unknown, z, strict=True))
        return point_of(self.plant, values)

    def _numbers(self, z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        values = {**{k: float(v) for k, v in self.known.items()}, **dict(zip(self.unknown, z, strict=True))}
        system = self.plant.system
        return (
            np.array([values[name] for name in system.state_names]),
            np.array([values[name] for name in system.input_names]),
        )


def _with_rationals(system: System, centre: Sequence[Fraction], balls: Sequence[arb]) -> list[Real]:
    """The zero with the coordinates that are short rationals.

    With these put in, some equations must hold exactly whatever the other coordinates are in their balls, and there
    must be as many others as coordinates that are left, with one zero by Krawczyk's test. It is in the box of the first
    test, which has one zero only.
    """
    short = [_short_rational(b) for b in balls]
    left = [k for k, value in enumerate(short) if value is None]
    if len(left) == len(balls):
        return list(balls)

    def put_in(z: Sequence[Real]) -> list[Real]:
        others = iter(z)
        return [next(others) if value is None else rational(value) for value in short]

    def holds(z: Sequence[Real]) -> list[bool]:
        return [isinstance(v, fmpq) and v == 0 for v in system(put_in(z))[0]]

    rows = [i for i, certain in enumerate(holds([balls[k] for k in left])) if not certain]

    def smaller(z: list[Real]) -> tuple[list[Real], list[list[Real]]]:
        value, jacobian = system(put_in(z))
        return [value[i] for i in rows], [[jacobian[i][k] for k in left] for i in rows]

    if len(rows) != len(left):
        return list(balls)
    found = krawczyk(smaller, [centre[k] for k in left]) if left else []
    if found is None or not all(certain or i in rows for i, certain in enumerate(holds(found))):
        return list(balls)
    return put_in(found)


def _short_rational(value: arb) -> Fraction | None:
    """The simplest number in an enclosure if it is short, else None."""
    simple = midpoint(value).limit_denominator(_LARGEST_DENOMINATOR)
    return simple if lower(value) <= simple <= upper(value) else None


def _search_box(plant: Plant, design: Design, unknown: Sequence[str]) -> Search:
    domain = plant.system.domain
    near = {name: float(value) for name, value in design.near.items()}
    bounds = [domain.get(name, (None, None)) for name in unknown]
    lo = np.array([-np.inf if b[0] is None else float(b[0]) for b in bounds])
    hi = np.array([np.inf if b[1] is None else float(b[1]) for b in bounds])
    start = np.array([near.get(name, 0.0) for name in unknown])
    return Search(lo, hi, (np.clip(start, lo, hi),))


def _independent_rows(
    plant: Plant,
    jacobian: ca.SX,
    names: Sequence[str],
    known: Mapping[str, Fraction],
    unknown: Sequence[str],
    search: Search,
) -> list[int]:
    """Rows of the Jacobian that are independent at generic points, greedily from the first."""
    function = plant.doubles(jacobian)
    generator = np.random.default_rng(1)
    best: list[int] = []
    for _ in range(5):
        values = {**{k: float(v) for k, v in known.items()}}
        width = np.minimum(search.upper - search.lower, 1.0)
        around = np.clip(0.0, search.lower, search.upper) + width * generator.uniform(-1.0, 1.0, len(unknown))
        sample = np.clip(around, search.lower, search.upper)
        values |= dict(zip(unknown, sample, strict=True))
        x = np.array([values[n] for n in names[: plant.system.n]])
        u = np.array([values[n] for n in names[plant.system.n :]])
        rows = greedy_rows(*function(x, u))
        if len(rows) > len(best):
            best = rows
    return best
