"""Asymptotic stability beyond the linearisation, and global claims: what is proved, refuted and left open."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import pytest

from pbcgen import (
    AffineSystem,
    Circuit,
    Design,
    DynamicExtension,
    Integral,
    Limits,
    Mechanical,
    NaturalDamping,
    PassiveOutput,
    PotentialCompensation,
    check,
    load,
)
from pbcgen.control.only_rest import _increase_together
from pbcgen.passivity.plant import Plant

LAW = DynamicExtension(2, 3, 5, 1)


def _claims(system, target, law=LAW, **options):
    options = {"sample_period": "1e-3", "name": "trial", **options}
    return {claim.claim: claim for claim in check(Design(system, target, law, **options)).claims}


def _statuses(system, target, law=LAW, **options):
    claims = _claims(system, target, law, **options)
    names = ("stable", "asymptotically-stable", "globally-asymptotically-stable")
    return tuple(str(claims[name].status) for name in names)


def _symbols(*names):
    return [ca.SX.sym(name) for name in names]


def _two_masses(V, D, G=((1,), (0,))):
    q1, q2, p1, p2 = _symbols("q1", "q2", "p1", "p2")
    return Mechanical([q1, q2], [p1, p2], M=ca.SX.eye(2), V=V(q1, q2), G=list(G), D=D(p1, p2))


def test_a_hardening_spring_is_globally_stable_because_its_energy_is_convex():
    q, p = _symbols("q", "p")
    system = Mechanical([q], [p], M=[[1]], V=q**2 / 2 + q**4 / 4, D=[1], G=[[1]])
    assert _statuses(system, {"q": "0.5"}) == ("PROVED", "PROVED", "PROVED")


def _oscillator(friction, spring, energy):
    x, v, u = _symbols("x", "v", "u")
    rates = [v, -spring(x) - friction(v)]
    return AffineSystem([x, v], [u], rates, [0, 1], energy(x) + v**2 / 2)


@pytest.mark.parametrize(
    "friction", [ca.tanh, lambda v: v**3, lambda v: v + ca.tanh(9 * v), lambda v: v * ca.sqrt(1 + v**2)]
)
def test_a_monotone_spring_is_global_with_any_friction(friction):
    system = _oscillator(friction, lambda x: x + x**3, lambda x: x**2 / 2 + x**4 / 4)
    assert _statuses(system, {"x": "0.5"}) == ("PROVED", "PROVED", "PROVED")


def test_a_spring_that_turns_is_not_global():
    system = _oscillator(ca.tanh, lambda x: x**3 - 6 * x, lambda x: x**4 / 4 - 3 * x**2)
    assert _statuses(system, {"x": "2.5"}) == ("PROVED", "PROVED", "REFUTED")


@pytest.mark.parametrize("c3", ["0.5", "0"])
def test_a_chain_with_stiffening_couplings_is_global(c3):
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 3)
    stretch = [q[0] - q[1], q[1] - q[2]]
    V = sum((d**2 / 2 + float(c3) * d**4 for d in stretch), q[2] ** 2 / 2)
    system = Mechanical(q, p, M=ca.diag(ca.SX([1, 1, 2])), V=V, D=[0, 0, 1], G=[[1], [0], [0]])
    assert _statuses(system, {"q_0": "0.3"}, near={"q_1": 0, "q_2": 0})[2] == "PROVED"


def _two_branches(first, second):
    i, v = _symbols("i", "v")
    return Circuit([i], [v], L=[1], C=[1], Gamma=[[1]], v_R=[first(i)], i_G=[second(v)], g_L=[-1])


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (lambda i: i, lambda v: v + v**3),
        (lambda i: i / 2 + i**3, lambda v: v + ca.tanh(v)),
        (lambda i: i, lambda v: ca.exp(v) - 1),
        (lambda i: i, lambda v: v**5),
    ],
)
def test_a_circuit_of_monotone_resistors_is_global(first, second):
    claims = _claims(_two_branches(first, second), {"v": "0.5"}, near={"i": 1})
    assert claims["globally-asymptotically-stable"].status == "PROVED"


@pytest.mark.parametrize(
    ("first", "second"),
    [(lambda i: i, lambda v: 3 * v**3 - v), (lambda i: i**3 - i / 9, lambda v: v), (lambda i: -2 * i, lambda v: v)],
)
def test_a_circuit_with_a_falling_characteristic_is_not_proved_global(first, second):
    claims = _claims(_two_branches(first, second), {"v": "0.5"}, near={"i": 1})
    assert claims["globally-asymptotically-stable"].status != "PROVED"


def test_a_softening_spring_has_other_equilibria():
    q, p = _symbols("q", "p")
    system = Mechanical([q], [p], M=[[1]], V=q**2 / 2 - q**4 / 40, D=[1], G=[[1]])
    claims = _claims(system, {"q": "0"})
    assert claims["globally-asymptotically-stable"].status == "REFUTED"
    x = claims["globally-asymptotically-stable"].counterexample["x"]
    assert abs(float(x["q"])) > 1


def test_a_pendulum_with_a_weak_controller_has_a_second_equilibrium():
    q, p = _symbols("q", "p")
    system = Mechanical([q], [p], M=[[1]], V=10 * (1 - ca.cos(q)), D=[1], G=[[1]])
    assert _statuses(system, {"q": 0}) == ("PROVED", "PROVED", "REFUTED")


def test_gravity_compensation_of_the_pendulum_is_global():
    q, p = _symbols("q", "p")
    system = Mechanical([q], [p], M=[[1]], V=10 * (1 - ca.cos(q)), D=[1], G=[[1]])
    law = PotentialCompensation(20, 3, 50, 1)
    assert _statuses(system, {"q": "0.5"}, law) == ("PROVED", "PROVED", "PROVED")


def test_cubic_damping_is_asymptotically_stable_although_the_linearisation_is_not_hurwitz():
    system = _two_masses(lambda a, b: a**2 / 2 + b**2 / 2, lambda p1, p2: [0, p2**2])
    claims = _claims(system, {"q1": "0.5"})
    assert claims["asymptotically-stable"].status == "PROVED"
    assert "LaSalle" in claims["asymptotically-stable"].method
    assert claims["sampled-stable"].status != "PROVED"


def test_an_undamped_mode_that_the_input_does_not_reach_is_stable_but_not_asymptotically():
    system = _two_masses(lambda a, b: a**2 / 2 + b**2 / 2, lambda p1, p2: [0, 0])
    assert _statuses(system, {"q1": "0.5"}) == ("PROVED", "REFUTED", "REFUTED")


@pytest.mark.parametrize(("damping", "expected"), [([0, 0, 0], "REFUTED"), ([1, 0, 1], "PROVED")])
def test_the_antisymmetric_mode_of_two_equal_masses_needs_damping(damping, expected):
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 3)
    V = (q[0] - q[1]) ** 2 / 2 + (q[2] - q[1]) ** 2 / 2
    system = Mechanical(q, p, M=ca.SX.eye(3), V=V, G=[[0], [1], [0]], D=damping)
    assert _statuses(system, {"q_1": "0.5"})[1] == expected


def test_different_masses_let_the_middle_one_damp_both():
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 3)
    V = (q[0] - q[1]) ** 2 / 2 + (q[2] - q[1]) ** 2 / 2
    system = Mechanical(q, p, M=ca.diag(ca.SX([1, 1, 2])), V=V, G=[[0], [1], [0]])
    assert _statuses(system, {"q_1": "0.5"})[1] == "PROVED"


def test_a_conserved_charge_is_found():
    x1, x2, u = _symbols("x1", "x2", "u")
    system = AffineSystem([x1, x2], [u], [-(x1 - x2), x1 - x2], [1, -1], x1**2 / 2 + x2**2 / 2)
    claims = _claims(system, [0, 0])
    assert (claims["stable"].status, claims["asymptotically-stable"].status) == ("PROVED", "REFUTED")
    assert "x1" in claims["asymptotically-stable"].counterexample["conserved"]


def test_a_buck_converter_is_globally_stable_within_its_duty_ratio():
    i, v, u = _symbols("i", "v", "d")
    system = AffineSystem(
        [i, v], [u], [-v / 0.5, (i - v / 3) / 0.2], [20, 0], 0.25 * i**2 + 0.1 * v**2, measured=["i", "v"]
    )
    limits = Limits([(0, 1)])
    law = DynamicExtension("0.4", 1, 5, 1)
    assert _statuses(system, {"v": 5}, law, limits=limits) == ("PROVED", "PROVED", "PROVED")
    assert _statuses(system, {"v": 5}, PassiveOutput("0.2", 1, "0.1"), limits=limits) == ("PROVED",) * 3


def test_a_constant_load_is_held_from_everywhere():
    """V = c q is cancelled by kappa, so any amplitude alpha > 0 grows."""
    q, p = _symbols("q", "p")
    system = Mechanical([q], [p], M=[[1]], V=1.5 * q, D=[1], G=[[1]])
    assert _statuses(system, {"q": 0}, DynamicExtension(1, 3, 5, 1)) == ("PROVED", "PROVED", "PROVED")


def test_saturation_below_kappa_loses_the_global_claim_where_only_ln_cosh_grows():
    """kappa = -10 sin(0.5) pulls without bound where the potential 10 (1 - cos q) does not grow."""
    q, p = _symbols("q", "p")
    system = Mechanical([q], [p], M=[[1]], V=10 * (1 - ca.cos(q)), D=[1], G=[[1]])
    claims = _claims(system, {"q": "0.5"}, DynamicExtension(2, 3, 50, 1))
    assert claims["asymptotically-stable"].status == "PROVED"
    assert claims["globally-asymptotically-stable"].status != "PROVED"


def test_the_integral_law_is_never_called_global():
    design = load("pera_integral")
    claims = {c.claim: c for c in check(design).claims}
    claim = claims["globally-asymptotically-stable"]
    assert claim.status == "REFUTED"  # the filters leak: gravity holds the elbow at 4.15 or 5.27 rad, or a turn on
    assert float(claim.counterexample["x"]["q2"]) > 4.1
    assert isinstance(design.law, Integral)


@pytest.mark.parametrize("name", ["rlc", "pera"])
def test_the_reference_designs_that_are_global(name):
    claims = {c.claim: c for c in check(load(name)).claims}
    assert claims["globally-asymptotically-stable"].status == "PROVED"


@pytest.mark.system
def test_the_coupling_device_is_global_when_theta_is_met_and_not_with_the_printed_gains():
    design = load("coupling_device")
    printed = {c.claim: c for c in check(design).claims}
    assert printed["theta"].status == "REFUTED"
    assert printed["globally-asymptotically-stable"].status == "REFUTED"  # by a periodic motion
    law = NaturalDamping("2.5", 450, 10**6, "0.3", alpha_l="2.5", beta_l=2 * 10**6, K_l=15, R_l=33)
    met = {c.claim: c for c in check(design.with_(law=law)).claims}
    assert met["theta"].status == "PROVED"
    assert met["globally-asymptotically-stable"].status == "PROVED"


def test_negative_damping_is_neither_stable_nor_global():
    q, p = _symbols("q", "p")
    system = Mechanical([q], [p], M=[[1]], V=q**2 / 2, D=[-1], G=[[1]])
    claims = _claims(system, {"q": 0})
    assert claims["assumption-1"].status == "REFUTED"
    assert claims["globally-asymptotically-stable"].status != "PROVED"


def test_a_domain_makes_the_global_claim_local():
    q, p = _symbols("q", "p")
    system = Mechanical([q], [p], M=[[1]], V=q**2 / 2, D=[1], G=[[1]], domain={"q": (-1, 1)})
    claims = _claims(system, {"q": 0})
    assert claims["asymptotically-stable"].status == "PROVED"
    assert claims["globally-asymptotically-stable"].status == "UNDECIDED"


def _scaled_input(damping, spring=lambda x: x, more=()):
    """x' = (1 + x^2) v with an input that enters by the same factor: found without a power structure."""
    x, v, u = _symbols("x", "v", "u")
    scale = 1 + x**2
    states, rates = [x, v, *(s for s, _ in more)], [scale * v, -scale * spring(x) - damping * v, *(r for _, r in more)]
    energy = sum((s**2 / 2 for s, _ in more), x**2 / 2 + v**2 / 2)
    return AffineSystem(states, [u], rates, [0, scale, *[0] * len(more)], energy)


