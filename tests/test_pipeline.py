"""From design to verdicts and a running controller: every law, several inputs, and three ways to write one model."""

from functools import lru_cache

import casadi as ca
import numpy as np
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
    pipeline,
)
from pbcgen.errors import EmitError, ModelError, NotProved
from pbcgen.law.law import VectorSolve
from pbcgen.models.loader import load
from pbcgen.run.simulate import PythonStepper, simulate_continuous, simulate_sampled

FULL_K = [[3, 1], [1, 2]]
FULL_R = [[1, "-0.2"], ["-0.2", "0.5"]]


def _chain(measured=None, damping=("0.5", "0.1", "0.4")):
    """Three masses in a row, forces on the outer ones."""
    q = [ca.SX.sym(f"q{k}") for k in range(3)]
    p = [ca.SX.sym(f"p{k}") for k in range(3)]
    V = (q[0] - q[1]) ** 2 + (q[1] - q[2]) ** 2 / 2 + q[1] ** 2 / 2
    D = [float(d) for d in damping]
    G = ca.DM([[1, 0], [0, 0], [0, 1]])
    return Mechanical(q, p, M=[1, 2, 1], V=V, D=D, G=G, inputs=["u1", "u2"], measured=measured)


def _arm():
    """Two links with gravity."""
    q = [ca.SX.sym("q1"), ca.SX.sym("q2")]
    p = [ca.SX.sym("p1"), ca.SX.sym("p2")]
    c = ca.cos(q[1])
    V = 10 * (1 - ca.cos(q[0])) + 3 * (1 - ca.cos(q[0] + q[1]))
    return Mechanical(q, p, M=[[3 + c, 1 + c / 2], [1 + c / 2, 1]], V=V, D=[2, 1], G=[[1, 0], [0, 1]])


def _port_hamiltonian(m):
    """Four states with damping everywhere and m inputs: outputs with feedthrough."""
    x = [ca.SX.sym(f"x{k}") for k in range(4)]
    u = [ca.SX.sym(f"u{k}") for k in range(m)]
    J = ca.DM([[0, 1, 0, 2], [-1, 0, 1, 0], [0, -1, 0, 0], [-2, 0, 0, 0]])
    R = ca.diag(ca.DM([1, 0.5, 0.2, 0.1]))
    S = x[0] ** 2 / 2 + x[1] ** 4 / 4 + x[1] ** 2 / 2 + (x[2] - x[3]) ** 2 + x[3] ** 2 / 2
    g = ca.DM([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1]])[:, :m]
    return AffineSystem(x, u, ca.mtimes(J - R, ca.gradient(S, ca.vertcat(*x))), g, S)


def _designs():
    chain_target = {"q0": "0.3", "q2": "-0.2"}
    arm_target = {"q1": "0.5", "q2": "-0.3"}
    full = {"K_c": FULL_K, "R_c": FULL_R}
    three = {
        "K_c": [[2, 1, 0], [1, 3, 1], [0, 1, 4]],
        "R_c": [[1, "0.2", 0], ["0.2", 1, "0.1"], [0, "0.1", 2]],
    }
    extension = DynamicExtension(alpha=[2, 3], beta=[1, 2], **full)
    natural = NaturalDamping(
        alpha_c=[2, 3], beta_c=1, **full, alpha_l="0.5", beta_l=1, K_l=[1, 2], R_l=[200, 100], Upsilon=[[1], [-1]]
    )
    return {
        "dynamic extension, two inputs, full K_c and R_c": (_chain(), chain_target, extension, 8),
        "natural damping, s = 1 and m = 2": (_chain(), chain_target, natural, 8),
        "passive output, two inputs": (
            _chain(measured=["q0", "q1", "q2", "p0", "p2"]),
            chain_target,
            PassiveOutput(alpha=[2, 3], beta=1, k_p=[1, 2]),
            8,
        ),
        "passive output with an algebraic loop, three inputs": (
            _port_hamiltonian(3),
            {"x0": "0.3", "x1": "0.1", "x3": "-0.2"},
            PassiveOutput(alpha=[2, 3, 4], beta=1, k_p=[1, 2, 3]),
            20,
        ),
        "dynamic extension, three inputs, full K_c and R_c": (
            _port_hamiltonian(3),
            {"x0": "0.3", "x1": "0.1", "x3": "-0.2"},
            DynamicExtension(alpha=[2, 3, 4], beta=1, **three),
            20,
        ),
        "potential compensation": (_arm(), arm_target, PotentialCompensation([8, 5], [2, 3], **full), 30),
        "integral on dynamic extension": (
            _arm(),
            arm_target,
            Integral(DynamicExtension([8, 5], [2, 3], **full), alpha_psi=1, beta_psi=1, R_psi=["0.1", "0.2"]),
            30,
        ),
        "integral on potential compensation": (
            _arm(),
            arm_target,
            Integral(PotentialCompensation([8, 5], [2, 3], **full), alpha_psi=1, beta_psi=1, R_psi=0),
            30,
        ),
    }


