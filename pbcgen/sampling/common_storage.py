"""One quadratic storage for several linear maps, proposed in floating point; whoever asks for it verifies it.

A map enters as its form: the n^2 x n^2 matrix that takes P (row by row) to the matrix that shall be positive, such as
``P - M^T P M``. With the solver of the extra `sos` the proposals are solutions of matrix inequalities, without it fixed
points that learn which of the maps need more weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Rounds of the weights.
_LESSONS = 60


def solver_available() -> bool:
    """Whether matrix inequalities can be solved."""
    return find_spec("clarabel") is not None


def decrease(M: Array) -> Array:
    """The form of ``z+ = M z``: ``P - M^T P M``."""
    return np.asarray(np.eye(M.size) - np.kron(M.T, M.T))


def decay(A: Array) -> Array:
    """The form of ``z' = A z``: ``-(A^T P + P A)``."""
    identity = np.eye(len(A))
    return -np.asarray(np.kron(A.T, identity) + np.kron(identity, A.T))


def modal_basis(M: Array) -> tuple[Array, NDArray[np.complex128]]:
    """Real eigenvectors of M, a plane for each complex pair, and the eigenvalue of each column."""
    values, vectors = np.linalg.eig(M)
    columns, own = [], []
    for value, vector in zip(values, vectors.T, strict=True):
        if value.imag < 0:
            continue
        for part in [vector.real] if value.imag == 0 else [vector.real, vector.imag]:
            columns.append(part)
            own.append(value)
    return np.array(columns).T, np.array(own)


def common_storage(forms: Sequence[Array], weights: Array) -> Array | None:
    """P > 0 with ``form(P) >= t W^2`` for all forms, W = diag(weights), t > 0 as large as it goes; or None."""
    n = len(weights)
    P = None
    if solver_available():
        blocks = [(_block(form, 1 / weights), -np.eye(n), np.zeros((n, n))) for form in forms]
        blocks.append((np.eye(n * n), np.zeros((n, n)), np.zeros((n, n))))
        P = _solved(n, blocks, np.zeros((n, n)), -1.0, trace=float(n))
    if P is None or _worst(forms, P) <= 0:
        P = _by_weights(forms, weights)
    return P if P is not None and np.linalg.eigvalsh(P)[0] > 0 else None


def smallest_storage(forms: Sequence[Array], weights: Array, floors: Sequence[Array], aim: Array) -> Array | None:
    """P >= c c^T for the floors c, with ``form(P) >= 0``, and ``trace(aim P)`` as small as it goes. None if not found.

    ``z^T P z <= 1`` is then inside ``|c^T z| <= 1``. Without the solver a common storage is scaled to fit.
    """
    n = len(weights)
    if solver_available():
        zero = np.zeros((n, n))
        blocks = [(_block(form, 1 / weights), zero, zero) for form in forms]
        blocks += [(np.eye(n * n), zero, -np.outer(c, c)) for c in floors]
        P = _solved(n, blocks, aim, 0.0)
        if P is not None and np.linalg.eigvalsh(P)[0] > 0:
            return P
    found = common_storage(forms, weights)
    if found is None:
        return None
    inverse = np.linalg.inv(found)
    return found * max(float(c @ inverse @ c) for c in floors)


def _block(form: Array, scale: Array) -> Array:
    """The form in rows and columns that are scaled."""
    return np.asarray(np.outer(scale, scale).ravel()[:, None] * form)


def _worst(forms: Sequence[Array], P: Array) -> float:
    n = len(P)
    return float(min(np.linalg.eigvalsh((form @ P.ravel()).reshape(n, n))[0] for form in forms))


def _solved(
    n: int, blocks: Sequence[tuple[Array, Array, Array]], aim: Array, slope: float, trace: float | None = None
) -> Array | None:
    """Minimise ``trace(aim P) + slope t`` with ``form(P) + t C + D >= 0`` for each block (form, C, D)."""
    import clarabel
    from scipy import sparse

    pairs = [(i, j) for j in range(n) for i in range(j + 1)]
    rows = np.array([i * n + j for i, j in pairs])
    scale = np.array([1.0 if i == j else np.sqrt(2) for i, j in pairs])
    units = np.zeros((n * n, len(pairs)))
    for k, (i, j) in enumerate(pairs):
        units[i * n + j, k] = units[j * n + i, k] = 1.0
    symmetric = np.array([((e := M.reshape(n, n)) + e.T).ravel() / 2 for M in np.eye(n * n)])
    A, b = [], []
    cones = []
    if trace is not None:
        A.append(np.array([[float(i == j) for i, j in pairs] + [0.0]]))
        b.append(np.array([trace]))
        cones.append(clarabel.ZeroConeT(1))
    for form, C, D in blocks:
        image = (symmetric @ form @ units)[rows] * scale[:, None]
        A.append(-np.hstack([image, (C.ravel()[rows] * scale)[:, None]]))
        b.append(D.ravel()[rows] * scale)
        cones.append(clarabel.PSDTriangleConeT(n))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    size = len(pairs) + 1
    q = np.append(units.T @ aim.ravel(), slope)
    quadratic = sparse.csc_matrix((size, size))
    solver = clarabel.DefaultSolver(quadratic, q, sparse.csc_matrix(np.vstack(A)), np.concatenate(b), cones, settings)
    solution = solver.solve()
    x = np.array(solution.x)
    if "Infeasible" in str(solution.status) or not np.all(np.isfinite(x)) or (slope and x[-1] <= 0):
        return None
    return np.asarray((units @ x[:-1]).reshape(n, n))


def _by_weights(forms: Sequence[Array], weights: Array) -> Array | None:
    """P with ``sum_k w_k form_k(P) = W^2``, the weights w learning from the forms that are not positive."""
    n = len(weights)
    share = np.full(len(forms), 1 / len(forms))
    target = np.diag(weights**2).ravel()
    left = 1 / weights[:, None]
    for _ in range(_LESSONS):
        try:
            found = np.linalg.solve(sum(w * form for w, form in zip(share, forms, strict=True)), target)
        except np.linalg.LinAlgError:
            return None
        P: Array = (found.reshape(n, n) + found.reshape(n, n).T) / 2
        margins = np.array([np.linalg.eigvalsh(left * (form @ P.ravel()).reshape(n, n) * left.T)[0] for form in forms])
        if np.all(margins > 0) and np.linalg.eigvalsh(P)[0] > 0:
            return P
        share = share * np.exp(-margins / max(1e-9, float(np.max(np.abs(margins)))))
        share /= share.sum()
    return None
