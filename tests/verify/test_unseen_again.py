"""What refutes `stable` beside the linearisation: steady motions that the controller does not see, checked again."""

import copy

import casadi as ca
import pytest
from certificates import forged, outcomes, signed
from documents import status, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension, Integral, Mechanical

LAW = DynamicExtension(3, 1, 2, 1)


def pair(masses=(1, 2), D=(0, 0), ground=0.0, law=LAW):
    """Two masses that a spring joins, with a force between them."""
    q, p = ([ca.SX.sym(f"{letter}{k}") for k in (1, 2)] for letter in "qp")
    r = q[0] - q[1]
    V = r**2 / 2 + r**4 / 4 + ground * (q[0] + q[1]) ** 2 / 2
    system = Mechanical(q, p, M=list(masses), V=V, D=list(D), G=[1, -1])
    return Design(system, {"q1": 1, "q2": 0}, law, sample_period="1e-2", name="pair")


def winding():
    """Two masses, and a state that the speed of their centre winds up; a stiffening spring."""
    q, p, w, u = ca.SX.sym("q"), ca.SX.sym("p", 2), ca.SX.sym("w"), ca.SX.sym("u")
    force = q + q**3
    f = [p[0] - p[1], -force, force, 3 * (p[0] + p[1])]
    system = AffineSystem([q, p, w], [u], f, [0, 1, -1, 0], q**2 / 2 + q**4 / 4 + ca.sumsqr(p) / 2)
    return Design(system, {"q": "0.5", "p_0": 0, "w": 2}, LAW, sample_period="1e-2", name="winding")


DESIGNS = [
    pair,
    lambda: pair((3, 3)),
    lambda: pair(D=[[1, -1], [-1, 1]]),
    winding,
    lambda: pair(law=Integral(LAW, alpha_psi=["0.1"], beta_psi=[1], R_psi=[1])),
]


@pytest.mark.parametrize("design", DESIGNS)
def test_a_steady_motion_is_checked(design):
    document = written_for(design())
    assert status(document, "stable") == "REFUTED"
    assert outcomes(document)["stable"] == "checked"


def test_on_tied_masses_the_motion_is_none():
    for other in (pair(ground=1.0), pair(D=(1, 1)), pair(D=(0, 0.001))):
        document = forged(written_for(pair()), other, claims=())
        assert outcomes(document)["stable"] == "fails"


@pytest.mark.parametrize(
    "changes",
    [
        {"rate": ["0", "0", "0", "0"]},
        {"rate": ["1", "0", "0", "0"]},
        {"rate": ["1", "1", "1", "2"]},
        {"rate": ["1/3", "2/3", "0", "0"]},
        {"set": {}},
    ],
)
def test_other_motions_are_refused(changes):
    document = written_for(pair())
    assert outcomes(with_witness(document, "stable", **changes))["stable"] == "fails"


def test_a_rate_of_another_length_is_the_same_motion():
    document = with_witness(written_for(pair()), "stable", rate=["7", "7", "0", "0"])
    assert outcomes(document)["stable"] == "checked"


def test_the_set_must_hold_x_star_and_be_kept():
    document = written_for(pair())
    found = witness(document, "stable")["set"]
    n = len([line for line in document["terms"] if line.startswith(" ")])
    document["terms"] += [f"  {n} constant 0", f"  {n + 1} state 1", f"  {n + 2} constant 2"]
    for place in (n, n + 1, n + 2):
        for k in found:
            other = with_witness(document, "stable", set={**found, k: place})
            assert outcomes(signed(other))["stable"] == "fails" or place == n


def test_a_motion_that_changes_its_speed_is_not_steady():
    """``x' = y, y' = -y^2``: where the speed falls, x grows like a logarithm; it is not said to be steady."""
    x, y, z, u = (ca.SX.sym(name) for name in "xyzu")
    S = y**2 / 2 + z**2 / 2
    plain = AffineSystem([x, y, z], [u], [y, 0, -z], [0, 0, 1], S, gamma=[z])
    slowed = AffineSystem([x, y, z], [u], [y, -(y**2), -z], [0, 0, 1], S, gamma=[z])
    designs = [Design(s, {"x": 0, "y": 0, "z": 0}, LAW, sample_period="1e-2", name="d") for s in (plain, slowed)]
    document = written_for(designs[0])
    assert (status(document, "stable"), outcomes(document)["stable"]) == ("REFUTED", "checked")
    assert outcomes(forged(document, designs[1], claims=()))["stable"] == "fails"


def test_a_claim_of_stability_is_not_shown_by_it():
    document = copy.deepcopy(written_for(pair()))
    for entry in document["claims"]:
        if entry["claim"] == "stable":
            entry["status"] = "PROVED"
    assert outcomes(signed(document))["stable"] == "fails"
