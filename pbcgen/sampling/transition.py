"""One sample period of the linearised loop as an analytic function of that period, enclosed.

The loop over one period h is ``z+ = M(h) z`` with the plant under an exact zero-order hold, the controller stepped by
backward Euler and, if wanted, its output delayed. A jet encloses its Taylor coefficients on a whole cell of periods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeAlias

from flint import acb, acb_mat, arb, arb_mat, ctx

from pbcgen.symbolic.real import BITS, ball, precision, rational
from pbcgen.symbolic.real_matrices import RealMatrix, add, multiply

#: V, V^{-1}, ``V^{-1} A V``, its diagonal and a bound of its rest.
Diagonal: TypeAlias = tuple[acb_mat, acb_mat, acb_mat, list[acb], arb]

#: Residual of an approximate diagonalisation, relative to the matrix, above which it is not used.
_DIAGONAL = 1e-20


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


@dataclass(frozen=True, eq=False)
class Jet:
    """Taylor coefficients of a matrix function of h: value, first derivative, halves and sixths of the next two."""

    c0: acb_mat
    c1: acb_mat
    c2: acb_mat
    c3: acb_mat

    @property
    def coefficients(self) -> tuple[acb_mat, acb_mat, acb_mat, acb_mat]:
        """The coefficients in their order."""
        return self.c0, self.c1, self.c2, self.c3

    def __matmul__(self, other: Jet) -> Jet:
        a, b = self.coefficients, other.coefficients
        return Jet(
            a[0] * b[0],
            a[0] * b[1] + a[1] * b[0],
            a[0] * b[2] + a[1] * b[1] + a[2] * b[0],
            a[0] * b[3] + a[1] * b[2] + a[2] * b[1] + a[3] * b[0],
        )

    def __add__(self, other: Jet) -> Jet:
        return Jet(*(a + b for a, b in zip(self.coefficients, other.coefficients, strict=True)))

    def __sub__(self, other: Jet) -> Jet:
        return Jet(*(a - b for a, b in zip(self.coefficients, other.coefficients, strict=True)))

    def times(self, right: acb_mat) -> Jet:
        """Multiply by a constant from the right."""
        return Jet(*(a * right for a in self.coefficients))

    def after(self, left: acb_mat) -> Jet:
        """Multiply by a constant from the left."""
        return Jet(*(left * a for a in self.coefficients))

    def plus(self, constant: acb_mat) -> Jet:
        """Add a constant."""
        return Jet(self.c0 + constant, self.c1, self.c2, self.c3)


@dataclass(frozen=True, eq=False)
class RealJet:
    """A jet of a real matrix function."""

    c0: arb_mat
    c1: arb_mat
    c2: arb_mat


def _real_part(matrix: acb_mat) -> arb_mat:
    return arb_mat(matrix.nrows(), matrix.ncols(), [v.real for v in matrix.entries()])


def _diagonal_blocks(size: int, *blocks: acb_mat) -> acb_mat:
    """The blocks along the diagonal of an identity matrix."""
    whole, start = identity(size), 0
    for block in blocks:
        _place(whole, block, start, start)
        start += block.nrows()
    return whole


def complex_matrix(matrix: RealMatrix, rows: int, columns: int) -> acb_mat:
    """Exact or enclosed entries as complex balls."""
    return acb_mat(rows, columns, [acb(ball(entry)) for row in matrix for entry in row])


def identity(size: int) -> acb_mat:
    """The identity."""
    return acb_mat(size, size, [int(i == j) for i in range(size) for j in range(size)])


def real_identity(size: int) -> arb_mat:
    """The identity in real balls."""
    return arb_mat(size, size, [int(i == j) for i in range(size) for j in range(size)])


def midpoints(matrix: acb_mat) -> acb_mat:
    """The matrix of the centres of the balls."""
    return acb_mat(matrix.nrows(), matrix.ncols(), [v.mid() for v in matrix.entries()])


def largest(matrix: acb_mat) -> arb:
    """An upper bound of the maximum norm (largest row sum)."""
    rows = [sum((v.abs_upper() for v in row), arb(0)) for row in matrix.tolist()]
    return max((row.upper() for row in rows), default=arb(0))


class Basis:
    """A matrix A in coordinates in which it is nearly diagonal: ``V^{-1} A V = diag(d) + rest``.

    Where no such coordinates exist (A defective) V = I and functions of A are evaluated as matrix functions.
    """

    def __init__(self, A: acb_mat) -> None:
        size = A.nrows()
        self.V = self.inverse = identity(size)
        self.matrix, self.values = A, None  # type: acb_mat, list[acb] | None
        self.error = arb(0)
        found = diagonalise(A) if size else None
        if found is not None:
            self.V, self.inverse, self.matrix, self.values, self.error = found

    def exponential(self, t: arb) -> tuple[acb_mat, acb_mat]:
        """Enclosures of ``e^{A t}`` and ``int_0^t e^{A s} ds`` in these coordinates, t >= 0."""
        if self.values is None:
            return self._exponential_of_blocks(t)
        # e^{(D + rest) t} and e^{D t} differ by at most e^{t (mu + |rest|)} - e^{t mu} for mu >= max Re d; with mu >= 0
        # this grows with t, so that its value at the longest t bounds it, and its integral, for all shorter ones.
        longest = t.upper()
        mu = max((v.real.upper() for v in self.values), default=arb(0)).max(arb(0))
        spread = ((longest * (mu + self.error)).exp() - (longest * mu).exp()).abs_upper()
        halo, halo_integral = _disc(spread), _disc(spread * longest)
        e, g = ([function(v, t) for v in self.values] for function in (_exponential, _integral))
        return _near_diagonal(e, halo), _near_diagonal(g, halo_integral)

    def _exponential_of_blocks(self, t: arb) -> tuple[acb_mat, acb_mat]:
        """The same from ``exp([[A, I], [0, 0]] t)``, for a defective A."""
        size = self.matrix.nrows()
        whole = acb_mat(2 * size, 2 * size)
        _place(whole, self.matrix * acb(t), 0, 0)
        _place(whole, identity(size) * acb(t), 0, size)
        whole = whole.exp()
        return _block(whole, size, 0, 0), _block(whole, size, 0, size)

    def resolvent(self, h: arb) -> acb_mat:
        """An enclosure of ``(I - h A)^{-1}`` in these coordinates. Raises ZeroDivisionError if it may not exist."""
        if self.values is None:
            return (identity(self.matrix.nrows()) - self.matrix * acb(h)).inv()
        e = [1 / (1 - v * h) for v in self.values]
        largest = max((v.abs_upper() for v in e), default=arb(0))
        factor = h.abs_upper() * self.error * largest
        if not factor < 1:
            raise ZeroDivisionError
        halo = _disc((largest * factor / (1 - factor)).abs_upper())
        return _near_diagonal(e, halo)


def _near_diagonal(values: Sequence[acb], halo: acb) -> acb_mat:
    """The diagonal matrix of the values, every entry known up to the halo."""
    size = len(values)
    return acb_mat(size, size, [(v if i == j else acb(0)) + halo for i, v in enumerate(values) for j in range(size)])


def _block(matrix: acb_mat, size: int, row: int, column: int) -> acb_mat:
    """The square block that begins there."""
    return acb_mat(size, size, [matrix[row + i, column + j] for i in range(size) for j in range(size)])


def _disc(radius: arb) -> acb:
    """The complex numbers of at most this modulus, in a square."""
    side = arb(0, radius.upper())
    return acb(side, side)


def _exponential(v: acb, t: arb) -> acb:
    return (v * t).exp()


def _integral(v: acb, t: arb) -> acb:
    """``(e^{v t} - 1) / v``, also around v = 0 and t = 0."""
    z = v * t
    size = z.abs_upper()
    if size < 1:
        total, term, left = acb(0), acb(1), 1.0
        for k in range(1, 60):
            total, term, left = total + term, term * z / (k + 1), left * float(size) / (k + 1)
            if left < 2.0**-ctx.prec:
                break
        # The terms that are left sum to less than twice the first of them.
        return (total + _disc(2 * term.abs_upper())) * t
    return (z.exp() - 1) / v


def diagonalise(A: acb_mat) -> Diagonal | None:
    """V, ``V^{-1}``, ``V^{-1} A V``, its diagonal and a bound of its rest; None if A is nearly defective."""
    size = A.nrows()
    try:
        _, V = midpoints(A).eig(right=True, algorithm="approx")
        V = midpoints(V)
        inverse = V.inv()
        matrix = inverse * A * V
    except (ValueError, ZeroDivisionError):
        return None
    values = [matrix[i, i] for i in range(size)]
    rest = matrix - acb_mat(size, size, [values[i] if i == j else 0 for i in range(size) for j in range(size)])
    error = largest(rest)
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
        plant: Basis | None = None,
        steps: Fraction | None = None,
    ) -> None:
        n, k, m = loop.sizes
        nm = len(loop.H)
        self.n, self.k, self.m = n, k, m
        self.whole, self.part = divmod(delay, 1)
        self.memory = int(self.whole) + (1 if self.part else 0)
        self.delay = delay
        self.steps = steps
        self.plant = plant or Basis(complex_matrix(loop.A, n, n))
        self.filter = Basis(complex_matrix(loop.r_xi, k, k))
        H = complex_matrix(loop.H, nm, n) * self.plant.V
        self.B = self.plant.inverse * complex_matrix(loop.B, n, m)
        self.u_x = complex_matrix(loop.u_m, m, nm) * H
        self.u_xi = complex_matrix(loop.u_xi, m, k) * self.filter.V
        self.drive = self.filter.inverse * complex_matrix(loop.r_m, k, nm) * H

    @property
    def size(self) -> int:
        """The number of states of the sampled loop."""
        return self.n + self.k + self.memory * self.m

    def jet(self, h: arb) -> Jet:
        """M, M', M''/2 and M'''/6, enclosed for every period in the ball h."""
        own = h if self.steps is None else ball(rational(self.steps))
        E = self.filter.resolvent(own)
        r = self.filter.matrix
        zero = acb_mat(self.k, self.k, [0] * self.k**2)
        rE = r * E if self.k else zero
        if not self.k:
            step = held = Jet(zero, zero, zero, zero)
        elif self.steps is not None:
            step, held = Jet(E, zero, zero, zero), Jet(E * acb(own), zero, zero, zero)
        else:
            EE, rErE = E * E, rE * rE
            step = Jet(E, rE * E, rErE * E, rErE * rE * E)
            held = Jet(E * acb(own), EE, rE * EE, rErE * EE)
        xi_x = held.times(self.drive)
        u_x, u_xi = xi_x.after(self.u_xi).plus(self.u_x), step.after(self.u_xi)
        e, first = self._hold(h, Fraction(1))
        if self.part:
            _, late = self._hold(h, 1 - self.part)
            pushes = [late, first - late]
        else:
            pushes = [first]
        return self._assemble(e, pushes, xi_x, step, u_x, u_xi)

    def real(self, jet: Jet) -> RealJet:
        """The jet in the coordinates (x, xi, past inputs), in which everything is real."""
        V = _diagonal_blocks(self.size, self.plant.V, self.filter.V)
        inverse = _diagonal_blocks(self.size, self.plant.inverse, self.filter.inverse)
        return RealJet(*(_real_part(V * part * inverse) for part in (jet.c0, jet.c1, jet.c2)))

    def _hold(self, h: arb, share: Fraction) -> tuple[Jet, Jet]:
        """Jets of ``e^{A s h}`` and ``int_0^{s h} e^{A t} dt B``, s the share."""
        s = ball(rational(share))
        e, g = self.plant.exponential(h * s)
        A = self.plant.matrix
        Ae = A * e
        AAe = A * Ae
        square, cube = acb(s * s / 2), acb(s * s * s / 6)
        return (
            Jet(e, Ae * acb(s), AAe * square, A * AAe * cube),
            Jet(g * self.B, e * self.B * acb(s), Ae * self.B * square, AAe * self.B * cube),
        )

    def _assemble(self, e: Jet, pushes: list[Jet], xi_x: Jet, xi_xi: Jet, u_x: Jet, u_xi: Jet) -> Jet:
        """Blocks in the order x, xi, past inputs; push number j acts with the input of ``whole + j`` samples ago."""
        now = not self.whole
        x_x = e + pushes[0] @ u_x if now else e
        x_xi = pushes[0] @ u_xi if now else None
        acting = {int(self.whole) + j: push for j, push in enumerate(pushes)}
        coefficients = []
        for c in ("c0", "c1", "c2", "c3"):
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
                    _place(M, identity(shift), self.n + self.k + self.m, self.n + self.k)
            coefficients.append(M)
        return Jet(*coefficients)


def _place(target: acb_mat, block: acb_mat, row: int, column: int) -> None:
    for i, values in enumerate(block.tolist()):
        for j, value in enumerate(values):
            target[row + i, column + j] = value
