"""What global claims rest on: storages that grow without bound, and that x* is the only rest."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from flint import arb, fmpq

from pbcgen.reading.sectors import Sectors
from pbcgen.symbolic.plain.boxes import Box, ball, covered
from pbcgen.symbolic.plain.elimination import Elimination, put_in, slopes
from pbcgen.symbolic.plain.formulas import combination, rational
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, dot, is_definite, plus, product, symmetric, transpose
from pbcgen.symbolic.plain.outcomes import NotCheckable, require
from pbcgen.symbolic.plain.spectra import krawczyk, preconditioned, stable
from pbcgen.symbolic.plain.values import apply, power, sign

GLOBAL = "globally-asymptotically-stable"

#: What is free at the rests, and U, Gamma and the equations as functions of that.
Rests = tuple[list[int], list[Any]]


class Overall(Sectors):
    """What a global claim rests on beside the invariant set.

    Two rests of the closed loop with the constant inputs U and ``Gamma = gamma + K_c^-1 U`` have
    ``U - u* + alpha tanh(beta (Gamma - Gamma*)) = 0``, hence ``dU^T dGamma < 0`` unless dU = 0, and then dGamma = 0.
    """

    # --- storages --------------------------------------------------------------------------------------------------

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
        ln cosh outgrows ``lambda_j - u_j*``, bound further states: they grow with these at least linearly. A domain
        bounds states too.
        """
        bounded = {k for k, pair in enumerate(self.ends[: self.n]) if None not in pair}
        if len(bounded) == self.n:
            return
        V = self.potential(self.field.symbols[: self.half], self.field.lift) if self.compensated else 0
        rest, gamma = self.column("S")[0] - V, self.column("gamma")
        parts = [(self.placed[s], *self.field.continued([self.placed[t]])) for s, t in witness["parts"]]
        require(all(self.field.positive(s) for s, _ in parts), "a weight is not positive")
        rest = rest - sum((s * t * t for s, t in parts), self.field.lift(0))
        outgrown, known = [True] * self.m, bounded
        if "convex" in witness:
            known = bounded | self._convex(rest, [t for _, t in parts], witness["convex"])
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
        """The states y by which gamma is given, and the rest of the storage, which is convex in them around x*.

        The other terms and their slopes by y vanish at x*. For affine gamma the rest is convex, and with it the
        Lyapunov function without these terms, whose Hessian by (y, x_c) is positive definite at x*. Else the rest less
        ``u*^T gamma`` is convex, as it is for u at all corners of a box around u*, and its Hessian is positive definite
        at x*; what the Lyapunov function has beside it is nowhere negative. A convex function grows around a strict
        minimum.
        """
        states, gamma = {*witness["states"]}, self.column("gamma")
        require(not self.compensated and rest.used.union(*(v.used for v in gamma)) <= states, "another state occurs")
        flat = [v for t in others for v in (t, *(slopes(self.field, t)[k] for k in states))]
        require(all(sign(put_in(self.field, v, self.rest_point)) == 0 for v in flat), "a term does not vanish at x*")
        left = self.field.lift(rest - dot(self.constants, gamma))
        H = [[slopes(self.field, v)[k] for k in states] for v in (slopes(self.field, left)[k] for k in states)]
        if "forces" not in witness:
            require(all(v.used <= states for row in H for v in row), "gamma is not affine")
            self.nonnegative(H, GLOBAL, witness)
            return states
        box = [{*map(rational, ends)} for ends in witness["forces"]]
        for corner, part in zip(itertools.product(*map(sorted, box)), witness["corners"], strict=True):
            place = [*self.field.symbols[: self.n], *corner, *self.field.symbols[self.n + self.m :]]
            self.nonnegative([[put_in(self.field, v, place) for v in row] for row in H], GLOBAL, part)
        holds = all({sign(u - min(e)), sign(max(e) - u)} <= {0, 1} for u, e in zip(self.point[1], box, strict=True))
        strict = is_definite([[put_in(self.field, v, self.rest_point) for v in row] for row in H])
        require(holds and strict, "there may be no strict minimum")
        return states

    # --- rests -----------------------------------------------------------------------------------------------------

    def follow(self, chain: Elimination, steps: Sequence[Any]) -> Elimination:
        """What follows by the steps of a certificate.

        An equation gives a variable; its derivative holds too; it holds a state alone, which then rests, as the zeros
        of an analytic function are isolated; equations are added up with weights.
        """
        for source, *rest in steps:
            if source is None:
                require(not any(self.field.has_poles(self.placed[w]) for w in rest[0].values()), "a weight has poles")
                weighted = [chain.equations[int(k)] * self.placed[w] for k, w in rest[0].items()]
                chain.equations.append(sum(weighted, self.field.lift(0)))
            elif len(rest) == 1:
                (k,), e = rest, chain.reduced(chain.equations[source])
                places = [[self.field.within(j, fmpq(v)) for j in range(len(self.field.symbols))] for v in (1, 2, 3)]
                values = [arb(put_in(self.field, e, place)) for place in places]
                require(e.used == {k} and self.field.entire() and {1, -1} & {*map(sign, values)}, "the state may move")
                chain.equations.append(chain.rates[k])
            elif rest:
                k, place, *through = rest
                kind, scale = through or ("", "1")
                value = self.vector([place])[0]
                require(chain.solve(source, k, value, kind, rational(scale)), "a step does not follow")
            else:
                chain.derive(source)
        return chain

    @property
    def standing(self) -> Elimination:
        """What holds at every rest: n equations, and no accelerations."""
        chain = Elimination(self.field, [], self.rates[: self.n - len(self.inertia)] + self.balance)
        chain.solved = {self.n + self.m + k: self.field.lift(0) for k in range(len(self.inertia))}
        return chain

    def along(self, chain: Elimination) -> Rests:
        """What this leaves free, and U, Gamma and the equations as functions of that."""
        parts = self.constants, self.column("gamma"), chain.equations
        U, gamma, zero = ([chain.reduced(v) for v in part] for part in parts)
        G = [a + b for a, (b,) in zip(gamma, product(self.softness, [[v] for v in U]), strict=True)]
        return [k for k in range(self.n + self.m) if k not in chain.solved], U + G + zero

    def another(self, witness: Mapping[str, Any]) -> None:
        """There is another rest: by Krawczyk's test, apart from x*. Or a linear plant outgrows bounded inputs."""
        if "growth" in witness:
            return self._outgrows(rational(witness["growth"]))
        left, centre = self.left(self.along(self.standing), range(self.n)), [rational(v) for v in witness["centre"]]
        box = krawczyk(left, centre, rational(witness["radius"]))
        require(box is not None, "Krawczyk's test does not hold")
        state = (box or [])[: self.n]
        require({1, -1} & {sign(a - b) for a, b in zip(state, self.rest_point, strict=False)}, "this may be x* again")
        require(self.inside(dict(zip(self.states, state, strict=True))), "the state is not in the domain")
        return require(arb(self.walk(state)["S"][0][0]).is_finite(), "the storage is not defined there")

    def _outgrows(self, rate: fmpq) -> None:
        """f is ``A x`` and what is bounded, as g u is; and A grows at more than a rate in some direction."""
        require(rate >= 0 and not self.compensated and not self.model.domain, "the inputs may be large, or states not")
        f, size = self.column("f"), range(self.field.pool + len(self.field.symbols))
        units = [tuple(int(j == self.field.pool + k) for j in size) for k in range(self.n)]
        A = [[a.top.to_dict().get(unit, fmpq(0)) for unit in units] for a in f]
        rest = [a - dot(row, self.field.symbols[: self.n]) for a, row in zip(f, A, strict=True)]
        bounded = all(map(self.field.bounded, [*rest, *(v for row in self.functions("g") for v in row)]))
        require(bounded, "the plant is not linear but for what is bounded", NotCheckable)
        shifted = plus(A, diagonal([rate] * self.n), -1)
        require(stable(shifted, False) is False, "no mode certainly grows so fast")

    def alone(self, witness: Mapping[str, Any]) -> None:
        """x* is the only rest.

        Because ``dU^T dGamma``, with equations that hold at every rest times linear functions z_j, is nowhere negative
        for two of them, and what is then the same at both fixes all states; or all rests lie in a box.
        """
        rests = self.along(self.follow(self.standing, witness["steps"]))
        if "box" in witness:
            return self._in_box(witness["box"], rests)
        self.nonnegative(symmetric(self.relation(rests, witness["multipliers"])), GLOBAL, witness)
        known = set[int]()
        for step in witness["fixed"]:  # a monotone map that is strictly so at x*: no other point has the same value
            J = self.increasing(step, rests[1], known, self.field.lift(0))
            strict = is_definite([[put_in(self.field, v, self.rest_point) for v in row] for row in J])
            require(strict, "a state may not be fixed")
        return require(known >= {*rests[0]}, "x* may not be the only rest")

    def relation(self, rests: Rests, multipliers: Mapping[str, Mapping[str, str]]) -> Matrix:
        """The matrix that ``dU^T dGamma`` is a mean value of, as a form in the differences of what is free."""
        free, m, slope = rests[0], self.m, [[slopes(self.field, v)[k] for k in rests[0]] for v in rests[1]]
        require(all(v.number() is not None for row in slope[:m] for v in row), "the inputs are not affine")
        left = slope[:m] + [[rational(row.get(str(k), "0")) for k in free] for row in multipliers.values()]
        return product(transpose(left), slope[m : 2 * m] + [slope[2 * m :][int(j)] for j in multipliers])

    def _in_box(self, witness: Mapping[str, Any], rests: Rests) -> None:
        """All rests are in a box, and x* is the only zero there: by a tree of boxes."""
        ends = dict[int, fmpq]()
        for i, k, end in witness["ends"]:
            require(self.bounds(rests, i, k, rational(end), ends), "a coordinate may be larger")
            ends[k] = rational(end)
        holds, box = self.no_other(rests, witness["zero"]), [(-ends[k], ends[k]) for k in rests[0]]
        require(covered(witness["tree"], box, holds), "there may be another rest")

    def bounds(self, rests: Rests, i: int, k: int, end: fmpq, ends: Mapping[int, fmpq]) -> bool:
        """Whether function i makes ``abs(x_k) < end`` at rests, where ends hold: its leading power outweighs the rest.

        An equation is zero; ``abs(U - u*) < alpha``; and where it is less, Gamma is bounded by the inverse of tanh.
        """
        a, at, powers, j = rests[1][i], self.field.pool + k, dict[int, fmpq](), i % self.m
        held, alpha = self.resting_input[j], self.model.vector("alpha")[j]
        reach = fmpq(0) if i >= 2 * self.m else abs(held) + alpha
        if self.m <= i < 2 * self.m:
            centre, size = self.field.bound(rests[1][j], ends)
            inverse = arb((abs(centre - held) + size) / alpha).atanh() / self.model.vector("beta")[j]
            reach = abs(put_in(self.field, a, self.rest_point)) + inverse
        for exponents, c in a.top.to_dict().items():
            if exponents[at] and sum(map(int, exponents)) == exponents[at]:
                powers[int(exponents[at])] = c
        own = sum((power(self.field.symbols[k], fmpq(d)) * c for d, c in powers.items()), fmpq(0))
        centre, size = self.field.bound(a - own, ends)
        degree = max(powers, default=0)
        others = sum((abs(c) * end**d for d, c in powers.items() if d < degree), abs(centre) + size)
        return bool(min(i, k) >= 0 and degree and end > 0 and abs(powers[degree]) * end**degree > others + reach)

    def left(self, rests: Rests, chosen: Sequence[int]) -> Callable[[Sequence[Any]], list[Any]]:
        """What some of the equations, and those of the filters, leave of zero; these are zero at rests."""
        alpha, beta, m = self.model.vector("alpha"), self.model.vector("beta"), self.m
        outputs = [put_in(self.field, g, self.rest_point) for g in rests[1][m : 2 * m]]
        functions = rests[1][: 2 * m] + [rests[1][2 * m :][k] for k in chosen]
        functions += [] if "R_psi" not in self.model.gains else self.column("gamma")

        def function(z: Sequence[Any]) -> list[Any]:
            place = dict(zip(rests[0], z, strict="R_psi" not in self.model.gains))
            values = [place.get(k, fmpq(0)) for k in range(len(self.field.symbols))]
            found = [put_in(self.field, v, values) for v in functions]
            found, filters = self._integrated(found, list(z[len(place) :]))
            rows = zip(found, self.resting_input, alpha, beta, found[m:], outputs, strict=False)
            return found[2 * m :] + [u - c + apply("tanh", (g - d) * b) * a for u, c, a, b, g, d in rows] + filters

        return function

    def _integrated(self, found: list[Any], psi: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """U and Gamma without what the integral term holds, if the law has one, and what its filter leaves of zero."""
        if "R_psi" not in self.model.gains:
            return found, []
        require(len(psi) == self.m, "a rest of the integral term is missing")
        m, gains, star = self.m, self.model.gains, [*self.point[0], *self.point[1]]
        a, b, away = gains["alpha_psi"][0], gains["beta_psi"][0], found[-self.m :]
        held = [apply("tanh", s * v) * c for c, s, v in zip(a, b, psi, strict=True)]
        yielding = product(self.softness, [[v] for v in held])
        pulls = [put_in(self.field, g, star) for g in self.column("gamma")]
        leak = product(gains["R_psi"], [[v] for v in psi])
        rows = zip(leak, a, b, away, pulls, psi, strict=True)
        filters = [r * apply("cosh", s * v) - (g - d) * c * s for (r,), c, s, g, d, v in rows]
        both = [*held, *[v for (v,) in yielding]]
        return [x + y for x, y in zip(found[: 2 * m], both, strict=True)] + found[2 * m : -m], filters

    def no_other(self, rests: Rests, chosen: Sequence[int]) -> Callable[[str, Box], bool]:
        """What the leaves say: an equation has no zero (.), or the Jacobian of all is regular from there to x* (;)."""
        left, star = self.left(rests, chosen), [self.rest_point[k] for k in rests[0]]

        def holds(kind: str, part: Box) -> bool:
            balls = [arb(ball(lo, hi)) for lo, hi in part]
            if kind == ".":
                return any(sign(v) in (1, -1) for v in left(balls))
            _, defect = preconditioned(left, star, [b.union(arb(c)) for b, c in zip(balls, star, strict=True)])
            return all(sum(map(abs, row), arb(0)) < 1 for row in defect)

        return holds
