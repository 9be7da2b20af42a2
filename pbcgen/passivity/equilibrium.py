"""The equilibrium x* that a target asks for, and its input u* = -kappa (kappa).

The unknowns are x* and u*; the equations are ``f(x) + g(x) u = 0`` and the conditions of the target. What follows
from them by linear elimination over the rationals is exact. The rest is found by Newton's method from many starts
and enclosed by Krawczyk's test, which proves that a true equilibrium lies in the enclosure, and only one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np
from flint import fmpq
from numpy.typing import NDArray

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.design import Condition, Design
from pbcgen.passivity.plant import Plant, Point
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import positive_definite
from pbcgen.proof.newton import Search, find_zeros, krawczyk, polish
from pbcgen.symbolic.display import formula
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, determined, reduce_rows
from pbcgen.symbolic.real import (
    BITS,
    Real,
    approximate,
    fraction,
    is_finite,
    lower,
    precision,
    radius,
    rational,
    sign,
    text,
    upper,
)
from pbcgen.symbolic.tape import exact_decimal


@dataclass(frozen=True)
class Equilibrium:
    """The outcome of completing a target.

    Attributes:
        claim: the verdict `equilibrium`.
        point: x* and u*, or None when there is none (or more than one to choose from).
        completions: all that were found, rounded, as x by state name.
    """

    claim: Claim
    point: Point | None
    completions: tuple[Mapping[str, float], ...] = ()


@dataclass(frozen=True)
class _Equations:
    """Square or not: residuals in (x, u) with the rationals already known."""

    plant: Plant
    names: tuple[str, ...]
    expressions: ca.SX
    labels: tuple[str, ...]

    @staticmethod
    def of(plant: Plant, design: Design) -> _Equations:
        system = plant.system
        conditions = design.target.conditions
        residuals = ca.vertcat(system.xdot, *[_residual(c) for c in conditions])
        labels = (*[f"d{n}/dt" for n in system.state_names], *[f"target {c.name}" for c in conditions])
        return _Equations(plant, (*system.state_names, *system.input_names), residuals, labels)


def _residual(condition: Condition) -> ca.SX:
    """``expression - value``, or a multiple of it when the value has no exact decimal of double length."""
    value = condition.value
    if exact_decimal(float(value)) == value:
        return condition.expression - float(value)
    return condition.expression * float(value.denominator) - float(value.numerator)


def complete(plant: Plant, design: Design) -> Equilibrium:
    """Find and enclose the equilibrium that the design's target determines."""
    equations = _Equations.of(plant, design)
    try:
        known = _linear_consequences(equations)
    except Inconsistent as contradiction:
        return _refuted(plant, design, contradiction)
    except (UnsupportedOperation, ZeroDivisionError):
        known = _target_values(design)
    unknown = [name for name in equations.names if name not in known]
    if not unknown:
        return _verify(plant, design, equations, known)
    return _search(plant, design, equations, known, unknown)


def _target_values(design: Design) -> dict[str, Fraction]:
    states = set(design.system.state_names)
    return {c.name: c.value for c in design.target.conditions if c.name in states}


def _linear_consequences(equations: _Equations) -> dict[str, Fraction]:
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
    """The equation ``numerator = 0`` as a row when it is linear in the unknowns with rational coefficients."""
    row: Row = {}
    for exponents, coefficient in quotient.numerator.to_dict().items():
        used = [k for k, e in enumerate(exponents) if e]
        if not used:
            row[CONSTANT] = coefficient
        elif len(used) == 1 and exponents[used[0]] == 1 and used[0] < len(names):
            row[names[used[0]]] = coefficient
        else:
            return None
    return row


def _verify(plant: Plant, design: Design, equations: _Equations, known: Mapping[str, Fraction]) -> Equilibrium:
    """Everything is rational: put it into all equations."""
    point = _point(plant, {name: rational(value) for name, value in known.items()})
    (residuals,) = plant.at(point, equations.expressions)
    values = [row[0] for row in residuals]
    if any(sign(v) in (1, -1) for v in values):
        return _not_assignable(plant, design, equations, point, values)
    if all(sign(v) == 0 for v in values):
        outside = _outside_domain(plant, _by_name(plant, point))
        if outside:
            return outside
        evidence = f"f(x*) + g(x*) u* = 0 exactly at {_show(plant, point)}"
        return Equilibrium(_proved(plant, point, "linear elimination over the rationals", evidence), point)
    return Equilibrium(_undecided("the residual is enclosed by balls around zero", values), None)


