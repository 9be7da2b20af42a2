"""Claims for all positive parameters: proved of families of models, refuted with values where one of them fails."""

from __future__ import annotations

import json
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen import (
    AffineSystem,
    Design,
    DynamicExtension,
    Integral,
    Limits,
    Mechanical,
    ModelError,
    NaturalDamping,
    Parameters,
    PassiveOutput,
    PotentialCompensation,
    check,
    for_all_parameters,
    load,
)
from pbcgen.cli import execute
from pbcgen.parametric.all_parameters import _equilibrium
from pbcgen.parametric.wide import Wide
from pbcgen.parametric.wide_stability import Stability, routh_column
from pbcgen.proof.nonnegative import positive
from pbcgen.symbolic.field import Field
from pbcgen.symbolic.real import approximate

LAW = DynamicExtension(2, 3, 5, 1)
DAMPED = NaturalDamping(1, 2, 3, "1/2", alpha_l=1, beta_l=2, K_l=3, R_l=4)
VALUES = ("1/7", "3", "40")


def _symbols(*names):
    return [ca.SX.sym(name) for name in names]


def _design(system, target, law=LAW):
    return Design(system, target, law, sample_period="1e-3", name="trial")


def _oscillator(damping, **values):
    """A mass on a spring; ``damping`` makes the coefficient of friction from the parameters."""
    p = Parameters(**{"m": 2, "k": 3, "d": "0.5", **values})
    q, v, u = _symbols("q", "v", "u")
    f = [v / p.m, -p.k * q - damping(p) * v / p.m]
    return AffineSystem([q, v], [u], f, [0, 1], v**2 / (2 * p.m) + p.k * q**2 / 2, parameters=p, measured=["q"])


def _masses(inertia, domain=None, **values):
    """Two masses with an inertia matrix of the parameters."""
    p = Parameters(**{"m1": 2, "m2": 3, "k": 1, "d": 1, **values})
    q1, q2, p1, p2 = _symbols("q1", "q2", "p1", "p2")
    V = p.k * (q1 - q2) ** 2 / 2 + q2**2 / 2
    return Mechanical([q1, q2], [p1, p2], M=inertia(p), V=V, D=[p.d, p.d], G=[[1], [0]], parameters=p, domain=domain)


def _arm():
    """Two links: M = sum J^T m J of positive masses."""
    p = Parameters(m1=2, m2=3, l1=1, l2="0.5", d=1, g="9.81")
    q, pp = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    elbow = ca.vertcat(p.l1 * ca.cos(q[0]), p.l1 * ca.sin(q[0]))
    hand = elbow + ca.vertcat(p.l2 * ca.cos(q[0] + q[1]), p.l2 * ca.sin(q[0] + q[1]))
    J1, J2 = ca.jacobian(elbow, q), ca.jacobian(hand, q)
    M = p.m1 * ca.mtimes(J1.T, J1) + p.m2 * ca.mtimes(J2.T, J2)
    V = p.g * (p.m1 * elbow[1] + p.m2 * hand[1])
    return Mechanical(q, pp, M=M, V=V, D=[p.d, p.d], G=ca.SX.eye(2), parameters=p)


def _buck():
    p = Parameters(L="0.5", C="0.2", R=3, E=20)
    i, v, u = _symbols("i", "v", "d")
    f, S = [-v / p.L, (i - v / p.R) / p.C], p.L * i**2 / 2 + p.C * v**2 / 2
    return AffineSystem([i, v], [u], f, [p.E / p.L, 0], S, parameters=p, measured=["i", "v"])


def _claims(design):
    return {claim.claim: claim for claim in for_all_parameters(check(design))}


def _statuses(design):
    return {name: str(claim.status) for name, claim in _claims(design).items()}


FAMILIES = {
    "oscillator": lambda: _design(_oscillator(lambda p: p.d), {"q": "0.5"}),
    "two dampers": lambda: _design(_oscillator(lambda p: p.d + p.e, e=1), {"q": "0.5"}),
    "buck converter": lambda: _design(_buck(), {"v": 5}, DynamicExtension("0.4", 1, 5, 1)),
    "buck converter, full state": lambda: _design(_buck(), {"v": 5}, PassiveOutput("0.2", 1, "0.1")),
    "masses": lambda: _design(_masses(lambda p: ca.diag(ca.vertcat(p.m1, p.m2))), {"q1": "0.5"}),
    "damped masses": lambda: _design(_masses(lambda p: ca.diag(ca.vertcat(p.m1, p.m2))), {"q1": "0.5"}, DAMPED),
    "rlc": lambda: load("rlc"),
    "pera": lambda: load("pera"),
}


