"""The sampled loop as a function of its period: its slopes, cells of periods, and storages for all of them."""

from fractions import Fraction

import numpy as np
import pytest
from flint import arb, arb_mat
from scipy.linalg import expm

from pbcgen.proof.claim import Status
from pbcgen.sampling.jitter import _decreases, jitter
from pbcgen.sampling.scan import _begin, _cell, _neumann
from pbcgen.sampling.transition import LinearLoop, Transition
from pbcgen.symbolic.real import ball, enclose, precision, rational


def _random_loop(seed):
    """Two modes and a filter, stable in continuous time; the filter steps implicitly."""
    rng = np.random.default_rng(seed)
    numbers = [Fraction(int(v), 8) for v in rng.integers(1, 33, 5)]
    w, damping, gain, leak, stiff = (rational(v) for v in numbers)
    one, zero = rational(Fraction(1)), rational(Fraction(0))
    A = [[zero, one, zero], [-w * w, -damping / 8, one], [zero, zero, -one - damping]]
    B, H = [[zero], [one], [one / 2]], [[one, zero, one / 3]]
    return LinearLoop(A, B, H, [[-stiff]], [[-leak]], [[-2 * gain]], [[one / 4]])


def _integrator():
    """Two integrators in a row, which have one eigenvector, and a filter of two states with one eigenvector, too."""
    one, zero = rational(Fraction(1)), rational(Fraction(0))
    leak = [[-one, one], [zero, -one]]
    return LinearLoop(
        [[zero, one], [zero, zero]], [[zero], [one]], [[one, one]], [[one], [one / 2]], leak, [[-one]], [[one / 4, one]]
    )


def _stepped(loop, h, delay, steps):
    """One period in double precision: (x, xi, past inputs) by the matrix exponential and an implicit step."""
    A, B, H, r_m, r_xi, u_m, u_xi = (
        np.array([[float(ball(v).mid()) for v in row] for row in part]).reshape(len(part), -1)
        for part in (loop.A, loop.B, loop.H, loop.r_m, loop.r_xi, loop.u_m, loop.u_xi)
    )
    n, k, m = loop.sizes
    past = int(np.ceil(delay))
    E = np.linalg.inv(np.eye(k) - steps * r_xi)
    z = np.eye(n + k + past * m)
    x, xi, old = z[:n], z[n : n + k], [z[n + k + j * m : n + k + (j + 1) * m] for j in range(past)]
    new_xi = E @ (xi + steps * r_m @ H @ x)
    inputs = [u_m @ H @ x + u_xi @ new_xi, *old]
    whole, early = int(delay), (delay - int(delay)) * h
    for time, ago in [(early, past)] * (early > 0) + [(h - early, whole)]:
        hold = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * time)
        x = hold[:n, :n] @ x + hold[:n, n:] @ inputs[ago]
    return np.vstack([x, new_xi, *inputs[:past]])


@pytest.mark.parametrize("steps", [None, Fraction(1, 7)])
@pytest.mark.parametrize("delay", [Fraction(0), Fraction(1, 3), Fraction(1), Fraction(3, 2), Fraction(2)])
@pytest.mark.parametrize("make", [lambda: _random_loop(0), lambda: _random_loop(3), _integrator])
def test_a_transition_and_its_slopes_are_those_of_the_loop(make, delay, steps):
    loop, h, d = make(), Fraction(1, 5), Fraction(1, 10**6)
    with precision(200):
        transition = Transition(loop, delay, steps=steps)
        jet, beside = (transition.jet(ball(rational(t))) for t in (h, h + d))
        exact = np.array([[float(v.mid()) for v in row] for row in transition.real(jet).c0.tolist()])
        rest = beside.c0
        for part in (jet.c0, jet.c1, jet.c2):
            rest = (rest - part) * (1 / ball(rational(d)))
        slopes = [[abs(v) for v in row] for row in (rest - jet.c3).tolist()]
        sizes = [float(abs(v).mid()) for row in jet.c3.tolist() for v in row]
    np.testing.assert_allclose(exact, _stepped(loop, float(h), float(delay), float(steps or h)), rtol=1e-9, atol=1e-12)
    assert max(float(v.mid()) for row in slopes for v in row) <= 1e-3 * max(sizes) + 1e-20


