"""Definiteness is decided at the margin, whatever the scaling; semidefinite is not definite."""

from fractions import Fraction

import numpy as np
import pytest
from flint import arb, fmpq
from hypothesis import given, settings
from hypothesis import strategies as st

from pbcgen.proof.claim import Status
from pbcgen.proof.definite import eigenvalues, positive_definite, positive_semidefinite
from pbcgen.symbolic.real import precision, rational, sign
from pbcgen.symbolic.real_matrices import quadratic_form

MARGIN = Fraction(1, 10**6)
PROVED, REFUTED, UNDECIDED = Status.PROVED, Status.REFUTED, Status.UNDECIDED


def _matrix(rows):
    return [[rational(Fraction(v)) for v in row] for row in rows]


def _balls(rows, bits=333):
    with precision(bits):
        return [[arb(rational(Fraction(v)), arb(2) ** -300) for v in row] for row in rows]


def _congruent(diagonal, factor):
    """L diag(d) L^T for a unit lower triangular integer L: its signs are those of d, whatever its entries."""
    n = len(diagonal)
    return [[sum(factor[i][k] * diagonal[k] * factor[j][k] for k in range(n)) for j in range(n)] for i in range(n)]


@pytest.mark.parametrize("scale", [Fraction(1, 10**3), Fraction(1), Fraction(10**6), Fraction(10**13)])
@pytest.mark.parametrize("make", [_matrix, _balls])
def test_a_relative_margin_of_1e_6_on_either_side_is_seen(scale, make):
    """[[1, c], [c, 1]] scaled by (1, s): definite iff c^2 < 1."""
    for c, expected in ((1 - MARGIN, PROVED), (1 + MARGIN, REFUTED)):
        verdict = positive_definite(make([[1, c * scale], [c * scale, scale**2]]))
        assert verdict.status is expected


@pytest.mark.parametrize("make", [_matrix, _balls])
def test_entries_from_1e_minus_3_to_1e13_do_not_confuse_the_elimination(make):
    """A soft spring s in series with a stiff one S against an unstable one: definite iff s S / (s + S) exceeds it."""
    stiff, soft = Fraction(10) ** 13, Fraction(1, 10**3)
    series = stiff * soft / (stiff + soft)
    for unstable, expected in ((series * (1 - MARGIN), PROVED), (series * (1 + MARGIN), REFUTED)):
        rows = [[soft + stiff, -stiff, 0], [-stiff, stiff - unstable, 0], [0, 0, soft]]
        assert positive_definite(make(rows)).status is expected


def test_semidefinite_is_not_definite():
    singular = [[1, 2], [2, 4]]
    assert positive_definite(_matrix(singular)).status is REFUTED
    assert positive_semidefinite(_matrix(singular)).status is PROVED
    assert positive_definite(_matrix([[0]])).status is REFUTED
    assert positive_semidefinite(_matrix([[0]])).status is PROVED


def test_a_singular_matrix_known_by_balls_only_is_left_open():
    """The true matrix may lie on either side."""
    assert positive_definite(_balls([[1, 2], [2, 4]])).status is UNDECIDED
    assert positive_semidefinite(_balls([[1, 2], [2, 4]])).status is UNDECIDED


def test_a_zero_on_the_diagonal_needs_a_zero_row():
    assert positive_semidefinite(_matrix([[0, 1], [1, 5]])).status is REFUTED
    assert positive_semidefinite(_matrix([[0, 0], [0, 5]])).status is PROVED
    assert positive_semidefinite(_matrix([[5, 0, 0], [0, 0, 1], [0, 1, 0]])).status is REFUTED


def test_a_zero_on_the_diagonal_with_a_row_that_may_not_be_zero_is_left_open():
    with precision(333):
        near, below = arb(0, arb(2) ** -300), arb(2) ** -200
    assert positive_semidefinite([[fmpq(0), near], [near, fmpq(0)]]).status is UNDECIDED
    assert positive_semidefinite([[fmpq(0), near], [near, fmpq(5)]]).status is UNDECIDED
    assert positive_semidefinite([[near, fmpq(0)], [fmpq(0), fmpq(5)]]).status is UNDECIDED
    assert positive_semidefinite([[fmpq(0), below], [below, fmpq(0)]]).status is REFUTED
    assert positive_semidefinite([[fmpq(0), -below], [-below, fmpq(0)]]).status is REFUTED


def test_what_is_not_finite_is_left_open():
    nan = [[fmpq(1), arb.nan()], [arb.nan(), fmpq(1)]]
    assert positive_definite(nan).status is UNDECIDED
    assert positive_semidefinite(nan).status is UNDECIDED
    assert positive_semidefinite([[arb.nan()]]).status is UNDECIDED


def test_the_empty_matrix_is_definite():
    assert positive_definite([]).status is PROVED
    assert eigenvalues([]) == []


_entries = st.integers(-5, 5)


@st.composite
def _signed(draw):
    """(matrix, signs of its eigenvalues): a congruence of a diagonal with entries of any size and sign."""
    n = draw(st.integers(1, 5))
    diagonal = [
        Fraction(draw(st.sampled_from([-1, 0, 1, 1, 1, 1]))) * Fraction(10) ** draw(st.integers(-3, 13))
        for _ in range(n)
    ]
    factor = [[draw(_entries) if j < i else int(i == j) for j in range(n)] for i in range(n)]
    order = draw(st.permutations(range(n)))
    rows = _congruent(diagonal, factor)
    return [[rows[i][j] for j in order] for i in order], diagonal


@settings(max_examples=150, deadline=None)
@given(_signed())
def test_the_verdict_is_that_of_the_inertia(case):
    rows, diagonal = case
    definite, semidefinite = positive_definite(_matrix(rows)), positive_semidefinite(_matrix(rows))
    assert definite.status is (PROVED if min(diagonal) > 0 else REFUTED)
    assert semidefinite.status is (PROVED if min(diagonal) >= 0 else REFUTED)


@settings(max_examples=150, deadline=None)
@given(_signed())
def test_a_refutation_comes_with_a_vector_that_refutes(case):
    rows, _ = case
    for verdict, bad in ((positive_definite(_matrix(rows)), (0, -1)), (positive_semidefinite(_matrix(rows)), (-1,))):
        if verdict.status is REFUTED:
            assert any(verdict.witness)
            assert sign(quadratic_form(_matrix(rows), verdict.witness)) in bad


@settings(max_examples=100, deadline=None)
@given(_signed())
def test_balls_say_nothing_that_rationals_contradict(case):
    rows, _ = case
    for decide in (positive_definite, positive_semidefinite):
        exact, enclosed = decide(_matrix(rows)).status, decide(_balls(rows)).status
        assert enclosed in (exact, UNDECIDED)


def test_the_eigenvalues_for_display_are_ordered_and_right():
    rows = [[2, 1, 0], [1, 3, 1], [0, 1, 4]]
    np.testing.assert_allclose(eigenvalues(_matrix(rows)), np.linalg.eigvalsh(np.array(rows, float)), rtol=1e-12)
