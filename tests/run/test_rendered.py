"""Packages as the generator renders them: loaded by name, validated as a whole."""

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import casadi as ca
import numpy as np
import oscillator
import pytest

from pbcgen.emit.package import Package, Provenance, render
from pbcgen.errors import ToolchainError
from pbcgen.law.closed_loop import ClosedLoop
from pbcgen.law.law import ControlLaw, Fallback, ScalarSolve, Signal, VectorSolve
from pbcgen.run.toolchain import find_zig
from pbcgen.run.validate import validate
from pbcgen.run.wrapper import Controller, Interface
from pbcgen.symbolic.tape import Tape

ALPHA, BETA = np.array([0.6, 0.3]), np.array([5.0, 20.0])
R_C = np.array([[2.0, 0.5], [0.5, 1.0]])
K_C = np.array([[1.5, -0.25], [-0.25, 2.0]])


def rendered(law: ControlLaw) -> Package:
    return render(law, Provenance("0" * 64, ()))


def pendulums() -> ClosedLoop:
    """Two damped pendulums with a spring between them; the controller measures the sines of the angles."""
    x, u, x_c = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("x_c", 2)
    angles, rates = x[:2], x[2:]
    spring = 0.5 * (angles[0] - angles[1]) * ca.vertcat(1, -1)
    t = ca.tanh(BETA * (ca.sin(angles) + x_c))
    return ClosedLoop(
        plant=ca.Function("plant", [x, u], [ca.vertcat(rates, -ca.sin(angles) - spring - 0.3 * rates + u)]),
        measure=ca.Function("measure", [x], [angles]),
        controller=ca.Function("controller", [x, x_c], [-R_C @ (ALPHA * t + K_C @ x_c), -ALPHA * t]),
        lyapunov=None,
        x_star=np.zeros(4),
        u_star=np.zeros(2),
        controller_states=("x_c1", "x_c2"),
        initial=np.array([0.8, -0.4, 0.0, 0.0]),
        duration=4.0,
        state_names=("q1", "q2", "p1", "p2"),
        state_units=("rad", "rad", "rad/s", "rad/s"),
        input_names=("u1", "u2"),
        input_units=("N m", "N m"),
    )


def coupled_law(precision: str = "double", h: Fraction = Fraction(1, 50)) -> ControlLaw:
    """Backward Euler with full R_c and K_c: x+ = P (x - h R A t), s + B P h R A t = B (sin q + P x)."""
    q, x_c, t = ca.SX.sym("q", 2), ca.SX.sym("x_c", 2), ca.SX.sym("t", 2)
    P = np.linalg.inv(np.eye(2) + float(h) * R_C @ K_C)
    pull = P @ (float(h) * R_C * ALPHA)
    return ControlLaw(
        name="pendulums",
        law="dynamic-extension",
        precision=precision,
        sample_period=h,
        inputs=(Signal("q1", "rad"), Signal("q2", "rad")),
        outputs=(Signal("double", "N m"), Signal("u2", "N m")),
        states=(Signal("x_c1"), Signal("x_c2")),
        prepare=Tape.of([q, x_c], [BETA * (ca.sin(q) + P @ x_c), ca.SX(BETA[:, None] * pull)]),
        update=Tape.of([q, x_c, t], [P @ x_c - pull @ t, -ALPHA * t]),
        solves=(VectorSolve((0, 1), 12, 1e-5 if precision == "float" else 1e-13),),
        intervals=((Fraction(-3, 5), Fraction(3, 5)), (Fraction(-3, 10), Fraction(3, 10))),
        equilibrium_output=(0.0, 0.0),
        fallback=Fallback.LAST_OUTPUT,
    )


@pytest.mark.parametrize("precision", ["float", "double"])
@pytest.mark.parametrize("fallback", list(Fallback))
def test_a_rendered_scalar_law_validates(precision: str, fallback: Fallback) -> None:
    law = replace(oscillator.law(precision), fallback=fallback)
    stages: list[str] = []
    validation = validate(
        law,
        rendered(law),
        oscillator.loop(),
        lambda h: oscillator.law(h=h),
        samples=4000,
        steps=150,
        progress=stages.append,
    )
    assert validation.passed, validation
    assert validation.agreement.u_ulp < 4
    assert stages[0] == "compile"


@pytest.mark.parametrize("precision", ["float", "double"])
def test_a_rendered_coupled_law_validates(precision: str) -> None:
    law = coupled_law(precision)
    validation = validate(law, rendered(law), pendulums(), lambda h: coupled_law(h=h), samples=4000, steps=200)
    assert validation.passed, validation
    assert validation.agreement.trajectory_u_ulp < 50
    assert validation.convergence.orders[-1] == pytest.approx(1.0, abs=0.1)
    assert [output.name for output in validation.outputs] == ["double", "u2"]


