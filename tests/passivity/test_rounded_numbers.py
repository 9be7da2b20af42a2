"""Numbers that were rounded before the model was made: no wrong verdict, and a hint."""

import casadi as ca
import pytest

from pbcgen import AffineSystem, Mechanical, Parameters
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.storage import assumption_1
from pbcgen.proof.claim import Status


def _lossless(a, b, c, friction=0.7, **options):
    """f = (J - R) grad S with R = diag(0, friction), as CasADi differentiates S."""
    x = ca.SX.sym("x", 2)
    S = a * (b * x[0] ** 2) / 2 + c * (1.7 * x[1] ** 2) / 2
    f = ca.mtimes(ca.SX([[0, 1.3], [-1.3, -friction]]), ca.gradient(S, x))
    return Plant(AffineSystem(x, [ca.SX.sym("u")], f, [1, 0], S, **options))


@pytest.mark.parametrize("numbers", [(0.7, 3, 0.9), (0.123456789, 1.25, 0.5), (0.7 / 3, 1, 0.9 / 11)])
def test_numbers_that_can_be_read_as_written_lose_nothing(numbers):
    assert assumption_1(_lossless(*numbers)).claim.status is Status.PROVED


@pytest.mark.parametrize(
    "numbers", [(2**0.5, 3**0.5, 0.3**0.5), (0.7 / 13, 1 / 7.3, 0.9 / 1.7), (5**0.5, 1 / 7**0.5, 1)]
)
def test_rounding_alone_refutes_nothing(numbers):
    claim = assumption_1(_lossless(*numbers)).claim
    assert claim.status is Status.UNDECIDED or claim.status is Status.PROVED
    if claim.status is Status.UNDECIDED:
        assert "declare the constants of the model with Parameters(...)" in claim.hint


def test_some_of_these_are_left_open():
    assert assumption_1(_lossless(2**0.5, 3**0.5, 0.3**0.5)).claim.status is Status.UNDECIDED


def test_parameters_mend_it():
    p = Parameters(a=2**0.5, b=3**0.5, c=0.3**0.5)
    assert assumption_1(_lossless(p.a, p.b, p.c, parameters=p)).claim.status is Status.PROVED


@pytest.mark.parametrize("friction", [-0.7, -1e-6])
def test_a_defect_beyond_rounding_is_refuted_all_the_same(friction):
    claim = assumption_1(_lossless(2**0.5, 3**0.5, 0.3**0.5, friction)).claim
    assert claim.status is Status.REFUTED


@pytest.mark.parametrize(
    ("friction", "status"),
    [("0.4", Status.PROVED), ("0.40000000000000001", Status.PROVED), ("0.39999999999999999", Status.REFUTED)],
)
def test_the_symmetric_part_of_a_factor_is_not_rounded(friction, status):
    """B = [[0.4, 0.4], [0.4, friction]], where 0.4 = (0.7 + 0.1) / 2, which doubles make 0.39999999999999997."""
    x, p = ca.SX.sym("x", 2), Parameters(friction=friction)
    S = 1.3 * x[0] ** 4 / 4 + x[0] ** 2 / 2 + x[1] ** 2 / 2
    f = [-(0.52 * x[0] ** 3 + 0.4 * x[0]) - 0.7 * x[1], -(0.13 * x[0] ** 3 + 0.1 * x[0]) - p.friction * x[1]]
    claim = assumption_1(Plant(AffineSystem(x, [ca.SX.sym("u")], f, [0, 1], S, parameters=p))).claim
    assert claim.status is status


def _resting_at(V):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    return assumption_1(Plant(Mechanical([q], [p], M=[1], V=V(q), D=[1], G=[1]).lower())).claim


def test_the_logarithm_of_a_base_is_not_rounded():
    assert _resting_at(lambda q: 2 * q**2 + 0.1 * 2**q).status is Status.PROVED
    assert _resting_at(lambda q: 2 * q**2 + 3 ** (2 * q)).status is Status.PROVED


def test_a_number_that_casadi_rounds_in_a_derivative_proves_nothing():
    """The derivative of erf has the factor 2/sqrt(pi), to sixteen digits."""
    claim = _resting_at(lambda q: 2 * q**2 + ca.erf(q))
    assert claim.status is Status.UNDECIDED
    assert "rounded a number" in claim.evidence
