"""Sample periods scanned with proof: where the linearised sampled loop is stable for every h, not at grid points only.

The loop over one period h is ``z+ = M(h) z`` with the plant under an exact zero-order hold, the controller stepped by
backward Euler and, if wanted, its output delayed. M is analytic in h, and a jet encloses M, M' and M''/2 on a whole
cell of periods. On a cell ``h = c + delta``, ``|delta| <= r``, in the coordinates of the eigenvectors of M(c) and
after the first-order similarity ``I + delta X`` that follows them, M is ``D + delta L`` (diagonal) plus a rest of
second order in r. If the weighted row sums of ``|D + delta L| + rest`` stay below one, every M(h) of the cell is a
contraction in one weighted maximum norm: that is the certificate of a cell, checked in ball arithmetic.

Cells that overlap from h = 0 on prove stability up to the end of the last one. There is no sampling in between, so
windows of instability cannot be missed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from flint import acb, acb_mat, arb, arb_mat
from numpy.typing import NDArray

from pbcgen.passivity.shaping import add, multiply
from pbcgen.proof.claim import Status
from pbcgen.proof.definite import RealMatrix
from pbcgen.symbolic.real import BITS, ball, enclose, in_high_precision, precision, rational

#: Bits of the balls of a scan; the decision at a single period uses more.
SCAN_BITS = 224

#: Residual of an approximate diagonalisation, relative to the matrix, above which it is not used.
_DIAGONAL = 1e-20

#: A cell narrower than this, relative to its period, ends the scan.
NARROWEST = 1e-7


@dataclass(frozen=True)
class LinearLoop:
    """Plant and law linearised at x*.

    ``x' = A x + B u``, ``m = H x``, ``xi' = r_m m + r_xi xi`` and ``u = u_m m + u_xi xi``. Every law steps its states
    by backward Euler at the target: ``xi+ = (I - h r_xi)^{-1} (xi + h r_m m)`` and ``u = u_m m + u_xi xi+``. A law
    without states has empty r and u_xi.
    """

    A: RealMatrix
    B: RealMatrix
    H: RealMatrix
    r_m: RealMatrix
    r_xi: RealMatrix
    u_m: RealMatrix
    u_xi: RealMatrix

    @property
    def sizes(self) -> tuple[int, int, int]:
        """(n, number of controller states, m)."""
        return len(self.A), len(self.r_xi), len(self.B[0])

    def continuous(self) -> RealMatrix:
        """The Jacobian of the continuous loop in (x, xi)."""
        with precision(BITS):
            pull = multiply(multiply(self.B, self.u_m), self.H)
            if not self.r_xi:
                return add(self.A, pull)
            top = [[*a, *b] for a, b in zip(add(self.A, pull), multiply(self.B, self.u_xi), strict=True)]
            return [*top, *([*a, *b] for a, b in zip(multiply(self.r_m, self.H), self.r_xi, strict=True))]


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


@dataclass(frozen=True, eq=False)
class _Jet:
    """Taylor coefficients of a matrix function of h: value, first derivative, half the second one."""

    c0: acb_mat
    c1: acb_mat
    c2: acb_mat

    def __matmul__(self, other: _Jet) -> _Jet:
        return _Jet(
            self.c0 * other.c0,
            self.c0 * other.c1 + self.c1 * other.c0,
            self.c0 * other.c2 + self.c1 * other.c1 + self.c2 * other.c0,
        )

    def __add__(self, other: _Jet) -> _Jet:
        return _Jet(self.c0 + other.c0, self.c1 + other.c1, self.c2 + other.c2)

    def __sub__(self, other: _Jet) -> _Jet:
        return _Jet(self.c0 - other.c0, self.c1 - other.c1, self.c2 - other.c2)

    def times(self, right: acb_mat) -> _Jet:
        return _Jet(self.c0 * right, self.c1 * right, self.c2 * right)

    def after(self, left: acb_mat) -> _Jet:
        return _Jet(left * self.c0, left * self.c1, left * self.c2)

    def plus(self, constant: acb_mat) -> _Jet:
        return _Jet(self.c0 + constant, self.c1, self.c2)


def _complex(matrix: RealMatrix, rows: int, columns: int) -> acb_mat:
    return acb_mat(rows, columns, [acb(ball(entry)) for row in matrix for entry in row])


def _identity(size: int) -> acb_mat:
    return acb_mat(size, size, [int(i == j) for i in range(size) for j in range(size)])


def _entries(matrix: acb_mat) -> Iterator[tuple[int, int, acb]]:
    for i in range(matrix.nrows()):
        for j in range(matrix.ncols()):
            yield i, j, matrix[i, j]


def _midpoints(matrix: acb_mat) -> acb_mat:
    return acb_mat(matrix.nrows(), matrix.ncols(), [v.mid() for _, _, v in _entries(matrix)])


def _largest(matrix: acb_mat) -> arb:
    """An upper bound of the maximum norm (largest row sum)."""
    rows = [sum((matrix[i, j].abs_upper() for j in range(matrix.ncols())), arb(0)) for i in range(matrix.nrows())]
    return max(rows, default=arb(0))


class _Basis:
    """A matrix A in coordinates in which it is nearly diagonal: ``V^{-1} A V = diag(d) + rest``.

    Where no such coordinates exist (A defective) V = I and functions of A are evaluated as matrix functions.
    """

    def __init__(self, A: acb_mat) -> None:
        size = A.nrows()
        self.V = self.inverse = _identity(size)
        self.matrix, self.values = A, None  # type: acb_mat, list[acb] | None
        self.error = arb(0)
        found = _diagonalise(A) if size else None
        if found is not None:
            self.V, self.inverse, self.matrix, self.values, self.error = found

    def exponential(self, t: arb) -> tuple[acb_mat, acb_mat]:
        """Enclosures of ``e^{A t}`` and ``int_0^t e^{A s} ds`` in these coordinates, t >= 0."""
        size = self.matrix.nrows()
        if self.values is None:
            block = [
                [self.matrix[i, j] * t for j in range(size)] + [t * int(i == j) for j in range(size)]
                for i in range(size)
            ]
            flat = [v for row in block for v in row] + [acb(0)] * (2 * size * size)
            whole = acb_mat(2 * size, 2 * size, flat).exp()
            return (
                acb_mat(size, size, [whole[i, j] for i in range(size) for j in range(size)]),
                acb_mat(size, size, [whole[i, size + j] for i in range(size) for j in range(size)]),
            )
        # e^{(D + rest) t} and e^{D t} differ by at most e^{t (mu + |rest|)} - e^{t mu}, mu = max Re d.
        longest = t.upper()
        mu = max((v.real.upper() for v in self.values), default=arb(0))
        spread = ((longest * (mu + self.error)).exp() - (longest * mu).exp()).abs_upper()
        halo, halo_integral = _disc(spread), _disc(spread * longest)
        e = [[(v * t).exp() if i == j else acb(0) for j in range(size)] for i, v in enumerate(self.values)]
        g = [[_integral(v, t) if i == j else acb(0) for j in range(size)] for i, v in enumerate(self.values)]
        return (
            acb_mat(size, size, [v + halo for row in e for v in row]),
            acb_mat(size, size, [v + halo_integral for row in g for v in row]),
        )

    def resolvent(self, h: arb) -> acb_mat:
        """An enclosure of ``(I - h A)^{-1}`` in these coordinates. Raises ZeroDivisionError if it may not exist."""
        size = self.matrix.nrows()
        if self.values is None:
            return (_identity(size) - self.matrix * acb(h)).inv()
        e = [1 / (1 - v * h) for v in self.values]
        largest = max((v.abs_upper() for v in e), default=arb(0))
        factor = h.abs_upper() * self.error * largest
        if not factor < 1:
            raise ZeroDivisionError
        halo = _disc((largest * factor / (1 - factor)).abs_upper())
        return acb_mat(size, size, [(e[i] if i == j else acb(0)) + halo for i in range(size) for j in range(size)])


def _disc(radius: arb) -> acb:
    """The complex numbers of at most this modulus, in a square."""
    side = arb(0, radius.upper())
    return acb(side, side)


def _integral(v: acb, t: arb) -> acb:
    """``(e^{v t} - 1) / v``, also around v = 0 and t = 0."""
    z = v * t
    if z.abs_upper() < 1:
        total, term = acb(0), acb(1)
        for k in range(1, 60):
            total, term = total + term, term * z / (k + 1)
        # The terms that are left sum to less than twice the last one.
        return (total + _disc(2 * term.abs_upper())) * t
    return (z.exp() - 1) / v


def _diagonalise(A: acb_mat) -> tuple[acb_mat, acb_mat, acb_mat, list[acb], arb] | None:
    size = A.nrows()
    try:
        _, V = _midpoints(A).eig(right=True, algorithm="approx")
        V = _midpoints(V)
        inverse = V.inv()
        matrix = inverse * A * V
    except (ValueError, ZeroDivisionError):
        return None
    values = [matrix[i, i] for i in range(size)]
    rest = matrix - acb_mat(size, size, [values[i] if i == j else 0 for i in range(size) for j in range(size)])
    error = _largest(rest)
    scale = max((v.abs_upper() for v in values), default=arb(0))
    if not error.is_finite() or not error <= arb(_DIAGONAL) * (1 + scale):
        return None
    return V, inverse, matrix, values, error


class Transition:
    """M(h) of a loop with an input delay, as jets.

    The state is (x, xi, the past inputs that still act), x and xi in the eigenvector coordinates of A and r_xi. With
    ``steps`` only the plant's period varies: the controller was generated for this one.
    """

    def __init__(
        self,
        loop: LinearLoop,
        delay: Fraction = Fraction(0),
        plant: _Basis | None = None,
        steps: Fraction | None = None,
    ) -> None:
        n, k, m = loop.sizes
        nm = len(loop.H)
        self.n, self.k, self.m = n, k, m
        self.whole, self.part = divmod(delay, 1)
        self.memory = int(self.whole) + (1 if self.part else 0)
        self.delay = delay
        self.steps = steps
        self.plant = plant or _Basis(_complex(loop.A, n, n))
        self.filter = _Basis(_complex(loop.r_xi, k, k))
        H = _complex(loop.H, nm, n) * self.plant.V
        self.B = self.plant.inverse * _complex(loop.B, n, m)
        self.u_x = _complex(loop.u_m, m, nm) * H
        self.u_xi = _complex(loop.u_xi, m, k) * self.filter.V
        self.drive = self.filter.inverse * _complex(loop.r_m, k, nm) * H

    @property
    def size(self) -> int:
        """The number of states of the sampled loop."""
        return self.n + self.k + self.memory * self.m

    def jet(self, h: arb) -> _Jet:
        """M, M' and M''/2, enclosed for every period in the ball h."""
        own = h if self.steps is None else ball(rational(self.steps))
        E = self.filter.resolvent(own)
        r = self.filter.matrix
        zero = acb_mat(self.k, self.k, [0] * self.k**2)
        rE = r * E if self.k else zero
        step = _Jet(E, rE * E, rE * rE * E) if self.k else _Jet(zero, zero, zero)
        held = _Jet(E * acb(own), E * E, rE * E * E) if self.k else step
        if self.steps is not None and self.k:
            step, held = _Jet(E, zero, zero), _Jet(E * acb(own), zero, zero)
        xi_x = held.times(self.drive)
        u_x, u_xi = xi_x.after(self.u_xi).plus(self.u_x), step.after(self.u_xi)
        e, first = self._hold(h, Fraction(1))
        if self.part:
            _, late = self._hold(h, 1 - self.part)
            pushes = [late, first - late]
        else:
            pushes = [first]
        return self._assemble(e, pushes, xi_x, step, u_x, u_xi)

    def _hold(self, h: arb, share: Fraction) -> tuple[_Jet, _Jet]:
        """Jets of ``e^{A s h}`` and ``int_0^{s h} e^{A t} dt B``, s the share."""
        s = ball(rational(share))
        e, g = self.plant.exponential(h * s)
        A = self.plant.matrix
        Ae = A * e
        return (
            _Jet(e, Ae * acb(s), A * Ae * acb(s * s / 2)),
            _Jet(g * self.B, e * self.B * acb(s), Ae * self.B * acb(s * s / 2)),
        )

    def _assemble(self, e: _Jet, pushes: list[_Jet], xi_x: _Jet, xi_xi: _Jet, u_x: _Jet, u_xi: _Jet) -> _Jet:
        """Blocks in the order x, xi, past inputs; push number j acts with the input of ``whole + j`` samples ago."""
        now = not self.whole
        x_x = e + pushes[0] @ u_x if now else e
        x_xi = pushes[0] @ u_xi if now else None
        acting = {int(self.whole) + j: push for j, push in enumerate(pushes)}
        coefficients = []
        for c in ("c0", "c1", "c2"):
            M = acb_mat(self.size, self.size, [0] * self.size**2)
            _place(M, getattr(x_x, c), 0, 0)
            if x_xi is not None:
                _place(M, getattr(x_xi, c), 0, self.n)
            for j, push in acting.items():
                if j:
                    _place(M, getattr(push, c), 0, self.n + self.k + (j - 1) * self.m)
            _place(M, getattr(xi_x, c), self.n, 0)
            _place(M, getattr(xi_xi, c), self.n, self.n)
            if self.memory:
                _place(M, getattr(u_x, c), self.n + self.k, 0)
                _place(M, getattr(u_xi, c), self.n + self.k, self.n)
                if c == "c0":
                    shift = (self.memory - 1) * self.m
                    _place(M, _identity(shift), self.n + self.k + self.m, self.n + self.k)
            coefficients.append(M)
        return _Jet(*coefficients)