@lru_cache(maxsize=16)
def _report(name):
    model, target, law, limit = _designs()[name]
    design = Design(
        model, target=target, law=law, limits=Limits.symmetric(limit), sample_period="1e-3", name="case", duration=20
    )
    return pipeline.check(design)


def _status(report):
    return {c.claim: str(c.status) for c in report.claims}


@pytest.mark.system
@pytest.mark.parametrize("name", _designs())
def test_a_sound_design_is_proved_and_may_be_emitted(name):
    report = _report(name)
    found = _status(report)
    for claim in ("equilibrium", "assumption-1", "passive-output", "stable", "asymptotically-stable", "sampled-stable"):
        assert found[claim] == "PROVED", claim
    assert found["saturation"] == found["measurability"] == "PROVED"
    assert report.emittable
    assert all(c.hint or str(c.status) == "PROVED" for c in report.claims)


@pytest.mark.system
@pytest.mark.parametrize("name", _designs())
def test_both_closed_loops_reach_the_target_within_the_interval(name):
    report = _report(name)
    loop, law = report.loop, report.control
    start = report.loop.x_star + 0.1 * np.cos(np.arange(len(report.loop.x_star)))
    object.__setattr__(loop, "initial", start)
    continuous = simulate_continuous(loop, np.linspace(0, 40, 401))
    sampled = simulate_sampled(loop, PythonStepper(law), law.sample_period, 0.2)
    lo, hi = (np.array([float(pair[k]) for pair in law.intervals]) for k in (0, 1))
    for run in (continuous, sampled):
        assert np.all(run.u >= lo - 1e-12)
        assert np.all(run.u <= hi + 1e-12)
    assert np.abs(continuous.x[-1] - loop.x_star).max() < 0.3 * np.abs(start - loop.x_star).max()
    same_time = np.array([np.interp(0.2, continuous.times, column) for column in continuous.x.T])
    np.testing.assert_allclose(sampled.x[-1], same_time, atol=5e-3)


@pytest.mark.system
def test_full_gains_and_algebraic_loops_are_solved_as_blocks():
    for name in (
        "dynamic extension, two inputs, full K_c and R_c",
        "passive output with an algebraic loop, three inputs",
    ):
        (solve,) = _report(name).control.solves
        assert isinstance(solve, VectorSolve)


# --- refusals ----------------------------------------------------------------------------------------------------


def _quick(**changes):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    model = Mechanical([q], [p], M=[1], V=-2 * ca.cos(q), D=[1], G=[1], inputs=["u"], **changes.pop("model", {}))
    arguments = {
        "target": {"q": "0.5"},
        "law": DynamicExtension(alpha=1, beta=4, K_c=4, R_c=1),
        "limits": Limits.symmetric(3),
        "sample_period": "1e-2",
        "name": "pendulum",
    }
    return pipeline.check(Design(model, **{**arguments, **changes}))


def test_a_pendulum_is_emittable():
    assert _quick().emittable


@pytest.mark.parametrize(
    ("changes", "claim"),
    [
        ({"limits": Limits.symmetric("1.9")}, "saturation"),
        ({"target": {"q": 3}, "law": DynamicExtension(alpha=1, beta=1, K_c=4, R_c=1)}, "asymptotically-stable"),
        ({"model": {"measured": ["p"]}}, "measurability"),
        ({"sample_period": 3, "law": DynamicExtension(alpha=1, beta=100, K_c=100, R_c=1)}, "sampled-stable"),
        ({"target": ["0.5", "0.1"]}, "equilibrium"),
    ],
)
def test_a_design_with_a_defect_is_refused_and_the_claim_named(changes, claim):
    report = _quick(**changes)
    assert _status(report)[claim] != "PROVED"
    assert not report.emittable
    assert claim in {c.claim for c in report.blocking()}
    with pytest.raises(NotProved, match=claim):
        pipeline.package(report)


def test_a_claim_may_be_allowed_by_name_and_the_package_says_so():
    report = _quick(limits=Limits.symmetric("1.9"))
    package = pipeline.package(report, allow=["saturation"])
    assert any("saturation" in text for name, text in package.files.items() if name.endswith(".h"))


# --- one model, three ways ---------------------------------------------------------------------------------------


def _lc_as_circuit():
    i, v = ca.SX.sym("i"), ca.SX.sym("v")
    return Circuit([i], [v], L=[2], C=[0.5], Gamma=[[1]], v_R=[3 * i], i_G=[0.25 * v], g_L=[-1], inputs=["u"])


def _lc_as_affine():
    """The same differential equation with the energy as storage."""
    i, v, u = (ca.SX.sym(name) for name in ("i", "v", "u"))
    f = [(-v - 3 * i) / 2, (i - 0.25 * v) / 0.5]
    return AffineSystem([i, v], [u], f, [0.5, 0], i**2 + v**2 / 4)


def _mass_as_mechanical():
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    return Mechanical([q], [p], M=[2], V=3 * q**2 / 2 + q**4 / 4, D=[0.5], G=[1], inputs=["u"])


