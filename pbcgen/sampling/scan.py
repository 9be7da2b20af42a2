"""Sample periods scanned with proof: where the linearised sampled loop is stable for every h, not at grid points only.

The transition M(h) of the loop over one period is analytic in h. On a cell ``h = c + delta``, ``|delta| <= r``, in the
coordinates of the eigenvectors of M(c) and after the similarity ``I + delta X + delta^2 Y`` that follows them, M is
``D + delta L + delta^2 Q`` (diagonal) plus a rest of third order in r. If the weighted row sums of moduli stay below
one, every M(h) of the cell is a contraction in one weighted maximum norm: that is the certificate of a cell, checked in
ball arithmetic.

Cells that overlap from h = 0 on prove stability up to the end of the last one. There is no sampling in between, so
windows of instability cannot be missed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from flint import acb, acb_mat, arb, arb_mat

from pbcgen.proof.claim import Status
from pbcgen.sampling.transition import Diagonal, LinearLoop, Transition, diagonalise, midpoints, real_identity
from pbcgen.symbolic.real import ball, enclose, in_high_precision, precision, rational

#: Bits of the balls of a scan; the decision at a single period uses more.
SCAN_BITS = 128
#: Bits of the eigenvectors that serve as coordinates: any will do that nearly diagonalise.
_EIGENVECTOR_BITS = 80

#: Of what the rest may be, so much is aimed at; it grows with the third power of the width. Widths change by factors
#: from the first to the second of these after a cell that holds, from the third to the fourth after one that does not.
_AIM = 0.5
_SLOWEST, _FASTEST, _RETREAT, _BACK = 0.7, 2.0, 0.3, 0.8
#: How much of the way to where an eigenvalue seems to leave the unit disc a cell takes, and how close, relatively, it
#: comes.
_APPROACH, _CLOSE = Fraction(31, 32), 1e-6

#: A cell narrower than this, relative to its period, ends the scan.
NARROWEST = 1e-7


@dataclass(frozen=True)
class Scan:
    """What a scan proved.

    Attributes:
        start: the scan began here; 0 means that all periods down to zero are covered.
        stable_to: every h in (start, stable_to] gives a Schur-stable loop.
        unstable_at: a period just beyond at which the loop is proved not to be stable, or None if none was found.
        cells: the certificate: for each cell (h1, h2) its end points.
        delay: of the input, in samples.
        complete: whether the scan reached the end of its range without a failure.
        exhausted: whether it stopped because it had tried as many cells as it was allowed.
    """

    start: Fraction
    stable_to: Fraction
    unstable_at: Fraction | None
    cells: tuple[tuple[Fraction, Fraction], ...]
    delay: Fraction
    complete: bool
    exhausted: bool = False


# --- cells -------------------------------------------------------------------------------------------------------


def _absolute(matrix: acb_mat) -> arb_mat:
    """Upper bounds of the moduli of the entries."""
    return arb_mat(matrix.nrows(), matrix.ncols(), [v.abs_upper() for v in matrix.entries()])


@dataclass(frozen=True)
class _Contraction:
    """Whether a weighted maximum norm contracts on a cell, with what tells how wide the next one may be.

    Attributes:
        holds: whether it does; so much is proved.
        load: how large the rest is, about 1 where it just does not contract; or None.
        wall: where, seen from the centre, an eigenvalue seems to leave the unit disc; or None.
    """

    holds: bool
    load: float | None = None
    wall: float | None = None

    def __bool__(self) -> bool:
        return self.holds


_NONE = _Contraction(False)


def _contracts(gaps: list[arb], rest: arb_mat) -> _Contraction:
    """Whether positive weights w exist with ``gaps_i w_i > (rest w)_i``: then the weighted maximum norm contracts."""
    size = len(gaps)
    if any(not g > 0 for g in gaps) or not all(v.is_finite() for v in rest.entries()):
        return _NONE
    g = np.array([float(v.mid()) for v in gaps])
    P = np.array([float(v.upper()) for v in rest.entries()]).reshape(size, size)
    try:
        load = float(np.max(np.abs(np.linalg.eigvals(P / g[:, None])), initial=0.0))
        w = np.linalg.solve(np.diag(g) - P, g)
    except np.linalg.LinAlgError:
        return _NONE
    if not np.all(np.isfinite(w)) or np.any(w <= 0):
        return _Contraction(False, load)
    weights = arb_mat(size, 1, [arb(float(v)) for v in w])
    pushed = rest * weights
    return _Contraction(all(gaps[i] * weights[i, 0] > pushed[i, 0] for i in range(size)), load)


def _first_cell(transition: Transition, continuous: Diagonal, end: arb) -> bool:
    """Whether the loop is stable for every h in (0, end].

    With ``M = I + h (J + h M''/2)``, J the continuous loop, and ``|1 + h mu| <= 1 + h Re mu + h^2 |mu|^2 / 2``.
    """
    V, inverse, _, values, error = continuous
    try:
        curved = _absolute(inverse * transition.jet(arb(0).union(end)).c2 * V)
    except ZeroDivisionError:
        return False
    size = transition.size
    halo = error.upper()
    rest = arb_mat(
        size, size, [curved[i, j] * end + (halo if i != j else arb(0)) for i in range(size) for j in range(size)]
    )
    gaps = [-(v.real + end * v.abs_upper() ** 2 / 2) for v in values]
    return _contracts([arb(g.lower()) for g in gaps], rest).holds


def _cell(transition: Transition, centre: arb, r: arb, span: arb) -> _Contraction:
    """Whether the loop is stable for every h within r of the centre; ``span`` is that set of periods.

    With ``M = N0 + delta N1 + delta^2 N2 + delta^3 N3`` in the eigenvectors of M(c), N3 over the whole cell, and
    ``T = I + delta X + delta^2 Y``: ``M T - T (D + delta L + delta^2 Q)`` by powers of delta, D, L, Q diagonal.
    """
    size = transition.size
    jet = transition.jet(centre)
    try:
        with precision(_EIGENVECTOR_BITS):
            _, V = midpoints(jet.c0).eig(right=True, algorithm="approx")
        V = midpoints(V)
        inverse = V.inv()
        last = transition.jet(span).c3
    except (ValueError, ZeroDivisionError):
        return _NONE
    N0, N1, N2, N3 = (inverse * part * V for part in (jet.c0, jet.c1, jet.c2, last))
    D, L = _diagonal(N0), _diagonal(N1)
    reach = float(r.mid())
    X = _following(N0, N1, reach)
    second = N2 + N1 * X - X * L
    Q = _diagonal(second)
    Y = _following(N0, second, reach**2)
    powers = [
        N0 - D,
        N1 + N0 * X - X * D - L,
        second + N0 * Y - Y * D - Q,
        N3 + N2 * X + N1 * Y - X * Q - Y * L,
        N3 * X + N2 * Y - Y * Q,
        N3 * Y,
    ]
    defect, power = arb_mat(size, size), arb(1)
    for part in powers:
        defect, power = defect + _absolute(part) * power, power * r
    try:
        rest = _neumann(_absolute(X) * r + _absolute(Y) * (r * r)) * defect
    except ZeroDivisionError:
        return _NONE
    gaps = [_gap(D[i, i], L[i, i], Q[i, i], r) for i in range(size)]
    leaving = [_wall(D[i, i], L[i, i], Q[i, i], -reach) for i in range(size) if not gaps[i] > 0]
    if leaving:
        return _Contraction(False, wall=min((wall for wall in leaving if wall is not None), default=None))
    return _contracts(gaps, rest)


def _diagonal(matrix: acb_mat) -> acb_mat:
    size = matrix.nrows()
    return acb_mat(size, size, [matrix[i, i] if i == j else acb(0) for i in range(size) for j in range(size)])


def _gap(value: acb, slope: acb, curve: acb, r: arb) -> arb:
    """A lower bound of ``1 - |value + delta slope + delta^2 curve|`` for ``|delta| <= r``, by the square's terms."""
    square = abs(value) ** 2
    tilt = 2 * (value.real * slope.real + value.imag * slope.imag)
    bend = abs(slope) ** 2 + 2 * (value.real * curve.real + value.imag * curve.imag)
    twist = 2 * (slope.real * curve.real + slope.imag * curve.imag)
    most = square + abs(tilt) * r + bend.union(arb(0)) * r**2 + abs(twist) * r**3 + abs(curve) ** 2 * r**4
    return arb((1 - most.abs_upper().sqrt()).lower())


