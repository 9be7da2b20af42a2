from collections.abc import Iterator
from pathlib import Path

import numpy as np
import oscillator
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pbcgen import pipeline
from pbcgen.emit import Extras
from pbcgen.errors import ModelError, ToolchainError
from pbcgen.law.step import ReferenceStep
from pbcgen.models.loader import load
from pbcgen.run.wrapper import Controller

pytestmark = pytest.mark.xdist_group("wrapper")  # they share what they compile


@pytest.fixture(scope="module", params=["float", "double"])
def precision(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def controller(precision: str) -> Iterator[Controller]:
    with Controller(oscillator.files(precision), oscillator.interface(precision)) as controller:
        yield controller


def test_a_step_takes_and_returns_names(controller: Controller) -> None:
    controller.reset()
    outputs = controller.step(position=1.0)
    assert list(outputs) == ["force"]
    assert -0.75 <= outputs["force"] < -0.7
    assert controller.status == "OSC_OK"


def test_the_status_is_the_enumerator(controller: Controller) -> None:
    controller.reset()
    assert controller.step(position=float("nan")) == {"force": 0.0}
    assert controller.status == "OSC_INVALID_INPUT"


def test_a_missing_input_is_named(controller: Controller) -> None:
    with pytest.raises(ModelError, match="the input `position` is missing"):
        controller.step()


def test_an_unknown_input_is_named(controller: Controller) -> None:
    with pytest.raises(ModelError, match="there is no input `velocity`: the inputs are `position`"):
        controller.step(position=0.0, velocity=0.0)


def test_the_state_can_be_read_and_set(controller: Controller) -> None:
    controller.reset()
    assert controller.state == {"x_c": 0.0}
    controller.state = {"x_c": 0.25}
    assert controller.state == {"x_c": 0.25}
    with pytest.raises(ModelError, match="the state `x_c` is missing"):
        controller.state = {}


def test_reset_starts_again(controller: Controller) -> None:
    controller.reset()
    first = [controller.step(position=0.3)["force"] for _ in range(3)]
    controller.reset()
    assert [controller.step(position=0.3)["force"] for _ in range(3)] == first


def test_a_run_is_many_steps(controller: Controller) -> None:
    positions = np.linspace(-1, 1, 50)
    controller.reset()
    single = [controller.step(position=p)["force"] for p in positions]
    controller.reset()
    assert controller.run(positions[:, None])[:, 0].tolist() == single


def test_independent_steps_match_the_reference_and_leave_the_controller_alone(
    controller: Controller, precision: str
) -> None:
    step = ReferenceStep(oscillator.law(precision))
    generator = np.random.default_rng(3)
    m, states = generator.normal(size=(500, 1)), generator.normal(size=(500, 1))
    controller.state = {"x_c": 0.125}
    xi, u, status = controller.step_many(m, states)
    xi_python, u_python, status_python = step(m, states)
    epsilon = np.finfo(step.dtype).eps
    np.testing.assert_allclose(u, u_python, rtol=0, atol=4 * epsilon)
    np.testing.assert_allclose(xi, xi_python, rtol=0, atol=4 * epsilon)
    assert status.tolist() == status_python.tolist()
    assert controller.state == {"x_c": 0.125}


def test_arrays_of_the_wrong_shape_are_refused(controller: Controller) -> None:
    with pytest.raises(ModelError, match="the measurements must have the shape N x 1, got 3 x 2"):
        controller.run(np.zeros((3, 2)))
    with pytest.raises(ModelError, match="the states must have the shape 3 x 1, got 2 x 1"):
        controller.step_many(np.zeros((3, 1)), np.zeros((2, 1)))


def test_a_hundred_thousand_steps_are_fast(controller: Controller) -> None:
    import time

    m = np.random.default_rng(0).normal(size=(100_000, 1))
    start = time.perf_counter()
    controller.run(m)
    assert time.perf_counter() - start < 1.0


def test_several_controllers_do_not_disturb_each_other(tmp_path: Path) -> None:
    first = Controller(oscillator.files(), oscillator.interface(), directory=tmp_path)
    second = Controller(oscillator.files(alpha=0.25), oscillator.interface(), directory=tmp_path)
    assert first.step(position=1.0)["force"] == pytest.approx(3 * second.step(position=1.0)["force"])
    first.close()
    assert second.state["x_c"] != 0.0
    second.close()


def test_a_closed_controller_says_so() -> None:
    controller = Controller(oscillator.files(), oscillator.interface())
    controller.close()
    controller.close()
    with pytest.raises(ToolchainError, match="the controller `osc` is closed"):
        controller.reset()


def test_a_package_without_its_source_is_refused() -> None:
    with pytest.raises(ToolchainError, match=r"has no file `osc\.c`"):
        Controller({"osc.h": ""}, oscillator.interface())


def test_a_member_that_the_header_lacks_is_a_compiler_error() -> None:
    files = oscillator.files()
    files["osc.h"] = files["osc.h"].replace("x_c;", "other;")
    with pytest.raises(ToolchainError, match="did not compile"):
        Controller(files, oscillator.interface())


@pytest.fixture(scope="module")
def adjustable() -> Iterator[Controller]:
    design = load("rlc").with_(target_box={"x3": ("2.9", "3.0515")}, gain_ranges={"alpha": ("0.04", "0.0485")})
    package = pipeline.package(pipeline.check(design), extras=Extras(start=True))
    with Controller.of_package(package) as controller:
        yield controller


#: Any float, with numbers that a user may mean among them.
ANY = st.one_of(st.floats(width=32), st.floats(2.9, 3.0515), st.floats(0.04, 0.0485))
CALLS = st.lists(st.tuples(st.sampled_from(["step", "target", "gains", "start"]), ANY), max_size=30)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(CALLS)
def test_no_sequence_of_calls_leaves_the_interval_or_the_finite_numbers(
    adjustable: Controller, calls: list[tuple[str, float]]
) -> None:
    adjustable.reset()
    for call, value in calls:
        before = adjustable.state
        if call == "step":
            assert 2.8515 <= adjustable.step(x3=value)["u"] <= 3.1
            done = adjustable.status in ("RLC_OK", "RLC_STATE_RESET")
        else:
            setter = {"target": adjustable.set_target, "gains": adjustable.set_gains, "start": adjustable.start_at}[
                call
            ]
            done = setter(**{"alpha" if call == "gains" else "x3": value}) == "RLC_OK"
        assert done or adjustable.state == before
        assert all(np.isfinite(list(adjustable.state.values())))