@pytest.mark.parametrize("name", sorted({*FAMILIES} - {"damped masses"}))
def test_a_family_that_is_stable_for_all_positive_parameters(name):
    claims = _claims(FAMILIES[name]())
    assert {str(claim.status) for claim in claims.values()} == {"PROVED"}
    assert {"assumption-1", "passive-output", "hessian-condition", "stable", "asymptotically-stable"} <= {*claims}
    assert all(claim.domain.endswith("all positive parameters") for claim in claims.values())


@pytest.mark.parametrize("name", ["oscillator", "two dampers", "buck converter", "masses"])
def test_what_is_proved_for_all_parameters_is_proved_at_others(name):
    design = FAMILIES[name]()
    proved = {name for name, status in _statuses(design).items() if status == "PROVED"}
    parameters = design.system.parameters
    for k in range(2):
        values = {name: VALUES[(i + k) % 3] for i, name in enumerate(parameters.names)}
        system = AffineSystem(
            design.system.x,
            design.system.u,
            design.system.f,
            design.system.g,
            design.system.S,
            parameters=parameters.with_values(**values),
        )
        target = {c.name: c.value for c in design.target.conditions}
        there = {c.claim: str(c.status) for c in check(_design(system, target, design.law)).claims}
        assert {name for name in proved if there[name] != "PROVED"} == set()


def test_the_coupling_device_is_passive_for_all_resistors():
    claims = _claims(load("coupling_device"))
    for name in ("assumption-1", "passive-output", "hessian-condition", "kc-bound", "equilibrium"):
        assert claims[name].status == "PROVED"
    assert "R1 + R2" in claims["passive-output"].evidence
    assert "Lambda_l = diag(a1), Lambda_c = diag(R1)" in claims["assumption-3"].evidence
    assert claims["theta"].status == "REFUTED"
    assert "K_l*R_l > 0.25*(a1 + R1)/(R1*a1)" in claims["theta"].evidence
    assert claims["stable"].status == "UNDECIDED"
    assert "proved where K_l*R_l > 0.25*(a1 + R1)/(R1*a1)" in claims["stable"].evidence


def test_an_arm_of_positive_masses():
    claims = _claims(_design(_arm(), {"q_0": "0.5", "q_1": "0.25"}, PotentialCompensation([200, 100], 3, 50, 1)))
    for name in ("assumption-1", "passive-output", "hessian-condition", "stable"):
        assert claims[name].status == "PROVED", name


# --- what must be refused ----------------------------------------------------------------------------------------


def test_damping_that_is_negative_for_some_parameters_is_refuted_with_them():
    design = _design(_oscillator(lambda p: p.d - p.e, e="0.1"), {"q": "0.5"})
    assert {c.claim: c for c in check(design).claims}["assumption-1"].status == "PROVED"
    claim = _claims(design)["assumption-1"]
    assert claim.status == "REFUTED"
    values = {name: Fraction(v) for name, v in claim.counterexample["parameters"].items()}
    assert min(values.values()) > 0
    v = Fraction(claim.counterexample["x"]["v"])
    assert -(values["d"] - values["e"]) * (v / values["m"]) ** 2 > 0
    assert _statuses(design)["stable"] != "PROVED"


def test_masses_whose_coupling_may_be_too_strong_are_refuted_with_values():
    design = _design(_masses(lambda p: ca.blockcat([[p.m1, p.c], [p.c, p.m2]]), c="0.5"), {"q1": "0.5"})
    assert {c.claim: c for c in check(design).claims}["stable"].status == "PROVED"
    claims = _claims(design)
    assert claims["hessian-condition"].status == "REFUTED"
    values = {name: Fraction(v) for name, v in claims["hessian-condition"].counterexample["parameters"].items()}
    assert min(values.values()) > 0
    assert values["m1"] * values["m2"] < values["c"] ** 2
    assert "where the model is defined" in claims["assumption-1"].domain  # M is singular for others
    assert claims["stable"].status == claims["asymptotically-stable"].status == "REFUTED"


SIGNS = {
    "the damping": lambda p: [1, -p.k, -(p.d - p.e)],
    "the spring": lambda p: [1, -(p.k - p.e), -p.d],
    "a product": lambda p: [1, -p.k, -(p.d * p.e - p.m)],
}


