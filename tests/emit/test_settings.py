"""The functions that change a target or gains, start without a jump, and test themselves: C against the reference."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction

import casadi as ca
import hand_made_laws as laws
import numpy as np
import pytest

from pbcgen.emit import render
from pbcgen.law.law import Signal
from pbcgen.law.step import ReferenceStep, StepStatus
from pbcgen.run.wrapper import Controller
from pbcgen.symbolic.tape import Tape


@pytest.fixture(scope="module", params=["float", "double"])
def step(request):
    return ReferenceStep(laws.adjustable(request.param))


@pytest.fixture(scope="module")
def controller(step):
    with Controller.of_package(render(step.law, laws.PROVENANCE, extras=laws.EXTRAS)) as controller:
        yield controller


@pytest.mark.parametrize(
    "value", [0.01, 0.0100001, 0.02, 0.029, 0.03, 0.0099, 0.031, -1, 1e30, np.nan, np.inf, -np.inf]
)
def test_a_target_is_stored_or_refused_as_in_the_reference(controller, step, value):
    controller.reset()
    before = controller.xi.copy()
    expected, status = step.set("target", before, [value])
    found = controller.set_target(i_D=value)
    assert found == f"ADJUSTABLE_{status.name}"
    assert (found == "ADJUSTABLE_OK") == (0.01 <= value <= 0.03)
    np.testing.assert_allclose(controller.xi, expected, rtol=8 * np.finfo(step.dtype).eps)
    if status is not StepStatus.OK:
        np.testing.assert_array_equal(controller.xi, before)


def test_steps_after_settings_are_those_of_the_reference(controller, step):
    controller.reset()
    assert controller.set_target(i_D=0.025) == "ADJUSTABLE_OK"
    assert controller.set_gains(alpha=1.75) == "ADJUSTABLE_OK"
    xi, last = controller.xi.copy(), None
    for v in np.linspace(0, 6, 50):
        xi, last, status = step(np.array([v]), xi, last)
        u = controller.advance([v])
        assert status == StepStatus.OK
        np.testing.assert_allclose(u, last, atol=1e-5 if step.dtype == np.float32 else 1e-12)


def test_an_invalid_measurement_gives_the_equilibrium_input_of_the_target_that_was_set(controller):
    controller.reset()
    controller.set_target(i_D=0.025)
    assert controller.step(v=float("nan"))["u"] == pytest.approx(np.log(26))


def test_a_corrupted_target_goes_back_to_the_declared_one(controller):
    controller.reset()
    controller.set_target(i_D=0.025)
    controller.state = {"x_c": 0.0, "x_star": float("nan"), "alpha": 1.0}
    assert controller.step(v=3.0)["u"] == pytest.approx(3.044522, abs=0.1)
    assert controller.status == "ADJUSTABLE_STATE_RESET"
    assert controller.state["x_star"] == pytest.approx(np.log(21))


def test_a_start_without_a_jump_meets_the_reference(controller, step):
    controller.reset()
    controller.set_target(i_D=0.012)
    before = controller.xi.copy()
    assert controller.start_at(v=1.0) == "ADJUSTABLE_OK"
    expected, status = step.start(before, [1.0])
    assert status is StepStatus.OK
    np.testing.assert_allclose(controller.xi, expected, rtol=1e-6)
    assert controller.step(v=1.0)["u"] == pytest.approx(np.log(13), rel=1e-6)


def test_the_self_test_passes_and_sees_a_wrong_constant(controller, step):
    assert controller.selftest() == 0
    package = render(step.law, laws.PROVENANCE, extras=laws.EXTRAS)
    text = package.files["adjustable.c"]
    broken = text.replace(
        "out_u = state->x_star", f"out_u = {'0.99f' if step.dtype == np.float32 else '0.99'} * state->x_star"
    )
    assert broken != text
    files = dict(package.files) | {"adjustable.c": broken}
    with Controller(files, controller.interface) as other:
        assert other.selftest() > 0


def test_names_of_settings_are_legal_and_free_and_reported():
    law = laws.adjustable()
    target, gains = law.setters
    odd = replace(target, inputs=(replace(target.inputs[0], signal=Signal("θ [A]", "A")),))
    clash = replace(law, setters=(odd, gains), outputs=(Signal("target_theta_A", "V"),))
    package = render(clash, laws.PROVENANCE)
    header = package.files["adjustable.h"]
    assert "float theta_A;" in header
    assert ("θ [A]", "theta_A") in package.renamed
    macros = [line.split()[1] for line in header.splitlines() if line.startswith("#define")]
    assert len(macros) == len(set(macros))


def test_packages_without_settings_say_nothing_of_them():
    package = render(laws.two_channels(), laws.PROVENANCE)
    assert "SETTING" not in "".join(package.files.values())
    assert "settings" not in json.loads(package.files["manifest.json"])


def test_a_symmetric_limit_is_one_comparison_with_the_values_of_fmin_and_fmax():
    law = laws.adjustable()
    m, xi, t = ca.SX.sym("m", 1), ca.SX.sym("xi", 3), ca.SX.sym("t", 1)
    limited = ca.fmax(-2.5, ca.fmin(2.5, m + xi[0]))
    outside = ca.fmin(2.5, ca.fmax(-2.5, m + xi[0]))  # gives -2.5 for NaN: another function
    update = Tape.of([m, xi, t], [ca.vertcat(limited, xi[1], xi[2]), outside + t])
    law = replace(law, update=update, intervals=((Fraction(-4), Fraction(6)),))
    package = render(law, laws.PROVENANCE)
    assert package.files["adjustable.c"].count("= adjustable_limit(") == 1
    step = ReferenceStep(law)
    values = np.array([0, -0.0, 1, -1, 2.5, -2.5, 2.6, -2.6, 1e30, -1e30], np.float32)
    states = np.tile(step.initial, (len(values), 1))
    with Controller.of_package(package) as controller:
        xi_next, u, _ = controller.step_many(values[:, None], states)
    expected, u_expected, _ = step(values[:, None], states)
    assert xi_next.tobytes() == expected.tobytes()
    assert u.tobytes() == u_expected.tobytes()
