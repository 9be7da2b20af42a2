"""Stability of a matrix of wide balls, by discs around the eigenvalues of its centre.

In the approximate eigenvectors V of the centre, ``T = V^-1 A V`` is nearly diagonal. With positive weights d every
eigenvalue of A lies in a disc around some ``T_ii`` with the radius ``sum_j |T_ij| d_j / d_i`` (Gershgorin). The best
weights solve ``(I - R) d = 1`` with ``R_ij = |T_ij| / margin_i``. V and d are found in floating point, everything else
is computed in balls, so that errors of the former only cost strength.
"""

from __future__ import annotations

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


def discs_inside(matrix: Varying, kind: Kind) -> bool:
    """Whether the matrices are certainly Hurwitz or Schur (a no means nothing).

    Where eigenvalues nearly meet, eigenvectors are nearly parallel: then an orthonormal basis of their span is tried.
    """
    with precision(_BITS):
        return any(_inside(matrix, kind, grouped) for grouped in (False, True))


def _inside(matrix: Varying, kind: Kind, grouped: bool) -> bool:
    modal = _modal(matrix, grouped)
    if modal is None:
        return False
    margins, radii = _margins(modal, kind), [[abs(entry) for entry in row] for row in modal]
    weights = _weights(radii, margins)
    if weights is None:
        return False
    for i, row in enumerate(radii):
        reach = sum((r * weights[j] for j, r in enumerate(row) if j != i), arb(0))
        if not reach < margins[i] * weights[i]:
            return False
    return True


def blurs(matrix: Varying, kind: Kind) -> list[float]:
    """How much each width adds to the balls that :func:`discs_inside` sees: in modes, relative to their margins."""
    with precision(_BITS):
        basis = _basis(matrix.centre, grouped=False)
        if basis is None:
            return [float("inf")] * len(matrix.widths)
        inverse, V = basis
        margins = _margins((inverse * acb_mat(matrix.centre) * V).tolist(), kind)
        own = [abs(float(m.mid())) or 1.0 for m in margins]
        result = []
        for slope, width in zip(matrix.slopes, matrix.widths, strict=True):
            moved = (inverse * acb_mat(slope * width) * V).tolist()
            result.append(sum(float(abs(v).abs_upper()) / m for row, m in zip(moved, own, strict=True) for v in row))
        return result


def _margins(modal: list[list[acb]], kind: Kind) -> list[arb]:
    return [-row[i].real if kind == "hurwitz" else 1 - abs(row[i]) for i, row in enumerate(modal)]


def _modal(matrix: Varying, grouped: bool) -> list[list[acb]] | None:
    """``V^-1 A V``, or None if the eigenvectors of the centre are not found."""
    basis = _basis(matrix.centre, grouped)
    if basis is None:
        return None
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


def _weights(radii: list[list[arb]], margins: list[arb]) -> list[arb] | None:
    """Positive weights that suit the discs best, exact as numbers; None if there are none."""
    size = len(radii)
    own = np.array([float(m.lower()) for m in margins])
    if not np.all(np.isfinite(own)) or not np.all(own > 0):
        return None
    R = np.array([[0.0 if i == j else float(radii[i][j].abs_upper()) for j in range(size)] for i in range(size)])
    R = R / own[:, None]
    if not np.all(np.isfinite(R)):
        return None
    try:
        d = np.linalg.solve(np.eye(size) - R, np.ones(size))
    except np.linalg.LinAlgError:
        return None
    return [arb(float(v)) for v in d] if np.all(np.isfinite(d)) and np.all(d > 0) else None
