"""Loops with many states: every claim is still decided, and broken ones are not proved."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen import Circuit, Design, DynamicExtension, Limits, Parameters
from pbcgen.pipeline import check
from pbcgen.proof.claim import Status


def ladder(n: int, resistance: str = "1", leakage: str = "0.1", where: int = 0) -> Design:
    """n/2 sections of an RLC ladder; the section ``where`` has its own resistance and leakage."""
    p = Parameters(L="0.01", C="1e-4", r=1, G="0.1")
    own = {"r": float(resistance), "G": float(leakage)}
    k = n // 2
    i_L, v_C = ([ca.SX.sym(f"{name}{j}") for j in range(k)] for name in "iv")
    Gamma = ca.SX(k, k)
    for j in range(k):
        Gamma[j, j] = 1
        if j:
            Gamma[j, j - 1] = -1
    circuit = Circuit(
        i_L,
        v_C,
        L=[p.L] * k,
        C=[p.C] * k,
        Gamma=Gamma,
        v_R=[(own["r"] if j == where else p.r) * i for j, i in enumerate(i_L)],
        i_G=[(own["G"] if j == where else p.G) * v for j, v in enumerate(v_C)],
        g_L=ca.vertcat(-1, ca.SX(k - 1, 1)),
        inputs=["u"],
        parameters=p,
    )
    law = DynamicExtension(alpha=10, beta=1, K_c=1, R_c=1)
    return Design(circuit, target={"v0": "0.001"}, law=law, limits=Limits.symmetric(1000), sample_period="1e-6")


def test_a_ladder_of_sixty_states_is_proved_globally() -> None:
    claims = {c.claim: c for c in check(ladder(60)).claims}
    assert {c.status for c in claims.values()} == {Status.PROVED}
    assert claims["globally-asymptotically-stable"].domain == "all x"
    assert "Lyapunov matrix" in claims["asymptotically-stable"].method
    assert "other sample periods were not examined" in claims["sampled-stable"].evidence


@pytest.mark.system
@pytest.mark.parametrize("broken", [{"resistance": "-5"}, {"leakage": "-0.2"}, {"resistance": "-0.1", "where": 29}])
def test_a_ladder_with_one_negative_resistance_is_not_proved(broken: dict[str, object]) -> None:
    claims = {c.claim: c for c in check(ladder(60, **broken)).claims}  # type: ignore[arg-type]
    assert claims["assumption-1"].status is not Status.PROVED
    assert claims["globally-asymptotically-stable"].status is not Status.PROVED
