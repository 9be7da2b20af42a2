"""Stability of a matrix of wide balls, by discs around the eigenvalues of its centre.

In the approximate eigenvectors V of the centre, ``T = V^-1 A V`` is nearly diagonal. With positive weights d every
eigenvalue of A lies in a disc around some ``T_ii`` with the radius ``sum_j |T_ij| d_j / d_i`` (Gershgorin). The best
weights solve ``(I - R) d = 1`` with ``R_ij = |T_ij| / margin_i``. V and d are found in floating point, everything else
is computed in balls, so that errors of the former only cost strength.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from flint import acb, acb_mat, arb, arb_mat
from numpy.typing import NDArray

from pbcgen.proof.lyapunov import Kind
from pbcgen.symbolic.real import precision

#: Bits of the verification.
_BITS = 192
#: Up to this size eigenvectors are computed with so many bits, beyond it in double precision.
_PRECISE = 12
#: Relative distance below which eigenvalues form a group.
_NEAR = 0.3


@dataclass(frozen=True, eq=False)
class Varying:
    """The matrices ``centre + sum_k slopes[k] widths[k]``: an enclosure of what a matrix is over a cell."""

    centre: arb_mat
    slopes: tuple[arb_mat, ...] = ()
    widths: tuple[arb, ...] = ()


def contract(family: Sequence[Varying], kind: Kind) -> bool:
    """Whether all matrices of a family pass in one basis with the same weights d (a no means nothing).

    For "schur" this says ``max_i |(V^-1 z)_i| / d_i`` gets smaller under each of them, so in any sequence too. The
    basis is that of the first centre. Where eigenvalues nearly meet, eigenvectors are nearly parallel: then an
    orthonormal basis of their span is tried.
    """
    with precision(_BITS):
        return any(_inside(family, kind, grouped) for grouped in (False, True))


def _inside(family: Sequence[Varying], kind: Kind, grouped: bool) -> bool:
    basis = _basis(family[0].centre, grouped)
    if basis is None:
        return False
    found = []
    for matrix in family:
        modal = _modal(matrix, basis)
        if modal is None:
            return False
        found.append((_margins(modal, kind), [[abs(entry) for entry in row] for row in modal]))
    weights = _weights(found)
    if weights is None:
        return False
    for margins, radii in found:
        for i, row in enumerate(radii):
            reach = sum((r * weights[j] for j, r in enumerate(row) if j != i), arb(0))
            if not reach < margins[i] * weights[i]:
                return False
    return True


def blurs(matrix: Varying, kind: Kind) -> list[float]:
    """How far :func:`contract` is from a proof, below 1 being one, in floating point: now, and with each width halved.

    That is the spectral radius of the entries beside the modes, relative to the margins; no scaling changes it.
    """
    with precision(_BITS):
        basis = _basis(matrix.centre, grouped=False)
        if basis is None:
            return [float("inf")] * (1 + len(matrix.widths))
        inverse, V = basis
        centre = (inverse * acb_mat(matrix.centre) * V).tolist()
        own = np.array([float(m.mid()) for m in _margins(centre, kind)])
        parts = [
            (inverse * acb_mat(slope * width) * V).tolist()
            for slope, width in zip(matrix.slopes, matrix.widths, strict=True)
        ]
    moved = [_sizes(part) / own[:, None] for part in parts]
    total = sum(moved, _sizes(centre) * (1 - np.eye(len(own))) / own[:, None])
    if not np.all(np.isfinite(total)) or not np.all(own > 0):
        return [float("inf")] * (1 + len(matrix.widths))
    return [float(np.abs(np.linalg.eigvals(total - less)).max()) for less in (0 * total, *(m / 2 for m in moved))]


def _sizes(rows: list[list[acb]]) -> NDArray[np.float64]:
    return np.array([[float(abs(v).abs_upper()) for v in row] for row in rows])


def _margins(modal: list[list[acb]], kind: Kind) -> list[arb]:
    return [-row[i].real if kind == "hurwitz" else 1 - abs(row[i]) for i, row in enumerate(modal)]


def _modal(matrix: Varying, basis: tuple[acb_mat, acb_mat]) -> list[list[acb]] | None:
    """``V^-1 A V``, or None if A is not finite."""
    inverse, V = basis
    total = inverse * acb_mat(matrix.centre) * V
    for slope, width in zip(matrix.slopes, matrix.widths, strict=True):
        if not all(entry.is_finite() for entry in slope.entries()):
            return None
        total = total + inverse * acb_mat(slope) * V * acb(width)
    modal: list[list[acb]] = total.tolist()
    return modal


def _basis(centre: arb_mat, grouped: bool) -> tuple[acb_mat, acb_mat] | None:
    if centre.nrows() == 0 or not all(entry.is_finite() for entry in centre.entries()):
        return None
    try:
        values, V = _eigenvectors(centre)
        if grouped:
            V = _orthonormal_in_groups(values, V)
        return V.inv(), V
    except (ValueError, ZeroDivisionError, np.linalg.LinAlgError):
        return None


def _eigenvectors(balls: arb_mat) -> tuple[list[complex], acb_mat]:
    if balls.nrows() <= _PRECISE:
        found, vectors = acb_mat(balls.mid()).eig(right=True, algorithm="approx")
        values = [complex(float(v.real.mid()), float(v.imag.mid())) for v in found]
        return values, acb_mat([[entry.mid() for entry in row] for row in vectors.tolist()])
    middle = np.array([[float(entry.mid()) for entry in row] for row in balls.tolist()])
    own, columns = np.linalg.eig(middle)
    return [complex(v) for v in own], _exactly(columns)


def _orthonormal_in_groups(values: list[complex], V: acb_mat) -> acb_mat:
    """The basis with the eigenvectors of eigenvalues that are near each other made orthonormal.

    Lengths are measured with every coordinate relative to its largest entry among the eigenvectors.
    """
    columns = np.array([[complex(float(v.real.mid()), float(v.imag.mid())) for v in row] for row in V.tolist()])
    columns = columns / np.abs(columns).max(axis=1, keepdims=True)
    change = np.eye(len(values), dtype=complex)
    for group in _groups(values):
        if len(group) > 1:
            own = np.linalg.qr(columns[:, group], mode="r")
            change[np.ix_(group, group)] = np.linalg.inv(own)
    if not np.all(np.isfinite(change)):
        raise ZeroDivisionError
    return V * _exactly(change)


def _groups(values: list[complex]) -> list[list[int]]:
    """The eigenvalues that are linked by small relative distances."""
    groups: list[list[int]] = []
    for k, value in enumerate(values):
        near = [g for g in groups if any(abs(value - values[j]) < _NEAR * max(abs(value), abs(values[j])) for j in g)]
        merged = sorted([k, *(j for g in near for j in g)])
        groups = [g for g in groups if g not in near] + [merged]
    return groups


def _exactly(columns: NDArray[Any]) -> acb_mat:
    return acb_mat([[acb(float(v.real), float(v.imag)) for v in row] for row in columns])


def _weights(found: Sequence[tuple[list[arb], list[list[arb]]]]) -> list[arb] | None:
    """Positive weights that suit the discs best, exact as numbers; None if there are none."""
    worst = np.zeros((len(found[0][0]),) * 2)
    for margins, radii in found:
        size = len(radii)
        own = np.array([float(m.lower()) for m in margins])
        if not np.all(np.isfinite(own)) or not np.all(own > 0):
            return None
        R = np.array([[0.0 if i == j else float(radii[i][j].abs_upper()) for j in range(size)] for i in range(size)])
        worst = np.maximum(worst, R / own[:, None])
    if not np.all(np.isfinite(worst)):
        return None
    try:
        d = np.linalg.solve(np.eye(len(worst)) - worst, np.ones(len(worst)))
    except np.linalg.LinAlgError:
        return None
    return [arb(float(v)) for v in d] if np.all(np.isfinite(d)) and np.all(d > 0) else None
