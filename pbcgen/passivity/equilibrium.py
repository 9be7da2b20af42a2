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
from flint import arb

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.design import Design
from pbcgen.passivity.assignable import best_point, nearest_assignable, residual_of, target_values
from pbcgen.passivity.completion import Equations, SquareSystem, linear_consequences, point_of
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.smooth import smooth_forms
from pbcgen.passivity.unreachable import Contradiction, contradiction
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import positive_definite
from pbcgen.symbolic.coefficients import cleared
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows
from pbcgen.symbolic.real import (
    BITS,
    ZERO,
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
from pbcgen.symbolic.real_matrices import RealMatrix
from pbcgen.symbolic.tape import exact_decimal

#: The radius of the ball around x* on which the model must be defined.
_NEAR = 1e-60


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


def complete(plant: Plant, design: Design) -> Equilibrium:
    """Find and enclose the equilibrium that the design's target determines."""
    equations = Equations.of(plant, design)
    try:
        known = linear_consequences(equations)
    except Inconsistent:
        return _refuted(plant, design)
    except (UnsupportedOperation, ZeroDivisionError):
        known = target_values(design)
    unknown = [name for name in equations.names if name not in known]
    if not unknown:
        return _verify(plant, design, equations, known)
    return _search(plant, design, equations, known, unknown)


def _verify(plant: Plant, design: Design, equations: Equations, known: Mapping[str, Fraction]) -> Equilibrium:
    """Everything is rational: put it into all equations."""
    point = point_of(plant, {name: rational(value) for name, value in known.items()})
    (residuals,) = plant.at(point, equations.expressions)
    values = [row[0] for row in residuals]
    if any(sign(v) in (1, -1) for v in values):
        return _not_assignable(plant, design, point)
    if all(sign(v) == 0 for v in values):
        unfit = _outside_domain(plant, _by_name(plant, point)) or _no_neighbourhood(plant, point)
        if unfit:
            return unfit
        evidence = f"f(x*) + g(x*) u* = 0 exactly at {_show(plant, point)}"
        return Equilibrium(_proved("linear elimination over the rationals", evidence), point)
    return Equilibrium(_undecided("the residual is enclosed by balls around zero", values), None)


def _search(
    plant: Plant, design: Design, equations: Equations, known: Mapping[str, Fraction], unknown: list[str]
) -> Equilibrium:
    """Newton from many starts on the equations that are left, then an enclosure of each zero."""
    given = {name: rational(value) for name, value in known.items()}
    outside = _outside_domain(plant, given)
    if outside:
        return outside
    square = SquareSystem.choose(plant, design, equations, known, unknown)
    if square is None:
        impossible = contradiction(plant, equations.expressions, known)
        return (
            _unreachable(plant, design, impossible) if impossible else _underdetermined(plant, design, known, unknown)
        )
    with precision(BITS):
        points = [p for z in square.zeros() if (p := square.enclose(z)) is not None]
    points = [p for p in points if _outside_domain(plant, _by_name(plant, p)) is None]
    if not points:
        return _no_zero(plant, design, equations, square)
    residuals = [[row[0] for row in plant.at(p, equations.expressions)[0]] for p in points]
    fitting = [p for p, values in zip(points, residuals, strict=True) if not {1, -1} & {sign(v) for v in values}]
    if not fitting and set(unknown) <= set(plant.system.input_names):  # linear: what was found is all there is
        return _not_assignable(plant, design, points[0])
    if not fitting and (impossible := contradiction(plant, equations.expressions, known)) is not None:
        return _unreachable(plant, design, impossible)
    if not fitting:  # there may be zeros that the search did not find
        why = "no rest position that was found meets all conditions of the target"
        return Equilibrium(_undecided(why, residuals[0]), None, tuple(_rounded(plant, p) for p in points))
    points, completions = fitting, tuple(_rounded(plant, p) for p in fitting)
    if len(points) > 1 and not design.near:
        return Equilibrium(_ambiguous(completions), None, completions)
    point = points[0]
    if len(points) > 1:
        point = min(points, key=lambda p: _distance(plant, p, design.near))
    return _accept(plant, design, equations, square, point, completions)


def _accept(
    plant: Plant,
    design: Design,
    equations: Equations,
    square: SquareSystem,
    point: Point,
    completions: tuple[Mapping[str, float], ...],
) -> Equilibrium:
    """The verdict on a zero of the square system: the equations that it left out must hold too, exactly."""
    (residuals,) = plant.at(point, equations.expressions)
    values = [row[0] for row in residuals]
    open_rows = [i for i, v in enumerate(values) if i not in square.rows and sign(v) != 0]
    if any(combination(plant, equations.expressions[i], square.expressions, square.known) is None for i in open_rows):
        why = f"{len(open_rows)} equations beyond the unknowns hold within balls only"
        return Equilibrium(_undecided(why, values), None, completions)
    unfit = _no_neighbourhood(plant, point)
    if unfit:
        return unfit
    size = max(radius(v) for v in (*point.x, *point.u))
    evidence = f"one zero of f + g u in a ball of radius {float(size):.1e} around {_show(plant, point)}"
    return Equilibrium(_proved("Krawczyk test in ball arithmetic", evidence), point, completions)


def combination(plant: Plant, expression: ca.SX, others: ca.SX, known: Mapping[str, Fraction]) -> list[Fraction] | None:
    """Constant coefficients with which an equation is a combination of others where some values are known, or None."""
    try:
        field, (values,) = plant.exact(ca.vertcat(expression, others), known=known)
        functions = cleared(field, values.column(field.const(0)))
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    rows: dict[object, Row] = {}
    for k, function in enumerate(functions):
        for exponents, coefficient in function.to_dict().items():
            key, value = (CONSTANT, -coefficient) if k == 0 else (k, coefficient)
            rows.setdefault(tuple(exponents), {})[key] = value
    try:
        solution = particular_solution(reduce_rows(rows.values()), ZERO)
    except Inconsistent:
        return None
    return [fraction(solution.get(k, ZERO)) for k in range(1, len(functions))]


# --- verdicts ---------------------------------------------------------------------------------------------------


def _rounded(plant: Plant, point: Point) -> dict[str, float]:
    return {name: approximate(value) for name, value in zip(plant.system.state_names, point.x, strict=True)}


def _show(plant: Plant, point: Point) -> str:
    system = plant.system
    pairs = [*zip(system.state_names, point.x, strict=True), *zip(system.input_names, point.u, strict=True)]
    return ", ".join(f"{name} = {text(value, 9)}" for name, value in pairs)


def _distance(plant: Plant, point: Point, near: Mapping[str, Fraction]) -> float:
    values = _rounded(plant, point)
    return sum((values[name] - float(value)) ** 2 for name, value in near.items())


def _proved(method: str, evidence: str) -> Claim:
    return Claim("equilibrium", Status.PROVED, "at x*", method, evidence)


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
    inputs = set(unknown) <= set(plant.system.input_names)
    claim = Claim(
        "equilibrium",
        Status.UNDECIDED,
        "at x*",
        "rank of the equilibrium equations",
        f"the target leaves a family of equilibria: not determined: {', '.join(unknown)}",
        "look at the input matrix: an input does not act, or two of them do the same"
        if inputs
        else f"add conditions to the target: {plant.system.m} are usually needed, one for each input",
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


def _no_neighbourhood(plant: Plant, point: Point) -> Equilibrium | None:
    """The verdict when what is said `near x*` would have no neighbourhood to be true in, else None."""
    for name, value in _by_name(plant, point).items():
        lo, hi = plant.system.domain.get(name, (None, None))
        if (lo is not None and lower(value) <= lo) or (hi is not None and upper(value) >= hi):
            why = f"{name} = {text(value, 9)} is on the edge of the domain, beyond which the model says nothing"
            return _unfit(why, "choose a target inside the domain, or widen the domain")
    ((row,),) = plant.at(point, plant.system.S)
    if not is_finite(row[0]):
        why = "S has no certain value there: it is undefined, or a comparison in it switches just there"
        return _unfit(why, "choose a target away from that point, or write a smooth storage")
    unsure = _undefined_near(plant, point)
    if unsure:
        why = f"{unsure} has no certain value near it: it is undefined, or grows without bound"
        return _unfit(why, "choose a target away from that point, or write a term that is defined around it")
    return None


def _undefined_near(plant: Plant, point: Point) -> str:
    """A part of the model that has no certain value on a small ball around x*, for what is said near x* is about f."""
    system = plant.system
    parts = {"f": system.f, "g": system.g}
    if system.mechanical is not None:
        parts = {"D": system.mechanical.D, "G": system.mechanical.G, "M": system.mechanical.M}
    ball = Point(tuple(v + arb(0, _NEAR) for v in point.x), point.u)
    for name, part in parts.items():
        (values,) = plant.at(ball, ca.densify(part))
        if not all(is_finite(v) for row in values for v in row):
            return name
    return ""


def _unfit(why: str, hint: str) -> Equilibrium:
    claim = Claim("equilibrium", Status.UNDECIDED, "at x*", "x* must have a neighbourhood in the model", why, hint)
    return Equilibrium(claim, None)


def _no_zero(plant: Plant, design: Design, equations: Equations, square: SquareSystem) -> Equilibrium:
    impossible = contradiction(plant, equations.expressions, square.known)
    if impossible is not None:
        return _unreachable(plant, design, impossible)
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
        smooth_forms(plant)
        or "check that the target is reachable, or give `near={...}` to start the search close to it",
    )
    return Equilibrium(claim, None)


def _unreachable(plant: Plant, design: Design, found: Contradiction) -> Equilibrium:
    """The verdict on a target that no real state meets."""
    nearest = nearest_assignable(plant, design)
    near = "" if nearest is None else "; the nearest assignable point found is " + _pairs(nearest)
    claim = Claim(
        "equilibrium",
        Status.REFUTED,
        "at x*",
        "elimination, and signs of exact functions",
        f"no real state meets the target: {found.text}",
        f"choose a target that an input can hold{near}",
        {"equation": found.equation, "why": found.why, "nearest": None if nearest is None else dict(nearest)},
    )
    return Equilibrium(claim, None)


def _is_smooth_at(plant: Plant, state: Mapping[str, float]) -> bool:
    """Whether f, g and their derivatives have certain finite values at a point."""
    x = tuple(rational(exact_decimal(state[name])) for name in plant.system.state_names)
    point = Point(x, tuple(rational(0) for _ in plant.system.input_names))
    flat = ca.vertcat(plant.system.f, ca.vec(ca.densify(plant.system.g)))
    entries = plant.at(point, flat, ca.densify(ca.jacobian(flat, plant.system.x)))
    return all(is_finite(v) for matrix in entries for row in matrix for v in row)


def _refuted(plant: Plant, design: Design) -> Equilibrium:
    """The linear equations contradict each other: measure by how much, at the target."""
    if _contradict_each_other(plant, design):
        return _contradiction(design, "linear elimination over the rationals", ", whatever the system")
    point = best_point(plant, design)
    (residual,) = plant.at(point, plant.system.xdot)
    values = [row[0] for row in residual]
    return _residual_verdict(plant, design, values, "linear elimination over the rationals", point)


def _contradiction(design: Design, method: str, scope: str = "") -> Equilibrium:
    asked = ", ".join(f"{c.name} = {text(rational(c.value))}" for c in design.target.conditions)
    why = f"the conditions of the target contradict each other{scope}: {asked}"
    hint = "take one of them out of the target"
    return Equilibrium(Claim("equilibrium", Status.REFUTED, "at x*", method, why, hint, {"conditions": asked}), None)


def _contradict_each_other(plant: Plant, design: Design) -> bool:
    """Whether the target's conditions alone, without the system's equations, have no solution."""
    conditions = design.target.conditions
    asked = Equations(
        plant,
        (*plant.system.state_names, *plant.system.input_names),
        ca.vertcat(*[residual_of(c) for c in conditions]),
        tuple(c.name for c in conditions),
    )
    try:
        linear_consequences(asked)
    except Inconsistent:
        return True
    return False


def _not_assignable(plant: Plant, design: Design, point: Point) -> Equilibrium:
    """The verdict where the state is certain, and the system's equations or the target's conditions do not hold."""
    method = "residual in exact or ball arithmetic"
    (rates,) = plant.at(point, plant.system.xdot)
    values = [row[0] for row in rates]
    if {1, -1} & {sign(v) for v in values}:
        return _residual_verdict(plant, design, values, method, point)
    return _contradiction(design, method)


def _residual_verdict(plant: Plant, design: Design, values: Sequence[Real], method: str, point: Point) -> Equilibrium:
    polished = nearest_assignable(plant, design)
    worst = max(values, key=lambda v: abs(approximate(v)))
    row = plant.system.state_names[list(values).index(worst)]
    hint = _give_less(plant, design)
    if polished is not None:
        given = {name: float(value) for name, value in target_values(design).items()}
        near = all(abs(polished[name] - value) <= 1e-6 * abs(value) for name, value in given.items())
        hint += "; the nearest assignable point is " + _pairs(polished, 17 if given and near else 9)
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


def _give_less(plant: Plant, design: Design) -> str:
    """The advice to leave entries of the target open: as many can be wished for as there are inputs."""
    given, inputs = [c.name for c in design.target.conditions], plant.system.m
    if len(given) <= inputs:
        return "choose a point that an input can hold"
    names = ", ".join(f"`{name}`" for name in given)
    there = "is 1 input" if inputs == 1 else f"are {inputs} inputs"
    leave = f"leave {len(given) - inputs} open, and say in near={{...}} about where they are"
    return f"the target gives {names}, and there {there}: {leave}"


def _pairs(values: Mapping[str, float], digits: int = 9) -> str:
    """``name = value, ...``; what is rounding beside the other entries is shown as zero."""
    noise = 1e-15 * max((abs(v) for v in values.values()), default=0.0)
    return ", ".join(f"{k} = {v if abs(v) > noise else 0:.{digits}g}" for k, v in values.items())


def gram_of_inputs(plant: Plant, point: Point | None) -> RealMatrix:
    """``g^T g`` at x*; where g is constant, x* is not needed."""
    (gram,) = plant.at(
        point or Point((ZERO,) * plant.system.n, (ZERO,) * plant.system.m), ca.mtimes(plant.system.g.T, plant.system.g)
    )
    return gram


def without_rank(plant: Plant) -> Claim | None:
    """The claim `input-rank` REFUTED for a constant g, whether there is an equilibrium or not; else None."""
    if ca.depends_on(plant.system.g, plant.system.x):
        return None
    claim = input_rank(plant, None)
    return claim if claim.status is Status.REFUTED else None


def input_rank(plant: Plant, point: Point | None) -> Claim:
    """The claim `input-rank`: g(x*) has full column rank m."""
    with precision(BITS):
        verdict = positive_definite(gram_of_inputs(plant, point))
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
        domain,
        "g^T g > 0 by elimination",
        f"g{'' if constant else '(x*)'} does not have full column rank {m}",
        "remove an input that does nothing, or that others duplicate"
        + ("" if constant else ", or choose a target where the inputs are independent"),
        counterexample,
    )
