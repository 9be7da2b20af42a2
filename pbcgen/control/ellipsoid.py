"""An ellipsoid that is certified as a region of attraction: one quadratic storage decreases in it.

With z the deviation of the plant and the arguments of the saturations, ``z' = F(z, t)``, ``t_i = tanh(beta_i z_i)``. On
the ellipsoid ``|z_i| <= Z_i``, so t_i = k_i beta_i z_i with k_i in [tanh(beta_i Z_i) / (beta_i Z_i), 1] (a sector), and
by the mean value theorem ``z' = (F_z + F_t diag(k beta)) z`` with averages of the derivatives on the segment from 0 to
(z, t). If ``P Q + Q^T P < 0`` for the matrices Q of every vertex of the sectors, with all values that the derivatives
take on the ellipsoid, ``z^T P z`` decreases on it, and it is a region of attraction of the continuous loop.

P is proposed by matrix inequalities at the vertices: as small as possible at the initial state. The proof is in balls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from flint import arb, arb_mat
from numpy.typing import NDArray

from pbcgen.control.derive import Derivation
from pbcgen.control.saturated_loop import Box, SaturatedLoop, Slope, saturated_loop
from pbcgen.proof.lyapunov import certainly_positive
from pbcgen.sampling.common_storage import Array, decay, modal_basis, smallest_storage
from pbcgen.symbolic.real import BITS, ball, precision, rational, upper

#: Arguments of tanh up to which the sectors of a proposal reach.
_SECTORS = (32.0, 22.0, 16.0, 11.0, 8.0, 5.5, 4.0, 2.8, 2.0, 1.4, 1.0, 0.5, 0.2, 0.05, 0.01)
#: Boxes of proposals as shares of the largest values on the way from the initial state.
_SHARES = (4.0, 2.0, 1.0, 0.7, 0.5, 0.35, 0.25, 0.17, 0.12, 0.08, 0.05, 0.03, 0.01, 3e-3, 1e-3, 1e-4, 1e-5)
#: Up to so many saturations a proposal takes all vertices into account.
_FEW_CHANNELS = 3
#: Saturations beyond which the vertices are too many, and the order of the largest loop.
_MOST_CHANNELS = 6
_LARGEST = 20
#: Shares of its own rate by which a mode must decay at every vertex: room for what the vertices do not show.
_DECAYS = (0.3, 0.1, 1e-3)
#: How often a proposal is solved in better coordinates.
_ROUNDS = 3
#: What the other directions count against the initial state.
_ROUND = 1e-3
_HALVINGS = 60
#: Work for the proposals (cube of the order times vertices), and how many there are at least.
_WORK = 30_000
_LEAST_PROPOSALS = 6
#: Proposals in a row that prove no larger ellipsoid, after which the search ends.
_PATIENCE = 6
#: Parts of a box that may be looked at for one ellipsoid.
_PARTS = 150
#: Logarithm below which a mode of the linear loop has faded.
_FADED = -200.0
#: A scale that is proved may still grow by about so much.
_GROWTH = 2.0


@dataclass(frozen=True)
class Ellipsoid:
    """``{z : z^T P z <= level}``, z the deviation of the plant and the arguments of the law's tanh terms.

    Attributes:
        names: of the entries of z. P, level: the ellipsoid. reach: its half widths along each coordinate.
        units: of the plant's states, the first entries of z.
        inside: half widths of its cut with all filters at rest; None where gamma or eta is not affine in x.
        start: how far along the way from x* to the initial state the ellipsoid reaches; None if that is x* itself.
    """

    names: tuple[str, ...]
    P: Array
    level: float
    reach: tuple[float, ...]
    units: tuple[str, ...]
    inside: tuple[float, ...] | None
    start: float | None

    def as_json(self) -> dict[str, object]:
        """For JSON documents: the ellipsoid and what it covers."""
        return {
            "names": list(self.names),
            "P": self.P.tolist(),
            "level": self.level,
            "reach": list(self.reach),
            "filters_at_rest": None if self.inside is None else list(self.inside),
            "covers_start": self.start,
        }

    @property
    def sentence(self) -> str:
        """The region in words and units of the states."""
        rest = "" if self.inside is None else " with the filters at rest"
        widths = ", ".join(
            f"{name} +- {width:.3g}{' ' + unit if unit else ''}"
            for name, width, unit in zip(self.names, self.inside or self.reach, self.units, strict=False)
        )
        start = ""
        if self.start is not None and self.start >= 1:
            start = ", which contains the initial state"
        elif self.start is not None:
            start = f", which covers {100 * self.start:.2g} % of the way from x* to the initial state"
        return f"certified region of attraction (continuous loop{rest}): an ellipsoid that reaches {widths}{start}"


def certified_ellipsoid(found: Derivation) -> Ellipsoid | None:
    """The largest ellipsoid that was certified around x*; None without one, and for the law `passive-output`.

    The coordinates are x, ``z_c = gamma~ + x_c``, ``z_l = Upsilon eta~ + K_l x_l`` and psi: each saturation depends on
    one of them.
    """
    loop = saturated_loop(found)
    if loop is None or len(loop.beta) > _MOST_CHANNELS or len(loop.names) > _LARGEST:
        return None
    with precision(BITS):
        try:
            best = _best(loop)
        except (ValueError, ZeroDivisionError, np.linalg.LinAlgError):
            return None
    if best is None:
        return None
    _, factor, scale = best
    return _described(found, loop, factor, scale)


def _best(loop: SaturatedLoop) -> _Found | None:
    """The proposal that proves the largest ellipsoid: wide boxes first, until narrower ones lose."""
    at_target = loop.at(np.zeros(len(loop.names)))
    if np.max(np.linalg.eigvals(loop.matrix(at_target, np.ones(len(loop.beta)))).real) >= 0:
        return None
    families = [_sectors(loop)]
    if loop.bends:
        families.append(_boxes(loop, at_target))
    best: _Found | None = None
    for widths in families:
        left, failures = _budget(loop) // len(families), 0
        for width in widths:
            hopeless = best is not None
            for share in _DECAYS:
                if left == 0:
                    break
                factor = _proposal(loop, at_target, width, share)
                if factor is None:
                    continue
                left -= 1
                if best is None or _GROWTH * loop.size_of(factor) > best[0]:
                    hopeless = False
                    grown = _grown(loop, factor, best)
                    best, failures = grown or best, 0 if grown else failures + 1
            if hopeless or left == 0 or (best is not None and failures >= _PATIENCE):
                break
    return best or _grown(loop, _modal(loop, at_target), None)


def _budget(loop: SaturatedLoop) -> int:
    """How many proposals are sought: fewer for large loops, whose inequalities take long."""
    corners: int = min(1 << len(loop.beta), len(loop.beta) + 2)
    return max(_LEAST_PROPOSALS, _WORK // (len(loop.names) ** 3 * corners))


def _modal(loop: SaturatedLoop, at_target: Slope) -> Array:
    """F whose rows are the modes, each decaying by itself, with arguments of the saturations of at most one."""
    basis, _ = modal_basis(loop.matrix(at_target, np.ones(len(loop.beta))))
    arguments = loop.slope_of_tanh * np.linalg.norm(basis[list(loop.row)], axis=1)
    return inverse_of(basis) * float(np.max(arguments))


def _described(found: Derivation, loop: SaturatedLoop, factor: Array, scale: float) -> Ellipsoid:
    inverse = np.linalg.inv(factor)
    reach = tuple(float(v) * scale for v in np.linalg.norm(inverse, axis=1))
    along = float(np.linalg.norm(factor @ loop.start))
    system = found.plant.system
    units = tuple(system.units.get(name, "") for name in system.state_names)
    P = factor.T @ factor
    inside = None if loop.lift is None else tuple(float(v) for v in scale * loop.cut(factor))
    return Ellipsoid(loop.names, P, scale**2, reach, units, inside, scale / along if along > 0 else None)


# --- the proposals -----------------------------------------------------------------------------------------------


def _sectors(loop: SaturatedLoop) -> list[Array]:
    """Half widths of boxes in which the arguments of the saturations are bounded and nothing else, widest first."""
    found = []
    for reach in _SECTORS:
        width = np.full(len(loop.names), np.inf)
        width[list(loop.row)] = reach / loop.slope_of_tanh
        found.append(width)
    return found


def _boxes(loop: SaturatedLoop, at_target: Slope) -> list[Array]:
    """Half widths in proportion to the largest values on the linear loop's way from the initial state, widest first."""
    values, vectors = np.linalg.eig(loop.matrix(at_target, np.ones(len(loop.beta))))
    times = np.concatenate([[0.0], np.geomspace(0.1 / np.max(np.abs(values)), 5 / np.min(-values.real), 400)])
    start = loop.start if np.any(loop.start) else np.ones(len(loop.names))
    modes = np.linalg.solve(vectors, start.astype(complex))
    exponents = np.outer(values, times)
    fading = np.where(exponents.real > _FADED, np.exp(np.maximum(exponents.real, _FADED) + 1j * exponents.imag), 0)
    path = np.abs((vectors * modes) @ fading)
    largest = np.max(path, axis=1)
    return [np.where(largest > 0, share * largest, np.inf) for share in _SHARES]


