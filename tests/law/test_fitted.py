"""The loop equation by fitted functions: their certificate, and their results against solutions in ball arithmetic."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from flint import arb

from pbcgen.law.fitted import TOLERANCE, certified_error, fitted, fitted_solve
from pbcgen.law.law import Fit

MUS = [4.8e-5, 1.1e-3, 0.0132, 0.03, 0.072, 0.136, 0.5, 1.0, 5.0, 10.0, 90.75, 200.0, 700.0, 2000.0]


def solved(mu: float) -> tuple[Fraction, Fit]:
    """The fit for a mu that is rounded to float."""
    exact = Fraction(float(np.float32(mu)))
    fit = fitted_solve(exact)
    assert fit is not None
    return exact, fit


def curve(mu: float, count: int = 4000):
    """(c, t) on the solution curve, from tiny to saturated."""
    s = np.concatenate([np.geomspace(1e-6, 0.1, 300), np.linspace(0.1, 25, count)])
    t = np.array([float(arb(float(v)).tanh()) for v in s])
    return (s + mu * t), t


@pytest.mark.parametrize("mu", MUS)
def test_float_results_are_as_close_as_certified(mu):
    exact, fit = solved(mu)
    assert fit.error_bound <= TOLERANCE
    exact_c, t = curve(float(exact))
    c = exact_c.astype(np.float32)
    with np.errstate(all="ignore"):
        found = fitted(fit, np.concatenate([c, -c]))
    # rounding: of P, Q and their quotient, and of c, which moves t by at most its relative rounding times |t'| c <= 1
    assert np.max(np.abs(found[: len(c)] - t)) <= fit.error_bound + 3e-7
    np.testing.assert_array_equal(found[len(c) :], -found[: len(c)])
    small = t < 1e-3
    assert np.max(np.abs(found[: len(c)][small] / t[small] - 1)) <= 2e-6


@pytest.mark.parametrize("mu", MUS)
def test_every_finite_c_has_a_result_of_at_most_one(mu):
    exact, fit = solved(mu)
    c = np.frombuffer(np.random.default_rng(3).bytes(200_000), np.float32)
    c = np.append(c[np.isfinite(c)], np.finfo(np.float32).max)
    with np.errstate(all="ignore"):
        t = fitted(fit, c)
    assert np.isfinite(t).all()
    assert (np.abs(t) <= 1).all()
    far = np.abs(c) > float(exact) + 20
    assert np.max(np.abs(t[far] - np.sign(c[far]))) <= TOLERANCE


@pytest.mark.parametrize("mu", [0.01, 90.0])
def test_what_is_not_finite_stays_visible(mu):
    with np.errstate(all="ignore"):
        t = fitted(solved(mu)[1], np.array([np.inf, -np.inf, np.nan], np.float32))
    assert np.isnan(t).all()


def test_the_certificate_refuses_a_bad_correction():
    mu, fit = solved(0.01)
    first, *others = fit.correction
    assert certified_error(mu, fit) <= TOLERANCE
    assert certified_error(mu, replace(fit, correction=(first * 1.001, *others))) > TOLERANCE
    assert certified_error(mu, replace(fit, correction=(first,))) > TOLERANCE
    assert certified_error(mu * 2, fit) > TOLERANCE


@pytest.mark.parametrize("which", [0, 1])
def test_the_certificate_refuses_bad_pieces(which):
    mu, fit = solved(90)

    def changed(**values: object) -> Fit:
        pieces = list(fit.pieces)
        pieces[which] = replace(pieces[which], **values)
        return replace(fit, pieces=tuple(pieces))

    piece = fit.pieces[which]
    first, *others = piece.numerator
    assert certified_error(mu, fit) <= TOLERANCE
    assert certified_error(mu, changed(numerator=(first * (1 + 1e-6), *others))) > TOLERANCE
    assert certified_error(mu, changed(length=piece.length * 1.5)) > TOLERANCE
    assert certified_error(mu, changed(length=piece.length * 0.5)) > TOLERANCE
    assert certified_error(mu, changed(denominator=tuple(-v for v in piece.denominator))) > TOLERANCE
    if which:
        assert certified_error(mu, changed(knot=piece.knot + 0.1)) > TOLERANCE


def test_extreme_mu_is_left_to_newton():
    assert fitted_solve(Fraction(0)) is None
    assert fitted_solve(Fraction(10**6)) is None
