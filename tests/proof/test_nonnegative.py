"""Signs of exact functions: what holds is proved in many forms, and what does not hold never is.

The broken variants are checked against a counterexample that is found by sampling and evaluated in exact numbers or
balls, so that a proof of one of them is a certain defect of the prover.
"""

from __future__ import annotations

import random
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pbcgen.proof.elimination import definite, semidefinite
from pbcgen.proof.nonnegative import nonnegative, positive
from pbcgen.proof.spot import Spots
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.real import BITS, REAL, precision, rational, sign
from pbcgen.symbolic.tape import Tape

X = ca.SX.sym("x", 3)
A, B, C = ca.vertsplit(X)
NAMES = ("a", "b", "c")


@pytest.fixture(autouse=True)
def _by_the_rules_alone(monkeypatch):
    """No samples that say no before a rule is asked: what must be refused is refused by every rule."""
    monkeypatch.setattr(Spots, "shows_negative", lambda self, polynomial: False)


def _exact(expression):
    field, (result,) = evaluate(Tape.of([X], [ca.densify(ca.SX(expression))]), NAMES)
    return result.dense(field.const(0))


def _nonnegative(expression, positive_symbols=frozenset()):
    return nonnegative(_exact(expression)[0][0], positive_symbols)


def _positive(expression):
    return positive(_exact(expression)[0][0])


#: Nonnegative functions that the prover must know.
HOLD = {
    "square": (A - 2 * B) ** 2,
    "completed square": A**2 + A * B + B**2,
    "shifted square": A**2 - 2 * A + 1,
    "quartic": A**4 - 2 * A**2 * B + B**2 + C**2,
    "weights": 1e-7 * A**2 + 1e6 * B**2 - 2 * 0.3 * A * B,
    "touching": A**2 - 0.2 * A * B + 0.01 * B**2,
    "tanh": 8e-5 * ca.tanh(40 * A) * A,
    "tanh and square": A * ca.tanh(3 * A) + 2 * A**2 + B**2 - 2 * A * B,
    "arctangent": A * ca.atan(A) + ca.tanh(A) ** 2,
    "odd cube": A**3 * ca.tanh(A),
    "area hyperbolic sine": 5 * A * ca.asinh(2 * A),
    "error function": A * ca.erf(A / 2),
    "exponential": ca.exp(A) * B**2,
    "diode": 1e-7 * ca.exp(4 * A) * B**2 + 100 * C**2,
    "exponential square": (ca.exp(A) - ca.exp(B)) ** 2,
    "cosine": 1 - ca.cos(A) ** 2,
    "sine": 2 - ca.sin(A) ** 2 - ca.cos(A) ** 2,
    "weighted sine": 3 * ca.sin(A) ** 2 + 2 * ca.cos(A) ** 2,
    "rational": A**2 / (1 + B**2),
    "rational square": (A / (B - 1)) ** 2,
    "root": ca.sqrt(1 + A**2) * B**2,
    "root of a square": ca.sqrt(A**4 + 1) - 0 * A,
    "friction": A**2 / ca.sqrt(1 + A**2),
    "zero": A - A,
}

#: Functions with a negative value somewhere, close to one that has none.
FAIL = {
    "square": (A - 2 * B) ** 2 - 1e-9,
    "completed square": A**2 + 2.000001 * A * B + B**2,
    "shifted square": A**2 - 2.000001 * A + 1,
    "quartic": A**4 - 2.000001 * A**2 * B + B**2 + C**2,
    "missing square": A**2 + A * B,
    "odd": A**3,
    "touching": A**2 - 0.2000001 * A * B + 0.01 * B**2,
    "tanh": 8e-5 * ca.tanh(40 * A) * B,
    "tanh shifted": ca.tanh(A + 0.001) * A,
    "tanh of a square": ca.tanh(A**2) * A,
    "tanh against square": 2.000001 * A**2 - 2 * A * ca.tanh(A) - 1e-5 * A**2,
    "even tanh": A**2 * ca.tanh(A),
    "cosine": ca.cos(A) ** 2 - 1e-6,
    "cosine alone": 0.999999 + ca.cos(A),
    "sine and cosine": 1.4142 + ca.sin(A) + ca.cos(A),
    "weighted sine": 3 * ca.sin(A) ** 2 + 2 * ca.cos(A) ** 2 - 2.000001,
    "exponential": ca.exp(A) - 1,
    "exponentials": ca.exp(2 * A) - 2.000001 * ca.exp(A) * ca.exp(B) + ca.exp(2 * B),
    "exponential and line": ca.exp(A) - 1 - 0.999999 * A,
    "rational": A**2 / (1 - B**2),
    "rational sign": (1 + A**2) / (B - 3),
    "root": ca.sqrt(1 + A**2) * B,
    "root against line": ca.sqrt(1 + A**2) - 1.000001 * A,
    "logarithm": ca.log(1 + A**2) - 1e-9,
    "logarithm of a positive number": ca.log(A) * (A - 1.001),
    "tanh in place of an exponential": A * (ca.tanh(A) - 1),
    "arctangent in place of an exponential": (ca.atan(A) - 1) * A * B**2,
    "sines of increasing angles": (ca.sin(A) - ca.sin(B)) * (A - B),
    "squares of tanh": (ca.tanh(A) ** 2 - ca.tanh(B) ** 2) * (A - B),
    "tanh with exchanged arguments": (ca.tanh(A) - ca.tanh(B)) * (B - A),
    "unlike functions that increase": (ca.tanh(A) - ca.atan(B)) * (A - B),
    "tanh of unlike arguments": (ca.tanh(A) - ca.tanh(2 * B)) * (A - B),
    "exponentials of unlike arguments": (ca.exp(A) - ca.exp(2 * B)) * (A - B),
    "a dominant row and no dominant column": 2 * ca.tanh(A) * A + 3 * ca.tanh(B) * A + 3 * ca.tanh(B) * B,
    "even power of an odd function": ca.tanh(A) * ca.atan(B),
    "negative square": -(A**2),
    "negative constant": ca.SX(-1e-12),
}


