"""Equations of LaSalle's set whose Lie derivatives are multiples of others: each is followed once."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension
from pbcgen.control.derive import derive
from pbcgen.passivity import lasalle
from pbcgen.proof.claim import Status


def coupled(damping: str = "0.5") -> Design:
    """Three states with nonlinear storages, the second one without damping of its own."""
    x = [ca.SX.sym(f"x{k}") for k in range(3)]
    S = 1.5 * x[0] ** 2 - ca.cos(x[0]) + x[1] ** 2 / 2 + 2 * (ca.exp(x[2]) - x[2])
    e = ca.gradient(S, ca.vertcat(*x))
    F = ca.blockcat([[-ca.SX(float(damping)), 0, -1], [0, 0, -1], [1, 1, 0]])
    law = DynamicExtension(alpha=5, beta=2, K_c=10, R_c=1)
    return Design(
        AffineSystem(x, [ca.SX.sym("u")], ca.mtimes(F, e), [1, 0, 0], S), {"x0": 0}, law, sample_period="1e-3"
    )


def test_an_equation_is_used_again_only_when_more_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at: list[int] = []
    use = lasalle._Elimination.use
    monkeypatch.setattr(lasalle._Elimination, "use", lambda self, e: looked_at.append(0) or use(self, e))
    claims = {c.claim: c for c in derive(coupled()).claims}
    assert claims["stable"].status is Status.PROVED
    assert len(looked_at) < 60


def test_without_damping_nothing_is_proved_to_attract() -> None:
    claims = {c.claim: c for c in derive(coupled("-0.5")).claims}
    assert claims["assumption-1"].status is Status.REFUTED
    assert claims["globally-asymptotically-stable"].status is not Status.PROVED
