"""Targets that no real state meets: what follows from the equations of a rest contradicts itself, or leaves the domain.

What is concluded holds of every real state and input in the domain where the equations are defined.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from math import lcm, prod
from typing import Any

from flint import fmpz_poly

from pbcgen.reading.overall import Overall
from pbcgen.symbolic.plain.elimination import Elimination
from pbcgen.symbolic.plain.outcomes import require
from pbcgen.symbolic.plain.values import Function, sign


class NoRest(Overall):
    """How a certificate shows that equations have no solution."""

    def nowhere(self, chain: Elimination, witness: Mapping[str, Any]) -> None:
        """No state of the domain meets the equations of a chain.

        After the steps an equation is a product, and none of its factors can be zero. Or the last equation is one and a
        sum of squares. Or one has no zero, or as a polynomial in one variable no real one; or a state is outside.
        """
        self.follow(chain, witness["steps"])
        if "cases" in witness:
            return self.each_case(chain, witness["cases"], self.nowhere)
        if "squares" in witness:
            places = [place for _, _, vector in witness["squares"] for place in vector]
            factors = [factor for _, found, _ in witness["squares"] for factor in found]
            places += [place for kind, a, b, _ in factors if kind not in ("above", "below", "box") for place in (a, b)]
            steady = not any(map(self.field.has_poles, self.vector(places)))
            left = self.without_squares([[chain.equations[-1] - 1]], "equilibrium", witness["squares"])[0][0]
            return require(steady and not chain.reduced(left).top, "the squares do not add up to this equation")
        given = {name: chain.solved[k].number() for k, name in enumerate(self.states) if k in chain.solved}
        outside = not self.inside({name: value for name, value in given.items() if value is not None})
        left_over = map(chain.reduced, chain.equations)
        without = outside or any(self.field.everywhere(e.top) or self._rootless(e) for e in left_over)
        return require(without, "there may be such an equilibrium")

    def each_case(
        self, chain: Elimination, cases: Sequence[Any], then: Callable[[Elimination, Mapping[str, Any]], None]
    ) -> None:
        """An equation is a product, so that one of its factors vanishes: what follows in each case."""
        source, *cases = cases
        factors = [self.field.lift(self.placed[place]) for place, _ in cases]
        require(not any(map(self.field.has_poles, factors)), "a factor has poles")
        require(chain.leaves(source, prod(factors, start=self.field.lift(1))), "no factor need vanish")
        for factor, (_, case) in zip(factors, cases, strict=True):
            other = copy.copy(chain)
            other.equations = [*chain.equations, factor]
            then(other, case)

    def _rootless(self, a: Function) -> bool:
        """Whether a polynomial in one state or input has no real root within its bounds."""
        if len(a.present) != 1 or min(a.present) < 0 or not a.bottom.is_constant():
            return False
        (k,) = a.present
        lo, hi = self.model.domain.get(self.states[k], (None, None)) if k < self.n else (None, None)
        terms = {int(e[self.field.pool + k]): c for e, c in a.top.to_dict().items()}
        scale = lcm(*(int(c.q) for c in terms.values()))
        polynomial = fmpz_poly([int((terms[d] * scale).p) if d in terms else 0 for d in range(max(terms) + 1)])
        real = [root.real for root, _ in polynomial.complex_roots() if root.imag.contains(0)]
        return all((lo is not None and sign(lo - r) == 1) or (hi is not None and sign(r - hi) == 1) for r in real)
