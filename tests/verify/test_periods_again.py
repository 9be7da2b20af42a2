"""Periods that vary are checked again by one quadratic form, and not believed where it may grow."""

import copy
import json
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from certificates import forged, fully_measured, outcomes, signed
from flint import arb_mat, fmpq
from scipy.linalg import expm

from pbcgen import AffineSystem, Design, DynamicExtension
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.models.loader import load
from pbcgen.sampling.transition import Transition
from pbcgen.symbolic.plain.matrices import diagonal
from pbcgen.symbolic.real import approximate, ball, precision, rational
from pbcgen.verify.stability import Stability


@pytest.fixture(scope="module")
def varied():
    """Half a sample of delay, and periods that vary by a fifth."""
    document = json.loads(json.dumps(certificate(derive(load("rlc").with_(jitter="1/5", delay="1/2")))))
    assert outcomes(document)["sampled-stable"] == "checked"
    return document


def _with_periods(document, **changes):
    document = copy.deepcopy(document)
    (entry,) = (entry for entry in document["claims"] if entry["claim"] == "sampled-stable")
    entry["witness"] |= changes
    return outcomes(signed(document))["sampled-stable"]


def test_one_form_must_decrease_with_every_period(varied):
    (found,) = (e["witness"] for e in varied["claims"] if e["claim"] == "sampled-stable")
    P, tree = found["P"], found["periods"]
    assert len(tree) > 1
    for other in ("", tree[:-1], tree + ".", "b" + tree[1:], tree.replace(".", ","), tree.replace(".", ";")):
        assert _with_periods(varied, periods=other) == "fails", other
    zero = [["0"] * len(row) for row in P]
    negative = [[v.removeprefix("-") if v.startswith("-") else f"-{v}" for v in row] for row in P]
    unit = [[str(int(i == j)) for j in range(i + 1)] for i in range(len(P))]
    for other in (zero, negative, unit, P[:-1], [], [*P[:-1], [*P[-1][:-1], "0"]]):
        assert _with_periods(varied, P=other) == "fails", other


@pytest.mark.parametrize("longest", ["3/10", "1/2", "9/10", "99/100"])
def test_periods_that_vary_more_are_not_believed(varied, longest):
    """With three tenths one would need another form; with more some period alone makes the loop unstable."""
    slow = load("rlc").with_(sample_period="3e-4", delay="1/2", jitter=longest)
    assert outcomes(forged(varied, slow))["sampled-stable"] == "fails"
    assert outcomes(forged(varied, load("rlc").with_(sample_period="3e-4", delay=2, jitter="1/10")))[
        "sampled-stable"
    ] == ("fails")


def test_modes_that_are_gone_long_before_the_sample_are_no_obstacle():
    """The coupling device has a mode that decays forty times per period."""
    document = json.loads(json.dumps(certificate(derive(load("coupling_device").with_(jitter="0.5")))))
    assert outcomes(document)["sampled-stable"] == "checked"
    tree = next(e["witness"] for e in document["claims"] if e["claim"] == "sampled-stable")["periods"]
    assert len(tree) > 20
    assert _with_periods(document, periods=".") == "fails"
    slow = load("coupling_device").with_(jitter="0.5", sample_period="1e-1")
    assert outcomes(forged(document, slow))["sampled-stable"] == "fails"


@pytest.mark.parametrize("name", ["coupling_device", "pera_integral", "pera", "rlc", "fully_measured"])
def test_the_transition_is_that_of_the_provers(name):
    design = fully_measured() if name == "fully_measured" else load(name)
    derivation = derive(design)
    system = Stability(json.loads(json.dumps(certificate(derivation))), 64)
    h = design.sample_period
    with precision(600):
        own = Transition(derivation.situation.loop, Fraction(0))
        expected = own.real(own.jet(ball(rational(h)))).c0
        found = arb_mat(system.sampled)
        for z in (0, 1, Fraction(1, 3), -2):  # their states may be scaled
            shift = arb_mat(diagonal([rational(z)] * len(system.sampled)))
            assert (found - shift).det().overlaps((expected - shift).det())


def test_the_controller_steps_by_its_own_period(varied):
    """The transition over another time is that of the plant under what is held, with the filter's step as it was."""
    with precision(600):
        system = Stability(varied, 16)
        (A, B), pieces = system.plant, system.controller
        step = np.array([[approximate(v) for v in row] for row in system.transition(fmpq(13, 100000))])
    A, B, k, H, Y, G, L, Z, V = (np.array([[approximate(v) for v in row] for row in M]) for M in (A, B, *pieces))
    P, Q, C, D = -(Z + G @ k @ Y), -(L + G @ k @ H), -k @ H, V - k @ Y
    h, time, n = 1e-4, 1.3e-4, len(A)
    filtered = np.linalg.inv(np.eye(len(Q)) - h * Q)
    xi = np.hstack([filtered @ (h * P), filtered])
    u = np.hstack([D, np.zeros((1, len(Q)))]) + C @ xi

    def held(share):
        block = expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * time * share)
        return block[:n, :n], block[:n, n:]

    (early, push), (late, push_late) = held(0.5), held(0.5)
    x = np.hstack([late @ early, np.zeros((n, len(Q))), late @ push])
    x[:, : n + len(Q)] += push_late @ u
    expected = np.vstack([x, np.hstack([xi, np.zeros((len(Q), 1))]), np.hstack([u, np.zeros((1, 1))])])
    np.testing.assert_allclose(step, expected, rtol=1e-8, atol=1e-8)


def test_what_the_storage_shows_for_all_sequences_of_periods_is_checked():
    """A motor on a spring that softens, so that the claim is local: the damping shows it."""
    i, w, q, u = (ca.SX.sym(name) for name in ("i", "w", "q", "u"))
    S = i**2 / 2 + w**2 / 2 + 1 - ca.cos(q)
    system = AffineSystem([i, w, q], [u], [-i - w, i - ca.tanh(3 * w) - ca.sin(q), w], [1, 0, 0], S)
    law = DynamicExtension(alpha=1, beta=1, R_c=5, K_c=2)
    design = Design(system, {"q": 0}, law, sample_period="1e-3", jitter="1/50", name="motor")
    document = json.loads(json.dumps(certificate(derive(design))))
    (entry,) = (entry for entry in document["claims"] if entry["claim"] == "sampled-stable")
    assert (entry["domain"], "Lambda" in entry["witness"]) == ("sampled loop", True)
    assert outcomes(document)["sampled-stable"] == "checked"
