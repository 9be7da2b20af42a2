"""The search for counterexamples finds narrow ones, confirms them exactly, and never refutes what holds."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen.proof.refute import refute
from pbcgen.proof.seeker import Question
from pbcgen.symbolic.real import REAL, ZERO, rational, sign
from pbcgen.symbolic.tape import Tape

X = ca.SX.sym("x", 4)
CENTRE = (0.3, -0.7, 1.1, 0.2)


def _question(value, bounds=None, scale=None):
    tape = Tape.of([X], [value])
    return Question(
        value, X, lambda p: tape.walk(REAL, [list(p)])[0].scalar(ZERO), tuple(bounds or [(None, None)] * 4), scale
    )


def _refuted(value, **keywords):
    question = _question(ca.SX(value), **keywords)
    found = refute(question)
    if found.point is None:
        return False
    assert sign(question.exact([rational(v) for v in found.point])) == -1
    return True


def _friction(v, v0, width, excess):
    return 1 - (1 + excess) * ca.exp(-(((v - v0) / width) ** 2))


@pytest.mark.parametrize("v0", [1.0, 0.037, 42.7, -3.3])
@pytest.mark.parametrize("excess", [0.5, 0.05, 1e-3])
def test_damping_that_is_negative_in_a_band_of_relative_width_1e_4_is_found(v0, excess):
    v = X[0]
    assert _refuted(_friction(v, v0, 1e-4 * abs(v0), excess) * v**2 + 0.1 * X[1] ** 2 + X[2] ** 2)


@pytest.mark.parametrize("v0", [1.0, 0.037, -3.3])
def test_damping_that_touches_zero_in_the_band_is_not_refuted(v0):
    v = X[0]
    assert not _refuted(_friction(v, v0, 1e-4 * abs(v0), -1e-9) * v**2 + 0.1 * X[1] ** 2)


def test_a_band_between_two_steps_is_found():
    v = X[0]
    step = ca.tanh((v - 1.7) / 1e-5) - ca.tanh((v - 1.7002) / 1e-5)
    assert _refuted((1 - 0.6 * step) * v**2 + X[1] ** 2)


def test_a_rational_band_is_found():
    v = X[0]
    assert _refuted((1 - 1.01 / (1 + ((v - 1.7) / 1e-4) ** 2)) * v**2)


@pytest.mark.parametrize(
    "value",
    [
        1 - 1.01 * ca.exp(-ca.sumsqr(X - ca.DM(CENTRE)) / 1e-5),
        ca.sumsqr(X - ca.DM(CENTRE)) - 1e-5,
        1 - 1.01 * np.prod([ca.exp(-(((X[k] - CENTRE[k]) / 1e-3) ** 2)) for k in range(3)]),
    ],
    ids=["bump", "polynomial", "product of bumps"],
)
def test_a_ball_of_relative_volume_1e_9_is_found(value):
    box = [(Fraction(-2), Fraction(2))] * 4
    assert _refuted(value, bounds=box)


def test_a_counterexample_outside_the_box_does_not_count():
    value = X[0] + 1
    assert _refuted(value)
    assert not _refuted(value, bounds=[(Fraction(-1), None), *[(None, None)] * 3])


@pytest.mark.parametrize("margin", [1e-3, 1e-6])
def test_an_almost_semidefinite_form_is_refuted(margin):
    assert _refuted(X[0] ** 2 - (2 + margin) * X[0] * X[1] + X[1] ** 2)


@pytest.mark.parametrize(
    "value",
    [
        ca.sumsqr(X),
        (X[0] - X[1]) ** 2,
        X[0] * ca.tanh(3 * X[0]),
        X[0] ** 4 * X[1] ** 2 + X[0] ** 2 * X[1] ** 4 + 1 - 3 * X[0] ** 2 * X[1] ** 2,
        (1 - ca.cos(X[0])) * X[1] ** 2,
        X[0] * (ca.exp(X[0]) - 1),
        ca.SX(0),
    ],
)
def test_what_holds_is_not_refuted(value):
    assert not _refuted(value)


@pytest.mark.parametrize("seed", range(12))
def test_what_touches_zero_is_not_refuted_and_what_lies_just_below_is(seed):
    """Friction (g - c)^2 h with h > 0 vanishes where g = c; less 1e-3 of h it is negative there."""
    generator = np.random.default_rng(seed)
    functions = [ca.sin(X[0]), ca.tanh(2 * X[0]), X[0], ca.exp(X[0] / 2), ca.cos(X[0] + X[1]), X[0] * X[1], X[0] - X[1]]
    g = functions[generator.integers(len(functions))]
    c = float(generator.uniform(0.1, 0.9))
    h = [ca.SX(1), 1 + X[1] ** 2, ca.exp(X[1] / 3), 2 + ca.cos(X[1])][generator.integers(4)]
    assert not _refuted((g - c) ** 2 * h)
    assert _refuted(((g - c) ** 2 - 1e-3) * h)


def test_the_search_is_reproducible():
    value = X[0] ** 4 * X[1] ** 2 + X[0] ** 2 * X[1] ** 4 + 1 - 3 * X[0] ** 2 * X[1] ** 2
    first, second = (refute(_question(value)) for _ in range(2))
    assert first == second
    assert first.worst < 1e-6


def test_the_point_is_short():
    found = refute(_question(X[0] - 1))
    assert found.point is not None
    assert all(v.denominator <= 10**3 for v in found.point)


def test_a_function_that_is_its_own_scale_is_refuted():
    """h / scale is the constant -1, so the ratio alone does not say which variables to move."""
    assert _refuted(-(X[0] ** 2), scale=X[0] ** 2)
