"""What is derived of the three systems of the paper: formulas exactly, numbers as computed independently.

The independent numbers come from trajectories at a relative tolerance of 1e-10 and from eigenvalues with 40 to 80
digits of the closed loops written out by hand.
"""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from variants import WITHOUT_FRICTION, WITHOUT_X_L, continuous, coupling, derivation, design, status

from pbcgen import Design, DynamicExtension
from pbcgen.control.derive import derive
from pbcgen.symbolic.real import approximate


def _is_exactly(name, expression, expected):
    """Whether two expressions are the same function of state and parameters."""
    plant = derivation(name).plant
    field, (difference,) = plant.exact(expression - expected, symbolic=True)
    return all(entry.is_zero() for entry in difference.column(field.const(0)))


def _claim(name, claim, changes=()):
    return {c.claim: c for c in derivation(name, changes).claims}[claim]


# --- coupling device ---------------------------------------------------------------------------------------------


def test_gamma_of_the_coupling_device():
    p = design("coupling_device").system.parameters
    x = design("coupling_device").system.x
    gamma = derivation("coupling_device").gamma
    expected = p.R2 / (p.R1 + p.R2) * x[0] + x[1] / (p.a0 * (p.R1 + p.R2))
    assert _is_exactly("coupling_device", gamma, expected)
    assert _is_exactly("coupling_device", derivation("coupling_device").eta, x[2])
    assert derivation("coupling_device").derived["kappa"] == [0.0]


def test_the_feedthrough_of_the_coupling_device():
    """w^T w = R2 / (R1 (R1 + R2)): its output needs w."""
    system = design("coupling_device").system
    p = system.parameters
    feedthrough = ca.mtimes(ca.jacobian(derivation("coupling_device").gamma, system.x), system.g)
    assert _is_exactly("coupling_device", feedthrough, p.R2 / (p.R1 * (p.R1 + p.R2)))


def test_any_k_c_does_for_the_coupling_device():
    assert derivation("coupling_device").derived["kc_min"] == 0
    assert status("coupling_device", "kc-bound") == "PROVED"


def test_theta_of_the_paper_gains_is_refuted_with_the_bound():
    """(1/Lambda_l + 1/Lambda_c)/4 = (1/6e-4 + 1/100)/4; the paper has K_l R_l = 5.5e-4 * 33."""
    derived = derivation("coupling_device").derived
    assert derived["Lambda_l"] == [6e-4]
    assert derived["Lambda_c"] == [100.0]
    assert derived["theta_bound"] == pytest.approx(float(Fraction(1, 4) * (Fraction(10000, 6) + Fraction(1, 100))))
    claim = _claim("coupling_device", "theta")
    assert str(claim.status) == "REFUTED"
    assert Fraction(claim.counterexample["Theta form"]) < 0


def test_the_coupling_device_is_stable_by_linearisation_although_theta_fails():
    claim = _claim("coupling_device", "asymptotically-stable")
    assert str(claim.status) == "PROVED"
    assert "linearisation" in claim.method
    assert "theta" in claim.evidence
    assert status("coupling_device", "globally-asymptotically-stable") != "PROVED"


@pytest.mark.system
@pytest.mark.parametrize(("alpha", "abscissa"), [("2.5", -0.2993), ("3.75", -0.2711), ("5", -0.2308)])
def test_spectral_abscissa_of_the_coupling_device(alpha, abscissa):
    changes = () if alpha == "2.5" else coupling(alpha)
    assert derivation("coupling_device", changes).derived["spectral_abscissa"] == pytest.approx(abscissa, abs=5e-5)


@pytest.mark.system
@pytest.mark.parametrize(("alpha", "largest"), [("2.5", 0.2404), ("5", 0.1807)])
def test_longest_sample_period_of_the_coupling_device(alpha, largest):
    changes = () if alpha == "2.5" else coupling(alpha)
    found = derivation("coupling_device", changes).derived["max_sample_period"]
    assert found == pytest.approx(largest, rel=1e-3)


def _settling_time(times, values, target):
    outside = np.flatnonzero(np.abs(values - target) > 0.02 * abs(target))
    return times[outside[-1] + 1]


@pytest.mark.system
def test_trajectory_of_the_coupling_device():
    run = continuous("coupling_device")
    assert run.x[:, 2].max() == pytest.approx(31.66e-3, abs=5e-6)
    assert _settling_time(run.times, run.x[:, 2], 0.025) == pytest.approx(10.8, abs=0.05)
    np.testing.assert_allclose(run.x[-1][:3], [-9.705e-7, 0.02500453, 0.02496592], rtol=1e-4)
    np.testing.assert_allclose(run.x[-1][3:], [-2.2e-7, 7.0e-8], rtol=2e-2)
    assert np.abs(run.u).max() <= 5


