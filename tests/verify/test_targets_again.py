"""Targets: what is said of them, and what the checker says of that."""

import json
from fractions import Fraction

import casadi as ca
import pytest
from certificates import outcomes as outcomes_of
from certificates import signed

from pbcgen import Design, DynamicExtension, Mechanical, Parameters
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import lower

pytestmark = pytest.mark.system

LAW = DynamicExtension(alpha=20, beta=2, K_c=10, R_c=1)


def spring(target, V=ca.cosh):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical(q=[q], p=[p], M=[1], V=V(q), D=[1], G=[1], measured=["q"])
    return Design(system, target(q) if callable(target) else target, LAW, sample_period="1e-3", name="spring")


def tower(target, **keywords):
    """Two masses on springs that stiffen; at rest q1 = q2 + cosh(q2) / 2."""
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    p = Parameters(k=4, a=2, d1="0.5", d2="0.3")
    V = p.k * (q1 - q2) ** 2 / 2 + p.a * ca.sinh(q2) + ca.cosh(q1)
    M = [[2, ca.cos(q1) / 3], [ca.cos(q1) / 3, 1]]
    system = Mechanical([q1, q2], [p1, p2], M=M, V=V, D=[p.d1, p.d2], G=[1, 0], parameters=p, measured=["q1", "q2"])
    wanted = target(q1, q2) if callable(target) else target
    return Design(system, wanted, LAW, sample_period="1e-3", name="tower", **keywords)


def claim_of(derivation, name):
    return next(claim for claim in derivation.claims if claim.claim == name)


def outcomes(derivation):
    return outcomes_of(json.loads(json.dumps(certificate(derivation))))


def equilibrium(design):
    """The derivation, and what the checker says of the claim `equilibrium`."""
    derivation = derive(design)
    found = outcomes(derivation)
    assert "fails" not in found.values()
    return derivation, found["equilibrium"]


@pytest.mark.parametrize("value", ["1.063812982603190314151413138431431431431", Fraction(-(10**40), 3 * 10**39 + 7)])
def test_a_value_of_many_digits_is_taken_as_it_is(value):
    derivation, outcome = equilibrium(spring({"q": value}))
    assert outcome == "checked"
    assert lower(derivation.point.x[0]) == Fraction(value)


@pytest.mark.parametrize("digits", [5, 11, 40])
def test_a_rounded_target_is_refuted_where_the_input_is_irrational(digits):
    exact = "1.0638129826031903926131125807013360062738"
    derivation, outcome = equilibrium(tower({"q1": exact[: digits + 1], "q2": "0.5"}))
    claim = claim_of(derivation, "equilibrium")
    assert (claim.status, outcome) == (Status.REFUTED, "checked")
    assert "dp2/dt" in claim.evidence
    assert "q1 = 1.06381298260" in claim.hint or digits == 5
    assert claim.counterexample["nearest"]["q1"] == pytest.approx(float(exact), abs=1e-5)


def test_a_condition_that_repeats_an_equation_holds_exactly():
    found, outcome = equilibrium(tower(lambda a, b: {"spring": (4 * (a - b), "2.5")}, near={"q2": "0.6"}))
    assert (claim_of(found, "equilibrium").status, outcome) == (Status.PROVED, "checked")


@pytest.mark.parametrize(
    "target",
    [
        lambda q: {"q": 1, "force": (ca.exp(q), 2)},
        lambda q: {"q": 1, "sum": (q + ca.SX(1), "2.001")},
        lambda q: {"q": 1, "square": (q**2, 2)},
    ],
)
def test_conditions_that_contradict_each_other_are_refuted(target):
    derivation, outcome = equilibrium(spring(target))
    claim = claim_of(derivation, "equilibrium")
    assert (claim.status, outcome) == (Status.REFUTED, "checked")
    assert "contradict each other" in claim.evidence


def test_a_condition_may_be_undefined_elsewhere():
    for condition in (lambda q: {"root": (ca.sqrt(q), 2)}, lambda q: {"level": (ca.log(q), 1)}):
        derivation, outcome = equilibrium(spring(condition))
        assert outcome == "checked"
        assert claim_of(derivation, "globally-asymptotically-stable").status is Status.PROVED


def test_constants_that_are_irrational_stand_beside_states():
    p = Parameters(a="0.7", k=4)
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    V = ca.exp(p.a) * (q1 - q2) ** 2 + ca.cosh(p.a) * q2**2
    system = Mechanical([q1, q2], [p1, p2], M=[2, 1], V=V, D=[p.a, p.a], G=[1, 0], parameters=p, measured=["q1"])
    design = Design(system, {"q2": "0.5"}, LAW, sample_period="1e-3", name="irrational")
    assert set(outcomes(derive(design)).values()) == {"checked"}


@pytest.mark.parametrize("G", [[[1, 0], [0, 0]], [[1, -2], [0, 0]]])
def test_inputs_without_rank_are_refuted_although_no_input_is_determined(G):
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    system = Mechanical([q1, q2], [p1, p2], M=[1, 1], V=q1**2 + q2**2, D=[1, 1], G=G)
    derivation = derive(Design(system, {"q1": 1, "q2": 0}, LAW, sample_period="1e-3", name="twice"))
    assert claim_of(derivation, "input-rank").status is Status.REFUTED
    document = certificate(derivation)
    assert outcomes_of(document)["input-rank"] == "checked"
    (entry,) = [entry for entry in document["claims"] if entry["claim"] == "input-rank"]
    entry["witness"]["v"] = ["1", "1"]
    assert outcomes_of(signed(document))["input-rank"] == "fails"
