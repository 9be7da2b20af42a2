"""Inverses of symmetric positive definite matrices, as small expression graphs."""

from __future__ import annotations

import math

import casadi as ca

from pbcgen.models.numbers import as_written, is_short
from pbcgen.models.parameters import Parameters

_LARGEST_COFACTOR = 3


def solve(M: ca.SX, right: ca.SX) -> ca.SX:
    """``M^-1 right`` for a symmetric positive definite M, without pivoting.

    M is split into the blocks that its zeros leave independent. A block of up to three rows is solved by cofactors
    (a division by its determinant only), a larger one by an L D L^T factorisation.

    Args:
        M: n x n, symmetric positive definite; only then are the divisions defined.
        right: n x k.
    """
    result = ca.SX(M.shape[0], right.shape[1])
    for block in independent_blocks(M):
        part, rows = M[block, block], right[block, :]
        result[block, :] = _cofactor_solve(part, rows) if len(block) <= _LARGEST_COFACTOR else _ldl_solve(part, rows)
    return result


def inverse(M: ca.SX) -> ca.SX:
    """``M^-1`` for a symmetric positive definite M; see :func:`solve`."""
    return ca.sparsify(solve(M, ca.SX.eye(M.shape[0])))


def named_constants(M: ca.SX, label: str, parameters: Parameters) -> tuple[ca.SX, Parameters]:
    """M with its numbers as parameters, where its inverse would not be exact otherwise.

    CasADi computes with the doubles that it is given: the inverse of 3 becomes a rounded number, and identities such
    as ``M M^-1 = I`` fail by it. A power of two stays in a block of its own.

    Args:
        M: n x n, symmetric.
        label: how the parameters are called, followed by row and column.
        parameters: the model's own.

    Returns:
        The matrix, and the parameters with those that were added.
    """
    if not _has_matching_numbers(M):
        return M, parameters
    result = ca.SX(M)
    for block in independent_blocks(M):
        if len(block) == 1 and _has_exact_inverse(M[block[0], block[0]]):
            continue
        for i in block:
            for j in block:
                if i > j or not M[i, j].is_constant() or M[i, j].is_zero():
                    continue
                name = f"{label}_{i + 1}_{j + 1}"
                while name in parameters:
                    name += "_"
                parameters = parameters.joined(**{name: as_written(float(M[i, j]))})
                result[i, j] = parameters[name]
                result[j, i] = parameters[name]
    return ca.sparsify(result), parameters


def _has_matching_numbers(M: ca.SX) -> bool:
    """Whether the numbers in M are finite and symmetric; other matrices are for the checks that follow."""
    numbers = {(i, j): float(M[i, j]) for i in range(M.shape[0]) for j in range(M.shape[1]) if M[i, j].is_constant()}
    return all(math.isfinite(v) and numbers.get((j, i)) == v for (i, j), v in numbers.items())


def _has_exact_inverse(entry: ca.SX) -> bool:
    if not entry.is_constant():
        return True
    value = as_written(float(entry))
    return value != 0 and is_short(value) and is_short(1 / value)


def independent_blocks(M: ca.SX) -> list[list[int]]:
    """The index sets between which M has only structural zeros, each sorted."""
    count, order, ends = ca.sparsify(M).sparsity().unite(ca.Sparsity.diag(M.shape[0])).scc()
    return sorted(sorted(order[ends[k] : ends[k + 1]]) for k in range(count))


def _cofactor_solve(M: ca.SX, right: ca.SX) -> ca.SX:
    adjugate = _adjugate(M)
    determinant = sum((M[0, j] * adjugate[j, 0] for j in range(M.shape[0])), ca.SX(0))
    return ca.mtimes(adjugate, right) / determinant


def _adjugate(M: ca.SX) -> ca.SX:
    """The transposed cofactors of a symmetric matrix with up to three rows."""
    n = M.shape[0]
    adjugate = ca.SX(n, n)
    for i in range(n):
        for j in range(i + 1):
            rows = [k for k in range(n) if k != i]
            cols = [k for k in range(n) if k != j]
            adjugate[i, j] = adjugate[j, i] = (-1) ** (i + j) * _small_determinant(M[rows, cols])
    return adjugate


def _small_determinant(M: ca.SX) -> ca.SX:
    match M.shape[0]:
        case 0:
            return ca.SX(1)
        case 1:
            return M[0, 0]
        case _:
            return M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]


def _ldl_solve(M: ca.SX, right: ca.SX) -> ca.SX:
    """Forward, diagonal and backward substitution with ``M = L diag(d) L^T``, L of unit diagonal."""
    n = M.shape[0]
    L, d = ca.SX.eye(n), ca.SX(n, 1)
    for j in range(n):
        d[j] = M[j, j] - sum((L[j, k] ** 2 * d[k] for k in range(j)), ca.SX(0))
        for i in range(j + 1, n):
            L[i, j] = (M[i, j] - sum((L[i, k] * L[j, k] * d[k] for k in range(j)), ca.SX(0))) / d[j]
    y = ca.SX(right)
    for i in range(n):
        for k in range(i):
            y[i, :] = y[i, :] - L[i, k] * y[k, :]
    for i in reversed(range(n)):
        y[i, :] = y[i, :] / d[i]
        for k in range(i + 1, n):
            y[i, :] = y[i, :] - L[k, i] * y[k, :]
    return y
