"""Loops with many states: every claim is still decided, and broken ones are not proved."""

from __future__ import annotations

import tracemalloc
from fractions import Fraction
from itertools import pairwise
from typing import Any

import casadi as ca
import pytest

from pbcgen import Circuit, Design, DynamicExtension, Limits, Mechanical, Parameters
from pbcgen.control.derive import derive
from pbcgen.control.situation import Situation
from pbcgen.law.closed_loop import until_settled
from pbcgen.pipeline import check
from pbcgen.proof.claim import Status
from pbcgen.proof.spectrum import schur
from pbcgen.sampling import linearisation
from pbcgen.sampling.gain_change import scaled
from pbcgen.sampling.linearisation import examine, spectral


def ladder(
    n: int, resistance: str = "1", leakage: str = "0.1", where: int = 0, sample_period: str = "1e-6", **more: Any
) -> Design:
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
        **more,
    )
    law = DynamicExtension(alpha=10, beta=1, K_c=1, R_c=1)
    return Design(circuit, target={"v0": "0.001"}, law=law, limits=Limits.symmetric(1000), sample_period=sample_period)


def was_linearised(situation: Situation | None) -> bool:
    assert situation is not None
    return "loop" in vars(situation) or "family" in vars(situation)


def test_a_ladder_of_sixty_states_is_proved_globally_without_being_linearised() -> None:
    found = derive(ladder(60))
    claims = {c.claim: c for c in found.claims}
    assert {c.status for c in claims.values()} == {Status.PROVED}
    assert claims["globally-asymptotically-stable"].domain == "all x"
    assert claims["sampled-stable"].domain == "sampled loop, all x"
    assert not was_linearised(found.situation)
    assert found.derived["spectral_abscissa"] is None
    assert found.situation is not None
    linear = found.situation.linearised
    assert linear.status is Status.PROVED
    assert linear.lyapunov is not None
    assert found.loop is not None
    assert found.loop.duration == until_settled(linear.extreme, found.design.sample_period)


def test_a_large_ladder_on_a_domain_is_proved_locally_without_being_linearised() -> None:
    found = derive(ladder(60, domain={"i0": (-1, 1)}))
    claims = {c.claim: c for c in found.claims}
    assert claims["asymptotically-stable"].status is Status.PROVED
    assert "isolated" in claims["asymptotically-stable"].evidence
    assert claims["globally-asymptotically-stable"].status is Status.UNDECIDED
    assert claims["sampled-stable"].domain == "sampled loop"
    assert not was_linearised(found.situation)


@pytest.mark.system
def test_a_large_ladder_that_is_sampled_too_slowly_is_refuted_by_its_linearisation() -> None:
    found = derive(ladder(60).with_(sample_period="1e-4"))
    claims = {c.claim: c for c in found.claims}
    assert claims["asymptotically-stable"].status is Status.PROVED
    assert claims["sampled-stable"].status is Status.REFUTED
    assert claims["sampled-stable"].counterexample


def peak(n: int) -> int:
    """The most memory that Python's objects take while a ladder is derived, bytes."""
    design = ladder(n)
    tracemalloc.start()
    try:
        derive(design)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.system
def test_memory_grows_with_the_nonzeros_not_with_the_square_of_the_states() -> None:
    derive(ladder(60))  # loads what large loops need
    assert peak(200) < 3 * peak(100)  # dense rows of functions or numbers would make it four


@pytest.mark.system
@pytest.mark.parametrize("broken", [{"resistance": "-5"}, {"leakage": "-0.2"}, {"resistance": "-0.1", "where": 29}])
def test_a_ladder_with_one_negative_resistance_is_not_proved(broken: dict[str, object]) -> None:
    claims = {c.claim: c for c in check(ladder(60, **broken)).claims}  # type: ignore[arg-type]
    assert claims["assumption-1"].status is not Status.PROVED
    assert claims["globally-asymptotically-stable"].status is not Status.PROVED


def chain(n: int, sample_period: str) -> Design:
    """n masses on springs in a row, weakly damped, the first one on a wall and driven."""
    q, p = ([ca.SX.sym(f"{name}{j}") for j in range(n)] for name in "qp")
    V = sum(10 * (a - b) ** 2 for a, b in pairwise(q)) + 5 * q[0] ** 2
    model = Mechanical(q=q, p=p, M=[1] * n, V=V, D=[0.01] * n, G=[1] + [0] * (n - 1), measured=["q0"])
    law = DynamicExtension(alpha=5, beta=30, K_c=40, R_c="0.3")
    return Design(model, {"q0": "0.5"}, law, sample_period=sample_period)


@pytest.mark.system
@pytest.mark.parametrize("delay", [0, 1])
def test_a_refusal_of_a_large_loop_names_a_proved_period_and_gain_change(delay: int) -> None:
    design = chain(13, "0.1")
    found = derive(design.with_(delay=delay))
    assert found.situation is not None
    loop, family = found.situation.loop, found.situation.family
    claim = {c.claim: c for c in found.claims}["sampled-stable"]
    assert claim.status is Status.REFUTED
    period = Fraction(claim.hint.split("sample at h = ")[1].split(" s")[0])
    assert spectral(loop, period, Fraction(delay)).status is Status.PROVED
    assert spectral(loop, period * Fraction(103, 100), Fraction(delay)).status is Status.REFUTED
    assert found.derived["max_sample_period"] is None  # a window of stability may lie below
    change = Fraction(claim.hint.split("alpha*beta by ")[1].split(",")[0])
    law = scaled(found.situation.law, {"alpha*beta": change})
    assert spectral(family.loop(law), design.sample_period, Fraction(delay)).status is Status.PROVED


def test_a_large_loop_that_is_sampled_far_too_slowly_is_refused_with_few_proofs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked_at = []
    monkeypatch.setattr(linearisation, "schur", lambda M: looked_at.append(len(M)) or schur(M))
    found = derive(ladder(40, sample_period="0.1"))
    claim = {c.claim: c for c in found.claims}["sampled-stable"]
    assert claim.status is Status.REFUTED
    assert found.situation is not None
    period = Fraction(claim.hint.split("sample at h = ")[1].split(" s")[0])
    assert spectral(found.situation.loop, period).status is Status.PROVED
    assert len(looked_at) <= 4


@pytest.mark.system
def test_no_period_of_an_unstable_loop_is_proved() -> None:
    found = derive(ladder(30, resistance="-5", where=1))
    assert found.situation is not None
    loop, h = found.situation.loop, Fraction(1, 1000)
    singles = examine(loop, h, Fraction(1), spectral(loop, h))
    assert singles.stable is None
    claim = {c.claim: c for c in found.claims}["sampled-stable"]
    assert claim.status is not Status.PROVED
    assert found.derived["max_sample_period"] is None
