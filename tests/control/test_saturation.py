"""The interval of each input covers everything that the law can put out."""

import math
from fractions import Fraction

import casadi as ca
import pytest

from pbcgen import Design, Limits, Mechanical, PotentialCompensation
from pbcgen.control.derive import derive
from pbcgen.proof.claim import Status


def _pendulum(V, limit, **keywords):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    arm = Mechanical([q], [p], M=[1], V=V(q), D=[1], G=[1], inputs=["u"], **keywords)
    law = PotentialCompensation(alpha=1, beta=1, K_c=1, R_c=1)
    design = Design(arm, target={"q": 0}, law=law, limits=Limits.symmetric(limit), sample_period="1e-3", name="arm")
    derivation = derive(design)
    return {c.claim: c for c in derivation.claims}["saturation"], derivation.derived["input_intervals"][0]


#: Potentials whose gradient is not periodic with 2 pi, and the supremum of the gradient plus alpha.
LONG_PERIODS = {
    "half an angle": (lambda q: -2 * ca.sin(q / 2) - ca.cos(q), 3),
    "quarter of an angle": (lambda q: -8 * ca.sin(q / 4) - ca.cos(q), 4),
    "product of an irrational": (lambda q: -2 * ca.sin(0.3718 * q) / 0.3718 - ca.cos(q), 4),
    "slow saturation": (lambda q: 20 * ca.log(ca.cosh(q / 20)) - ca.cos(q), 3),
    "slow arctangent": (lambda q: 20 * q * ca.atan(q / 20) - 200 * ca.log(1 + q**2 / 400) - ca.cos(q), 3),
}


@pytest.mark.parametrize("name", LONG_PERIODS)
def test_a_gradient_with_another_period_is_not_bounded_over_one_turn(name):
    V, supremum = LONG_PERIODS[name]
    claim, interval = _pendulum(V, supremum - 0.5)
    assert claim.status is not Status.PROVED
    assert interval is None or interval[1] >= supremum - 1e-6 or name == "half an angle"


def test_two_harmonics_are_bounded_tightly_over_one_turn():
    """sin q + sin 2q has the maximum 1.7601725."""
    claim, interval = _pendulum(lambda q: -ca.cos(q) - ca.cos(2 * q) / 2, "2.7603")
    assert claim.status is Status.PROVED
    assert interval[1] == pytest.approx(2.7601725, abs=1e-5)
    assert interval[1] >= 2.7601725
    assert _pendulum(lambda q: -ca.cos(q) - ca.cos(2 * q) / 2, "2.76")[0].status is not Status.PROVED


def test_an_unbounded_potential_leaves_the_limits_somewhere():
    claim, interval = _pendulum(lambda q: q**2, 5)
    assert claim.status is Status.REFUTED
    assert abs(2 * Fraction(claim.counterexample["x"]["q"])) + 1 > 5
    assert interval is None


@pytest.mark.parametrize(("limit", "status"), [("2.7", "REFUTED"), ("2.760172", "REFUTED"), ("2.77", "PROVED")])
def test_a_limit_is_refuted_with_positions_at_which_it_is_exceeded(limit, status):
    """sin q + sin 2q and alpha = 1 reach 2.7601725 together."""
    claim, _ = _pendulum(lambda q: -ca.cos(q) - ca.cos(2 * q) / 2, limit)
    assert claim.status.name == status
    if status == "REFUTED":
        q = float(Fraction(claim.counterexample["x"]["q"]))
        assert math.sin(q) + math.sin(2 * q) + 1 > float(limit)


@pytest.mark.parametrize(
    ("V", "limit"),
    [
        (lambda q: 3 * ca.sin(q) + 4 * ca.cos(q), 6),  # one harmonic, with the amplitude 5
        (lambda q: ca.sin(q) + ca.sin(3 * q) / 3, 3),  # two that are largest together
        (lambda q: ca.sin(q) ** 2, 2),  # sin 2q
    ],
)
def test_a_force_that_touches_its_limit_respects_it(V, limit):
    claim, interval = _pendulum(V, limit)
    assert claim.status is Status.PROVED
    assert interval == [-limit, limit]
    tighter = Fraction(limit) * Fraction(999_999_999, 10**9)
    assert _pendulum(V, tighter)[0].status is not Status.PROVED


