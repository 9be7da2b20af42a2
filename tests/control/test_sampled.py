"""Claims about the sampled loop: the Lyapunov route, the certified scan, delay, jitter and gain changes."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from pbcgen import Design, DynamicExtension, Limits, Mechanical, ModelError, NaturalDamping, PassiveOutput, pipeline
from pbcgen.control.derive import derive
from pbcgen.control.sampled import radius_text
from pbcgen.examples import path
from pbcgen.models.loader import load
from pbcgen.proof.claim import Status
from pbcgen.proof.spectrum import schur
from pbcgen.sampling.family import LoopFamily
from pbcgen.sampling.gain_change import gain_change, scaled
from pbcgen.sampling.jitter import jitter
from pbcgen.sampling.linearisation import Spectrum, delayed_matrix, period_matrix, radius_in_doubles, spectral
from pbcgen.sampling.scan import scan
from pbcgen.sampling.transition import LinearLoop, Transition
from pbcgen.symbolic.real import ball, precision, rational
from pbcgen.tuning.trial import Trial


def frictionless_arm(directory):
    """The arm as published: its joints have no friction."""
    text = path("pera").read_text(encoding="utf-8")
    text = text.replace("d_1=5,", "d_1=0,").replace("d_2=1,", "d_2=0,").replace('d_3="0.2"', "d_3=0")
    file = directory / "arm.py"
    file.write_text(text, encoding="utf-8")
    return load(file)


def two_masses(K_c, R_c, damping=(2, 3)):
    """Two masses on springs to a wall and to each other, both driven: m = 2, everything linear but the law."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    model = Mechanical(
        q=[q[0], q[1]],
        p=[p[0], p[1]],
        M=[1, 2],
        V=(q[0] ** 2 + (q[0] - q[1]) ** 2) / 2,
        D=list(damping),
        G=ca.SX.eye(2),
        measured={"a": q[0], "b": q[1]},
        inputs=["f1", "f2"],
    )
    return Design(
        model,
        target=[1, 1],
        law=DynamicExtension(alpha=[4, 4], beta=[5, 10], K_c=K_c, R_c=R_c),
        limits=Limits.symmetric(20),
        sample_period="1e-2",
        duration=5,
    )


def claims(design):
    return {c.claim: c for c in derive(design).claims}


def figures(design):
    return derive(design).derived["sample_periods"]


@pytest.fixture(scope="module")
def rlc():
    design = load("rlc")
    found = derive(design)
    return design, found.situation.loop


def test_coupling_device_bound_is_four_over_forty_five():
    design = load("coupling_device").with_(law=DynamicExtension(alpha=5, beta=450, K_c="1e6", R_c="0.3"))
    assert claims(design)["sampled-stable"].certificate["lyapunov_period"] == "4/45"


def test_the_bound_holds_for_full_K_c_and_R_c():
    diagonal = figures(two_masses(7, 3))["lyapunov_stable_to"]
    full = figures(two_masses([[7, 2], [2, 9]], [[3, 1], [1, 2]]))["lyapunov_stable_to"]
    # min(2 * 2 / 20, 2 * 3 / 40), whatever K_c and R_c are
    assert diagonal == pytest.approx(0.15, rel=1e-8)
    assert full == diagonal


def test_without_damping_of_the_port_there_is_no_lyapunov_route():
    claim = claims(two_masses(7, 3, damping=(0, 3)))["sampled-stable"]
    assert "no Lyapunov route" in claim.evidence


def test_compensation_pays_for_the_softest_potential():
    # 2 D - h (alpha beta + L) with L = m g d on the elbow only; joint 3 decides: 2 * 0.2 / 264
    assert figures(load("pera"))["lyapunov_stable_to"] == pytest.approx(0.4 / 264, rel=1e-8)


def test_natural_damping_needs_theta_with_the_damping_that_sampling_leaves():
    law = NaturalDamping(alpha_c="2.5", beta_c=450, K_c="1e6", R_c="0.3", alpha_l="2.5", beta_l=1000, K_l=1, R_l=500)
    h = figures(load("coupling_device").with_(law=law))["lyapunov_stable_to"]
    Lambda_l, Lambda_c = 6e-4, 100 - h / 2 * (2.5 * 450 + 2.5 * 1000)
    assert (1 / Lambda_l + 1 / Lambda_c) / 4 == pytest.approx(500, rel=1e-5)


