"""Where a system can rest at all: the assignable equilibria, and the one nearest to a target that is none."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.design import Design
from pbcgen.models.target import Condition
from pbcgen.passivity.plant import Plant, Point, sparse_dot
from pbcgen.proof.newton import sizes_of
from pbcgen.symbolic.display import formula
from pbcgen.symbolic.linear import sparse_kernel
from pbcgen.symbolic.real import approximate, rational
from pbcgen.symbolic.tape import exact_decimal

#: Starts of the search for the nearest point: the target, and the target with small offsets.
_STARTS = 4
#: Weight of coordinates that the target leaves open, beside 1 for those that it names.
_OPEN = 1e-8
#: Constants up to this are read as the integers that they are.
_CHUNK = 10**9


def residual_of(condition: Condition) -> ca.SX:
    """``expression - value`` times :func:`scale_of` the condition, with constants that doubles hold exactly."""
    value = condition.value
    if _is_double(value):
        return condition.expression - float(value)
    digits: list[tuple[int, ...]] = [(value.denominator,), (abs(value.numerator),)]
    while any(high >= _CHUNK for high, *_ in digits):
        digits = [(*divmod(high, _CHUNK), *low) for high, *low in digits]
    residual = ca.SX(0)  # Horner's scheme
    for below, above in zip(*digits, strict=True):
        residual = residual * _CHUNK + (condition.expression * below - (above if value > 0 else -above))
    return residual * float(f"1e-{_magnitude(value)}")


def scale_of(condition: Condition) -> Fraction:
    """1, or a number between 1 and 10 when the value has no exact decimal of double length."""
    value = condition.value
    return Fraction(1) if _is_double(value) else Fraction(value.denominator, 10 ** _magnitude(value))


def _is_double(value: Fraction) -> bool:
    return exact_decimal(float(value)) == value


def _magnitude(value: Fraction) -> int:
    return len(str(value.denominator)) - 1


def target_values(design: Design) -> dict[str, Fraction]:
    """The states that the target names, with their values."""
    states = set(design.system.state_names)
    return {c.name: c.value for c in design.target.conditions if c.name in states}


def best_point(plant: Plant, design: Design) -> Point:
    """The target where it is given (``near`` or zero elsewhere) with the least-squares input, as rationals."""
    given = {**design.near, **target_values(design)}
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


def greedy_rows(matrix: NDArray[np.float64]) -> list[int]:
    """Row indices that raise the rank, by Gram-Schmidt on rows of unit length, in units in which columns are alike."""
    basis: list[NDArray[np.float64]] = []
    chosen = []
    with np.errstate(all="ignore"):
        rows, columns = sizes_of(matrix)
        scaled = matrix / rows[:, None] / columns
    for i, row in enumerate(scaled):
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


def nearest_assignable(plant: Plant, design: Design) -> dict[str, float] | None:
    """The assignable point closest to the target, by state name; None if none was found.

    Least squares over the target's conditions, each relative to its value, subject to ``f + g u = 0``: coordinates that
    the target leaves open go where they must. A local search from several starts, so it may miss a nearer point.
    """
    from scipy.optimize import minimize

    system, n = plant.system, plant.system.n
    best = best_point(plant, design)
    z0 = np.array([approximate(v) for v in (*best.x, *best.u)])
    symbols = ca.vertcat(system.x, system.u)
    conditions = design.target.conditions
    sizes = np.array([abs(float(c.value)) for c in conditions])
    scale = np.maximum(sizes, 0.1 * max(float(np.max(sizes, initial=0.0)), 1e-3))
    offsets = ca.vertcat(
        *[(c.expression - float(c.value)) / s for c, s in zip(conditions, scale, strict=True)],
        _OPEN**0.5 * (system.x - z0[:n]) / float(np.max(scale, initial=1e-3)),
    )
    distance = ca.sumsqr(offsets)
    function = plant.doubles(system.xdot, ca.jacobian(system.xdot, symbols), distance, ca.gradient(distance, symbols))

    def entries(z: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        return function(z[:n], z[n:])

    rows = greedy_rows(entries(z0)[1])  # SLSQP cannot have dependent constraints
    constraint = {"type": "eq", "fun": lambda z: entries(z)[0].ravel()[rows], "jac": lambda z: entries(z)[1][rows]}
    generator = np.random.default_rng(0)
    found: list[tuple[float, NDArray[np.float64]]] = []
    for k in range(_STARTS):
        start = z0 if k == 0 else z0 + 0.1 * (1e-3 + np.abs(z0)) * generator.uniform(-1, 1, len(z0))
        with np.errstate(all="ignore"):
            result = minimize(
                lambda z: (float(entries(z)[2][0, 0]), entries(z)[3].ravel()),
                start,
                jac=True,
                method="SLSQP",
                constraints=[constraint],
                options={"maxiter": 200, "ftol": 1e-14},
            )
        z = result.x
        if np.all(np.isfinite(z)) and np.max(np.abs(entries(z)[0])) <= 1e-6 * (1 + np.max(np.abs(z))):
            found.append((float(entries(z)[2][0, 0]), z))
    if not found:
        return None
    _, z = min(found, key=lambda pair: pair[0])
    x = np.where(np.abs(z[:n]) > 1e-9 * np.max(np.abs(z[:n])), z[:n], 0.0)
    return dict(zip(system.state_names, (float(v) for v in x), strict=True))


def assignable_set(plant: Plant) -> list[str]:
    """The equations ``g_perp(x) f(x) = 0`` of the assignable equilibria, as text in the parameters' names.

    g_perp is a basis of the left annihilator of g over the rational functions. For mechanical systems these are p = 0
    and ``G_perp grad V = 0`` (eqmec). Empty when the functions are not analytic.
    """
    system, mechanics = plant.system, plant.system.mechanical
    if mechanics is None:
        return _annihilated(plant, system.f, system.g)
    at_rest = [f"{name} = 0" for name in system.state_names[system.n // 2 :]]
    return at_rest + _annihilated(plant, ca.gradient(mechanics.V, mechanics.q), mechanics.G)


def _annihilated(plant: Plant, drift: ca.SX, inputs: ca.SX) -> list[str]:
    """The equations of the drift that no input enters, as text."""
    try:
        field, (f, g) = plant.exact(drift, inputs, symbolic=True, known=plant.numbers)
        (rest,) = f.columns()
        equations = []
        for weights in sparse_kernel(g.columns(), g.shape[0], field.const(1)):
            total = sparse_dot(weights, rest, field.const(0))
            if not total.is_zero():
                text = formula(field.polynomial(total.numerator), plant.parameter_positions())
                equations.append(f"{text} = 0")
    except (UnsupportedOperation, ZeroDivisionError):
        return []
    return equations