def test_the_invariant_set_needs_no_power_structure():
    assert _statuses(_scaled_input(1), {"x": "0.5"}) == ("PROVED", "PROVED", "PROVED")


def test_without_a_power_structure_an_undamped_mode_is_not_called_attractive():
    a, b = _symbols("a", "b")
    statuses = _statuses(_scaled_input(1, more=((a, b), (b, -a))), {"x": "0.5"}, near={"a": 0, "b": 0})
    assert statuses[0] == "PROVED"
    assert "PROVED" not in statuses[1:]


def _motor(spring, energy, resistance=1, load=0):
    i, th, w, u = _symbols("i", "th", "w", "u")
    rates = [-resistance * i - w, w, i - spring(th) - load * w]
    return AffineSystem([i, th, w], [u], rates, [1, 0, 0], i**2 / 2 + energy(th) + w**2 / 2)


def test_a_motor_with_a_hyperbolic_spring_is_global():
    assert _statuses(_motor(ca.sinh, ca.cosh), {"th": "0.5"}) == ("PROVED",) * 3


@pytest.mark.parametrize("broken", [{"resistance": -1}, {"load": -1}, {"spring": lambda a: 2 * ca.sinh(a)}])
def test_a_broken_motor_is_not_proved_global(broken):
    assert _statuses(_motor(**{"spring": ca.sinh, "energy": ca.cosh, **broken}), {"th": "0.5"})[2] != "PROVED"


