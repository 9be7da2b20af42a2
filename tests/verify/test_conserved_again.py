"""Stable beside what is conserved: proved on the leaves, checked again, and not where a leaf has no minimum."""

import copy
import json

import casadi as ca
import pytest
from certificates import outcomes, signed

from pbcgen import AffineSystem, Circuit, Design, DynamicExtension, Mechanical, Parameters, PassiveOutput
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive

LAW = DynamicExtension(alpha=5, beta="0.01", K_c=1, R_c=10)


def capacitors(resistor=lambda i: 3 * i, names=("a", "b")):
    """One current charges all capacitors: differences of their charges are constant."""
    i, v = ca.SX.sym("i"), [ca.SX.sym(name) for name in names]
    p = Parameters(L="0.01", **{f"C_{name}": f"{k + 1}e-3" for k, name in enumerate(names)})
    C = [getattr(p, f"C_{name}") for name in names]
    row = [[1] * len(names)]
    circuit = Circuit([i], v, L=[p.L], C=C, Gamma=row, v_R=[resistor(i)], g_L=[-1], parameters=p)
    return Design(circuit, dict(zip(names, (2, 1, "-0.3"), strict=False)), LAW, sample_period="1e-5", name="capacitors")


def reaction(law=LAW):
    """a <-> b <-> c in a closed vessel: the total is constant, and the storage is least at another one."""
    a, b, c, u, v = (ca.SX.sym(name) for name in "abcuv")
    system = AffineSystem(
        [a, b, c],
        [u, v],
        [2 * b - a, a - 4 * b + 3 * c, 2 * b - 3 * c],
        [[-1, 0], [1, -1], [0, 1]],
        a**2 / 2 + b**2 + 3 * c**2 / 2,
    )
    return Design(system, {"a": "0.6", "b": "0.3", "c": "0.2"}, law, sample_period="1e-3", name="reaction")


def masses(k):
    """A mass on a spring, beside a state that nothing moves."""
    q, p, c, u = (ca.SX.sym(name) for name in "qpcu")
    S = p**2 / 2 + k * q**2 / 2 - c**2
    law = DynamicExtension(alpha=1, beta=1, K_c=1, R_c=1)
    return Design(
        AffineSystem([q, p, c], [u], [p, -k * q - p, 0], [0, 1, 0], S),
        {"q": 0, "c": 0},
        law,
        sample_period="1e-3",
        name="m",
    )


def verdict(derivation):
    return {claim.claim: claim.status for claim in derivation.claims}["stable"]


@pytest.mark.parametrize(
    "design",
    [
        capacitors,
        lambda: capacitors(ca.sinh),
        lambda: capacitors(names=("a", "b", "c")),
        reaction,
        lambda: reaction(PassiveOutput(alpha=5, beta="0.01", k_p=1)),
        lambda: masses(2),
    ],
)
def test_a_minimum_on_the_leaves_is_enough(design):
    derivation = derive(design())
    claims = {claim.claim: claim for claim in derivation.claims}
    assert claims["stable"].status == "PROVED"
    assert claims["asymptotically-stable"].status == "REFUTED"
    document = json.loads(json.dumps(certificate(derivation)))
    assert outcomes(document)["stable"] == "checked"


@pytest.mark.parametrize("k", [-2, -1])
def test_a_saddle_on_the_leaf_is_not_stable(k):
    assert verdict(derive(masses(k))) != "PROVED"


def test_a_pair_of_free_masses_drifts():
    """The momentum is conserved and the distance settles, but their centre runs away."""
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    D = [[0.5, -0.5], [-0.5, 0.5]]
    pair = Mechanical([q1, q2], [p1, p2], M=[1, 2], V=(q1 - q2 - 1) ** 2, D=D, G=[1, -1])
    design = Design(pair, {"q1": 1, "q2": 0}, LAW, sample_period="1e-3", name="pair")
    assert verdict(derive(design)) != "PROVED"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("conserved", [["1", "1", "2"]]),
        ("conserved", [["0", "0", "0"]]),
        ("conserved", []),
        ("slope", ["0"]),
        ("slope", ["-3/10"]),
        ("weight", "-1"),
        ("weight", "0"),
    ],
)
def test_other_numbers_are_refused(name, value):
    document = json.loads(json.dumps(certificate(derive(reaction() if name != "weight" else masses(2)))))
    spoiled = copy.deepcopy(document)
    (entry,) = [entry for entry in spoiled["claims"] if entry["claim"] == "stable"]
    entry["witness"][name] = value
    assert outcomes(signed(document))["stable"] == "checked"
    assert outcomes(signed(spoiled))["stable"] == "fails"


def test_three_alike_modes_that_nothing_sees_have_eigenvalues_that_cannot_be_told_apart():
    q, p = ([ca.SX.sym(f"{name}{k}") for k in range(4)] for name in "qp")
    V = q[0] ** 2 + sum((q[0] - other) ** 2 for other in q[1:])
    star = Mechanical(q, p, M=[1, 1, 1, 1], V=V, D=[0.5, 0, 0, 0], G=[1, 0, 0, 0])
    law = DynamicExtension(alpha=5, beta=2, K_c=10, R_c=1)
    derivation = derive(Design(star, {"q0": 0}, law, sample_period="1e-3", name="star"))
    found = outcomes(json.loads(json.dumps(certificate(derivation))))
    assert (found["stable"], found["asymptotically-stable"]) == ("checked", "checked")


def test_springs_that_stiffen_are_eliminated_quickly_enough():
    """The chain of implications multiplies polynomials of fourth degree out."""
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    V = q1**2 / 2 + q2**2 / 2 + (q1 - q2) ** 4
    pair = Mechanical([q1, q2], [p1, p2], M=[1, 1.5], V=V, D=[0.1, 0], G=[1, 0])
    law = DynamicExtension(alpha=9, beta=2, K_c=10, R_c=1)
    derivation = derive(Design(pair, {"q1": 0}, law, sample_period="1e-3", name="pair"))
    assert {*outcomes(json.loads(json.dumps(certificate(derivation)))).values()} == {"checked"}
