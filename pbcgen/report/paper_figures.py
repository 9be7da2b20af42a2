"""The figures of the examples in the literature, from the generated C beside the continuous law: ``make figures``.

Borja, Chan-Zheng and Scherpen, *Stabilization of physical systems via saturated controllers with only partial state
measurements*, Section 6. ``facts`` computes the numbers that docs/paper.md states and the tests assert.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pbcgen import pipeline
from pbcgen.law.closed_loop import ClosedLoop
from pbcgen.models.design import Design
from pbcgen.models.laws import DynamicExtension, NaturalDamping
from pbcgen.models.limits import Limits
from pbcgen.models.loader import load
from pbcgen.report.curves import saturation_entries, settling_time
from pbcgen.report.plots import COLOURS, STYLE, save
from pbcgen.run.simulate import Trajectory, simulate_continuous, simulate_sampled
from pbcgen.run.wrapper import Controller

Array = NDArray[np.float64]

#: Dry friction of the arm's joints in N m, added to the plant only, and the speed at which it is fully developed.
COULOMB, COULOMB_SPEED = (1.0, 0.2, 0.2), 0.01

#: For each beta of the circuit a stable sample period, and how much of the run the C is simulated for.
BETAS = {1: ("1e-4", 0.2), 10: ("2e-5", 0.2), 100: ("2e-6", 0.05)}

#: The outer share of the interval that counts as saturated: tanh reaches its limits only at infinity.
BAND = 0.01

VOLTS = (5.0, 7.5, 10.0)


@dataclasses.dataclass(frozen=True)
class Case:
    """One closed loop, with the continuous law and with the generated C; ``sampled`` may be shorter."""

    report: pipeline.Report
    continuous: Trajectory
    sampled: Trajectory

    @property
    def limits(self) -> tuple[float, float]:
        """Of the first input."""
        assert self.report.control is not None
        lo, hi = self.report.control.intervals[0]
        return float(lo), float(hi)


def run(design: Design, *, plant: Callable[[ClosedLoop], ClosedLoop] | None = None, c_until: float = 1e9) -> Case:
    """Check a design, generate its C, and simulate both; ``plant`` may change what the controller acts on."""
    report = pipeline.check(design)
    package = pipeline.package(report)
    assert report.loop is not None
    loop = report.loop if plant is None else plant(report.loop)
    continuous = simulate_continuous(loop, np.linspace(0.0, loop.duration, 20_001))
    with Controller.of_package(package) as controller:
        sampled = simulate_sampled(loop, controller, design.sample_period, min(loop.duration, c_until))
    return Case(report, continuous, sampled)


# --- the cases ---------------------------------------------------------------------------------------------------


@cache
def coupling_without_damping() -> Case:
    """Scenario (i): alpha_l = 0 is law (uc) without x_l."""
    design = load("coupling_device")
    return run(design.with_(law=DynamicExtension(alpha=5, beta=450, K_c="1e6", R_c="0.3")))


@cache
def coupling_with_damping(volts: float) -> Case:
    """Scenario (ii) and its siblings: alpha_c = alpha_l = volts / 2."""
    design = load("coupling_device")
    base = design.law
    assert isinstance(base, NaturalDamping)
    half = str(volts / 2)
    law = NaturalDamping(
        half, base.beta_c, base.K_c, base.R_c, alpha_l=half, beta_l=base.beta_l, K_l=base.K_l, R_l=base.R_l
    )
    return run(design.with_(law=law, limits=Limits.symmetric(volts)))


@cache
def circuit(beta: int) -> Case:
    """The circuit with one beta_c at a sample period that is stable for it."""
    period, until = BETAS[beta]
    law = DynamicExtension(alpha="0.0485", beta=beta, K_c=10, R_c=10)
    return run(load("rlc").with_(law=law, sample_period=period), c_until=until)


@cache
def arm(name: str) -> Case:
    """``pera`` or ``pera_integral`` on a plant with dry friction that the model does not know."""
    return run(load(name), plant=with_coulomb_friction)


def with_coulomb_friction(loop: ClosedLoop) -> ClosedLoop:
    """The same loop with friction ``COULOMB tanh(q' / COULOMB_SPEED)`` on the momenta."""
    n = len(loop.initial)
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", len(loop.u_star))
    rate = loop.plant(x, u)
    friction = ca.DM(COULOMB) * ca.tanh(rate[: n // 2] / COULOMB_SPEED)
    changed = rate - ca.vertcat(ca.SX(n // 2, 1), friction)
    return dataclasses.replace(loop, plant=ca.Function("plant", [x, u], [changed], ["x", "u"], ["xdot"]))


# --- the facts ---------------------------------------------------------------------------------------------------


def overshoot(values: Array, target: float) -> float:
    """By how much the signal passes its target, as a share of the step from zero."""
    return float(values.max() / target - 1)


def extrema(values: Array) -> int:
    """How many turning points a signal has, those of the last thousandth of its range left out."""
    margin = 1e-3 * float(np.ptp(values))
    turning, reference, direction = 0, float(values[0]), 0
    for value in values[1:]:
        if direction >= 0 and value < reference - margin:
            turning, direction, reference = turning + (direction != 0), -1, value
        elif direction <= 0 and value > reference + margin:
            turning, direction, reference = turning + (direction != 0), 1, value
        elif (direction > 0 and value > reference) or (direction < 0 and value < reference):
            reference = value
    return turning


def load_current(case: Case, trajectory: Trajectory) -> Array:
    """a (exp(v / b) - 1) of the circuit's load, in A."""
    values = case.report.design.system.parameters.values
    result: Array = float(values["a"]) * np.expm1(trajectory.x[:, 2] / float(values["b"]))
    return result


def facts() -> dict[str, float]:
    """Every number that docs/paper.md states; from the continuous law unless the name says C."""
    found: dict[str, float] = {}
    for key, case in {"free": coupling_without_damping(), "damped": coupling_with_damping(5.0)}.items():
        c = case.continuous
        found[f"coupling {key}: overshoot of x2"] = overshoot(c.x[:, 1], 0.025)
        found[f"coupling {key}: overshoot of x3"] = overshoot(c.x[:, 2], 0.025)
        found[f"coupling {key}: turning points of x3"] = extrema(c.x[:, 2])
        found[f"coupling {key}: x3 at 20 s"] = float(c.x[-1, 2])
        found[f"coupling {key}: settling time of x3"] = settling_time(c.times, c.x[:, 2], 0.025) or np.inf
    for volts in VOLTS:
        case = coupling_with_damping(volts)
        found[f"coupling {volts:g} V: largest input, C"] = float(np.abs(case.sampled.u).max())
        found[f"coupling {volts:g} V: peak of x3"] = float(case.continuous.x[:, 2].max())
        found[f"coupling {volts:g} V: slowest mode"] = float(case.report.derived["spectral_abscissa"])
    for beta in BETAS:
        case = circuit(beta)
        lo, hi = case.limits
        found[f"circuit {beta}: entries into saturation"] = saturation_entries(case.continuous.u[:, 0], lo, hi, BAND)
        found[f"circuit {beta}: smallest input, C"] = float(case.sampled.u.min())
        found[f"circuit {beta}: largest input, C"] = float(case.sampled.u.max())
        found[f"circuit {beta}: load current at the end"] = float(load_current(case, case.continuous)[-1])
    for name in ("pera", "pera_integral"):
        case = arm(name)
        assert case.report.loop is not None
        for k in range(3):
            error = case.sampled.x[-1, k] - case.report.loop.x_star[k]
            found[f"{name}: final error of q{k + 1}, C"] = float(error)
            found[f"{name}: largest input u{k + 1}, C"] = float(np.abs(case.sampled.u[:, k]).max())
        pair = np.abs(case.sampled.u[:, 1]) + np.abs(case.sampled.u[:, 2])
        found[f"{name}: largest abs(u2) + abs(u3), C"] = float(pair.max())
    return found


# --- drawing -----------------------------------------------------------------------------------------------------


def figures() -> dict[str, Figure]:
    """Every figure by the name of its file."""
    makers = (coupling_damping, coupling_masses, coupling_control, circuit_figure, arm_positions, arm_torques)
    with mpl.rc_context(STYLE):
        return {maker.__name__: maker() for maker in makers}


def coupling_damping() -> Figure:
    """Masses and control with and without the term in x_l."""
    cases = {"(i) without natural damping": coupling_without_damping(), "(ii) with it": coupling_with_damping(5.0)}
    figure, axes = _panels(1, 3, 3.6)
    for colour, (label, case) in zip(COLOURS, cases.items(), strict=False):
        for panel, k in zip(axes[:2], (1, 2), strict=True):
            _draw(panel, case, "x", k, colour, label, scale=1e3)
        _draw(axes[2], case, "u", 0, colour, label)
    for panel, text in zip(axes[:2], ("first mass x2 [mm]", "second mass x3 [mm]"), strict=True):
        panel.axhline(25, color="#606060", linestyle="-.", linewidth=1)
        panel.set_ylabel(text)
    _limits(axes[2], [(-5.0, 5.0)], ["#606060"])
    axes[2].set_ylabel("voltage u [V]")
    return _finished(figure, axes, "time [s]")


def coupling_masses() -> Figure:
    """Masses for three limits of the input."""
    figure, axes = _panels(1, 2, 3.6)
    for colour, volts in zip(COLOURS, VOLTS, strict=False):
        for panel, k in zip(axes, (1, 2), strict=True):
            _draw(panel, coupling_with_damping(volts), "x", k, colour, f"limit {volts:g} V", scale=1e3)
    for panel, text in zip(axes, ("first mass x2 [mm]", "second mass x3 [mm]"), strict=True):
        panel.axhline(25, color="#606060", linestyle="-.", linewidth=1)
        panel.set_ylabel(text)
    return _finished(figure, axes, "time [s]")


def coupling_control() -> Figure:
    """Control for three limits, whole and magnified."""
    figure, axes = _panels(1, 2, 3.6)
    for colour, volts in zip(COLOURS, VOLTS, strict=False):
        for panel in axes:
            _draw(panel, coupling_with_damping(volts), "u", 0, colour, f"limit {volts:g} V")
            _limits(panel, [(-volts, volts)], [colour])
    for panel in axes:
        panel.set_ylabel("voltage u [V]")
    axes[1].set_xlim(0, 2)
    axes[1].set_title("the first two seconds", loc="left")
    return _finished(figure, axes, "time [s]")


def circuit_figure() -> Figure:
    """Control and load current for three beta."""
    figure, axes = _panels(2, 3, 5.6, sharey="row")
    for k, beta in enumerate(BETAS):
        case = circuit(beta)
        for panel, row in zip(axes[k::3], ("u", "current"), strict=True):
            for trajectory, style in ((case.continuous, _BAND), (case.sampled, _LINE)):
                values = trajectory.u[:, 0] if row == "u" else 1e3 * load_current(case, trajectory)
                step = "steps-post" if row == "u" and style is _LINE else "default"
                panel.plot(1e3 * trajectory.times, values, color=COLOURS[k], drawstyle=step, **style)
            panel.set_xlim(0, 50)
        axes[k].set_title(f"beta = {beta}, h = {float(case.report.design.sample_period) * 1e6:g} µs", loc="left")
        _limits(axes[k], [case.limits], ["#606060"])
        axes[3 + k].axhline(20, color="#606060", linestyle="-.", linewidth=1)
    axes[0].set_ylabel("voltage u [V]")
    axes[3].set_ylabel("load current [mA]")
    return _finished(figure, axes, "time [ms]", legend=False)


_ARMS = {"potential-compensation (umec)": "pera", "with the filter psi (conint)": "pera_integral"}


def arm_positions() -> Figure:
    """Positions with both laws on a plant with dry friction."""
    figure, axes = _panels(1, 3, 3.6)
    for colour, (label, name) in zip(COLOURS, _ARMS.items(), strict=False):
        for k, panel in enumerate(axes):
            _draw(panel, arm(name), "x", k, colour, label)
    loop = arm("pera").report.loop
    assert loop is not None
    for k, panel in enumerate(axes):
        panel.axhline(loop.x_star[k], color="#606060", linestyle="-.", linewidth=1)
        panel.set_ylabel(f"q{k + 1} [rad]")
    return _finished(figure, axes, "time [s]")


def arm_torques() -> Figure:
    """Torques with both laws; the limits of joints 2 and 3 are those of the motors of the differential."""
    figure, axes = _panels(1, 3, 3.6)
    for colour, (label, name) in zip(COLOURS, _ARMS.items(), strict=False):
        u = arm(name).sampled.u
        shown = (u[:, 0], u[:, 1] + u[:, 2], u[:, 1] - u[:, 2])
        for panel, values in zip(axes, shown, strict=True):
            panel.plot(arm(name).sampled.times, values, color=colour, label=label, drawstyle="steps-post", **_LINE)
    for panel, text, limit in zip(axes, ("u1", "u2 + u3", "u2 - u3"), (17.1007, 7.901, 7.901), strict=True):
        _limits(panel, [(-limit, limit)], ["#606060"])
        panel.set_ylabel(f"{text} [N m]")
        panel.set_xlim(0, 4)
    return _finished(figure, axes, "time [s]")


_BAND: dict[str, Any] = {"alpha": 0.3, "linewidth": 5.0}
_LINE: dict[str, Any] = {"linewidth": 1.3}


def _panels(rows: int, columns: int, height: float, sharey: Literal["row"] | bool = False) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(12, height), dpi=100, layout="constrained")
    grid = figure.subplots(rows, columns, sharey=sharey, squeeze=False)
    return figure, list(grid.ravel())


def _draw(axes: Axes, case: Case, field: str, k: int, colour: str, label: str, scale: float = 1.0) -> None:
    """A pale band for the continuous law, a line for the C."""
    axes.plot(case.continuous.times, scale * getattr(case.continuous, field)[:, k], color=colour, **_BAND)
    step = "steps-post" if field == "u" else "default"
    axes.plot(
        case.sampled.times,
        scale * getattr(case.sampled, field)[:, k],
        color=colour,
        label=label,
        drawstyle=step,
        **_LINE,
    )


def _limits(axes: Axes, limits: Sequence[tuple[float, float]], colours: Sequence[str]) -> None:
    for pair, colour in zip(limits, colours, strict=True):
        for limit in pair:
            axes.axhline(limit, color=colour, linestyle=":", linewidth=1.4)


def _finished(figure: Figure, axes: Sequence[Axes], time: str, *, legend: bool = True) -> Figure:
    for panel in axes:
        panel.set_xlabel(time)
        panel.margins(x=0)
    if legend:
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def main(directory: str) -> None:
    """Write every figure into a directory as PNG."""
    target = Path(directory)
    target.mkdir(parents=True, exist_ok=True)
    for name, figure in figures().items():
        save(figure, target / f"{name}.png")
        print(target / f"{name}.png")


if __name__ == "__main__":
    main(*sys.argv[1:])