def storage_run(design, h, steps):
    """V after each step of the controller, on the nonlinear sampled loop."""
    design = design.with_(sample_period=h)
    found = derive(design)
    trial = Trial(found.plant, found.point, found.gamma, found.eta, design, found.law, steps=200)
    z = np.concatenate([[float(v) for v in design.initial], np.zeros(1)])
    law, system = design.law, design.system
    gamma = trial.plant.numeric(found.gamma, system.S)
    star = float(gamma(*[[float(v) for v in part] for part in (found.loop.x_star, found.loop.u_star)])[0])
    values = []
    gains = [float(v) for v in (law.alpha[0], law.beta[0], law.K_c[0][0], law.R_c[0][0])]
    for _ in range(steps):
        after = np.array(trial._step(z, gains, [0.0])[0]).ravel()
        # the state before the plant moved, with the controller already advanced
        g, S = (float(v) for v in gamma(z[:-1], found.loop.u_star))
        x_c = after[-1]
        values.append(S - found.loop.u_star[0] * g + gains[0] / gains[1] * np.log(np.cosh(gains[1] * (g - star + x_c))))
        values[-1] += gains[2] * x_c**2 / 2
        z = after
    return np.array(values)


def test_the_storage_falls_below_the_bound_and_grows_far_beyond_it():
    design = load("elastic_pendulum")
    below = storage_run(design, "0.008", 400)
    assert np.all(np.diff(below) <= 1e-12)
    assert np.any(np.diff(storage_run(design, "0.08", 60)) > 1e-6)


def step_of_the_graph(found, h):
    """M(h) from the formulas that the C is written from, in double precision."""
    graph, system = found.graph, found.design.system
    discrete = graph.discretise(h)
    symbols = [graph.m, graph.xi, graph.t]
    parts = graph.rounded(discrete.N, discrete.c, discrete.next_state, discrete.output)
    slopes = [ca.jacobian(part, symbol) for part in parts[1:] for symbol in symbols]
    measured = np.array(found.loop.measure(found.loop.x_star)).ravel()
    at_target = ca.Function("slopes", symbols, [parts[0], *slopes])
    zeros = [np.zeros(symbol.numel()) for symbol in symbols[1:]]
    N, c_m, c_xi, _, x_m, x_xi, x_t, u_m, u_xi, u_t = (np.array(v) for v in at_target(measured, *zeros))
    solve = np.linalg.inv(np.eye(len(N)) + N)
    x_m, x_xi = x_m + x_t @ solve @ c_m, x_xi + x_t @ solve @ c_xi
    u_m, u_xi = u_m + u_t @ solve @ c_m, u_xi + u_t @ solve @ c_xi
    x, u = system.x, system.u
    slope = ca.Function("plant", [x, u], [ca.jacobian(found.loop.plant(x, u), v) for v in (x, u)])
    A, B = (np.array(v) for v in slope(found.loop.x_star, found.loop.u_star))
    H = np.array(ca.Function("sensors", [x], [ca.jacobian(found.loop.measure(x), x)])(found.loop.x_star))
    n, m = B.shape
    hold = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * float(h))
    Ad, Bd = hold[:n, :n], hold[:n, n:]
    return np.block([[Ad + Bd @ u_m @ H, Bd @ u_xi], [x_m @ H, x_xi]])


@pytest.mark.parametrize("model", ["coupling_device", "pera_integral", "two_masses"])
def test_the_analysed_step_is_the_step_that_is_emitted(model):
    full = two_masses([[7, 2], [2, 9]], [[3, 1], [1, 2]])
    found = derive(full if model == "two_masses" else load(model))
    h = found.design.sample_period
    exact = np.array([[float(ball(v).mid()) for v in row] for row in period_matrix(found.situation.loop, h)])
    emitted = step_of_the_graph(found, h)
    assert np.allclose(exact, emitted, rtol=1e-9, atol=1e-9 * np.max(np.abs(emitted)))


@pytest.mark.system
def test_gains_beyond_double_precision_are_linearised_exactly():
    # alpha beta K_c is lost in a product of doubles: rounded, the loop would have an eigenvalue of +1.8e7
    design = two_masses(7, 3).with_(law=DynamicExtension(alpha=4, beta="1e30", K_c=7, R_c=3))
    found = claims(design)
    assert found["asymptotically-stable"].status is Status.PROVED
    assert "-0.84" in found["asymptotically-stable"].evidence