def _search(
    plant: Plant, design: Design, equations: _Equations, known: Mapping[str, Fraction], unknown: list[str]
) -> Equilibrium:
    """Newton from many starts on the equations that are left, then an enclosure of each zero."""
    given = {name: rational(value) for name, value in known.items()}
    outside = _outside_domain(plant, given)
    if outside:
        return outside
    square = _SquareSystem.choose(plant, design, equations, known, unknown)
    if square is None:
        return _underdetermined(plant, design, known, unknown)
    with precision(BITS):
        points = [p for z in square.zeros() if (p := square.enclose(z)) is not None]
    points = [p for p in points if _outside_domain(plant, _by_name(plant, p)) is None]
    completions = tuple(_rounded(plant, p) for p in points)
    if not points:
        return _no_zero(plant, design, equations, square)
    if len(points) > 1 and not design.near:
        return Equilibrium(_ambiguous(completions), None, completions)
    point = points[0]
    if len(points) > 1:
        point = min(points, key=lambda p: _distance(plant, p, design.near))
    return _accept(plant, design, equations, square, point, completions)


def _accept(
    plant: Plant,
    design: Design,
    equations: _Equations,
    square: _SquareSystem,
    point: Point,
    completions: tuple[Mapping[str, float], ...],
) -> Equilibrium:
    """The verdict on a zero of the square system: the equations that it left out must hold too, exactly."""
    (residuals,) = plant.at(point, equations.expressions)
    values = [row[0] for row in residuals]
    if any(sign(v) in (1, -1) for v in values):
        return _not_assignable(plant, design, equations, point, values)
    open_rows = [i for i, v in enumerate(values) if i not in square.rows and sign(v) != 0]
    if not all(_implied(plant, equations.expressions[i], square) for i in open_rows):
        why = f"{len(open_rows)} equations beyond the unknowns hold within balls only"
        return Equilibrium(_undecided(why, values), None, completions)
    size = max(radius(v) for v in (*point.x, *point.u))
    evidence = f"one zero of f + g u in a ball of radius {float(size):.1e} around {_show(plant, point)}"
    return Equilibrium(_proved(plant, point, "Krawczyk test in ball arithmetic", evidence), point, completions)


def _implied(plant: Plant, expression: ca.SX, square: _SquareSystem) -> bool:
    """Whether an equation is a combination, with constant coefficients, of those of the square system."""
    try:
        field, (values,) = plant.exact(ca.vertcat(expression, square.expressions), known=square.known)
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    functions = values.column(field.const(0))
    if not all(function.is_polynomial() for function in functions):
        return False
    rows: dict[object, Row] = {}
    for k, function in enumerate(functions):
        for exponents, coefficient in function.numerator.to_dict().items():
            key, value = (CONSTANT, -coefficient) if k == 0 else (k, coefficient)
            rows.setdefault(tuple(exponents), {})[key] = value
    try:
        reduce_rows(rows.values())
    except Inconsistent:
        return False
    return True


