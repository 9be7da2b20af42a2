"""What the claims of stability say, and how a certificate shows them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

from flint import arb_mat, fmpq

from pbcgen.reading.overall import GLOBAL as _GLOBAL
from pbcgen.symbolic.plain.boxes import Box, ball, covered, shown
from pbcgen.symbolic.plain.elimination import Elimination, put_in, slopes
from pbcgen.symbolic.plain.formulas import combination, rational
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, dot, is_definite, plus, product, transpose
from pbcgen.symbolic.plain.outcomes import Fails, NotCheckable, require
from pbcgen.symbolic.plain.spectra import all_stable, stable
from pbcgen.symbolic.plain.values import Dual, sign
from pbcgen.verify.assumptions import Assumptions


class Stability(Assumptions):
    """By linearisation, by the Lyapunov function with LaSalle's argument, and for the sampled loop."""

    def closes(self) -> None:
        """There is a loop: what the law reads is measured, and its equation has one solution.

        The law `passive-output` reads ``y = gamma'``, where u may enter: then ``sym(grad gamma g) >= 0`` is what makes
        u unique, and it is part of what passive-output says.
        """
        self.once(self.proved_measurability)
        if "passive-output" in self.law and any(v.top for row in self.rate("gamma") for v in row[1:]):
            self.once(self.proved_passive_output)

    def lyapunov(self, least: bool = True) -> None:
        """The Lyapunov function of Prop. pro1, pro2 or pro4: it does not grow, and has a minimum at x*."""
        require("integral" not in self.law, "the law has no Lyapunov function", NotCheckable)
        filtered = "passive-output" not in self.law
        checks = [self.proved_assumption_1, self.proved_passive_output]
        checks += [self.proved_gain_definiteness] if filtered else []
        checks += [self.proved_theta] if "natural-damping" in self.law else []
        if least:
            checks += [self.proved_gradient_condition, self.proved_hessian_condition]
            checks += [self.proved_kc_bound] if filtered else []
        for check in checks:
            self.once(check)

    def on_leaves(self, witness: Mapping[str, Any]) -> None:
        """``S_d + lambda^T C x + t |C (x - x*)|^2`` has a minimum at x*, and C x is constant whatever the input."""
        C = [[rational(v) for v in row] for row in witness["conserved"]]
        self.zero([v for name in ("f", "g") for row in product(C, self.functions(name)) for v in row], "C x may move")
        self.lyapunov(least=False)
        slope = [*map(rational, witness["slope"])]
        flat = {sign(v + dot(c, slope)) for v, c in zip(self.shaped[0], transpose(C), strict=True)}
        if flat != {0}:
            require(not any(slope), "the gradient may not vanish on the leaf of x*")
            self.once(self.proved_gradient_condition)
        H = self.hessian_d if "passive-output" in self.law else self.hessian_dc
        wide = [row + [fmpq(0)] * (len(H) - self.n) for row in C]
        require(is_definite(plus(H, product(transpose(wide), wide), rational(witness["weight"]))), "no minimum")

    @cached_property
    def is_hurwitz(self) -> bool | None:
        """Whether the linearised closed loop is Hurwitz; None if that is not certain, or not what is shown."""
        if {"steps", "globally"} & self.witness["asymptotically-stable"].keys():
            return None
        return stable(self.continuous, False, self.storage("asymptotically-stable"))

    def proved_stable(self) -> None:
        """By the Lyapunov function, if need be on the leaves of what is conserved, or by linearisation."""
        if "conserved" in self.witness["stable"]:
            self.on_leaves(self.witness["stable"])
        elif not self.is_hurwitz:
            self.lyapunov()

    def refuted_stable(self) -> None:
        """The linearisation has an eigenvalue with a positive real part; or a motion that nobody sees never ends."""
        if "rate" in self.witness["stable"]:
            return self.drifts(self.given("stable", "rate"))
        known = Fails if self.is_hurwitz else NotCheckable
        return require(self.is_hurwitz is False, "no eigenvalue certainly grows", known)

    def proved_asymptotically_stable(self) -> None:
        """The linearisation is Hurwitz, or LaSalle's set consists of equilibria and x* is an isolated one."""
        if self.is_hurwitz:
            return None
        if "steps" not in self.witness["asymptotically-stable"]:
            require(self.is_hurwitz is None, "the linearisation is not Hurwitz")
            return self.once(self.proved_globally_asymptotically_stable)
        self.lyapunov()
        self.settles(self.undriven(), self.witness["asymptotically-stable"])
        self.smooth()
        return require(sign(arb_mat(self.continuous).det()) in (1, -1), "x* may not be isolated")

    def refuted_asymptotically_stable(self) -> None:
        """An unstable eigenvalue; a conserved linear function; or trajectories near x* with a constant storage."""
        witness = self.witness["asymptotically-stable"]
        if "conserved" in witness:
            c, moves = self.given("asymptotically-stable", "conserved"), [self.functions("f"), self.functions("g")]
            require(any(c), "nothing is conserved")
            return self.zero([v for rows in moves for v in product([c], rows)[0]], "it is not conserved")
        if "set" not in witness:
            return self.refuted_stable()
        self.once(self.proved_gradient_condition)
        return self.undamped()

    # --- LaSalle's invariant set -----------------------------------------------------------------------------------

    def undriven(self) -> Elimination:
        """What holds where the Lyapunov function rests: no dissipation, gamma constant, eta too for natural damping."""
        signals = ["gamma", "eta"] if "natural-damping" in self.law else ["gamma"]
        require(len(signals) == 1 or is_definite(self.theta), "Theta may not be positive definite")
        one_u, values = [self.field.lift(1), *self.push], [*self.field.symbols[: self.n], *self.push]
        equations = [self.field.lift(put_in(self.field, row, values)) for row in self.rows]
        equations += [dot(row, one_u) for name in signals for row in self.rate(name)]
        return Elimination(self.field, self.rates, equations + self.balance)

    def settles(self, chain: Elimination, witness: Mapping[str, Any]) -> None:
        """What follows from that by the steps of a certificate: that nothing moves.

        Each rate vanishes with what was found put in, less a combination of equations if the certificate names one. Or
        an equation is a product; along a trajectory, which is analytic, one of the factors then vanishes all the time.
        """
        self.follow(chain, witness["steps"])
        if "cases" in witness:
            require(self.field.entire(), "a motion may not be analytic")
            return self.each_case(chain, witness["cases"], self.settles)
        weights = (witness.get("rates", {}).get(str(i), {}) for i in range(len(self.rates)))
        still = [v - combination(row, chain.equations) for v, row in zip(self.rates, weights, strict=True)]
        return self.zero([chain.reduced(self.field.lift(v)) for v in still], "the invariant set may move")

    # --- on the whole space ----------------------------------------------------------------------------------------

    def proved_globally_asymptotically_stable(self) -> None:
        """The Lyapunov function is radially unbounded, and x* is the only point of LaSalle's set; or on the domain."""
        witness = self.witness[_GLOBAL]
        if "popov" in witness:
            return self.in_sectors(_GLOBAL)
        loop = self.grown(witness)  # first, as nothing is said against a claim whose certificate has no witness
        self.lyapunov()
        loop.settles(loop.undriven(), witness)
        loop.alone(witness["alone"])
        return require(loop.field.entire(moduli=True), "the model may not be smooth everywhere", NotCheckable)

    def refuted_globally_asymptotically_stable(self) -> None:
        """x* is not attractive, or there is another equilibrium: by Krawczyk's test, apart from x*."""
        if self.status["asymptotically-stable"] == "REFUTED":
            return self.refuted_asymptotically_stable()
        return self.another(self.witness[_GLOBAL])

    # --- sampled ---------------------------------------------------------------------------------------------------

    def proved_sampled_stable(self) -> None:
        """The storage decreases, where its damping is given; else the linearised sampled loop is Schur."""
        witness, whole = self.witness["sampled-stable"], self.domain["sampled-stable"] == "sampled loop, all x"
        if "Lambda" in witness and not (self.jitter and "natural-damping" in self.law):  # filters step by one period
            grown = not (whole and ("popov" in self.witness[_GLOBAL] or self.model.domain))
            require(grown, "nothing shows that the storage grows", NotCheckable)
            self.once(self.proved_globally_asymptotically_stable if whole else self.proved_asymptotically_stable)
            return self._decreases()
        if self.jitter and not whole:
            tree, P = witness["periods"], self.storage("sampled-stable") or []
            falls = is_definite(P) and covered(tree, self.periods, self.falling(P))
            return require(falls, "the form may grow with some periods")
        known = self.is_schur is False or (self.is_schur and not whole)
        require(known, "the certificate does not hold the damping that sampling consumes", NotCheckable)
        return require(self.is_schur, "the linearised sampled loop is not Schur")

    def falling(self, P: Matrix) -> Callable[[str, Box], bool]:
        """Whether a quadratic form decreases with all periods of a part of their range."""

        def rise(time: Any) -> Matrix:
            step = self.transition(time)
            return plus(product(transpose(step), P, step), P, -1)

        def falls(kind: str, part: Box) -> bool:
            ((lo, hi),) = part
            here, over = rise((lo + hi) / 2), rise(Dual(ball(lo, hi), {0: fmpq(1)}))
            return kind == "." and all_stable([(here, over, [(hi - lo) / 2])], False)

        return falls

    @cached_property
    def is_schur(self) -> bool | None:
        """Whether the linearised sampled loop is Schur; None if that is not certain."""
        return stable(self.sampled, True, self.storage("sampled-stable"))

    def refuted_sampled_stable(self) -> None:
        """An eigenvalue outside the unit disc; or what shows that x* does not attract stays so with held inputs."""
        shown = self.witness["asymptotically-stable"]
        if "conserved" in shown or ("set" in shown and not self.compensated):
            require(self.status["asymptotically-stable"] == "REFUTED", "it is said to attract")
            return self.once(self.refuted_asymptotically_stable)
        return require(self.is_schur is False, "no eigenvalue certainly lies outside the unit disc")

    def _decreases(self) -> None:
        """What the longest period h consumes leaves damping: ``Lambda - h C / 2 > 0`` for y, or Theta > 0 with that."""
        require("delay" not in self.model.words, "the storage argument is for inputs that act at once")
        self.lyapunov()
        gains, damped = self.model.gains, "natural-damping" in self.law
        h = self.period * (1 + self.jitter)
        rates = (self.rate("eta") if damped else []) + self.rate("gamma")
        consumed = [row[k] for k, row in enumerate(self.stiffness)]
        if damped:
            consumed = [c + a * b for c, a, b in zip(consumed, gains["alpha_l"][0], gains["beta_l"][0], strict=True)]
        if self.compensated:
            bounds = [[self.field.bound(v, {}) for v in slopes(self.field, row)[: self.half]] for row in self.force]
            for i, row in enumerate(bounds):
                least = row[i][0] - row[i][1] - sum((abs(c) + r for j, (c, r) in enumerate(row) if j != i), fmpq(0))
                consumed[i] += max(-least, fmpq(0))
        spent = diagonal([fmpq(0)] * (len(rates) - self.m) + [c * h / 2 for c in consumed])
        left = plus(self.damps("sampled-stable", rates, self.matrix("sampled-stable")), spent, -1)
        require(is_definite(self.carried(left) if damped else left), "the storage may grow from sample to sample")

    # --- at all settings -------------------------------------------------------------------------------------------

    def proved_adjustable(self) -> None:
        """All settings have an x* that meets the target; near it the loop is stable, sampled too; the inputs fit."""
        witness = self.witness["adjustable"]
        cells = witness["cells"]
        require(self.model.settings and self.rests(), "the settings have other equilibria")
        passed = covered(cells, self.box, lambda kind, part: kind == "." and self.passes(part))
        require(passed, "a cell of settings may fail")
        if self.compensated:
            return self.at([hi for _, hi in self.box]).fit(witness["limits"])
        fits = (shown(witness["trees"][k], self.box, self.room(k), {}) for k in range(len(self.model.limits)))
        return require(all(fits), "an input may leave its limits")

    def refuted_adjustable(self) -> None:
        """At some settings there is no x*, or it leaves the domain, or an input its limits, or the loop is unstable."""
        witness = self.witness["adjustable"]
        values = self.given("adjustable", "at")
        require(all(lo <= v <= hi for v, (lo, hi) in zip(values, self.box, strict=True)), "these may not be set")
        if "steps" in witness:
            other = copy.copy(self)
            other.model = self.model.with_settings(values)
            return other.nowhere(Elimination(self.field, [], other.equations({})), witness)
        require(self.rests(), "the settings have other equilibria")
        other = self.at(values)
        unstable = stable(other.continuous, False) is False or stable(other.sampled, True) is False
        return require(other.misses() or unstable, "nothing certainly fails at these settings")
