"""M(q) > 0 by its factors: proved where they leave no direction out, and not where they do."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen import Mechanical, ModelError, Parameters
from pbcgen.passivity.inertia import missing_for_definiteness, missing_for_growth
from pbcgen.passivity.plant import Plant

P = Parameters(m="0.7", l="0.4", J="0.05")


def arm(n: int, rotors: bool = True, weight: object = None, missing: int | None = None) -> Plant:
    """A planar arm of point masses, from the positions of the masses; ``missing`` leaves one of them out."""
    q, p = (ca.vertcat(*[ca.SX.sym(f"{name}{k}") for k in range(n)]) for name in ("q", "p"))
    factors = [(ca.SX.eye(n), P.J)] if rotors else []
    at, angle = ca.SX(2, 1), ca.SX(0)
    for k in range(n):
        angle = angle + q[k]
        at = at + P.l * ca.vertcat(ca.sin(angle), -ca.cos(angle))
        if k != missing:
            factors.append((ca.jacobian(at, q), P.m if weight is None else weight))
    return Plant(Mechanical(q, p, M=factors, V=0, G=ca.SX.eye(n), parameters=P).system)


@pytest.mark.parametrize("n", [1, 2, 3, 6, 10])
@pytest.mark.parametrize("rotors", [True, False])
def test_arms_have_a_definite_and_bounded_inertia(n: int, rotors: bool) -> None:
    plant = arm(n, rotors)
    assert missing_for_definiteness(plant) == ""
    assert missing_for_growth(plant) == ""


def test_a_kinetic_energy_that_is_a_sum_of_squares_gives_the_factors() -> None:
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    cart = ca.vertcat(v[0] + P.l * ca.cos(q[1]) * v[1], P.l * ca.sin(q[1]) * v[1])
    T = P.m * ca.dot(cart, cart) / 2 + 3 * v[0] ** 2 / 2
    system = Mechanical.from_lagrangian(q, v, T=T, V=0, G=[1, 0], parameters=P)
    assert len(system.parts.factors) == 3
    assert missing_for_growth(Plant(system.system)) == ""


@pytest.mark.parametrize(
    "T",
    [
        lambda q, v: (v[0] * ca.cos(q[1])) ** 2 + v[1] ** 2,
        lambda q, v: (v[0] + v[1]) ** 2 + (2 * v[0] + 2 * v[1]) ** 2 + (ca.sin(q[0]) * v[1]) ** 2,
        lambda q, v: q[0] * v[0] ** 2 + 2 * v[0] ** 2 + v[1] ** 2,
    ],
)
def test_an_energy_that_vanishes_or_is_negative_somewhere_is_not_definite(T) -> None:  # type: ignore[no-untyped-def]
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    system = Mechanical.from_lagrangian(q, v, T=T(q, v), V=0, G=[1, 0])
    assert missing_for_definiteness(Plant(system.system)) != ""


def test_a_mass_that_is_missing_leaves_a_direction_without_energy() -> None:
    assert missing_for_definiteness(arm(2, rotors=True, missing=1)) == ""  # the rotors are enough
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    J = ca.horzcat(ca.SX(1), ca.cos(q[0]))
    with pytest.raises(ModelError):
        Mechanical(q, p, M=[(J, 1)], V=0, G=[1, 0])


def test_a_weight_without_sign_proves_nothing() -> None:
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    factors = [(ca.SX.eye(2), 1), (ca.horzcat(ca.SX(1), ca.SX(0)), q[1])]
    system = Mechanical(q, p, M=factors, V=0, G=[1, 0])
    assert missing_for_definiteness(Plant(system.system)) != ""


@pytest.mark.parametrize("weight", [ca.sin, lambda q: 1 + ca.sin(q), lambda q: ca.tanh(q) ** 2])
def test_bounded_weights_that_vanish_somewhere_prove_no_growth(weight) -> None:  # type: ignore[no-untyped-def]
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    factors = [(ca.horzcat(ca.SX(1), ca.SX(0)), 1), (ca.horzcat(ca.SX(0), ca.SX(1)), weight(q[0]))]
    plant = Plant(Mechanical(q, p, M=factors, V=0, G=[1, 0]).system)
    assert missing_for_definiteness(plant) != ""
    assert missing_for_growth(plant) != ""


def test_an_inertia_that_is_given_as_a_matrix_must_be_bounded_too() -> None:
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    for entry, missing in ((1 + q[1] ** 2, "M(q) is not bounded"), (2 + ca.sin(q[1]), "")):
        plant = Plant(Mechanical(q, p, M=[[entry, 0], [0, 1]], V=0, G=[1, 0]).system)
        assert missing_for_definiteness(plant) == ""
        assert missing_for_growth(plant) == missing


def test_an_unbounded_factor_is_definite_but_not_bounded() -> None:
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    factors = [(ca.SX.eye(2), 1), (ca.horzcat(ca.SX(1), q[0]), 1)]
    plant = Plant(Mechanical(q, p, M=factors, V=0, G=[1, 0]).system)
    assert missing_for_definiteness(plant) == ""
    assert missing_for_growth(plant) == "M(q) is not bounded"


def test_factors_of_the_wrong_shape_are_refused_by_name() -> None:
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 3)
    with pytest.raises(ModelError, match="J_2 of M"):
        Mechanical(q, p, M=[(ca.SX.eye(3), 1), (ca.SX(2, 2), 1)], V=0, G=[1, 0, 0])
    with pytest.raises(ModelError, match="W_1 of M"):
        Mechanical(q, p, M=[(ca.SX.eye(3), ca.SX.eye(2))], V=0, G=[1, 0, 0])