def _place(target: acb_mat, block: acb_mat, row: int, column: int) -> None:
    for i, j, value in _entries(block):
        target[row + i, column + j] = value


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
    """Eigenvalues of many loops around one plant, with 40 digits."""

    _BITS = 140

    def __init__(self, A: RealMatrix, B: RealMatrix) -> None:
        with precision(self._BITS):
            self._plant = _Basis(_complex(A, len(A), len(A)))

    def figures(self, loop: LinearLoop, h: Fraction, margin: Fraction) -> Figures | None:
        """The figures at h, the radius also at ``margin`` times h; None where they could not be computed."""
        with precision(self._BITS):
            try:
                transition = Transition(loop, plant=self._plant)
                values = _midpoints(transition.jet(ball(rational(h))).c0).eig(algorithm="approx")
                longer = [] if margin == 1 else _midpoints(transition.jet(ball(rational(h * margin))).c0).eig(
                    algorithm="approx"
                )  # fmt: skip
                slow = _midpoints(transition.jet(arb(0)).c1).eig(algorithm="approx")
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


# --- cells -------------------------------------------------------------------------------------------------------


def _floats(matrix: acb_mat) -> NDArray[np.complex128]:
    size = matrix.nrows(), matrix.ncols()
    return np.array([complex(float(v.real.mid()), float(v.imag.mid())) for _, _, v in _entries(matrix)]).reshape(size)


