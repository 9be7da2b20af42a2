"""Loops whose saturations are in sectors: a quadratic form and their integrals make a Lyapunov function."""

from __future__ import annotations

from pbcgen.reading.growth import GLOBAL, Growth
from pbcgen.symbolic.plain.elimination import slopes
from pbcgen.symbolic.plain.matrices import diagonal, dot, is_definite, plus, product
from pbcgen.symbolic.plain.outcomes import require
from pbcgen.symbolic.plain.values import Field


class Sectors(Growth):
    """What is global without a passive output."""

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
