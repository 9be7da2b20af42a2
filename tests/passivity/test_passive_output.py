"""gamma with gamma' = y: found, proved through Z(x) >= 0, or not claimed."""

from fractions import Fraction

import casadi as ca
import pytest
from flint import fmpq

from pbcgen import AffineSystem, Mechanical
from pbcgen.passivity import passive_output
from pbcgen.passivity.passive_output import PassiveOutput
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.storage import assumption_1
from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import fraction


def _find(system, plant=None):
    plant = plant or Plant(system)
    storage = assumption_1(plant)
    return passive_output.find(plant, storage.structure, storage.proved, storage.by_structure)


def _status(found):
    return found.claim.status if isinstance(found, PassiveOutput) else found.status


def test_an_output_is_not_passive_because_the_storage_happens_to_decrease():
    """u^T y - dS/dt is v^T B v with B indefinite for some u; the closed loop of this model is unstable."""
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    a, b = ca.exp(x), ca.exp(y)
    found = _find(AffineSystem([x, y], [u], [-a - 2 * b, -2 * a - b], [3, 3], a + b))
    assert _status(found) is not Status.PROVED


def _gamma_is(system, expected):
    plant = Plant(system)
    found = _find(system, plant)
    assert isinstance(found, PassiveOutput)
    assert found.claim.status is Status.PROVED
    field, (difference,) = plant.exact(ca.jacobian(found.gamma - ca.vertcat(*expected), system.x))
    return all(entry.is_zero() for row in difference.dense(field.const(0)) for entry in row)


def _oscillator(**keywords):
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    return AffineSystem([x, y], [u], [y, -x - y], [0, 1], x**2 / 2 + y**2 / 2, **keywords)


def test_the_natural_output_of_an_oscillator_is_found():
    system = _oscillator()
    assert _gamma_is(system, [system.x[0]])


@pytest.mark.parametrize("factor", [-1, 2, 0.999999, 1.000001, 0])
def test_a_given_gamma_with_a_wrong_factor_is_not_proved(factor):
    system = _oscillator()
    wrong = AffineSystem(system.x, system.u, system.f, system.g, system.S, gamma=[factor * system.x[0]])
    found = _find(wrong)
    assert _status(found) is not Status.PROVED
    assert "leave gamma out" in (found.claim if isinstance(found, PassiveOutput) else found).hint


def test_a_gamma_that_feeds_nothing_back_is_no_output():
    """The averaged boost converter with its energy: only gamma = const satisfies the linear conditions."""
    i, v, w = (ca.SX.sym(name) for name in ("i", "v", "w"))
    system = AffineSystem([i, v], [w], [12 - i, -v], [-v, i], i**2 / 2 + v**2 / 2)
    found = _find(system)
    assert not isinstance(found, PassiveOutput)
    assert "feeds nothing back" in found.evidence


def test_a_given_gamma_may_have_a_constant():
    system = _oscillator()
    shifted = AffineSystem(system.x, system.u, system.f, system.g, system.S, gamma=[system.x[0] + 7])
    assert _status(_find(shifted)) is Status.PROVED


def test_a_tiny_admixture_of_the_velocity_is_not_proved():
    system = _oscillator()
    mixed = AffineSystem(system.x, system.u, system.f, system.g, system.S, gamma=[system.x[0] + 1e-9 * system.x[1]])
    assert _status(_find(mixed)) is not Status.PROVED


def test_an_input_on_a_damped_state_needs_a_feedthrough():
    """f = [[-1, 1], [-1, -2]] grad S, g = e1: gamma = -(F^-1 g)^T x = (2 x - y)/3, and w^T w = 2/3."""
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    system = AffineSystem([x, y], [u], [y - x, -x - 2 * y], [1, 0], x**2 / 2 + y**2 / 2)
    plant = Plant(system)
    found = _find(system, plant)
    assert found.claim.status is Status.PROVED
    field, (slope,) = plant.exact(ca.mtimes(ca.jacobian(found.gamma, system.x), system.g))
    assert fraction(slope.scalar(field.const(0)).constant()) == Fraction(2, 3)