def _radius(transition, h):
    M = transition.jet(ball(rational(h))).c0
    return max(float(v.abs_upper()) for v in M.eig(algorithm="approx"))


@pytest.mark.parametrize("delay", [Fraction(0), Fraction(1, 2), Fraction(1)])
@pytest.mark.parametrize("seed", [0, 1, 3, 4, 6, 7, 10])
def test_no_cell_holds_a_period_that_is_unstable(seed, delay):
    """Cells about the end of the stable periods, of all widths; those that end before it may hold."""
    with precision(128):
        transition = Transition(_random_loop(seed), delay)
        stable, unstable = Fraction(1, 1000), Fraction(1, 1000)
        while _radius(transition, unstable) < 1:
            stable, unstable = unstable, unstable * Fraction(9, 8)
        for _ in range(30):
            middle = ((stable + unstable) / 2).limit_denominator(10**12)
            stable, unstable = (middle, unstable) if _radius(transition, middle) < 1 else (stable, middle)
        for k in range(1, 12):
            width = unstable / 2**k
            for share in (Fraction(1, 100), Fraction(1, 2), Fraction(99, 100)):
                lo = unstable - width * share
                assert not _holds(transition, lo, lo + width), (k, share)
        assert _holds(transition, stable * Fraction(9, 10), stable * Fraction(901, 1000))
        if not delay:
            first = _begin(transition, Fraction(1000))
            assert first is None or 0 < first < unstable


def _holds(transition, lo, hi):
    centre, r = ball(rational((lo + hi) / 2)), arb(ball(rational((hi - lo) / 2)).upper())
    return _cell(transition, centre, r, enclose(lo, hi))


def test_a_geometric_series_of_matrices_is_bounded_where_it_converges():
    P = [[Fraction(1, 2), Fraction(1, 4)], [Fraction(1, 8), Fraction(1, 4)]]
    bound = _neumann(arb_mat([[ball(rational(v)) for v in row] for row in P]))
    truth = np.linalg.inv(np.eye(2) - np.array(P, dtype=float))
    assert all(truth[i, j] * (1 - 1e-9) <= float(bound[i, j].mid()) for i in range(2) for j in range(2))
    with pytest.raises(ZeroDivisionError):
        _neumann(arb_mat([[2, 0], [0, 0]]))
    with pytest.raises(ZeroDivisionError):  # the weights that solve for it are negative
        _neumann(arb_mat([[3, 0], [0, 0]]))


def test_a_loop_that_is_unstable_in_continuous_time_has_no_first_cell():
    loop = _random_loop(1)
    with precision(128):
        assert _begin(Transition(loop), Fraction(1)) is not None
        pushed = LinearLoop(loop.A, loop.B, loop.H, loop.r_m, loop.r_xi, [[rational(Fraction(100))]], loop.u_xi)
        assert _begin(Transition(pushed), Fraction(1)) is None


@pytest.mark.parametrize("seed", [0, 1, 6, 10])
def test_a_storage_that_grows_for_one_period_is_no_common_storage(seed):
    """Storages between the one that is found and others: where a sampled period makes one grow, none is proved."""
    loop, h, share = _random_loop(seed), Fraction(1, 20), Fraction(2, 5)
    found = jitter(loop, h, share)
    assert found.status is Status.PROVED
    rng = np.random.default_rng(seed)
    grown = 0
    with precision(128):
        transition = Transition(loop, steps=h)
        for scale in (0.0, 0.01, 0.1, 0.3, 1.0, 3.0):
            F = found.storage @ (np.eye(4) + scale * rng.normal(size=(4, 4)))
            for lo, hi in ((h * (1 - share), h * (1 + share)), (h, h * 40)):
                worst = max(_growth(transition, F, lo + (hi - lo) * k / 16) for k in range(17))
                proved = _decreases(transition, F, lo, hi)
                assert not (proved and worst > 1)
                grown += worst > 1
        assert _decreases(transition, found.storage, h * (1 - share), h * (1 + share))
    assert grown >= 4


def _growth(transition, F, h):
    """The largest ``|F M(h) z| / |F z|``."""
    M = transition.real(transition.jet(ball(rational(h)))).c0
    numbers = np.array([[float(v.mid()) for v in row] for row in M.tolist()])
    return np.linalg.norm(F @ numbers @ np.linalg.inv(F), 2)
