"""Motions that the controller does not see refute the sampled loop too; what it may see, the spectrum decides."""

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Integral, Mechanical, PotentialCompensation
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.proof.claim import Status
from pbcgen.verify.claims import examine
from pbcgen.verify.files import digest

LAW = DynamicExtension(alpha=3, beta=2, K_c=20, R_c="0.5")
Q, P = ([ca.SX.sym(f"{letter}{k}") for k in (1, 2, 3)] for letter in "qp")


def carts(stiff=(1, 1), masses=(1, 1, 1), D=(0, 0, 0), law=LAW, far=0, G=(0, 1, 0)):
    """Three carts; the one in the middle is driven and held by a spring."""
    V = stiff[0] * (Q[0] - Q[1]) ** 2 + stiff[1] * (Q[2] - Q[1]) ** 2 + Q[1] ** 2 / 2 + far * Q[0] ** 2
    system = Mechanical(Q, P, M=list(masses), V=V, D=list(D), G=[[g] for g in G])
    return Design(system, dict.fromkeys(("q1", "q2", "q3"), 0), law, sample_period="1e-3")


def _claims(design):
    derivation = derive(design)
    return derivation, {c.claim: c for c in derivation.claims}


UNSEEN = {
    "symmetric": carts(),
    "with friction where it is driven": carts(D=(0, 1, 0)),
    "with an integral term": carts(law=Integral(LAW, alpha_psi=1, beta_psi="0.3", R_psi=1)),
    "late": carts().with_(delay="0.5"),
    "uneven": carts().with_(jitter="0.05"),
}


@pytest.mark.parametrize("name", UNSEEN)
def test_what_the_sensors_do_not_see_is_not_damped_by_sampling(name):
    derivation, claims = _claims(UNSEEN[name])
    assert claims["asymptotically-stable"].status is Status.REFUTED
    assert claims["sampled-stable"].status is Status.REFUTED
    document = certificate(derivation)
    assert {f.claim: f.outcome for f in examine(document)}["sampled-stable"] == "checked"
    for entry in document["claims"]:  # the sampled verdict rests on the other one
        if entry["claim"] == "asymptotically-stable":
            entry["status"] = "UNDECIDED"
    document["digest"] = digest(document)
    assert {f.claim: f.outcome for f in examine(document)}["sampled-stable"] != "checked"


SEEN = {
    "unequal springs": carts(stiff=(1, 1.001)),
    "unequal masses": carts(masses=(1, 1, 1.001)),
    "friction on the outer carts": carts(D=(1, 0, 1)),
    "friction on one cart": carts(D=(1, 0, 0)),
    "a spring to the wall": carts(far=0.01),
    "driven at the end": carts(G=(1, 0, 0)),
    "driven at two": carts(G=(1, 1, 0)),
    "driven at all, unevenly": carts(G=(1, 1, 2)),
    "a little friction": carts(D=(1e-6, 0, 0)),
    "unequal in both": carts(stiff=(1, 2), masses=(1, 1, 2.001)),
}


@pytest.mark.parametrize("name", SEEN)
def test_what_they_see_is_judged_by_the_sampled_loop(name):
    _, claims = _claims(SEEN[name])
    assert claims["asymptotically-stable"].status is not Status.REFUTED
    sampled = claims["sampled-stable"]
    assert sampled.status is not Status.REFUTED or "spectral_radius" in sampled.counterexample


def test_a_conserved_charge_is_conserved_by_a_held_input():
    x = [ca.SX.sym(name) for name in ("a", "b")]
    system = AffineSystem(x, [ca.SX.sym("u")], [x[1] - x[0], x[0] - x[1]], [1, -1], (x[0] - x[1]) ** 2 / 2)
    _, claims = _claims(Design(system, {"a": 1, "b": 1}, DynamicExtension(1, 1, 1, 1), sample_period="1e-2"))
    assert claims["asymptotically-stable"].status is claims["sampled-stable"].status is Status.REFUTED


def test_a_compensated_force_changes_between_the_samples():
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[1], V=1 - ca.cos(q), G=[1])
    law = PotentialCompensation(3, 2, 20, "0.5")
    _, claims = _claims(Design(system, {"q": 1}, law, sample_period="1e-3"))
    assert claims["asymptotically-stable"].status is Status.PROVED
    sampled = claims["sampled-stable"]
    assert sampled.status is not Status.REFUTED or "spectral_radius" in sampled.counterexample