@pytest.mark.parametrize("name", SIGNS)
def test_a_sign_that_depends_on_the_parameters_is_never_proved(name):
    """The values are harmless; for others the loop is unstable, or the storage grows."""
    p = Parameters(m=2, k=3, d=5, e="0.5")
    q, v, u = _symbols("q", "v", "u")
    a, b, c = SIGNS[name](p)
    S = v**2 / (2 * p.m) - b * q**2 / 2
    system = AffineSystem([q, v], [u], [a * v / p.m, b * q + c * v / p.m], [0, 1], S, parameters=p, measured=["q"])
    weak = DynamicExtension("1/100", "1/10", 5, 1)
    found = _statuses(_design(system, {"q": 0}, weak))
    wrong = {
        "the damping": "assumption-1",
        "the spring": "hessian-condition",
        "a product": "assumption-1",
    }[name]
    assert found[wrong] != "PROVED"
    assert found["asymptotically-stable"] != "PROVED"


def test_a_stiffness_that_the_gains_do_not_hold_for_all_parameters_is_refuted():
    """An upside-down pendulum: alpha beta = 6 holds it for m g l < 6 only."""
    p = Parameters(m=1, g="9.81", l="0.1", d=1)
    q, v = _symbols("q", "p")
    system = Mechanical([q], [v], M=[[p.m * p.l**2]], V=p.m * p.g * p.l * ca.cos(q), D=[p.d], G=[[1]], parameters=p)
    assert {c.claim: c for c in check(_design(system, {"q": 0})).claims}["hessian-condition"].status == "PROVED"
    claim = _claims(_design(system, {"q": 0}))["hessian-condition"]
    assert claim.status == "REFUTED"
    values = {name: Fraction(v) for name, v in claim.counterexample["parameters"].items()}
    assert values["m"] * values["g"] * values["l"] > 6


def test_a_resting_point_that_may_leave_the_domain_is_open():
    """q2* = k/(k + 1) q1* lies within the bounds at k = 1, and it is not asked whether it does for every k."""
    free = _masses(lambda p: ca.diag(ca.vertcat(p.m1, p.m2)))
    bounded = _masses(lambda p: ca.diag(ca.vertcat(p.m1, p.m2)), domain={"q2": (-1, 1)})
    assert _statuses(_design(free, {"q1": "0.5"}))["equilibrium"] == "PROVED"
    assert _statuses(_design(bounded, {"q1": "0.5"}))["equilibrium"] == "UNDECIDED"


def test_a_resting_point_that_is_not_a_rational_function_is_open():
    """q + a q^3 = 1 gives q(a) by a cubic: the claims at x* are open, those on the whole space are not."""
    p = Parameters(a=1)
    q, v, w, u = _symbols("q", "v", "w", "u")
    f = [v, -(q + p.a * q**3) + (w - 1) * 0 - v, -w]
    system = AffineSystem([q, v, w], [u], f, [0, 1, 1], v**2 / 2 + q**2 / 2 + p.a * q**4 / 4 + w**2 / 2, parameters=p)
    found = _statuses(Design(system, {"w": "0.5"}, LAW, near={"q": "0.4"}, sample_period="1e-3", name="cubic"))
    assert found["assumption-1"] == "PROVED"
    assert found["equilibrium"] == found["asymptotically-stable"] == "UNDECIDED"


def test_a_value_that_is_not_positive_is_named():
    """The friction d + e with e = -1/10 is one of another family: what is proved speaks of positive e only."""
    design = _design(_oscillator(lambda p: p.d + p.e, e="-0.1"), {"q": "0.5"})
    claim = _claims(design)["assumption-1"]
    assert claim.status == "PROVED"
    assert "does not speak of the model's own e" in claim.evidence


def test_a_model_without_parameters_is_told_to_name_them():
    q, v, u = _symbols("q", "v", "u")
    system = AffineSystem([q, v], [u], [v, -q - v], [0, 1], (q**2 + v**2) / 2)
    with pytest.raises(ModelError, match="no parameters"):
        for_all_parameters(check(_design(system, {"q": 0})))


#: Coefficients of two parameters, positive at a = 3, b = 1; some are so for all of them.
COEFFICIENTS = {
    "a": lambda a, b: a,
    "a b": lambda a, b: a * b,
    "a + b": lambda a, b: a + b,
    "a / b": lambda a, b: a / b,
    "a - b": lambda a, b: a - b,
    "a^2 - a b + b^2": lambda a, b: a**2 - a * b + b**2,
    "a^2 - 2 a b + b^2": lambda a, b: a**2 - 2 * a * b + b**2,
    "a^2 - 2.1 a b + b^2": lambda a, b: a**2 - 2.1 * a * b + b**2,
    "a b - b^2": lambda a, b: a * b - b**2,
    "a - 2.9": lambda a, b: a - 2.9,
}