def test_a_package_of_other_gains_is_rejected() -> None:
    law = coupled_law()
    other = rendered(replace(law, update=oscillating_update(1 + 1e-9)))
    validation = validate(law, other, pendulums(), lambda h: coupled_law(h=h), samples=400, steps=20)
    assert not validation.agreement.passed
    assert not validation.passed


def oscillating_update(factor: float) -> Tape:
    q, x_c, t = ca.SX.sym("q", 2), ca.SX.sym("x_c", 2), ca.SX.sym("t", 2)
    P = np.linalg.inv(np.eye(2) + 0.02 * R_C @ K_C)
    return Tape.of([q, x_c, t], [P @ x_c - P @ (0.02 * R_C * ALPHA) @ t, -ALPHA * t * factor])


def test_a_package_of_another_law_is_refused() -> None:
    with pytest.raises(ToolchainError, match="does not belong to the law of `oscillator`"):
        validate(oscillator.law(), rendered(coupled_law()), oscillator.loop(), lambda h: oscillator.law(h=h), steps=10)


@pytest.mark.system
def test_zig_and_cc_compile_to_the_same_controller() -> None:
    zig = find_zig()
    if zig is None:
        pytest.skip("ziglang is not installed")
    package, generator = rendered(coupled_law("float")), np.random.default_rng(5)
    m, states = generator.normal(size=(1000, 2)), generator.normal(size=(1000, 4))
    with Controller.of_package(package) as cc, Controller.of_package(package, compiler=zig) as other:
        for first, second in zip(cc.step_many(m, states), other.step_many(m, states), strict=True):
            np.testing.assert_array_equal(first, second)


def test_users_names_stay_where_c_renames() -> None:
    with Controller.of_package(rendered(coupled_law())) as controller:
        assert set(controller.step(q1=0.1, q2=0.2)) == {"double", "u2"}


def test_a_written_package_is_loaded_and_left_as_it_was(tmp_path: Path) -> None:
    rendered(oscillator.law()).write(tmp_path)
    before = sorted(path.name for path in tmp_path.iterdir())
    with Controller.of_directory(tmp_path) as controller:
        assert controller.step(position=1.0)["force"] < -0.7
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_directory_without_a_package_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ToolchainError, match=r"holds no package: .*manifest\.json"):
        Controller.of_directory(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", "{}", json.dumps({"prefix": "p"})])
def test_a_damaged_manifest_is_refused(text: str) -> None:
    with pytest.raises(ToolchainError, match="generate it again"):
        Interface.of_manifest(text)


def test_an_unknown_precision_is_refused() -> None:
    document = json.loads(rendered(oscillator.law()).files["manifest.json"]) | {"precision": "half"}
    with pytest.raises(ToolchainError, match="precision `half`"):
        Interface.of_manifest(json.dumps(document))


def test_scalar_solves_may_stand_in_any_order() -> None:
    """Two channels that are solved one by one, listed in reverse."""
    law = oscillator.law()
    q, x_c, t = ca.SX.sym("q"), ca.SX.sym("x_c"), ca.SX.sym("t", 2)
    law = replace(
        law,
        prepare=Tape.of([q, x_c], [ca.vertcat(q, 2 * q), ca.diag(ca.SX([0.5, 90.0]))]),
        update=Tape.of([q, x_c, t], [0.5 * x_c, -0.5 * t[0] - 0.25 * t[1]]),
        solves=(ScalarSolve(1, 8, 1e-9), ScalarSolve(0, 8, 1e-9)),
    )
    validation = validate(law, rendered(law), oscillator.loop(), lambda h: law, samples=400, steps=10)
    assert validation.agreement.passed


def test_a_law_without_a_state_validates() -> None:
    x, q, t, none = ca.SX.sym("x", 2), ca.SX.sym("q"), ca.SX.sym("t"), ca.SX.sym("none", 0)
    law = replace(
        oscillator.law("float"),
        states=(),
        prepare=Tape.of([q, none], [oscillator.BETA * q, ca.SX(0)]),
        update=Tape.of([q, none, t], [ca.SX(0, 1), -oscillator.ALPHA * t]),
    )
    feedback = ca.Function("controller", [x, none], [ca.SX(0, 1), -oscillator.ALPHA * ca.tanh(oscillator.BETA * x[0])])
    loop = replace(oscillator.loop(), controller=feedback, controller_states=())
    double = replace(law, precision="double")
    validation = validate(law, rendered(law), loop, lambda h: replace(double, sample_period=h), samples=2000, steps=200)
    assert validation.passed, validation
    assert validation.agreement.xi_ulp == 0.0
