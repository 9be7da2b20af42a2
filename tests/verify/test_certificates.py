"""What a certificate shows, and what it does not."""

import functools
import json
import re

import casadi as ca
import numpy as np
import pytest
from certificates import (
    IDLE,
    REFERENCE,
    certificate_of,
    damped_oscillator,
    forged,
    oscillator,
    outcomes,
    signed,
    spoiled,
)

from pbcgen import Design, DynamicExtension, Limits, Mechanical
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.models.identity import canonical_text
from pbcgen.models.loader import load
from pbcgen.symbolic.plain.outcomes import Malformed
from pbcgen.symbolic.real import approximate, precision
from pbcgen.verify.claims import bits_for, find
from pbcgen.verify.stability import Stability

#: Certificates are shared by the tests of one process.
pytestmark = pytest.mark.xdist_group("certificates")

#: Claims that the checker has a check for.
COVERED = {
    "input-rank",
    "equilibrium",
    "assumption-1",
    "passive-output",
    "gradient-condition",
    "hessian-condition",
    "gain-definiteness",
    "kc-bound",
    "assumption-3",
    "theta",
    "measurability",
    "saturation",
    "stable",
    "asymptotically-stable",
    "globally-asymptotically-stable",
    "sampled-stable",
}


@pytest.mark.parametrize("name", [*REFERENCE, "oscillator", "damped_oscillator", "fully_measured"])
def test_every_verdict_is_checked_again(name):
    document = certificate_of(name)
    found = outcomes(document)
    decided = {entry["claim"] for entry in document["claims"] if entry["status"] != "UNDECIDED"}
    by_motion = {"globally-asymptotically-stable"} if name == "coupling_device" else set()
    assert {claim for claim in decided & COVERED if found[claim] != "checked"} == by_motion
    assert {found[claim] for claim in by_motion} <= {"recorded"}  # nothing checks a tube around a periodic motion again
    assert len(decided & COVERED) >= 11


def test_the_certificate_is_the_same_for_the_same_design():
    first, second = (json.dumps(certificate(derive(oscillator()))) for _ in range(2))
    assert first == second


def test_the_coupling_device_has_a_checked_counterexample_to_theta():
    document = certificate_of("coupling_device")
    status = {entry["claim"]: entry["status"] for entry in document["claims"]}
    assert status["theta"] == "REFUTED"
    assert outcomes(document)["theta"] == "checked"


@pytest.mark.parametrize("part", ["formulas", "readings", "terms", "claims"])
@pytest.mark.parametrize("name", ["oscillator", "damped_oscillator", "fully_measured", "coupling_device", "rlc"])
def test_another_digit_is_not_believed(name, part):
    document = certificate_of(name)
    text = json.dumps(document[part])
    tried = 0
    for place, changed in list(spoiled(document, part))[:: 1 if part != "claims" else 2]:
        start = int(re.search(r"\d+", place)[0])
        if IDLE.search(text[:start]) or "feedthrough" in text[:start] or "constant 0" in text[start - 9 : start + 1]:
            continue
        tried += 1
        try:
            found = outcomes(changed)
        except Malformed:
            continue
        assert "fails" in found.values(), f"{place}: {text[start - 30 : start]}>{text[start]}<"
    assert tried >= 5


def test_another_parameter_under_the_proof_is_not_believed():
    document = certificate_of("coupling_device")
    for k, line in enumerate(document["model"]):
        if line.startswith("parameter") and not line.startswith("parameter k "):  # the spring takes no power
            changed = signed(document | {"model": [*document["model"][:k], line + "1", *document["model"][k + 1 :]]})
            assert outcomes(changed)["assumption-1"] == "fails", line


def test_a_tighter_limit_than_the_input_needs_is_not_believed():
    document = certificate_of("coupling_device")
    model = [line.replace("limit u -5 5", "limit u -5 4999/1000") for line in document["model"]]
    assert outcomes(signed(document | {"model": model}))["saturation"] == "fails"


