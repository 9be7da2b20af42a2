"""Equations that hold along every trajectory of a set: their Lie derivatives hold too, and some give a variable.

Nothing is searched for. A step names an equation and says what it gives; it is accepted when the equation, after what
was found before is put in, is what is said to vanish times a function that vanishes nowhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from flint import fmpq

from pbcgen.symbolic.plain.matrices import dot
from pbcgen.symbolic.plain.values import ODD, Field, Function, apply, partial, plain, variables

_ONE = fmpq(1)


def put_in(field: Field, a: Function, values: Sequence[Any]) -> Any:
    """The function with values of any kind in place of the symbols."""
    (content, factors), value, safe = a.bottom.factor(), field.at(a.top, values), field.everywhere(a.bottom)
    for factor, times in factors:
        below = field.at(factor, values)
        known = isinstance(plain(below), Function) and not field.ends  # what is put in may be beyond these
        if known and (safe or field.everywhere(factor)):  # so it is whatever is put in
            field.nowhere_zero.add(str(plain(below).top))
        for _ in range(int(times)):
            value = value / below
    return value / content


def slopes(field: Field, a: Function) -> list[Function]:
    """The partial derivatives of a function by the symbols."""
    degrees = a.top.degrees()
    if a.bottom.is_constant() and not any(degrees[: field.pool]):  # a polynomial without atoms
        tops = [a.top.derivative(k) if degrees[k] else None for k in range(field.pool, len(degrees))]
        return [field.lift(0) if top is None else field.quotient(top, a.bottom) for top in tops]
    dual = put_in(field, a, variables(field.symbols))
    return field.continued([a, *(field.lift(partial(dual, k)) for k in range(len(field.symbols)))])[1:]


class Elimination:
    """What is known on the set: equations ``e = 0``, and variables as functions of the others."""

    def __init__(self, field: Field, rates: Sequence[Function], equations: Sequence[Function]) -> None:
        self.field, self.rates, self.equations = field, list(rates), list(equations)
        self.solved: dict[int, Function] = {}

    def reduced(self, a: Function, values: Mapping[int, Function] | None = None) -> Function:
        """The function with the solved variables, or other values, put in where they may occur."""
        values = self.solved if values is None else values
        if not a.used & values.keys():
            return a
        pool, bent = self.field.pool, a.top.total_degree() > 1
        whole = bent and all(f.bottom.is_constant() for f in (a, *values.values()))
        if whole and not any(a.top.degrees()[:pool]):  # polynomials of some degree, without atoms
            put = {pool + k: v.top / v.bottom for k, v in values.items()}
            inside = [put.get(k, g) for k, g in enumerate(self.field.generators)]
            return self.field.quotient(a.top.compose(*inside), a.bottom)
        return self.field.lift(put_in(self.field, a, [values.get(k, v) for k, v in enumerate(self.field.symbols)]))

    def derive(self, source: int) -> None:
        """Add the derivative of an equation along the trajectories; ``0 = 0`` if it holds variables without a rate."""
        by, known = slopes(self.field, self.equations[source]), len(self.rates)
        rate = self.field.lift(0) if any(v.top for v in by[known:]) else dot(by[:known], self.rates)
        self.equations.append(self.field.lift(rate))

    def solve(self, source: int, k: int, value: Function, kind: str = "", scale: fmpq = _ONE) -> bool:
        """Take ``x_k = value`` from an equation, and add its derivative; whether that follows.

        The equation must be a power of ``x_k - value``, or of ``kind(scale (x_k - value))`` with kind odd and
        increasing, times a function that vanishes nowhere.
        """
        zero = self.field.symbols[k] - value
        fresh = k not in self.solved and not value.used & {k, *self.solved}
        if not fresh or (kind and (kind not in ODD or scale == 0)):
            return False
        if not self.leaves(source, apply(kind, zero * scale) if kind else zero):
            return False
        self.solved = {j: self.reduced(a, {k: value}) for j, a in self.solved.items()} | {k: value}
        self.equations.append(zero)
        self.derive(-1)
        del self.equations[-2]
        return True

    def leaves(self, source: int, gone: Function) -> bool:
        """Whether an equation is a power of this function times a function that vanishes nowhere."""
        e = self.reduced(self.equations[source])
        for _ in range(max(1, int(e.top.total_degree()))):
            e = self.field.quotient(e.top, gone.top)
            if self.field.everywhere(e.top) and self.field.everywhere(gone.bottom):
                return True
        return False
