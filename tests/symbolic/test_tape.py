"""The tape means what CasADi means, for every operation of SX."""

import math
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from flint import fmpq
from graphs import BINARY, UNARY, graphs
from hypothesis import given, settings

from pbcgen.errors import ModelError, UnsupportedOperation
from pbcgen.law.numpy_algebra import NumpyAlgebra
from pbcgen.symbolic.real import REAL, ball
from pbcgen.symbolic.tape import OPERATIONS, Constant, Tape, exact_decimal

_ALGEBRA = NumpyAlgebra("double")
#: CasADi's own erfinv has seven digits only.
ACCURATE = {name: function for name, function in UNARY.items() if name != "erfinv"}


def _walk(x, expression, point):
    tape = Tape.of([x], [expression])
    inputs = [np.float64(v) for v in point]
    with np.errstate(all="ignore"):
        return float(tape.walk(_ALGEBRA, [inputs])[0].scalar(np.float64(0)))


def _casadi(x, expression, point):
    return float(ca.Function("f", [x], [expression])(point))


def _same(a, b, digits=1e-13):
    return (math.isnan(a) and math.isnan(b)) or a == b or abs(a - b) <= digits * max(abs(a), abs(b))


@pytest.mark.parametrize("name", UNARY)
@pytest.mark.parametrize("at", [-1.75, -0.3, 0.0, 0.4, 1.0, 2.5])
def test_a_unary_operation_is_that_of_casadi(name, at):
    x = ca.SX.sym("x")
    expression = UNARY[name](x)
    assert _same(_walk(x, expression, [at]), _casadi(x, expression, [at]), 1e-13 if name in ACCURATE else 1e-6)


@pytest.mark.parametrize("name", BINARY)
@pytest.mark.parametrize("at", [(1.5, 0.4), (-1.5, 0.4), (1.5, -0.4), (-2.25, -0.5), (0.0, 1.0), (2.0, 2.0)])
def test_a_binary_operation_is_that_of_casadi(name, at):
    x = ca.SX.sym("x", 2)
    expression = BINARY[name](x[0], x[1])
    assert _same(_walk(x, expression, at), _casadi(x, expression, at))


def test_every_operation_of_sx_is_known():
    """CasADi gives a structural zero for codes that are no scalar operation (matrix operations of MX)."""
    x = ca.SX.sym("x", 2)
    codes = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}
    scalar = {code for code in codes if not ca.SX.binary(code, x[0], x[1]).is_zero()}
    assert len(scalar) > 45
    assert [codes[code] for code in sorted(scalar - set(OPERATIONS))] == []


@settings(max_examples=150, deadline=None)
@given(graphs(ACCURATE, BINARY))
def test_a_graph_walks_to_the_value_of_casadi(case):
    x, expression = case
    for point in [(0.37, 0.71, -0.4), (1.3, -0.77, 0.125), (-0.36, 0.15, 2.25)]:
        walked, expected = _walk(x, expression, point), _casadi(x, expression, point)
        if math.isfinite(expected) and abs(expected) < 1e6:
            assert walked == pytest.approx(expected, rel=1e-9, abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(graphs(UNARY, BINARY))
def test_a_tape_names_earlier_values_only_and_computes_nothing_twice(case):
    x, expression = case
    tape = Tape.of([x], [expression, expression + 1])
    seen = set()
    for position, instruction in enumerate(tape.instructions):
        operands = getattr(instruction, "operands", ())
        assert all(o < position for o in operands)
        key = (getattr(instruction, "name", type(instruction).__name__), operands, str(instruction))
        if operands:
            assert key not in seen
        seen.add(key)


def test_constants_are_the_decimals_that_were_written():
    x = ca.SX.sym("x")
    constants = [i.value for i in Tape.of([x], [x * 0.1 + 2.2e-4]).instructions if isinstance(i, Constant)]
    assert sorted(constants) == [Fraction(11, 50000), Fraction(1, 10)]
    assert exact_decimal(0.1) == Fraction(1, 10)
    assert exact_decimal(1e-320) == Fraction("1e-320")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_constant_that_is_no_number_is_refused(value):
    with pytest.raises(ModelError, match="finite"):
        exact_decimal(value)


def test_a_free_symbol_is_named():
    x, k = ca.SX.sym("x"), ca.SX.sym("stiffness")
    with pytest.raises(ModelError, match="`stiffness`"):
        Tape.of([x], [k * x])


def test_an_mx_function_is_refused():
    x = ca.MX.sym("x", 2)
    with pytest.raises(UnsupportedOperation, match="SX"):
        Tape.of_function(ca.Function("f", [x], [ca.mtimes(x.T, x)]))


def test_an_operation_without_meaning_is_named():
    class Numbers:
        def const(self, value):
            return value

    x = ca.SX.sym("x")
    with pytest.raises(UnsupportedOperation, match="`sin` has no meaning in Numbers"):
        Tape.of([x], [ca.sin(x)]).walk(Numbers(), [[1]])


def test_wrong_input_sizes_are_refused():
    x = ca.SX.sym("x", 2)
    with pytest.raises(ValueError, match="sizes"):
        Tape.of([x], [x[0]]).walk(_ALGEBRA, [[1.0]])


def test_sparse_outputs_keep_their_shape_and_structure():
    x = ca.SX.sym("x", 2)
    tape = Tape.of([x], [ca.diag(x), ca.SX(2, 3), ca.vertcat(x[1], 0, x[0])])
    first, empty, last = tape.walk(_ALGEBRA, [[2.0, 3.0]])
    assert first.dense(0.0) == [[2.0, 0.0], [0.0, 3.0]]
    assert (empty.shape, dict(empty.entries)) == ((2, 3), {})
    assert last.column(0.0) == [3.0, 0.0, 2.0]
    with pytest.raises(ValueError, match="column"):
        first.column(0.0)
    with pytest.raises(ValueError, match="scalar"):
        first.scalar(0.0)


def test_a_deep_graph_stays_linear():
    """A tree with 2^60 leaves is a tape of some hundred instructions."""
    x = ca.SX.sym("x")
    expression = x
    for _ in range(60):
        expression = ca.sin(expression) * expression
    assert len(Tape.of([x], [expression]).instructions) < 200


def test_what_depends_on_known_inputs_alone_is_computed_once():
    x, p, q = ca.SX.sym("x", 2), ca.SX.sym("p", 2), ca.SX.sym("q")
    tape = Tape.of([x, p, q], [ca.vertcat(x[0] * ca.exp(p[0] * p[1]) + q, p[1] + 2), x[1] / q])
    values = [[fmpq(3), fmpq(5)], [fmpq(1, 2), fmpq(4)], [fmpq(7)]]
    left, held = tape.given(REAL, {1: values[1], 2: values[2]})
    assert left.input_sizes[1:3] == (0, 0)
    assert len(left.instructions) < len(tape.instructions)
    both = tape.walk(REAL, values), left.walk(REAL, [values[0], [], [], held])
    for before, after in zip(*both, strict=True):
        assert before.shape == after.shape
        assert all(abs(ball(before.entries[at]) - ball(after.entries[at])) < 1e-12 for at in before.entries)
