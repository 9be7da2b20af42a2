"""The linearised closed loop over one sample period: its matrix, the verdict on it, and rounded eigenvalues."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
from flint import acb, arb
from numpy.typing import NDArray

from pbcgen.proof.claim import Status
from pbcgen.proof.spectrum import Stability, eigenvalues_in_doubles, schur, zero_order_hold
from pbcgen.sampling.transition import Basis, LinearLoop, Transition, complex_matrix, midpoints
from pbcgen.symbolic.real import BITS, ONE, ball, near_eigenvalues, precision, rational
from pbcgen.symbolic.real_matrices import RealMatrix, add, as_floats, diagonal, inverse, multiply

#: Periods of the estimate grow by this factor.
_RATIO = 1.4
#: Single periods are examined by this factor up or down, then in between until they are as close as this.
_LEAP, _CLOSE = 4, 1.02
#: Loops of more states are looked at in double precision, where there are many to look at.
_LARGEST_PRECISE = 24
#: The shortest that is examined, as a share of the first one.
_SHORTEST = 1e-12


def spectral(loop: LinearLoop, h: Fraction, delay: Fraction = Fraction(0)) -> Stability:
    """Whether the sampled loop is Schur stable at one period; UNDECIDED where its numbers grow beyond any use."""
    try:
        return schur(delayed_matrix(loop, h, delay) if delay else period_matrix(loop, h))
    except (OverflowError, ZeroDivisionError):
        return Stability(Status.UNDECIDED, math.nan, ())


def period_matrix(loop: LinearLoop, h: Fraction) -> RealMatrix:
    """M(h) in the coordinates (x, xi): exact zero-order hold and implicit step, entries exact or enclosed.

    Raises ZeroDivisionError if the implicit step may be singular.
    """
    period = rational(h)
    with precision(BITS):
        Ad, Bd = zero_order_hold(loop.A, loop.B, period)
        u_x = multiply(loop.u_m, loop.H)
        if not loop.r_xi:
            return add(Ad, multiply(Bd, u_x))
        step = inverse(add(diagonal([ONE] * len(loop.r_xi)), [[-period * v for v in row] for row in loop.r_xi]))
        if step is None:
            raise ZeroDivisionError("the implicit step may be singular")
        moved = multiply(multiply(step, [[period * v for v in row] for row in loop.r_m]), loop.H)
        u_x, u_xi = add(u_x, multiply(loop.u_xi, moved)), multiply(loop.u_xi, step)
        top = zip(add(Ad, multiply(Bd, u_x)), multiply(Bd, u_xi), strict=True)
        return [[*a, *b] for a, b in (*top, *zip(moved, step, strict=True))]


def delayed_matrix(loop: LinearLoop, h: Fraction, delay: Fraction = Fraction(0)) -> RealMatrix:
    """M(h) with an input delay in the coordinates (x, xi, past inputs), entries enclosed."""
    with precision(BITS):
        transition = Transition(loop, delay)
        return [list(row) for row in transition.real(transition.jet(ball(rational(h)))).c0.tolist()]


@dataclass(frozen=True)
class Figures:
    """Eigenvalues of a loop in a nutshell, rounded: no proof, but no artefacts of double precision either.

    Attributes:
        abscissa: the largest real part of the continuous loop, 1/s.
        radius: the larger of the spectral radii at h and at a multiple of it.
        damping: the least damping ratio of the modes of the sampled loop at h.
    """

    abscissa: float
    radius: float
    damping: float


def radius_in_doubles(loop: LinearLoop, h: Fraction) -> float:
    """The spectral radius of the sampled loop, without bounds and in double precision: nan where that fails.

    Stiff loops may be misjudged. It is for large loops, to see which of them are worth a proof.
    """
    from scipy.linalg import expm, inv

    n, k, m = loop.sizes
    period, H = float(h), as_floats(loop.H)
    with np.errstate(all="ignore"):
        try:
            held = expm(np.block([[as_floats(loop.A), as_floats(loop.B)], [np.zeros((m, n + m))]]) * period)
            free, driven, read = held[:n, :n], held[:n, n:], as_floats(loop.u_m) @ H
            if not k:
                return _largest(free + driven @ read)
            step = inv(np.eye(k) - period * as_floats(loop.r_xi))
            moved, pull = period * step @ as_floats(loop.r_m) @ H, as_floats(loop.u_xi)
            return _largest(np.block([[free + driven @ (read + pull @ moved), driven @ pull @ step], [moved, step]]))
        except (ValueError, np.linalg.LinAlgError, OverflowError):
            return math.nan


def _largest(matrix: NDArray[np.float64]) -> float:
    return max((abs(v) for v in eigenvalues_in_doubles(matrix)), default=0.0)


class Spectrum:
    """Eigenvalues of many loops around one plant, with 40 digits; the sampled ones with the delay of the input."""

    _BITS = 140

    def __init__(self, A: RealMatrix, delay: Fraction = Fraction(0)) -> None:
        self._A, self._delay = A, delay

    @cached_property
    def _plant(self) -> Basis:
        with precision(self._BITS):
            return Basis(complex_matrix(self._A, len(self._A), len(self._A)))

    def figures(self, loop: LinearLoop, h: Fraction, margin: Fraction) -> Figures | None:
        """The figures at h, the radius also at ``margin`` times h; None where they could not be computed."""
        with precision(self._BITS):
            try:
                transition = Transition(loop, self._delay, self._plant)
                values = _eigenvalues(transition, h)
                longer = [] if margin == 1 else _eigenvalues(transition, h * margin)
                at_once = Transition(loop, plant=self._plant) if self._delay else transition
                slow = near_eigenvalues(midpoints(at_once.jet(arb(0)).c1))
            except (ValueError, ZeroDivisionError):
                return None
            radius = max(float(v.abs_upper()) for v in [*values, *longer])
            abscissa = max(float(v.real.mid()) for v in slow)
            rates = [v.log() for v in values if v.abs_lower() > 1e-12]
            damping = min(
                (-float(s.real.mid()) / float(s.abs_upper()) for s in rates if s.abs_lower() > 0), default=1.0
            )
        if not (math.isfinite(radius) and math.isfinite(abscissa)):
            return None
        return Figures(abscissa, radius, damping)

    def beyond(self, loop: LinearLoop, h: Fraction) -> float | None:
        """How far the spectral radius at h is beyond one, ``radius - 1``; None where it could not be computed.

        Of large loops without a delay in double precision.
        """
        if sum(loop.sizes[:2]) > _LARGEST_PRECISE and not self._delay:
            beyond = radius_in_doubles(loop, h) - 1
            return None if math.isnan(beyond) else beyond
        with precision(self._BITS):
            try:
                values = _eigenvalues(Transition(loop, self._delay, self._plant), h)
            except (ValueError, ZeroDivisionError):
                return None
            return max(float((v.abs_upper() - 1).mid()) for v in values)


def _eigenvalues(transition: Transition, h: Fraction) -> list[acb]:
    return near_eigenvalues(midpoints(transition.jet(ball(rational(h))).c0))


def estimate(loop: LinearLoop, start: Fraction, end: Fraction) -> Fraction | None:
    """About where the loop stops being stable beyond ``start``, from eigenvalues with 40 digits; no proof.

    None if no period up to ``end`` of a geometric grid is unstable.
    """
    spectrum = Spectrum(loop.A)

    def stable(h: Fraction) -> bool:
        beyond = spectrum.beyond(loop, h)
        return beyond is not None and beyond < 0

    good, bad = start, start * Fraction(_RATIO)
    while stable(bad):
        if bad > end:
            return None
        good, bad = bad, bad * Fraction(_RATIO)
    for _ in range(14):
        middle = ((good + bad) / 2).limit_denominator(10**15)
        good, bad = (middle, bad) if stable(middle) else (good, middle)
    return good


@dataclass(frozen=True)
class Examined:
    """Single periods that were decided, without what lies between them.

    Attributes:
        stable: the longest one that is proved stable, or None.
        next: the shortest examined one beyond it, which is not; None if there is none.
    """

    stable: Fraction | None
    next: Fraction | None


def examine(loop: LinearLoop, h: Fraction, end: Fraction, here: Stability, delay: Fraction = Fraction(0)) -> Examined:
    """Decide single periods from h on: shorter ones until one is stable, longer ones until one is not, then between.

    ``here`` is the verdict at h.

    For loops that are too large to scan. Each period is a number of at most three digits, or h. Without a delay they
    are looked for in double precision, and the one that is found is proved.
    """

    def proved(t: Fraction) -> bool:
        return spectral(loop, t, delay).status is Status.PROVED

    stable_here = here.status is Status.PROVED
    if not delay:
        likely = _search(h, end, stable_here, lambda t: radius_in_doubles(loop, t) < 1)
        if likely.stable is not None and (likely.stable == h or proved(likely.stable)):
            return likely
    return _search(h, end, stable_here, proved)


def _search(h: Fraction, end: Fraction, stable_here: bool, stable: Callable[[Fraction], bool]) -> Examined:
    good, bad = (h, None) if stable_here else (None, h)  # type: Fraction | None, Fraction | None
    while bad is not None and good is None:
        lower = _three_digits(float(bad) / _LEAP)
        if lower < h * Fraction(_SHORTEST):
            return Examined(None, bad)
        good, bad = (lower, bad) if stable(lower) else (None, lower)
    while good is not None and bad is None:
        upper = _three_digits(float(good) * _LEAP)
        if upper > end:
            return Examined(good, None)
        good, bad = (upper, None) if stable(upper) else (good, upper)
    assert good is not None
    assert bad is not None
    while bad > good * Fraction(_CLOSE):
        middle = _three_digits(math.sqrt(good * bad))
        if not good < middle < bad:
            break
        good, bad = (middle, bad) if stable(middle) else (good, middle)
    return Examined(good, bad)


def _three_digits(value: float) -> Fraction:
    return Fraction(f"{value:.3g}")
