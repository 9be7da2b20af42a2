"""Storages that are radially unbounded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pbcgen.reading.settings import Family
from pbcgen.symbolic.plain.elimination import put_in, slopes
from pbcgen.symbolic.plain.formulas import combination
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, plus, symmetric
from pbcgen.symbolic.plain.outcomes import require
from pbcgen.symbolic.plain.values import sign

GLOBAL = "globally-asymptotically-stable"


class Growth(Family):
    """What a global claim rests on beside the invariant set."""

    def increasing(self, step: Mapping[str, Any], functions: Sequence[Any], known: set[int], least: Any) -> Matrix:
        """Combinations of functions increase with some states y by ``least``, the known ones staying what they are.

        Their Jacobian J by y has ``sym J >= least I``, and no other state occurs. Then y is known too.
        """
        states = step["states"]
        values = [self.field.lift(combination(row, functions)) for row in step["rows"]]
        require(all(int(k) >= 0 for row in step["rows"] for k in row), "there is no such function")
        require(set().union(*(v.used for v in values)) <= known | {*states}, "another state occurs")
        J = symmetric([[slopes(self.field, v)[k] for k in states] for v in values])
        self.nonnegative(plus(J, diagonal([least] * len(states)), -1), GLOBAL, step)
        known |= {*states}
        return J

    def grows(self, witness: Mapping[str, Any]) -> None:
        """The Lyapunov function is radially unbounded.

        The storage is ``sum s_i t_i^2``, and a convex function of some states with a strict minimum at x*, or else
        ``sum lambda_j gamma_j``, squares and bounded terms. Step by step, some t_i (s_i > 0, known), and gamma_j whose
        ln cosh outgrows ``lambda_j - u_j*``, bound further states: they grow with these at least linearly.
        """
        V = self.potential(self.field.symbols[: self.half], self.field.lift) if self.compensated else 0
        rest, gamma = self.column("S")[0] - V, self.column("gamma")
        parts = [(self.placed[s], self.placed[t]) for s, t in witness["parts"]]
        require(all(self.field.positive(s) for s, _ in parts), "a weight is not positive")
        rest = rest - sum((s * t * t for s, t in parts), self.field.lift(0))
        outgrown, known = [True] * self.m, set[int]()
        if "convex" in witness:
            known = self._convex(rest, [t for _, t in parts], witness["convex"])
        else:
            outgrown = self._terms(rest, parts, witness)
        for step in witness["spans"]:
            chosen, least = {int(k) for row in step["rows"] for k in row}, self.placed[step["least"]]
            require(all(outgrown[k - len(parts)] for k in chosen if k >= len(parts)), "ln cosh does not outgrow")
            weights = [least, *(parts[k][0] for k in chosen if k < len(parts))]
            require(self.field.positive(least), "nothing increases")
            require(set().union(*(v.used for v in weights)) <= known, "a weight is not known")
            self.increasing(step, [*(t for _, t in parts), *gamma], known, least)
        require(known >= {*range(self.n)}, "a state may grow alone")

    def _terms(self, rest: Any, parts: Sequence[tuple[Any, Any]], witness: Mapping[str, Any]) -> list[bool]:
        """Which ln cosh outgrow the linear terms; the others are affine in t_i with constant s_i."""
        linear, gamma = self.given(GLOBAL, "linear"), self.column("gamma")
        force = [a if self.compensated else a - u for a, u in zip(linear, self.point[1], strict=True)]
        outgrown = [sign(a - abs(v)) == 1 for a, v in zip(self.model.vector("alpha"), force, strict=True)]
        for j, row in enumerate(witness["rows"]):
            rest = rest - gamma[j] * linear[j]
            affine = gamma[j] - combination(row, [t for _, t in parts])
            steady = [parts[int(k)][0].number() for k in row]
            slow = all(steady) and self.field.lift(affine).number() is not None
            require(outgrown[j] or slow, "gamma may outgrow the storage")
        left = self.without_squares([[self.field.lift(rest)]], GLOBAL, witness["excess"])
        require(self.field.bounded(left[0][0]), "more grows")
        return outgrown

    def _convex(self, rest: Any, others: Sequence[Any], witness: Mapping[str, Any]) -> set[int]:
        """The states y by which gamma, affine, and the rest of the storage are given, which is convex in them.

        The other terms and their slopes by y vanish at x*: there the Hessian of the Lyapunov function by (y, x_c) is
        positive definite without them, and the gradient zero. A convex function grows around a strict minimum.
        """
        states, gamma = {*witness["states"]}, self.column("gamma")
        require(not self.compensated and rest.used.union(*(v.used for v in gamma)) <= states, "another state occurs")
        require(all(v.number() is not None for row in self.slope("gamma") for v in row), "gamma is not affine")
        flat = [v for t in others for v in (t, *(slopes(self.field, t)[k] for k in states))]
        require(all(sign(put_in(self.field, v, self.rest_point)) == 0 for v in flat), "a term does not vanish at x*")
        H = [[slopes(self.field, v)[k] for k in states] for v in (slopes(self.field, rest)[k] for k in states)]
        self.nonnegative(H, GLOBAL, witness)
        return states