BROKEN = {
    "viscous friction with the wrong sign": {"friction_2": lambda p, q1, q2, v1, v2: -p.d * v2 + _tanh(v2)},
    "dry friction with the wrong sign": {"friction_2": lambda p, q1, q2, v1, v2: p.d * v2 - _tanh(v2)},
    "negative friction at the port": {"friction_1": lambda p, q1, q2, v1, v2: -p.d * v1 / p.m},
    "a spring that pulls one side more": {"coupling": lambda p, q1, q2, v1, v2: 1.001},
    "a spring that pushes": {"coupling": lambda p, q1, q2, v1, v2: -1},
    "no energy of the wall": {"energy": lambda p, q1, q2, v1, v2: _energy(p, q1, q2, v1, v2, wall=0)},
    "half the energy of the wall": {"energy": lambda p, q1, q2, v1, v2: _energy(p, q1, q2, v1, v2, wall=0.5)},
    "negative energy of the spring": {"energy": lambda p, q1, q2, v1, v2: _energy(p, q1, q2, v1, v2, spring=-1)},
    "a wall that pushes, its energy not": {"wall": lambda p, q1, q2, v1, v2: -p.c * q1},
    "a wall that pushes hard": {
        "wall": lambda p, q1, q2, v1, v2: -20 * p.c * q1,
        "energy": lambda p, q1, q2, v1, v2: _energy(p, q1, q2, v1, v2, wall=-20),
    },
    "an actuator with the wrong sign": {"push": lambda p, q1, q2, v1, v2: -1},
}


def _tanh(v):
    import casadi as ca

    return ca.tanh(3 * v)


def _energy(p, q1, q2, v1, v2, wall=1, spring=1):
    return v1**2 / (2 * p.m) + v2**2 / 2 + spring * p.k * (q1 - q2) ** 2 / 2 + wall * p.c * q1**2 / 2


@functools.cache
def _broken(defect):
    """What is derived of a broken model, and its certificate as a text."""
    derivation = derive(oscillator(**BROKEN[defect]))
    return derivation, json.dumps(certificate(derivation))


@pytest.mark.parametrize("defect", BROKEN)
def test_a_broken_model_is_not_believed(defect):
    """Under the certificate of the good model, and under its own with every verdict forced to PROVED."""
    derivation, text = _broken(defect)
    design = derivation.design
    truth = {claim.claim: claim.status for claim in derivation.claims}
    assert "REFUTED" in truth.values()
    own = json.loads(text)
    for document in (forged(certificate_of("oscillator"), design), forged(own, design)):
        believed = {claim for claim, outcome in outcomes(document).items() if outcome == "checked"}
        assert {claim for claim in believed if truth[claim] != "PROVED"} == set()


@pytest.mark.parametrize("defect", BROKEN)
def test_the_refutations_of_a_broken_model_are_checked(defect):
    derivation, text = _broken(defect)
    found = outcomes(json.loads(text))
    refuted = {claim.claim for claim in derivation.claims if claim.status == "REFUTED"} & COVERED
    assert {claim for claim in refuted if found[claim] != "checked"} == set()


@pytest.mark.parametrize("name", ["oscillator", "damped_oscillator", "fully_measured", "rlc"])
def test_a_refutation_of_a_true_claim_is_not_believed(name):
    """One claim after the other, with directions and states that might be counterexamples."""
    document = certificate_of(name)
    states = Stability(document, 64).n
    sizes = (1, 2, states, states + 1)
    directions = [[str(int(j == k)) for j in range(n)] for n in sizes for k in range(n)]
    for k, entry in enumerate(document["claims"]):
        if entry["status"] != "PROVED" or entry["claim"] == "equilibrium":
            continue
        for v in directions:
            more = {"v": v, "x": v, "z": v, "q": v, "gain": "K_c"}
            changed = entry | {"status": "REFUTED", "witness": (entry["witness"] or {}) | more}
            claims = [*document["claims"][:k], changed, *document["claims"][k + 1 :]]
            system = Stability(document | {"claims": claims}, 64)
            with precision(bits_for(states)):
                assert find(system, entry["claim"], "REFUTED").outcome != "checked", (entry["claim"], v)
                assert system.point


@pytest.mark.parametrize(
    ("gains", "limits", "wrong"),
    [
        ({"alpha": 4}, (-2, 3), {"saturation"}),
        ({"beta": "1e3", "K_c": "1e3"}, (-2, 3), {"sampled-stable"}),
        ({"alpha": "1/1000", "K_c": "1/1000"}, (-2, 3), set()),
    ],
)
def test_other_gains_under_the_certificate(gains, limits, wrong):
    plain = oscillator()
    law = DynamicExtension(**({"alpha": 2, "beta": 1, "K_c": 1, "R_c": "1/2"} | gains))
    design = Design(plain.system, target={"q1": "1/2"}, law=law, limits=Limits({"u": limits}), sample_period="1e-2")
    truth = {claim.claim: str(claim.status) for claim in derive(design).claims}
    found = outcomes(forged(certificate_of("oscillator"), design))
    bound = {"globally-asymptotically-stable", "sampled-stable"}  # to the gains by their witnesses
    for claim in COVERED & {*truth}:
        assert (found[claim] == "checked") == (truth[claim] == "PROVED") or (claim in bound and found[claim] == "fails")
    assert wrong <= {claim for claim in truth if truth[claim] != "PROVED"}