@pytest.mark.parametrize(("slope", "expected"), [(1, "PROVED"), (-2, "OPEN")])
def test_resistors_with_varying_slopes_leave_nothing_that_moves(slope, expected):
    i, a, b = _symbols("i", "a", "b")
    sources = [a / 2 + ca.sinh(a) + (a - b), (b - a) + slope * b]
    system = Circuit([i], [a, b], L=[1], C=[1, 2], Gamma=[[1, 0]], v_R=[i / 2], i_G=sources, g_L=[-1])
    found = _statuses(system, {"a": "0.5"}, near={"b": 0})[2]
    assert (found == "PROVED") == (expected == "PROVED")


#: Potentials of two unit masses, of which the first is actuated and neither is damped.
_SEEN = {
    "a square": lambda a, b: a**2 + b**2 + a * b**2 / 3 + b**4 / 4,
    "a cube": lambda a, b: a**2 / 2 + b**2 / 2 + a * b**3 / 6 + a**4 / 4 + b**4 / 4,
    "a cosine": lambda a, b: a**2 + b**2 / 2 + a * (1 - ca.cos(b)),
}


@pytest.mark.parametrize("name", _SEEN)
def test_a_mode_that_the_output_sees_nonlinearly_is_damped(name):
    """On the invariant set a nonlinear function of b is constant: its rate is a product, and each factor stops b."""
    system = _two_masses(_SEEN[name], lambda *_: [0, 0])
    assert _statuses(system, {"q1": 0}, near={"q2": 0})[:2] == ("PROVED", "PROVED")


