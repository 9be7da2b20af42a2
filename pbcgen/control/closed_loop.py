"""Plant and continuous law as numeric functions: what simulation and validation integrate."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray


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