def test_theta_at_its_margin():
    """K_l R_l >= (1/Lambda_l + 1/Lambda_c)/4 = (4 + 4)/4 = 2; touching zero counts."""
    for K_l, status in (("2", "PROVED"), ("1.999999", "REFUTED"), ("2.000001", "PROVED")):
        derivation = derive(damped_oscillator(K_l))
        assert {c.claim: str(c.status) for c in derivation.claims}["theta"] == status
        document = json.loads(json.dumps(certificate(derivation)))
        assert outcomes(document)["theta"] == "checked"
        assert "fails" not in outcomes(document).values()  # what is shown without Theta is not called false
        other = "REFUTED" if status == "PROVED" else "PROVED"
        for entry in document["claims"]:
            entry["status"] = other if entry["claim"] == "theta" else entry["status"]
        assert outcomes(signed(document))["theta"] != "checked"
        entry = next(entry for entry in document["claims"] if entry["claim"] == "theta")
        states = (["1", "1", "1", "1", "0"], ["0", "0", "1", "-1", "0"], ["0", "0", "1", "-1", "1"])
        for x in states if status == "PROVED" else ():
            entry["witness"] = {"x": x}
            assert outcomes(signed(document))["theta"] == "fails"


@pytest.mark.parametrize(("gain", "value"), [("K_c", "[[1]]"), ("R_c", "[[1/2]]"), ("K_l", "[[10]]"), ("R_l", "[[1]]")])
def test_a_gain_that_is_not_positive_is_not_believed_to_be(gain, value):
    document = certificate_of("damped_oscillator")
    line = f"gain {gain} = {value}"
    assert line in document["model"]
    for other in ("[[-1]]", "[[0]]"):
        model = [f"gain {gain} = {other}" if text == line else text for text in document["model"]]
        assert outcomes(signed(document | {"model": model}))["gain-definiteness"] == "fails", other


def test_a_claim_that_nobody_knows_fails():
    document = certificate_of("oscillator")
    document["claims"][0]["claim"] = "assumption-4"
    assert outcomes(signed(document))["assumption-4"] == "fails"


def test_claims_without_a_witness_are_recorded_not_checked():
    document = certificate_of("oscillator")
    for entry in document["claims"]:
        if entry["claim"] == "assumption-1":
            entry["witness"] = None
    assert outcomes(signed(document))["assumption-1"] == "recorded"


def test_the_rank_of_inputs_that_depend_on_the_state_is_known_at_x_star_only():
    document = certificate_of("oscillator")
    assert next(e["domain"] for e in document["claims"] if e["claim"] == "input-rank") == "all x"
    assert outcomes(document)["input-rank"] == "checked"
    lines = [line for line in document["model"] if re.match(r"  \d", line)]
    twice = f"  {len(lines)} twice {_place(lines, 'state 0')}"  # 2 q1, which is 1 at q1* = 1/2
    model = [re.sub(r"^g 4x1 2,0:\d+$", f"g 4x1 2,0:{len(lines)}", line) for line in document["model"]]
    model.insert(model.index(lines[-1]) + 1, twice)
    changed = signed(document | {"model": model})
    found = outcomes(changed)
    assert (found["equilibrium"], found["input-rank"]) == ("checked", "fails")
    changed["claims"][0]["domain"] = "at x*"
    assert outcomes(signed(changed))["input-rank"] == "checked"


def test_an_equilibrium_on_the_edge_of_the_domain_is_none():
    """Where the model says nothing on one side, nothing can be said of stability."""
    document = certificate_of("oscillator")
    for bound, outcome in (("1/2", "fails"), ("501/1000", "checked")):
        model = [*document["model"], f"domain q1 unbounded {bound}"]
        assert outcomes(signed(document | {"model": model}))["equilibrium"] == outcome


def test_an_empty_domain_has_no_equilibrium():
    document = certificate_of("oscillator")
    model = [*document["model"], "domain q1 1 -1"]
    assert outcomes(signed(document | {"model": model}))["equilibrium"] == "fails"


def test_formulas_cannot_stand_in_for_the_model():
    """A certificate that defines f, S or the measurement again is read with the model's."""
    design = oscillator(**BROKEN["viscous friction with the wrong sign"])
    good = certificate_of("oscillator")
    document = forged(good, design)
    model = [line for line in good["model"] if re.match(r" |f |S ", line)]
    document["formulas"] = [*model, f"gamma 1x1 0,0:{_place(model, 'state 0')}"]
    assert outcomes(signed(document))["assumption-1"] == "fails"