def test_a_branch_on_which_something_moves_is_not_attractive():
    """Where q1 = 0, the other coordinate swings; the product q1 q2 = 0 has this branch too."""
    q1, q2, p1, p2, u = _symbols("q1", "q2", "p1", "p2", "u")
    rates = [p1, p2, -q1 - q1 * p2, -q2 + q1 * p1]
    system = AffineSystem([q1, q2, p1, p2], [u], rates, [0, 0, 1, 0], (q1**2 + q2**2 + p1**2 + p2**2) / 2)
    statuses = _statuses(system, {"q1": 0}, near={"q2": 0})
    assert statuses[0] == "PROVED"
    assert "PROVED" not in statuses[1:]


def test_a_symmetric_mode_is_not_damped_by_springs_that_stiffen():
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 3)
    V = sum(((a - q[1]) ** 2 / 2 + (a - q[1]) ** 4 / 4 for a in (q[0], q[2])), q[1] ** 2 / 2)
    system = Mechanical(q, p, M=ca.SX.eye(3), V=V, G=[[0], [1], [0]])
    assert "PROVED" not in _statuses(system, {"q_1": 0}, near={"q_0": 0, "q_2": 0})[1:]


def test_a_convex_storage_with_a_gamma_that_bends_has_other_rests():
    """Along ``q1 + 3 sin q2 = 0``, which the law holds, a bowl has several hollows."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    G = ca.vertcat(1, 3 * ca.cos(q[1]))
    system = Mechanical(q, p, M=ca.SX.eye(2), V=ca.sumsqr(q) / 20, D=[1, 1], G=G)
    assert _statuses(system, {"q_0": 0, "q_1": 0}, DynamicExtension(3, 3, 5, 1)) == ("PROVED", "PROVED", "REFUTED")


@pytest.mark.parametrize(
    ("inputs", "outputs", "together"),
    [
        (lambda z: z, lambda z: z**3, True),
        (lambda z: z + z**3, ca.sinh, True),
        (lambda z: -z, lambda z: -ca.tanh(z), True),
        (lambda z: z - z**3, lambda z: 3 * z - 3 * z**3 + 1, True),  # the same function
        (lambda z: z, lambda z: -z, False),
        (lambda z: z, lambda z: z**2, False),
        # slopes (1 - z^2) and (1 - z^2) (z + 3)^2: of one sign at each z, and not between two of them
        (lambda z: z - z**3 / 3, lambda z: 9 * z + 3 * z**2 - 8 * z**3 / 3 - 1.5 * z**4 - z**5 / 5, False),
    ],
)
def test_two_functions_increase_together_only_if_they_do_between_all_points(inputs, outputs, together):
    z, v, u = _symbols("z", "v", "u")
    plant = Plant(AffineSystem([z, v], [u], [v, -z - v], [0, 1], (z**2 + v**2) / 2))
    along = SimpleNamespace(z=[z], inputs=inputs(z), outputs=outputs(z), zero=ca.SX(0, 1))
    assert _increase_together(SimpleNamespace(plant=plant), along) is together


def test_what_swings_while_the_output_sees_a_constant_is_not_damped():
    """The output sees q1^2 + q2^2, which stays what it is while (q1, q2) runs around a circle."""
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 3)
    radius = q[1] ** 2 + q[2] ** 2
    swing = q[0] * radius / 4 + radius**2
    system = Mechanical(q, p, M=ca.SX.eye(3), V=ca.sumsqr(q) / 2 + swing, G=[[1], [0], [0]], D=[1, 0, 0])
    assert "PROVED" not in _statuses(system, {"q_0": 0, "q_1": 0, "q_2": 0})[1:]


def _pair(target):
    """Two equal masses on stiffening springs, pushed together."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    V = (q[0] - q[1]) ** 2 / 2 + sum((a**2 / 2 + a**4 / 4 for a in (q[0], q[1])), ca.SX(0))
    system = Mechanical(q, p, M=ca.SX.eye(2), V=V, G=[[1], [1]])
    return _statuses(system, {"q_0": target, "q_1": target})[:2]


def test_a_branch_of_the_invariant_set_that_is_not_near_the_target_does_not_count():
    """Against each other the masses swing unseen about zero, not elsewhere."""
    assert _pair("0.5") == ("PROVED", "PROVED")
    assert _pair(0) == ("PROVED", "REFUTED")
