"""Hurwitz and Schur stability, up to the boundary and not beyond it."""

from fractions import Fraction
from itertools import pairwise
from random import Random

import numpy as np
import pytest
from flint import arb, fmpq, fmpq_mat
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pbcgen.proof.claim import Status
from pbcgen.proof.spectrum import approximate_eigenvalues, hurwitz, routh_column, schur, zero_order_hold
from pbcgen.symbolic.real import approximate, precision, rational

PROVED, REFUTED, UNDECIDED = Status.PROVED, Status.REFUTED, Status.UNDECIDED
MARGIN = Fraction(1, 10**9)


def _matrix(rows):
    return [[rational(Fraction(v)) for v in row] for row in rows]


def _balls(rows, radius=-250):
    with precision(333):
        return [[arb(rational(Fraction(v)), arb(2) ** radius) for v in row] for row in rows]


def _rotation(real, imaginary):
    return [[real, imaginary], [-imaginary, real]]


@pytest.mark.parametrize("make", [_matrix, _balls])
@pytest.mark.parametrize("fast", [1, 10**5, 10**12])
def test_a_slow_pair_beside_a_fast_mode_is_decided_at_the_margin(make, fast):
    for real, expected in ((-MARGIN, PROVED), (MARGIN, REFUTED)):
        rows = [[*_rotation(real, 1)[0], 7], [*_rotation(real, 1)[1], -3], [0, 0, -fast]]
        assert hurwitz(make(rows)).status is expected


@pytest.mark.parametrize("make", [_matrix, _balls])
def test_a_radius_is_decided_at_the_margin(make):
    for radius, expected in ((1 - MARGIN, PROVED), (1 + MARGIN, REFUTED)):
        rows = _rotation(radius * Fraction(3, 5), radius * Fraction(4, 5))
        assert schur(make(rows)).status is expected
        assert schur(make([[radius]])).status is expected
        assert schur(make([[-radius]])).status is expected


@pytest.mark.parametrize(
    "rows",
    [[[0]], _rotation(0, 1), [[-1, 0], [0, 0]], [[0, 1], [0, 0]], [[-1, 0, 0], [0, 0, 2], [0, -2, 0]]],
    ids=["integrator", "oscillator", "conserved", "double integrator", "hidden oscillator"],
)
@pytest.mark.parametrize("make", [_matrix, _balls])
def test_the_imaginary_axis_is_not_hurwitz(rows, make):
    assert hurwitz(make(rows)).status is not PROVED


@pytest.mark.parametrize(
    "rows",
    [[[1]], [[-1]], _rotation(Fraction(3, 5), Fraction(4, 5)), [[1, 1], [0, 1]], [[-1, 0], [0, Fraction(1, 2)]]],
    ids=["one", "minus one", "rotation", "drift", "alternating"],
)
@pytest.mark.parametrize("make", [_matrix, _balls])
def test_the_unit_circle_is_not_schur(rows, make):
    assert schur(make(rows)).status is not PROVED


@pytest.mark.parametrize("rows", [[[-1]], [[-1, 0], [0, Fraction(1, 2)]], [[-1, 0], [0, 0]]])
def test_an_eigenvalue_minus_one_that_is_only_enclosed_does_not_refute(rows):
    """The enclosed matrix may have its eigenvalue inside the unit circle."""
    assert schur(_balls(rows)).status is UNDECIDED


def test_numbers_that_are_not_finite_are_left_open():
    nan = [[arb.nan()]]
    assert hurwitz(nan).status is UNDECIDED
    assert schur(nan).status is UNDECIDED


@pytest.mark.parametrize("size", [3, 25])
@pytest.mark.parametrize(("decide", "centre"), [(hurwitz, -1), (schur, fmpq(1, 2))])
def test_entries_around_zero_are_not_taken_for_zero(size, decide, centre):
    """A loop between the first two states, of a gain that is known up to 100 only."""
    matrix = [[fmpq(centre) if i == j else fmpq(0) for j in range(size)] for i in range(size)]
    assert decide(matrix).status is Status.PROVED
    matrix[0][1] = matrix[1][0] = arb(0, 100)
    assert decide(matrix).status is Status.UNDECIDED
    matrix[0][1] = matrix[1][0] = arb(0, 0.1)
    assert decide(matrix).status is not Status.REFUTED


def test_the_empty_matrix_is_stable():
    assert hurwitz([]).status is PROVED
    assert schur([]).status is PROVED


def test_stable_eigenvalues_that_double_precision_gets_wrong_are_proved():
    """A companion-like triangular matrix with entries of very different size: the eigenvalues stand on the diagonal."""
    n = 8
    rows = [[-Fraction(k + 1, 100) if i == k else 10**6 * (i < k) for k in range(n)] for i in range(n)]
    shear = [[int(i == j) + 3 * (i == j + 1) for j in range(n)] for i in range(n)]
    back = [[int(i == j) if i <= j else (-3) ** (i - j) for j in range(n)] for i in range(n)]
    product = [[sum(shear[i][a] * rows[a][b] * back[b][j] for a in range(n) for b in range(n)) for j in range(n)]
               for i in range(n)]  # fmt: skip
    verdict = hurwitz(_matrix(product))
    assert verdict.status is PROVED
    assert verdict.extreme == pytest.approx(-0.01, rel=1e-6)