def _absolute(matrix: acb_mat) -> arb_mat:
    """Upper bounds of the moduli of the entries."""
    return arb_mat(matrix.nrows(), matrix.ncols(), [v.abs_upper() for _, _, v in _entries(matrix)])


def _contracts(gaps: list[arb], rest: arb_mat) -> bool:
    """Whether positive weights w exist with ``gaps_i w_i > (rest w)_i``: then the weighted maximum norm contracts."""
    size = len(gaps)
    if any(not g > 0 for g in gaps) or any(not rest[i, j].is_finite() for i in range(size) for j in range(size)):
        return False
    g = np.array([float(v.mid()) for v in gaps])
    P = np.array([[float(rest[i, j].upper()) for j in range(size)] for i in range(size)])
    try:
        w = np.linalg.solve(np.diag(g) - P, g)
    except np.linalg.LinAlgError:
        return False
    if not np.all(np.isfinite(w)) or np.any(w <= 0):
        return False
    weights = arb_mat(size, 1, [arb(float(v)) for v in w])
    pushed = rest * weights
    return all(gaps[i] * weights[i, 0] > pushed[i, 0] for i in range(size))


def _first_cell(transition: Transition, continuous: acb_mat, end: arb) -> bool:
    """Whether the loop is stable for every h in (0, end].

    With ``M = I + h (J + h M''/2)``, J the continuous loop, and ``|1 + h mu| <= 1 + h Re mu + h^2 |mu|^2 / 2``.
    """
    found = _diagonalise(continuous)
    if found is None:
        return False
    V, inverse, _, values, error = found
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
    return _contracts([arb(g.lower()) for g in gaps], rest)


