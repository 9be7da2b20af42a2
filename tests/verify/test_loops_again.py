"""Claims about the loop are made of a law that can be written: its signals are measured, its equation is solved."""

import copy
import json

import casadi as ca
import pytest
from certificates import outcomes, signed

from pbcgen import AffineSystem, Design, DynamicExtension, PassiveOutput
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive

LOOP = {"stable", "asymptotically-stable", "globally-asymptotically-stable", "sampled-stable"}


def _design(drift, law, **options):
    """One state whose rate u enters, so that y = x' depends on u; y u - S' = (u - x)(u + drift)."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = AffineSystem([x], [u], [drift(x)], [1], x**2 / 2, gamma=[x], **options)
    return Design(system, {"x": "0.25"}, law, sample_period="1e-3", name="loop")


def _believed(document, status):
    document = copy.deepcopy(document)
    for entry in document["claims"]:
        if entry["claim"] in LOOP:
            domain = {"sampled-stable": "sampled loop", "globally-asymptotically-stable": "all x"}
            entry |= {"status": status, "domain": domain.get(entry["claim"], "near x*")}
    found = outcomes(signed(document))
    return {claim for claim in LOOP if found[claim] == "checked"}


@pytest.mark.parametrize("status", ["PROVED", "REFUTED"])
def test_a_law_with_an_equation_that_may_have_several_solutions_is_stable_in_no_sense(status):
    """The passive output is not passive far from x*: nothing says that the law has one input there."""
    law = PassiveOutput(alpha=2, beta=3, k_p="0.5")
    document = json.loads(json.dumps(certificate(derive(_design(lambda x: -x + x**3 / 100, law)))))
    statuses = {entry["claim"]: entry["status"] for entry in document["claims"]}
    assert statuses["passive-output"] == "REFUTED"
    assert {statuses[claim] for claim in LOOP} == {"UNDECIDED"}
    assert _believed(document, status) == set()


def test_the_same_law_is_stable_where_its_equation_has_one_solution():
    document = json.loads(json.dumps(certificate(derive(_design(lambda x: -x, PassiveOutput(2, 3, "0.5"))))))
    assert _believed(document, "PROVED") >= {"stable", "asymptotically-stable", "sampled-stable"}
    for entry in document["claims"]:
        entry["witness"] = None if entry["claim"] == "passive-output" else entry["witness"]
    assert _believed(document, "PROVED") == set()


def test_a_loop_without_the_sensors_of_its_law_is_none():
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    system = AffineSystem([x, y], [u], [y, -x - y], [0, 1], (x**2 + y**2) / 2, measured=["y"])
    design = Design(system, {"x": "0.25"}, DynamicExtension(2, 3, 5, 1), sample_period="1e-3", name="loop")
    document = json.loads(json.dumps(certificate(derive(design))))
    assert {e["claim"]: e["status"] for e in document["claims"]}["measurability"] == "REFUTED"
    assert _believed(document, "PROVED") == set()


@pytest.mark.parametrize(
    ("drift", "outcome"),
    [
        (lambda x: x + ca.tanh(x), "checked"),  # linear but for what is bounded
        (lambda x: x - x**3, "recorded"),
        (lambda x: x / 4, "fails"),  # it grows more slowly than that
        (lambda x: -x, "fails"),
    ],
)
def test_bounded_inputs_do_not_hold_what_grows_beyond_them(drift, outcome):
    document = json.loads(json.dumps(certificate(derive(_design(drift, DynamicExtension(2, 3, 5, 1))))))
    for entry in document["claims"]:
        if entry["claim"] == "globally-asymptotically-stable":
            entry |= {"status": "REFUTED", "domain": "all x", "witness": {"growth": "1/2"}}
        elif entry["claim"] == "asymptotically-stable":
            entry |= {"status": "UNDECIDED"}
    assert outcomes(signed(document))["globally-asymptotically-stable"] == outcome
