"""Families of models for all positive parameters, sound and broken: the broken ones must not be PROVED."""

from __future__ import annotations

from fractions import Fraction
from itertools import product
from types import SimpleNamespace

import casadi as ca
import pytest

from pbcgen import (
    AffineSystem,
    Design,
    DynamicExtension,
    Mechanical,
    NaturalDamping,
    Parameters,
    PotentialCompensation,
    check,
    for_all_parameters,
)
from pbcgen.parametric import wide
from pbcgen.parametric.wide import Wide
from pbcgen.passivity.structure import PowerStructure

LAWS = {
    "dynamic-extension": DynamicExtension(2, 1, 5, 1),
    "natural-damping": NaturalDamping(2, 1, 5, 1, alpha_l=1, beta_l=1, K_l=100, R_l=100),
}
COEFFICIENTS = ("m1", "m2", "k1", "k2", "d1", "d2")
#: What is made of a coefficient c with another parameter e, and whether it stays positive.
CHANGES = {
    "c + e": (lambda c, e: c + e, True),
    "c e": (lambda c, e: c * e * 1000, True),
    "c / (c + e)": (lambda c, e: c / (c + e), True),
    "c^2 - c e + e^2": (lambda c, e: c**2 - c * e + e**2, True),
    "c - e": (lambda c, e: c - e, False),
    "c e - c^2 e^2": (lambda c, e: c - c**2 * e, False),
    "c^2 - 2.1 c e + e^2": (lambda c, e: c**2 - 2.1 * c * e + e**2, False),
}


def _chain(change, changed, law):
    """Two masses and two springs, the second mass pushed; one coefficient is changed."""
    p = Parameters(m1=1, m2=2, k1=3, k2=1, d1="0.5", d2="0.25", e="1/1000")
    value = {name: p[name] for name in COEFFICIENTS}
    value[changed] = change(p[changed], p.e)
    q1, q2, p1, p2, u = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2", "u"))
    S = (p1**2 / value["m1"] + p2**2 / value["m2"] + value["k1"] * q1**2 + value["k2"] * (q1 - q2) ** 2) / 2
    pull = value["k2"] * (q1 - q2)
    v1, v2 = p1 / value["m1"], p2 / value["m2"]
    f = [v1, v2, -value["k1"] * q1 - pull - value["d1"] * v1, pull - value["d2"] * v2]
    system = AffineSystem([q1, q2, p1, p2], [u], f, [0, 0, 0, 1], S, parameters=p, measured=["q1", "q2"])
    return Design(system, {"q2": "0.5"}, law, sample_period="1e-3", name="chain")


def _statuses(design):
    return {claim.claim: str(claim.status) for claim in for_all_parameters(check(design))}


@pytest.fixture
def without_refuter(monkeypatch):
    """The search for counterexamples takes most of the time, and proofs do not wait for it."""
    monkeypatch.setattr(wide, "refute", lambda question: SimpleNamespace(point=None, value=None))


#: Sound changes with natural damping where they reach it, and every broken one.
CASES = [
    (change, changed, law)
    for change, changed, law in product(CHANGES, COEFFICIENTS, LAWS)
    if not CHANGES[change][1] or changed in ("d2", "m1") or (law == "dynamic-extension" and changed == "k1")
]


@pytest.mark.parametrize(("change", "changed", "law"), CASES)
def test_a_changed_coefficient_of_a_chain(change, changed, law, without_refuter):
    """Sound changes keep the proofs; after broken ones no claim that needs the coefficient is proved."""
    function, sound = CHANGES[change]
    found = _statuses(_chain(function, changed, LAWS[law]))
    rests = {"m": "hessian-condition", "k": "hessian-condition", "d": "assumption-1"}[changed[0]]
    stable = ["stable", "asymptotically-stable", "globally-asymptotically-stable"]
    if sound:
        needed = ["assumption-1", "passive-output", "hessian-condition", "kc-bound"]
        needed += stable if law == "dynamic-extension" else ["assumption-3"]
        assert {name for name in needed if found[name] != "PROVED"} == set()
        return
    refused = [rests, *stable]
    if changed[0] == "d" and law == "natural-damping":
        refused += ["assumption-3", "theta"]
    assert {name for name in refused if found[name] == "PROVED"} == set()


def _arm(change, changed):
    """Two links of point masses: M = sum J^T m J, and one coefficient of it changed."""
    p = Parameters(m1=2, m2=3, d1=1, d2=1, g="9.81", e="1/1000")
    value = {name: p[name] for name in ("m1", "m2", "d1", "d2")}
    value[changed] = change(p[changed], p.e)
    q, momenta = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    elbow = ca.vertcat(ca.cos(q[0]), ca.sin(q[0]))
    hand = elbow + ca.vertcat(ca.cos(q[0] + q[1]), ca.sin(q[0] + q[1])) / 2
    J1, J2 = ca.jacobian(elbow, q), ca.jacobian(hand, q)
    M = value["m1"] * ca.mtimes(J1.T, J1) + value["m2"] * ca.mtimes(J2.T, J2)
    V = p.g * (value["m1"] * elbow[1] + value["m2"] * hand[1])
    system = Mechanical(q, momenta, M=M, V=V, D=[value["d1"], value["d2"]], G=ca.SX.eye(2), parameters=p)
    law = PotentialCompensation([200, 100], 3, 50, 1)
    return Design(system, {"q_0": "0.5", "q_1": "0.25"}, law, sample_period="1e-3", name="arm")