@pytest.mark.parametrize("damping", COEFFICIENTS)
@pytest.mark.parametrize("stiffness", ["a", "a b - b^2"])
def test_a_verdict_agrees_with_every_sample_of_the_parameters(damping, stiffness):
    D, K = COEFFICIENTS[damping], COEFFICIENTS[stiffness]
    p = Parameters(a=3, b=1)
    q, v, u = _symbols("q", "v", "u")
    f, S = [v, -K(p.a, p.b) * q - D(p.a, p.b) * v], v**2 / 2 + K(p.a, p.b) * q**2 / 2
    system = AffineSystem([q, v], [u], f, [0, 1], S, parameters=p, measured=["q"])
    found = _statuses(_design(system, {"q": 0}, DynamicExtension(1, "1/10", 5, 1)))
    values = 10 ** np.random.default_rng(1).uniform(-3, 3, size=(2000, 2))
    damped = [D(a, b) >= 0 for a, b in values]
    stiff = [K(a, b) + 0.1 > 0 for a, b in values]
    for claim, holds in (("assumption-1", damped), ("hessian-condition", stiff)):
        assert found[claim] != ("REFUTED" if all(holds) else "PROVED")
    if found["asymptotically-stable"] == "PROVED":
        for a, b in values[:300]:
            loop = [[0, 1, 0], [-K(a, b) - 0.1, -D(a, b), -0.1], [-0.1, 0, -5.1]]
            assert np.max(np.linalg.eigvals(loop).real) < 1e-9 * max(1, K(a, b), D(a, b))


# --- parts -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "integral"),
    [
        ("oscillator", False),
        ("buck converter", False),
        ("buck converter, full state", False),
        ("pera", False),
        ("damped masses", False),
        ("damped masses", True),
    ],
)
def test_the_closed_loop_is_that_of_the_linearisation_at_the_values(name, integral):
    design = FAMILIES[name]()
    if integral:
        design = design.with_(law=Integral(design.law, alpha_psi="0.7", beta_psi=2, R_psi="0.3"))
    report = check(design)
    wide = Wide(report.derivation)
    point, _ = _equilibrium(wide)
    matrix = wide.at_parameters(point.put_in(Stability.closed_loop(wide)))
    expected = np.array([[approximate(v) for v in row] for row in report.derivation.situation.loop.continuous()])
    own = list(wide.values.values())
    exact = np.array([[approximate(v) for v in row] for row in matrix.exact(own)])
    for found in (matrix.rounded(np.array([float(v) for v in own])), exact):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


#: Gains of an integral term on a mass with a spring and a damper, and whether it is stable for all of them.
INTEGRAL = [("0.1", "1", True), ("1", "1", True), ("1", "0", False), ("5", "0.5", False), ("9", "0.1", False)]


@pytest.mark.parametrize(("alpha", "leak", "always"), INTEGRAL)
def test_an_integral_term_is_stable_for_all_parameters_or_refuted_with_some(alpha, leak, always):
    p = Parameters(m=1, k=2, d="0.5")
    q, v = _symbols("q", "v")
    system = Mechanical([q], [v], M=[p.m], V=p.k * q**2 / 2, D=[p.d], G=[1], parameters=p)
    law = Integral(DynamicExtension(3, 2, 20, "0.5"), alpha_psi=alpha, beta_psi="0.3", R_psi=leak)
    claims = {c.claim: c for c in for_all_parameters(check(_design(system, {"q": "0.2"}, law)))}
    near = claims["asymptotically-stable"]
    assert near.status == claims["stable"].status == ("PROVED" if always else "REFUTED")
    shown = [{"m": 1, "k": 2, "d": 0.5}] if always else [near.counterexample["parameters"]]
    if always:
        shown += [dict(zip("mkd", v, strict=True)) for v in 10 ** np.random.default_rng(2).uniform(-4, 4, (500, 3))]
    for values in shown:
        m, k, d = (float(values[name]) for name in "mkd")
        b = float(alpha) * 0.3
        loop = [[0, 1 / m, 0, 0], [-k - 6, -d / m, -6, -b], [-3, 0, -13, 0], [b, 0, 0, -float(leak)]]
        assert (np.max(np.linalg.eigvals(loop).real) < 0) == always


