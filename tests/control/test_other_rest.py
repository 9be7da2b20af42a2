"""Equilibria of the closed loop besides x*: found for arms of many links, at rest, and only where there are any."""

from __future__ import annotations

import copy

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Integral, Mechanical
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.control.other_rest import other_rest
from pbcgen.proof.claim import Status
from pbcgen.symbolic.plain.formulas import rational
from pbcgen.symbolic.real import approximate
from pbcgen.verify.claims import examine
from pbcgen.verify.files import digest


def pendulums(links: int, stiffness: float) -> Design:
    """Masses on a chain of light rods, hanging, with a spring and a motor in each joint."""
    q, p = ca.SX.sym("q", links), ca.SX.sym("p", links)
    V = -3 * sum((ca.cos(q[k]) for k in range(links)), ca.SX(0)) + stiffness * ca.dot(q, q) / 2
    M = ca.SX.eye(links) * 2
    for k in range(links - 1):
        M[k, k + 1] = M[k + 1, k] = ca.cos(q[k] - q[k + 1]) / 2
    system = Mechanical(q, p, M=M, V=V, G=ca.SX.eye(links), D=[1] * links)
    law = DynamicExtension(alpha=[1] * links, beta=1, K_c=1, R_c=1)
    return Design(system, {f"q_{k}": 0 for k in range(links)}, law, sample_period="1e-3")


@pytest.mark.parametrize("links", [2, 7])
def test_a_turned_link_is_another_equilibrium_and_its_momenta_are_zero(links: int) -> None:
    situation = derive(pendulums(links, 0.1)).situation
    assert situation is not None
    found = other_rest(situation)
    assert found is not None
    assert found[links:] == [0] * links
    q, at = situation.plant.system.x[:links], [approximate(v) for v in found[:links]]
    torque = ca.Function("torque", [q], [3 * ca.sin(q) + 0.1 * q])(at)
    assert abs(float(ca.norm_inf(torque))) < 1  # what motors with alpha = 1 can hold
    assert max(map(abs, at)) > 1


def test_none_is_found_where_springs_outweigh_gravity() -> None:
    situation = derive(pendulums(3, 10.0)).situation
    assert situation is not None
    assert other_rest(situation) is None


def test_a_system_with_one_state_has_no_momenta() -> None:
    x = ca.SX.sym("x")
    system = AffineSystem([x], [ca.SX.sym("u")], [-ca.sin(x)], [1], 1 - ca.cos(x))
    law = DynamicExtension(alpha="0.1", beta=1, K_c=1, R_c=1)
    situation = derive(Design(system, {"x": 0}, law, sample_period="1e-3")).situation
    assert situation is not None
    found = other_rest(situation)
    assert found is not None
    assert abs(approximate(found[0])) > 1


def _integral_pendulum(alpha, alpha_psi, leak, friction=1):
    """A pendulum of weight 2 held at 1 rad, with an integral term."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[1], V=-2 * ca.cos(q), D=[friction], G=[1])
    law = Integral(DynamicExtension(alpha, 2, 3, 1), alpha_psi=alpha_psi, beta_psi="0.3", R_psi=leak)
    return Design(system, {"q": 1}, law, sample_period="1e-3")


@pytest.mark.parametrize(
    ("alpha", "alpha_psi", "leak", "another"),
    [
        (1, "0.5", 1, True),  # at most 1.5 beside u* = 1.68: not enough to hold the weight on its way round
        (1, "0.5", "0.1", True),
        (1, "2.5", "0.1", True),
        (1, "0.5", 0, False),  # without leak the filter rests at gamma = gamma* only
        ("3.4", "0.5", 1, True),  # 2 + 1.68 < 3.4 + 0.5, but the filter has leaked
        ("3.7", "0.5", 1, False),  # 2 + 1.68 < 3.7
        (4, "0.1", 1, False),
    ],
)
def test_an_integral_term_rests_elsewhere_where_it_leaks(alpha, alpha_psi, leak, another):
    derivation = derive(_integral_pendulum(alpha, alpha_psi, leak))
    claim = next(c for c in derivation.claims if c.claim == "globally-asymptotically-stable")
    assert (claim.status is Status.REFUTED) == another
    document = certificate(derivation)
    assert {f.claim: f.outcome for f in examine(document)}[claim.claim] == ("checked" if another else "open")
    if not another:
        return
    assert derivation.situation is not None
    q, _, psi = (approximate(v) for v in other_rest(derivation.situation))
    w = 2 * np.sin(q) - 2 * np.sin(1) + float(alpha_psi) * np.tanh(0.3 * psi)  # what x_c holds
    assert abs(w + float(alpha) * np.tanh(2 * (q - 1 + w / 3))) < 1e-9
    assert abs(float(leak) * psi - float(alpha_psi) * 0.3 * (q - 1) / np.cosh(0.3 * psi)) < 1e-9
    witness = next(c["witness"] for c in document["claims"] if c["claim"] == claim.claim)
    for k in range(len(witness["centre"])):
        forged = copy.deepcopy(document)
        centre = next(c["witness"] for c in forged["claims"] if c["claim"] == claim.claim)["centre"]
        centre[k] = f"{float(rational(centre[k])) + 0.01:.12g}"
        forged["digest"] = digest(forged)
        assert {f.claim: f.outcome for f in examine(forged)}[claim.claim] == "fails"


def _well(V, alpha=1):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    return Design(
        Mechanical([q], [p], M=[1], V=V(q), D=[1], G=[1]),
        {"q": 0},
        DynamicExtension(alpha, 1, 1, 1),
        sample_period="1e-2",
    )


@pytest.mark.parametrize(
    "V",
    [
        lambda q: q**2 / 2 - 40 * ca.exp(-200 * (q - 20) ** 2),
        lambda q: q**2 / 2 - 400 / (1 + 400 * (q + 13) ** 2),
        lambda q: q**2 - 9000 / (9 + 5000 * (q - 57) ** 2),
        lambda q: q**4 / 4 - 90 * ca.exp(-2000 * (q - 3) ** 2),
    ],
)
def test_a_narrow_well_far_away_is_found(V):
    claims = {c.claim: c for c in derive(_well(V)).claims}
    claim = claims["globally-asymptotically-stable"]
    assert claim.status == "REFUTED"
    assert abs(float(claim.counterexample["x"]["q"])) > 2


def test_wells_too_shallow_to_rest_in_do_not_refute():
    def dent(q):
        return q**2 / 2 - ca.exp(-4 * (q - 9) ** 2)

    assert (
        next(c for c in derive(_well(dent)).claims if c.claim == "globally-asymptotically-stable").status != "REFUTED"
    )