def test_a_second_rest_outside_of_the_domain_refutes_nothing():
    """The wall that bounds q is written into the model of a certificate that has the rest beyond it."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[1], V=2 - 2 * ca.cos(q), D=[0.3], G=[1])
    law = DynamicExtension(alpha=1, beta=2, K_c=20, R_c=1)
    design = Design(system, target={"q": 0}, law=law, sample_period="1e-3")
    document = json.loads(json.dumps(certificate(derive(design))))
    assert outcomes(document)["globally-asymptotically-stable"] == "checked"
    narrow = Mechanical([q], [p], M=[1], V=2 - 2 * ca.cos(q), D=[0.3], G=[1], domain={"q": (-3, 3)})
    document["model"] = canonical_text(design.with_(system=narrow)).splitlines()
    assert outcomes(signed(document))["globally-asymptotically-stable"] == "fails"


@pytest.mark.parametrize(("inside", "outcome"), [("1 + r**2", "checked"), ("r**2 + 0 * r", None)])
def test_a_root_of_what_is_positive_is_smooth_everywhere(inside, outcome):
    """A spring that stiffens as sqrt(1 + r^2) does; sqrt(r^2) is the absolute value of r."""
    q, r, p1, p2 = (ca.SX.sym(name) for name in ("q", "r", "p1", "p2"))
    V = (q - r) ** 2 / 2 + r**2 / 2 + ca.sqrt(eval(inside, {"r": r}))
    system = Mechanical([q, r], [p1, p2], M=[1, 1], V=V, D=[0.5, 0.5], G=[1, 0])
    law = DynamicExtension(alpha=3, beta=2, K_c=20, R_c=1)
    derivation = derive(Design(system, {"q": 0}, law, sample_period="1e-2", near={"r": 0}))
    document = json.loads(json.dumps(certificate(derivation)))
    status = {entry["claim"]: entry["status"] for entry in document["claims"]}["globally-asymptotically-stable"]
    assert (status == "PROVED") == (outcome == "checked")
    if outcome:
        assert outcomes(document)["globally-asymptotically-stable"] == outcome


def _place(lines, instruction):
    return next(line.split()[0] for line in lines if line.endswith(instruction))


@pytest.mark.parametrize(("delay", "status"), [("1/2", "PROVED"), (1, "PROVED"), ("3/2", "REFUTED"), (2, "REFUTED")])
def test_a_delayed_loop_is_checked_again(delay, status):
    document = json.loads(json.dumps(certificate(derive(load("rlc").with_(delay=delay)))))
    assert {c["claim"]: c["status"] for c in document["claims"]}["sampled-stable"] == status
    assert outcomes(document)["sampled-stable"] == "checked"


def test_a_delay_that_the_certificate_leaves_out_or_adds_is_seen():
    """The loop is stable without a delay, and not with two samples."""
    late = json.loads(json.dumps(certificate(derive(load("rlc").with_(delay=2)))))
    assert outcomes(forged(late, load("rlc")))["sampled-stable"] == "checked"
    assert outcomes(forged(certificate_of("rlc"), load("rlc").with_(delay=2)))["sampled-stable"] == "fails"


@pytest.mark.parametrize("delay", ["1/2", 1, "3/2"])
def test_the_transition_of_a_delayed_loop_is_the_one_that_was_decided(delay):
    design = load("coupling_device").with_(delay=delay, sample_period="0.05")
    found = derive(design)
    system = Stability(json.loads(json.dumps(certificate(found))), 16)
    radius = max(abs(np.linalg.eigvals(np.array([[approximate(v) for v in row] for row in system.sampled]))))
    assert radius == pytest.approx(found.derived["spectral_radius"], rel=1e-9)


def test_periods_that_vary_below_the_bound_of_the_storage_are_checked():
    """The bound is 1/660 s, for any sequence of periods; the common storage of the coupling device is not checked."""
    document = json.loads(json.dumps(certificate(derive(load("pera").with_(jitter="1/2")))))
    assert {c["claim"]: c["domain"] for c in document["claims"]}["sampled-stable"] == "sampled loop, all x"
    assert outcomes(document)["sampled-stable"] == "checked"
    slow = load("pera").with_(sample_period="1.4e-3")
    assert outcomes(forged(document, slow))["sampled-stable"] == "checked"
    assert outcomes(forged(document, slow.with_(jitter="1/10")))["sampled-stable"] == "fails"
    assert outcomes(forged(document, slow.with_(delay="1/2")))["sampled-stable"] == "fails"