def test_a_period_beyond_all_numbers_is_refused_with_the_largest_that_is_proved():
    design = load("elastic_pendulum").with_(sample_period="1e6")
    claim = claims(design)["sampled-stable"]
    assert claim.status is Status.UNDECIDED
    assert "spectral radius unknown" in claim.evidence
    assert "sample at h = 0.0258 s or faster" in claim.hint


def test_an_unstable_loop_has_no_largest_sample_period():
    design = load("elastic_pendulum").with_(law=DynamicExtension(alpha=3, beta="0.1", K_c=12, R_c=1))
    found = derive(design)
    claim = {c.claim: c for c in found.claims}["sampled-stable"]
    assert claim.status is Status.REFUTED
    assert found.derived["max_sample_period"] is None
    assert "no range of short periods was proved for the linearised loop: it is unstable at" in claim.evidence


def test_a_radius_shows_on_which_side_of_one_it_lies():
    assert radius_text(1 - 1.25e-10) == "1 - 1.3e-10"
    assert radius_text(1 + 2e-9) == "1 + 2e-09"
    assert radius_text(0.25) == "0.25"


@pytest.mark.parametrize("damping", [(2, 3), (2, 2), ("1e-6", "1e-6"), (1000, 1)])
def test_the_largest_period_is_not_below_one_that_is_proved(damping):
    # nearly equal and very slow modes, whose radius rounds to one
    design = two_masses(7, "1e-6", damping=[float(v) for v in damping])
    found = derive(design)
    figures, largest = found.derived["sample_periods"], found.derived["max_sample_period"]
    assert figures["spectral_stable_to"] >= figures["lyapunov_stable_to"]
    assert largest is None or largest >= figures["spectral_stable_to"]


def test_the_scan_ends_where_the_loop_becomes_unstable(rlc):
    design, linear = rlc
    found = scan(linear, design.sample_period * 10**4)
    assert float(found.stable_to) == pytest.approx(0.38e-3, rel=0.01)
    assert found.stable_to < found.unstable_at < found.stable_to * Fraction(1001, 1000)
    assert schur(delayed_matrix(linear, found.unstable_at)).status is Status.REFUTED


def test_cells_overlap_from_zero_and_are_stable_inside(rlc):
    design, linear = rlc
    found = scan(linear, design.sample_period * 10**4)
    assert found.cells[0][0] == 0
    assert all(a[1] == b[0] for a, b in zip(found.cells, found.cells[1:], strict=False))
    for lo, hi in found.cells[1::4]:
        assert schur(delayed_matrix(linear, lo + (hi - lo) / 3)).status is Status.PROVED


def test_a_window_of_instability_is_not_jumped():
    # A lightly damped oscillator sampled near multiples of its half period: stable, unstable, stable again.
    one, zero = rational(Fraction(1)), rational(Fraction(0))
    small = rational(Fraction(1, 50))
    loop = LinearLoop(
        [[zero, one], [-one, -small]], [[zero], [one]], [[one, zero]], [], [], [[rational(Fraction(-1, 10))]], [[]]
    )
    found = scan(loop, Fraction(10))
    first = found.unstable_at
    statuses = [schur(delayed_matrix(loop, Fraction(k, 10))).status for k in range(1, 100)]
    assert Status.REFUTED in statuses
    assert Status.PROVED in statuses[int(first * 10) :]
    assert found.stable_to < first < Fraction(statuses.index(Status.REFUTED) + 1, 10)


def test_delay_takes_from_the_period(rlc):
    design, linear = rlc
    ends = [
        float(scan(linear, Fraction(1, 100), delay=d, start=design.sample_period / 100).stable_to)
        for d in (Fraction(0), Fraction(1, 2), Fraction(1), Fraction(2))
    ]
    assert ends == sorted(ends, reverse=True)
    assert ends[3] < ends[0] / 2


def test_a_delay_of_one_sample_is_that_of_a_shifted_input(rlc):
    _, linear = rlc
    h = Fraction(1, 10**4)
    with precision(200):
        M = Transition(linear, Fraction(1)).jet(ball(rational(h))).c0
        nearly = Transition(linear, Fraction(999999, 10**6)).jet(ball(rational(h))).c0
        radii = [max(float(v.abs_upper()) for v in m.eig(algorithm="approx")) for m in (M, nearly)]
    assert radii[0] == pytest.approx(radii[1], abs=1e-6)


