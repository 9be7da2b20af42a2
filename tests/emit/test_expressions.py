"""Expressions printed in C against the values that CasADi computes for the same graph."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import casadi as ca
import cffi
import numpy as np
import pytest
from compiled import WARNINGS, compiler, run
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from pbcgen.emit.expressions import FORMS, Graph, Printer
from pbcgen.emit.lowering import constants_of
from pbcgen.emit.templating import fill
from pbcgen.errors import EmitError, UnsupportedOperation
from pbcgen.law.numpy_algebra import NumpyAlgebra
from pbcgen.symbolic.tape import OPERATIONS, Operation, Tape


def function_text(tape: Tape, name: str, precision: str) -> str:
    """A C function ``void name(const real *x, real *y)`` that computes the scalar outputs of a tape of one input."""
    graph = Graph()
    roots = [
        m.scalar(graph.const(Fraction(0))) for m in tape.walk(graph, [[graph.name(f"x[{i}]") for i in range(SIZE)]])
    ]
    statements, texts = Printer(graph, precision, "p", roots).stage(roots)
    lines = [f"    const {precision} {s.name} = {s.expression};" for s in statements]
    lines += [f"    y[{k}] = {text};" for k, text in enumerate(texts)]
    body = "\n".join(lines)
    return (
        f"void {name}(const {precision} *x, {precision} *y);\n"
        f"void {name}(const {precision} *x, {precision} *y)\n{{\n    (void)x;\n{body}\n}}\n"
    )


SIZE = 3


def compile_functions(tapes: list[Tape], precision: str, directory) -> list:
    """The tapes as C functions that take and give NumPy arrays."""
    directory.mkdir(exist_ok=True)
    source, library = directory / "f.c", directory / "f.so"
    context = {"prefix": "p", **vars(constants_of(precision))}
    f = context["f"]
    helpers = [
        f"static {precision} p_tanh({precision} x);",
        f"static {precision} p_tanh({precision} x) {{ return tanh{f}(x); }}",
        fill("erfinv.c.j2", context),
        fill("cosh.c.j2", context | {"fast_tanh": None}),
        function_text(Tape.of([ca.SX.sym("x", SIZE)], [ca.SX(0)]), "unused", precision),
        f"{precision} use({precision} x);\n{precision} use({precision} x) {{ return p_tanh(p_erfinv(p_cosh(x))); }}",
    ]
    functions = [function_text(tape, f"f{k}", precision) for k, tape in enumerate(tapes)]
    source.write_text("#include <math.h>\n" + "\n".join(helpers + functions))
    # without builtins: a compiler that knows an argument computes the function itself, to another last bit
    flags = ["-std=c99", "-O1", "-ffp-contract=off", "-fno-builtin", "-shared", "-fPIC"]
    run([*compiler(), *flags, *WARNINGS, str(source), "-o", str(library), "-lm"])
    ffi = cffi.FFI()
    ffi.cdef("".join(f"void f{k}(const {precision} *, {precision} *);" for k in range(len(tapes))))
    lib = ffi.dlopen(str(library))
    dtype = np.float32 if precision == "float" else np.float64

    def caller(k: int, count: int):
        def call(x: np.ndarray) -> np.ndarray:
            x = np.ascontiguousarray(x, dtype)
            y = np.empty((len(x), count), dtype)
            for row, result in zip(x, y, strict=True):
                getattr(lib, f"f{k}")(
                    ffi.cast(f"{precision} *", row.ctypes.data), ffi.cast(f"{precision} *", result.ctypes.data)
                )
            return y

        return call

    return [caller(k, len(tape.outputs)) for k, tape in enumerate(tapes)]


OPERATION_CODES = {
    name: (code, arity) for code, (name, arity) in OPERATIONS.items() if name not in ("assign", "assign_first")
}
#: Operations that CasADi computes with the functions of the same math library.
ARITHMETIC = [name for name in OPERATION_CODES if name != "erfinv"]
#: copysign(x, NaN) has the sign of a NaN, which nobody defines.
DEFINED = [name for name in ARITHMETIC if name != "copysign"]


def apply(name: str, *operands: ca.SX) -> ca.SX:
    code, arity = OPERATION_CODES[name]
    return ca.SX.unary(code, operands[0]) if arity == 1 else ca.SX.binary(code, operands[0], operands[1])


def values(dtype=np.float64) -> np.ndarray:
    limits = np.finfo(dtype)
    some = [
        0.0,
        limits.smallest_subnormal,
        limits.tiny,
        0.3,
        0.5,
        0.99,
        1.0,
        1.5,
        2.0,
        2.5,
        3.0,
        27.25,
        1e9,
        limits.max,
    ]
    line = np.array([np.nan, np.inf, *some, -np.inf, *(-v for v in some)], dtype)
    grid = np.array(np.meshgrid(line, line)).reshape(2, -1).T
    return np.hstack([grid, np.ones((len(grid), SIZE - 2), dtype)])


def same(a: np.ndarray, b: np.ndarray, ulps: float) -> np.ndarray:
    """Where two arrays agree: both NaN, equal, or a few units of the last place of b apart."""
    eps, tiny = np.finfo(b.dtype).eps, np.finfo(b.dtype).tiny
    with np.errstate(all="ignore"):
        near = np.abs(a - b) <= ulps * np.maximum(eps * np.abs(b), eps * tiny)
    return (a == b) | (np.isnan(a) & np.isnan(b)) | near


def test_every_operation_of_the_tape_has_a_form():
    assert set(FORMS) == set(OPERATION_CODES)
    assert all(callable(getattr(NumpyAlgebra("double"), name)) for name in OPERATION_CODES)


def test_each_operation_computes_what_casadi_computes_on_all_special_values(tmp_path):
    x = ca.SX.sym("x", SIZE)
    expressions = [apply(name, x[0], x[1]) for name in ARITHMETIC]
    tape = Tape.of([x], expressions)
    call = compile_functions([tape], "double", tmp_path)[0]
    points = values()
    expected = np.array(ca.Function("f", [x], [ca.vertcat(*expressions)])(points.T)).T
    agree = same(call(points), expected, 4)
    assert agree.all(), [(ARITHMETIC[k], points[i]) for i, k in np.argwhere(~agree)[:5]]


@pytest.mark.parametrize("precision", ["float", "double"])
def test_each_operation_computes_what_the_reference_step_computes(precision, tmp_path):
    x = ca.SX.sym("x", SIZE)
    tape = Tape.of([x], [apply(name, x[0], x[1]) for name in OPERATION_CODES])
    call = compile_functions([tape], precision, tmp_path)[0]
    dtype = np.float32 if precision == "float" else np.float64
    points = values(dtype)
    with np.errstate(all="ignore"):
        columns = tape.walk(NumpyAlgebra(precision), [list(points.T)])
    expected = np.array([c.scalar(0.0) for c in columns]).T
    assert expected.dtype == dtype
    agree = same(call(points), expected, 64)
    names = list(OPERATION_CODES)
    assert agree.all(), [
        (names[k], points[i], call(points[i : i + 1])[0, k], expected[i, k]) for i, k in np.argwhere(~agree)[:5]
    ]


def test_erfinv_inverts_erf(tmp_path):
    from scipy import special

    for precision, dtype in (("float", np.float32), ("double", np.float64)):
        x = ca.SX.sym("x", SIZE)
        call = compile_functions([Tape.of([x], [ca.erfinv(x[0])])], precision, tmp_path / precision)[0]
        eps = np.finfo(dtype).eps
        y = np.concatenate([np.linspace(-1, 1, 2001), 1 - np.geomspace(eps, 0.5, 200), np.geomspace(1e-30, 0.5, 200)])
        y = y.astype(dtype)
        result = call(np.tile(y[:, None], (1, SIZE)))[:, 0]
        exact = special.erfinv(y.astype(np.float64))
        assert same(result, exact.astype(dtype), 8).all()


@st.composite
def graphs(draw) -> tuple[ca.SX, list[ca.SX]]:
    """A random graph with shared subexpressions: its input and three outputs."""
    x = ca.SX.sym("x", SIZE)
    pool = [x[i] for i in range(SIZE)]
    pool += [ca.SX(draw(st.sampled_from([-2.5, -1.0, 0.5, 1.0, 3.0, 1e-7, 0.1]))) for _ in range(2)]
    for _ in range(draw(st.integers(1, 25))):
        name = draw(st.sampled_from(DEFINED))
        recent = st.integers(max(0, len(pool) - 6), len(pool) - 1) | st.integers(0, len(pool) - 1)
        result = apply(name, pool[draw(recent)], pool[draw(recent)])
        if result.is_constant() and not math.isfinite(float(result)):
            continue
        pool.append(result)
    return x, pool[-3:]


@settings(
    max_examples=12, deadline=None, derandomize=True, phases=[Phase.generate]
)  # shrinking would compile for minutes
@given(st.lists(graphs(), min_size=30, max_size=30), st.integers(0, 2**32 - 1))
def test_random_graphs_compute_what_casadi_computes(tmp_path_factory, samples, seed):
    tapes = [Tape.of([x], outputs) for x, outputs in samples]
    calls = compile_functions(tapes, "double", tmp_path_factory.mktemp("graphs"))
    points = np.random.default_rng(seed).normal(size=(40, SIZE)) * 2
    for (x, outputs), call in zip(samples, calls, strict=True):
        expected = np.array(ca.Function("f", [x], [ca.densify(ca.vertcat(*outputs))])(points.T)).T
        agree = same(call(points), expected, 0)
        assert agree.all(), (outputs, points[np.argwhere(~agree)[0][0]])


def printed(expression: ca.SX, x: ca.SX, precision: str = "double") -> list[str]:
    text = function_text(Tape.of([x], [expression]), "f", precision)
    return [line.strip() for line in text.splitlines() if " = " in line]


X = ca.SX.sym("x", SIZE)


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (X[0] - (X[1] + X[2]), "x[0] - (x[1] + x[2])"),
        (X[0] - X[1] + X[2], "x[0] - x[1] + x[2]"),
        (X[0] / (X[1] * X[2]), "x[0] / (x[1] * x[2])"),
        (-(X[0] + X[1]), "-(x[0] + x[1])"),
        ((X[0] + X[1]) * X[2], "(x[0] + x[1]) * x[2]"),
        (X[0] ** 2, "x[0] * x[0]"),
        (ca.if_else(ca.logic_and(X[0] < X[1], X[2] >= 0), X[0], 0), "((x[0] < x[1]) && (0.0 <= x[2])) ? x[0] : 0.0"),
        (ca.if_else(ca.logic_not(X[0]), X[1], 0), "(!(x[0] != 0.0)) ? x[1] : 0.0"),
        (X[0] < X[1], "(x[0] < x[1]) ? 1.0 : 0.0"),
        (ca.sin(X[0] * 0.1), "sin(0.1 * x[0])"),
        (X[0] + (-0.5), "x[0] - 0.5"),
    ],
)
def test_expressions_read_like_written_by_hand(expression, text):
    assert printed(expression, X) == [f"y[0] = {text};"]


def test_a_value_used_twice_gets_a_name():
    assert printed(ca.sin(X[0]) * ca.sqrt(1 + ca.sin(X[0])), X) == [
        "const double v0 = sin(x[0]);",
        "y[0] = v0 * sqrt(1.0 + v0);",
    ]


def test_float_code_has_float_literals_and_float_functions():
    assert printed(ca.atan2(X[0], 0.1) + ca.fmin(X[1], 3), X, "float") == [
        "y[0] = atan2f(x[0], 0.1f) + ((x[1] < 3.0f) ? x[1] : 3.0f);"
    ]


@pytest.mark.parametrize("value", [1e39, 1e-39, -1e-46])
def test_a_constant_that_a_float_cannot_hold_is_named(value):
    with pytest.raises(EmitError, match=re.escape(f"constant {value} ") + ".*choose double precision"):
        printed(X[0] * value, X, "float")


def test_an_operation_without_a_c_form_is_refused():
    tape = Tape((*Tape.of([X], [X[0]]).instructions, Operation("gamma", (0,))), (SIZE,), ())
    with pytest.raises(UnsupportedOperation, match="gamma"):
        tape.walk(Graph(), [[Graph().name("x")] * SIZE])


def test_values_are_shared_between_tapes():
    graph = Graph()
    x = [graph.name(f"x[{i}]") for i in range(SIZE)]
    first, second = (Tape.of([X], [ca.cos(X[0]) + k]).walk(graph, [x])[0].scalar(x[0]) for k in (1, 2))
    printer = Printer(graph, "double", "p", [first, second])
    assert printer.stage([first])[1] == ("1.0 + v0",) or printer.stage([first])[1] == ("v0 + 1.0",)
    assert printer.stage([second])[0] == ()