def _cell(transition: Transition, centre: arb, r: arb, span: arb) -> bool:
    """Whether the loop is stable for every h within r of the centre; ``span`` is that set of periods."""
    size = transition.size
    jet = transition.jet(centre)
    try:
        _, V = _midpoints(jet.c0).eig(right=True, algorithm="approx")
        V = _midpoints(V)
        inverse = V.inv()
        curve = transition.jet(span).c2
    except (ValueError, ZeroDivisionError):
        return False
    N0, N1, N2 = inverse * jet.c0 * V, inverse * jet.c1 * V, inverse * curve * V
    X = _following(N0, N1, float(r.mid()))
    D = acb_mat(size, size, [N0[i, i] if i == j else 0 for i in range(size) for j in range(size)])
    L = acb_mat(size, size, [N1[i, i] if i == j else 0 for i in range(size) for j in range(size)])
    turned = _absolute(X) * r
    straight = _absolute(N1 - L + D * X - X * D) * r + _absolute(N0 - D)
    bent = (_absolute(N1 * X - X * L) + _absolute(N2) * (_real_identity(size) + turned)) * (r * r)
    try:
        rest = _neumann(turned) * (straight + bent)
    except ZeroDivisionError:
        return False
    gaps = [_gap(N0[i, i], N1[i, i], r) for i in range(size)]
    return _contracts(gaps, rest)