def _proposal(loop: SaturatedLoop, at_target: Slope, width: Array, share: float) -> Array | None:
    """F for a box around the target, every mode decaying by a share of its own rate; None if there is none.

    The inequalities are solved again in the coordinates of the solution, where its numbers are of order one, and with
    the slopes of the plant on the ellipsoid that was found.
    """
    size, beta = len(loop.names), loop.slope_of_tanh
    reach = np.minimum(beta * width[list(loop.row)], _SECTORS[0])
    corners = _corners(np.tanh(reach) / reach)
    basis, values = modal_basis(loop.matrix(at_target, np.ones(len(beta))))
    rooted = basis @ np.diag(np.sqrt(share * np.abs(values.real))) @ inverse_of(basis)
    slopes: list[Slope] = []
    for _ in range(_ROUNDS):
        inverse = inverse_of(basis)
        kept = inverse @ rooted @ basis
        left = np.kron(kept.T, kept.T)
        pairs = [(at_target, k) for k in corners] + [(slope, k) for slope in slopes for k in corners[:2]]
        forms = [decay(inverse @ loop.matrix(slope, k) @ basis) - left for slope, k in pairs]
        weights = np.sqrt(np.maximum(np.diag((forms[-1] @ np.eye(size).ravel()).reshape(size, size)), 1e-12))
        start = inverse @ loop.start
        aim = np.outer(start, start) + _ROUND * np.eye(size) * (float(start @ start) / size or 1.0)
        floors = [basis[j] / w for j, w in enumerate(width) if np.isfinite(w)]
        P = smallest_storage(forms, weights, floors, aim / np.trace(aim))
        if P is None:
            return None
        basis = np.asarray(basis @ inverse_of(np.linalg.cholesky(P).T))
        if loop.bends:
            slopes = [loop.at(sign * axis) for axis in basis.T for sign in (1, -1)]
    return inverse_of(basis)