@st.composite
def _spectrum(draw):
    """A matrix of integers-similar form whose eigenvalues are chosen: blocks, then a unimodular similarity."""
    blocks = draw(
        st.lists(
            st.one_of(
                st.integers(-6, 2).map(lambda a: [[a]]),
                st.tuples(st.integers(-4, 1), st.integers(1, 5)).map(lambda p: _rotation(*p)),
            ),
            min_size=1,
            max_size=3,
        )
    )
    n = sum(len(b) for b in blocks)
    matrix = np.zeros((n, n), dtype=object)
    at = 0
    for block in blocks:
        for i, row in enumerate(block):
            for j, entry in enumerate(row):
                matrix[at + i, at + j] = Fraction(entry)
        at += len(block)
    for _ in range(draw(st.integers(0, 4))):
        if n == 1:
            break
        i, j = draw(st.permutations(range(n)))[:2]
        k = draw(st.integers(-3, 3))
        shear, back = np.eye(n, dtype=object), np.eye(n, dtype=object)
        shear[i, j], back[i, j] = k, -k
        matrix = shear.dot(matrix).dot(back)
    real = [block[0][0] for block in blocks]
    modulus = [abs(complex(block[0][0], block[0][1] if len(block) > 1 else 0)) for block in blocks]
    return matrix.tolist(), max(real), max(modulus)


@settings(max_examples=120, deadline=None)
@given(_spectrum())
def test_the_verdict_is_that_of_the_eigenvalues(case):
    rows, abscissa, _ = case
    status = hurwitz(_matrix(rows)).status
    assert (status is PROVED) == (abscissa < 0)
    if status is REFUTED:
        assert abscissa > 0


@settings(max_examples=120, deadline=None)
@given(_spectrum(), st.integers(1, 12))
def test_the_verdict_on_the_circle_is_that_of_the_moduli(case, divisor):
    rows, _, modulus = case
    status = schur(_matrix([[Fraction(v) / divisor for v in row] for row in rows])).status
    if modulus < divisor * (1 - 1e-12):
        assert status is PROVED
    elif modulus > divisor * (1 + 1e-12):
        assert status is not PROVED
    else:
        assert status is not PROVED


@settings(max_examples=60, deadline=None)
@given(_spectrum())
def test_balls_say_nothing_that_rationals_contradict(case):
    rows, _, _ = case
    for decide in (hurwitz, schur):
        exact, enclosed = decide(_matrix(rows)).status, decide(_balls(rows)).status
        assert enclosed in (exact, UNDECIDED) or exact is UNDECIDED


def test_the_routh_array_counts_right_half_plane_roots():
    """(s - 1)(s + 2)(s + 3) has one sign change; s^2 + 1 has a zero pivot."""
    signs = [v > 0 for v in routh_column([fmpq(c) for c in (-6, 1, 4, 1)])]
    assert sum(a != b for a, b in pairwise(signs)) == 1
    assert routh_column([fmpq(1), fmpq(0), fmpq(1)]) is None


def test_the_hold_is_the_matrix_exponential():
    A, B, h = [[0, 1], [-4, Fraction(-1, 2)]], [[0], [2]], Fraction(1, 5)
    with precision(200):
        Ad, Bd = zero_order_hold(_matrix(A), _matrix(B), rational(h))
    block = np.zeros((3, 3))
    block[:2, :2], block[:2, 2:] = np.array(A, float), np.array(B, float)
    expected = expm(block * float(h))
    np.testing.assert_allclose([[approximate(v) for v in row] for row in Ad], expected[:2, :2], rtol=1e-13)
    np.testing.assert_allclose([[approximate(v) for v in row] for row in Bd], expected[:2, 2:], rtol=1e-13)


def test_eigenvalues_for_display_come_largest_real_part_first():
    values = approximate_eigenvalues(_matrix([[-1, 0], [0, -2]]))
    assert [round(z.real, 9) for z in values] == [-1, -2]


def test_eigenvalues_for_display_are_right_where_some_coincide():
    """Three critically damped modes on top of each other, seen through random coordinates, and an oscillation."""
    modes = fmpq_mat(6, 6, [-20, 1, 0, 0, 0, 0] + [0, -20, 1, 0, 0, 0] + [0, 0, -20, 0, 0, 0] + [0] * 18)
    for (i, j), value in {(3, 3): -1, (3, 4): 3, (4, 3): -3, (4, 4): -1, (5, 5): -44}.items():
        modes[i, j] = value
    drawn = Random(4)
    turn = fmpq_mat(6, 6, [drawn.randint(-5, 5) for _ in range(36)])
    values = approximate_eigenvalues((turn * modes * turn.inv()).tolist())
    np.testing.assert_allclose([z.real for z in values], [-1, -1, -20, -20, -20, -44], atol=1e-9)
    assert sorted(round(z.imag, 9) for z in values) == [-3, 0, 0, 0, 0, 3]
