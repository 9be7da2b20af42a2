"""Stability of large matrices by a Lyapunov matrix: proposed in floating point, verified in ball arithmetic.

With M = -(A^T P + P A) > 0 (Hurwitz) or M = P - A^T P A > 0 (Schur) no eigenvalue lies on the boundary; then all lie
inside iff P > 0, and ``v^T P v < 0`` for one v proves that one lies outside. The solver's errors do not matter: M is
computed again from P and the given A in balls. M and P are tested as ``X M X^T``, X being a floating-point inverse of a
Cholesky factor: close to the identity, so that Gershgorin's discs decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from flint import arb, arb_mat
from numpy.typing import NDArray

from pbcgen.proof.claim import Status
from pbcgen.symbolic.real import approximate, ball, precision
from pbcgen.symbolic.real_matrices import RealMatrix, nonzeros

Floats: TypeAlias = NDArray[np.float64]
Kind: TypeAlias = Literal["hurwitz", "schur"]

#: Bits of the verification; the products of doubles are exact in so many.
_BITS = 192
#: Corrections of the Lyapunov matrix by its own residual.
_CORRECTIONS = 2


@dataclass(frozen=True, eq=False)
class LyapunovProof:
    """P in the coordinates z with x = scale z.

    Attributes:
        status: PROVED, REFUTED (an eigenvalue is certainly outside) or UNDECIDED.
        scale: powers of two that balance the matrix.
        P: exact symmetric matrix of doubles, empty when UNDECIDED.
        direction: for REFUTED, v with ``v^T P v < 0``.
    """

    status: Status
    scale: tuple[float, ...] = ()
    P: tuple[tuple[float, ...], ...] = ()
    direction: tuple[float, ...] = ()

    def certificate(self) -> dict[str, object]:
        """Numbers from which the verdict can be checked again."""
        if self.status is Status.UNDECIDED:
            return {}
        result: dict[str, object] = {
            "scale": [v.hex() for v in self.scale],
            "P": [[v.hex() for v in row[: i + 1]] for i, row in enumerate(self.P)],
        }
        return result | ({"direction": [v.hex() for v in self.direction]} if self.direction else {})


def lyapunov(matrix: RealMatrix, kind: Kind) -> LyapunovProof:
    """Decide whether a matrix of exact numbers or balls is Hurwitz or Schur."""
    undecided = LyapunovProof(Status.UNDECIDED)
    middle = np.array([[approximate(entry) for entry in row] for row in matrix], dtype=float)
    if middle.size == 0 or not np.all(np.isfinite(middle)):
        return undecided
    scale = _balance(middle)
    balanced = middle / scale[:, None] * scale
    proposal = _propose(balanced, kind)
    if proposal is None:
        return undecided
    with precision(_BITS):
        A = _scaled(matrix, scale)
        P = proposal
        if not certainly_positive(_decrease(A, P, kind)):
            return undecided
        exact_scale = tuple(float(v) for v in scale)
        rows = tuple(tuple(float(v) for v in row) for row in P)
        if certainly_positive(_balls(P)):
            return LyapunovProof(Status.PROVED, exact_scale, rows)
        values, vectors = np.linalg.eigh(P)
        direction = vectors[:, 0]
        v = _balls(direction[:, None])
        if values[0] < 0 and (v.transpose() * _balls(P) * v)[0, 0] < 0:
            return LyapunovProof(Status.REFUTED, exact_scale, rows, tuple(float(c) for c in direction))
    return undecided


def _balance(middle: Floats) -> Floats:
    """Powers of two by which a diagonal similarity makes rows and columns comparable."""
    from scipy.linalg import matrix_balance

    _, (scale, _) = matrix_balance(middle, permute=False, separate=True)
    return np.asarray(2.0 ** np.round(np.log2(scale)))


def _propose(A: Floats, kind: Kind) -> Floats | None:
    """A symmetric P with M = I, corrected once by its residual; for Schur M = I after the map (A - I)(A + I)^-1."""
    from scipy.linalg import schur
    from scipy.linalg.lapack import dtrsyl

    identity = np.eye(len(A))
    with np.errstate(all="ignore"):
        try:
            generator = A if kind == "hurwitz" else np.linalg.solve((A + identity).T, (A - identity).T).T
            if not np.all(np.isfinite(generator)):
                return None
            T, U = schur(generator, output="real")
        except np.linalg.LinAlgError:
            return None
        P = np.zeros_like(A)
        for _ in range(_CORRECTIONS):
            residual = -identity - (generator.T @ P + P @ generator)
            step, size, info = dtrsyl(T, T, U.T @ residual @ U, trana="T")
            if info != 0 or not np.all(np.isfinite(step)):
                return None
            step = U @ (step / size if size != 1 else step) @ U.T
            P = P + (step + step.T) / 2
    return np.asarray(P) if np.all(np.isfinite(P)) else None


def _balls(values: Floats) -> arb_mat:
    return arb_mat([[arb(float(v)) for v in row] for row in values])


def _scaled(matrix: RealMatrix, scale: Floats) -> arb_mat:
    """The balanced matrix as balls; the scale is made of powers of two, so nothing is rounded."""
    factors = [arb(float(v)) for v in scale]
    balanced = arb_mat(len(matrix), len(matrix))
    for i, row in enumerate(nonzeros(matrix)):
        for j, entry in row.items():
            balanced[i, j] = ball(entry) * factors[j] / factors[i]
    return balanced


def _decrease(A: arb_mat, P: Floats, kind: Kind) -> arb_mat:
    """M, symmetric by construction."""
    exact = _balls(P)
    if kind == "schur":
        M = exact - A.transpose() * exact * A
        return (M + M.transpose()) * arb(0.5)
    product = exact * A
    return -(product + product.transpose())


def certainly_positive(matrix: arb_mat) -> bool:
    """Whether a symmetric matrix of balls is certainly positive definite (a no means nothing)."""
    size = matrix.nrows()
    middle = np.array([[float(entry.mid()) for entry in row] for row in matrix.tolist()])
    diagonal = np.sqrt(np.abs(np.diag(middle)))
    if not np.all(np.isfinite(middle)) or not np.all(diagonal > 0):
        return False
    try:
        factor = np.linalg.cholesky((middle + middle.T) / 2 / np.outer(diagonal, diagonal))
        X = np.linalg.solve(factor, np.diag(1 / diagonal))
    except np.linalg.LinAlgError:
        return False
    if not np.all(np.isfinite(X)):
        return False
    near = _balls(X)
    image = (near * matrix * near.transpose()).tolist()
    for k in range(size):
        off = sum((abs(entry) for j, entry in enumerate(image[k]) if j != k), arb(0))
        if not image[k][k] > off:
            return False
    return True