def _mass_as_affine():
    q, p, u = (ca.SX.sym(name) for name in ("q", "p", "u"))
    f = [p / 2, -3 * q - q**3 - 0.5 * p / 2]
    return AffineSystem([q, p], [u], f, [0, 1], p**2 / 4 + 3 * q**2 / 2 + q**4 / 4)


def _mass_from_lagrangian():
    q, p, v = (ca.SX.sym(name) for name in ("q", "p", "v"))
    return Mechanical.from_lagrangian([q], [p], [v], T=v**2, V=3 * q**2 / 2 + q**4 / 4, D=[0.5], G=[1], inputs=["u"])


def _check(model, target):
    law = DynamicExtension(alpha=2, beta=1, K_c=3, R_c=1)
    return pipeline.check(Design(model, target=target, law=law, sample_period="1e-2", name="same"))


@pytest.mark.parametrize(
    ("models", "target"),
    [
        ((_lc_as_circuit, _lc_as_affine), {"v": "0.4"}),
        ((_mass_as_mechanical, _mass_as_affine), {"q": "0.4"}),
    ],
)
def test_two_ways_to_write_a_model_give_the_same_verdicts(models, target):
    first, second = (_check(model(), target) for model in models)
    for claim in ("equilibrium", "assumption-1", "passive-output", "stable", "asymptotically-stable", "sampled-stable"):
        assert _status(first)[claim] == _status(second)[claim] == "PROVED", claim
    np.testing.assert_allclose(first.derived["x_star"], second.derived["x_star"], rtol=1e-14)
    np.testing.assert_allclose(first.derived["kappa"], second.derived["kappa"], rtol=1e-14)


def test_a_mass_on_a_spring_has_the_same_numbers_in_both_forms():
    first, second = _check(_mass_as_mechanical(), {"q": "0.4"}), _check(_mass_as_affine(), {"q": "0.4"})
    assert first.derived["gamma"] == second.derived["gamma"] == ["q"]
    for key in ("hessian_min_eigenvalue", "spectral_abscissa", "kc_min"):
        assert first.derived[key] == pytest.approx(second.derived[key], rel=1e-12)


def test_measured_expressions_are_enough_when_they_give_gamma():
    """gamma = q is read as the difference of two sensors that both see a hidden state."""
    q, p, z, u = (ca.SX.sym(name) for name in ("q", "p", "z", "u"))
    f = [p, -q - p - 0.1 * (p + z), -z - 0.1 * p]
    S = (q**2 + p**2 + z**2) / 2
    sensors = [{"left": 2 * q + z}, {"right": q + z}]
    system = AffineSystem([q, p, z], [u], f, [0, 1, 0], S, measured=sensors)
    report = _check(system, {"q": "0.4"})
    assert _status(report)["measurability"] == "PROVED"
    blind = AffineSystem([q, p, z], [u], f, [0, 1, 0], S, measured=[{"left": 2 * q + z}])
    assert _status(_check(blind, {"q": "0.4"}))["measurability"] != "PROVED"


def test_gains_that_no_float_holds_leave_the_verdicts_and_say_why(tmp_path):
    design = load("rlc").with_(law=DynamicExtension(alpha="0.0485", beta="1e45", K_c=10, R_c=10))
    report = pipeline.check(design)
    assert report.control is None
    assert not report.emittable
    assert "does not fit a float: choose double precision" in report.unwritable
    with pytest.raises(EmitError, match="a product of h, alpha, beta and R"):
        pipeline.generate(design, tmp_path)


def test_formulas_show_numbers_of_the_model_and_not_their_symbols():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    S = 0.7 * x[0] ** 2 / 2 + 0.3 * x[1] ** 2
    F = ca.SX([[-1, 1], [-1, -0.4]])
    system = AffineSystem(x, u, F @ ca.gradient(S, x), [0, 1], S, measured={"a": x[0], "b": x[1]})
    law = DynamicExtension(alpha=1, beta=1, K_c=1, R_c=1)
    (gamma,) = pipeline.check(Design(system, {"x_0": 1}, law, sample_period="1e-2")).derived["gamma"]
    assert "c_" not in gamma
    assert [eval(gamma, {"x_0": a, "x_1": b}) for a, b in ((1, 0), (0, 1))] == pytest.approx([1 / 1.4] * 2)


@pytest.mark.parametrize("run", [pipeline.simulate, pipeline.validate])
def test_a_run_that_would_begin_outside_of_the_domain_names_the_state(run):
    h, q = ca.SX.sym("h"), ca.SX.sym("q")
    tank = AffineSystem([h], [q], [-ca.sqrt(h)], [1], 2 * h * ca.sqrt(h) / 3, domain={"h": ("0.1", 2)})
    law = DynamicExtension(alpha="0.4", beta=1, K_c=1, R_c=1)
    design = Design(tank, {"h": 1}, law, sample_period="1e-2", name="tank")
    with pytest.raises(ModelError, match=r"begin at h = 0, outside of its domain \[0.1, 2\].*initial=\{'h'"):
        run(design)
    assert pipeline.simulate(design.with_(initial={"h": "0.5"})).continuous.x[-1, 0] == pytest.approx(1, abs=0.05)
