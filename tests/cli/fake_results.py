"""Made-up results of the stages after `check`."""

from dataclasses import dataclass, replace
from fractions import Fraction
from types import SimpleNamespace

import fake_report
import numpy as np

from pbcgen.run.simulate import Trajectory
from pbcgen.run.validate import Agreement, Convergence, OutputRange, Validation

INTERVAL = (Fraction("3.003"), Fraction("3.1"))


def validation(*, passed: bool = True) -> Validation:
    agreement = Agreement(20_000, 2_001, 1.25, 0.5, 0.75, 0.25, 0.4, 0 if passed else 3, 0, {}, passed)
    convergence = Convergence(
        horizon=0.2,
        periods=(1e-4, 5e-5, 2.5e-5),
        errors=(4e-3, 2e-3, 1e-3),
        maximum_errors=(4e-3, 2e-3, 1e-3),
        state_errors=((4e-3,), (2e-3,), (1e-3,)),
        orders=(1.0, 1.0),
        floor=1e-7,
        passed=True,
        note="the error falls with order 1.00",
    )
    output = OutputRange("u", INTERVAL, 3.003, 3.1, 30_000, True)
    return Validation("rlc", "float", Fraction(1, 10_000), 0, agreement, convergence, (output,))


@dataclass(frozen=True)
class Simulation:
    continuous: Trajectory
    sampled: Trajectory
    report: object
    intervals: tuple[tuple[Fraction, Fraction], ...]


def simulation() -> Simulation:
    times = np.linspace(0, 0.2, 5)
    run = Trajectory(
        times=times,
        x=np.outer(1 - np.exp(-times), [0.05, 0.03, 3.05]),
        xi=np.zeros((5, 1)),
        u=np.full((5, 1), 3.05),
        state_names=("x1", "x2", "x3"),
        controller_states=("xc",),
        input_names=("u",),
        state_units=("A", "A", "V"),
        input_units=("V",),
    )
    loop = SimpleNamespace(x_star=np.array([0.0505, 0.030515, 3.0515]))
    return Simulation(run, run, replace(fake_report.report(), loop=loop), (INTERVAL,))
