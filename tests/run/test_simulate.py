from dataclasses import replace
from fractions import Fraction

import casadi as ca
import numpy as np
import oscillator
import pytest
from scipy.linalg import expm

from pbcgen.law.closed_loop import ClosedLoop, until_settled
from pbcgen.run.simulate import (
    PythonStepper,
    SimulationError,
    Tolerance,
    remaining,
    simulate_continuous,
    simulate_sampled,
)
from pbcgen.run.wrapper import Controller


class Constant:
    """A controller without state that outputs one value."""

    xi = np.zeros(0)

    def __init__(self, value: float) -> None:
        self.value = value

    def reset(self) -> None:
        pass

    def advance(self, measurement: object) -> np.ndarray:
        return np.array([self.value])


def scalar_loop(field: ca.SX, x: ca.SX, u: ca.SX, initial: float, duration: float = 1.0) -> ClosedLoop:
    xi = ca.SX.sym("xi", 0)
    return ClosedLoop(
        plant=ca.Function("plant", [x, u], [field]),
        measure=ca.Function("measure", [x], [x]),
        controller=ca.Function("controller", [x, xi], [ca.SX(0, 1), ca.SX(0)]),
        lyapunov=None,
        x_star=np.zeros(1),
        u_star=np.zeros(1),
        controller_states=(),
        initial=np.array([initial]),
        duration=duration,
        state_names=("x",),
        state_units=("",),
        input_names=("u",),
        input_units=("",),
    )


def without_controller_state(loop: ClosedLoop) -> ClosedLoop:
    x, xi = ca.SX.sym("x", 2), ca.SX.sym("xi", 0)
    controller = ca.Function("controller", [x, xi], [ca.SX(0, 1), ca.SX(0)])
    return replace(loop, controller=controller, controller_states=())


def test_the_continuous_run_has_the_tolerance_asked_for() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    times = np.linspace(0.0, 5.0, 21)
    run = simulate_continuous(scalar_loop(-x, x, u, 1.0), times)
    np.testing.assert_allclose(run.x[:, 0], np.exp(-times), rtol=0, atol=1e-8)
    assert run.times.tolist() == times.tolist()
    assert run.xi.shape == (21, 0)


def test_tiny_units_do_not_spoil_the_accuracy() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    times = np.linspace(0.1, 5.0, 20)
    run = simulate_continuous(scalar_loop(-x, x, u, 1e-15), times)
    np.testing.assert_allclose(run.x[:, 0] / 1e-15, np.exp(-times), rtol=0, atol=1e-8)


def test_the_hold_is_exact_for_a_linear_plant() -> None:
    loop = oscillator.loop()
    A = np.array([[0.0, 1.0], [-oscillator.STIFFNESS, -oscillator.DAMPING]])
    hold = expm(0.1 * np.block([[A, np.array([[0.0], [1.0]])], [np.zeros((1, 3))]]))
    expected = [loop.initial]
    for _ in range(50):
        expected.append(hold[:2, :2] @ expected[-1] + hold[:2, 2] * 0.5)
    run = simulate_sampled(without_controller_state(loop), Constant(0.5), Fraction(1, 10), 5.0)
    np.testing.assert_allclose(run.x, expected, rtol=0, atol=1e-8)
    assert np.all(run.u == 0.5)


