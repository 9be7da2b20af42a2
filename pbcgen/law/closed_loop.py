"""Plant and continuous law as numeric functions: what simulation and validation integrate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.law.graph import LawGraph
from pbcgen.models.design import Design
from pbcgen.passivity.plant import Plant, Point
from pbcgen.symbolic.real import approximate


@dataclass(frozen=True)
class ClosedLoop:
    """The plant at its parameter values with the continuous-time law of the paper.

    Attributes:
        plant: (x, u) -> x' = f(x) + g(x) u.
        measure: x -> m, the signals that the controller reads, in the order of ``ControlLaw.inputs``.
        controller: (x, xi) -> (xi', u), the law before discretisation.
        lyapunov: (x, xi) -> the closed-loop storage S_d of the law, or None where the law has none.
        x_star: the equilibrium (rounded). u_star: its input -kappa. The controller state is zero there.
        initial: x(0) of the simulation. duration: its length in seconds.
        state_names, state_units, input_names, input_units: for tables and plots.
    """

    plant: ca.Function
    measure: ca.Function
    controller: ca.Function
    lyapunov: ca.Function | None
    x_star: NDArray[np.float64]
    u_star: NDArray[np.float64]
    controller_states: tuple[str, ...]
    initial: NDArray[np.float64]
    duration: float
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]


#: Coefficient with which the linearly implicit method ROS2 is L-stable.
ROS2 = 1 - 1 / math.sqrt(2)

#: Time constants of the slowest mode in a simulation whose length was left open, and the most samples of it.
_TIME_CONSTANTS = 5
_MOST_SAMPLES = 200_000
#: Length of a simulation of a loop that does not settle, seconds.
_UNSETTLED = 10.0
#: How many slow modes of a large loop are looked at.
_MODES = 6


def _slow_decay(plant: ca.Function, controller: ca.Function, x_star: NDArray[np.float64]) -> float | None:
    """The largest real part of the slowest modes of the linearised loop, 1/s, from sparse matrices; no proof.

    For loops that are too large to look at all their modes; None where no mode is found.
    """
    from scipy.sparse.linalg import ArpackError, eigs

    x, xi = ca.SX.sym("x", plant.size1_in(0)), ca.SX.sym("xi", controller.size1_in(1))
    rate, u = controller(x, xi)
    whole = ca.vertcat(x, xi)
    slope = ca.Function("slope", [whole], [ca.jacobian(ca.vertcat(plant(x, u), rate), whole)])
    matrix = slope(ca.vertcat(x_star, ca.DM.zeros(xi.numel()))).sparse()
    if matrix.shape[0] < 3 or not np.isfinite(matrix.data).all():
        return None
    try:
        found = eigs(matrix, min(_MODES, matrix.shape[0] - 2), sigma=0, v0=np.ones(matrix.shape[0]))
    except (ArpackError, RuntimeError):
        return None
    return max((float(v.real) for v in found[0]), default=None)


def until_settled(abscissa: float | None, h: Fraction) -> float:
    """How long to simulate: until the slowest mode has decayed, rounded up to 1, 2 or 5 times a power of ten.

    Args:
        abscissa: the largest real part of the linearised loop, 1/s; None or not negative for one that does not settle.
        h: sample period, seconds; no simulation takes more than 200 000 samples.
    """
    most = float(h) * _MOST_SAMPLES
    if abscissa is None or not abscissa < 0:
        return min(_UNSETTLED, most)
    wanted = _TIME_CONSTANTS / -abscissa
    decade = 10.0 ** math.floor(math.log10(wanted))
    return min(next(k * decade for k in (1, 2, 5, 10) if k * decade >= wanted * (1 - 1e-9)), most)


def closed_loop(plant: Plant, design: Design, graph: LawGraph, point: Point, abscissa: float | None) -> ClosedLoop:
    """Numeric functions of plant, sensors and continuous law.

    ``abscissa`` is the largest real part of the linearised loop, None for one that was too large to be linearised.
    """
    system = plant.system
    values = np.array([float(plant.values[n]) for n in system.parameters.names])

    def at_values(expression: ca.SX) -> ca.SX:
        return ca.substitute(expression, ca.SX(system.parameters.symbols), values) if len(values) else expression

    measured = at_values(system.measured_expressions)
    rate, u = graph.rounded(*graph.continuous)
    of_state = [ca.substitute(e, graph.m, measured) if e.numel() else e for e in (rate, u)]
    motion = ca.Function("plant", [system.x, system.u], [at_values(system.xdot)], ["x", "u"], ["xdot"])
    controller = ca.Function("controller", [system.x, graph.xi], of_state, ["x", "xi"], ["rate", "u"])
    x_star = np.array([approximate(v) for v in point.x])
    if design.duration is None:
        slowest = _slow_decay(motion, controller, x_star) if abscissa is None else abscissa
        duration = until_settled(slowest, design.sample_period)
    else:
        duration = float(design.duration)
    return ClosedLoop(
        motion,
        ca.Function("measure", [system.x], [measured], ["x"], ["m"]),
        controller,
        None,
        x_star,
        np.array([approximate(v) for v in point.u]),
        graph.names,
        np.array([float(v) for v in design.initial]),
        duration,
        system.state_names,
        tuple(system.units.get(n, "") for n in system.state_names),
        system.input_names,
        tuple(system.units.get(n, "") for n in system.input_names),
    )
