"""The second reading of formulas against the first, and against CasADi's derivatives."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from flint import arb, fmpq
from hypothesis import given, settings
from hypothesis import strategies as st

from pbcgen.certify.writing import Writing
from pbcgen.symbolic.plain.boxes import shown
from pbcgen.symbolic.plain.elimination import Elimination, slopes
from pbcgen.symbolic.plain.formulas import Formulas, rational
from pbcgen.symbolic.plain.matrices import is_definite
from pbcgen.symbolic.plain.outcomes import NotCheckable
from pbcgen.symbolic.plain.spectra import krawczyk, stable
from pbcgen.symbolic.plain.values import Field, Grow, apply, partial, plain, power, sign, variables
from pbcgen.symbolic.real import REAL, approximate, precision
from pbcgen.symbolic.real import rational as exact
from pbcgen.symbolic.tape import Tape

x, y = ca.SX.sym("x"), ca.SX.sym("y")
POINT = [Fraction(3, 7), Fraction(-5, 11)]

LEAVES = st.sampled_from([x, y, ca.SX(2), ca.SX(0.25), x + y, 3 * x])
UNARY = st.sampled_from([ca.sin, ca.cos, ca.tanh, ca.exp, ca.atan, ca.asinh, lambda a: a**2, lambda a: -a, ca.sinh])
BINARY = st.sampled_from([lambda a, b: a + b, lambda a, b: a - b, lambda a, b: a * b, lambda a, b: a / (2 + b * b)])
EXPRESSIONS = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.builds(lambda f, a: f(a), UNARY, inner), st.builds(lambda f, a, b: f(a, b), BINARY, inner, inner)
    ),
    max_leaves=5,
)


def formulas_of(expression):
    writing = Writing()
    (matrix,) = writing.tape(Tape.of([ca.vertcat(x, y)], [ca.densify(expression)]), ["state"], {})
    writing.output("e", matrix.shape, matrix.entries)
    return Formulas.parse(writing.lines())


def value(formulas, state, lift=fmpq):
    return formulas.matrix("e", formulas.walk(lift, {"state": state}))[0][0]


@settings(max_examples=60, deadline=None)
@given(EXPRESSIONS)
def test_numbers_functions_and_derivatives_agree(expression):
    formulas, point = formulas_of(expression), [exact(v) for v in POINT]
    first = Tape.of([ca.vertcat(x, y)], [ca.densify(expression)]).walk(REAL, [point])[0].dense(fmpq(0))[0][0]
    assert arb(value(formulas, point)).overlaps(arb(first))
    dual = value(formulas, variables(point, 2))
    H, g = ca.hessian(expression, ca.vertcat(x, y))
    numbers = ca.Function("d", [ca.vertcat(x, y)], [ca.densify(g), ca.densify(H)])([float(v) for v in POINT])
    slopes = [approximate(plain(partial(dual, k))) for k in range(2)]
    bends = [[approximate(plain(partial(partial(dual, i), k))) for k in range(2)] for i in range(2)]
    np.testing.assert_allclose(slopes, np.array(numbers[0]).ravel(), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(bends, np.array(numbers[1]), rtol=1e-8, atol=1e-8)
    field = Field(2, 64)
    try:
        function = field.lift(value(formulas, field.symbols, field.lift))
    except (NotCheckable, Grow):
        return
    there = field.at(function.top, point) / field.at(function.bottom, point)
    assert arb(there).overlaps(arb(first))


@pytest.mark.parametrize(
    "zero",
    [
        ca.sin(x + y) - ca.sin(x) * ca.cos(y) - ca.cos(x) * ca.sin(y),
        ca.sin(x) ** 2 + ca.cos(x) ** 2 - 1,
        ca.cos(2 * x) - 1 + 2 * ca.sin(x) ** 2,
        ca.exp(2 * x) - ca.exp(x) ** 2,
        ca.exp(x + y) * ca.exp(-y) - ca.exp(x),
        ca.tanh(-3 * x) + ca.tanh(3 * x),
        ca.sqrt(1 + x**2) ** 2 - 1 - x**2,
        (x**2 - y**2) / (x - y) - x - y,
        ca.cosh(x) ** 2 - ca.sinh(x) ** 2 - 1,
        ca.tan(x) * ca.cos(x) - ca.sin(x),
    ],
    ids=str,
)
def test_identities_are_known(zero):
    field = Field(2, 4)
    for _ in range(9):
        try:
            assert field.lift(value(formulas_of(zero), field.symbols, field.lift)).top.is_zero()
            return
        except Grow as larger:
            field = Field(2, *larger.args)
    pytest.fail("it does not settle")


def test_a_divisor_that_is_the_zero_function_for_some_states_is_noted():
    field = Field(2, 16)
    a = field.symbols[0]
    root = apply("sqrt", a * a)
    assert (root - a).top
    hidden = ((root - a) * (root + a)) / (root + a)
    assert hidden.top.is_zero()
    (divisor,) = field.divisors.values()
    assert sign(arb(field.at(divisor, [fmpq(-1), fmpq(1)]))) in (0, None)


@pytest.mark.parametrize("text", ["-3", "2/7", "1.5", "2e-70", "-12345e-3", "0"])
def test_numbers_are_read_exactly(text):
    number = rational(text)
    assert Fraction(int(number.p), int(number.q)) == Fraction(text)


@pytest.mark.parametrize(
    ("name", "argument", "expected"), [("sqrt", "9/4", "3/2"), ("sqrt", "0", "0"), ("log", "1", "0"), ("exp", "0", "1")]
)
def test_a_rational_value_is_exact_as_it_is_for_the_prover(name, argument, expected):
    """An equation at x* with sqrt(1) in it holds exactly, and not only within a ball."""
    found = apply(name, rational(argument))
    assert isinstance(found, fmpq)
    assert found == rational(expected) == getattr(REAL, name)(exact(Fraction(argument)))
    assert isinstance(apply("sqrt", fmpq(2)), arb)


def test_what_has_no_exact_meaning_is_named():
    with pytest.raises(NotCheckable, match="gamma"):
        Formulas.parse(["  0 state 0", "  1 gamma 0"]).walk(fmpq, {"state": [fmpq(1)]})


@pytest.mark.parametrize(
    "expression",
    [
        x * ca.sign(x),
        ca.sign(y) * (x + y),
        ca.fmin(x, y) * x,
        ca.fmax(x * y, y**2),
        ca.atan2(y, x),
        ca.atan2(y, -x),
        ca.copysign(x, y),
        ca.erf(x) * y,
        ca.erfinv(y),
        ca.floor(5 * x) * y,
        ca.ceil(5 * x) * y,
        ca.fmod(5 * x, y),
        ca.remainder(5 * x, y),
        ca.if_else(x < y, x, y * y),
        ca.if_else(ca.logic_or(x <= y, ca.logic_not(ca.logic_and(x != y, y != 1))), x, y * y),
        ca.if_else(ca.logic_or(x >= y, x == 1), x, y * y),
        (x > 0) * x,
    ],
)
def test_functions_of_cases_agree(expression):
    """With the provers' values, with CasADi's slopes, and as exact functions."""
    formulas, point = formulas_of(expression), [exact(v) for v in POINT]
    first = Tape.of([ca.vertcat(x, y)], [ca.densify(expression)]).walk(REAL, [point])[0].dense(fmpq(0))[0][0]
    dual = value(formulas, variables(point))
    assert arb(plain(dual)).overlaps(arb(first))
    g = ca.Function("d", [ca.vertcat(x, y)], [ca.densify(ca.gradient(expression, ca.vertcat(x, y)))])
    slopes = [approximate(plain(partial(dual, k))) for k in range(2)]
    np.testing.assert_allclose(slopes, np.array(g([float(v) for v in POINT])).ravel(), rtol=1e-9, atol=1e-12)
    field = Field(2, 64)
    function = field.lift(value(formulas, field.symbols, field.lift))
    assert arb(field.at(function.top, point) / field.at(function.bottom, point)).overlaps(arb(first))


@pytest.mark.parametrize("name", ["sign", "fabs"])
def test_nothing_is_known_of_a_sign_where_it_changes(name):
    """Neither of its value nor of its slope, unless zero multiplies it; as a function it is no constant."""
    for at in (fmpq(0), arb(0, 1)):
        (v,) = variables([at])
        found = apply(name, v)
        assert not arb(plain(partial(found, 0))).abs_upper() < 10**6
        assert name == "fabs" or plain(found).rad() > 10**6
    field = Field(1, 16)
    (v,) = field.symbols
    assert apply("sign", v).number() is None
    with pytest.raises(NotCheckable, match="jump"):
        field.continued([apply("sign", v)])
    assert not (apply("sign", v) * v - apply("fabs", v)).top


def test_the_derivative_of_a_modulus_is_known_where_a_factor_vanishes_with_it():
    """v |v| has the slope 2 |v|, at zero too; |v| and v + |v| have none there, and no second derivative is known."""
    for at, slope in ((fmpq(-3), 6), (fmpq(0), 0), (fmpq(2), 4)):
        (v,) = variables([at], 2)
        found = v * apply("fabs", v)
        assert plain(partial(found, 0)) == slope
    assert plain(partial(partial(found, 0), 0)) == 2
    (v,) = variables([fmpq(0)], 2)
    assert not plain(partial(partial(v * apply("fabs", v), 0), 0)).is_finite()
    for kink in (apply("fabs", v), v + apply("fabs", v), apply("fabs", v * fmpq(1, 10**300))):
        assert sign(plain(partial(kink, 0))) is None
        assert plain(partial(kink, 0)).rad() > 1e300


def test_the_slope_of_a_function_with_a_modulus_must_continue():
    field = Field(1, 16)
    (v,) = field.symbols
    modulus = apply("fabs", v)
    assert not (slopes(field, v * modulus)[0] - modulus * 2).top
    assert not (modulus * modulus - v * v).top
    assert not (apply("fabs", v * -3) - modulus * 3).top
    for kink in (modulus, v + modulus, modulus / (v * v + 1)):
        with pytest.raises(NotCheckable, match="jump"):
            slopes(field, kink)


@pytest.mark.parametrize("eigenvalue", ["1", "1/1000000", "0", "-1/1000000"])
def test_definiteness_is_exact_at_the_margin(eigenvalue):
    e = rational(eigenvalue)
    matrix = [[1 + e, fmpq(1)], [fmpq(1), 1 + e]]
    assert is_definite(matrix) is bool(e > 0)
    assert is_definite(matrix, semi=True) is bool(e >= 0)


@pytest.mark.parametrize(
    ("diagonal", "continuous", "discrete"), [("-1/2", True, True), ("-2", True, False), ("1/2", False, True)]
)
def test_stability_of_both_kinds(diagonal, continuous, discrete):
    matrix = [[rational(diagonal), fmpq(1)], [fmpq(0), rational(diagonal)]]
    assert stable(matrix, False) is continuous
    assert stable(matrix, True) is discrete


def test_an_eigenvalue_on_the_boundary_decides_nothing():
    assert stable([[fmpq(0), fmpq(1)], [fmpq(-1), fmpq(0)]], False) is None


def test_krawczyk_encloses_the_zero_and_refuses_what_is_none():
    def system(z):
        return [z[0] * z[0] - 2]

    with precision(200):
        (root,) = krawczyk(
            system, [rational("1.41421356237309504880168872420969807856967187537694")], rational("1e-40")
        )
        assert root.overlaps(arb(2).sqrt())
        assert krawczyk(system, [rational("1.4142")], rational("1e-40")) is None


@pytest.mark.parametrize("exponent", ["3/4", "-1/4", "1/3", "-13/10", "-3/2", "2"])
def test_powers_are_those_of_exp_and_log(exponent):
    found = power(arb(3), rational(exponent))
    assert found.overlaps((arb(3).log() * arb(rational(exponent))).exp())
    assert found.rad() < 1e-10


def test_a_power_of_what_may_be_negative_is_unknown():
    assert not power(arb(0, 1), rational("1/3")).is_finite()
    assert not power(fmpq(-8), rational("1/3")).is_finite()


def test_powers_of_one_function_are_related():
    """The derivative of a^(4/3) is 4/3 a^(1/3)."""
    field = Field(1, 16)
    (x,) = field.symbols
    a = x * x + 1
    root = power(a, fmpq(1, 3))
    assert not (root * root * root - a).top
    assert (root * root * root + a).top
    (slope,) = slopes(field, power(a, fmpq(4, 3)))
    assert not (slope - root * x * fmpq(8, 3)).top
    assert (slope - root * x * fmpq(7, 3)).top


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda x, y: (x - y) * (x - y) + fmpq(1, 30), 1),
        (lambda x, y: fmpq(-1, 10**6) - (x + y * 2) * (x + y * 2) - (x - 1) * (x - 1), -1),
        (lambda x, y: (x - y) * (x - y), 0),
        (lambda x, y: (x - y) * (x - y) - fmpq(1, 10**6), 0),
        (lambda x, y: x * x + x * y * 3 + y * y * 2 + 1, 0),
        (lambda x, y: x * x * (y * y + 1) + x * 2 + 2, 1),
        (lambda x, y: x * x * (y * y + 1) + x * 2 + fmpq(1, 2), 0),
    ],
)
def test_squares_are_completed(make, expected):
    field = Field(2, 4)
    assert field.everywhere(make(*field.symbols).top) == expected


def _chain(*equations):
    """Two variables a, b with the rates b and -a, and equations of them."""
    field = Field(2, 8)
    a, b = field.symbols
    return field, Elimination(field, [b, -a], [field.lift(e(field, a, b)) for e in equations])


def test_a_step_is_accepted_where_the_equation_gives_the_variable():
    for equation in (
        lambda f, a, b: a - b * b,
        lambda f, a, b: power(a - b * b, fmpq(3)) * (1 + b * b),
        lambda f, a, b: apply("tanh", (a - b * b) * 2),
    ):
        field, chain = _chain(equation)
        b = field.symbols[1]
        kind = ("tanh", fmpq(2)) if len(chain.field.atoms) else ()
        assert chain.solve(0, 0, b * b, *kind)
        assert (chain.solved[0] - b * b).top.is_zero()
        assert (chain.equations[-1] - (b + 2 * b * field.symbols[0])).top.is_zero()  # a' - 2 b b'


@pytest.mark.parametrize(
    ("equation", "value"),
    [
        (lambda f, a, b: a * a - 1, lambda f, a, b: f.lift(1)),  # or -1
        (lambda f, a, b: (a - b) * b, lambda f, a, b: b),  # or b = 0
        (lambda f, a, b: (a - b) * (2 + b), lambda f, a, b: b),  # or b = -2
        (lambda f, a, b: apply("sin", a), lambda f, a, b: f.lift(0)),
        (lambda f, a, b: a - b, lambda f, a, b: -b),
        (lambda f, a, b: a - b, lambda f, a, b: b * 2 - a),  # it says nothing of a but by a
        (lambda f, a, b: a - b, lambda f, a, b: a + (a - b)),
        (lambda f, a, b: f.lift(0) * a, lambda f, a, b: b),
    ],
)
def test_a_step_is_refused_where_the_equation_gives_no_such_value(equation, value):
    field, chain = _chain(equation)
    before = len(chain.equations)
    assert not chain.solve(0, 0, value(field, *field.symbols))
    assert chain.solved == {}
    assert len(chain.equations) == before


def test_a_variable_is_given_once_and_not_by_what_was_given_before():
    field, chain = _chain(lambda f, a, b: a - b, lambda f, a, b: b - a * a)
    a, b = field.symbols
    assert chain.solve(0, 0, b)
    assert not chain.solve(0, 0, b)
    assert not chain.solve(1, 1, a * a)


def test_an_odd_function_is_undone_only_if_it_increases_and_its_scale_is_not_zero():
    field, chain = _chain(lambda f, a, b: apply("tanh", a - b), lambda f, a, b: apply("sin", a - b))
    b = field.symbols[1]
    assert not chain.solve(1, 0, b, "sin")
    assert not chain.solve(0, 0, b, "tanh", fmpq(0))
    assert not chain.solve(0, 0, b, "tanh", fmpq(2))
    assert chain.solve(0, 0, b, "tanh")


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda x, y: apply("sin", x) + 2, 1),
        (lambda x, y: -apply("sin", x) - 2, -1),
        (lambda x, y: apply("sin", x) + 1, 0),
        (lambda x, y: apply("tanh", x) * apply("cos", y) - fmpq(11, 10), -1),
        (lambda x, y: apply("atan", x) + 2, 0),
        (lambda x, y: apply("exp", x), 1),
        (lambda x, y: apply("exp", x) - 1, 0),
        (lambda x, y: apply("exp", x) + apply("exp", y) - 1, 0),
        (lambda x, y: apply("exp", x) + apply("sin", y), 0),
        (lambda x, y: apply("exp", x) + apply("sin", y) + 1, 1),
        (lambda x, y: apply("sqrt", x * x + 1), 1),
        (lambda x, y: apply("sqrt", x * x), 0),
        (lambda x, y: apply("sqrt", x * x) + 1, 1),
        (lambda x, y: x * apply("exp", y), 0),
        (lambda x, y: x * x * apply("exp", y) + fmpq(1, 9), 1),
        (lambda x, y: x + 1, 0),
        (lambda x, y: (apply("exp", x) + 1) * (apply("sin", y) - 3), -1),
        (lambda x, y: (apply("sin", x) - 3) * (apply("sin", y) - 3), 1),
        (lambda x, y: (apply("exp", x) + 1) * y, 0),
        (lambda x, y: x * 0, 0),
    ],
)
def test_signs_that_hold_everywhere(make, expected):
    field = Field(2, 8)
    a = make(*field.symbols)
    assert field.everywhere(a.top) == expected
    assert field.everywhere((-a).top) == -expected
    assert field.positive(a) == (expected == 1)


@pytest.mark.parametrize(
    ("make", "ends", "expected"),
    [
        (lambda s, t: s, (0, None), 1),
        (lambda s, t: s, (None, 0), -1),
        (lambda s, t: s, (-1, None), 0),
        (lambda s, t: s * s - 1, (1, None), 1),
        (lambda s, t: s * s - 1, (fmpq(99, 100), None), 0),
        (lambda s, t: 5 - s, (0, 5), 1),
        (lambda s, t: s * (5 - s), (0, 5), 1),
        (lambda s, t: s * (5 - s), (0, fmpq(501, 100)), 0),
        (lambda s, t: s * (5 - s) - 1, (0, 5), 0),
        (lambda s, t: s + t * t, (0, 1), 1),
        (lambda s, t: s - t * t, (0, 1), 0),
        (lambda s, t: s - t, (0, 1), 0),
        (lambda s, t: s + apply("sin", s), (0, None), 0),  # what is inside of functions is not known
        (lambda s, t: s + 1 + apply("sin", s), (0, None), 1),
    ],
)
def test_signs_that_hold_between_ends(make, ends, expected):
    field = Field(2, 8)
    field.ends = {0: tuple(None if v is None else fmpq(v) for v in ends)}
    assert field.everywhere(field.lift(make(*field.symbols)).top) == expected


def test_the_logarithm_of_an_exponential_is_its_argument():
    field = Field(2, 8)
    s, t = field.symbols
    assert not (apply("log", apply("exp", s)) - s).top
    assert not (apply("log", apply("exp", s + t * 3)) - s - t * 3).top
    assert (apply("log", apply("exp", s) * 2) - s).top
    assert (apply("log", apply("exp", s) * t) - s).top
    assert (apply("log", s * s) - apply("log", s) * 2).top  # of another sign


def test_a_bound_counts_every_term_and_none_is_known_of_what_is_unbounded():
    field = Field(2, 8)
    a, b = field.symbols
    s, t = apply("sin", a), apply("tanh", b)
    centre, reach = field.bound(s * 3 - s * t * t * 2 + 5, {})
    assert (centre, reach) == (5, 5)
    centre, reach = field.bound(a * a * t * 2 - a + 1, {0: fmpq(3)})
    assert (centre, reach) == (1, 21)
    for unbounded in (a, apply("exp", a), apply("atan", b), s / (a * a + 1), a * t):
        assert not field.bounded(unbounded)
        assert not field.bound(unbounded, {})[1].is_finite()
    assert not field.bound(a * b, {0: fmpq(3)})[1].is_finite()


@pytest.mark.parametrize(
    ("function", "lo", "hi", "least"),
    [
        (lambda z: z[0] * z[0] * (z[0] - fmpq(3, 2)), "1", "6/5", None),  # convex there, not from there to zero
        (lambda z: z[0] * z[0] * (-z[0] - fmpq(3, 2)), "-6/5", "-1", None),
        (lambda z: z[0] * z[0] * (z[0] + fmpq(3, 2)), "1/10", "6/5", ":"),
        (lambda z: z[0] * z[0] * (fmpq(3, 2) - z[0]), "-6/5", "-1/10", ":"),
        (lambda z: apply("cos", z[0]) * -1 + 1, "-1", "1", ":"),
        (lambda z: apply("cos", z[0]) - 1, "-1", "1", None),
        (lambda z: apply("sin", z[0]) - fmpq(1, 2), "6/10", "2", ";"),
        (lambda z: apply("exp", z[0]) - 1, "1/100", "1", ";"),
        (lambda z: -apply("exp", z[0]) + 1, "-1", "-1/100", ";"),
        (lambda z: apply("exp", z[0]) - 1, "-1/100", "1", None),
        (lambda z: 3 - z[0] * z[0], "-3/2", "3/2", "."),
        (lambda z: 3 - z[0] * z[0], "-9/5", "3/2", None),
        (lambda z: z[0] * z[0] - z[0] + fmpq(1, 3), "1/4", "1/2", ","),
        (lambda z: z[0] * z[0] - z[0] + fmpq(1, 5), "0", "1", None),
    ],
)
def test_a_leaf_shows_what_is_nonnegative_on_its_box_and_nothing_else(function, lo, hi, least):
    box, at_zero = [(rational(lo), rational(hi))], function([fmpq(0)])
    zeros = {0: fmpq(0)} if at_zero == 0 and partial(function(variables([fmpq(0)])), 0) == 0 else {}
    if least:
        assert shown(least, box, function, zeros)
    else:
        assert not any(shown(leaf, box, function, zeros) for leaf in ".,;:")
        assert not any(shown(f"a{one}{two}", box, function, zeros) for one in ".,;:" for two in ".,;:")
    assert not shown(":", box, function, {})


def test_a_tree_covers_its_box_with_nothing_over_and_nothing_left_out():
    one = [(fmpq(0), fmpq(1))]
    assert shown("a..", one, lambda z: z[0] + 1, {})
    for tree in ("", "a", "a.", "a...", "..", "?", "a.?"):
        assert not _is_shown(tree, one)


def _is_shown(tree, box):
    try:
        return shown(tree, box, lambda z: z[0] + 1, {})
    except IndexError:  # the coordinate that is halved is none of the box
        return False