@pytest.mark.parametrize("name", HOLD)
def test_a_nonnegative_function_is_proved(name):
    assert _nonnegative(HOLD[name])


@pytest.mark.parametrize("name", FAIL)
def test_a_function_that_is_negative_somewhere_is_not_proved(name):
    assert not _nonnegative(FAIL[name])


@pytest.mark.parametrize("name", HOLD)
def test_the_negative_of_a_nonnegative_function_is_not_proved(name):
    if name != "zero":
        assert not _nonnegative(-HOLD[name])


@pytest.mark.parametrize("name", HOLD)
def test_a_nonnegative_function_stays_so_under_factors_that_are_positive(name):
    assert _nonnegative(HOLD[name] * ca.exp(C))
    assert _nonnegative(HOLD[name] * 3 / 7)
    assert not _nonnegative(HOLD[name] * C) or name == "zero"


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (1 + A**2, True),
        (A**2, False),
        (ca.exp(A), True),
        (ca.sqrt(A), False),
        (2 + ca.cos(A), None),
        (1 + ca.sin(A) ** 2, True),
        (ca.sin(A) ** 2, False),
        (1e-9 + A**2 - 2 * A * B + B**2, True),
        (A**2 - 2 * A * B + B**2, False),
        (1 / (1 + A**2), True),
        (1 / (1 - A**2), False),
        (ca.exp(A) - 1, False),
        (ca.SX(0), False),
        (ca.SX(-1), False),
        (ca.SX(1e-12), True),
    ],
)
def test_positive_is_more_than_nonnegative(expression, expected):
    found = _positive(expression)
    assert expected is None or found == expected


def test_symbols_may_be_declared_positive():
    assert not _nonnegative(A * B**2)
    assert _nonnegative(A * B**2, frozenset({0}))
    assert _nonnegative(A / (A + B), frozenset({0, 1}))
    assert not _nonnegative(A / (A + B), frozenset({0}))
    assert not _nonnegative(A - B, frozenset({0, 1}))


# --- generated forms ---------------------------------------------------------------------------------------------

_COEFFICIENTS = [Fraction(v) for v in ("1", "-1", "2", "-3", "1/2", "-7/4", "1e-3", "1000")]


def _atoms(rng):
    """Building blocks: linear forms, monomials and bounded or growing functions of them."""
    linear = sum((float(rng.choice(_COEFFICIENTS)) * s for s in rng.sample([A, B, C], rng.randint(1, 3))), ca.SX(0))
    return rng.choice(
        [linear, A * B, A**2, ca.tanh(2 * A), ca.sin(A), ca.cos(B), ca.exp(A), ca.exp(-B / 2), ca.atan(C), A, B, C]
    )


def _nonnegative_term(rng):
    """A term that is nowhere negative, by construction."""
    kind = rng.randint(0, 6)
    scale = float(abs(rng.choice(_COEFFICIENTS)))
    if kind <= 2:
        combination = sum((float(rng.choice(_COEFFICIENTS)) * _atoms(rng) for _ in range(rng.randint(1, 3))), ca.SX(0))
        return scale * combination**2
    argument = rng.choice([A, B, C])
    return (
        scale
        * {
            3: argument * ca.tanh(3 * argument),
            4: argument**3 * ca.atan(argument),
            5: ca.exp(argument) * rng.choice([A, B, C]) ** 2,
            6: (1 - ca.cos(argument) ** 2) * rng.choice([A, B, ca.SX(1)]) ** 2,
        }[kind]
    )