def _wall(value: acb, slope: acb, curve: acb, first: float) -> float | None:
    """About the first delta at which ``|value + delta slope + delta^2 curve|`` is one; nothing rests on it."""
    v, s, c = (complex(z.mid()) for z in (value, slope, curve))
    short = float((1 - abs(value) ** 2).mid())
    powers = [abs(c) ** 2, 2 * (s * c.conjugate()).real, abs(s) ** 2 + 2 * (v * c.conjugate()).real]
    roots = np.roots([*powers, 2 * (v * s.conjugate()).real, -short]) if np.all(np.isfinite([v, s, c])) else np.zeros(0)
    real = [float(z.real) for z in roots if abs(z.imag) < 1e-6 * abs(z) and z.real > first]
    return min(real, default=None)


def _following(N0: acb_mat, N: acb_mat, reach: float) -> acb_mat:
    """X with ``N + D X - X D`` diagonal where eigenvalues stay apart for ``|t| <= reach``: exact numbers, else zero."""
    size = N0.nrows()
    values = [N0[i, i].mid() for i in range(size)]
    couplings = [v.mid() for v in N.entries()]
    X = acb_mat(size, size)
    for i in range(size):
        for j in range(i):
            difference = values[j] - values[i]
            if not difference.abs_lower() > 0:
                continue
            there, back = couplings[i * size + j] / difference, couplings[j * size + i] / difference
            if float((there * back).abs_upper().mid()) * reach**2 < 0.09:
                X[i, j], X[j, i] = there.mid(), -back.mid()
    return X


