"""Global stability without a passive output: a quadratic form and integrals over sectors as Lyapunov function.

The loop is ``zeta' = F(zeta, phi, theta)`` of :mod:`pbcgen.control.sectors`: phi_i is a function of ``z_i``, linear in
zeta, with ``a_i <= phi_i / z_i <= b_i``. For

    V = zeta^T P zeta / 2 + sum lambda_i int_0^{z_i} phi_i dz,   P > 0,   lambda_i >= 0, and 0 unless a_i >= 0,

V' is a polynomial in (zeta, phi) where F is one. Because ``(phi_i - a_i z_i) (z_i - phi_i / b_i) >= 0`` (without the
quotient where b_i is infinite),

    -V' - sum tau_i (phi_i - a_i z_i) (z_i - phi_i / b_i) = positive definite form of (zeta, phi),   tau_i >= 0,

makes V' < 0 but at x*: x* attracts from everywhere (Lur'e, Popov, the S-procedure). Terms that are not quadratic must
vanish, which is a linear condition on P: gyroscopic forces and what motors exchange between their coils vanish so. P,
lambda and tau are proposed in doubles and rounded; the definite forms are decided exactly.

States that no rate depends on, such as x_l and where a device stands, enter by the phi_i only. Terms with them must
vanish too, the form being one of the others and phi. Where it is zero, so are the z_i with ``a_i = 0``, as phi_i is
strictly increasing, and these states with them if the z_i are one-to-one in them. Where P has no entries for some
states, integrals with lambda_i > 0 make V grow with them, at least in proportion, if their z_i are one-to-one there.

The law `integral` adds ``theta = alpha tanh(beta psi)``, ``psi' = -r psi + alpha beta sech(beta psi) gamma~``.
``W = (cosh(beta psi) - 1) / beta^2`` then has ``W' = gamma~ theta - r psi sinh(beta psi) / beta``, which is at most
``gamma~ theta - r theta^2 / (alpha beta)^2``. V is given ``mu W``, mu >= 0, and the form is one of (zeta, phi, theta).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations_with_replacement
from typing import Any, TypeAlias

import numpy as np
from flint import fmpq
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

from pbcgen.control.sectors import Polynomial, Sector, SectorLoop, plus
from pbcgen.control.situation import Situation
from pbcgen.errors import UnsupportedOperation
from pbcgen.proof.claim import Status
from pbcgen.proof.cutting_planes import interior
from pbcgen.proof.definite import positive_definite
from pbcgen.symbolic.linear import Row, kernel, reduce_rows
from pbcgen.symbolic.real import approximate, rational
from pbcgen.symbolic.real_matrices import as_floats, congruence, transpose, weighted_sum

#: The method of the claim that this proves.
METHOD = "absolute stability: sectors of the saturations and the S-procedure, definite forms over the rationals"
#: Loops of more states, and of more states and functions, are not tried.
_MOST, _LARGEST = 9, 16
_ROUNDS = 200
#: Shares of their slopes at zero that saturations may act like.
_SHARES = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
_DENOMINATORS = (10**3, 10**5, 10**8)

_Matrix: TypeAlias = list[list[fmpq]]
_Array: TypeAlias = NDArray[np.float64]


def sectors(situation: Situation) -> SectorLoop | None:
    """The loop as polynomials, or None where it is none, or too large."""
    if situation.compensation is not None or situation.plant.system.n + situation.plant.system.m > _MOST:
        return None
    try:
        loop = SectorLoop.of(situation)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    return None if loop is None or loop.order > _MOST or loop.size > _LARGEST else loop


def absolutely_stable(situation: Situation, loop: SectorLoop) -> str | None:
    """Why x* attracts from everywhere, in words; or None."""
    found = None if situation.plant.system.domain else storage_of(loop)
    if found is None:
        return None
    terms = ["a positive definite quadratic form of x - x* and the filters' states"]
    terms += ["integrals of what is in the sectors"] if any(found.popov) else []
    terms += ["cosh(beta_psi psi)"] if found.integral else []
    return f"V = {' and '.join(terms)}: V' < 0 but at x*, whatever is in the sectors a_i <= phi_i / z_i <= b_i"


def far_oscillation(loop: SectorLoop) -> str:
    """Numeric evidence that large motions may not decay, in words; empty where there is none.

    In a large motion a saturation acts like a share of its slope at zero (a describing function). A linear loop with
    such slopes that grows and turns suggests a limit cycle around x*.
    """
    for share in _SHARES:
        A = _linear(loop, share)
        values = np.linalg.eigvals(A)
        worst = values[np.argmax(values.real)]
        if worst.real > 1e-10 * np.linalg.norm(A) and abs(worst.imag) > worst.real:
            return (
                f"where saturations act like {share:g} of their slope, as in large motions, the linear loop grows at "
                f"{worst.real:.3g} 1/s and turns at {abs(worst.imag):.3g} rad/s: a limit cycle is likely"
            )
    return ""


@dataclass(frozen=True, eq=False)
class Storage:
    """P, for the states as they are, and the weights lambda, tau of each sector, and mu of each integral term."""

    P: _Matrix
    popov: list[fmpq]
    sectors: list[fmpq]
    integral: list[fmpq]

    def written(self) -> dict[str, Any]:
        """P by its lower triangle, and the weights."""
        parts = {"popov": self.popov, "sectors": self.sectors, "integral": self.integral}
        P = [[str(v) for v in row[: i + 1]] for i, row in enumerate(self.P)]
        return {"P": P} | {name: [str(v) for v in part] for name, part in parts.items()}


def storage_of(loop: SectorLoop) -> Storage | None:
    """P, lambda, tau and mu that are certainly good, or None."""
    unseen = _unseen(loop)
    if _hopeless(loop, unseen) or not _one_to_one(loop, unseen, [sector.least == 0 for sector in loop.sectors]):
        return None
    pairs, parts = _parts(loop)
    basis = _without_other_terms(loop, parts, unseen)
    if not basis:
        return None
    count, order = len(loop.sectors), loop.order
    P = [_symmetric({pair: v for pair, v in zip(pairs, vector, strict=False) if v}, order) for vector in basis]
    held = [k for k in range(order) if any(v != 0 for M in P for v in M[k])]
    seen = [k for k in range(loop.size) if k not in unseen]
    forms = [_symmetric(_combined(parts, vector), loop.size, halved=True) for vector in basis]
    forms = [[[row[k] for k in seen] for row in (M[k] for k in seen)] for M in forms]
    weights = [vector[len(pairs) :] for vector in basis]
    for t in _proposals(_scales(loop), (held, seen), P, forms, weights):
        size = len(weights[0])
        signs = [sum((c * w[i] for c, w in zip(t, weights, strict=True)), fmpq(0)) for i in range(size)]
        others = [k for k in range(order) if k not in held]
        if any(v < 0 for v in signs) or not _one_to_one(loop, others, [v > 0 for v in signs[:count]]):
            continue
        chosen = weighted_sum(t, P)
        kept = [[chosen[i][j] for j in held] for i in held]
        if all(positive_definite(matrix).status is Status.PROVED for matrix in (kept, weighted_sum(t, forms))):
            P_zeta = chosen if loop.turn is None else congruence(transpose(loop.turn), chosen)
            return Storage(P_zeta, signs[:count], signs[count : 2 * count], signs[2 * count :])
    return None


def _unseen(loop: SectorLoop) -> list[int]:
    """The states that no rate depends on."""
    return [k for k in range(loop.order) if not any(k in key for rate in loop.rates for key in rate)]


def _one_to_one(loop: SectorLoop, states: Sequence[int], usable: Sequence[bool]) -> bool:
    """Whether the arguments of the usable sectors with an end at zero fix these states where the others are known."""
    rows: list[Row] = [
        {k: sector.argument[(k,)] for k in states if (k,) in sector.argument}
        for sector, use in zip(loop.sectors, usable, strict=True)
        if use and sector.least == 0
    ]
    return len(reduce_rows(rows)) == len(states)


def _without_other_terms(loop: SectorLoop, parts: Sequence[Polynomial], unseen: Sequence[int]) -> list[list[fmpq]]:
    """A basis of the weights of the parts with which only terms of the form are left, and no integral that falls."""
    rows: dict[object, Row] = {}
    for k, part in enumerate(parts):
        for key, c in part.items():
            if c != 0 and (len(key) != 2 or any(state in key for state in unseen)):
                rows.setdefault(key, {})[k] = c
    first = len(parts) - 2 * len(loop.sectors) - len(loop.leaks)
    for i, sector in enumerate(loop.sectors):
        if sector.least < 0:
            rows[f"no integral {i}"] = {first + i: fmpq(1)}
    return kernel(rows.values(), len(parts), fmpq(0), fmpq(1))


def _parts(loop: SectorLoop) -> tuple[list[tuple[int, int]], list[Polynomial]]:
    """What each unknown adds to the form: entries of P, lambda, tau, mu."""
    order = loop.order
    pairs = list(combinations_with_replacement(range(order), 2))
    parts: list[Polynomial] = []
    for a, b in pairs:
        total = _times(a, loop.rates[b])
        parts.append(_negative(total if a == b else plus(total, _times(b, loop.rates[a]))))
    for i, sector in enumerate(loop.sectors):
        rate: Polynomial = {}
        for (k,), c in sector.argument.items():
            rate = plus(rate, {key: c * v for key, v in loop.rates[k].items()})
        parts.append(_negative(_times(order + i, rate)))
    parts += [_negative(_room_in(sector, order + i)) for i, sector in enumerate(loop.sectors)]
    for i, (output, leak) in enumerate(zip(loop.outputs, loop.leaks, strict=False)):
        theta = order + len(loop.sectors) + i
        parts.append(plus(_negative(_times(theta, output)), {(theta, theta): leak}))
    return pairs, parts


def _room_in(sector: Sector, phi: int) -> Polynomial:
    """``(phi - a z) (z - phi / b)``, or ``(phi - a z) z`` for b infinite."""
    z = sector.argument
    above: Polynomial = {(phi,): fmpq(1)} | {key: -sector.least * c for key, c in z.items() if sector.least}
    below = z | ({} if sector.most is None else {(phi,): -1 / sector.most})
    total: Polynomial = {}
    for key, c in above.items():
        total = plus(total, {tuple(sorted((*key, *other))): c * v for other, v in below.items()})
    return total


def _proposals(
    scale: _Array,
    places: tuple[Sequence[int], Sequence[int]],
    P: Sequence[_Matrix],
    forms: Sequence[_Matrix],
    weights: Sequence[Sequence[fmpq]],
) -> Iterator[list[fmpq]]:
    """Weights of the basis, from cutting planes in balanced coordinates.

    Args:
        scale: sizes of (zeta, phi, theta).
        places: which of them P has entries for, and which the forms are forms of.
        P: of each vector of the basis, for all states.
        forms: likewise, of what is seen.
        weights: likewise, lambda, tau and mu.
    """
    held, seen = (list(part) for part in places)
    families = [np.array([as_floats(M) for M in part]) for part in (P, forms)]
    families = [families[0][:, held][:, :, held] * np.outer(scale[held], scale[held]), families[1]]
    families[1] = families[1] * np.outer(scale[seen], scale[seen])
    signs = np.array([[float(v.p) / float(v.q) for v in row] for row in weights])
    sizes = np.max(np.abs(families[1]), axis=(1, 2))
    if not np.all(np.isfinite(sizes)) or not np.all(sizes > 0):
        return
    families = [f / sizes[:, None, None] for f in families]
    families[0] /= np.max(np.abs(families[0]))
    loose = [(column / sizes)[:, None, None] for column in signs.T if np.any(column)]
    loose = [f / max(float(np.max(np.abs(f))), 1e-300) for f in loose]
    t = interior(families, loose, _ROUNDS)
    if t is None:
        return
    t = t / sizes
    t = t / np.max(np.abs(t))
    for denominator in _DENOMINATORS:
        yield [rational(Fraction(float(v)).limit_denominator(denominator)) for v in t]


def _linear(loop: SectorLoop, share: float) -> _Array:
    """The linear part of the loop with slopes at this share of the way through their sectors."""
    order = loop.order
    A = np.zeros((order, loop.size))
    for i, rate in enumerate(loop.rates):
        for key, c in rate.items():
            if len(key) == 1:
                A[i, key[0]] += approximate(c)
    linear = A[:, :order]
    for j, sector in enumerate(loop.sectors):
        least, most = sector.bounds
        for (k,), c in sector.argument.items():
            linear[:, k] += A[:, order + j] * (least + share * (most - least)) * approximate(c)
    return linear


def _hopeless(loop: SectorLoop, unseen: Sequence[int]) -> bool:
    """Whether a linear loop in the sectors does not decay: then no V exists."""
    loops = [_linear(loop, share) for share in (0.0, 0.5, 1.0)]
    if all(sector.least == 0 for sector in loop.sectors):
        loops[0] = np.delete(np.delete(loops[0], unseen, 0), unseen, 1)
    return any(np.max(np.linalg.eigvals(loop).real) >= -1e-12 * np.linalg.norm(loop) for loop in loops)


def _scales(loop: SectorLoop) -> _Array:
    """Sizes of (zeta, phi, theta) with which the linear part of the loop is balanced."""
    _, (scaling, _) = matrix_balance(_linear(loop, 1.0), permute=False, separate=True)
    drawn = [
        max(abs(approximate(c)) * scaling[k] for (k,), c in sector.argument.items()) * max(map(abs, sector.bounds))
        for sector in loop.sectors
    ]
    held = [
        max(abs(approximate(c)) * scaling[k] for (k,), c in output.items()) / approximate(leak)
        for output, leak in zip(loop.outputs, loop.leaks, strict=False)
    ]
    return np.concatenate([scaling, drawn, held])


def _times(k: int, p: Polynomial) -> Polynomial:
    return {tuple(sorted((k, *key))): c for key, c in p.items()}


def _negative(p: Polynomial) -> Polynomial:
    return {key: -c for key, c in p.items()}


def _combined(parts: Sequence[Polynomial], weights: Sequence[fmpq]) -> Polynomial:
    """The quadratic terms of a combination."""
    total: Polynomial = {}
    for part, weight in zip(parts, weights, strict=True):
        if weight != 0:
            total = plus(total, {key: weight * c for key, c in part.items() if len(key) == 2})
    return total


def _symmetric(entries: dict[tuple[int, ...], fmpq], size: int, halved: bool = False) -> _Matrix:
    """A symmetric matrix; ``halved`` where the entries are the coefficients of a quadratic form."""
    matrix = [[fmpq(0)] * size for _ in range(size)]
    for (i, j), c in entries.items():
        matrix[i][j] = matrix[j][i] = c / 2 if halved and i != j else c
    return matrix