@pytest.mark.system
@pytest.mark.parametrize("changed", ["m1", "m2", "d1", "d2"])
@pytest.mark.parametrize("change", ["c + e", "c - e"])
def test_a_changed_coefficient_of_an_arm(change, changed, without_refuter):
    """The potential is compensated: with positive masses and friction everything holds for all of them."""
    function, sound = CHANGES[change]
    found = _statuses(_arm(function, changed))
    if sound:
        assert {*found.values()} == {"PROVED"}
        return
    refused = ["stable", "asymptotically-stable", "globally-asymptotically-stable"]
    refused.append("assumption-1" if changed[0] == "d" else "hessian-condition")
    assert {name for name in refused if found[name] == "PROVED"} == set()


def test_friction_that_may_be_zero_is_not_asymptotic_by_laziness(without_refuter):
    """d (e - 1)^2 vanishes at e = 1: dissipation is proved, Lambda and what needs strict damping are not."""
    found = _statuses(_chain(lambda c, e: c * (e - 1) ** 2, "d1", LAWS["natural-damping"]))
    assert found["assumption-1"] == "PROVED"
    assert {found[name] for name in ("assumption-3", "theta", "stable")} == {"UNDECIDED"}


def test_a_number_in_the_model_is_no_parameter():
    """The loss (d - 0.3) v^2 is refuted by a small d; with d - 0.3 d it is proved."""
    p = Parameters(m=1, d=2)
    q, v, u = (ca.SX.sym(name) for name in "qvu")
    for loss, expected in ((p.d - 0.3 * p.d, "PROVED"), (p.d - 0.3, "REFUTED")):
        system = AffineSystem([q, v], [u], [v, -q - loss * v], [0, 1], (q**2 + v**2) / 2, parameters=p)
        claims = for_all_parameters(check(Design(system, {"q": 0}, LAWS["dynamic-extension"], sample_period="1e-3")))
        claim = next(claim for claim in claims if claim.claim == "assumption-1")
        assert claim.status == expected
        if claim.counterexample is not None:
            assert {*claim.counterexample["parameters"]} == {"m", "d"}


def test_numbers_that_a_search_at_the_values_makes_do_not_get_in_the_way():
    """A structure may hold fractions that the plant at the values has made after the widened one."""
    derivation = check(_pendulum(LAWS["dynamic-extension"])).derivation
    design = Wide(derivation)
    third = derivation.plant.number(Fraction(1, 3))
    structure = PowerStructure("F", third * ca.SX.eye(2), ca.SX(2, 1), "made up")
    (matrix,) = design.exact(design.power_structure(structure).matrix)
    assert str(matrix[0][0].constant()) == "1/3"


def test_what_is_refuted_at_the_models_own_values_is_refuted():
    """The buck converter without coil resistance has no Lambda_c, for these values and so not for all."""
    p = Parameters(L="0.5", C="0.2", R=3, E=20)
    i, v, u = (ca.SX.sym(name) for name in "ivd")
    f, S = [-v / p.L, (i - v / p.R) / p.C], p.L * i**2 / 2 + p.C * v**2 / 2
    system = AffineSystem([i, v], [u], f, [p.E / p.L, 0], S, parameters=p, measured=["i", "v"])
    claims = for_all_parameters(check(Design(system, {"v": 5}, LAWS["natural-damping"], sample_period="1e-3")))
    claim = next(claim for claim in claims if claim.claim == "assumption-3")
    assert claim.status == "REFUTED"
    assert claim.counterexample["parameters"] == {"L": "0.5", "C": "0.2", "R": "3", "E": "20"}


# --- conditions as formulas ----------------------------------------------------------------------------------------


def _pendulum(law, **values):
    p = Parameters(**{"m": 1, "g": "9.81", "l": "0.1", "d": 1, **values})
    q, v = ca.SX.sym("q"), ca.SX.sym("p")
    return Design(
        Mechanical([q], [v], M=[[p.m * p.l**2]], V=p.m * p.g * p.l * ca.cos(q), D=[p.d], G=[[1]], parameters=p),
        {"q": 0},
        law,
        sample_period="1e-3",
        name="pendulum",
    )


def test_the_stiffness_that_holds_a_pendulum_is_a_formula():
    claims = {c.claim: c for c in for_all_parameters(check(_pendulum(DynamicExtension(2, 3, 5, 1))))}
    assert "hess S_d > 0 iff alpha*beta > g*l*m (here alpha*beta = 6)" in claims["hessian-condition"].evidence
    assert "alpha*beta*K_c > g*l*m*(alpha*beta + K_c)" in claims["kc-bound"].evidence
    assert claims["stable"].evidence.startswith("proved where alpha*beta > g*l*m")


@pytest.mark.parametrize("length", ["0.1", "0.2", "0.27", "0.29", "0.4", "0.6", "0.62"])
def test_the_formula_says_what_is_found_at_the_values(length):
    """alpha beta = 6 and K_c = 5 hold 9.81 l < 6 and 9.81 l < 30/11."""
    claims = {c.claim: str(c.status) for c in check(_pendulum(DynamicExtension(2, 3, 5, 1), l=length)).claims}
    load = 9.81 * float(length)
    assert (claims["hessian-condition"] == "PROVED") is (load < 6)
    assert (claims["kc-bound"] == "PROVED") is (load < 30 / 11)


def test_theta_is_a_condition_on_the_gains():
    claims = {c.claim: c for c in for_all_parameters(check(_chain(lambda c, e: c, "d1", LAWS["natural-damping"])))}
    assert "Lambda_l = diag(d1), Lambda_c = diag(d2)" in claims["assumption-3"].evidence
    assert "K_l*R_l > 0.25*(d1 + d2)/(d1*d2)" in claims["theta"].evidence
    assert claims["theta"].status == "REFUTED"
    values = {name: Fraction(v) for name, v in claims["theta"].counterexample["parameters"].items()}
    assert (1 / values["d1"] + 1 / values["d2"]) / 4 > 10_000