def _neumann(P: arb_mat) -> arb_mat:
    """An upper bound of ``sum_k P^k`` for P >= 0. Raises ZeroDivisionError if the series may diverge."""
    size = P.nrows()
    if not _contracts([arb(1)] * size, P):
        raise ZeroDivisionError
    inverted = (real_identity(size) - P).inv()
    return arb_mat(size, size, [v.abs_upper() for v in inverted.entries()])


# --- the scan ----------------------------------------------------------------------------------------------------


@dataclass
class _March:
    """Cells one behind the other, each as wide as it can be proved."""

    transition: Transition
    at: Fraction
    end: Fraction
    width: Fraction
    cells: list[tuple[Fraction, Fraction]]
    tries: int | None = None
    wall: Fraction | None = None

    def run(self) -> bool:
        """Go on to the end; False where the cells become too narrow or the tries run out."""
        while self.at < self.end:
            if self.tries is not None:
                if self.tries == 0:
                    return False
                self.tries -= 1
            width = min(self.width, self.end - self.at, self._room())
            upper = self.at + width
            found = self._contraction(self.at, upper)
            wanted = (_AIM / found.load) ** (1 / 3) if found.load else _FASTEST if found else _RETREAT
            if found:
                self.cells.append((self.at, upper))
                self.at = upper
                if self.wall is None:
                    self.width = _short(width * Fraction(min(max(wanted, _SLOWEST), _FASTEST)))
            else:
                self.wall = None if found.wall is None else (self.at + upper) / 2 + Fraction(found.wall)
                self.width = _short(width * Fraction(min(max(wanted, _RETREAT), _BACK)))
                if self.width < self.at * Fraction(NARROWEST):
                    return False
        return True

    def _room(self) -> Fraction:
        """The width of a cell that ends a little before an eigenvalue leaves the unit disc, if it is not too close."""
        if self.wall is None or self.wall - self.at < self.at * Fraction(_CLOSE):
            self.wall = None
            return self.end
        return _short((self.wall - self.at) * _APPROACH)

    def _contraction(self, lo: Fraction, hi: Fraction) -> _Contraction:
        centre = (lo + hi) / 2
        r = (hi - lo) / 2
        return _cell(self.transition, ball(rational(centre)), arb(ball(rational(r)).upper()), enclose(lo, hi))


