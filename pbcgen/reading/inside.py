"""Global claims on a domain: no trajectory leaves it, or reaches its ends."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

from flint import fmpq

from pbcgen.reading.overall import GLOBAL, Overall
from pbcgen.symbolic.plain.elimination import put_in
from pbcgen.symbolic.plain.formulas import rational
from pbcgen.symbolic.plain.outcomes import NotCheckable, require
from pbcgen.symbolic.plain.values import apply, sign


class Inside(Overall):
    """A design whose model is restricted to a box D of its states, with x* inside.

    What the proof for the whole space asks for is asked for on D, which is convex: signs of divisors and arguments, the
    invariant set, differences between two rests as mean values. That trajectories stay in D is shown by what the rates
    are at its ends, or by what is stored there.
    """

    def grown(self, witness: Mapping[str, Any]) -> Self:
        """The design, on its domain if it has one, where the storage grows with all states and no trajectory leaves."""
        if not self.model.domain:
            self.grows(witness)
            everywhere = {self.domain[c] for c in ("assumption-1", "passive-output")} == {"all x"}
            require(everywhere, "it holds on a domain only")
            return self
        require(self.on_box(GLOBAL), "the model is restricted to a domain")
        loop = self.on_domain("kept" in witness)
        if "kept" in witness:
            loop._keeps(witness["kept"])
            loop.grows(witness)
            return loop
        require(not re.search(r"[\[\]=]", self.domain[GLOBAL]), "the ends belong to the domain")
        z = self.logarithmic(witness["growth"]["terms"])
        z.grows(witness["growth"])
        require(z.field.entire(moduli=True), "the storage may not be smooth inside of the domain")
        return loop

    def on_domain(self, closed: bool) -> Self:
        """The same design where signs are asked for on D only."""
        other = self._again(self.document)
        other.field.ends = self.widened if closed else self.bounded
        return other

    def logarithmic(self, terms: Sequence[str]) -> Self:
        """The storage and gamma with coordinates z in place of the states, to see that it grows towards the ends of D.

        ``x_k = a + exp(z_k)``, ``b - exp(z_k)`` or ``(a + b exp(z_k)) / (1 + exp(z_k))`` maps the whole space smoothly
        onto what is between the ends, and z* to x*, both ways. The rates stay those of x.
        """
        require(not self.compensated, "this is not known where a force is compensated", NotCheckable)
        z = self._again({**self.document, "terms": terms})
        z.opened, z.model = self.bounded, replace(self.model, domain={})
        z.point = [_logarithm(v, *self.bounded.get(k, ())) for k, v in enumerate(self.point[0])], self.point[1]
        return z

    def _again(self, document: Mapping[str, Any]) -> Self:
        return type(self)(document, self.field.pool, self.field.units)

    def _keeps(self, witness: Mapping[str, Any]) -> None:
        """At the ends of D the rates do not point outside, whatever the law asks for (Nagumo).

        ``u - u*``, or with a force that is compensated u less that, stays within what all tanh pull together; f and g
        are Lipschitz on D.
        """
        self.reach = [(rational(lo), rational(hi)) for lo, hi in witness["inputs"]]
        for (lo, hi), u, s in zip(self.reach, self.resting_input, self.pull, strict=True):
            require({sign(u - s - lo), sign(hi - u - s)} <= {0, 1}, "an input may be larger")
        for rate, squares in zip(self.inwards, witness["ends"], strict=True):
            self.nonnegative([[rate]], GLOBAL, {"squares": squares})

    @property
    def inwards(self) -> list[Any]:
        """How fast a state moves to the inside where it is at an end, whatever the others and the inputs are."""
        found = []
        for k, ends in self.bounded.items():
            for end, side in zip(ends, (1, -1), strict=True):
                if end is not None:
                    place = [self.field.lift(end) if j == k else v for j, v in enumerate(self.field.symbols)]
                    found.append(self.field.lift(put_in(self.field, self.field.lift(self.moved[k][0]), place)) * side)
        return found


def _logarithm(x: Any, lo: fmpq | None = None, hi: fmpq | None = None) -> Any:
    """z of x."""
    parts = x if lo is None else x - lo, 1 if hi is None else hi - x
    return x if lo is hi is None else apply("log", parts[1] if lo is None else parts[0] / parts[1])
