"""The largest invariant set on which the Lyapunov function rests (LaSalle), by Lie derivatives and elimination.

On that set the dissipation vanishes, ``B v = 0`` and ``rho^T grad S = 0``; the filters rest, so gamma is constant and
``u = u_c(x) + ubar`` with constant ubar (u_c is the potential compensation, zero for the other laws). Every equation
that holds along the trajectories of the set has a Lie derivative that holds too. An equation is used to eliminate a
state when it is linear in it with a constant coefficient; before that it is stripped of factors that never vanish, of
odd monotone functions, and split when it is a sum of terms of one sign. All of this is exact, on the whole space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.equation import (
    affine,
    certainly_varies,
    combination,
    eliminated,
    essential,
    essentials,
    is_combination,
    is_entire,
    linear_in,
    never_zero,
    parts,
    short,
)
from pbcgen.passivity.flow import Flow
from pbcgen.proof.nonnegative import positive
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Row
from pbcgen.symbolic.tape import Tape
from pbcgen.symbolic.to_sx import to_sx

#: Lie derivatives of an equation are followed up to this many times the number of states.
_ROUNDS = 3

#: Equations beyond these sizes are given up: nonlinear ones grow with every Lie derivative.
_LARGEST_TAPE = 1500
_MOST_TERMS = 600
#: How many branches may be followed, and how many products one after the other may be split.
_MOST_BRANCHES, _DEEPEST = 8, 4
#: So many equations are compared with each other.
_MOST_COMPARED = 12
#: Instructions of all the expressions that one elimination may look at: some seconds of work.
_BUDGET = 25_000


@dataclass(frozen=True, eq=False)
class InvariantSet:
    """What elimination leaves.

    Attributes:
        solved: states as expressions of the free states and ubar, by position.
        free: positions of the states that are left.
        pending: equations that could not be used, as expressions.
        inputs: components of ubar that are determined, by position (0 or an expression of the other ones).
        resting: whether x' = 0 on the whole set: it consists of equilibria.
        closed: whether every Lie derivative was followed to the end.
        steps: the chain of implications in words.
    """

    solved: dict[int, ca.SX]
    free: tuple[int, ...]
    pending: tuple[ca.SX, ...]
    inputs: dict[int, ca.SX]
    resting: bool
    closed: bool
    steps: tuple[str, ...]


class _Split(Exception):
    """An equation is a product; along a trajectory, which is analytic, one of its factors vanishes all the time."""

    def __init__(self, factors: list[ca.SX]) -> None:
        super().__init__("one of several factors vanishes")
        self.factors = factors


@dataclass
class _Elimination:
    flow: Flow
    names: list[str]
    symbols: list[ca.SX]
    solved: dict[int, ca.SX] = field(default_factory=dict)
    pending: list[ca.SX] = field(default_factory=list)
    relations: list[ca.SX] = field(default_factory=list)
    followed: dict[int, ca.SX] = field(default_factory=dict)
    tried: dict[int, tuple[ca.SX, int]] = field(default_factory=dict)
    steps: list[str] = field(default_factory=list)
    budget: int = _BUDGET
    spent: int = 0
    resting: bool = False
    splitting: bool = False

    @property
    def states(self) -> int:
        return int(self.flow.plant.system.n)

    def substitute(self, expression: ca.SX) -> ca.SX:
        """The expression with solved variables replaced."""
        if not self.solved:
            return expression
        old = ca.vertcat(*[self.symbols[k] for k in self.solved])
        return ca.substitute(expression, old, ca.vertcat(*self.solved.values()))

    def exact(self, *expressions: ca.SX) -> tuple[Field, list[Quotient]]:
        """Scalar expressions as exact functions of states and ubar, at the parameter values."""
        plant = self.flow.plant
        parameters = plant.parameter_symbols
        tape = Tape.of([ca.vertcat(*self.symbols), parameters], [ca.vertcat(*expressions)])
        self.spent += len(tape.instructions)
        if self.spent > self.budget or len(tape.instructions) > _LARGEST_TAPE * len(expressions):
            raise UnsupportedOperation(
                f"its equations grow beyond the budget, {self.spent} of {self.budget} instructions; known are "
                + ("; ".join(self.steps) or "no states")
            )
        names = [*self.names, *plant.parameter_names]
        field_, (values,) = evaluate(tape, names, plant.values, plant.reads_signs(tape))
        functions = values.column(field_.const(0))
        if any(len(function.numerator) > _MOST_TERMS for function in functions):
            raise UnsupportedOperation(
                f"an equation grows beyond {_MOST_TERMS} terms; known are " + ("; ".join(self.steps) or "no states")
            )
        return field_, functions

    def to_sx(self, element: Quotient) -> ca.SX:
        """An exact function as an expression, which may be put in for a variable."""
        plant = self.flow.plant
        return to_sx(element, [*self.symbols, *plant.parameter_list], plant.number, alone=True)

    # --- one equation ---------------------------------------------------------------------------------------------

    def use(self, expression: ca.SX) -> bool:
        """Take in ``expression = 0``; whether it was used up (else it is pending)."""
        _, (value,) = self.exact(self.substitute(expression))
        if value.is_zero():
            return True
        factors = [f for part in parts(value) for f in [essential(part)]]
        used = True
        for factor in factors:
            if factor is None:
                used = False
                continue
            used = self._solve(factor) and used
        return used

    def _solve(self, factor: Quotient) -> bool:
        """Eliminate a variable from ``factor = 0``."""
        for k in self._order(factor):
            rest = linear_in(factor, k, len(self.symbols), units=True)
            if rest is None:
                continue
            value = self.to_sx(-rest)
            symbol = self.symbols[k]
            for j in list(self.solved):
                self.solved[j] = ca.substitute(self.solved[j], symbol, value)
            self.solved[k] = value
            self._record(k, -rest, value)
            return True
        return False

    def _order(self, factor: Quotient) -> list[int]:
        """Variables by preference: states first (momenta and currents before ubar)."""
        present = factor.generators()
        return [k for k in range(len(self.symbols)) if k in present]

    # --- rounds ---------------------------------------------------------------------------------------------------

    def run(self) -> bool:
        """Use equations and their Lie derivatives until nothing new appears; whether that point was reached."""
        queue = [self.flow.base[k] for k in range(self.flow.base.numel())]
        for _ in range(_ROUNDS * self.states):
            waiting = [e for e in self._use_affine(queue) if not self._used(e)]
            waiting = self._linear_block(waiting)
            if self._rests(waiting):  # by combinations with constant weights: multiples by functions count here
                self._settle(waiting)
                return True
            waiting = self._without_multiples(waiting)
            if self.splitting:
                self._split(waiting)
            waiting, fresh = self._distinct(waiting, [*self._derivatives(waiting), *self._stopped(waiting)])
            self.pending = waiting
            if not fresh:
                self.pending = self.nonzero(waiting)
                return True
            queue = [*waiting, *fresh]
        return False

    def _without_multiples(self, waiting: list[ca.SX]) -> list[ca.SX]:
        """The equations without those that are multiples of another one: they and their rates say nothing more."""
        if not 1 < len(waiting) <= _MOST_COMPARED:
            return waiting
        _, values = self.exact(*ca.vertsplit(self.substitute(ca.vertcat(*waiting))))
        tops = [value.numerator for value in values]
        kept: list[int] = []
        for i in sorted(range(len(tops)), key=lambda k: (tops[k].total_degree(), len(tops[k]), k)):
            if not any(divmod(tops[i], tops[j])[1].is_zero() for j in kept if not tops[j].is_zero()):
                kept.append(i)
        return [waiting[i] for i in sorted(kept)]

    def _used(self, expression: ca.SX) -> bool:
        """:meth:`use`, unless it failed before and no more variables are known now."""
        known = len(self.relations)
        if self.tried.get(id(expression), (expression, -1))[1] == known:
            return False
        used = self.use(expression)
        if not used:
            self.tried[id(expression)] = expression, known
        return used

    def _split(self, waiting: Sequence[ca.SX]) -> None:
        """Raise _Split for the first equation that is a product of functions that may vanish."""
        for expression in waiting:
            _, (value,) = self.exact(self.substitute(expression))
            factors = essentials(value)
            if 1 < len(factors) <= _MOST_BRANCHES:
                raise _Split([self.to_sx(factor) for factor in factors])

    def _stopped(self, waiting: Sequence[ca.SX]) -> list[ca.SX]:
        """Rates of states that an equation of their own holds: the zeros of an analytic function are isolated."""
        if not waiting:
            return []
        _, values = self.exact(*ca.vertsplit(self.substitute(ca.vertcat(*waiting))))
        alone = [(value, min(value.symbols())) for value in values if len(value.symbols()) == 1 and is_entire(value)]
        return [self.flow.drift[k] for value, k in alone if k < self.states and self._varies(value)]

    def _varies(self, value: Quotient) -> bool:
        return certainly_varies(self.flow.plant, self.to_sx(value), ca.vertcat(*self.symbols))

    def _rests(self, waiting: Sequence[ca.SX]) -> bool:
        """Whether the velocities of the states that are left are combinations of functions that vanish on the set.

        The states that are solved depend on them and on constants, so they rest too.
        """
        free = [k for k in range(self.states) if k not in self.solved]
        velocities = [self.flow.drift[k] for k in free]
        try:
            _, values = self.exact(*ca.vertsplit(self.substitute(ca.vertcat(*waiting, *velocities))))
        except UnsupportedOperation:
            return False
        if not all(value.is_polynomial() for value in values):
            return all(value.is_zero() for value in values[len(waiting) :])
        zeros = [value.numerator.to_dict() for value in values[: len(waiting)]]
        return all(is_combination(value.numerator.to_dict(), zeros) for value in values[len(waiting) :])

    def _settle(self, waiting: Sequence[ca.SX]) -> None:
        """Use that everything rests, as far as it goes: Lie derivatives say nothing more."""
        self.resting = True
        queue = [*waiting, *ca.vertsplit(self.flow.drift)]
        try:
            while queue:
                before = len(self.solved)
                queue = self.nonzero([e for e in self._use_affine(queue) if not self.use(e)])
                if len(self.solved) == before:
                    break
        except UnsupportedOperation:
            pass  # too large to be solved for more states; they stay free
        self.pending = list(queue)

    def _use_affine(self, queue: Sequence[ca.SX]) -> list[ca.SX]:
        """Solve the equations that are affine with constant coefficients, all at once; what is left is returned."""
        try:
            field_, values = self.exact(*ca.vertsplit(self.substitute(ca.vertcat(*queue))))
        except UnsupportedOperation:
            return list(queue)
        rows: dict[int, Row] = {}
        left = []
        for equation, value in zip(queue, values, strict=True):
            row = affine(value, len(self.symbols))
            if row is None:
                left.append(equation)
                continue
            while not rows.keys().isdisjoint(row):
                row = eliminated(row, rows)
            unknown = [k for k in row if k != CONSTANT]
            if not unknown:
                left += [equation] if row else []
                continue
            k = min(int(str(key)) for key in unknown)
            rest = {key: c / row[k] for key, c in row.items() if key != k}
            found_value = combination(field_, rest)
            self._record(k, found_value, self.to_sx(found_value))
            rows[k] = rest
        for k in reversed([*rows]):  # what a row holds was solved later, or is free
            rows[k] = eliminated(rows[k], rows)
        if rows:
            found = [self.to_sx(combination(field_, row)) for row in rows.values()]
            old, new = ca.vertcat(*[self.symbols[k] for k in rows]), ca.vertcat(*found)
            self.solved = {j: ca.substitute(value, old, new) for j, value in self.solved.items()}
            self.solved |= dict(zip(rows, found, strict=True))
        return left

    def _record(self, k: int, value: Quotient, expression: ca.SX) -> None:
        self.relations.append(self.symbols[k] - expression)
        self.steps.append(f"{self.names[k]} = {short(value)}")

    def _derivatives(self, waiting: Sequence[ca.SX]) -> list[ca.SX]:
        """Along the trajectories, of what was not followed before."""
        fresh = {id(e): e for e in (*self.relations, *waiting) if id(e) not in self.followed}
        self.followed |= fresh
        column = ca.vertcat(*fresh.values())
        return ca.vertsplit(ca.jtimes(column, self.flow.plant.system.x, self.flow.drift)) if fresh else []

    def _distinct(self, waiting: Sequence[ca.SX], more: Sequence[ca.SX]) -> tuple[list[ca.SX], list[ca.SX]]:
        """Both without what vanishes or is a multiple of an earlier one; of the second, solved variables replaced."""
        if not waiting and not more:
            return [], []
        on_set = ca.vertsplit(self.substitute(ca.vertcat(*waiting, *more)))
        _, values = self.exact(*on_set)
        keys = ["" if v.is_zero() else str(v.numerator / v.numerator.leading_coefficient()) for v in values]
        first = {key: k for k, key in reversed([*enumerate(keys)]) if key}
        kept = sorted(first.values())
        size = len(waiting)
        return [waiting[k] for k in kept if k < size], [on_set[k] for k in kept if k >= size]

    def vanishes(self, expression: ca.SX) -> bool:
        """Whether the expression is zero on the set, as far as it is known."""
        return not self.nonzero([expression])

    def nonzero(self, expressions: Sequence[ca.SX]) -> list[ca.SX]:
        """Those that are not known to be zero on the set, with solved variables replaced."""
        if not expressions:
            return []
        on_set = ca.vertsplit(self.substitute(ca.vertcat(*expressions)))
        _, values = self.exact(*on_set)
        return [e for e, value in zip(on_set, values, strict=True) if not value.is_zero()]

    def _linear_block(self, waiting: list[ca.SX]) -> list[ca.SX]:
        """Equations ``A(q) z = 0`` in as many states z: they give z = 0 when det A never vanishes."""
        mechanics = self.flow.plant.system.mechanical
        if mechanics is None or not waiting:
            return waiting
        left = [k for k in range(self.states) if k not in self.solved]
        momenta = [k for k in left if k >= self.states // 2]
        column = ca.vertcat(*[self.substitute(w) for w in waiting])
        z = ca.vertcat(*[self.symbols[k] for k in momenta]) if momenta else ca.SX(0, 1)
        if not momenta:
            return waiting
        matrix = ca.jacobian(column, z)
        if ca.depends_on(matrix, z):
            return waiting
        rows = [
            i
            for i in range(column.numel())
            if matrix[i, :].nnz() and self.vanishes(column[i] - ca.mtimes(matrix[i, :], z))
        ]
        if len(rows) < len(momenta):
            return waiting
        for start in range(len(rows) - len(momenta) + 1):
            chosen = rows[start : start + len(momenta)]
            _, (determinant,) = self.exact(_determinant(matrix[chosen, :]))
            if not determinant.is_zero() and never_zero(determinant):
                for k in momenta:
                    self._assign_zero(k)
                return [w for i, w in enumerate(waiting) if i not in rows]
        return waiting

    def _assign_zero(self, k: int) -> None:
        zero = ca.SX(0)
        for j in list(self.solved):
            self.solved[j] = ca.substitute(self.solved[j], self.symbols[k], zero)
        self.solved[k] = zero
        self.relations.append(self.symbols[k])
        self.steps.append(f"{self.names[k]} = 0")


def invariant_set(
    flow_: Flow, fixed: ca.SX | None = None, extra: ca.SX | None = None, budget: int = _BUDGET
) -> InvariantSet:
    """Eliminate as far as possible.

    Args:
        flow_: the flow and its base equations.
        fixed: exact values of ubar, when they are known.
        extra: further equations that hold on the set, a column.
        budget: instructions of all the expressions that may be looked at.

    Raises:
        UnsupportedOperation: for models that are not analytic, and when the equations grow beyond the budget.
    """
    base, drift = flow_.base, flow_.drift
    if extra is not None:
        base = ca.vertcat(base, extra)
    if fixed is not None:
        base = ca.substitute(base, flow_.constant, fixed)
        drift = ca.substitute(drift, flow_.constant, fixed)
    return _reduced(Flow(flow_.plant, flow_.constant, drift, base), False, budget)


def branches(flow_: Flow) -> list[InvariantSet]:
    """The invariant set as a union: where an equation is a product, one branch for each factor; none if too many.

    Raises:
        UnsupportedOperation: for models that are not analytic, and when the equations grow beyond the budget.
    """
    waiting: list[list[ca.SX]] = [[]]
    done: list[InvariantSet] = []
    analytic = _is_analytic(flow_)
    while waiting:
        assumed = waiting.pop()
        try:
            base = ca.vertcat(flow_.base, *assumed)
            done.append(
                _reduced(
                    Flow(flow_.plant, flow_.constant, flow_.drift, base),
                    analytic and len(assumed) < _DEEPEST,
                    _BUDGET // 4,
                )
            )
        except _Split as found:
            waiting += [[*assumed, factor] for factor in found.factors]
        if len(waiting) + len(done) > _MOST_BRANCHES:
            return []
    return done


def _is_analytic(flow_: Flow) -> bool:
    """Whether trajectories are analytic in time: no moduli, and roots and logarithms of positive functions only."""
    plant = flow_.plant
    both = ca.substitute(ca.vertcat(flow_.drift, flow_.base), flow_.constant, plant.system.u)
    try:
        field_, _ = plant.exact(both)
    except UnsupportedOperation:
        return False
    return all(
        atom.kind != "fabs" and (atom.kind not in ("sqrt", "log") or positive(atom.argument))
        for atom in field_.atoms.values()
    )


def _reduced(flow_: Flow, splitting: bool, budget: int) -> InvariantSet:
    """Raises _Split where an equation is a product, if that is wanted."""
    plant = flow_.plant
    m = plant.system.m
    symbols = [*ca.vertsplit(plant.system.x), *ca.vertsplit(flow_.constant)]
    names = [*plant.system.state_names, *[f"ubar_{i + 1}" if m > 1 else "ubar" for i in range(m)]]
    work = _Elimination(flow_, names, symbols, budget=budget, splitting=splitting)
    closed = work.run()
    n = plant.system.n
    resting = work.resting or (closed and not work.nonzero(ca.vertsplit(flow_.drift)))
    return InvariantSet(
        {k: v for k, v in work.solved.items() if k < n},
        tuple(k for k in range(n) if k not in work.solved),
        tuple(work.pending),
        {k - n: v for k, v in work.solved.items() if k >= n},
        resting,
        closed,
        tuple(work.steps),
    )


def _determinant(matrix: ca.SX) -> ca.SX:
    return ca.det(matrix) if matrix.shape[0] > 1 else matrix[0, 0]
