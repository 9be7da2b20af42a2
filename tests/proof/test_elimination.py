"""Matrices of functions: conditions for definiteness, and numbers such as cos(1/2) among the coefficients."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from pbcgen.proof.elimination import definite, is_regular, positivity_conditions, semidefinite
from pbcgen.proof.nonnegative import nonnegative, positive
from pbcgen.symbolic.field import Field

NAMES = ("a", "b", "c")
POSITIVE = frozenset(range(3))


def _value(function, point):
    """A polynomial or quotient of a field without atoms at a point."""

    def polynomial(p):
        return sum(float(c) * np.prod([point[k] ** int(e) for k, e in enumerate(es)]) for es, c in p.to_dict().items())

    return polynomial(function.numerator) / polynomial(function.denominator)


def _random_matrix(seed):
    """Symmetric, of small polynomials in three positive symbols, with a heavier diagonal."""
    generator = np.random.default_rng(seed)
    field = Field(NAMES, 4)
    a, b, c = (field.exp(field.symbol(k)) for k in range(3))
    choices = [field.const(0), a, b, c, a * b, a - b, field.const(1), a + c]
    size = int(generator.integers(2, 5))
    M = [[field.const(0)] * size for _ in range(size)]
    for i in range(size):
        for j in range(i + 1):
            entry = choices[generator.integers(len(choices))]
            M[i][j] = M[j][i] = entry if i != j else entry + choices[1 + generator.integers(4)] + field.const(2)
    return field, M


@pytest.mark.parametrize("seed", range(36))
def test_conditions_are_positive_just_where_the_matrix_is_definite(seed):
    field, M = _random_matrix(seed)
    conditions = positivity_conditions(M)
    assert definite(M) is (not conditions)
    generator = np.random.default_rng(seed)
    atoms = [next(k for k, a in field.atoms.items() if a.argument == field.symbol(s)) for s in range(3)]
    for _ in range(40):
        point = np.zeros(field.symbol_count + field.pool)
        point[atoms] = 10 ** generator.uniform(-2, 2, size=3)
        values = np.array([[_value(entry, point) for entry in row] for row in M])
        scale = 1 / np.sqrt(np.abs(np.diag(values)))
        least = np.linalg.eigvalsh(values * np.outer(scale, scale))[0]
        if abs(least) < 1e-9:
            continue
        assert all(_value(c, point) > 0 for c in conditions) == (least > 0)


@pytest.mark.parametrize("seed", range(20))
def test_a_matrix_that_is_proved_semidefinite_is_so_at_samples(seed):
    field, M = _random_matrix(seed + 1000)
    if not semidefinite(M):
        return
    atoms = [next(k for k, a in field.atoms.items() if a.argument == field.symbol(s)) for s in range(3)]
    generator = np.random.default_rng(seed)
    for _ in range(40):
        point = np.zeros(field.symbol_count + field.pool)
        point[atoms] = 10 ** generator.uniform(-2, 2, size=3)
        values = np.array([[_value(entry, point) for entry in row] for row in M])
        assert np.linalg.eigvalsh(values)[0] >= -1e-9 * np.max(np.abs(values))


COS_HALF = "0.87758256189037271611628158260383"


@pytest.mark.parametrize(
    ("shift", "expected"), [("-1e-12", True), ("1e-12", False), ("1e-20", False), ("-1e-20", None)]
)
def test_a_number_such_as_the_cosine_of_a_half_is_enclosed(shift, expected):
    """a cos(1/2) - r a is positive for r below the cosine: close to it that may stay open."""
    field = Field(["s"], 8)
    a = field.exp(field.symbol(0))
    cosine = field.cos(field.const(Fraction(1, 2)))
    value = a * cosine - a * field.const(Fraction(COS_HALF) + Fraction(shift))
    proved = positive(value), nonnegative(value)
    assert expected is None or proved == (expected, expected)
    assert not positive(-value) or expected is False


def test_a_negative_number_is_not_taken_for_a_positive_one():
    field = Field(["s"], 8)
    a, x = field.exp(field.symbol(0)), field.symbol(0)
    cosine = field.cos(field.const(2))  # -0.416
    assert not nonnegative(a * cosine)
    assert positive(-(a * cosine))
    assert positive(a + a * cosine)
    assert not positive(a + field.const(3) * a * cosine)
    assert not nonnegative(x * cosine)
    assert not nonnegative(-(x * cosine))


@pytest.mark.parametrize("weight", ["1.9", "1.999999", "2", "2.000001", "2.1"])
def test_a_negative_product_of_positive_symbols_between_their_squares(weight):
    """c^2 - w c e + e^2 + d is nonnegative for w <= 2, whatever else stands beside."""
    field = Field(["c", "e", "d"], 8)
    c, e, d = (field.exp(field.symbol(k)) for k in range(3))
    value = c * c - field.const(Fraction(weight)) * c * e + e * e + d
    assert nonnegative(value) is (Fraction(weight) <= 2)
    assert nonnegative(value * d) is (Fraction(weight) <= 2)


def test_a_product_of_positive_factors_is_positive_although_its_terms_have_both_signs():
    """(c^2 - c e + e^2) (c^2 - d c + d^2 + e) has a sign by its factors; with a factor c - d it has none."""
    field = Field(["c", "e", "d"], 8)
    c, e, d = (field.exp(field.symbol(k)) for k in range(3))
    value = (c * c - c * e + e * e) * (c * c - d * c + d * d + e)
    assert positive(value)
    assert positive(-(value * -(e + d)))
    assert not positive(-value)
    assert not positive(value * (c - d))
    assert not positive(value * (c - d) * (c - d))  # zero at c = d
    assert nonnegative(value * (c - d) * (c - d))


def _coupled(size, heavy, coupling):
    """A tridiagonal matrix with ``coupling cos(a - b)`` beside its diagonal."""
    field = Field(NAMES, 8)
    between = field.cos(field.symbol(0) - field.symbol(1)) * field.const(coupling)
    zero = field.const(0)
    return [
        [field.const(heavy) if i == j else between if abs(i - j) == 1 else zero for j in range(size)]
        for i in range(size)
    ]


def test_a_matrix_with_a_dominant_diagonal_is_definite_and_one_that_touches_zero_is_not():
    assert definite(_coupled(12, 2, Fraction(99, 100)))
    assert not definite(_coupled(2, 1, 1))
    assert not definite(_coupled(3, 1, 1))
    assert not definite(_coupled(4, 2, Fraction(3, 2)))
    assert not definite(_coupled(2, -2, Fraction(1, 2)))


@pytest.mark.parametrize("seed", range(40))
def test_a_matrix_of_numbers_is_regular_where_its_determinant_is_not_zero(seed):
    generator = np.random.default_rng(seed)
    size = int(generator.integers(1, 7))
    numbers = generator.integers(-1, 2, (size, size))
    field = Field(NAMES)
    matrix = [[field.const(int(v)) for v in row] for row in numbers]
    assert is_regular(matrix) == (round(np.linalg.det(numbers)) != 0)


def test_functions_are_pivots_where_they_vanish_nowhere():
    field = Field(NAMES, 8)
    a, b = field.symbol(0), field.symbol(1)
    one, zero, e = field.const(1), field.const(0), field.exp(a)
    assert is_regular([[zero, one], [-one, -(a * a)]])
    assert is_regular([[a, e, zero], [-e, b, zero], [one, a, a * a + one]]) is False  # a b + exp(2a) may be zero
    assert is_regular([[zero, e, zero], [-e, b, zero], [one, a, a * a + one]])
    assert not is_regular([[a, zero], [zero, one]])
    assert not is_regular([[one, a], [a, one]])
    assert is_regular([[one, a], [-a, one]])
    assert not is_regular([[one, one, a], [one, one, a], [zero, a, one]])
    assert is_regular([{1: one}, {0: e}])
    assert not is_regular([{0: one}, {}])
