"""Bounded inputs do not bring back a mode that grows by itself; where none does, nothing is refuted for it."""

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Integral, Mechanical, PotentialCompensation
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.control.escape import growth_rate
from pbcgen.proof.claim import Status
from pbcgen.verify.claims import examine
from pbcgen.verify.files import digest

LAW = DynamicExtension(alpha=3, beta=2, K_c=20, R_c="0.5")
Q, P, U = ca.SX.sym("q"), ca.SX.sym("p"), ca.SX.sym("u")


def cart(V=Q**2, D=-0.1, law=LAW, target=0):
    return Design(Mechanical([Q], [P], M=[1], V=V, D=[D], G=[1]), {"q": target}, law, sample_period="1e-3")


def first_order(f, g=1, domain=None):
    system = AffineSystem([Q], [U], [f], [g], Q**2 / 2, gamma=[Q], domain=domain or {})
    return Design(system, {"q": 0}, LAW, sample_period="1e-3")


ESCAPE = {
    "an oscillator that is driven": cart(),
    "an integrator and a drive": cart(V=5 * Q),
    "with an integral term": cart(law=Integral(LAW, alpha_psi=1, beta_psi="0.1", R_psi=1)),
    "a pendulum that is driven": cart(V=-ca.cos(Q)),
    "an unstable lag": first_order(Q / 10),
    "an unstable lag with a bounded input gain": first_order(Q / 10, g=1 + ca.sin(Q) / 2),
    "an inverted spring": cart(V=-(Q**2) / 10, D=1),
}


@pytest.mark.parametrize("name", ESCAPE)
def test_a_mode_that_grows_escapes(name):
    derivation = derive(ESCAPE[name])
    claim = next(c for c in derivation.claims if c.claim == "globally-asymptotically-stable")
    assert claim.status is Status.REFUTED
    if "growth" not in claim.counterexample:  # another equilibrium was found first
        assert growth_rate(derivation.situation) is not None
        return
    document = certificate(derivation)
    assert {f.claim: f.outcome for f in examine(document)}[claim.claim] == "checked"
    for rate in ("1e3", "-1"):
        next(c for c in document["claims"] if c["claim"] == claim.claim)["witness"]["growth"] = rate
        document["digest"] = digest(document)
        assert {f.claim: f.outcome for f in examine(document)}[claim.claim] != "checked"


STAY = {
    "friction": cart(D=0.1),
    "no friction": cart(D=0),
    "an integrator": cart(V=0 * Q, D=0),
    "drag at speed": cart(D=-0.1 + P**2),
    "a stiffening spring": cart(V=Q**4 - Q**2 / 10, D=0.1),
    "a force that is compensated": cart(D=-0.1, law=PotentialCompensation(3, 2, 20, "0.5")),
    "a flow that stops it": first_order(Q / 10 - Q**3),
    "an input that grows with the state": first_order(Q / 10, g=1 + Q**2),
    "a domain": first_order(Q / 10, domain={"q": (-1, 1)}),
    "a bounded drive": first_order(ca.tanh(Q) - Q),
    "a slow decay": first_order(-Q / 10**6),
    "a drive that fades": first_order(Q * ca.exp(-(Q**2)) - Q / 100),
}


@pytest.mark.parametrize("name", STAY)
def test_nothing_else_does(name):
    situation = derive(STAY[name]).situation
    assert situation is None or growth_rate(situation) is None
