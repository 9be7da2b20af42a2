from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pbcgen import DynamicExtension, Integral, ModelError, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.models.gains import rank
from pbcgen.models.laws import amplitudes, gains, shaping

C = {"alpha_c": 1, "beta_c": 1, "K_c": 1, "R_c": 1}
ONES = {**C, "alpha_l": 1, "beta_l": 1, "K_l": 1, "R_l": 1}


def test_gains_are_exact():
    law = DynamicExtension(alpha="0.0485", beta=0.1, K_c="1e6", R_c=Fraction(1, 3)).resolve(1)
    assert law.alpha == (Fraction(97, 2000),)
    assert law.beta == (Fraction(1, 10),)
    assert law.K_c == ((Fraction(1000000),),)
    assert law.R_c == ((Fraction(1, 3),),)


def test_single_numbers_take_the_size_of_the_system():
    law = DynamicExtension(alpha=2, beta=[1, 2], K_c=3, R_c=[4, 5]).resolve(2)
    assert law.alpha == (2, 2)
    assert law.beta == (1, 2)
    assert law.K_c == ((3, 0), (0, 3))
    assert law.R_c == ((4, 0), (0, 5))
    assert law.resolve(2) == law


def test_arrays_are_gains_too():
    law = PotentialCompensation(np.array([1.5, 2]), np.array(1), np.eye(2), [[2, 1], [1, 2]]).resolve(2)
    assert law.alpha == (Fraction(3, 2), 2)
    assert law.K_c == ((1, 0), (0, 1))


def test_every_law_has_its_name():
    base = DynamicExtension(1, 1, 1, 1)
    laws = [
        PassiveOutput(1, 1, 1),
        base,
        NaturalDamping(**ONES),
        PotentialCompensation(1, 1, 1, 1),
        Integral(base, 1, 1, 0),
    ]
    assert [law.name for law in laws] == [
        "passive-output",
        "dynamic-extension",
        "natural-damping",
        "potential-compensation",
        "integral",
    ]
    assert list(gains(laws[-1].resolve(2))) == ["alpha", "beta", "K_c", "R_c", "alpha_psi", "beta_psi", "R_psi"]


def test_upsilon_is_the_identity_pattern_unless_given():
    law = NaturalDamping(**ONES)
    assert law.resolve(2).Upsilon is None
    assert law.resolve(1, 1).Upsilon == ((1,),)
    assert law.resolve(2, 2).Upsilon == ((1, 0), (0, 1))
    assert law.resolve(1, 2).Upsilon == ((1, 0),)
    assert law.resolve(2, 1).Upsilon == ((1,), (0,))
    assert NaturalDamping(**ONES, Upsilon=[[2, -1]]).resolve(1, 2).Upsilon == ((2, -1),)
    assert NaturalDamping(**ONES, Upsilon=3).resolve(1, 1).Upsilon == ((3,),)


