"""What is known of mechanical systems by the way they are written, and what must not be taken for that."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Limits, Mechanical, Parameters
from pbcgen.models.affine import Mechanics, Structure
from pbcgen.passivity.assignable import assignable_set
from pbcgen.passivity.construction import drift_by_construction, gradient_by_construction
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.storage import assumption_1
from pbcgen.pipeline import check
from pbcgen.proof.claim import Status


def planar_arm(n: int) -> Mechanical:
    """n links as point masses at their ends and small rotors, from the positions of the masses."""
    q, v = (ca.vertcat(*[ca.SX.sym(f"{name}{k}") for k in range(n)]) for name in ("q", "v"))
    p = Parameters(m="0.7", l="0.4", g="9.81", J="0.01", d="0.2")
    position, angle, T, V = ca.SX(2, 1), ca.SX(0), p.J * ca.dot(v, v) / 2, ca.SX(0)
    for k in range(n):
        angle = angle + q[k]
        position = position + p.l * ca.vertcat(ca.sin(angle), -ca.cos(angle))
        velocity = ca.mtimes(ca.jacobian(position, q), v)
        T = T + p.m * ca.dot(velocity, velocity) / 2
        V = V + p.m * p.g * position[1]
    return Mechanical.from_lagrangian(q, v, T=T, V=V, G=ca.SX.eye(n), D=[p.d] * n, parameters=p, name="arm")


def spatial_arm() -> Mechanical:
    """A turning base and two links."""
    q, v = (ca.vertcat(*[ca.SX.sym(f"{name}{k}") for k in range(3)]) for name in ("q", "v"))
    p = Parameters(m1="1.5", m2="0.8", l1="0.5", l2="0.4", J="0.02", g="9.81", d="0.2")
    r1, z1 = p.l1 * ca.cos(q[1]), p.l1 * ca.sin(q[1])
    r2, z2 = r1 + p.l2 * ca.cos(q[1] + q[2]), z1 + p.l2 * ca.sin(q[1] + q[2])
    T, V = p.J * v[0] ** 2 / 2, ca.SX(0)
    for mass, r, z in ((p.m1, r1, z1), (p.m2, r2, z2)):
        velocity = ca.mtimes(ca.jacobian(ca.vertcat(r * ca.cos(q[0]), r * ca.sin(q[0]), z), q), v)
        T, V = T + mass * ca.dot(velocity, velocity) / 2, V + mass * p.g * z
    return Mechanical.from_lagrangian(q, v, T=T, V=V, G=ca.SX.eye(3), D=[p.d] * 3, parameters=p, name="spatial arm")


def tampered(system: AffineSystem, **changes: object) -> AffineSystem:
    """The system with other parts, as a careless front end might hand it on."""
    fields = ("f", "g", "S", "parameters", "domain", "structure")
    parts = {name: changes.get(name, getattr(system, name)) for name in fields}
    return AffineSystem(system.x, system.u, **parts)  # type: ignore[arg-type]


def with_mechanics(system: AffineSystem, **changes: object) -> AffineSystem:
    """The system with other mechanical parts."""
    assert system.structure is not None
    assert system.mechanical is not None
    mechanics: Mechanics = replace(system.mechanical, **changes)
    return tampered(system, structure=replace(system.structure, mechanical=mechanics))


@pytest.mark.parametrize("arm", [planar_arm(2), planar_arm(4), planar_arm(6), spatial_arm()])
def test_arms_are_recognised_without_expanding_their_inertia(arm: Mechanical) -> None:
    assert gradient_by_construction(arm.system)
    assert drift_by_construction(arm.system)
    storage = assumption_1(Plant(arm.system))
    assert storage.claim.status is Status.PROVED
    assert storage.by_structure


def test_an_inverse_inertia_is_recognised() -> None:
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    inverse = ca.SX([[2, 0], [0, 1]]) + ca.cos(q[0]) * ca.SX([[0, 1], [1, 0]]) / 2
    arm = Mechanical(q, p, M_inv=inverse, V=-ca.cos(q[0]), G=ca.SX.eye(2))
    assert gradient_by_construction(arm.system)


@pytest.mark.parametrize("arm", [planar_arm(3), spatial_arm()])
def test_check_of_three_joints_ends(arm: Mechanical) -> None:
    law = DynamicExtension(alpha=[30, 20, 10], beta=1, K_c=1, R_c=1)
    target = dict.fromkeys(arm.system.state_names[:3], "0") if arm.system.name == "arm" else {"q0": "0", "q1": "-1.5"}
    near = {} if arm.system.name == "arm" else {"near": {"q2": "-0.1"}}
    design = Design(arm, target=target, law=law, limits=Limits.symmetric(100), sample_period="1e-3", **near)
    claims = {c.claim: c for c in check(design).claims}
    assert claims["assumption-1"].status is Status.PROVED
    assert claims["passive-output"].status is Status.PROVED


def test_another_gradient_is_not_recognised() -> None:
    system = planar_arm(3).system
    assert system.mechanical is not None
    wrong = system.mechanical.energy_gradient + ca.vertcat(system.x[0], ca.SX(5, 1)) / 1000
    assert not gradient_by_construction(with_mechanics(system, energy_gradient=wrong))


def test_another_storage_is_not_recognised() -> None:
    system = planar_arm(3).system
    assert not gradient_by_construction(tampered(system, S=system.S + system.x[0] ** 2))


def test_another_drift_is_not_recognised() -> None:
    system = planar_arm(2).system
    changed = tampered(system, f=system.f + ca.vertcat(ca.SX(3, 1), 10 * system.x[2]))
    assert not drift_by_construction(changed)
    assert assumption_1(Plant(changed)).claim.status is not Status.PROVED


def test_another_inertia_is_not_recognised() -> None:
    system = planar_arm(3).system
    assert system.mechanical is not None
    assert not gradient_by_construction(with_mechanics(system, M=2 * system.mechanical.M, M_inv=ca.SX.eye(3)))


def test_an_inertia_that_is_not_symmetric_is_not_recognised() -> None:
    """The formulas for M^-1 read one half of M only, so S would be the same for it."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    bump = ca.exp(-1000 * (q[0] - 3) ** 2)
    M = ca.SX([[2, 0], [0, 1]]) + ca.SX([[0, 1], [0, 0]]) * bump
    arm = Mechanical(q, p, M=M, V=q[0] ** 2 / 2, G=ca.SX.eye(2))
    assert not gradient_by_construction(arm.system)
    assert assumption_1(Plant(arm.system)).claim.status is not Status.PROVED


def test_damping_of_the_wrong_sign_is_not_proved_by_construction() -> None:
    system = planar_arm(3).system
    assert system.mechanical is not None
    F = ca.SX(system.structure.F)  # type: ignore[union-attr]
    F[4, 4] = 0.1
    changed = tampered(
        system,
        f=ca.mtimes(F, system.mechanical.energy_gradient),
        structure=Structure(F=F, mechanical=system.mechanical),
    )
    assert assumption_1(Plant(changed)).claim.status is not Status.PROVED


def test_rests_of_a_mechanical_system_are_those_of_its_potential() -> None:
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    M = ca.SX([[2, 0], [0, 1]]) + ca.cos(q[0]) * ca.SX([[0, 1], [1, 0]]) / 2
    arm = Mechanical(q, p, M=M, V=-ca.cos(q[1]), G=ca.SX([1, 0]))
    assert assignable_set(Plant(arm.system)) == ["p_0 = 0", "p_1 = 0", "sin(q_1) = 0"]
