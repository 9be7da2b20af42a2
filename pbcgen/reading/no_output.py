"""Storages without a passive output: what the matrix Z of Hill and Moylan asks of every gamma, and cannot be.

``[1, u]^T Z [1, u] = u^T gamma' - S' = r^T (f + g u)`` is nowhere negative, where ``r = grad gamma u - grad S``. What
is shown here is that there is no gamma with second derivatives.
"""

from __future__ import annotations

from typing import Any

from flint import arb, fmpq

from pbcgen.reading.no_rest import NoRest
from pbcgen.symbolic.plain.elimination import put_in, slopes
from pbcgen.symbolic.plain.formulas import rational
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, dot, is_definite, plus, product, transpose
from pbcgen.symbolic.plain.outcomes import require
from pbcgen.symbolic.plain.spectra import inverse
from pbcgen.symbolic.plain.values import sign


class NoOutput(NoRest):
    """How a certificate shows that no gamma fits, or what one that fits must be at a rest."""

    def reached(self) -> Matrix:
        """``A = d(f + g u*)/dx``, where [A, g] has rank n at x*.

        There ``r^T (f + g u)``, which is zero at x* and nowhere negative, has the gradient ``[A, g]^T r = 0``. So r is
        zero: ``grad S = grad gamma u*``.
        """
        A, g = self.plant
        both = [[*row, *inputs] for row, inputs in zip(A, g, strict=True)]
        require(is_definite(product(both, transpose(both))), "[A, g] may lose rank at x*")
        return A

    def no_response(self, witness: Any) -> None:
        """``grad S^T z < 0`` at a rest and a frequency, for ``(A^2 + omega^2 I) z = g u``: then no gamma fits.

        As r is zero there, the second derivative of ``r^T (f + g u)`` in a direction (a, d) is
        ``2 (H a + grad gamma d)^T (A a + g d) >= 0``, where H is symmetric. In the directions (-A z, u) and
        (-omega z, 0) the two add up to ``2 omega^2 grad S^T z``.
        """
        rest, omega = self.elsewhere(witness["rest"]) if "rest" in witness else self, rational(witness["omega"])
        require(omega, "this is no frequency")
        A, (_, g) = rest.reached(), rest.plant
        bends = rest.hessian(rest.star["S"][0][0])
        require(all(arb(v).is_finite() for row in bends for v in row), "the storage may have no second derivatives")
        shifted = plus(product(A, A), diagonal([omega**2] * self.n))
        z = product(inverse(shifted), g, [[u] for u in rest.point[1]])
        require(sign(product(rest.jacobian(rest.star["S"]), z)[0][0]) == -1, "the response may be passive")

    def no_gradient(self, witness: Any) -> None:
        """What Z(x) >= 0 asks of ``psi = grad gamma_i`` where f = 0 on a set of states, and psi cannot be.

        There it asks for ``g_i^T grad S = 0``, and in a direction d in which the loss vanishes to third order for
        ``psi^T J d = d^T grad (g_i^T grad S)`` with J = df/dx. That is wrong where J d = 0; or J d is a unit vector for
        two directions, and these entries of psi are no gradient along the set.
        """
        self.in_states()
        chain, x = self.on_set("passive-output"), self.given("passive-output", "x")
        require(all(v.number() == x[k] for k, v in chain.solved.items()), "the state is not in the set")
        require(self.inside(dict(zip(self.states, x, strict=True)), {1}), "the state is not in the domain")
        natural = dot(transpose(self.functions("g"))[witness["input"]], self.slope("S")[0])
        gradients = self.column("f"), slopes(self.field, self.rate("S")[0][0])[: self.n]
        J, curvature = ([slopes(self.field, v)[: self.n] for v in part] for part in gradients)
        self.zero([chain.reduced(v) for v in self.column("f")], "f is not zero on the set")
        found = [(None, chain.reduced(natural))]
        for target, places in witness["vectors"]:
            d = self.vector(places)
            moved = [dot(row, d) - int(k == target) for k, row in enumerate(J)]
            vanish = [chain.reduced(v) for v in (*moved, *(dot(row, d) for row in curvature))]
            self.zero(vanish, "the direction is not as it must be")
            found.append((target, chain.reduced(dot(slopes(self.field, natural)[: self.n], d))))
        (j, first), (k, value) = found[-2:] if len(found) > 1 else (found[0], found[0])
        if k is not None:
            require({j, k} <= {*range(self.n)} - {*chain.solved}, "the entries are not along the set")
            value = slopes(self.field, first)[k] - slopes(self.field, value)[j]
        point = [*x, *[fmpq(0)] * self.m]
        require(sign(put_in(self.field, value, point)) in (1, -1), "this contradicts nothing")
