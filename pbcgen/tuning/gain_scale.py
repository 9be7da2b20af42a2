"""Gains of the size that the plant itself suggests: where the search of gains starts when the given ones do not hold.

At a frequency w the linearised plant answers an input with ``G(jw) = (grad gamma)^T (jw I - A)^{-1} B``. A stiffness
alpha beta of ``1 / |G_ii(jw)|`` makes a loop gain of one: much less leaves the plant alone, much more is a stiff loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from pbcgen.models.laws import Integral, Law, NaturalDamping, PassiveOutput, base_law
from pbcgen.sampling.family import LoopFamily
from pbcgen.symbolic.real import approximate
from pbcgen.symbolic.real_matrices import RealMatrix
from pbcgen.tuning.gain_space import rebuilt
from pbcgen.tuning.trial import entries

#: The answers of the plant are taken on so many frequencies between a run's length and the Nyquist rate.
_FREQUENCIES = 9


def natural_scale(family: LoopFamily, law: Law, h: Fraction, duration: float) -> Law:
    """The law with the amplitudes of ``law`` and the other gains of the plant's own size.

    Args:
        family: the linearised plant.
        law: resolved gains with diagonal matrices.
        h: sample period, seconds.
        duration: of a trial run, seconds.
    """
    w = math.sqrt(2 * math.pi / duration * math.pi / float(h))
    base, found = base_law(law), entries(law)
    stiffness = _stiffness(family, family.gamma, h, duration)
    c = "_c" if isinstance(base, NaturalDamping) else ""
    chosen = dict(found)
    chosen["beta" + c] = _quotients(stiffness, found["alpha" + c])
    if not isinstance(base, PassiveOutput):
        chosen["K_c"] = _exact(stiffness)
        chosen["R_c"] = _exact(w / stiffness)
    if isinstance(base, NaturalDamping) and family.eta is not None and base.Upsilon is not None:
        Upsilon = np.array([[float(v) for v in row] for row in base.Upsilon])
        natural = _stiffness(family, family.eta, h, duration, Upsilon)
        chosen["beta_l"] = _quotients(natural, found["alpha_l"])
        chosen["R_l"] = _exact(w / (natural * np.array([float(v) for v in found["K_l"]])))
    if isinstance(law, Integral):
        chosen["beta_psi"] = _quotients(stiffness, found["alpha_psi"])
    return rebuilt(law, chosen)


def _stiffness(
    family: LoopFamily, signal: RealMatrix, h: Fraction, duration: float, weight: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """One over the geometric mean of ``|G_ii|``; one where a channel does not answer."""
    A, B, C = (np.array([[approximate(v) for v in row] for row in rows]) for rows in (family.A, family.B, signal))
    C = C if weight is None else weight @ C
    answers = []
    for w in np.geomspace(2 * math.pi / duration, math.pi / float(h), _FREQUENCIES):
        answers.append(np.abs(np.diag(C @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B))))
    with np.errstate(divide="ignore"):
        mean: NDArray[np.float64] = np.exp(-np.mean(np.log(np.array(answers)), axis=0))
    return np.where(np.isfinite(mean) & (mean > 0), mean, 1.0)


def _quotients(stiffness: NDArray[np.float64], amplitudes: Sequence[Fraction]) -> tuple[Fraction, ...]:
    return _exact(stiffness / np.array([float(a) for a in amplitudes]))


def _exact(values: NDArray[np.float64]) -> tuple[Fraction, ...]:
    return tuple(Fraction(f"{v:.3g}") for v in values)
