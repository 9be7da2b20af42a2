import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction

import casadi as ca
import numpy as np
import oscillator
import pytest

from pbcgen.law.step import ReferenceStep
from pbcgen.run.agreement import Allowance, _Inexact
from pbcgen.run.simulate import PythonStepper, simulate_sampled
from pbcgen.run.validate import Validation, check_limits, compare, observe_order, validate_controller
from pbcgen.run.wrapper import Controller
from pbcgen.symbolic.tape import OPERATIONS, Tape


@contextmanager
def compiled(precision: str = "double", **fault: object) -> Iterator[Controller]:
    with Controller(oscillator.files(precision, **fault), oscillator.interface(precision)) as controller:
        yield controller


def rediscretised(h: Fraction) -> PythonStepper:
    return PythonStepper(oscillator.law(h=h))


def validated(precision: str = "double", **fault: object) -> Validation:
    law, loop = oscillator.law(precision), oscillator.loop()
    with compiled(precision, **fault) as controller:
        return validate_controller(law, controller, loop, rediscretised, samples=4000, steps=150)


def compared(precision: str, **fault: object):
    loop = oscillator.loop(2.0)
    with compiled(precision, **fault) as controller:
        run = simulate_sampled(loop, controller, oscillator.PERIOD, 2.0)
        return compare(oscillator.law(precision), controller, loop, run, samples=4000)


@pytest.mark.parametrize("precision", ["float", "double"])
def test_a_correct_controller_passes_all_three_tests(precision: str) -> None:
    validation = validated(precision)
    assert validation.passed
    assert validation.agreement.u_ulp < 4
    assert validation.agreement.xi_ulp < 4
    assert validation.agreement.samples >= 4000
    assert validation.agreement.trajectory_samples == 151
    assert validation.convergence.orders == pytest.approx((1.0, 1.0), abs=0.05)
    (force,) = validation.outputs
    assert (force.smallest, force.largest) == (-0.75, 0.75)


def test_all_figures_are_in_the_json() -> None:
    document = json.loads(json.dumps(validated().as_json(), allow_nan=False))
    assert document["passed"] is True
    assert document["agreement"]["u_ulp"] < 4
    assert len(document["convergence"]["errors"]) == 3
    assert document["outputs"][0]["interval"] == ["-3/4", "3/4"]


@pytest.mark.system
def test_validation_is_reproducible() -> None:
    assert validated().as_json() == validated().as_json()


def test_a_flipped_sign_is_rejected() -> None:
    agreement, _ = compared("double", alpha=-oscillator.ALPHA)
    assert not agreement.passed
    assert agreement.share > 1e10


@pytest.mark.parametrize("precision", ["float", "double"])
def test_a_gain_that_is_off_by_a_hundred_thousandth_is_rejected(precision: str) -> None:
    agreement, _ = compared(precision, beta=oscillator.BETA * (1 + 1e-5))
    assert not agreement.passed
    assert agreement.worst["u_c"] != agreement.worst["u_python"]


def test_a_gain_that_is_off_by_a_few_ulp_of_double_is_rejected() -> None:
    agreement, _ = compared("double", beta=oscillator.BETA * (1 + 2**-45))
    assert not agreement.passed


def test_an_output_that_is_not_clamped_is_caught() -> None:
    agreement, u = compared("double", alpha=0.8, clamp=False)
    (force,) = check_limits(oscillator.law(), [u])
    assert not force.passed
    assert force.largest == 0.8
    assert not agreement.passed


def test_one_ulp_beyond_the_limit_is_beyond_the_limit() -> None:
    law = replace(oscillator.law(), intervals=((Fraction(-3, 4), Fraction(1, 10)),))
    inside, beyond = np.array([[np.nextafter(0.1, 0)]]), np.array([[0.1]])  # the double 0.1 is above 1/10
    assert check_limits(law, [inside])[0].passed
    assert not check_limits(law, [inside, beyond])[0].passed


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_output_that_is_no_number_is_outside(value: float) -> None:
    (force,) = check_limits(oscillator.law(), [np.array([[0.0], [value]])])
    assert not force.passed


