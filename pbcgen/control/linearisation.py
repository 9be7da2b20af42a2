"""The linearised closed loop over one sample period: its matrix, the verdict on it, and rounded eigenvalues."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

from flint import acb, arb

from pbcgen.control.transition import Basis, LinearLoop, Transition, complex_matrix, midpoints
from pbcgen.passivity.shaping import add, diagonal, multiply
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import RealMatrix, inverse
from pbcgen.proof.spectrum import Stability, schur, zero_order_hold
from pbcgen.symbolic.real import BITS, ONE, approximate, ball, near_eigenvalues, precision, rational

#: Periods of the estimate grow by this factor.
_RATIO = 1.4
#: Single periods are examined by this factor up or down, then in between until they are as close as this.
_LEAP, _CLOSE = 4, 1.02
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
    # Enclosures of the exponential lose about norm(A) h bits; the extra precision pays for them.
    norm = max((sum(abs(approximate(v)) for v in row) for row in loop.A), default=0.0)
    extra = int(min(4096.0, 3 * norm * float(h)))
    period = rational(h)
    with precision(BITS + extra):
        Ad, Bd = zero_order_hold(loop.A, loop.B, period)
    with precision(BITS):
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


class Spectrum:
    """Eigenvalues of many loops around one plant, with 40 digits; the sampled ones with the delay of the input."""

    _BITS = 140

    def __init__(self, A: RealMatrix, delay: Fraction = Fraction(0)) -> None:
        self._delay = delay
        with precision(self._BITS):
            self._plant = Basis(complex_matrix(A, len(A), len(A)))

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
        """How far the spectral radius at h is beyond one, ``radius - 1``; None where it could not be computed."""
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

    For loops that are too large to scan. Each period is a number of at most three digits, or h.
    """

    def stable(t: Fraction) -> bool:
        return spectral(loop, t, delay).status is Status.PROVED

    good: Fraction | None = h if here.status is Status.PROVED else None
    bad: Fraction | None = None if good else h
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
