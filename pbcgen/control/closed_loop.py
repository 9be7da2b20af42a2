"""Plant and continuous law as numeric functions: what simulation and validation integrate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

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


#: Time constants of the slowest mode in a simulation whose length was left open, and the most samples of it.
_TIME_CONSTANTS = 5
_MOST_SAMPLES = 200_000
#: Length of a simulation of a loop that does not settle, seconds.
_UNSETTLED = 10.0


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
