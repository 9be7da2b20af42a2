"""Storages that are radially unbounded, and that have one critical point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from flint import fmpq, fmpq_mat

from pbcgen.reading.settings import Family
from pbcgen.reading.system import require
from pbcgen.symbolic.plain.elimination import Elimination, put_in, slopes
from pbcgen.symbolic.plain.formulas import rational
from pbcgen.symbolic.plain.growth import spans
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, dot, is_definite, plus, product, transpose
from pbcgen.symbolic.plain.values import sign

GLOBAL = "globally-asymptotically-stable"


class Growth(Family):
    """What a global claim rests on beside the invariant set."""

    def convex_part(self, chain: Elimination, places: Sequence[Sequence[int | None]]) -> Matrix:
        """The Hessian of S in the states that are not at their values of x* at every rest.

        There ``grad S - grad gamma u = N (f + g u) = 0``. Where S is convex and gamma affine, a rest with u = u* + w
        would have ``w^T (gamma - gamma*) >= 0``, and (rest) has the other sign unless w = 0.
        """
        N, S = [self.vector(row) for row in places], self.column("S")[0]
        balance = plus(transpose(self.slope("S")), product(N, self.functions("f")), -1)
        follows = plus(transpose(self.slope("gamma")), product(N, self.functions("g")))
        require(not self.compensated and not self.inertia, "the storage is not the Lyapunov function's")
        self.zero([v for row in (*balance, *follows) for v in row], "grad S does not vanish at rest")
        require(all(v.number() is not None for row in self.slope("gamma") for v in row), "gamma is not affine")
        fixed = {k: v for k, v in chain.solved.items() if k < self.n and v.number() == self.point[0][k]}
        S = self.field.lift(put_in(self.field, S, [fixed.get(k, v) for k, v in enumerate(self.field.symbols)]))
        free = [k for k in range(self.n) if k not in fixed]
        return [[slopes(self.field, slopes(self.field, S)[i])[j] for j in free] for i in free]

    def grows(self, witness: Any) -> None:
        """The Lyapunov function is radially unbounded.

        The storage is ``sum s_i t_i^2 + sum lambda_j gamma_j``, squares, and bounded terms. Each t_i, and each gamma_j
        whose ln cosh outgrows ``lambda_j - u_j*``, is a coordinate: it gives one more state in terms of the earlier.
        """
        V = self.potential(self.field.symbols[: self.half], self.field.lift) if self.compensated else 0
        rest, gamma, one = self.column("S")[0] - V, self.column("gamma"), self.field.lift(1)
        linear = self.given(GLOBAL, "linear")
        force = [a if self.compensated else a - u for a, u in zip(linear, self.point[1], strict=True)]
        outgrown = [sign(a - abs(v)) == 1 for a, v in zip(self.model.vector("alpha"), force, strict=True)]
        found = witness["coordinates"]
        coordinates = [(one, gamma[i], k) if w is None else (self.placed[w], self.placed[i], k) for w, i, k in found]
        require(spans(self.field, self.n, coordinates), "these are no coordinates")
        require(all(outgrown[i] for w, i, _ in found if w is None), "ln cosh does not outgrow the linear terms")
        for (w, _, _), (s, t, _) in zip(found, coordinates, strict=True):
            rest = rest if w is None else rest - s * t * t
        steady = {place for w, place, _ in found if w is not None and self.placed[w].number()}
        for j, row in enumerate(witness["rows"]):  # gamma_j is affine in these coordinates, or ln cosh outgrows it
            rest = rest - gamma[j] * linear[j]
            affine = gamma[j] - sum((self.placed[int(p)] * rational(c) for p, c in row.items()), fmpq(0))
            slow = steady >= {int(p) for p in row} and self.field.lift(affine).number() is not None
            require(outgrown[j] or slow, "gamma may outgrow the storage")
        require(
            self.field.bounded(self.without_squares([[self.field.lift(rest)]], GLOBAL, "excess")[0][0]), "more grows"
        )

    def by_currents(self, witness: Mapping[str, Any]) -> Matrix:
        """``d gamma / d u + K_c^-1`` over the rests, its symmetric part; the Lyapunov function is radially unbounded.

        ``S = w^T Xi w / 2`` plus bounded terms and ``gamma = R w + r`` with w(x), Xi > 0. For signs T and c > 0 the
        Jacobian has ``sym(T w_x) >= c I``: w grows with x and fixes it. At rest ``w = N f = -N g u`` with N g constant.
        """
        self.in_states()
        w, N = self.vector(witness["w"]), [self.vector(row) for row in witness["N"]]
        Xi, R = ([[rational(v) for v in row] for row in witness[name]] for name in ("Xi", "R"))
        S, size = self.column("S")[0] - dot(w, [dot(row, w) for row in Xi]) / 2, range(self.n)
        require(not self.compensated and is_definite(Xi), "the storage is not a form in the currents")
        require(self.field.bounded(self.field.lift(S)), "the storage is not a form in the currents")
        others = [a - dot(row, w) for a, row in zip(self.column("gamma"), R, strict=True)]
        require(all(self.field.lift(v).number() is not None for v in others), "gamma is not affine in the currents")
        signed = [
            [v * int(s) for v in slopes(self.field, a)[: self.n]] for a, s in zip(w, witness["signs"], strict=True)
        ]
        sums = [[(signed[i][j] + signed[j][i]) / 2 for j in size] for i in size]
        least = rational(witness["least"])
        require(least > 0 and {*witness["signs"]} <= {1, -1}, "nothing grows")
        self.nonnegative(plus(sums, diagonal([least] * self.n), -1), GLOBAL)
        self.zero([a - dot(row, self.column("f")) for a, row in zip(w, N, strict=True)], "the currents do not rest")
        G = [[self.field.lift(v).number() for v in row] for row in product(N, self.functions("g"))]
        require(all(v is not None for row in G for v in row), "the currents at rest are not linear in the input")
        slope = product(R, G)
        soft = [
            [(a + b) / -2 for a, b in zip(*rows, strict=True)] for rows in zip(slope, transpose(slope), strict=True)
        ]
        K_c = self.model.gains.get("K_c")
        return soft if K_c is None else plus(soft, fmpq_mat(K_c).inv().tolist())
