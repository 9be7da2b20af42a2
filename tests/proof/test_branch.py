"""Branch and bound: proofs on boxes, zeros taken out first, nothing proved that is false, no vacuous proofs."""

from __future__ import annotations

import random
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen.proof.branch import Budget, EmptyBoxError, Formula, OnBox, nonnegative_on_box, positive_on_box
from pbcgen.proof.claim import Status
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.tape import Tape

X = ca.SX.sym("x", 4)
A, B, C, D = ca.vertsplit(X)
NAMES = ("a", "b", "c", "d")


def _box(**bounds):
    return {NAMES.index(k): (Fraction(str(lo)), Fraction(str(hi))) for k, (lo, hi) in bounds.items()}


def _proved(value, budget=3000, **bounds):
    field, (matrix,) = evaluate(Tape.of([X], [ca.SX(value)]), NAMES)
    return OnBox(_box(**bounds), Budget(budget)).nonnegative(matrix.scalar(field.const(0)))


TRUE = {
    "touches zero at both ends": (A * (1 - A), {"a": (0, 1)}),
    "sine in its half turn": (A * ca.sin(A), {"a": (-3, 3)}),
    "damping of all angles": ((1.2 + ca.sin(3 * A) * ca.cos(B)) * C**2, {}),
    "inertia of all angles": ((2 + ca.cos(A)) * C**2 + 2 * (1 + ca.cos(A) / 2) * C * D + 1.2 * D**2, {}),
    "cubic friction": (C**2 * (1 + 0.5 * C - 0.2 * C**2), {"c": (-1, 1)}),
    "stiction": (0.1 * C**2 + (C - 0.2 * C**3) * ca.tanh(3 * C), {"c": (-2, 2)}),
    "exponential": (A * (ca.exp(A) - 1) + B**2 - 0.1 * A**2, {"a": (-1, 2), "b": (-1, 1)}),
    "velocity without bounds": (C**2 * (1 - A**2 / 5), {"a": (-2, 2)}),
}
FALSE = {
    "beyond the end": (A * (1 - A), {"a": (0, 1.001)}),
    "sine beyond": (A * ca.sin(A), {"a": (-3.2, 3.2)}),
    "damping": ((0.99 + ca.sin(A)) * C**2, {}),
    "inertia": ((2 + ca.cos(A)) * C**2 + 2 * (1 + ca.cos(A)) * C * D + 1.2 * D**2, {}),
    "velocity": (C**2 * (1 - A**2 / 3.99), {"a": (-2, 2)}),
    "constant": (ca.SX(-1), {"a": (0, 1)}),
}


@pytest.mark.parametrize("name", TRUE)
def test_what_holds_on_the_box_is_proved(name):
    value, bounds = TRUE[name]
    assert _proved(value, **bounds)


@pytest.mark.parametrize("name", FALSE)
def test_what_fails_on_the_box_is_not_proved(name):
    value, bounds = FALSE[name]
    assert not _proved(value, **bounds)


def test_two_hundred_broken_variants_are_not_proved():
    """A sign flipped, a term dropped, a coefficient changed: those that are negative somewhere must not pass."""
    generator = random.Random(7)
    terms = [
        lambda s: s * C**2,
        lambda s: s * C * ca.tanh(C),
        lambda s: s * (1 - A) * D**2,
        lambda s: s * A * C**2,
        lambda s: s * C * D,
        lambda s: s * (ca.exp(A) - 1) * D**2,
        lambda s: s * C**2 * ca.cos(A),
    ]
    samples = np.random.default_rng(0).uniform(size=(4, 3000)) * np.array([[1], [1], [4], [4]]) - [[0], [0], [2], [2]]
    bounds = {"a": (0, 1), "b": (0, 1), "c": (-2, 2), "d": (-2, 2)}
    proved = refuted = 0
    for _ in range(200):
        parts = generator.sample(terms, generator.randint(1, 4))
        value = sum((part(generator.choice([1, 1, 2, 0.5, -0.3])) for part in parts), ca.SX(0))
        least = float(np.min(np.asarray(ca.Function("f", [X], [value]).map(3000)(samples))))
        if _proved(value, budget=150, **bounds):
            proved += 1
            assert least >= -1e-12
        else:
            refuted += least < 0
    assert proved > 20
    assert refuted > 20


def test_an_empty_box_is_refused():
    formula = Formula(-1 - A**2, A)
    with pytest.raises(EmptyBoxError):
        positive_on_box(formula, ((Fraction(1), Fraction(0)),), Budget())
    with pytest.raises(EmptyBoxError):
        positive_on_box(formula, (), Budget())
    with pytest.raises(EmptyBoxError):
        OnBox({0: (Fraction(1), Fraction(0))})


def test_a_spent_budget_proves_nothing():
    proof = positive_on_box(Formula(1 + A**2, A), ((Fraction(-1), Fraction(1)),), Budget(0))
    assert proof.status is Status.UNDECIDED


@pytest.mark.parametrize(
    "value",
    [5 * (A < 1) - 1, ca.floor(A) + 0.5, ca.if_else(A < 1, 1.0, -1.0), ca.sign(A - 1.3), 1 / (A - 1.3), ca.sqrt(A - 2)],
    ids=["comparison", "floor", "if_else", "sign", "pole", "root"],
)
def test_jumps_and_poles_are_not_passed_over(value):
    """Slopes are zero on both sides of a jump; the value is not."""
    proof = nonnegative_on_box(Formula(value, A), ((Fraction(-1), Fraction(2)),), Budget(500))
    assert proof.status is not Status.PROVED


def test_a_negative_value_at_a_centre_is_a_counterexample():
    proof = positive_on_box(Formula(A**2 - Fraction(1, 2).__float__(), A), ((Fraction(-1), Fraction(1)),), Budget())
    assert proof.status is Status.REFUTED
    assert proof.point is not None
    assert proof.point[0] ** 2 < Fraction(1, 2)


def test_progress_is_reported():
    seen = []
    positive_on_box(
        Formula(A**4 * B**2 + A**2 * B**4 + 1.001 - 3 * A**2 * B**2, ca.vertcat(A, B)),
        ((Fraction(-2), Fraction(2)),) * 2,
        Budget(600, seen.append),
    )
    assert seen
