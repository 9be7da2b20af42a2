"""What docs/paper.md says of the published examples is what the generated C and the continuous law do."""

import pytest

from pbcgen import DynamicExtension, pipeline
from pbcgen.models.loader import load
from pbcgen.proof.claim import Status
from pbcgen.report import paper_figures as figures

# The simulations take most of a minute and are shared: all in one worker.
pytestmark = [pytest.mark.system, pytest.mark.xdist_group("paper")]


@pytest.fixture(scope="module")
def facts():
    return figures.facts()


def test_without_natural_damping_the_first_mass_settles_and_the_second_oscillates(facts):
    assert facts["coupling free: overshoot of x2"] < 1e-4
    assert facts["coupling free: overshoot of x3"] == pytest.approx(0.326, abs=5e-4)
    assert facts["coupling free: turning points of x3"] == 27
    assert facts["coupling free: x3 at 20 s"] == pytest.approx(0.0213161, abs=1e-6)
    assert facts["coupling free: settling time of x3"] == float("inf")


def test_with_natural_damping_the_second_mass_settles(facts):
    assert facts["coupling damped: settling time of x3"] == pytest.approx(10.8, abs=0.1)
    assert facts["coupling damped: x3 at 20 s"] == pytest.approx(0.02496592, abs=1e-7)


@pytest.mark.parametrize(("volts", "peak", "mode"), [(5, 31.66, -0.2993), (7.5, 30.40, -0.2711), (10, 30.91, -0.2308)])
def test_the_control_saturates_at_the_stated_limit_and_the_masses_hardly_notice(facts, volts, peak, mode):
    assert facts[f"coupling {volts:g} V: largest input, C"] == pytest.approx(volts, rel=1e-6)
    assert facts[f"coupling {volts:g} V: largest input, C"] <= volts
    assert 1e3 * facts[f"coupling {volts:g} V: peak of x3"] == pytest.approx(peak, abs=0.01)
    assert facts[f"coupling {volts:g} V: slowest mode"] == pytest.approx(mode, abs=1e-4)


def test_the_published_gains_do_not_satisfy_theta():
    (theta,) = (c for c in figures.coupling_with_damping(5.0).report.claims if c.claim == "theta")
    assert theta.status is Status.REFUTED
    assert "416.67" in theta.evidence or "416.669" in theta.evidence


def test_larger_beta_saturates_more_often(facts):
    entries = [facts[f"circuit {beta}: entries into saturation"] for beta in (1, 10, 100)]
    assert entries == [4, 9, 26]
    for band in (0.002, 0.005, 0.02):
        counted = [
            figures.saturation_entries(figures.circuit(b).continuous.u[:, 0], *figures.circuit(b).limits, band)
            for b in (1, 10, 100)
        ]
        assert counted == sorted(set(counted)), "the order does not depend on what counts as saturated"


@pytest.mark.parametrize("beta", [1, 10, 100])
def test_the_source_reaches_its_limits_and_never_passes_them(facts, beta):
    lo, hi = facts[f"circuit {beta}: smallest input, C"], facts[f"circuit {beta}: largest input, C"]
    assert 3.003 <= lo < 3.0031
    assert 3.0999 < hi <= 3.1
    assert facts[f"circuit {beta}: load current at the end"] == pytest.approx(0.0199984, abs=1e-7)


def test_dry_friction_leaves_an_error_that_the_filter_removes(facts):
    assert facts["pera: final error of q1, C"] == pytest.approx(-0.142, abs=0.002)
    assert 0.005 < abs(facts["pera: final error of q3, C"]) < 0.01
    for k in (1, 2, 3):
        assert abs(facts[f"pera_integral: final error of q{k}, C"]) < 1e-4


@pytest.mark.parametrize("name", ["pera", "pera_integral"])
def test_the_torques_respect_the_motors(facts, name):
    assert 16.9 < facts[f"{name}: largest input u1, C"] <= 17
    assert facts[f"{name}: largest abs(u2) + abs(u3), C"] <= 7.87


def test_the_published_arm_without_friction_is_not_stable_at_one_kilohertz():
    pera = load("pera")
    parameters = pera.system.parameters.with_values(d_1="0", d_2="0", d_3="0")
    model = pera.model
    frictionless = type(model)(
        model.q,
        model.p,
        M=model.parts.M,
        V=model.parts.V,
        G=model.parts.G,
        parameters=parameters,
        inputs=["u1", "u2", "u3"],
    )
    report = pipeline.check(pera.with_(system=frictionless))
    (sampled,) = (c for c in report.claims if c.claim == "sampled-stable")
    assert sampled.status is not Status.PROVED
    assert report.derived["max_sample_period"] == pytest.approx(2.1e-4, rel=0.05)


def test_twenty_milliamperes_exactly_would_break_the_limit():
    import casadi as ca

    rlc = load("rlc")
    p, x3 = rlc.system.parameters, rlc.system.x[2]
    target = {"load current": (p.a * (ca.exp(x3 / p.b) - 1), "0.02")}
    report = pipeline.check(rlc.with_(target=target, law=DynamicExtension("0.0485", 1, 10, 10)))
    (saturation,) = (c for c in report.claims if c.claim == "saturation")
    assert saturation.status is Status.REFUTED
    assert report.derived["input_intervals"][0][1] - 3.1 == pytest.approx(1.9e-5, abs=1e-6)


def test_every_figure_is_drawn():
    drawn = figures.figures()
    assert set(drawn) == {
        "coupling_damping",
        "coupling_masses",
        "coupling_control",
        "circuit_figure",
        "arm_positions",
        "arm_torques",
    }
    limits = [line for axes in drawn["coupling_control"].axes for line in axes.lines if line.get_linestyle() == ":"]
    assert len(limits) == 12, "three pairs of dotted limits in both panels"
    assert drawn["coupling_control"].axes[1].get_xlim() == (0, 2)