def _short(value: Fraction) -> Fraction:
    """A fraction with a short denominator a little below the value, so that end points stay short."""
    exponent = math.frexp(float(value))[1] - 12
    unit = Fraction(2) ** exponent
    return Fraction(math.floor(value / unit)) * unit


def scan(
    loop: LinearLoop,
    end: Fraction,
    *,
    delay: Fraction = Fraction(0),
    start: Fraction = Fraction(0),
    tries: int | None = None,
) -> Scan:
    """Prove stability for all sample periods from ``start`` on, as far as it holds, at most to ``end``.

    Args:
        loop: plant and law at the target.
        end: the largest period that matters, seconds.
        delay: of the input in samples, 0 to 2, whole or not.
        start: where to begin, seconds. With a delay it must be positive.
        tries: how many cells may be tried; as many as it takes by default.

    Returns:
        The proved range and, where it ends before ``end``, a period at which the loop is proved unstable.
    """
    with precision(SCAN_BITS):
        transition = Transition(loop, delay)
        cells: list[tuple[Fraction, Fraction]] = []
        at = start
        if start == 0:
            first = _begin(transition, end)
            if first is None:
                return Scan(start, start, _unstable_after(transition, Fraction(0), end), (), delay, False)
            cells.append((Fraction(0), first))
            at = first
        march = _March(transition, at, end, at / 2, cells, tries)
        complete = march.run()
        exhausted = not complete and march.tries == 0
        unstable = None if complete or exhausted else _unstable_after(transition, march.at, end)
        return Scan(start, march.at, unstable, tuple(march.cells), delay, complete, exhausted)


def _begin(transition: Transition, end: Fraction) -> Fraction | None:
    """The end of a first cell that starts at h = 0, or None if the continuous loop is not certainly Hurwitz."""
    continuous = diagonalise(transition.jet(arb(0)).c1)
    if continuous is None:
        return None
    h = end
    for _ in range(120):
        if _first_cell(transition, continuous, ball(rational(h))):
            return h
        h = _short(h / 4)
    return None


def _unstable_after(transition: Transition, h: Fraction, end: Fraction) -> Fraction | None:
    """A period closely behind h at which the loop is proved not to be stable."""
    base = h if h > 0 else end * Fraction(1, 10**9)
    for exponent in range(-7, 1):
        candidate = base * (1 + Fraction(10) ** exponent)
        if candidate > end:
            return None
        candidate = candidate.limit_denominator(10**18)
        if decide(transition, candidate) is Status.REFUTED:
            return candidate
    return None


@in_high_precision
def decide(transition: Transition, h: Fraction) -> Status:
    """Whether the loop with this sample period is Schur stable: PROVED, REFUTED or UNDECIDED."""
    M = transition.jet(ball(rational(h))).c0
    if _cell(transition, ball(rational(h)), arb(0), ball(rational(h))):
        return Status.PROVED
    try:
        values = M.eig(multiple=True)
    except (ValueError, ZeroDivisionError):
        return Status.UNDECIDED
    return Status.REFUTED if any(v.abs_lower() > 1 for v in values) else Status.UNDECIDED