def _gap(value: acb, slope: acb, r: arb) -> arb:
    """A lower bound of ``1 - |value + delta slope|``: the modulus is convex in delta, so its ends decide."""
    ends = [(value + slope * r).abs_upper(), (value - slope * r).abs_upper()]
    return arb((1 - max(ends)).lower())


def _following(N0: acb_mat, N1: acb_mat, r: float) -> acb_mat:
    """X with ``N1 + D X - X D`` diagonal, as far as the eigenvalues are apart: exact numbers, zero elsewhere."""
    size = N0.nrows()
    values = [N0[i, i].mid() for i in range(size)]
    entries = []
    for i, j, slope in _entries(N1):
        difference = values[j] - values[i]
        if i == j or not difference.abs_lower() > 0:
            entries.append(acb(0))
            continue
        x = (slope.mid() / difference).mid()
        turn = (x * (N1[j, i].mid() / difference)).abs_upper()
        entries.append(x if float(turn.mid()) * r * r < 0.09 else acb(0))
    return acb_mat(size, size, entries)


def _real_identity(size: int) -> arb_mat:
    return arb_mat(size, size, [int(i == j) for i in range(size) for j in range(size)])


def _neumann(P: arb_mat) -> arb_mat:
    """An upper bound of ``sum_k P^k`` for P >= 0. Raises ZeroDivisionError if the series may diverge."""
    size = P.nrows()
    if not _contracts([arb(1)] * size, P):
        raise ZeroDivisionError
    inverted = (_real_identity(size) - P).inv()
    return arb_mat(size, size, [inverted[i, j].abs_upper() for i in range(size) for j in range(size)])


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

    def run(self) -> bool:
        """Go on to the end; False where the cells become too narrow or the tries run out."""
        while self.at < self.end:
            if self.tries is not None:
                if self.tries == 0:
                    return False
                self.tries -= 1
            width = min(self.width, self.end - self.at)
            upper = self.at + width
            if self._holds(self.at, upper):
                self.cells.append((self.at, upper))
                self.at, self.width = upper, _short(width * 2)
            else:
                self.width = _short(width / 3)
                if self.width < self.at * Fraction(NARROWEST):
                    return False
        return True

    def _holds(self, lo: Fraction, hi: Fraction) -> bool:
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
    continuous = transition.jet(arb(0)).c1
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
