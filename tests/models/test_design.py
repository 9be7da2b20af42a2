import os
import subprocess
import sys
from fractions import Fraction

import casadi as ca
import pytest

from pbcgen import (
    AffineSystem,
    Design,
    DynamicExtension,
    Integral,
    Limits,
    Mechanical,
    ModelError,
    NaturalDamping,
    Parameters,
    PassiveOutput,
    PotentialCompensation,
)
from pbcgen.models.identity import canonical_text, model_hash

P = Parameters(k=2, d="0.5")
X, V, U = ca.SX.sym("x"), ca.SX.sym("v"), ca.SX.sym("u")
SPRING = AffineSystem(
    [X, V],
    [U],
    [V, -P.k * X - P.d * V],
    [0, 1],
    P.k * X**2 / 2 + V**2 / 2,
    parameters=P,
    measured=["x", {"force": P.k * X}],
)
LAW = DynamicExtension(1, 2, 3, 4)
Q, QP = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
ARM = Mechanical(Q, QP, M=[1, 2], V=ca.cos(Q[0]), G=ca.SX.eye(2))


def _design(**changes):
    return Design(**{"system": SPRING, "target": {"x": "0.1"}, "law": LAW, "sample_period": "1e-3", **changes})


def test_a_design_is_exact():
    design = _design(limits=Limits.symmetric(3), initial={"v": "0.2"}, near={"x": 0.1}, duration="2.5")
    assert design.sample_period == Fraction(1, 1000)
    assert design.initial == (0, Fraction(1, 5))
    assert design.near == {"x": Fraction(1, 10)}
    assert design.duration == Fraction(5, 2)
    assert design.input_set.intervals == ((-3, 3),)
    assert (design.system, design.model) == (SPRING, SPRING)
    assert _design().input_set.intervals == ((None, None),)
    assert _design().precision == "float"


def test_a_partial_target_gives_conditions_only():
    target = _design().target
    assert target.full is None
    assert [(c.name, c.value) for c in target.conditions] == [("x", Fraction(1, 10))]
    assert ca.is_equal(target.conditions[0].expression, X)
    assert _design(target=[None, 0]).target.full is None


@pytest.mark.parametrize("target", [["0.1", 0], {"v": 0, "x": 0.1}, ("0.1", 0)])
def test_a_target_that_names_every_state_is_full(target):
    assert _design(target=target).target.full == (Fraction(1, 10), 0)


def test_a_target_may_be_an_expression_or_a_measured_signal():
    target = _design(target={"energy": (P.k * X**2 / 2, "0.02"), "force": 1}).target
    assert [c.name for c in target.conditions] == ["energy", "force"]
    assert target.conditions[0].value == Fraction(1, 50)
    assert ca.is_equal(target.conditions[1].expression, P.k * X, 2)


def test_a_posture_gives_the_momenta_of_a_mechanical_system_too():
    for target in ({"q_0": 1, "q_1": 2}, [1, 2], [1, 2, 0, 0]):
        assert _design(system=ARM, target=target).target.full == (1, 2, 0, 0)
    assert _design(system=ARM, target={"q_0": 1}).target.full is None
    assert _design(system=ARM, target={"q_0": 1}, initial=[3, 4]).initial == (3, 4, 0, 0)


