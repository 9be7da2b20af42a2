"""Stability beside conserved functions, as charges that no input moves: x* need be a minimum on their leaves only.

Let ``C x`` be constant along every trajectory, whatever the input. Then with the Lyapunov function V of the paper, so
does ``V + lambda^T C x + t |C (x - x*)|^2`` not grow. It has a strict minimum at x* if its gradient vanishes there and
its Hessian is positive definite; for some t it is if that of V is on the kernel of C (Finsler).
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import fmpq

from pbcgen.control.situation import Situation
from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.plant import Plant, columns
from pbcgen.passivity.shaping import extended_hessian, shape_at
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import positive_definite
from pbcgen.symbolic.coefficients import cleared
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, kernel, particular_solution, reduce_rows
from pbcgen.symbolic.real import BITS, ZERO, Real, approximate, precision, rational, text
from pbcgen.symbolic.real_matrices import SparseRow, diagonal

#: What t is tried to be, as multiples of the ratio of the largest entries.
_WEIGHTS = tuple(fmpq(1000) ** k for k in range(5))


def conserved(plant: Plant) -> list[list[fmpq]]:
    """A basis of the rows c with ``c f = 0`` and ``c g = 0``, as far as it shows with independent atoms."""
    system = plant.system
    try:
        field, (f, g) = plant.exact(system.f, system.g)
        zero = field.const(0)
        moves = [cleared(field, column) for column in (f.column(zero), *columns(g, zero))]
    except (UnsupportedOperation, ZeroDivisionError):
        return []
    rows: dict[object, Row] = {}
    for j, column in enumerate(moves):
        for i, entry in enumerate(column):
            for exponents, coefficient in entry.to_dict().items():
                rows.setdefault((j, tuple(exponents)), {})[i] = coefficient
    return kernel(rows.values(), system.n, fmpq(0), fmpq(1))


def written(plant: Plant, c: Sequence[fmpq]) -> str:
    """A conserved function in the names of the states."""
    terms = [(v, name) for v, name in zip(c, plant.system.state_names, strict=True) if v != 0]
    shown = " + ".join(name if v == 1 else f"{text(v)}*{name}" for v, name in terms)
    return shown.replace("+ -1*", "- ").replace("+ -", "- ")


def stable_on_leaves(situation: Situation, missing: Sequence[str]) -> Claim | None:
    """`stable`, where V fails to have a minimum at x* only because something is conserved; else None.

    Args:
        situation: the law at its target.
        missing: the premises of the Lyapunov route that are not proved.
    """
    if not missing or not {*missing} <= {"gradient-condition", "hessian-condition", "kc-bound"}:
        return None
    C = conserved(situation.plant)
    if not C:
        return None
    alpha, beta, K_c = situation.gains
    shape = shape_at(situation.plant, situation.point, situation.gamma, situation.law)
    stiffness = diagonal([rational(a * b) for a, b in zip(alpha, beta, strict=True)])
    rows = [[rational(v) for v in row] for row in K_c] if K_c is not None else None
    slope = [fmpq(0)] * len(C) if "gradient-condition" not in missing else _multipliers(C, shape.gradient)
    with precision(BITS):
        H = shape.hessian(stiffness) if rows is None else extended_hessian(shape, stiffness, rows)
        weight = None if slope is None else _weight(H, C)
    if slope is None or weight is None:
        return None
    functions = ", ".join(written(situation.plant, c) for c in C)
    return Claim(
        "stable",
        Status.PROVED,
        "near x*",
        "Lyapunov function on the leaves of what is conserved",
        f"no input moves {functions}; with multiples of that and of its square the Lyapunov function is least at x*",
        certificate={
            "conserved": [[str(v) for v in c] for c in C],
            "slope": [str(v) for v in slope],
            "weight": str(weight),
        },
    )


def _multipliers(C: Sequence[Sequence[fmpq]], gradient: Sequence[Real]) -> list[fmpq] | None:
    """lambda with ``gradient + C^T lambda = 0``, for an exact gradient."""
    if not all(isinstance(v, fmpq) for v in gradient):
        return None
    rows: list[Row] = [
        {**{j: c[k] for j, c in enumerate(C) if c[k] != 0}, CONSTANT: gradient[k]} for k in range(len(C[0]))
    ]
    try:
        solution = particular_solution(reduce_rows(rows), ZERO)
    except Inconsistent:
        return None
    return [solution.get(j, fmpq(0)) for j in range(len(C))]


def _weight(H: Sequence[SparseRow], C: Sequence[Sequence[fmpq]]) -> fmpq | None:
    """t with ``H + t C^T C > 0``, where C stands beside zeros for the filter."""
    largest = max((abs(approximate(v)) for row in H for v in row.values()), default=0.0)
    unit = rational(max(int(largest / max(float(abs(v)) for c in C for v in c) ** 2), 1))
    for factor in _WEIGHTS:
        t = unit * factor
        held = [dict(row) for row in H]
        for c in C:
            used = [k for k, v in enumerate(c) if v != 0]
            for i in used:
                for j in used:
                    held[i][j] = held[i].get(j, ZERO) + t * c[i] * c[j]
        if positive_definite(held).status is Status.PROVED:
            return t
    return None
