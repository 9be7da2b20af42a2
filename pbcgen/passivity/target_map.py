"""x* and u* as explicit functions of an adjustable target.

The equations ``f(x) + g(x) u = 0`` and the conditions of the target are solved by elimination, with the adjustable
values as symbols: an equation that is linear in an unknown gives that unknown, and one that holds an unknown inside a
single invertible function (exp, log, sinh, tanh, ...) is inverted first. Each step keeps exactly the solutions at which
its divisor is not zero. So the result is the only equilibrium wherever it is defined, and whoever evaluates it in balls
sees where that is: a divisor that may vanish makes the ball infinite. What no such step solves is left to a branch (see
:mod:`pbcgen.passivity.target_branch`): then the result is the equilibrium that continues the declared one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import casadi as ca
from flint import fmpq_mpoly

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.design import Design
from pbcgen.models.target import Condition
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.target_branch import LARGEST, Branch, find_branch
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import REAL, ZERO, Real, approximate, reals, undefined
from pbcgen.symbolic.tape import Tape
from pbcgen.symbolic.to_sx import to_sx

#: Functions that take every value of their range once, and their inverses.
_INVERSES: Final[Mapping[str, Callable[[ca.SX], ca.SX]]] = {
    "exp": ca.log,
    "log": ca.exp,
    "sinh": ca.asinh,
    "asinh": ca.sinh,
    "tanh": ca.atanh,
    "atanh": ca.tanh,
    "expm1": ca.log1p,
    "log1p": ca.expm1,
}


@dataclass(frozen=True, eq=False)
class TargetMap:
    """The equilibrium as a function of the adjustable values.

    Attributes:
        plant: the system.
        symbols: one for each adjustable condition, a column.
        x, u: x* and u* in those symbols, the unknowns of the branch and the plant's parameters.
        branch: for unknowns that no formula gives, or None.
    """

    plant: Plant
    symbols: ca.SX
    x: ca.SX
    u: ca.SX
    branch: Branch | None = None
    rates: ca.SX = field(init=False)

    def __post_init__(self) -> None:
        unknowns = 0 if self.branch is None else self.branch.z.numel()
        object.__setattr__(self, "rates", ca.SX.sym("rates", unknowns, self.symbols.numel()))

    @property
    def moving(self) -> ca.SX:
        """Everything that moves with the target: the adjustable values and the unknowns of the branch."""
        return self.symbols if self.branch is None else ca.vertcat(self.symbols, self.branch.z)

    @property
    def hidden(self) -> ca.SX:
        """Symbols for the unknowns of the branch and their derivatives by the adjustable values, a column."""
        return ca.SX(0, 1) if self.branch is None else ca.vertcat(self.branch.z, ca.vec(self.rates))

    def hidden_at(self, values: Sequence[Real]) -> list[Real]:
        """What ``hidden`` stands for at given values, enclosed; undefined where there is no proof that it exists."""
        if self.branch is None:
            return []
        found = self.branch.enclose(values)
        if found is None:
            return [undefined()] * int(self.hidden.numel())
        columns = range(len(values))
        return [*found.z, *(row[k] for k in columns for row in found.rates)]

    def slope(self, expression: ca.SX) -> ca.SX:
        """The derivative of a column by the adjustable values, in these and ``hidden``."""
        direct = ca.jacobian(expression, self.symbols)
        if self.branch is None:
            return direct
        return direct + ca.mtimes(ca.jacobian(expression, self.branch.z), self.rates)

    @property
    def how(self) -> str:
        """How the unknowns of the branch are found, in words."""
        if self.branch is None:
            return ""
        steps = f"{self.branch.steps} Newton step{'s' if self.branch.steps > 1 else ''}"
        return f" ({steps} from a polynomial of degree {self.branch.degree} reach it)"

    def at_target(self, *expressions: ca.SX) -> list[ca.SX]:
        """Expressions in (x, u) with the equilibrium put in."""
        system = self.plant.system
        both = ca.vertcat(system.x, system.u)
        return [ca.substitute(e, both, ca.vertcat(self.x, self.u)) for e in expressions]

    def tape(self, *expressions: ca.SX) -> Tape:
        """The tape of expressions in the adjustable values and ``hidden``, for :meth:`walk`."""
        inputs = [self.symbols, self.hidden, self.plant.parameter_symbols]
        return Tape.of(inputs, [ca.densify(e) for e in expressions])

    def walk(self, tape: Tape, values: Sequence[Real]) -> list[list[Real]]:
        """The columns of a tape at given values, exact or enclosed, at the current precision."""
        parameters = reals(self.plant.parameter_values)
        inputs = [list(values), self.hidden_at(values), parameters]
        return [[row[0] for row in m.dense(ZERO)] for m in tape.walk(REAL, inputs)]

    def with_numbers(self, expression: ca.SX) -> ca.SX:
        """The expression in the adjustable values alone: steps written out, parameters rounded to doubles."""
        if self.branch is not None:
            expression = ca.substitute(expression, self.branch.z, self.branch.formula)
        values = ca.DM([float(v) for v in self.plant.parameter_values])
        symbols = self.plant.parameter_symbols
        return ca.substitute(expression, symbols, values) if symbols.numel() else expression


@dataclass(frozen=True)
class NotExplicit:
    """Why there is no such function; ``assignable`` is false when some targets are certainly no equilibria."""

    reason: str
    hint: str
    assignable: bool = True


def target_map(plant: Plant, design: Design, point: Point | None = None) -> TargetMap | NotExplicit:
    """Solve the equilibrium equations for the adjustable conditions of the design.

    ``point`` is the declared equilibrium; without it only formulas are looked for.
    """
    symbols = ca.vertcat(*[ca.SX.sym(f"target {name}") for name in design.target_box])
    try:
        return _Elimination(plant, design, symbols, point).run()
    except (UnsupportedOperation, ZeroDivisionError) as error:
        return NotExplicit(f"the equilibrium equations are not analytic ({error})", _FIXED)


_FIXED: Final = "leave this design's target fixed: remove target_box, and generate one package for each target"


class _Elimination:
    """The equations that are left, and what they have given so far."""

    def __init__(self, plant: Plant, design: Design, symbols: ca.SX, point: Point | None) -> None:
        self.plant, self.design, self.symbols, self.point = plant, design, symbols, point
        system = plant.system
        self.names = (*system.state_names, *system.input_names)
        self.unknowns = dict(zip(self.names, ca.vertsplit(ca.vertcat(system.x, system.u)), strict=True))
        adjustable = dict(zip(design.target_box, ca.vertsplit(symbols), strict=True))
        self.left: list[tuple[str, ca.SX]] = [
            *((f"target {c.name}", self._condition(c, adjustable)) for c in design.target.conditions),
            *((f"d{n}/dt = 0", e) for n, e in zip(system.state_names, ca.vertsplit(system.xdot), strict=True)),
        ]
        self.solved: dict[str, ca.SX] = {}
        self.torn: list[int] = []
        self.residuals: list[ca.SX] = []

    def _condition(self, condition: Condition, adjustable: Mapping[str, ca.SX]) -> ca.SX:
        value = adjustable.get(condition.name)
        return condition.expression - (self.plant.number(condition.value) if value is None else value)

    def run(self) -> TargetMap | NotExplicit:
        """Eliminate until nothing is left."""
        while self.left:
            field, values = self._exact()
            open_rows = [k for k, v in enumerate(values) if not v.is_zero()]
            values = [values[k] for k in open_rows]
            self.left = [self.left[k] for k in open_rows]
            if not self.left:
                break
            for k, value in enumerate(values):
                if not self._unknowns_of(value) and not value.symbols() & set(self.torn):
                    return self._not_assignable(self.left[k][0])
            kept = [k for k, value in enumerate(values) if self._unknowns_of(value)]
            self.residuals += [self.left[k][1] for k in range(len(values)) if k not in kept]
            self.left, values = [self.left[k] for k in kept], [values[k] for k in kept]
            if self.left and not (self._solve_linear(field, values) or self._invert(field, values)):
                if self.point is None or len(self.torn) == LARGEST:
                    return self._stuck(values)
                self._tear(values)
        missing = [name for k, name in enumerate(self.names) if name not in self.solved and k not in self.torn]
        if missing or len(self.residuals) < len(self.torn):
            missing = missing or [self.names[k] for k in self.torn]
            return NotExplicit(f"the target does not determine {', '.join(missing)}", "add conditions to the target")
        return self._map()

    def _tear(self, values: Sequence[Quotient]) -> None:
        """Take one unknown as known: that of the equation with the fewest which most equations hold."""
        shortest = min(values, key=lambda v: len(self._unknowns_of(v)))
        self.torn.append(
            max(sorted(self._unknowns_of(shortest)), key=lambda k: sum(k in self._unknowns_of(v) for v in values))
        )

    def _map(self) -> TargetMap | NotExplicit:
        n = self.plant.system.n
        column = ca.vertcat(*[self.solved.get(name, self.unknowns[name]) for name in self.names])
        if not self.torn:
            return TargetMap(self.plant, self.symbols, column[:n], column[n:])
        names = [self.names[k] for k in self.torn]
        label = f"the equations for {', '.join(names)} have no explicit solution"
        if len(self.residuals) > len(self.torn):
            return NotExplicit(f"{label}, and are more than these unknowns", _FIXED)
        assert self.point is not None
        own = ca.vertcat(*[self.unknowns[name] for name in names])
        z = ca.vertcat(*[ca.SX.sym(f"solved {name}") for name in names])
        column, equations = (ca.substitute(e, own, z) for e in (column, ca.vertcat(*self.residuals)))
        values = {c.name: float(c.value) for c in self.design.target.conditions}
        rest = [approximate(v) for v in (*self.point.x, *self.point.u)]
        declared = ([values[name] for name in self.design.target_box], [rest[k] for k in self.torn])
        box = [(r.lo, r.hi) for r in self.design.target_box.values()]
        branch = find_branch(self.plant, self.symbols, z, equations, box, declared)
        if isinstance(branch, str):
            return NotExplicit(f"{label}: {branch}", f"narrow the box, or {_FIXED}")
        return TargetMap(self.plant, self.symbols, column[:n], column[n:], branch)

    def _exact(self) -> tuple[Field, list[Quotient]]:
        expressions = ca.vertcat(*[e for _, e in self.left])
        tape = Tape.of([*self.plant.symbols, self.symbols], [expressions])
        names = (*self.plant.names, *(f"target {k}" for k in range(self.symbols.numel())))
        field, (matrix,) = evaluate(tape, names, dict(self.plant.values))
        return field, matrix.column(field.const(0))

    def _unknowns_of(self, value: Quotient) -> set[int]:
        return {k for k in value.symbols() if k < len(self.names) and k not in self.torn}

    def _solve_linear(self, field: Field, values: Sequence[Quotient]) -> bool:
        """Solve one equation for an unknown in which it is linear; prefer constant divisors, then few unknowns."""
        best: tuple[tuple[int, int], int, int, Quotient] | None = None
        for row, value in enumerate(values):
            for k in sorted(self._unknowns_of(value)):
                split = _linear_in(field, value, k)
                if split is None:
                    continue
                slope, rest = split
                cost = (0 if slope.constant() is not None else 1 + len(self._unknowns_of(slope)), len(rest.symbols()))
                if best is None or cost < best[0]:
                    best = (cost, row, k, -rest / slope)
        if best is None:
            return False
        _, row, k, solution = best
        del self.left[row]
        self._put(self.names[k], self._expression(solution))
        return True

    def _invert(self, field: Field, values: Sequence[Quotient]) -> bool:
        """Replace one equation ``a F(v) + b = 0``, where only v holds unknowns, by ``v = F^-1(-b/a)``."""
        for row, value in enumerate(values):
            holding = [k for k in value.generators() if self._unknowns_of(_generator(field, k))]
            if len(holding) != 1 or holding[0] not in field.atoms:
                continue
            atom = field.atoms[holding[0]]
            split = _linear_in(field, value, holding[0])
            if split is None or atom.kind not in _INVERSES:
                continue
            slope, rest = split
            inverted = _INVERSES[atom.kind](self._expression(-rest / slope))
            self.left[row] = (self.left[row][0], self._expression(atom.argument) - inverted)
            return True
        return False

    def _expression(self, element: Quotient) -> ca.SX:
        known = [s for column in self.plant.symbols for s in ca.vertsplit(column) if column.numel()]
        return to_sx(element, [*known, *ca.vertsplit(self.symbols)], self.plant.number, alone=True)

    def _put(self, name: str, solution: ca.SX) -> None:
        symbol = self.unknowns[name]

        def put(expression: ca.SX) -> ca.SX:
            return ca.substitute(expression, symbol, solution)

        self.left = [(label, put(e)) for label, e in self.left]
        self.solved = {other: put(e) for other, e in self.solved.items()} | {name: solution}

    def _not_assignable(self, label: str) -> NotExplicit:
        return NotExplicit(
            f"`{label}` does not hold for every target of the box: the adjustable conditions are not independent",
            "put fewer conditions into target_box: one for each input can be adjusted",
            assignable=False,
        )

    def _stuck(self, values: Sequence[Quotient]) -> NotExplicit:
        value = min(values, key=lambda v: len(self._unknowns_of(v)))
        label = self.left[list(values).index(value)][0]
        unknown = ", ".join(self.names[k] for k in sorted(self._unknowns_of(value)))
        return NotExplicit(f"`{label}` has no explicit solution for {unknown}", _FIXED)


def _generator(field: Field, k: int) -> Quotient:
    return field.symbol(k) if k < field.symbol_count else field.polynomial(field.context.gen(k))


def _linear_in(field: Field, value: Quotient, k: int) -> tuple[Quotient, Quotient] | None:
    """(a, b) with ``numerator = a z + b`` for generator k, if neither a nor b depends on z."""
    slope: dict[tuple[int, ...], object] = {}
    rest: dict[tuple[int, ...], object] = {}
    for exponents, coefficient in value.numerator.to_dict().items():
        if exponents[k] > 1:
            return None
        if exponents[k] == 1:
            slope[tuple(0 if j == k else e for j, e in enumerate(exponents))] = coefficient
        else:
            rest[tuple(exponents)] = coefficient
    if not slope:
        return None
    parts = [field.polynomial(_polynomial(field, terms)) for terms in (slope, rest)]
    if k < field.symbol_count and any(k in part.symbols() for part in parts):
        return None
    return parts[0], parts[1]


def _polynomial(field: Field, terms: Mapping[tuple[int, ...], object]) -> fmpq_mpoly:
    return field.context.from_dict(terms) if terms else field.context.constant(0)
