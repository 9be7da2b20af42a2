"""Sums of squares: found numerically, accepted only when they hold exactly."""

from __future__ import annotations

import random
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from flint import fmpq

from pbcgen.proof import sos
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.tape import Tape

pytest.importorskip("clarabel")

X = ca.SX.sym("x", 4)
A, B, C, D = ca.vertsplit(X)
NAMES = ("a", "b", "c", "d")


def _function(value):
    field, (matrix,) = evaluate(Tape.of([X], [ca.SX(value)]), NAMES)
    return matrix.scalar(field.const(0))


def _proved(value, **bounds):
    box = {NAMES.index(k): (Fraction(str(lo)), Fraction(str(hi))) for k, (lo, hi) in bounds.items()}
    return sos.sum_of_squares(_function(value), box) is not None


MOTZKIN = A**4 * B**2 + A**2 * B**4 + 1 - 3 * A**2 * B**2


@pytest.mark.parametrize(
    "value",
    [
        (A**2 - B) ** 2 + (C - A * B) ** 2,
        2 * A**4 + 2 * A**3 * B - A**2 * B**2 + 5 * B**4,
        MOTZKIN * (A**2 + B**2 + 1),
        ca.exp(2 * A) - ca.exp(A) + 1,
        ca.exp(A) * (B**2 - B * C + C**2),
        1 + ca.cos(A) - 0.5 * ca.sin(A) ** 2,
        (A - B) * (ca.tanh(A) - ca.tanh(B)) + (A - C) * (ca.tanh(A) - ca.tanh(C)),
        1e-8 * A**2 + 1e-3 * A * B + 1e3 * B**2 + (1e-4 * A**2 - B) ** 2,
    ],
)
def test_sums_of_squares_are_found(value):
    assert _proved(value)


def test_bounds_of_a_box_are_used():
    assert _proved(A * (1 - A), a=(0, 1))
    assert _proved(B**2 * (4 - A**2), a=(-2, 2))
    assert not _proved(B**2 * (4 - A**2), a=(-2, 2.001))


def test_a_quotient_has_the_sign_of_both_its_parts():
    assert _proved((A**2 + A * B + B**2) / (1 + C**2))
    assert _proved((A**2 + A * B + B**2) * (C - 1) / (C**3 - C**2 + C - 1))
    assert not _proved((A**2 + A * B + B**2) / (-1 - C**2))
    assert not _proved((A**2 + A * B + B**2) / (C**2 - 1))
    assert not _proved((A**2 + A * B + B**2) / C)
    assert _proved((A**2 + A * B + B**2) / C, c=(1, 2))
    assert not _proved((A**2 + A * B + B**2) / C, c=(-1, 2))


def test_a_nonnegative_polynomial_that_is_no_sum_of_squares_is_left_open():
    assert not _proved(MOTZKIN)


def test_three_hundred_perturbed_sums_of_squares():
    """A form with a random definite matrix, shifted so that it is definite, singular or indefinite."""
    generator = np.random.default_rng(3)
    z = ca.vertcat(A, B, C, A * B, A**2)
    counts = {True: 0, False: 0}
    for k in range(300):
        factor = generator.integers(-3, 4, size=(5, generator.integers(1, 5))).astype(float)
        gram = factor @ factor.T
        if k % 3:
            i, j = generator.integers(0, 5, size=2)
            gram[i, j] += generator.choice([-1.0, 1.0, 0.25, -1e-3])
        value = ca.mtimes(ca.mtimes(z.T, ca.DM(gram)), z)
        points = generator.normal(size=(4, 400)) * 10.0 ** generator.uniform(-2, 2, size=(1, 400))
        least = np.min(np.asarray(ca.Function("f", [X], [value]).map(400)(points)))
        found = _proved(value)
        counts[found] += 1
        assert not (found and least < -1e-9 * np.abs(gram).max())
    assert counts[True] > 100
    assert counts[False] > 60


def test_a_changed_digit_of_a_proof_does_not_hold():
    function = _function((A**2 - B) ** 2 + A * B + B**2 + C**2 + A**2)
    found = sos.find(function.field, function.numerator, {})
    assert found is not None
    assert found.holds(function.field)
    generator = random.Random(5)
    for _ in range(40):
        gram = generator.choice([g for g in found.grams if g])
        i, j = generator.randrange(len(gram)), generator.randrange(len(gram))
        kept = gram[i][j]
        gram[i][j] = kept + fmpq(1, 10**12)
        assert not found.holds(function.field)
        gram[i][j] = kept


def test_without_the_solver_nothing_is_tried(monkeypatch):
    monkeypatch.setattr(sos, "available", lambda: False)
    assert not _proved(2 * A**4 + 2 * A**3 * B - A**2 * B**2 + 5 * B**4)
    assert "not installed" in sos.squares_tried()


def test_coefficients_that_make_a_sum_of_squares_are_proposed():
    base, direction = _function(A**2 + B**2), _function(2 * A * B + A**3)
    found = sos.coefficients(base.field, base.numerator, [direction.numerator])
    assert found is not None
    assert abs(found[0]) < 1e-6


def _completed(base, *directions):
    field, (matrix,) = evaluate(Tape.of([X], [ca.vertcat(base, *directions)]), NAMES)
    first, *others = [value.numerator for value in matrix.column(field.const(0))]
    found = sos.completed(field, first, others, {})
    assert found is None or found[0].holds(field)
    return None if found is None else found[1]


def test_numbers_beside_the_squares_meet_their_equations_exactly():
    """a d has no d^2 beside it, so that its number is certain; that of a b may vary."""
    found = _completed(A**2 + 2 * B**2 - A * D / 3, A * D, A * B)
    assert found is not None
    assert found[0] == Fraction(1, 3)


def test_a_form_that_is_singular_for_every_number_is_completed():
    """(a - b)^2 + c (a - b) (d + a) + d^2: its value at a = b, d = 0 is zero, whatever c."""
    assert _completed((A - B) ** 2 + (A - B) * (D + A) / 7 + D**2, (A - B) * A) is not None


@pytest.mark.parametrize("value", [A * B, A**2 - B**2, -(A**2)])
def test_no_number_makes_squares_where_there_are_none(value):
    assert _completed(value, C**2 - D**2) is None