@pytest.mark.parametrize(("damping", "expected"), [("exp", True), ("symbol", False), ("minus", False)])
def test_rouths_array_in_functions(damping, expected):
    """s^2 + d s + 1 with d = exp(a), a free symbol, and -exp(a)."""
    field = Field(["a"], 4)
    d = {"exp": field.exp(field.symbol(0)), "symbol": field.symbol(0), "minus": -field.exp(field.symbol(0))}[damping]
    zero, one = field.const(0), field.const(1)
    assert all(map(positive, routh_column([[zero, one], [-one, -d]]))) is expected


# --- the command -------------------------------------------------------------------------------------------------


def test_the_command_adds_a_table_and_a_field(capsys):
    assert execute(["check", "rlc", "--for-all-parameters"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "for all positive L1, L2, C, r, a, b" in shown
    assert "all x, all positive parameters" in shown
    assert execute(["check", "rlc", "--json", "--for-all-parameters"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {c["claim"] for c in document["for_all_parameters"]} >= {"assumption-1", "asymptotically-stable"}
    assert execute(["check", "rlc", "--json"]) == 0
    assert "for_all_parameters" not in json.loads(capsys.readouterr().out)


def test_nothing_of_it_lets_code_out(tmp_path):
    """Proved for all parameters, but the limits at the values refuse: so does the emission."""
    report = check(FAMILIES["oscillator"]().with_(limits=Limits([("-1/100", "1/100")])))
    assert not report.emittable
    assert {str(c.status) for c in for_all_parameters(report)} == {"PROVED"}
    assert not report.emittable


@pytest.mark.parametrize("where", ["S", "gamma", "V"])
def test_nothing_is_said_for_all_parameters_of_a_model_that_jumps(where):
    """Derivatives do not show a jump, and the parameters move x* across it."""
    x, p = _symbols("x", "p")
    k = Parameters(k=2)
    jump = ca.floor(k.k * x)
    if where == "V":
        system = Mechanical([x], [p], M=[1], V=k.k * x**2 / 2 + jump, D=[1], G=[1], parameters=k)
    else:
        S = k.k * x**2 / 2 + p**2 / 2 + (jump if where == "S" else 0)
        gamma = x + jump if where == "gamma" else None
        system = AffineSystem([x, p], ca.SX.sym("u"), [p, -k.k * x - p], [0, 1], S, parameters=k, gamma=gamma)
    claims = for_all_parameters(check(_design(system, {"x": "0.3"})))
    assert {claim.status for claim in claims} == {"UNDECIDED"}
    assert all("floor" in claim.evidence for claim in claims)


def test_a_target_on_the_edge_of_the_domain_is_no_equilibrium_of_the_model():
    x, p = _symbols("x", "p")
    k = Parameters(k=2)
    S = k.k * x**2 / 2 + p**2 / 2
    for value, status in ((0, "UNDECIDED"), ("0.1", "PROVED")):
        system = AffineSystem(
            [x, p], ca.SX.sym("u"), [p, -k.k * x - p], [0, 1], S, parameters=k, domain={"x": (0, None)}
        )
        claims = {c.claim: c for c in for_all_parameters(check(_design(system, {"x": value})))}
        assert claims["equilibrium"].status == claims["asymptotically-stable"].status == status


def test_theta_is_refuted_by_a_state_at_parameters_not_by_constants_that_are_too_small():
    """The friction d p + p cosh p is at least (d + 1) p; the structure for all parameters has d alone."""
    q1, q2, p1, p2 = _symbols("q1", "q2", "p1", "p2")
    d = Parameters(d=1)
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l="0.6", R_l=1, Upsilon=1)

    def theta(more):
        f = [p1, -2 * q1 + q2 - d.d * p1 - more(p1), p2, q1 - q2 - d.d * p2 - more(p2)]
        S = (q1**2 + (q1 - q2) ** 2 + p1**2 + p2**2) / 2
        system = AffineSystem(
            [q1, p1, q2, p2], ca.SX.sym("u"), f, [0, 1, 0, 0], S, parameters=d, eta=[q2], measured=["q1", "q2"]
        )
        claims = for_all_parameters(check(_design(system, {"q1": 0, "q2": 0}, law)))
        return next(claim for claim in claims if claim.claim == "theta")

    found = theta(lambda p: 0)
    assert found.status == "REFUTED"
    assert Fraction(found.counterexample["Theta form"]) < 0
    assert theta(lambda p: p * ca.cosh(p)).status != "REFUTED"