@pytest.mark.system
@pytest.mark.parametrize(("alpha", "peak", "bound"), [("3.75", 30.40e-3, 7.5), ("5", 30.91e-3, 10)])
def test_larger_amplitudes_of_the_coupling_device(alpha, peak, bound):
    run = continuous("coupling_device", coupling(alpha))
    assert run.x[:, 2].max() == pytest.approx(peak, abs=5e-6)
    assert np.abs(run.u).max() == pytest.approx(bound, rel=1e-6)
    assert np.abs(run.u).max() <= bound


@pytest.mark.system
def test_without_x_l_the_second_mass_of_the_coupling_device_oscillates():
    run = continuous("coupling_device", WITHOUT_X_L)
    x2, x3 = run.x[:, 1], run.x[:, 2]
    assert x3[-1] == pytest.approx(0.0213161, abs=5e-8)
    assert x3.max() == pytest.approx(33.15e-3, abs=5e-6)
    turns = np.diff(np.sign(np.diff(x3)))
    assert np.count_nonzero(turns) == 27
    assert x2.max() < 0.025 * 1.0001


# --- RLC circuit -------------------------------------------------------------------------------------------------


def test_gamma_and_kappa_of_the_circuit():
    system = design("rlc").system
    assert _is_exactly("rlc", derivation("rlc").gamma, system.x[2] / system.parameters.L1)
    assert derivation("rlc").derived["kappa"] == [-3.0515]
    assert status("rlc", "stable") == "PROVED"


def test_the_interval_of_the_circuit_touches_the_limit_and_is_accepted():
    claim = _claim("rlc", "saturation")
    assert str(claim.status) == "PROVED"
    assert derivation("rlc").derived["input_intervals"] == [[3.003, 3.1]]


def test_a_slightly_larger_amplitude_of_the_circuit_is_refused():
    changes = (('alpha="0.0485"', 'alpha="0.0485000000001"'),)
    assert status("rlc", "saturation", changes) == "REFUTED"


@pytest.mark.system
def test_20_ma_exactly_is_refused_by_19_microvolts():
    """x3* = ln(200001)/4 = 3.0515194 V, and 3.0515194 + 0.0485 - 3.1 = 1.9e-5."""
    base = design("rlc")
    p, x3 = base.system.parameters, base.system.x[2]
    target = {"i_D": (p.a * (ca.exp(x3 / p.b) - 1), "0.02")}
    exact = Design(
        base.model, target=target, law=base.law, limits=base.limits, sample_period="1e-4", name="twenty milliamperes"
    )
    found = derive(exact)
    claims = {c.claim: c for c in found.claims}
    assert str(claims["equilibrium"].status) == "PROVED"
    assert str(claims["saturation"].status) == "REFUTED"
    assert float(claims["saturation"].counterexample["excess"]) == pytest.approx(1.94114e-5, rel=1e-4)
    np.testing.assert_allclose(
        [approximate(v) for v in found.point.x], [0.050515194, 0.030515194, 3.0515194], rtol=2e-8
    )


@pytest.mark.system
@pytest.mark.parametrize(("beta", "largest"), [(1, 3.804e-4), (10, 3.554e-5), (100, 3.737e-6)])
def test_longest_sample_period_of_the_circuit(beta, largest):
    """Eigenvalues with 40 digits: the radius passes one at 380.4 us, 35.54 us and 3.737 us."""
    changes = () if beta == 1 else (("beta=1,", f"beta={beta},"),)
    assert derivation("rlc", changes).derived["max_sample_period"] == pytest.approx(largest, rel=5e-4)
    assert status("rlc", "sampled-stable", changes) == ("PROVED" if beta == 1 else "REFUTED")


@pytest.mark.system
def test_a_larger_beta_saturates_more_often():
    entries = []
    for beta in (1, 10, 100):
        run = continuous("rlc", () if beta == 1 else (("beta=1,", f"beta={beta},"),))
        u = run.u[:, 0]
        assert u.min() >= 3.003 - 1e-12
        assert u.max() <= 3.1 + 1e-12
        saturated = np.abs(u - 3.0515) > 0.99 * 0.0485
        entries.append(int(saturated[0]) + int(np.count_nonzero(~saturated[:-1] & saturated[1:])))
    assert entries == [4, 8, 24]


# --- robot arm ---------------------------------------------------------------------------------------------------


@pytest.mark.system
@pytest.mark.parametrize("name", ["pera", "pera_integral"])
def test_gamma_of_the_arm_are_the_joint_angles(name):
    assert _is_exactly(name, derivation(name).gamma, design(name).system.x[:3])