def test_a_limit_that_is_touched_where_harmonics_oppose_each_other():
    """cos q + cos 2q = 2 (cos q + 1/4)^2 - 9/8: less than the amplitudes allow."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    arm = Mechanical([q], [p], M=[1], V=ca.sin(q) + ca.sin(2 * q) / 2, D=[1], G=[1], inputs=["u"])
    law = PotentialCompensation(alpha=1, beta=1, K_c=1, R_c=1)

    def status(lowest):
        limits = Limits({"u": (lowest, 3)})
        design = Design(arm, {"q": 0}, law, limits=limits, sample_period="1e-3")
        return next(c.status for c in derive(design).claims if c.claim == "saturation")

    assert status("-2.125") is Status.PROVED
    assert status("-2.12499999999") is not Status.PROVED


def test_joints_that_share_their_load_touch_the_sum_of_their_amplitudes():
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    V = 4 * ca.sin(q[0]) + 3 * ca.sin(q[0] + q[1])
    arm = Mechanical(q, p, M=ca.SX.eye(2), V=V, D=[1, 1], G=ca.SX.eye(2))
    law = PotentialCompensation(alpha=[2, 1], beta=1, K_c=1, R_c=1)

    def status(first, second):
        limits = Limits([(-first, first), (-second, second)])
        design = Design(arm, {"q_0": 0, "q_1": 0}, law, limits=limits, sample_period="1e-3")
        return next(c.status for c in derive(design).claims if c.claim == "saturation")

    assert status(9, 4) is Status.PROVED
    assert status(Fraction("8.9999999999"), 4) is not Status.PROVED
    assert status(9, Fraction("3.9999999999")) is not Status.PROVED


def test_a_slope_that_touches_the_limit_inside_of_the_domain():
    """1 - q^2 on [-1, 1] is largest at 0 and least at both ends."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    arm = Mechanical([q], [p], M=[1], V=q - q**3 / 3, D=[1], G=[1], inputs=["u"], domain={"q": (-1, 1)})
    law = PotentialCompensation(alpha=1, beta=1, K_c=1, R_c=1)

    def status(lo, hi):
        design = Design(arm, {"q": 0}, law, limits=Limits({"u": (lo, hi)}), sample_period="1e-3")
        return next(c.status for c in derive(design).claims if c.claim == "saturation")

    assert status(-1, 2) is Status.PROVED
    assert status(-1, "1.9999999999") is not Status.PROVED
    assert status("-0.9999999999", 2) is not Status.PROVED


def test_an_unbounded_potential_is_bounded_on_its_domain():
    claim, interval = _pendulum(lambda q: q**2, 3, domain={"q": (-1, 1)})
    assert claim.status is Status.PROVED
    assert interval == [-3, 3]
    assert _pendulum(lambda q: q**2, "2.999", domain={"q": (-1, 1)})[0].status is not Status.PROVED


def spring(bound, alpha=2):
    """A driven mass on a spring, whose force is bounded on the domain of its position only."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    model = Mechanical(q=[q], p=[p], M=[1], V=3 * q**2 / 2, D=[2], G=[1], domain={"q": (-1, 1)}, inputs=["f"])
    law = PotentialCompensation(alpha=alpha, beta=1, K_c=1, R_c=1)
    return Design(model, target={"q": "0.5"}, law=law, limits=Limits.symmetric(bound), sample_period="1e-3")


def test_a_range_that_rests_on_a_domain_says_what_holds_beyond():
    claim = {c.claim: c for c in derive(spring(5)).claims}["saturation"]
    assert claim.status is Status.PROVED
    assert "the law itself stays within for q in the domain, beyond it the C cuts it off there" in claim.evidence


def test_the_amplitudes_of_the_hint_respect_the_limits():
    found = {c.claim: c for c in derive(spring(4)).claims}["saturation"]
    assert found.status is not Status.PROVED
    assert "these sums of alpha respect all limits: 1 for f" in found.hint
    assert {c.claim: c for c in derive(spring(4, alpha=1)).claims}["saturation"].status is Status.PROVED