def _corners(least: Array) -> list[Array]:
    """Vertices of the sectors for a proposal, the two extreme ones first; of many channels not all."""
    channels = len(least)
    if channels <= _FEW_CHANNELS:
        choices = [np.array(full) for full in product((False, True), repeat=channels)]
    else:
        choices = [np.arange(channels) != i for i in range(channels)]
    others = [np.where(full, 1.0, least) for full in choices if 0 < np.sum(full) < channels]
    return [least, np.ones(channels), *others]


def inverse_of(matrix: NDArray[np.floating[Any]]) -> Array:
    """The inverse. Raises LinAlgError for a singular matrix."""
    return np.asarray(np.linalg.inv(matrix))


# --- the proof ---------------------------------------------------------------------------------------------------


#: The size of the ellipsoid ``|F z| <= s``, F and s.
_Found = tuple[float, Array, float]


def _grown(loop: SaturatedLoop, factor: Array, best: _Found | None) -> _Found | None:
    """The largest scale that is proved, by halving and refinement; None where the ellipsoid is not above the best."""
    F = arb_mat([[arb(float(v)) for v in row] for row in factor])
    inverse = F.inv()
    size = loop.size_of(factor)
    beyond = 0.0 if best is None else best[0]
    scale = 0.999
    for _ in range(_HALVINGS):
        if scale * _GROWTH * size <= beyond:
            return None
        if _decreases(loop, F, inverse, scale):
            break
        scale /= 2
    else:
        return None
    for step in (1.4, 1.2, 1.1, 1.05):
        if _decreases(loop, F, inverse, scale * step):
            scale *= step
    return (scale * size, factor, scale) if scale * size > beyond else None


