"""Motions near x* that the controller does not see: with u = u* and gamma = gamma*, so that its filters rest.

They stay in a set that a certificate writes as functions of some of the states, which are free.
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb, fmpq

from pbcgen.reading.no_output import NoOutput
from pbcgen.symbolic.plain.elimination import Elimination, put_in, slopes
from pbcgen.symbolic.plain.matrices import dot, transpose
from pbcgen.symbolic.plain.outcomes import require
from pbcgen.symbolic.plain.values import sign


class Unseen(NoOutput):
    """What such a set shows about x*."""

    def unseen(self, claim: str) -> Elimination:
        """The set of a witness: x* is in it, u = u* keeps it, and gamma, and eta if it is fed back, are constant."""
        self.in_states()
        set_ = (chain := self.on_set(claim)).solved
        require(len(set_) < self.n and max(set_, default=0) < self.n, "the set has no other states than x*")
        signals = [name for name in ("gamma", "eta") if name in self.exact]
        constants = [a - b for s in signals for a, (b,) in zip(self.column(s), self.numbers(s), strict=True)]
        chain.solved = {self.n + j: self.field.lift(u) for j, u in enumerate(self.resting_input)} | set_
        for k, value in set_.items():
            require(sign(put_in(self.field, value, self.point[0]) - self.point[0][k]) == 0, "x* is not in the set")
            constants.append(dot(slopes(self.field, self.field.symbols[k] - value), self.rates))
        self.zero([chain.reduced(v) for v in constants], "the set is not as it must be")
        return chain

    def undamped(self) -> None:
        """S_d is constant along the motions of the set, and not the same on all of it near x*: x* does not attract."""
        chain = self.unseen("asymptotically-stable")
        set_ = {k: v for k, v in chain.solved.items() if k < self.n}
        self.zero([chain.reduced(self.power_at(self.push))], "something is lost on the set")
        values = [set_.get(k, self.field.symbols[k]) for k in range(self.n)]
        slope = [[put_in(self.field, v, self.point[0]) for v in slopes(self.field, a)[: self.n]] for a in values]
        require(all(sign(slope[k][j]) == 0 for k in set_ for j in set_), "the set is not written in its free states")
        tangents = [d for k, d in enumerate(transpose(slope)) if k not in set_]
        bends = [dot(d, [dot(row, d) for row in self.hessian_d]) for d in tangents]
        require({1, -1} & {*map(sign, bends)}, "S_d may be the same on all of the set")
        self.smooth()

    def drifts(self, rate: Sequence[fmpq]) -> None:
        """In the set ``x' = s(x) v`` with a constant v, along which s does not change: x* is not stable.

        The motions are ``x + t s(x) v``. As s vanishes at x* but its slope does not, some start as near to x* as one
        likes with s != 0, and leave every bounded set.
        """
        chain = self.unseen("stable")
        moved = [chain.reduced(v) for v in self.rates[: self.n]]
        require(any(rate), "nothing moves")
        speed = next(v / a for v, a in zip(moved, rate, strict=True) if a)
        slope = slopes(self.field, speed)[: self.n]
        steady = [*(v - speed * a for v, a in zip(moved, rate, strict=True)), dot(slope, rate)]
        self.zero(steady, "the motion is not steady")
        require({1, -1} & {sign(put_in(self.field, v, self.point[0])) for v in slope}, "nothing may move near x*")
        require(all(arb(v).is_finite() for row in self.continuous for v in row), "the model may not be smooth at x*")
