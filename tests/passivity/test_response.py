"""No gamma near x*, from the response of the linearised system; systems that have one are never refuted by it."""

from __future__ import annotations

import random
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension
from pbcgen.control.derive import derive
from pbcgen.passivity.equilibrium import complete
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.response import has_full_rank, negative_response
from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import rational


def _motor(target, k=1, beside=None, domain=None, bend=0):
    """A motor with a wound field, its currents and speed; its energy is lost in the windings at rest, too.

    ``beside`` is a further state that nothing moves; the storage may ``bend`` where the speed is 5.
    """
    field, armature, speed = x = [ca.SX.sym(name) for name in ("i_f", "i_a", "omega")]
    u = [ca.SX.sym("u_f"), ca.SX.sym("u_a")]
    f = [-field, -armature - k * field * speed, k * field * armature - speed / 10]
    more = [] if beside is None else [beside]
    g = [[1, 0], [0, 1], [0, 0], *[[0, 0] for _ in more]]
    S = ca.sumsqr(ca.vertcat(*x, *more)) / 2 + bend * (speed - 5) * ca.fabs(speed - 5)
    system = AffineSystem([*x, *more], u, [*f, *[0 for _ in more]], g, S, domain=domain)
    two = [1, 1]
    law = DynamicExtension(alpha=two, beta=two, R_c=two, K_c=two)
    return Design(system, target=target, law=law, sample_period="1e-3", name="motor")


def _found(design):
    plant = Plant(design.system)
    return plant, complete(plant, design).point


def test_a_motor_with_a_field_that_turns_has_no_output_for_its_energy():
    plant, point = _found(_motor({"i_f": 1, "omega": 5}))
    found = negative_response(plant, point)
    assert found is not None
    # The same in doubles, from what is written above: at rest i_a = 1/2, u = (1, 5.5).
    A = np.array([[-1, 0, 0], [-5, -1, -1], [0.5, 1, -0.1]])
    e, b = np.array([1, 0.5, 5]), np.array([1, 5.5, 0])
    value = e @ np.linalg.solve(A @ A + float(found.omega) ** 2 * np.eye(3), b)
    assert value < -0.01
    assert float(found.value.mid()) == pytest.approx(value, rel=1e-9)


def test_the_verdict_says_so_and_blames_no_gradient_of_a_candidate():
    claims = {claim.claim: claim for claim in derive(_motor({"i_f": 1, "omega": 5})).claims}
    assert claims["passive-output"].status is Status.REFUTED
    assert set(claims["passive-output"].counterexample) == {"rest", "omega", "e^T (A^2 + omega^2 I)^-1 g u"}
    assert claims["gradient-condition"].status is not Status.REFUTED
    assert claims["asymptotically-stable"].status is Status.PROVED  # by linearisation, for the candidate


def test_another_rest_shows_it_where_the_target_does_not():
    """A motor that stands: at x* the response is passive, and at speeds that other inputs hold it is not."""
    plant, point = _found(_motor({"i_f": 1, "omega": 0}))
    found = negative_response(plant, point)
    assert found is not None
    assert found.point.u != point.u
    (rates,) = plant.at(found.point, plant.system.xdot)
    assert all(abs(row[0]) < 1e-30 for row in rates)


def test_a_storage_that_bends_abruptly_at_the_rest_shows_nothing_there():
    """Its gradient is the same there, but it has no second derivatives, which the theorem is about."""
    plant, point = _found(_motor({"i_f": 1, "omega": 5}, bend=1))
    found = negative_response(plant, point)
    assert found is None or found.point != point


def test_other_rests_must_be_inside_of_the_domain():
    plant, point = _found(_motor({"i_f": 1, "omega": 0}, domain={"omega": ("-1e-6", "1e-6")}))
    assert negative_response(plant, point) is None


def test_a_motor_without_a_field_in_its_torque_is_not_refuted():
    plant, point = _found(_motor({"i_f": 1}, k=0))
    assert point is None or negative_response(plant, point) is None


