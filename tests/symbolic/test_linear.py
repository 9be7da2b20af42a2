"""Linear equations over exact fields: solved, contradictory, or left with free unknowns."""

from fractions import Fraction

import pytest
from flint import fmpq, fmpq_mat
from hypothesis import given, settings
from hypothesis import strategies as st

from pbcgen.symbolic.linear import (
    CONSTANT,
    Inconsistent,
    determined,
    kernel,
    particular_solution,
    reduce_rows,
    solve,
    sparse_kernel,
)

_numbers = st.integers(-4, 4).map(fmpq)


def test_a_contradiction_is_raised_with_its_residual():
    with pytest.raises(Inconsistent) as caught:
        reduce_rows([{"a": fmpq(1), CONSTANT: fmpq(-1)}, {"a": fmpq(2), CONSTANT: fmpq(-3)}])
    assert caught.value.residual != 0


def test_what_all_solutions_share_is_determined():
    solved = reduce_rows([{"a": fmpq(1), "b": fmpq(1)}, {"c": fmpq(2), CONSTANT: fmpq(-3)}])
    assert determined(solved, fmpq(0)) == {"c": fmpq(3, 2)}


@settings(max_examples=80, deadline=None)
@given(st.integers(1, 4).flatmap(lambda n: st.tuples(*[st.lists(_numbers, min_size=n + 1, max_size=n + 1)] * n)))
def test_a_solution_solves_and_no_solution_means_singular(rows):
    matrix, right = [list(r[:-1]) for r in rows], [r[-1] for r in rows]
    solution = solve([dict(enumerate(row)) for row in matrix], right, len(matrix[0]), fmpq(0))
    if solution is None:
        from flint import fmpq_mat

        assert fmpq_mat(matrix).det() == 0
        return
    assert [sum((a * x for a, x in zip(row, solution, strict=True)), fmpq(0)) for row in matrix] == right


@settings(max_examples=80, deadline=None)
@given(st.lists(st.lists(_numbers, min_size=4, max_size=4), min_size=1, max_size=4))
def test_a_particular_solution_solves(rows):
    equations = [{"x": r[0], "y": r[1], "z": r[2], CONSTANT: r[3]} for r in rows]
    try:
        values = particular_solution(reduce_rows(equations), fmpq(0))
    except Inconsistent:
        return
    for row in equations:
        total = row[CONSTANT] + sum((row[k] * values.get(k, fmpq(0)) for k in "xyz"), fmpq(0))
        assert total == fmpq(0)
    assert all(isinstance(Fraction(int(v.p), int(v.q)), Fraction) for v in values.values())


@settings(deadline=None)
@given(st.lists(st.lists(_numbers, min_size=4, max_size=4), max_size=5))
def test_a_kernel_is_all_that_the_rows_annihilate(rows):
    basis = kernel([dict(enumerate(row)) for row in rows], 4, fmpq(0), fmpq(1))
    assert all(sum(a * b for a, b in zip(row, vector, strict=True)) == 0 for row in rows for vector in basis)
    assert len(basis) == 4 - (fmpq_mat(rows).rank() if rows else 0)
    assert not basis or fmpq_mat(basis).rank() == len(basis)


def test_a_sparse_kernel_holds_the_nonzero_entries_of_a_kernel():
    rows = [{0: fmpq(1), 2: fmpq(-2)}, {1: fmpq(3), 2: fmpq(1), 3: fmpq(0)}]
    found = sparse_kernel(rows, 5, fmpq(1))
    assert [sorted(vector) for vector in found] == [[0, 1, 2], [3], [4]]
    assert all(sum(c * vector.get(k, 0) for k, c in row.items()) == 0 for vector in found for row in rows)
    assert kernel(rows, 5, fmpq(0), fmpq(1)) == [[vector.get(k, 0) for k in range(5)] for vector in found]
