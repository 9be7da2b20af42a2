"""The arguments on which two implementations of a law are compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbcgen.law.rounding import DTYPES
from pbcgen.law.step import equilibrium_output, initial_state

if TYPE_CHECKING:
    from pbcgen.law.closed_loop import ClosedLoop
    from pbcgen.law.law import ControlLaw
    from pbcgen.run.simulate import Trajectory

Array = NDArray[Any]

#: Decimal exponents of the widest random inputs: beyond, the products of an ordinary law overflow.
_WIDEST = {"float": 18.0, "double": 100.0}


@dataclass(frozen=True)
class Questions:
    """Arguments of N steps: measurements (N, nm), states (N, nxi), last outputs (N, m); in the law's precision."""

    m: Array
    xi: Array
    last: Array


def questions(
    law: ControlLaw, loop: ClosedLoop, run: Trajectory, *, generator: np.random.Generator, samples: int
) -> tuple[Questions, NDArray[np.bool_]]:
    """What both implementations are asked, and which rows of it come from the closed loop ``run``."""
    dtype = DTYPES[law.precision]
    nm, start = len(law.inputs), np.array(equilibrium_output(law), dtype)
    m = np.array(loop.measure.map(len(run.times))(run.x.T)).reshape(nm, -1).T.astype(dtype)
    xi = np.vstack([np.array(initial_state(law), dtype)[None, :], memory(law, run)[:-1]]).astype(dtype)
    random = _inputs(law, loop, np.hstack([m, xi]), generator, samples)
    bounds = np.array([[float(lo), float(hi)] for lo, hi in law.intervals])
    last = generator.uniform(bounds[:, 0], bounds[:, 1], (len(random), len(bounds)))
    last[::10] *= 3.0  # some that no step can have left behind
    last[::100] = np.nan
    question = Questions(
        np.vstack([m, random[:, :nm]]),
        np.vstack([xi, random[:, nm:]]),
        np.vstack([start[None, :], run.u[:-1].astype(dtype), last.astype(dtype)]),
    )
    return question, np.arange(len(question.m)) < len(m)


def memory(law: ControlLaw, run: Trajectory) -> Array:
    """The states of the controller along a run (N, nxi), with the settings, which stay what they are."""
    return np.hstack([run.xi, np.tile(np.array(law.kept), (len(run.xi), 1))])


def _inputs(
    law: ControlLaw, loop: ClosedLoop, trajectory: Array, generator: np.random.Generator, samples: int
) -> Array:
    """Random (m, xi) near the equilibrium, of any magnitude, with any bits in m, and special values."""
    dtype, nm = trajectory.dtype, len(law.inputs)
    middle = np.concatenate([np.array(loop.measure(loop.x_star), dtype=float).ravel(), np.array(law.initial)])
    span = np.abs(trajectory - middle).max(axis=0)
    span[span == 0] = 1.0
    size = (max(samples // 4, 1), len(middle))
    around = middle + span * generator.uniform(-2.0, 2.0, size)
    nearer = middle + span * _logarithmic(generator, size, -8.0, 0.5)
    wide = _logarithmic(generator, size, -_WIDEST[law.precision], _WIDEST[law.precision])
    patterns = nearer.astype(dtype)
    bits = generator.bytes(size[0] * nm * dtype.itemsize)
    patterns[:, :nm] = np.frombuffer(bits, dtype).reshape(size[0], nm)
    return np.vstack(
        [around.astype(dtype), nearer.astype(dtype), wide.astype(dtype), patterns, _special(middle, dtype)]
    )


def _logarithmic(generator: np.random.Generator, size: tuple[int, int], low: float, high: float) -> Array:
    """Numbers of either sign whose decimal logarithm is uniform."""
    return generator.choice([-1.0, 1.0], size) * 10.0 ** generator.uniform(low, high, size)


def _special(middle: Array, dtype: np.dtype[Any]) -> Array:
    """Points with a special value in one entry, or in all of them."""
    limits = np.finfo(dtype)
    positive = [0.0, limits.smallest_subnormal, limits.tiny, limits.eps, 1.0, limits.max, np.inf, np.nan]
    values = np.array([sign * value for value in positive for sign in (1, -1)], dtype)
    single = np.tile(middle.astype(dtype), (len(middle), len(values), 1))
    for k in range(len(middle)):
        single[k, :, k] = values
    everywhere = np.repeat(values[:, None], len(middle), axis=1)
    return np.vstack([single.reshape(-1, len(middle)), everywhere])
