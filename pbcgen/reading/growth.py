"""Storages of global claims: radially unbounded ones, and quadratic forms beside the integrals of saturations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pbcgen.reading.settings import Family
from pbcgen.symbolic.plain.elimination import put_in, slopes
from pbcgen.symbolic.plain.formulas import combination
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, dot, is_definite, plus, product, symmetric
from pbcgen.symbolic.plain.outcomes import require
from pbcgen.symbolic.plain.values import Field, sign

GLOBAL = "globally-asymptotically-stable"


class Growth(Family):
    """What a global claim rests on beside the invariant set, or without a passive output."""

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

    def in_sectors(self) -> None:
        """``V = zeta^T P zeta / 2 + sum lambda_i int phi_i dz_i + sum mu_i (cosh(beta psi_i) - 1) / beta^2`` decreases.

        zeta is (x - x*, x_c); phi and theta are the saturated terms of ``z = gamma - gamma* + x_c`` and of psi. It
        suffices that -V', less tau_i times ``phi_i (z_i - phi_i / (alpha beta)_i) >= 0``, is a positive definite form
        of (zeta, phi, theta). To V', mu_i adds ``theta_i (gamma - gamma*)_i - r psi_i sinh(beta psi_i) / beta``, where
        the last term is at least ``r theta_i^2 / (alpha beta)^2``.
        """
        m, k, gains, P = self.m, self.n + self.m, self.model.gains, self.storage(GLOBAL) or []
        popov, sectors, integral = (self.given(GLOBAL, name) for name in ("popov", "sectors", "integral"))
        require("dynamic-extension" in self.law and not self.model.domain, "this is for another law, or on a domain")
        require(is_definite(P) and min([*popov, *sectors, *integral]) >= 0, "V may be negative, or a sector left")
        field = Field(k + m + len(integral), self.field.pool, self.field.units)
        zeta, phi, theta = field.symbols[:k], field.symbols[k : k + m], field.symbols[k + m :]
        found = self.walk([a + b for a, b in zip(self.point[0], zeta, strict=False)], field.lift, aim=False)
        away = [v - c for (v,), (c,) in zip(found["gamma"], self.numbers("gamma"), strict=True)]
        z = [field.lift(a + b) for a, b in zip(away, zeta[self.n :], strict=True)]
        held = [a + b for a, b in zip(phi, theta, strict=True)] if "integral" in self.law else phi
        rates = self.misfits(found, [u - v for u, v in zip(self.point[1], held, strict=True)], {})
        leaving = plus([[v] for v in phi], product(gains["K_c"], [[v] for v in zeta[self.n :]]))
        rates += [-v for (v,) in product(gains["R_c"], leaving)]
        rise = dot(zeta, [dot(row, rates) for row in P])
        for i, (p, t) in enumerate(zip(popov, sectors, strict=True)):
            slack = z[i] - phi[i] / self.stiffness[i][i]
            rise = rise + phi[i] * (dot(slopes(field, z[i])[:k], rates) * p + slack * t)
        for i, mu in enumerate(integral):
            leak = gains["R_psi"][i][i] / (gains["alpha_psi"][0][i] * gains["beta_psi"][0][i]) ** 2
            rise = rise + theta[i] * (away[i] - theta[i] * leak) * mu
        require(not integral or gains["R_psi"] == diagonal([gains["R_psi"][i][i] for i in range(m)]), "filters mix")
        form = [[v.number() for v in slopes(field, row)] for row in slopes(field, -rise)]
        require(all(None not in row for row in form) and is_definite(form), "V may not decrease")
        require(field.entire(), "the model may not be smooth everywhere")
