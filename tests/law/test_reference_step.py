"""The solvers of the reference step against solutions in 50 digits."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pbcgen.law.law import VectorSolve
from pbcgen.law.step import solve_block, solve_scalar

DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64])


def exact_tanh(mu: float, c: float) -> mpmath.mpf:
    """tanh(s) of ``s + mu tanh(s) = c``, by bisection in 50 digits."""
    with mpmath.workdps(50):
        mu, r = mpmath.mpf(mu), abs(mpmath.mpf(c))
        low, high = max(r / (1 + mu), r - mu), r
        for _ in range(400):
            s = (low + high) / 2
            low, high = (s, high) if s + mu * mpmath.tanh(s) < r else (low, s)
        return mpmath.sign(c) * mpmath.tanh(low)


@DTYPES
def test_the_scalar_solve_is_accurate_for_every_size_of_c(dtype):
    limits = np.finfo(dtype)
    mus = [0, 1e-30, 1e-3, 0.5, 1, 7, 90, 1e4]
    small, large = [0, limits.smallest_subnormal, limits.tiny, 1e-9, 0.1, 1, 5, 20], [1e4, 1e4 + 3, 1e30, limits.max]
    pairs = np.array([(mu, c) for mu in mus for c in (*small, 89, 91, 95, 110, *large)], dtype)
    found = solve_scalar(pairs[:, 0], pairs[:, 1], 14)
    exact = np.array([float(exact_tanh(float(mu), float(c))) for mu, c in pairs])
    assert np.max(np.abs(found - exact)) <= 8 * limits.eps


@DTYPES
def test_the_scalar_solve_survives_the_largest_numbers(dtype):
    largest = np.finfo(dtype).max
    values = np.array([0, 1, 1e30, largest / 2, largest], dtype)
    mu, c = (grid.ravel() for grid in np.meshgrid(values, values))
    t = solve_scalar(mu, c, 14)
    assert np.isfinite(t).all()
    assert (np.abs(t) <= 1).all()


@DTYPES
@given(c=st.floats(-1e6, 1e6, width=32), mu=st.floats(0, 1e6, width=32), steps=st.integers(0, 8))
def test_the_scalar_solve_is_odd_and_bounded_after_any_number_of_steps(dtype, c, mu, steps):
    c, mu = np.array([c, -c], dtype), np.array([mu, mu], dtype)
    t = solve_scalar(mu, c, steps)
    assert t[0] == -t[1]
    assert np.abs(t[0]) <= 1
    assert t[0] * c[0] >= 0


def stiff_block(rng, batch: int, m: int, dtype):
    """Random N = P Lambda with entries up to 100 and condition up to 1000, and c."""
    Q = np.linalg.qr(rng.normal(size=(batch, m, m)))[0]
    stiffness = 10 ** rng.uniform(-3, 2, (batch, 1))
    P = np.einsum("bij,bj,bkj->bik", Q, stiffness * 1000 ** rng.uniform(-1, 0, (batch, m)), Q)
    N = P * 10 ** rng.uniform(-1, 0, (batch, 1, m))
    c = 10 ** rng.uniform(-3, 5, (batch, 1)) * rng.normal(size=(batch, m))
    return N.astype(dtype), c.astype(dtype)


@DTYPES
@pytest.mark.parametrize("m", [1, 2, 3, 6])
def test_fifteen_steps_solve_every_block_of_the_documented_range(dtype, m):
    N, c = stiff_block(np.random.default_rng(m), 2000, m, dtype)
    t, ok = solve_block(N, c, VectorSolve(tuple(range(m)), 15, 1e-5 if dtype is np.float32 else 1e-12))
    assert ok.all()
    assert (np.abs(t) <= 1).all()
    # where tanh is not saturated, s is known from t: the loop equation must hold
    s = np.arctanh(np.clip(t.astype(np.float64), -0.999, 0.999))
    residual = s + np.einsum("bij,bj->bi", N.astype(np.float64), t.astype(np.float64)) - c
    inside = np.all(np.abs(t) < 0.99, axis=1)
    assert inside.sum() > 100
    scale = 1 + np.abs(c).max(axis=1) + np.abs(N).sum(axis=2).max(axis=1)
    assert np.max(np.abs(residual[inside]) / scale[inside, None]) <= 200 * np.finfo(dtype).eps


@DTYPES
def test_a_block_of_one_is_the_scalar_solve(dtype):
    rng = np.random.default_rng(0)
    mu, c = (10 ** rng.uniform(-3, 4, 500)).astype(dtype), (10 ** rng.uniform(-3, 5, 500)).astype(dtype)
    t, ok = solve_block(mu[:, None, None], c[:, None], VectorSolve((0,), 20, 1e-5 if dtype is np.float32 else 1e-12))
    assert ok.all()
    np.testing.assert_allclose(t[:, 0], solve_scalar(mu, c, 14), atol=8 * np.finfo(dtype).eps)


@settings(max_examples=200, deadline=None)
@given(
    arrays(np.float32, (1, 3, 3), elements=st.floats(width=32, allow_nan=False, allow_infinity=False)),
    arrays(np.float32, (1, 3), elements=st.floats(width=32, allow_nan=False, allow_infinity=False)),
)
def test_a_block_of_any_numbers_ends_and_never_claims_more_than_it_has(N, c):
    with np.errstate(all="ignore"):
        t, ok = solve_block(N, c, VectorSolve((0, 1, 2), 5, 1e-5))
    assert ok.shape == (1,)
    assert (np.abs(t[ok]) <= 1).all()
