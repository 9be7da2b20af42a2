"""The solve with one tanh: its certificate, and its result against a solution in ball arithmetic."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from flint import arb

from pbcgen.control.hyperbolic import fast_tanh
from pbcgen.control.law import Start
from pbcgen.control.step import solve_scalar
from pbcgen.control.taylor import TOLERANCE, certified_error, taylor_solve

MUS = [4.8e-5, 1.1e-3, 0.0132, 0.136, 0.5, 1.0, 3.0, 10.0, 90.75, 700.0]


def curve(mu: float, count: int = 4000):
    """(r, t) on the solution curve, from tiny to saturated."""
    s = np.concatenate([np.geomspace(1e-6, 0.1, 300), np.linspace(0.1, 25, count)])
    t = np.array([float(arb(float(v)).tanh()) for v in s])
    return (s + mu * t), t


@pytest.mark.parametrize("mu", MUS)
def test_float_results_are_as_close_as_certified(mu):
    exact_mu = Fraction(float(np.float32(mu)))
    solve = taylor_solve(exact_mu)
    assert solve is not None
    assert solve.error_bound <= TOLERANCE
    r, t = curve(float(exact_mu))
    c = r.astype(np.float32)
    found = solve_scalar(np.float32(mu), np.concatenate([c, -c]), 0, fast_tanh, solve)
    # rounding: that of tanh (6 ulp), and of c, which moves t by at most its relative rounding times |t'| c <= 1
    assert np.max(np.abs(found[: len(c)] - t)) <= solve.error_bound + 6e-7
    np.testing.assert_array_equal(found[len(c) :], -found[: len(c)])
    small = t < 1e-3
    assert np.max(np.abs(found[: len(c)][small] / t[small] - 1)) <= 2e-6


@pytest.mark.parametrize("mu", MUS)
def test_every_finite_c_has_a_result_of_at_most_one(mu):
    mu = np.float32(mu)
    solve = taylor_solve(Fraction(float(mu)))
    c = np.frombuffer(np.random.default_rng(3).bytes(200_000), np.float32)
    c = np.append(c[np.isfinite(c)], np.finfo(np.float32).max)
    with np.errstate(all="ignore"):
        t = solve_scalar(mu, c, 0, fast_tanh, solve)
    assert np.isfinite(t).all()
    assert (np.abs(t) <= 1 + 2**-22).all()
    assert (t[np.abs(c) > mu + 20] == np.sign(c[np.abs(c) > mu + 20])).all()


def test_what_is_not_finite_stays_visible():
    solve = taylor_solve(Fraction(90))
    with np.errstate(all="ignore"):
        t = solve_scalar(np.float32(90), np.array([np.inf, -np.inf, np.nan], np.float32), 0, fast_tanh, solve)
    assert np.isnan(t).all()


def test_the_certificate_refuses_a_bad_start():
    mu = Fraction(90)
    solve = taylor_solve(mu)
    first, *others = solve.start.low
    assert certified_error(mu, replace(solve.start, low=(first * 1.1, *others)), solve.order) > TOLERANCE
    assert certified_error(mu, Start((1 / 91,), (), (90.0,)), 4) > TOLERANCE
    assert certified_error(mu, solve.start, 2) > TOLERANCE


def test_extreme_mu_is_left_to_newton():
    assert taylor_solve(Fraction(0)) is None
    assert taylor_solve(Fraction(10**6)) is None