def _lowest(expression, seed, count=3000):
    """A sampled minimum, at points of several sizes and on the axes."""
    generator = np.random.default_rng(seed)
    points = generator.normal(size=(3, count)) * 10.0 ** generator.uniform(-3, 0.8, size=(1, count))
    points *= generator.integers(0, 2, size=(3, count)) | (generator.uniform(size=(1, count)) < 0.7)
    values = np.array(ca.Function("f", [X], [expression]).map(count)(points)).ravel()
    values = np.where(np.isfinite(values), values, np.inf)
    best = int(np.argmin(values))
    return [Fraction(float(v)) for v in points[:, best]]


def _is_certainly_negative(expression, point):
    with precision(BITS):
        value = Tape.of([X], [expression]).walk(REAL, [[rational(v) for v in point]])[0].scalar(rational(0))
    return sign(value) == -1


@pytest.mark.parametrize("seed", range(150))
def test_a_broken_sum_of_nonnegative_terms_is_not_proved(seed):
    """A term is dropped, changes its sign or loses a part: where a sample is negative, no proof may exist."""
    rng = random.Random(seed)
    terms = [_nonnegative_term(rng) for _ in range(rng.randint(1, 3))]
    whole = sum(terms[1:], terms[0])
    broken = {
        "sign": whole - 2 * terms[-1],
        "sign of a part": whole - 1.000001 * terms[0],
        "less": whole - 1e-3 * _atoms(rng) ** 2,
        "cross term": whole + 2 * _atoms(rng) * _atoms(rng),
        "constant": whole - 1e-6,
        "line": whole + 1e-3 * rng.choice([A, B, C]),
        "product": whole * _atoms(rng),
    }
    for name, expression in broken.items():
        if _nonnegative(expression):
            assert not _is_certainly_negative(expression, _lowest(expression, seed)), name


@pytest.mark.parametrize("seed", range(60))
def test_a_sum_of_nonnegative_terms_has_no_certain_negative_value(seed):
    """The samples of the test above can be trusted: sound forms pass them."""
    rng = random.Random(1000 + seed)
    whole = sum((_nonnegative_term(rng) for _ in range(3)), ca.SX(0))
    assert not _is_certainly_negative(whole, _lowest(whole, seed))


@pytest.mark.parametrize("seed", range(60))
def test_sums_of_squares_of_linear_forms_are_always_proved(seed):
    rng = random.Random(seed)
    forms = [
        sum((float(rng.choice(_COEFFICIENTS)) * s for s in (A, B, C, ca.SX(1))), ca.SX(0))
        for _ in range(rng.randint(1, 4))
    ]
    assert _nonnegative(sum((f**2 for f in forms), ca.SX(0)))


@settings(max_examples=120, deadline=None)
@given(st.lists(st.integers(-6, 6), min_size=6, max_size=6), st.sampled_from([0, Fraction(1, 10**6)]))
def test_a_quadratic_form_is_decided_like_its_matrix(entries, margin):
    """For forms in the symbols the method is exact: proved iff the matrix is positive semidefinite."""
    a, b, c, d, e, f = entries
    expression = a * A**2 + b * B**2 + c * C**2 + 2 * d * A * B + 2 * e * A * C + 2 * f * B * C
    expression = expression - float(margin) * (A**2 + B**2 + C**2)
    matrix = np.array([[a, d, e], [d, b, f], [e, f, c]], float) - float(margin) * np.eye(3)
    smallest = np.linalg.eigvalsh(matrix)[0]
    if abs(smallest) > 1e-9:
        assert _nonnegative(expression) == (smallest > 0)


# --- matrices ----------------------------------------------------------------------------------------------------


def _semidefinite(rows):
    return semidefinite(_exact(ca.blockcat(rows)))


def _definite(rows):
    return definite(_exact(ca.blockcat(rows)))


def test_a_matrix_of_functions_with_damping_on_the_diagonal_is_semidefinite():
    assert _semidefinite([[0, 0, 0], [0, 1 + A**2, 0], [0, 0, ca.exp(B)]])
    assert not _semidefinite([[0, 1e-9, 0], [1e-9, 1 + A**2, 0], [0, 0, ca.exp(B)]])
    assert not _semidefinite([[0, 0, 0], [0, A, 0], [0, 0, 1]])