def test_c_and_python_give_the_same_loop() -> None:
    loop = oscillator.loop(2.0)
    with Controller(oscillator.files(), oscillator.interface()) as controller:
        c = simulate_sampled(loop, controller, oscillator.PERIOD, 2.0)
    python = simulate_sampled(loop, PythonStepper(oscillator.law()), oscillator.PERIOD, 2.0)
    np.testing.assert_allclose(c.x, python.x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(c.xi, python.xi, rtol=0, atol=1e-12)
    assert c.times[-1] == 2.0
    assert len(c.times) == 101


def test_row_k_holds_the_output_of_sample_k() -> None:
    loop = oscillator.loop(1.0)
    stepper = PythonStepper(oscillator.law())
    run = simulate_sampled(loop, stepper, oscillator.PERIOD, 1.0)
    stepper.reset()
    assert run.u[0] == stepper.advance(loop.initial[:1])
    assert run.xi[0] == stepper.xi


def test_a_period_that_does_not_divide_the_duration_stops_before_its_end() -> None:
    run = simulate_sampled(oscillator.loop(), PythonStepper(oscillator.law()), Fraction(3, 10), 1.0)
    assert run.times.tolist() == [0.0, 0.3, 0.6, 0.9]


def test_a_run_can_report_its_progress() -> None:
    seen: list[float] = []
    simulate_sampled(oscillator.loop(), PythonStepper(oscillator.law()), Fraction(1, 100), 2.0, progress=seen.append)
    assert seen == [0.0, 0.5, 1.0]


def test_an_explosion_is_reported_with_its_time(capfd: pytest.CaptureFixture[str]) -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    with pytest.raises(SimulationError, match=r"stopped at t = 0\.(5|49999\d*) s"):
        simulate_continuous(scalar_loop(x**2, x, u, 2.0, 2.0), [1.0, 2.0])
    assert capfd.readouterr() == ("", "")


def test_an_explosion_between_samples_is_reported_with_its_time() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    loop = scalar_loop(u * x**2, x, u, 2.0, 2.0)
    with pytest.raises(SimulationError, match=r"stopped at t = 0\.(5|49999\d*) s"):
        simulate_sampled(loop, Constant(1.0), Fraction(1, 5), 2.0)


@pytest.mark.parametrize("times", [[], [0.0, 0.0], [-1.0, 1.0], [0.0, float("nan")]])
def test_times_that_make_no_sense_are_refused(times: list[float]) -> None:
    with pytest.raises(SimulationError, match="increasing"):
        simulate_continuous(oscillator.loop(), times)


def test_a_sample_period_of_zero_is_refused() -> None:
    with pytest.raises(SimulationError, match="must be positive"):
        simulate_sampled(oscillator.loop(), Constant(0.0), 0.0, 1.0)


def test_a_loose_tolerance_is_looser() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    loop = scalar_loop(-x, x, u, 1.0)
    loose = simulate_continuous(loop, [1.0], Tolerance(1e-3, 1e-4)).x[0, 0]
    assert 1e-7 < abs(loose - np.exp(-1)) < 1e-2


def test_what_remains_is_a_share_of_the_largest_distance():
    run = simulate_continuous(oscillator.loop(), [0.0, 1.0])
    times = np.array([0.0, 1.0, 2.0])
    run = replace(run, times=times, x=np.array([[0.0, 1.0], [4.0, 1.0], [1.5, 1.0 + 1e-9]]))
    assert remaining(run, [1.0, 1.0]).tolist() == pytest.approx([0.5 / 3, 0.0])


def test_the_default_duration_covers_the_slowest_mode():
    assert until_settled(-0.3, Fraction(1, 1000)) == 20
    assert until_settled(-100.0, Fraction(1, 10**6)) == pytest.approx(0.05)
    assert until_settled(-1e-9, Fraction(1, 1000)) == 200, "no more than 200 000 samples"
    assert until_settled(None, Fraction(1, 10)) == until_settled(0.5, Fraction(1, 10)) == 10


@pytest.mark.parametrize(("delay", "late"), [("0", 0.0), ("1/4", 0.25), ("1", 1.0), ("7/4", 1.75)])
def test_a_delayed_output_acts_so_much_later(delay: str, late: float) -> None:
    """x' = u with u = 1 from the first sample on: x is the time since the output acts."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    run = simulate_sampled(scalar_loop(u, x, u, 0.0), Constant(1.0), Fraction(1), 4.0, delay=Fraction(delay))
    np.testing.assert_allclose(run.x[:, 0], np.maximum(np.arange(5.0) - late, 0), atol=1e-9)
