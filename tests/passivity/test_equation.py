"""What may be concluded from one equation that holds along trajectories, and what may not."""

from __future__ import annotations

import casadi as ca
import pytest
from flint import fmpq

from pbcgen import AffineSystem
from pbcgen.passivity.equation import (
    affine,
    certainly_varies,
    essential,
    is_combination,
    linear_in,
    never_zero,
    parts,
)
from pbcgen.passivity.plant import Plant
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import CONSTANT
from pbcgen.symbolic.tape import Tape

NAMES = ["x", "y", "k"]
x, y, k = (ca.SX.sym(name) for name in NAMES)


def exact(*expressions: ca.SX) -> list[Quotient]:
    field, (values,) = evaluate(Tape.of([ca.vertcat(x, y, k)], [ca.densify(ca.vertcat(*expressions))]), NAMES, {})
    return values.column(field.const(0))


def test_an_affine_function_is_known_by_its_coefficients() -> None:
    (value,) = exact(2 * x - y / 3 + 5)
    assert affine(value, 2) == {0: fmpq(2), 1: fmpq(-1, 3), CONSTANT: fmpq(5)}


@pytest.mark.parametrize(
    "expression", [x**2 - 1, x + y**2, x * y - 1, x + ca.sin(y), ca.exp(x) - 2, 1 / (2 + x), x + k, k - 1]
)
def test_what_is_not_affine_gives_no_state(expression: ca.SX) -> None:
    """x^2 = 1 has two solutions; k is no state."""
    (value,) = exact(expression)
    assert affine(value, 2) is None


@pytest.mark.parametrize(
    ("expression", "rest"),
    [
        (2 * x + y**2, y**2 / 2),
        (x - ca.sin(y), -ca.sin(y)),
        ((1 + k**2) * x - y, -y / (1 + k**2)),
        (ca.exp(k) * x - y, -y / ca.exp(k)),
    ],
)
def test_a_state_is_given_by_what_is_linear_in_it(expression: ca.SX, rest: ca.SX) -> None:
    value, wanted = exact(expression, rest)
    found = linear_in(value, 0, 2)
    assert found is not None
    assert (found - wanted).is_zero()


@pytest.mark.parametrize(
    "expression",
    [x**2 - y, x + x**2, x * y - 1, x + ca.sin(x), ca.exp(x) - y, k * x - y, (1 + y**2) * x - 1, (k**2) * x - y],
)
def test_a_state_is_not_given_where_it_may_have_several_values_or_none(expression: ca.SX) -> None:
    """k may be zero; whether y is then given is not known either. A factor that depends on a state is no number."""
    (value,) = exact(expression)
    assert linear_in(value, 0, 2) is None


def test_a_sum_vanishes_with_its_terms_only_where_they_have_one_sign() -> None:
    definite, indefinite = exact(x**2 + 3 * y**4, x**2 - y**2)
    assert len(parts(definite)) == 2
    assert len(parts(-definite)) == 2
    assert len(parts(indefinite)) == 1


def test_a_product_names_the_one_factor_that_may_vanish() -> None:
    one, two, none, odd, even = exact((1 + x**2) * (y - 1), x * y, 1 + x**2, ca.tanh(x - y), ca.cos(x))
    found = essential(one)
    assert found is not None
    assert affine(found, 2) == {1: fmpq(1), CONSTANT: fmpq(-1)}
    assert essential(two) is None
    assert essential(none) is None
    through = essential(odd)
    assert through is not None
    assert through.is_polynomial()
    assert through.symbols() == {0, 1}
    kept = essential(even)
    assert kept is not None
    assert kept.generators() - {0, 1}  # cos(x) vanishes elsewhere than x


def test_what_vanishes_nowhere_is_proved_to() -> None:
    assert [never_zero(v) for v in exact(1 + x**2, -ca.exp(x), x, ca.cos(x), ca.SX(0), ca.SX(3), 2 - ca.sin(x))] == [
        True,
        True,
        False,
        False,
        False,
        True,
        True,
    ]


def test_a_combination_has_numbers_for_weights() -> None:
    first, second, sum_, multiple, other = (
        v.numerator.to_dict() for v in exact(x + y, x * y, 2 * (x + y) - 3 * x * y, x * (x + y), x - y)
    )
    assert is_combination(sum_, [first, second])
    assert not is_combination(multiple, [first, second])
    assert not is_combination(other, [first, second])


def test_what_is_zero_in_disguise_does_not_vary() -> None:
    plant = Plant(AffineSystem([x, y], [k], [y, -x - y], [0, 1], (x**2 + y**2) / 2))
    symbols = ca.vertcat(x, y)
    assert certainly_varies(plant, x - y**2, symbols)
    assert certainly_varies(plant, ca.sin(x) - ca.sin(x) * (1 + 1e-12), symbols)
    assert not certainly_varies(plant, ca.sin(x) ** 2 + ca.cos(x) ** 2 - 1, symbols)
    assert not certainly_varies(plant, ca.log(ca.exp(x)) - x, symbols)
    assert not certainly_varies(plant, ca.SX(0), symbols)
