"""Assumption 1: proved, refuted by a checked point, or left open."""

from fractions import Fraction

import casadi as ca

from pbcgen import AffineSystem, Mechanical, Parameters
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.storage import assumption_1
from pbcgen.proof.claim import Status


def _system(f, S, g=(0, 1), **keywords):
    x, u = [ca.SX.sym("x"), ca.SX.sym("y")], [ca.SX.sym("u")]
    return Plant(AffineSystem(x, u, f(*x), list(g), S(*x), **keywords))


def _energy(x, y):
    return x**2 / 2 + y**2 / 2


def test_a_damped_oscillator_does_not_gain_storage():
    assert assumption_1(_system(lambda x, y: [y, -x - y], _energy)).proved


def test_negative_damping_is_refuted_with_a_state_where_the_storage_grows():
    claim = assumption_1(_system(lambda x, y: [y, -x + y], _energy)).claim
    assert claim.status is Status.REFUTED
    point = claim.counterexample["x"]
    assert Fraction(point["y"]) != 0


def test_negative_damping_on_a_part_of_the_space_is_not_proved():
    """Van der Pol: power y^2 (1 - x^2) is positive for abs(x) < 1."""
    assert assumption_1(_system(lambda x, y: [y, -x + (1 - x**2) * y], _energy)).claim.status is Status.REFUTED


def test_a_storage_with_a_wrong_sign_is_refuted():
    assert assumption_1(_system(lambda x, y: [y, -x - y], lambda x, y: x**2 / 2 - y**2 / 2)).claim.status is not (
        Status.PROVED
    )


def test_friction_of_known_sign_is_proved():
    f = lambda x, y: [y, -x - ca.tanh(3 * y) - y**3]  # noqa: E731
    assert assumption_1(_system(f, _energy)).proved


def test_friction_with_one_wrong_sign_is_not_proved():
    f = lambda x, y: [y, -x + ca.tanh(3 * y) - y**3]  # noqa: E731
    assert assumption_1(_system(f, _energy)).claim.status is Status.REFUTED


def test_an_assumption_that_needs_the_signs_of_exponentials_is_no_statement_about_the_dissipation_matrix():
    """f = -B grad S with B = [[1, 2], [2, 1]] indefinite; grad S = (exp x, exp y) has positive entries only."""
    storage = assumption_1(
        _system(
            lambda x, y: [-ca.exp(x) - 2 * ca.exp(y), -2 * ca.exp(x) - ca.exp(y)], lambda x, y: ca.exp(x) + ca.exp(y)
        )
    )
    assert storage.proved
    assert not storage.by_structure


def test_an_inertia_matrix_that_is_not_quite_symmetric_does_not_pass():
    """M_inv passes the sampled check of the front end; the power is of the order of the asymmetry, and positive."""
    q, p = [ca.SX.sym("q1"), ca.SX.sym("q2")], [ca.SX.sym("p1"), ca.SX.sym("p2")]
    c = ca.cos(q[0])
    k = Parameters(e="1e-10")
    M_inv = [[2, c], [c + k.e * ca.sin(q[0]), 2]]
    arm = Mechanical(q, p, M_inv=M_inv, V=q[0] ** 2 + q[1] ** 2, G=[[1, 0], [0, 1]], parameters=k)
    plant = Plant(arm.lower())
    assert not plant.gradient_is_exact
    assert assumption_1(plant).claim.status is Status.REFUTED


def test_the_gradient_of_the_front_end_is_used_when_it_is_exact():
    k = Parameters(k=3)
    q, p = [ca.SX.sym("q1"), ca.SX.sym("q2")], [ca.SX.sym("p1"), ca.SX.sym("p2")]
    c = ca.cos(q[0] - q[1])
    arm = Mechanical(q, p, M=[[2, c], [c, 2]], V=k.k * q[0] ** 2, D=[1, 1], G=[[1, 0], [0, 1]], parameters=k)
    plant = Plant(arm.lower())
    assert plant.gradient_is_exact
    assert assumption_1(plant).by_structure


def test_parameters_under_a_root_are_coefficients_like_others():
    """f and grad S contain sqrt(k), which is irrational at k = 2."""
    k = Parameters(k=2)
    w = ca.sqrt(k.k)
    storage = assumption_1(_system(lambda x, y: [y, -w * x - y], lambda x, y: w * x**2 / 2 + y**2 / 2, parameters=k))
    assert storage.by_structure


def test_a_dependence_with_irrational_coefficients_is_decided_or_left_open():
    """grad S has two entries that are multiples of each other by sqrt(2): F is not unique."""
    k = Parameters(k=2)
    w = ca.sqrt(k.k)
    storage = assumption_1(
        _system(lambda x, y: [-(x + w * y), -w * (x + w * y)], lambda x, y: (x + w * y) ** 2 / 2, parameters=k)
    )
    assert storage.claim.status is not Status.REFUTED
