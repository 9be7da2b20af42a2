"""Inertia matrices as sums of squares: ``M = sum J_i^T W_i J_i``, which shows that they are positive definite."""

from __future__ import annotations

from typing import Any

import casadi as ca

from pbcgen.models.expressions import expression, shaped, square

#: Pairs (J_i, W_i): J_i has as many columns as there are coordinates, W_i is symmetric.
Factors = tuple[tuple[ca.SX, ca.SX], ...]

#: A kinetic energy of more squares than this is not taken apart.
_MOST_SQUARES = 200


def given_factors(M: Any, n: int) -> Factors:
    """The pairs (J_i, W_i) of an n x n inertia that is given by them, checked; none if it is given in another way.

    Raises ModelError for pairs of wrong shapes.
    """
    if not isinstance(M, list | tuple) or not M:
        return ()
    if not all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in M):
        return ()
    if n == 2 and not any(isinstance(entry, list | tuple) or ca.SX(entry).numel() > 1 for pair in M for entry in pair):
        return ()  # the two rows of a matrix
    factors = []
    for k, (J, W) in enumerate(M, start=1):
        jacobian = expression(J, f"the factor J_{k} of M")
        jacobian = shaped(jacobian, (jacobian.shape[0], n), f"the factor J_{k} of M")
        weight = expression(W, f"the weight W_{k} of M")
        size = jacobian.shape[0]
        weight = weight * ca.SX.eye(size) if weight.is_scalar() else weight
        factors.append((ca.sparsify(jacobian), ca.sparsify(square(weight, size, f"the weight W_{k} of M"))))
    return tuple(factors)


def sum_of_factors(factors: Factors) -> ca.SX:
    """``sum J_i^T W_i J_i`` for pairs (J_i, W_i), symmetric as written."""
    size = factors[0][0].shape[1]
    total = sum((ca.mtimes(J.T, ca.mtimes(W, J)) for J, W in factors), ca.SX(size, size))
    return ca.sparsify(ca.tril2symm(ca.tril(total)))


def squares(T: ca.SX, qdot: ca.SX) -> Factors | None:
    """Pairs (J_k, W_k) of rows and numbers with ``T = sum W_k (J_k q')^2 / 2``, if T is written as such a sum.

    Args:
        T: kinetic energy, a sum of products of a coefficient and a square.
        qdot: velocities; the coefficients and J_k do not depend on them.
    """
    found: list[tuple[ca.SX, ca.SX]] = []
    waiting = [(T, ca.SX(2))]
    while waiting:
        term, weight = waiting.pop()
        if term.is_zero():
            continue
        if not ca.depends_on(term, qdot) or len(found) >= _MOST_SQUARES:
            return None
        parts = [term.dep(k) for k in range(term.n_dep())]
        moving = [ca.depends_on(part, qdot) for part in parts]
        root = None
        match term.op():
            case ca.OP_ADD:
                waiting += [(part, weight) for part in parts]
                continue
            case ca.OP_TWICE:
                waiting.append((parts[0], 2 * weight))
                continue
            case ca.OP_MUL if moving == [True, False]:
                waiting.append((parts[0], weight * parts[1]))
                continue
            case ca.OP_MUL if moving == [False, True]:
                waiting.append((parts[1], weight * parts[0]))
                continue
            case ca.OP_DIV if moving == [True, False]:
                waiting.append((parts[0], weight / parts[1]))
                continue
            case ca.OP_SQ:
                root = parts[0]
            case ca.OP_MUL if ca.is_equal(parts[0], parts[1], 1):
                root = parts[0]
        row = None if root is None else _linear(root, qdot)
        if row is None:
            return None
        found.append((row, weight))
    return tuple(reversed(found))


def _linear(form: ca.SX, qdot: ca.SX) -> ca.SX | None:
    """The row J with ``form = J q'``, or None."""
    row = ca.jacobian(form, qdot)
    at_rest = ca.substitute(form, qdot, ca.SX.zeros(qdot.numel()))
    return None if ca.depends_on(row, qdot) or not at_rest.is_zero() else row
