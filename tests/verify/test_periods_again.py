"""Periods that vary are checked again by one quadratic form, and not believed where it may grow."""

import copy
import json

import numpy as np
import pytest
from certificates import forged, outcomes, signed
from flint import fmpq
from scipy.linalg import expm

from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.models.loader import load
from pbcgen.symbolic.real import approximate, precision
from pbcgen.verify.stability import Stability


@pytest.fixture(scope="module")
def varied():
    """Half a sample of delay, and periods that vary by a tenth."""
    document = json.loads(json.dumps(certificate(derive(load("rlc").with_(jitter="1/10", delay="1/2")))))
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


def test_the_controller_steps_by_its_own_period(varied):
    """The transition over another time is that of the plant under what is held, with the filter's step as it was."""
    with precision(600):
        system = Stability(varied, 16)
        (A, B), (P, Q, C, D) = system.plant, system.controller
        step = np.array([[approximate(v) for v in row] for row in system.transition(fmpq(13, 100000))])
    A, B, P, Q, C, D = (np.array([[approximate(v) for v in row] for row in M]) for M in (A, B, P, Q, C, D))
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