@dataclass(frozen=True)
class _SquareSystem:
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
        plant: Plant, design: Design, equations: _Equations, known: Mapping[str, Fraction], unknown: list[str]
    ) -> _SquareSystem | None:
        symbols = ca.vertcat(plant.system.x, plant.system.u)
        wanted = ca.vertcat(*[symbols[equations.names.index(name)] for name in unknown])
        jacobian = ca.jacobian(equations.expressions, wanted)
        search = _search_box(plant, design, unknown)
        rows = _independent_rows(plant, jacobian, equations.names, known, unknown, search)
        if len(rows) < len(unknown):
            return None
        return _SquareSystem(
            plant,
            known,
            tuple(unknown),
            equations.expressions[rows],
            jacobian[rows, :],
            search,
            tuple(rows),
        )

    def zeros(self) -> list[NDArray[np.float64]]:
        function = self.plant.numeric(self.expressions, self.jacobian)

        def system(z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            x, u = self._numbers(z)
            value, jacobian = function(x, u)
            return np.array(value).ravel(), np.array(ca.densify(jacobian))

        return find_zeros(system, self.search)

    def enclose(self, zero: NDArray[np.float64]) -> Point | None:
        tape = self.plant.tape(self.expressions, self.jacobian)

        def system(z: list[Real]) -> tuple[list[Real], list[list[Real]]]:
            point = self._point(z)
            value, jacobian = self.plant.walk(tape, point.x, point.u)
            return [row[0] for row in value], jacobian

        centre = polish(system, zero.tolist())
        balls = None if centre is None else krawczyk(system, centre)
        return None if balls is None else self._point(list(balls))

    def _point(self, z: list[Real]) -> Point:
        values = {name: rational(value) for name, value in self.known.items()} | dict(zip(self.unknown, z, strict=True))
        return _point(self.plant, values)

    def _numbers(self, z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        values = {**{k: float(v) for k, v in self.known.items()}, **dict(zip(self.unknown, z, strict=True))}
        system = self.plant.system
        return (
            np.array([values[name] for name in system.state_names]),
            np.array([values[name] for name in system.input_names]),
        )


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
    function = plant.numeric(jacobian)
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
        rows = greedy_rows(np.array(ca.densify(function(x, u))))
        if len(rows) > len(best):
            best = rows
    return best


def greedy_rows(matrix: NDArray[np.float64]) -> list[int]:
    """Row indices that raise the rank, by Gram-Schmidt on rows of unit length."""
    basis: list[NDArray[np.float64]] = []
    chosen = []
    for i, row in enumerate(matrix):
        length = np.linalg.norm(row)
        if not np.isfinite(length) or length == 0:
            continue
        rest = row / length
        for b in basis:
            rest = rest - b * (b @ rest)
        for b in basis:
            rest = rest - b * (b @ rest)
        if np.linalg.norm(rest) > 1e-9:
            basis.append(rest / np.linalg.norm(rest))
            chosen.append(i)
    return chosen


# --- verdicts ---------------------------------------------------------------------------------------------------


def _point(plant: Plant, values: Mapping[str, Real]) -> Point:
    system = plant.system
    return Point(tuple(values[n] for n in system.state_names), tuple(values[n] for n in system.input_names))


def _rounded(plant: Plant, point: Point) -> dict[str, float]:
    return {name: approximate(value) for name, value in zip(plant.system.state_names, point.x, strict=True)}


def _show(plant: Plant, point: Point) -> str:
    system = plant.system
    pairs = [*zip(system.state_names, point.x, strict=True), *zip(system.input_names, point.u, strict=True)]
    return ", ".join(f"{name} = {text(value, 9)}" for name, value in pairs)


def _distance(plant: Plant, point: Point, near: Mapping[str, Fraction]) -> float:
    values = _rounded(plant, point)
    return sum((values[name] - float(value)) ** 2 for name, value in near.items())


def _proved(plant: Plant, point: Point, method: str, evidence: str) -> Claim:
    certificate = {
        "x": [_interval(v) for v in point.x],
        "u": [_interval(v) for v in point.u],
        "method": method,
    }
    return Claim("equilibrium", Status.PROVED, "at x*", method, evidence, certificate=certificate)


def _interval(value: Real) -> list[str]:
    return [str(lower(value)), str(upper(value))]


def _undecided(why: str, values: Sequence[Real]) -> Claim:
    if not all(is_finite(v) for v in values):
        evidence = "f or g has no certain value there: it is undefined, or jumps, or ends its range of definition"
        hint = "choose a target away from that point, or a smooth approximation of the term"
        return Claim("equilibrium", Status.UNDECIDED, "at x*", "ball arithmetic", evidence, hint)
    evidence = f"{why}; largest residual {max(abs(approximate(v)) for v in values):.3g}"
    hint = "name the target by fewer coordinates, so that the others can be completed"
    return Claim("equilibrium", Status.UNDECIDED, "at x*", "ball arithmetic", evidence, hint)


def _ambiguous(completions: Sequence[Mapping[str, float]]) -> Claim:
    listed = "; ".join(", ".join(f"{k} = {v:.9g}" for k, v in c.items()) for c in completions)
    return Claim(
        "equilibrium",
        Status.UNDECIDED,
        "at x*",
        "Krawczyk test in ball arithmetic",
        f"{len(completions)} equilibria fit the target: {listed}",
        "choose one with `near={...}`, or add a coordinate to the target",
    )


def _underdetermined(
    plant: Plant, design: Design, known: Mapping[str, Fraction], unknown: Sequence[str]
) -> Equilibrium:
    free = ", ".join(name for name in unknown)
    claim = Claim(
        "equilibrium",
        Status.UNDECIDED,
        "at x*",
        "rank of the equilibrium equations",
        f"the target leaves a family of equilibria: {free} are not determined",
        f"add conditions to the target: {plant.system.m} are usually needed, one for each input",
    )
    return Equilibrium(claim, None)


def _by_name(plant: Plant, point: Point) -> dict[str, Real]:
    return dict(zip(plant.system.state_names, point.x, strict=True))


def _outside_domain(plant: Plant, values: Mapping[str, Real]) -> Equilibrium | None:
    """The verdict when one of the values by name certainly lies outside the domain, else None."""
    for name, (lo, hi) in plant.system.domain.items():
        if name not in values:
            continue
        value = values[name]
        if (lo is not None and upper(value) < lo) or (hi is not None and lower(value) > hi):
            bounds = f"[{'-inf' if lo is None else text(rational(lo))}, {'inf' if hi is None else text(rational(hi))}]"
            claim = Claim(
                "equilibrium",
                Status.REFUTED,
                "at x*",
                "comparison with the domain",
                f"the equilibrium has {name} = {text(value, 9)}, outside the domain {bounds}",
                "choose a target inside the domain, or widen the domain",
                {"state": name, "value": approximate(value)},
            )
            return Equilibrium(claim, None)
    return None


def _no_zero(plant: Plant, design: Design, equations: _Equations, square: _SquareSystem) -> Equilibrium:
    polished = nearest_assignable(plant, design)
    near = "" if polished is None else "; nearest assignable point found: " + _pairs(polished)
    if polished is not None and not _is_smooth_at(plant, polished):
        near += ", where f or g is not differentiable"
    claim = Claim(
        "equilibrium",
        Status.UNDECIDED,
        "at x*",
        f"Newton's method from {square.search.samples} starts",
        f"no equilibrium that meets the target was found{near}",
        "check that the target is reachable, or give `near={...}` to start the search close to it",
    )
    return Equilibrium(claim, None)


def _is_smooth_at(plant: Plant, state: Mapping[str, float]) -> bool:
    """Whether f, g and their derivatives have certain finite values at a point."""
    x = tuple(rational(exact_decimal(state[name])) for name in plant.system.state_names)
    point = Point(x, tuple(rational(0) for _ in plant.system.input_names))
    flat = ca.vertcat(plant.system.f, ca.vec(ca.densify(plant.system.g)))
    entries = plant.at(point, flat, ca.densify(ca.jacobian(flat, plant.system.x)))
    return all(is_finite(v) for matrix in entries for row in matrix for v in row)


def _refuted(plant: Plant, design: Design, contradiction: Inconsistent) -> Equilibrium:
    """The linear equations contradict each other: measure by how much, at the target."""
    polished = nearest_assignable(plant, design)
    point = _best_point(plant, design)
    (residual,) = plant.at(point, plant.system.xdot)
    values = [row[0] for row in residual]
    return _residual_verdict(plant, values, polished, "linear elimination over the rationals", point)


def _not_assignable(
    plant: Plant, design: Design, equations: _Equations, point: Point, values: Sequence[Real]
) -> Equilibrium:
    polished = nearest_assignable(plant, design)
    return _residual_verdict(plant, values[: plant.system.n], polished, "residual in exact or ball arithmetic", point)


def _residual_verdict(
    plant: Plant, values: Sequence[Real], polished: Mapping[str, float] | None, method: str, point: Point
) -> Equilibrium:
    worst = max(values, key=lambda v: abs(approximate(v)))
    row = plant.system.state_names[list(values).index(worst)]
    hint = "give fewer coordinates and let pbcgen complete them"
    if polished is not None:
        hint += "; the nearest assignable point is " + _pairs(polished)
    residual = f"d{row}/dt = {text(worst, 6)} with the best u"
    claim = Claim(
        "equilibrium",
        Status.REFUTED,
        "at x*",
        method,
        f"the target is not assignable: no input makes f + g u zero there; {residual}",
        hint,
        {
            "x": [text(v, 17) for v in point.x],
            "u": [text(v, 17) for v in point.u],
            "residual": [text(v, 9) for v in values],
            "nearest": None if polished is None else dict(polished),
        },
    )
    return Equilibrium(claim, None)


def _pairs(values: Mapping[str, float]) -> str:
    return ", ".join(f"{k} = {v:.9g}" for k, v in values.items())


def _best_point(plant: Plant, design: Design) -> Point:
    """The target where it is given (zero elsewhere) with the least-squares input, as rationals."""
    given = _target_values(design)
    if design.target.full is not None:
        given = dict(zip(plant.system.state_names, design.target.full, strict=True))
    x = [given.get(name, Fraction(0)) for name in plant.system.state_names]
    function = plant.numeric(plant.system.f, plant.system.g)
    f, g = function([float(v) for v in x], np.zeros(plant.system.m))
    drift, matrix = np.array(f).ravel(), np.array(ca.densify(g))
    certain = np.all(np.isfinite(drift)) and np.all(np.isfinite(matrix))
    u = np.linalg.lstsq(matrix, -drift, rcond=None)[0] if certain else np.zeros(plant.system.m)
    finite = np.where(np.isfinite(u), u, 0.0)
    return Point(tuple(rational(v) for v in x), tuple(rational(Fraction(float(v))) for v in finite))


def nearest_assignable(plant: Plant, design: Design) -> dict[str, float] | None:
    """The assignable point closest to the target, coordinates scaled by their size; None if not found."""
    from scipy.optimize import minimize

    system = plant.system
    best = _best_point(plant, design)
    z0 = np.array([approximate(v) for v in (*best.x, *best.u)])
    n = system.n
    scale = np.maximum(np.abs(z0[:n]), 0.1 * max(float(np.max(np.abs(z0[:n]))), 1e-3))
    function = plant.numeric(system.xdot, ca.jacobian(system.xdot, ca.vertcat(system.x, system.u)))

    def residual(z: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array(function(z[:n], z[n:])[0]).ravel()

    def slope(z: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array(ca.densify(function(z[:n], z[n:])[1]))

    def distance(z: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        offset = (z[:n] - z0[:n]) / scale
        return float(offset @ offset), np.concatenate([2 * offset / scale, np.zeros(system.m)])

    constraint = {"type": "eq", "fun": residual, "jac": slope}
    with np.errstate(all="ignore"):
        found = minimize(
            distance, z0, jac=True, method="SLSQP", constraints=[constraint], options={"maxiter": 200, "ftol": 1e-14}
        )
    size = max(float(np.max(np.abs(found.x))), 1e-300)
    if not np.all(np.isfinite(found.x)) or np.max(np.abs(residual(found.x))) > 1e-6 * (1 + size):
        return None
    x = np.where(np.abs(found.x[:n]) > 1e-9 * np.max(np.abs(found.x[:n])), found.x[:n], 0.0)
    return dict(zip(system.state_names, (float(v) for v in x), strict=True))


def assignable_set(plant: Plant) -> list[str]:
    """The equations ``g_perp(x) f(x) = 0`` of the assignable equilibria, as text in the parameters' names.

    g_perp is a basis of the left annihilator of g over the rational functions. Empty when f or g is not analytic.
    """
    system = plant.system
    try:
        field, (f, g) = plant.exact(system.f, system.g, symbolic=True)
    except (UnsupportedOperation, ZeroDivisionError):
        return []
    zero = field.const(0)
    drift, rows = f.column(zero), g.dense(zero)
    solved = reduce_rows([{i: rows[i][j] for i in range(system.n)} for j in range(system.m)])
    equations = []
    for free in (k for k in range(system.n) if k not in solved):
        total = drift[free]
        for pivot, row in solved.items():
            if free in row:
                total = total - row[free] * drift[int(str(pivot))]
        if not total.is_zero():
            equations.append(f"{formula(field.polynomial(total.numerator), plant.parameter_positions())} = 0")
    return equations


def input_rank(plant: Plant, point: Point) -> Claim:
    """The claim `input-rank`: g(x*) has full column rank m."""
    (gram,) = plant.at(point, ca.mtimes(plant.system.g.T, plant.system.g))
    with precision(BITS):
        verdict = positive_definite(gram)
    constant = not ca.depends_on(plant.system.g, plant.system.x)
    domain = "all x" if constant else "at x*"
    m = plant.system.m
    if verdict.status is Status.PROVED:
        return Claim("input-rank", Status.PROVED, domain, "g^T g > 0 by elimination", f"rank g = m = {m}")
    counterexample = None
    if verdict.status is Status.REFUTED and verdict.witness is not None:
        counterexample = {"v": [str(c) for c in verdict.witness], "g v": "0"}
    return Claim(
        "input-rank",
        verdict.status,
        "at x*",
        "g^T g > 0 by elimination",
        f"g(x*) does not have full column rank {m}",
        "remove an input that others duplicate, or choose a target where the inputs are independent",
        counterexample,
    )