def _planted(seed: int) -> tuple[Plant, Point]:
    """f = F(x) grad S and g = -F(x) grad gamma with sym F <= 0, at rest where grad S = grad gamma u."""
    draw = random.Random(seed)
    n, m = draw.choice((2, 3, 4)), draw.choice((1, 2))
    x = [ca.SX.sym(f"x{k}") for k in range(n)]
    F = ca.SX(n, n)
    for i in range(n):
        F[i, i] = -draw.choice((0, 1, 2, 1 + x[draw.randrange(n)] ** 2))
        for j in range(i):
            F[i, j] = draw.choice((0, 1, -1)) * draw.choice((1, 2, 1 + x[j] ** 2, x[draw.randrange(n)]))
            F[j, i] = -F[i, j]
    bends = [lambda k: x[k], lambda k: x[k], lambda k: x[k] ** 3, lambda k: x[k] * x[(k + 1) % n]]
    gamma = [sum(draw.choice((-1, 1, 2)) * draw.choice(bends)(k) for k in range(n)) for _ in range(m)]
    psi = ca.jacobian(ca.vertcat(*gamma), ca.vertcat(*x)).T
    at, u = [draw.randint(-2, 2) for _ in range(n)], [draw.randint(1, 3) for _ in range(m)]
    e = ca.Function("e", [ca.vertcat(*x)], [ca.mtimes(psi, ca.DM(u)) - ca.vertcat(*x) - ca.vertcat(*x) ** 3])(at)
    storage = sum((x[k] ** 2 / 2 + x[k] ** 4 / 4 + float(e[k]) * x[k] for k in range(n)), ca.SX(0))
    f = ca.mtimes(F, ca.gradient(storage, ca.vertcat(*x)))
    inputs = [ca.SX.sym(f"u{k}") for k in range(m)]
    plant = Plant(AffineSystem(x, inputs, f, -ca.mtimes(F, psi), storage))
    return plant, Point(tuple(rational(Fraction(v)) for v in at), tuple(rational(Fraction(v)) for v in u))


@pytest.mark.parametrize("seed", range(30))
def test_a_system_with_a_gamma_is_never_contradicted(seed):
    plant, point = _planted(seed)
    (rates,) = plant.at(point, plant.system.xdot)
    assert all(row[0] == 0 for row in rates)
    assert negative_response(plant, point) is None


def test_the_systems_with_a_gamma_are_reached_by_their_inputs():
    """So that the test above is about something."""
    reached = 0
    for seed in range(30):
        plant, point = _planted(seed)
        slope = ca.densify(ca.jacobian(plant.system.xdot, plant.system.x))
        reached += has_full_rank(*plant.at(point, slope, plant.system.g))
    assert reached > 15


def test_a_mode_out_of_reach_of_the_inputs_is_left_open():
    """The same motor beside a state that nothing moves: grad S* need not be (grad gamma) u* any more."""
    design, system = _motor({"i_f": 1, "omega": 5}), _motor({"i_f": 1}, beside=ca.SX.sym("still")).system
    plant, point = _found(design)
    there = Point((*point.x, rational(Fraction(0))), point.u)
    assert negative_response(plant, point) is not None
    assert negative_response(Plant(system), there) is None


def test_the_gradient_condition_follows_from_a_passive_output_where_x_is_irrational():
    x, y, u = (ca.SX.sym(name) for name in "xyu")
    F = ca.vertcat(ca.horzcat(-1, 1 + x**2), ca.horzcat(-(1 + x**2), -2))
    psi = ca.vertcat(ca.cos(x), 1)
    S = x**2 / 2 + y**2 / 2
    system = AffineSystem([x, y], [u], ca.mtimes(F, ca.vertcat(x, y)), -ca.mtimes(F, psi), S, gamma=[ca.sin(x) + y])
    law = DynamicExtension(alpha=1, beta=1, R_c=1, K_c=1)
    design = Design(system, target={"x": "0.3"}, law=law, sample_period="1e-3", name="d")
    claims = {claim.claim: claim for claim in derive(design).claims}
    assert claims["passive-output"].status is Status.PROVED
    assert claims["gradient-condition"].status is Status.PROVED
    assert "rank n" in claims["gradient-condition"].method
