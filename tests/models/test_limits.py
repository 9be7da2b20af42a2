from fractions import Fraction

import pytest

from pbcgen import Limits, ModelError

NAMES = ("u1", "u2")


def test_intervals_follow_the_order_of_the_inputs():
    free = (None, None)
    assert Limits({"u2": (0, "3.1")}).resolve(NAMES).intervals == (free, (0, Fraction(31, 10)))
    assert Limits([(None, 1), (0, 2)]).resolve(NAMES).intervals == ((None, 1), (0, 2))
    assert Limits().resolve(NAMES).intervals == (free, free)
    assert Limits({"u1": (0, 1)}, every=(-2, 2)).resolve(NAMES).intervals == ((0, 1), (-2, 2))


def test_symmetric_bounds():
    assert Limits.symmetric("7.5").resolve(NAMES).intervals == ((Fraction(-15, 2), Fraction(15, 2)),) * 2
    assert Limits.symmetric({"u1": 1}).resolve(NAMES).intervals == ((-1, 1), (None, None))
    assert Limits.symmetric([1, 2]).resolve(NAMES).intervals == ((-1, 1), (-2, 2))


def test_absolute_bounds_have_both_signs():
    limits = Limits.absolute([[1, 1], [1, -1]], ["7.901", 2]).resolve(NAMES)
    assert limits.A == ((1, 1), (1, -1), (-1, -1), (-1, 1))
    assert limits.b == (Fraction(7901, 1000), 2, Fraction(7901, 1000), 2)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Limits({"u1": (1, 0)}), "interval of `u1` is empty: its lower bound 1 is not below its upper bound 0"),
        (lambda: Limits({"u1": ("0.5", "0.1")}), "lower bound 0.5 is not below its upper bound 0.1"),
        (lambda: Limits({"u1": 5}), "interval of `u1` is 5: a pair"),
        (lambda: Limits([(0, float("nan"))]), "upper bound of the interval 1 is nan"),
        (lambda: Limits(A=[[1, 1]]), "A without b"),
        (lambda: Limits(A=[[1, 1]], b=[1, 2]), "A has 1 rows and b has 2 entries"),
        (lambda: Limits(A=[[0, 0]], b=[1]), "row 1 of the limits' A is zero"),
        (lambda: Limits(A=[1, 1], b=[1]), "mixes numbers and rows"),
        (lambda: Limits.symmetric(-1), "bound of the inputs is -1: it must be positive"),
        (lambda: Limits.symmetric({"u1": 0}), "bound of `u1` is 0"),
        (lambda: Limits.absolute([[1, 1]], [-1]), "bound 1 of the polyhedron is -1"),
        (lambda: Limits({"v": (0, 1)}).resolve(NAMES), "bound `v`, which is not an input"),
        (lambda: Limits([(0, 1)]).resolve(NAMES), "1 intervals, the system has 2 inputs"),
        (lambda: Limits(A=[[1]], b=[1]).resolve(NAMES), "have 1 entries, the system has 2 inputs"),
    ],
)
def test_bad_limits_are_refused_by_name(build, message):
    with pytest.raises(ModelError, match=message):
        build()


@pytest.mark.parametrize(
    ("limits", "named"),
    [
        (Limits(A=[[1, 1], [-1, -1]], b=[-1, -1]), "`a + b <= -1`, `-a - b <= -1`"),
        (Limits({"a": (0, 1)}, A=[[2, 0]], b=["-5"]), "`-a <= 0`, `2*a <= -5`"),
    ],
)
def test_limits_that_no_input_keeps_are_refused_by_name(limits, named):
    with pytest.raises(ModelError) as error:
        limits.resolve(["a", "b"]).check(["a", "b"])
    assert f"no input keeps the limits {named} together" in str(error.value)


@pytest.mark.parametrize("b", [[1, -1], [0, 0], [1, 1]])
def test_limits_that_touch_or_leave_room_are_kept(b):
    Limits(A=[[1, 1], [-1, -1]], b=b).resolve(["a", "b"]).check(["a", "b"])