def test_an_inertia_matrix_is_definite_only_with_enough_mass():
    """The two-link arm: m11 m22 > (a cos)^2 + b."""
    for m22, expected in ((1.0, True), (0.05, False)):
        rows = [[2 + ca.cos(A), m22 + ca.cos(A) / 2], [m22 + ca.cos(A) / 2, m22]]
        smallest = min(np.linalg.eigvalsh(np.array(ca.Function("m", [X], [ca.blockcat(rows)])([t, 0, 0])))[0]
                       for t in np.linspace(-4, 4, 400))  # fmt: skip
        assert (smallest > 0) == expected
        assert not _definite(rows) or expected


def test_a_matrix_that_touches_zero_is_semidefinite_and_not_definite():
    rows = [[A**2 + 1, A], [A, 1 - 1 / (1 + A**2)]]
    assert not _definite(rows)
    touching = [[1, A], [A, A**2]]
    assert _semidefinite(touching)
    assert not _definite(touching)
    assert not _semidefinite([[1, A], [A, A**2 - 1e-9]])


def test_a_dominant_diagonal_exceeds_what_is_beside_it():
    c, d = ca.cos(A), ca.sin(B)
    assert _definite([[1.001, c], [c, 1.001]])
    assert _definite([[2.1, c, d], [c, 2, 0], [d, 0, 2]])
    for rows in (
        [[1, c], [c, 1]],
        [[2, c + d], [c + d, 2]],
        [[1, c, d], [c, 2, 0], [d, 0, 1]],
        [[1.5, 2 * c], [2 * c, 1.5]],
        [[0, 0], [0, 1]],
        [[-1, 0], [0, 1]],
        [[1, A], [A, 5]],
    ):
        assert not _definite(rows), rows


def test_the_empty_matrix_and_the_zero_matrix():
    assert semidefinite([])
    assert definite([])
    assert _semidefinite([[A - A, 0], [0, 0]])
    assert not _definite([[A - A]])


@pytest.mark.parametrize("seed", range(80))
def test_a_broken_gram_matrix_of_functions_is_not_proved(seed):
    """V^T V is semidefinite; with a sign flipped or a coefficient changed it is not, wherever a sample shows that."""
    rng = random.Random(seed)
    n = rng.randint(2, 3)
    V = ca.blockcat([[float(rng.choice(_COEFFICIENTS)) * _atoms(rng) for _ in range(n)] for _ in range(2)])
    gram = ca.mtimes(V.T, V)
    i, j = rng.randrange(n), rng.randrange(n)
    change = rng.choice([1e-3, 1e-6, 1.0])
    broken = ca.SX(gram)
    broken[i, j] = gram[i, j] * (1 - change) if i == j else gram[i, j] + change
    broken[j, i] = broken[i, j]
    if not semidefinite(_exact(broken)):
        return
    generator = np.random.default_rng(seed)
    function = ca.Function("m", [X], [broken])
    for _ in range(300):
        point = generator.normal(size=3) * 10.0 ** generator.uniform(-2, 0.5)
        value = np.array(function(point))
        scale = np.abs(value).max()
        assert not np.isfinite(scale) or np.linalg.eigvalsh(value)[0] > -1e-9 * (1e-6 + scale)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(-3, 3), min_size=9, max_size=9), st.sampled_from([Fraction(0), Fraction(-1, 10**6)]))
def test_a_constant_matrix_is_decided_exactly(entries, shift):
    V = np.array(entries, dtype=object).reshape(3, 3)
    gram = V.T.dot(V)
    rows = [[float(gram[i][j]) + (float(shift) if i == j else 0.0) for j in range(3)] for i in range(3)]
    smallest = np.linalg.eigvalsh(np.array(rows))[0]
    if shift == 0:
        assert _semidefinite(rows)
    elif smallest < -1e-9:
        assert not _semidefinite(rows)
    assert _definite(rows) == (smallest > 1e-9)


@pytest.mark.parametrize("height", [1.0, 0.999])
def test_a_bell_is_below_its_height(height):
    """Exponentials are taken apart into exp(v), exp(v^2) and numbers; their products are at most one."""
    assert _nonnegative(1 - height * ca.exp(-((A - 1.5) ** 2)))
    assert _nonnegative(1 - height * ca.exp(-((A - B) ** 2) - B**2) * ca.sin(A))


@pytest.mark.parametrize(
    "value",
    [
        1 - 1.001 * ca.exp(-((A - 1.5) ** 2)),
        1 - ca.exp((A - 1.5) ** 2),
        1 - ca.exp(-((A - B) ** 2) + B),
        1 - ca.exp(-((A - B) ** 2)) - ca.exp(-(B**2)) * ca.sin(A) / 1000,
        ca.exp(-(A**2)) - 1,
        1 - 2 * ca.exp(-A),
    ],
)
def test_what_a_bell_exceeds_is_not_proved(value):
    assert not _nonnegative(value)