@pytest.mark.system
def test_a_law_for_another_sample_period_does_not_converge() -> None:
    loop = oscillator.loop()
    right, _ = observe_order(loop, rediscretised, oscillator.PERIOD, 200)
    wrong, _ = observe_order(loop, lambda h: PythonStepper(oscillator.law(h=2 * h, stated=h)), oscillator.PERIOD, 200)
    assert right.passed
    assert not wrong.passed
    assert "does not vanish" in wrong.note


def test_a_law_that_keeps_its_old_coefficients_does_not_converge() -> None:
    loop = oscillator.loop()
    stale, _ = observe_order(loop, lambda h: PythonStepper(oscillator.law(stated=h)), oscillator.PERIOD, 200)
    assert not stale.passed


def test_no_order_is_claimed_below_the_accuracy_of_the_integration() -> None:
    loop = replace(oscillator.loop(), initial=np.zeros(2))
    convergence, _ = observe_order(loop, rediscretised, oscillator.PERIOD, 20)
    assert convergence.passed
    assert "no order to be seen" in convergence.note


def test_the_allowance_is_a_few_ulp_for_a_well_conditioned_law() -> None:
    generator = np.random.default_rng(1)
    law = oscillator.law("float")
    m, xi = generator.normal(size=(100, 1)), generator.normal(size=(100, 1))
    xi_allowed, u_allowed = Allowance(law)(m, xi)
    epsilon = 2.0**-23
    assert u_allowed.shape == xi_allowed.shape == (100, 1)
    assert np.all(u_allowed < 32 * epsilon * oscillator.ALPHA)
    assert np.all(xi_allowed < 16 * epsilon * np.maximum(1, np.abs(xi)))


def test_the_allowance_does_not_overflow_before_the_law_does() -> None:
    m = np.array([[1e307], [-1e307]])
    for bound in Allowance(oscillator.law())(m, np.zeros((2, 1))):
        assert np.all(np.isfinite(bound))


def test_the_allowance_covers_the_errors_of_other_libraries() -> None:
    """A law whose c goes through sin, steeply: two libraries differ by beta ulp, and that is allowed."""
    q, x_c, t = ca.SX.sym("q"), ca.SX.sym("x_c"), ca.SX.sym("t")
    steep = 1e4

    def prepare(error: float) -> Tape:
        return Tape.of([q, x_c], [steep * (error * ca.sin(q) + 0.5 * x_c), ca.SX(0.25)])

    law = replace(oscillator.law(), prepare=prepare(1.0), update=Tape.of([q, x_c, t], [0.5 * x_c - 0.1 * t, -0.5 * t]))
    other = replace(law, prepare=prepare(1 + 2.0**-50))
    generator = np.random.default_rng(2)
    m = generator.uniform(-1, 1, (2000, 1))
    xi = -2 * np.sin(m) + generator.normal(size=m.shape) / steep
    xi_allowed, u_allowed = Allowance(law)(m, xi)
    xi_first, u_first, _ = ReferenceStep(law)(m, xi)
    xi_other, u_other, _ = ReferenceStep(other)(m, xi)
    assert np.max(np.abs(u_first - u_other)) > 100 * 2.0**-52  # more than a fixed number of ulp would allow
    assert np.all(np.abs(u_first - u_other) <= u_allowed)
    assert np.all(np.abs(xi_first - xi_other) <= xi_allowed)


def test_every_operation_of_the_tape_has_an_error_model() -> None:
    algebra = _Inexact(2.0**-52)
    assert [name for name, _ in OPERATIONS.values() if not hasattr(algebra, name)] == []


def test_the_python_stepper_counts_as_a_controller() -> None:
    stepper = PythonStepper(oscillator.law())
    first = stepper.advance([1.0])
    stepper.advance([1.0])
    stepper.reset()
    assert stepper.advance([1.0]) == first
