"""Loops with functions of one argument each that lie in sectors: a second way to show that x* attracts from all x."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from flint import fmpq, fmpq_mat, fmpq_mpoly

from pbcgen.reading.settings import Family
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, dot, is_definite, plus, product
from pbcgen.symbolic.plain.outcomes import NotCheckable, require
from pbcgen.symbolic.plain.values import Field

#: The least slope of functions on the whole line, and the inverse of the largest, which is zero where there is none.
_SLOPES = {"tanh": (0, 1), "atan": (0, 1), "asinh": (0, 1), "exp": (0, 0), "sin": (-1, 1), "cos": (-1, 1)}

#: z, a and 1/b: phi is between ``a z`` and ``b z`` and is neither, unless z = 0.
Sector = tuple[fmpq_mpoly, fmpq, fmpq]


@dataclass(frozen=True)
class SectorLoop:
    """The loop ``zeta' = F(zeta, phi, theta)`` in deviations from x*, as polynomials.

    Attributes:
        ring: its generators.
        variables: the places of (zeta, phi, theta) among them; zeta are the states of plant and filters but psi.
        rates: zeta'.
        sectors: of phi.
        outputs: gamma - gamma* where there are ``theta = alpha tanh(beta psi)``, else nothing.
        leaks: ``r / (alpha beta)^2`` of each of these.
    """

    ring: Sequence[fmpq_mpoly]
    variables: list[int]
    rates: list[fmpq_mpoly]
    sectors: list[Sector]
    outputs: list[fmpq_mpoly]
    leaks: list[fmpq]

    def row(self, linear: fmpq_mpoly) -> list[fmpq]:
        """The coefficients of a linear function."""
        return [linear.derivative(k).leading_coefficient() for k in self.variables]


class _Deviations:
    """Functions less their values at x*, as polynomials in which an atom stands for its own deviation.

    ``centre`` is x*, and zero for what vanishes there, by symbols; None for what is not exact.
    """

    def __init__(self, field: Field, centre: Sequence[fmpq | None]) -> None:
        self.field, self.centre = field, [None] * field.pool + [*centre]
        self.atoms = {field.pool - 1 - i: (key[0], a) for i, (key, a) in enumerate(field.atoms.items())}
        moving = (g * (k not in self.atoms or bool(self.atoms[k][1].used)) for k, g in enumerate(field.generators))
        self.places = [g + (c or 0) for g, c in zip(moving, self.centre, strict=True)]

    def of(self, value: Any) -> fmpq_mpoly:
        """A polynomial, where terms of higher degree need an exact x* and do not hold atoms, less its value there."""
        a = self.field.lift(value)
        bent = (e for e in a.top.to_dict() if sum(map(int, e)) > 1)
        exact = all(c is not None for e in bent for c, d in zip(self.centre, e, strict=True) if d)
        require(exact and a.bottom.is_constant(), "a term is no polynomial, and no function that stands alone")
        moved = a.top.compose(*self.places)
        return moved - moved[(0,) * len(self.places)]

    def linear(self, value: Any) -> fmpq_mpoly:
        """The same of an affine function."""
        moved = self.of(value)
        require(moved.total_degree() < 2 and not any(moved.degrees()[: self.field.pool]), "a function is not affine")
        return moved

    def sector(self, k: int) -> Sector:
        """Of the atom T(s + z) - T(s): a slope of T times z, by the mean value theorem; T is affine nowhere."""
        kind, argument = self.atoms[k]
        require(kind in _SLOPES, f"the slopes of {kind} are not known", NotCheckable)
        least, soft = _SLOPES[kind]
        return self.linear(argument), fmpq(least), fmpq(soft)


class Sectors(Family):
    """Storages that fall whatever is in the sectors."""

    @cached_property
    def sector_loop(self) -> SectorLoop:
        """The loop of the laws `dynamic-extension` and `natural-damping`, with `integral` or without.

        phi are the saturations of ``gamma~ + x_c`` and of ``Upsilon eta~ + K_l x_l``, then the functions in f.
        """
        n, m, gains, natural = self.n, self.m, self.model.gains, "natural-damping" in self.law
        require(natural or "dynamic-extension" in self.law, "this is for another law")
        kinds, integral = 1 + natural, "integral" in self.law
        field = Field(n + (2 * kinds + integral) * m, self.field.pool, self.field.units)
        found = self.walk(field.symbols[:n], field.lift, wanted="(f|g|gamma|measurement" + "|eta" * natural + ")$")
        columns = [[[v] for v in field.symbols[k : k + m]] for k in range(n, len(field.symbols), m)]
        (x_c, *x_l), held = columns[:kinds], columns[kinds:]
        star, push = ([v if isinstance(v, fmpq) else None for v in part] for part in self.point)
        still = [None if u is None else fmpq(0) for u in push] * len(held)
        away = _Deviations(field, [*star, *[fmpq(0)] * (kinds * m), *still])
        inputs = [sum((-v for (v,) in row), field.lift(u or 0)) for u, *row in zip(push, *held, strict=True)]
        rates = self.misfits(found, inputs, {})
        rates += [-v for (v,) in product(gains["R_c"], plus(held[0], product(gains["K_c"], x_c)))]
        z = plus(found["gamma"], x_c)
        if natural:
            z += plus(product(self.upsilon(len(found["eta"])), found["eta"]), product(gains["K_l"], x_l[0]))
            rates += [-v for (v,) in product(gains["R_l"], held[1])]
        moved = [away.of(v) for v in rates]
        *sizes, psi = [[self.model.vector(f"{s}{k}") for s in ("alpha", "beta")] for k in (*("", "_l")[:kinds], "_psi")]
        soft = [1 / (a * b) for pair in sizes for a, b in zip(*pair, strict=True)]
        sectors = [(away.linear(v), fmpq(0), s) for (v,), s in zip(z, soft, strict=True)]
        inside = [k for k in away.atoms if any(rate.degrees()[k] for rate in moved)]
        sectors += [away.sector(k) for k in inside]
        theta = field.pool + n + 2 * kinds * m
        variables = [*range(field.pool, theta), *inside, *range(theta, len(field.generators))]
        R = gains["R_psi"] if integral else []
        leaks = [row[i] / (a * b) ** 2 for i, (row, a, b) in enumerate(zip(R, *psi, strict=integral))]
        require(diagonal([row[i] for i, row in enumerate(R)]) == R, "filters mix")
        require(field.entire(), "the model may not be smooth everywhere", NotCheckable)
        outputs = [away.linear(v) for (v,) in found["gamma"]][: len(R)]
        return SectorLoop(field.generators, variables, moved, sectors, outputs, leaks)

    def in_sectors(self, claim: str) -> None:
        """``V = zeta^T P zeta / 2 + sum lambda_i int phi_i dz_i + sum mu_i (cosh(beta psi_i) - 1) / beta^2`` decreases.

        -V' is a form Q of (zeta, phi, theta), and ``tau_i (phi_i - a_i z_i) (z_i - phi_i / b_i)`` and ``mu_i r (psi_i
        sinh(beta psi_i) / beta - theta_i^2 / (alpha beta)^2)``, which are never negative. Where Q vanishes, so must phi
        and theta, and zeta where in addition the z_i with a_i = 0 do, as phi_i vanishes with them only. V is radially
        unbounded: where P takes no notice of zeta, the z_i with lambda_i > 0 do, and the integral of a function that
        increases and is zero at zero grows at least in proportion.
        """
        loop, P = self.sector_loop, self.storage(claim) or []
        popov, sectors, integral = (self.given(claim, name) for name in ("popov", "sectors", "integral"))
        require(not self.model.domain and min([*popov, *sectors, *integral]) >= 0, "a weight, or the domain, is wrong")
        k, ring = len(loop.rates), [loop.ring[i] for i in loop.variables]
        phi, theta = ring[k : k + len(popov)], ring[k + len(popov) :]
        rise = dot(ring[:k], [dot(row, loop.rates) for row in P])
        for v, p, t, (z, a, soft) in zip(phi, popov, sectors, loop.sectors, strict=True):
            require(a == 0 or p == 0, "an integral may be negative")
            rise += v * dot(loop.row(z)[:k], loop.rates) * p + (v - z * a) * (z - v * soft) * t
        for v, mu, y, leak in zip(theta, integral, loop.outputs, loop.leaks, strict=True):
            rise += v * (y - v * leak) * mu
        slopes = [[-rise.derivative(i).derivative(j) for j in loop.variables] for i in loop.variables]
        require(all(v.is_constant() for row in slopes for v in row), "terms of V' are left")
        Q, units = [[v.leading_coefficient() for v in row] for row in slopes], diagonal([fmpq(1)] * len(ring))
        grows = [loop.row(z)[:k] for (z, _, _), p in zip(loop.sectors, popov, strict=True) if p > 0]
        seen = [loop.row(z) for z, a, _ in loop.sectors if a == 0]
        require(is_definite(P, semi=True) and _rank(P + grows) == k, "V may not grow")
        vanish = _rank(Q + units[k:]) == _rank(Q) and _rank(Q + seen) == len(ring)
        require(is_definite(Q, semi=True) and vanish, "V may not decrease")


def _rank(rows: Matrix) -> int:
    return int(fmpq_mat(rows).rank())
