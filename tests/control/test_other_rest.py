"""Equilibria of the closed loop besides x*: found for arms of many links, at rest, and only where there are any."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical
from pbcgen.control.derive import derive
from pbcgen.control.other_rest import other_rest
from pbcgen.symbolic.real import approximate


def pendulums(links: int, stiffness: float) -> Design:
    """Masses on a chain of light rods, hanging, with a spring and a motor in each joint."""
    q, p = ca.SX.sym("q", links), ca.SX.sym("p", links)
    V = -3 * sum((ca.cos(q[k]) for k in range(links)), ca.SX(0)) + stiffness * ca.dot(q, q) / 2
    M = ca.SX.eye(links) * 2
    for k in range(links - 1):
        M[k, k + 1] = M[k + 1, k] = ca.cos(q[k] - q[k + 1]) / 2
    system = Mechanical(q, p, M=M, V=V, G=ca.SX.eye(links), D=[1] * links)
    law = DynamicExtension(alpha=[1] * links, beta=1, K_c=1, R_c=1)
    return Design(system, {f"q_{k}": 0 for k in range(links)}, law, sample_period="1e-3")


@pytest.mark.parametrize("links", [2, 7])
def test_a_turned_link_is_another_equilibrium_and_its_momenta_are_zero(links: int) -> None:
    situation = derive(pendulums(links, 0.1)).situation
    assert situation is not None
    found = other_rest(situation)
    assert found is not None
    assert found[links:] == [0] * links
    q, at = situation.plant.system.x[:links], [approximate(v) for v in found[:links]]
    torque = ca.Function("torque", [q], [3 * ca.sin(q) + 0.1 * q])(at)
    assert abs(float(ca.norm_inf(torque))) < 1  # what motors with alpha = 1 can hold
    assert max(map(abs, at)) > 1


def test_none_is_found_where_springs_outweigh_gravity() -> None:
    situation = derive(pendulums(3, 10.0)).situation
    assert situation is not None
    assert other_rest(situation) is None


def test_a_system_with_one_state_has_no_momenta() -> None:
    x = ca.SX.sym("x")
    system = AffineSystem([x], [ca.SX.sym("u")], [-ca.sin(x)], [1], 1 - ca.cos(x))
    law = DynamicExtension(alpha="0.1", beta=1, K_c=1, R_c=1)
    situation = derive(Design(system, {"x": 0}, law, sample_period="1e-3")).situation
    assert situation is not None
    found = other_rest(situation)
    assert found is not None
    assert abs(approximate(found[0])) > 1
