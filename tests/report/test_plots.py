from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from pbcgen.errors import ModelError
from pbcgen.report.plots import COLOURS, Bounds, plot_closed_loop, save
from pbcgen.run.simulate import Trajectory


def trajectory(samples: int, units: tuple[str, ...], sizes: tuple[float, ...], inputs: int, end: float) -> Trajectory:
    times = np.linspace(0.0, end, samples)
    waves = [size * np.exp(-times / end) * np.cos(20 * times / end + k) for k, size in enumerate(sizes)]
    return Trajectory(
        times=times,
        x=np.array(waves).T,
        xi=np.zeros((samples, 0)),
        u=np.array([np.tanh(waves[0] / sizes[0])] * inputs).T,
        state_names=tuple(f"x_{k + 1}" for k in range(len(sizes))),
        controller_states=(),
        input_names=tuple(f"u_{k + 1}" for k in range(inputs)),
        state_units=units,
        input_units=("V",) * inputs,
    )


def plotted(units: tuple[str, ...], sizes: tuple[float, ...], inputs: int = 1, end: float = 10.0):
    return plot_closed_loop(
        trajectory(500, units, sizes, inputs, end),
        trajectory(100, units, sizes, inputs, end),
        Bounds([(Fraction(-1), Fraction(1))] * inputs, [(Fraction(-2), Fraction(1000))] * inputs),
        [0.0] * len(sizes),
        "a $ title",
    )


def labels(figure) -> list[str]:
    return [axes.get_ylabel() for axes in figure.axes]


def test_states_of_one_unit_share_a_panel() -> None:
    assert labels(plotted(("m", "m", "V"), (1.0, 2.0, 1.0))) == ["x_1, x_2 [m]", "x_3 [V]", "u_1 [V]"]


def test_states_of_unlike_size_do_not_share_a_panel() -> None:
    assert labels(plotted(("m", "m"), (1.0, 1e-3))) == ["x_1 [m]", "x_2 [m]", "u_1 [V]"]


def test_no_panel_is_crowded() -> None:
    figure = plotted(("m",) * 9, (1.0,) * 9)
    assert [label.count("x_") for label in labels(figure)] == [4, 4, 1, 0]


def test_every_signal_has_a_colour_of_its_own_in_its_panel() -> None:
    assert len(set(COLOURS)) >= 4
    axes = plotted(("m", "m"), (1.0, 2.0)).axes[0]
    assert len({line.get_color() for line in axes.get_lines() if line.get_label()[0] != "_"}) == 2


def test_intervals_limits_and_targets_are_drawn() -> None:
    figure = plotted(("m",), (1.0,))

    def levels(place: int, style: str) -> list[float]:
        lines = figure.axes[place].get_lines()
        return [float(line.get_ydata()[0]) for line in lines if line.get_linestyle() == style]

    assert levels(-1, "--") == [-1.0, 1.0]
    assert levels(-1, ":") == [-2.0], "a limit of 1000 would flatten the curve"
    assert levels(0, "-.") == [0.0]


@pytest.mark.parametrize(("end", "unit"), [(10.0, "s"), (0.05, "ms"), (1e-5, "µs")])
def test_the_time_axis_has_a_readable_unit(end: float, unit: str) -> None:
    assert plotted(("m",), (1.0,), end=end).axes[0].get_xlabel() == f"time [{unit}]"


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_equal_figures_give_equal_bytes(tmp_path: Path, suffix: str) -> None:
    first, second = tmp_path / f"first.{suffix}", tmp_path / f"second.{suffix}"
    save(plotted(("m", "V"), (1.0, 1.0), inputs=2), first)
    save(plotted(("m", "V"), (1.0, 1.0), inputs=2), second)
    assert first.read_bytes() == second.read_bytes()


def test_a_picture_has_1600_by_900_pixels(tmp_path: Path) -> None:
    save(plotted(("m",), (1.0,)), tmp_path / "a.png")
    header = (tmp_path / "a.png").read_bytes()[16:24]
    assert (int.from_bytes(header[:4], "big"), int.from_bytes(header[4:], "big")) == (1600, 900)


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"does not end in \.pdf, \.png, \.svg"):
        save(plotted(("m",), (1.0,)), tmp_path / "a.jpg")


def test_a_path_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="cannot be written"):
        save(plotted(("m",), (1.0,)), tmp_path / "absent" / "a.png")