def _decreases(loop: SaturatedLoop, F: arb_mat, inverse: arb_mat, scale: float) -> bool:
    """Whether ``|F z|`` falls along the loop wherever ``0 < |F z| <= scale``.

    The condition on Q is convex, so it may be shown part by part for a box around the ellipsoid: parts are halved where
    one does not pass, and left out where they lie outside.
    """
    size = len(loop.names)
    # |z_j| <= scale times the norm of row j of F^-1.
    widths = [
        float((sum((inverse[j, k] ** 2 for k in range(size)), arb(0)).sqrt() * arb(scale)).upper()) * (1 + 1e-9)
        for j in range(size)
    ]
    if any(w > room for w, room in zip(widths, loop.room, strict=True)):
        return False
    arguments = [ball(rational(b)) * arb(widths[row]) for b, row in zip(loop.beta, loop.row, strict=True)]
    limits, sectors = [a.tanh().upper() for a in arguments], [_least_ratio(a) for a in arguments]
    waiting = [[(-w, w) for w in widths]]
    for _ in range(_PARTS):
        if not waiting:
            return True
        part = waiting.pop()
        if _outside(F, part, scale):
            continue
        if _contracts(loop, F, inverse, part, limits, sectors):
            continue
        middle = [((lo + hi) / 2,) * 2 for lo, hi in part]
        if not loop.bending or not _contracts(loop, F, inverse, middle, [arb(0)] * len(limits), sectors):
            return False
        k = max(loop.bending, key=lambda j: (part[j][1] - part[j][0]) / widths[j])
        cut = middle[k][0]
        waiting += [[*part[:k], ends, *part[k + 1 :]] for ends in ((part[k][0], cut), (cut, part[k][1]))]
    return False


def _outside(F: arb_mat, part: Box, scale: float) -> bool:
    """Whether no point of the box has ``|F z| <= scale``."""
    z = arb_mat([[arb(lo).union(arb(hi))] for lo, hi in part])
    image = F * z
    return bool(sum((image[i, 0].abs_lower() ** 2 for i in range(len(part))), arb(0)) > arb(scale) ** 2)


def _contracts(
    loop: SaturatedLoop, F: arb_mat, inverse: arb_mat, part: Box, limits: Sequence[arb], sectors: Sequence[arb]
) -> bool:
    """Whether the condition holds for all slopes on a box, at every vertex of the sectors."""
    size = len(loop.names)
    F_z, F_t = loop.slopes(part, limits)
    if not all(v.is_finite() for matrix in (F_z, F_t) for row in matrix.tolist() for v in row):
        return False
    for vertex in product((False, True), repeat=len(loop.beta)):
        Q = arb_mat(F_z.tolist())
        for i, (full, row) in enumerate(zip(vertex, loop.row, strict=True)):
            k = ball(rational(loop.beta[i])) * (arb(1) if full else sectors[i])
            for j in range(size):
                Q[j, row] = Q[j, row] + F_t[j, i] * k
        B = F * Q * inverse
        if not certainly_positive(-(B + B.transpose())):
            return False
    return True


def _least_ratio(argument: arb) -> arb:
    """A number not above ``tanh(s) / s`` for 0 < s <= argument."""
    s = rational(upper(argument))
    least = (ball(s).tanh() / s).lower() if s else arb(1)
    return arb(least)