def test_a_state_dependent_actuator_gives_a_nonlinear_gamma():
    q, p = [ca.SX.sym("q1"), ca.SX.sym("q2")], [ca.SX.sym("p1"), ca.SX.sym("p2")]
    arm = Mechanical(q, p, M=[1, 1], V=q[0] ** 2, D=[1, 1], G=[[q[1]], [q[0]]]).lower()
    assert _gamma_is(arm, [arm.x[0] * arm.x[1]])


def test_an_output_that_is_no_gradient_is_not_integrated():
    """G = (1, q1): the output q1' + q1 q2' is not the rate of any function of q."""
    q, p = [ca.SX.sym("q1"), ca.SX.sym("q2")], [ca.SX.sym("p1"), ca.SX.sym("p2")]
    arm = Mechanical(q, p, M=[1, 1], V=q[0] ** 2, D=[1, 1], G=[[1], [q[0]]]).lower()
    assert _status(_find(arm)) is not Status.PROVED


def test_the_storage_is_part_of_the_claim():
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    active = AffineSystem([x, y], [u], [y, -x + y], [0, 1], x**2 / 2 + y**2 / 2, gamma=[x])
    assert _status(_find(active)) is not Status.PROVED


def test_levels_of_two_tanks_give_a_passive_output_although_grad_S_is_no_polynomial():
    """f = F grad S in terms of sqrt(h) only; S' <= y u with gamma = h1 + h2 leaves 3/4 (sqrt h1 - sqrt h2)^2."""
    h1, h2, u = (ca.SX.sym(name) for name in ("h1", "h2", "u"))
    domain = {"h1": ("0.01", None), "h2": ("0.01", None)}
    a, b = ca.sqrt(h1), ca.sqrt(h2)
    tanks = AffineSystem([h1, h2], [u], [-a, a - b], [1, 0], (h1 * a + h2 * b) / 1.5, domain=domain)
    plant = Plant(tanks)
    found = _find(tanks, plant)
    assert _status(found) is Status.PROVED
    rate = plant.numeric(ca.mtimes(ca.jacobian(found.gamma, tanks.x), tanks.xdot))
    power = plant.numeric(ca.mtimes(ca.gradient(tanks.S, tanks.x).T, tanks.xdot))
    for levels in ([0.5, 2], [1, 1], [3, 0.1]):
        for flow in (-2.0, 0.0, 0.3, 5.0):
            assert float(power(levels, flow)) <= float(rate(levels, flow)) * flow + 1e-12


def test_a_population_that_an_input_feeds_has_the_logarithm_as_gamma():
    """``S = h - ln h``, ``h' = h (1 - h + u)``: the noise of semidefinite programming is no part of it."""
    pytest.importorskip("clarabel")
    h, u = ca.SX.sym("h"), ca.SX.sym("u")
    system = AffineSystem([h], [u], [h * (1 - h)], [h], h - ca.log(h), domain={"h": ("0.1", 5)})
    plant = Plant(system)
    storage = assumption_1(plant)
    found = passive_output.find(plant, storage.structure, storage.proved, storage.by_structure, storage.region)
    assert _status(found) is Status.PROVED
    field, (difference,) = plant.exact(found.gamma - ca.log(h))
    assert difference.scalar(field.const(0)).constant() is not None


@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_a_gamma_that_falls_where_the_input_pushes_is_not_offered(inputs):
    """The natural output of a braked rigid body is the rate of -L: a law with that gamma would spin it up."""
    L, u = ca.SX.sym("L", 3), ca.SX.sym("u", inputs)
    w = L / ca.SX([1, 2, 3])
    system = AffineSystem(L, u, ca.cross(L, w) - w, ca.SX.eye(3)[:, :inputs], ca.dot(L, w) / 2)
    plant = Plant(system)
    storage = assumption_1(plant)
    rest = Point((fmpq(0),) * 3, (fmpq(0),) * inputs)
    found = passive_output.find(plant, storage.structure, storage.proved, storage.by_structure, None, rest)
    assert isinstance(found, PassiveOutput)
    (feedthrough,) = plant.at(rest, ca.mtimes(ca.jacobian(found.gamma, L), system.g))
    assert all(feedthrough[i][i] > 0 for i in range(inputs))


