"""x* as the only rest in a box that bounded forces and stiff gains make: proved, and never where there is another."""

from __future__ import annotations

import random
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen import Design, DynamicExtension, Mechanical, check
from pbcgen.control.rest_box import _bounded_by
from pbcgen.proof.alone import only_zero
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.real import BITS, REAL, ZERO, precision, rational
from pbcgen.symbolic.tape import Tape


def _global(system, target, law, **options):
    report = check(Design(system, target, law, sample_period="1e-3", **options))
    return next(c for c in report.claims if c.claim == "globally-asymptotically-stable")


def _pendulum(V):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    return Mechanical([q], [p], M=[[1]], V=V(q), D=[1], G=[[1]])


@pytest.mark.parametrize(
    ("V", "target"),
    [
        (lambda q: 2 * (1 - ca.cos(q)), "0.4"),
        (lambda q: 2 * (1 - ca.cos(q)) + q**2 / 2, "0.4"),
        (lambda q: q**4 / 4 - q**2 / 2, "1.5"),
    ],
)
def test_a_stiff_law_leaves_one_rest(V, target):
    claim = _global(_pendulum(V), {"q": target}, DynamicExtension(30, 2, 50, 1))
    assert claim.status == "PROVED"
    assert "x* is alone" in claim.evidence


def test_gravity_behind_a_spring_leaves_one_rest():
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    V = 15 * (q[0] - q[1]) ** 2 - ca.cos(q[0])
    system = Mechanical(q, p, M=[1, 1], V=V, D=[0, 1], G=[[0], [1]])
    law = DynamicExtension(20, 3, 30, 1)
    assert _global(system, {"q_0": "0.3"}, law, near={"q_1": 0}).status == "PROVED"


def test_two_joints_with_gravity_leave_one_rest():
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    V = -3 * ca.cos(q[0]) - ca.cos(q[0] + q[1])
    system = Mechanical(q, p, M=[2, 1], V=V, D=[1, 1], G=[[1, 0], [0, 1]])
    law = DynamicExtension([30, 20], [3, 3], [60, 60], [1, 1])
    assert _global(system, {"q_0": "0.3", "q_1": "0.2"}, law).status == "PROVED"


@pytest.mark.parametrize("seed", range(16))
def test_nothing_is_proved_where_a_scan_finds_another_rest(seed):
    draw = random.Random(seed)
    alpha, beta, K = (Fraction(draw.randint(lo, hi), 10) for lo, hi in ((21, 80), (2, 40), (5, 400)))
    claim = _global(_pendulum(lambda q: 2 * (1 - ca.cos(q))), {"q": "0.4"}, DynamicExtension(alpha, beta, K, 1))
    q = np.linspace(-60, 60, 480_001)
    w = 2 * (np.sin(q) - np.sin(0.4))
    rest = w + float(alpha) * np.tanh(float(beta) * (q - 0.4 + w / float(K)))
    rests = np.count_nonzero(np.diff(np.sign(rest)))
    assert claim.status != ("REFUTED" if rests == 1 else "PROVED")


def _system(function):
    x = ca.SX.sym("x", 2)
    value = function(x)
    tape = Tape.of([x], [value, ca.densify(ca.jacobian(value, x))])

    def system(z):
        found, slopes = (matrix.dense(ZERO) for matrix in tape.walk(REAL, [z]))
        return [row[0] for row in found], slopes

    return system


@pytest.mark.parametrize(
    ("function", "alone"),
    [
        (lambda x: ca.vertcat(x[0] + ca.sin(x[1]) / 2, x[1] - x[0] / 3), True),
        (lambda x: ca.vertcat(x[0] + x[0] ** 3 + x[1], x[1] + x[1] ** 3 - x[0]), True),
        (lambda x: ca.vertcat(x[0] ** 2 - x[0], x[1]), False),
        (lambda x: ca.vertcat(x[0] * (x[0] - 3) * (x[1] + 5), x[1]), False),
        (lambda x: ca.vertcat(ca.sin(3 * x[0]), x[1]), False),
        (lambda x: ca.vertcat(x[0] - x[1], x[0] - x[1]), False),
        (lambda x: ca.vertcat(x[0] ** 3, x[1]), False),
    ],
)
def test_a_zero_is_alone_or_not(function, alone):
    """The last one has no other zero, but its Jacobian is singular there: nothing is proved."""
    box = ((Fraction(-3), Fraction(4)), (Fraction(-2), Fraction(2)))
    with precision(BITS):
        assert only_zero(_system(function), [ZERO, ZERO], box, 600) == alone


@pytest.mark.parametrize(
    ("make", "bounded"),
    [
        (lambda a, b: a, True),
        (lambda a, b: 2 * a + 3 * ca.sin(a), True),
        (lambda a, b: a**3 - 5 * a + ca.cos(b), True),
        (lambda a, b: -(a**2) / 4 + 7 * a, True),
        (lambda a, b: a / (1 + a**2), False),
        (lambda a, b: (a**3 - a) / (1 + a**2), False),
        (lambda a, b: a + b, False),
        (lambda a, b: a * b, False),
        (lambda a, b: a * ca.sin(b), False),
        (lambda a, b: ca.tanh(a), False),
        (lambda a, b: a + ca.exp(b), False),
    ],
)
def test_a_function_that_is_known_to_a_reach_bounds_its_coordinate(make, bounded):
    """Beyond the bound the function is farther from its centre than the reach, wherever the others are."""
    names = ["a", "b"]
    x = ca.SX.sym("a", 2)
    value = make(*ca.vertsplit(x))
    field, (matrix,) = evaluate(Tape.of([x], [value]), names)
    found = _bounded_by(matrix.scalar(field.const(0)), rational(Fraction(1, 2)), Fraction(3), {})
    assert (found is not None) == bounded
    if found is not None:
        k, end = found
        assert k == 0
        numeric = ca.Function("f", [x], [value])
        for away in (1.0, 1.001, 2.0, 50.0):
            for side in (-1, 1):
                for other in np.linspace(-9, 9, 7):
                    assert abs(float(numeric([side * away * float(end), other])) - 0.5) >= 3 - 1e-9


def _cubic_joint(weight, beta=2):
    """A link that hangs (or stands, for a negative weight) on a spring that stiffens; the motor turns its other end."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    r = q[0] - q[1]
    V = -weight * ca.cos(q[0]) + 5 * r**2 + r**4
    system = Mechanical(q, p, M=[1, 1], V=V, D=[1, 1], G=[[0], [1]])
    return _global(system, {"q_0": "0.5"}, DynamicExtension(5, beta, 5, 1), near={"q_1": "0.5"})


def test_a_spring_that_stiffens_bounds_a_link_by_its_motor():
    assert _cubic_joint(-2).status == "PROVED"
    assert _cubic_joint(2).status == "PROVED"


@pytest.mark.parametrize(("weight", "beta"), [(2, "0.2"), (5, 2), (-5, 2)])
def test_a_soft_law_or_a_heavy_link_has_other_rests_beside_it(weight, beta):
    assert _cubic_joint(weight, beta).status != "PROVED"