def test_with_changes_one_thing_and_keeps_the_rest():
    design = _design(limits=Limits.symmetric(3), name="spring", initial=[1, 2])
    other = design.with_(sample_period="2e-3", target={"x": 1})
    assert (other.sample_period, other.target.conditions[0].value) == (Fraction(1, 500), 1)
    assert (other.law, other.limits, other.name, other.initial) == (LAW, design.limits, "spring", (1, 2))
    assert design.sample_period == Fraction(1, 1000)
    assert canonical_text(design.with_()) == canonical_text(design)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"system": 3}, "system is a int"),
        ({"sample_period": 0}, "sample period is 0: it must be positive"),
        ({"sample_period": None}, "sample period has no value"),
        ({"sample_period": float("nan")}, "sample period is nan"),
        ({"precision": "half"}, "precision is 'half'"),
        ({"duration": -1}, "duration is -1"),
        ({"law": "uc"}, "law is 'uc'"),
        ({"law": DynamicExtension([1, 1], 1, 1, 1)}, "gain alpha has 2 entries, the system has 1 input"),
        ({"law": PotentialCompensation(1, 1, 1, 1)}, "`potential-compensation` is for mechanical systems"),
        ({"law": Integral(LAW, 1, 1, 1)}, "`integral` is for mechanical systems"),
        ({"limits": (-1, 1)}, "limits is a tuple"),
        ({"limits": Limits({"w": (0, 1)})}, "limits bound `w`"),
        ({"target": {}}, "target is empty"),
        ({"target": [None, None]}, "target is empty"),
        ({"target": [1]}, r"target has 1 values: 2 were expected \(x, v\)"),
        ({"target": 3}, "target is 3"),
        ({"target": {"w": 3}}, "target `w` is neither a state nor a measured signal"),
        ({"target": {"forc": 3}}, "did you mean `force`"),
        ({"target": {"x": float("nan")}}, "target `x` is nan"),
        ({"target": {"x": None}}, "target `x` has no value"),
        ({"target": {"e": (X, 1, 2)}}, "a pair"),
        ({"target": {"x": (V, 1)}}, "target `x` has the name of a state"),
        ({"target": {"e": (U, 1)}}, "target `e` depends on the input `u`"),
        ({"target": {"e": (P.k, 1)}}, "target `e` does not depend on the state"),
        ({"target": {"e": (ca.SX.sym("z") * X, 1)}}, "target `e` contains the symbol `z`"),
        ({"near": {"w": 1}}, "near names `w`"),
        ({"initial": {"w": 1}}, "initial state names `w`"),
        ({"initial": {"x": float("inf")}}, "initial state `x` is inf"),
        ({"initial": [1]}, "initial state has 1 values"),
    ],
)
def test_a_bad_design_is_refused_by_name(changes, message):
    with pytest.raises(ModelError, match=message):
        _design(**changes)


def test_an_unknown_change_is_refused():
    with pytest.raises(ModelError, match="no `sample_time`: did you mean `sample_period`"):
        _design().with_(sample_time=1)


def test_the_text_lists_expressions_and_exact_values():
    text = canonical_text(_design(limits=Limits.absolute([[1]], ["0.3"])))
    for line in ("parameter d = 1/2", "target x = 1/10", "gain K_c = [[3]]", "limit [-1] u <= 3/10", "  0 state 1"):
        assert line in text.splitlines()
    assert "float" in text


@pytest.mark.parametrize(
    "changes",
    [
        {"target": {"x": "0.2"}},
        {"target": {"force": "0.1"}},
        {"sample_period": "2e-3"},
        {"delay": "0.5"},
        {"jitter": "0.1"},
        {"precision": "double"},
        {"law": DynamicExtension(1, 2, 3, 5)},
        {"law": PassiveOutput(1, 2, 3)},
        {"law": NaturalDamping(1, 2, 3, 4, alpha_l=1, beta_l=1, K_l=1, R_l=1)},
        {"limits": Limits.symmetric(3)},
        {"near": {"x": 1}},
        {"system": AffineSystem([X, V], [U], [V, -P.k * X], [0, 1], X**2, parameters=P)},
        {"system": AffineSystem([X, V], [U], SPRING.f, [0, 1], SPRING.S, parameters=P, measured=["x"])},
        {"system": AffineSystem([X, V], [U], SPRING.f, [0, 1], SPRING.S, parameters=P.with_values(k=3))},
    ],
)
def test_the_hash_sees_what_matters(changes):
    assert model_hash(_design(**changes)) != model_hash(_design())


def test_the_hash_ignores_names_and_simulations():
    assert model_hash(_design(name="a", description="b", duration=3, initial=[1, 1])) == model_hash(_design())


def test_the_hash_is_the_same_in_another_process():
    code = (
        "from pbcgen.models.loader import load; from pbcgen.models.identity import model_hash;"
        "print(model_hash(load('pera')), model_hash(load('coupling_device')))"
    )
    runs = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(runs) == 1