def test_friction_that_is_no_constant_multiple_is_taken_into_the_structure():
    """x' = -(x + x^3) / (1 + 3 x^2) + ... is -R(x) grad S, and y = g^T x' / R(x) is passive where it is not at rest."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    X, slope = x + x**3, 1 + 3 * x**2
    assert _gamma_is(AffineSystem([x], [u], [-X / slope], [1 / slope], X**2 / 2), [X])


def _planted(gamma, S, F=lambda x, y: [[-1, 1 + x**2], [-(1 + x**2), -2]], change=1.0):
    """f = F(x) grad S and g = -F(x) grad gamma; the search does not see this F, which depends on the state."""
    x, y, u = (ca.SX.sym(name) for name in "xyu")
    state, rows = ca.vertcat(x, y), F(x, y)
    matrix = ca.vertcat(*[ca.horzcat(*row) for row in rows])
    g = -ca.mtimes(matrix, ca.gradient(gamma(x, y), state))
    return AffineSystem([x, y], [u], ca.mtimes(matrix, ca.gradient(S(x, y), state)), [g[0], change * g[1]], S(x, y))


CURVED = [
    (lambda x, y: x + y**3, lambda x, y: x**2 / 2 + y**2 / 2),
    (lambda x, y: ca.sin(x) / 2 + y, lambda x, y: x**2 / 2 + y**4 / 4 + y**2),
    (lambda x, y: x + x * y, lambda x, y: x**2 / 2 + y**2 / 2),
]


@pytest.mark.parametrize(("gamma", "S"), CURVED)
def test_a_curved_gamma_is_found_although_no_structure_gives_it(gamma, S):
    pytest.importorskip("clarabel")
    assert _status(_find(_planted(gamma, S))) is Status.PROVED


@pytest.mark.parametrize(("gamma", "S"), CURVED)
@pytest.mark.parametrize("change", [-1.0, 0.999, 1.001])
def test_a_changed_input_matrix_leaves_that_gamma_unproved(gamma, S, change):
    system = _planted(gamma, S, change=change)
    given = [gamma(*ca.vertsplit(system.x))]
    wrong = AffineSystem(system.x, system.u, system.f, system.g, system.S, gamma=given, parameters=system.parameters)
    assert _status(_find(wrong)) is not Status.PROVED


@pytest.mark.parametrize(("bound", "status"), [("0.6", "PROVED"), ("0.9", "REFUTED"), (None, "REFUTED")])
def test_a_gamma_that_is_passive_on_a_part_of_the_space_is_so_where_the_domain_is_in_it(bound, status):
    """With u = x + v, u gamma' - S' = (1 + y^2) v^2 - x y^2 v + (1 - 2 x^2) y^2, which needs 2 x^2 < 1."""
    x, y, u = (ca.SX.sym(name) for name in "xyu")
    domain = None if bound is None else {"x": ("-" + bound, bound), "y": (-2, 2)}
    gamma = x + x * y**2
    system = AffineSystem([x, y], [u], [-x, -y], [1, 0], x**2 / 2 + y**2 / 2, gamma=[gamma], domain=domain)
    found = _find(system)
    assert _status(found).name == status
    assert found.claim.domain != "all x" or bound is None


def test_a_gamma_with_a_pole_serves_where_it_is_defined():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    for gamma, domain in ((x, "all x"), (x + ca.atan(1 / x) + ca.atan(x), "all x where the model is defined")):
        found = _find(AffineSystem([x], [u], [-x], [1], x**2 / 2, gamma=[gamma]))
        assert _status(found) is Status.PROVED
        assert found.claim.domain == domain
