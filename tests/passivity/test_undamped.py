"""Undamped motions that the controller does not see: x* is refuted to attract, and only then."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Integral, Mechanical, PassiveOutput, check
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.passivity.equilibrium import complete
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.undamped import undamped_plane
from pbcgen.verify.claims import examine

LAW = DynamicExtension(2, 3, 5, 1)
LAWS = {"extension": LAW, "output": PassiveOutput(2, 3, 1), "integral": Integral(LAW, "0.1", 1, 1)}


def _relations(system, output, target, near):
    """The equations of the plane that is found, or None."""
    design = Design(system, target, LAW, sample_period="1e-3", near=near)
    plant = Plant(design.system)
    point = complete(plant, design).point
    assert point is not None
    plane = undamped_plane(plant, point, output, None)
    return None if plane is None else plane.words(design.system.state_names)


def _hung(spring, masses=(1, 1), damping=(0, 0, 0), held=lambda q: q**2 / 2):
    """A driven mass q_0 on a spring, and masses that hang on it by springs ``spring(k, q_k - q_0)``."""
    n = len(masses) + 1
    q, p = ca.SX.sym("q", n), ca.SX.sym("p", n)
    V = held(q[0]) + sum((spring(k, q[k + 1] - q[0]) for k in range(n - 1)), ca.SX(0))
    D = [*damping, *[0] * (n - len(damping))]
    names = [f"{letter}_{k}" for letter in "qp" for k in range(n)]
    M = ca.diag(ca.SX([1, *masses]))
    return Mechanical(q, p, M=M, V=V, D=D, G=[[1], *[[0]] * (n - 1)], measured=names)


def _plane(system, target=0):
    n = system.q.numel()
    return _relations(system.system, system.q[0], {"q_0": target}, {f"q_{k}": target for k in range(1, n)})


def _quartic(*factors):
    return lambda k, d: d**2 / 2 + factors[k] * d**4 / 4


@pytest.mark.parametrize("law", LAWS)
def test_masses_that_swing_against_each_other_are_not_damped_by_any_law(law):
    design = Design(_hung(_quartic(1, 1)), {"q_0": 0}, LAWS[law], sample_period="1e-3", near={"q_1": 0, "q_2": 0})
    claim = next(c for c in check(design).claims if c.claim == "asymptotically-stable")
    assert claim.status == "REFUTED"
    assert "dq_0 = 0" in claim.counterexample["relations"]


def test_it_does_not_matter_where_they_rest_when_the_springs_are_between_them():
    """u* = sinh(0.3) is no decimal, and is not needed."""
    found = _plane(_hung(_quartic(1, 1), held=ca.cosh), "0.3")
    assert found is not None
    assert found[0] == "dq_0 = 0"


def test_springs_of_sines_are_odd_too():
    assert _plane(_hung(lambda k, d: 1 - ca.cos(d), (2, 2)))


def test_of_four_equal_masses_two_may_swing_while_the_others_rest():
    """The sum of four cubes that stand for displacements with sum zero has linear factors."""
    assert _plane(_hung(_quartic(1, 1, 1, 1), (1, 1, 1, 1)))


def test_a_mass_and_a_spring_in_proportion_move_in_proportion():
    """The second displacement is half of the first, against it: 2 d + 2 d^3 balances 4 (d/2) + 16 (d/2)^3."""
    springs = [lambda d: 2 * d**2 / 2 + 2 * d**4 / 4, lambda d: 4 * d**2 / 2 + 16 * d**4 / 4]
    assert _plane(_hung(lambda k, d: springs[k](d), (2, 4))) is not None


def test_two_pendulums_on_a_cart_swing_against_each_other():
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 3)
    c = [ca.cos(q[1]), ca.cos(q[2])]
    V = q[0] ** 2 / 2 - c[0] - c[1]
    system = Mechanical(q, p, M=[[4, c[0], c[1]], [c[0], 1, 0], [c[1], 0, 1]], V=V, G=[[1], [0], [0]])
    found = _relations(system.system, q[0], {"q_0": "1/3"}, {"q_1": 0, "q_2": 0})
    assert found is not None
    assert found[0] == "dq_0 = 0"


@pytest.mark.parametrize(
    "system",
    [
        _hung(_quartic(1, 1.01)),
        _hung(_quartic(1, -1)),
        _hung(_quartic(0, 1)),
        _hung(lambda k, d: d**2 / 2 + d**3 / 20 + d**4 / 4),
        _hung(lambda k, d: ca.exp(d) - d),
        _hung(_quartic(1, 1), masses=(1, 1.001)),
        _hung(_quartic(1, 1), damping=(0, 0.01, 0)),
        _hung(_quartic(1, 1), damping=(0, 0.01, 0.01)),
    ],
)
def test_what_is_not_odd_and_symmetric_is_not_refuted(system):
    assert _plane(system) is None


def _beside(rates, output=lambda x, a, b: x, energy=lambda a, b: a**2 / 2 + b**2 / 2):
    """``x' = -x + u`` beside a motion of (a, b) that it does not reach."""
    x, a, b, u = (ca.SX.sym(name) for name in ("x", "a", "b", "u"))
    system = AffineSystem([x, a, b], [u], [-x, *rates(a, b)], [1, 0, 0], x**2 / 2 + energy(a, b))
    return _relations(system, output(x, a, b), {"x": "0.5"}, {"a": 0, "b": 0})


def test_a_motion_beside_the_controlled_one_is_found():
    assert _beside(lambda a, b: (b, -ca.sin(a)), energy=lambda a, b: 1 - ca.cos(a) + b**2 / 2) == ["dx = 0"]


@pytest.mark.parametrize(
    "rates",
    [
        lambda a, b: (b, -a - b**3),
        lambda a, b: (b - a**3, -a),
        lambda a, b: (b, -a - a**2 * b),
        lambda a, b: (b, -a - 1e-9 * b),
        lambda a, b: (b, -a + b**3),
        lambda a, b: (b, -a - a**2),  # another energy is conserved, not this one
    ],
)
def test_a_motion_that_loses_a_little_is_not_refuted(rates):
    assert _beside(rates) is None


def test_a_motion_that_the_output_sees_is_not_refuted():
    assert _beside(lambda a, b: (b, -a), lambda x, a, b: x + a**3) is None


def test_without_energy_nothing_shows_that_it_moves_away():
    assert _beside(lambda a, b: (b, -a), energy=lambda a, b: ca.SX(0)) is None


@pytest.mark.parametrize("stiffness", ["0.1", 20])
def test_the_checker_sees_an_undamped_mode_where_the_storage_has_no_minimum_too(stiffness):
    """Twins that fall outwards together and swing against each other, and a damper that acts on their sum."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    between = q[0] - q[1]
    V = 5 * between**2 / 2 + 3 * between**4 / 4 - 3 * (q[0] + q[1]) ** 2 / 2
    twins = Mechanical(q, p, M=[2, 2], V=V, D=[[0.4, 0.4], [0.4, 0.4]], G=[1, 1])
    law = DynamicExtension(1, stiffness, 400, "0.5")
    derivation = derive(Design(twins, {"q_0": 0, "q_1": 0}, law, sample_period="1e-2"))
    found = {f.claim: (f.status, f.outcome) for f in examine(certificate(derivation))}
    assert found["asymptotically-stable"] == ("REFUTED", "checked")
    assert found["globally-asymptotically-stable"] == ("REFUTED", "checked")
