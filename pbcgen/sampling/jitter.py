"""Sample periods that change from step to step: one quadratic storage that decreases for each of them.

Only the plant's period varies: the code of the controller knows the nominal one. P is proposed in floating point, in
the eigenvectors of the nominal loop, as the solution of matrix inequalities at samples of the interval; then
``P - M(h)^T P M(h) > 0`` is verified for *every* h of the interval on subintervals, in balls.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from flint import arb, arb_mat

from pbcgen.proof.claim import Status
from pbcgen.sampling.common_storage import Array, common_storage, decrease, modal_basis
from pbcgen.sampling.scan import SCAN_BITS
from pbcgen.sampling.transition import LinearLoop, Transition, real_identity
from pbcgen.symbolic.real import ball, enclose, precision, rational

#: Limits of the search: order of the loop, samples of the interval.
_LARGEST = 30
_SAMPLES = 9

#: Subintervals that may be tried for one storage.
_CELLS = 1500

#: Bisections for the largest jitter.
_BISECTIONS = 6


@dataclass(frozen=True)
class Jitter:
    """Sample periods that change from step to step within [shortest, longest].

    Attributes:
        status: PROVED when one quadratic storage decreases for every period of the interval, else UNDECIDED.
        storage: F with the storage ``|F z|^2``, z = (x, xi, past inputs), or None.
        share: the largest share of the nominal period, to a few percent, for which a storage was certified.
    """

    shortest: Fraction
    longest: Fraction
    status: Status
    storage: Array | None
    share: Fraction = Fraction(0)


def jitter(loop: LinearLoop, h: Fraction, share: Fraction, delay: Fraction = Fraction(0)) -> Jitter:
    """Decide all sequences of periods in ``h (1 - share) .. h (1 + share)``, h being what the controller steps by.

    The largest share that is proved is sought by bisection.
    """
    found = _storage(loop, h, share, delay)
    good, bad = (Fraction(0), share) if found is None else (share, Fraction(1))
    for _ in range(_BISECTIONS):
        middle = (good + bad) / 2
        good, bad = (good, middle) if _storage(loop, h, middle, delay) is None else (middle, bad)
    status = Status.UNDECIDED if found is None else Status.PROVED
    return Jitter(h * (1 - share), h * (1 + share), status, found, good)


def _storage(loop: LinearLoop, h: Fraction, share: Fraction, delay: Fraction) -> Array | None:
    """F for the interval, verified; or None."""
    with precision(SCAN_BITS):
        transition = Transition(loop, delay, steps=h)
        if transition.size > _LARGEST:
            return None
        try:
            samples = [_floats(transition.real(transition.jet(ball(rational(t)))).c0) for t in _spread(h, share)]
            factor = _proposal(samples)
            if factor is None:
                return None
            return factor if _decreases(transition, factor, h * (1 - share), h * (1 + share)) else None
        except (ValueError, ZeroDivisionError, np.linalg.LinAlgError):
            return None


def _spread(h: Fraction, share: Fraction) -> list[Fraction]:
    """The nominal period first, then samples of the interval."""
    width = 2 * h * share
    return [h, *(h * (1 - share) + width * k / (_SAMPLES - 1) for k in range(_SAMPLES))]


def _floats(matrix: arb_mat) -> Array:
    return np.array([[float(matrix[i, j].mid()) for j in range(matrix.ncols())] for i in range(matrix.nrows())])


# --- the proposal ------------------------------------------------------------------------------------------------


def _proposal(samples: list[Array]) -> Array | None:
    """F with ``|F M_k z| < |F z|`` for all samples, the first being the nominal loop; or None."""
    basis, values = modal_basis(samples[0])
    inverse = np.linalg.inv(basis)
    weights = np.sqrt(np.maximum(1 - np.abs(values) ** 2, 1e-14))
    P = common_storage([decrease(inverse @ M @ basis) for M in samples], weights)
    return None if P is None else np.asarray(np.linalg.cholesky(P).T @ inverse)


# --- the proof ---------------------------------------------------------------------------------------------------


def _decreases(transition: Transition, factor: Array, lo: Fraction, hi: Fraction) -> bool:
    """Whether ``|F M(h) z| < |F z|`` for every h in [lo, hi] and z: subintervals, halved where one does not pass."""
    F = arb_mat([[arb(float(v)) for v in row] for row in factor])
    inverse = F.inv()
    waiting, left = [(lo, hi)], _CELLS
    while waiting:
        if left == 0:
            return False
        left -= 1
        a, b = waiting.pop()
        if _cell(transition, F, inverse, a, b):
            continue
        if b - a <= (hi - lo) / 10**5:
            return False
        middle = (a + b) / 2
        waiting += [(middle, b), (a, middle)]
    return True


def _cell(transition: Transition, F: arb_mat, inverse: arb_mat, a: Fraction, b: Fraction) -> bool:
    """One subinterval: with ``N(h) = F M(h) F^-1 = N0 + d N1 + d^2 N2`` the form ``I - N^T N`` around its middle.

    ``X (I - N0^T N0) X^T`` is close to I for X from a Cholesky factor in floating point; the terms in d must not eat
    it up. Terms of first order are summed before d is bounded, so that they cancel as they do in truth.
    """
    here = transition.real(transition.jet(ball(rational((a + b) / 2))))
    curve = transition.real(transition.jet(enclose(a, b))).c2
    N0, N1, N2 = (F * part * inverse for part in (here.c0, here.c1, curve))
    n = N0.nrows()
    rest = real_identity(n) - N0.transpose() * N0
    try:
        X = np.linalg.inv(np.linalg.cholesky(_floats(rest)))
    except np.linalg.LinAlgError:
        return False
    turn = arb_mat([[arb(float(v)) for v in row] for row in X])
    d = arb(ball(rational((b - a) / 2)).upper())
    zeroth = turn * rest * turn.transpose() - real_identity(n)
    left, first = (turn * N0.transpose(), turn * N1.transpose())
    steep = left * N1 * turn.transpose()
    bent = left * N2 * turn.transpose()
    last = turn * N2.transpose()
    quadratic = bent + bent.transpose() + first * first.transpose()
    cubic = first * last.transpose()
    total = (
        _norm(zeroth)
        + d * _norm(steep + steep.transpose())
        + d**2 * _norm(quadratic)
        + d**3 * _norm(cubic + cubic.transpose())
        + d**4 * _norm(last * last.transpose())
    )
    return bool(total < 1)


def _norm(symmetric: arb_mat) -> arb:
    """An upper bound of the spectral norm of a symmetric matrix: its Frobenius norm."""
    n = symmetric.nrows()
    return sum((symmetric[i, j].abs_upper() ** 2 for i in range(n) for j in range(n)), arb(0)).sqrt()