def test_jitter_has_a_common_storage(rlc):
    design, linear = rlc
    h = design.sample_period
    assert jitter(linear, h, Fraction(1, 10)).status is Status.PROVED
    beyond = jitter(linear, h * 3, Fraction(1, 2))  # the upper end is unstable
    assert beyond.status is Status.UNDECIDED
    assert 0 < beyond.share < Fraction(381, 300) - 1


@pytest.mark.system
def test_half_a_period_of_jitter_on_the_coupling_device():
    claim = claims(load("coupling_device").with_(jitter="0.5"))["sampled-stable"]
    assert claim.status is Status.PROVED
    assert "one quadratic storage serves all h in [0.0005, 0.0015] s" in claim.evidence


@pytest.mark.system
def test_the_storage_of_jitter_decreases_along_random_periods():
    found = derive(load("coupling_device"))
    h, loop = found.design.sample_period, found.situation.loop
    factor = jitter(loop, h, Fraction(1, 2)).storage
    generator = np.random.default_rng(1)
    with precision(300):
        transition = Transition(loop, steps=h)
        for share in generator.uniform(0.5, 1.5, 20):
            M = transition.real(transition.jet(ball(rational(h * Fraction(share))))).c0
            N = factor @ np.array([[float(v.mid()) for v in row] for row in M.tolist()]) @ np.linalg.inv(factor)
            assert np.linalg.norm(N, 2) < 1


def test_too_much_jitter_is_refused_with_what_is_proved():
    claim = claims(load("rlc").with_(sample_period="3e-4", jitter="0.5"))["sampled-stable"]
    assert claim.status is Status.UNDECIDED
    assert "keep the periods within" in claim.hint


def test_options_of_sampling_are_checked():
    for wrong in ({"delay": 3}, {"delay": -1}, {"jitter": 1}, {"jitter": "-0.1"}):
        with pytest.raises(ModelError, match=r"(was|were) expected"):
            load("rlc").with_(**wrong)


@pytest.mark.system
def test_frictionless_arm_at_1_khz_is_refused_with_period_and_gain_change(tmp_path):
    design = frictionless_arm(tmp_path)
    report = pipeline.check(design)
    claim = {c.claim: c for c in report.claims}["sampled-stable"]
    assert claim.status is Status.REFUTED
    assert report.derived["max_sample_period"] == pytest.approx(0.211e-3, rel=1e-3)
    assert "0.00021 s or faster" in claim.hint
    assert "multiply R_c by 5" in claim.hint
    changed = design.with_(law=scaled(design.law.resolve(3), {"R_c": Fraction(5)}))
    assert claims(changed)["sampled-stable"].status is Status.PROVED


def test_a_gain_change_is_proved_for_the_wished_period():
    design = load("rlc").with_(law=DynamicExtension(alpha="0.0485", beta=100, K_c=10, R_c=10))
    found = derive(design)
    family = LoopFamily.of(found.plant, found.point, found.gamma, found.eta)
    change = gain_change(family, found.law, design.sample_period)
    assert change is not None
    assert schur(delayed_matrix(family.loop(change.law), design.sample_period)).status is Status.PROVED
    assert schur(delayed_matrix(family.loop(found.law), design.sample_period)).status is Status.REFUTED


@pytest.mark.parametrize("name", ["coupling_device", "rlc", "pera_integral", "passive output"])
def test_gains_are_left_out_only_where_the_spectral_radius_is_beyond_one(name):
    if name == "passive output":
        q, p = ca.SX.sym("q"), ca.SX.sym("p")
        system = Mechanical([q], [p], M=[1], V=q**2, D=[1], G=[1], measured=["q", "p"])
        design = Design(system, {"q": 0}, PassiveOutput(alpha=4, beta=5, k_p=1), sample_period="1e-2")
    else:
        design = load(path(name))
    loop = derive(design).situation.loop
    spectrum, seen = Spectrum(loop.A), set()
    for factor in (1, 10, 30, 1000):
        h = design.sample_period * factor
        found, beyond = spectral(loop, h), spectrum.beyond(loop, h)
        assert beyond == pytest.approx(found.extreme - 1, rel=1e-6, abs=1e-9)
        assert radius_in_doubles(loop, h) == pytest.approx(found.extreme, rel=1e-6)
        assert (beyond > 0.01) <= (found.status is Status.REFUTED)
        seen.add(found.status)
    assert seen == {Status.PROVED, Status.REFUTED}