@pytest.mark.system
def test_the_torques_of_the_arm_respect_the_differential_drives():
    """u1 <= 17; u2 and u3 reach 3 + m3 g d = 4.5696 and 3.3, together 7.8696 < 7.901."""
    intervals = derivation("pera").derived["input_intervals"]
    np.testing.assert_allclose(intervals, [[-17, 17], [-4.5696, 4.5696], [-3.3, 3.3]], rtol=1e-12)
    assert status("pera", "saturation") == "PROVED"
    assert status("pera", "saturation", (('["17.1007", "7.901", "7.901"]', '["17.1007", "7.8695", "7.901"]'),)) != (
        "PROVED"
    )


@pytest.mark.system
def test_without_friction_the_gains_of_the_arm_are_refused_at_1_khz():
    derived = derivation("pera", WITHOUT_FRICTION).derived
    assert derived["max_sample_period"] == pytest.approx(0.21e-3, rel=1e-2)
    assert status("pera", "asymptotically-stable", WITHOUT_FRICTION) == "PROVED"
    claim = _claim("pera", "sampled-stable", WITHOUT_FRICTION)
    assert str(claim.status) == "REFUTED"
    assert claim.hint


@pytest.mark.system
def test_with_friction_the_gains_of_the_arm_are_accepted_at_1_khz():
    assert status("pera", "sampled-stable") == "PROVED"
    assert status("pera_integral", "sampled-stable") == "PROVED"


@pytest.mark.system
def test_the_linearised_arm_with_the_integral_filter():
    """(linPERA) without friction."""
    derived = derivation("pera_integral", WITHOUT_FRICTION).derived
    assert derived["spectral_abscissa"] == pytest.approx(-0.0919, abs=5e-5)
    assert status("pera_integral", "asymptotically-stable", WITHOUT_FRICTION) == "PROVED"
    assert status("pera_integral", "globally-asymptotically-stable", WITHOUT_FRICTION) != "PROVED"


# --- elastic pendulum: the tutorial ------------------------------------------------------------------------------


def _stiffness(k, unstable):
    """det [[k - w, -k], [-k, k + ab]] = (k - w)(k + ab) - k^2 = 0 at ab = k w / (k - w), for w = m g l < k."""
    return k * unstable / (k - unstable)


THRESHOLD = _stiffness(Fraction(6), Fraction(1, 2) * Fraction("9.81") * Fraction(3, 10))


def _pendulum(alpha_beta, K_c):
    law = DynamicExtension(alpha=1, beta=alpha_beta, K_c=K_c, R_c=1)
    base = design("elastic_pendulum")
    tuned = Design(base.model, target={"link": 0}, law=law, sample_period="1e-3", name="pendulum")
    return {c.claim: c for c in derive(tuned).claims}


def test_the_threshold_of_the_elastic_pendulum():
    assert float(THRESHOLD) == pytest.approx(1.94965220, rel=1e-8)
    assert derivation("elastic_pendulum").derived["alpha_beta_min"] == pytest.approx(float(THRESHOLD), rel=1e-12)


def test_the_elastic_pendulum_just_below_its_threshold_is_refuted():
    claims = _pendulum(THRESHOLD * (1 - Fraction(1, 10**6)), 10**9)
    assert str(claims["hessian-condition"].status) == "REFUTED"
    assert str(claims["stable"].status) == "REFUTED"
    assert str(claims["asymptotically-stable"].status) == "REFUTED"


def test_the_elastic_pendulum_just_above_its_threshold_is_proved():
    claims = _pendulum(THRESHOLD * (1 + Fraction(1, 10**6)), 10**9)
    assert str(claims["hessian-condition"].status) == "PROVED"
    assert str(claims["kc-bound"].status) == "PROVED"
    assert str(claims["stable"].status) == "PROVED"
    assert str(claims["asymptotically-stable"].status) == "PROVED"


@pytest.mark.parametrize(("side", "expected"), [(-1, "REFUTED"), (1, "PROVED")])
def test_the_filter_yields_like_a_spring_in_series(side, expected):
    """With ab = 2 thresholds, ab K_c / (ab + K_c) exceeds the threshold iff K_c exceeds 2 thresholds."""
    claims = _pendulum(2 * THRESHOLD, 2 * THRESHOLD * (1 + side * Fraction(1, 10**6)))
    assert str(claims["hessian-condition"].status) == "PROVED"
    assert str(claims["kc-bound"].status) == expected
    assert str(claims["stable"].status) == expected


def test_at_the_threshold_semidefinite_is_not_definite():
    claims = _pendulum(THRESHOLD, 10**9)
    assert str(claims["hessian-condition"].status) == "REFUTED"
    assert str(claims["stable"].status) != "PROVED"