@pytest.mark.parametrize(
    ("law", "m", "s", "message"),
    [
        (DynamicExtension([1, 1], 1, 1, 1), 3, None, "gain alpha has 2 entries, the system has 3 inputs"),
        (DynamicExtension([1], 1, 1, 1), 2, None, "gain alpha has 1 entry, the system has 2 inputs"),
        (DynamicExtension(1, 1, [1, 1], 1), 1, None, "gain K_c is 2x2, the system has 1 input$"),
        (PassiveOutput(1, 1, [1, 2]), 1, None, "gain k_p has 2 entries"),
        (NaturalDamping(**{**ONES, "R_l": [1, 1]}), 1, 1, "gain R_l is 2x2"),
        (NaturalDamping(**ONES, Upsilon=[[1, 1]]), 1, 1, "gain Upsilon is 1x2: 1x1 was expected"),
        (NaturalDamping(**ONES, Upsilon=[[1, 2], [2, 4]]), 2, 2, "gain Upsilon has rank 1: rank 2 is needed"),
        (Integral(DynamicExtension(1, 1, 1, 1), [1, 2], 1, 1), 3, None, "gain alpha_psi has 2 entries"),
        (Integral(DynamicExtension([1, 2], 1, 1, 1), 1, 1, 1), 3, None, "gain alpha has 2 entries"),
    ],
)
def test_a_gain_of_the_wrong_size_is_named(law, m, s, message):
    with pytest.raises(ModelError, match=message):
        law.resolve(m, s)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: PassiveOutput(-1, 1, 1), "gain alpha is -1: it must be positive"),
        (lambda: PassiveOutput(1, [1, 0], 1), r"gain beta\[2\] is 0: it must be positive"),
        (lambda: PassiveOutput(1, 1, float("nan")), "gain k_p is nan"),
        (lambda: PassiveOutput(1, 1, None), "gain k_p has no value"),
        (lambda: PassiveOutput([], 1, 1), "gain alpha is empty"),
        (lambda: DynamicExtension(1, 1, -10, 1), "gain K_c is -10: it must be positive"),
        (lambda: DynamicExtension(1, 1, [1, -1], 1), r"gain K_c\[2,2\] is -1"),
        (lambda: DynamicExtension(1, 1, [[1, 2], [0, 1]], 1), r"gain K_c is not symmetric: entry \(2, 1\) is 0"),
        (lambda: DynamicExtension(1, 1, 1, [[1, 2]]), "gain R_c is 1x2: a square matrix"),
        (lambda: DynamicExtension(1, 1, 1, [[1, 2], [3]]), "gain R_c has rows of different lengths"),
        (lambda: DynamicExtension(1, 1, 1, [[1, 2], 3]), "gain R_c mixes numbers and rows"),
        (lambda: DynamicExtension(1, 1, 1, "ten"), "gain R_c is 'ten'"),
        (lambda: NaturalDamping(**{**ONES, "alpha_l": 0}), "alpha_l is 0: .* use DynamicExtension"),
        (lambda: NaturalDamping(**{**ONES, "alpha_l": np.zeros(2)}), "alpha_l is 0: .* use DynamicExtension"),
        (lambda: NaturalDamping(**{**ONES, "K_l": [[1, 1], [1, 1]]}), "gain K_l must be diagonal"),
        (lambda: NaturalDamping(**{**ONES, "R_l": 0}), "gain R_l is 0"),
        (lambda: Integral(PassiveOutput(1, 1, 1), 1, 1, 1), "base of Integral is passive-output"),
        (lambda: Integral(3, 1, 1, 1), "base of Integral is 3"),
        (lambda: Integral(DynamicExtension(1, 1, 1, 1), 1, 1, -1), "gain R_psi is -1: it must be nonnegative"),
    ],
)
def test_a_bad_gain_is_refused_by_name(build, message):
    with pytest.raises(ModelError, match=message):
        build()


@given(st.lists(st.lists(st.integers(-3, 3), min_size=3, max_size=3), min_size=1, max_size=4))
def test_the_rank_is_that_of_the_matrix(rows):
    exact = tuple(tuple(Fraction(entry) for entry in row) for row in rows)
    assert rank(exact) == np.linalg.matrix_rank(np.array(rows, dtype=float))


def test_the_term_in_gamma_and_the_amplitudes_are_those_of_each_law():
    passive = PassiveOutput(2, 3, 5).resolve(2)
    natural = NaturalDamping(2, 3, 7, 11, alpha_l=13, beta_l=1, K_l=1, R_l=1).resolve(2)
    integral = Integral(DynamicExtension(2, 3, 7, 11), 17, 1, 0).resolve(2)
    assert [shaping(law).stiffness for law in (passive, natural, integral)] == [(6, 6)] * 3
    assert shaping(passive).K_c is None
    assert shaping(natural).K_c == shaping(integral).K_c == ((7, 0), (0, 7))
    assert [amplitudes(law) for law in (passive, natural, integral)] == [(7, 7), (15, 15), (19, 19)]
