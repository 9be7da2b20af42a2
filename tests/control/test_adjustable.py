"""Targets and gains that a running controller may be given: what is proved of the box, and what is refused."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Limits, NaturalDamping, pipeline
from pbcgen.control.box import _Box
from pbcgen.control.cells import Loops
from pbcgen.control.sampled import Sampling
from pbcgen.errors import ModelError, NotProved
from pbcgen.law.step import ReferenceStep
from pbcgen.models.loader import load
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.target_map import NotExplicit, TargetMap, target_map
from pbcgen.proof.boxes import halves, longest_side
from pbcgen.proof.claim import Status
from pbcgen.run.simulate import simulate_sampled
from pbcgen.run.wrapper import Controller
from pbcgen.sampling.linearisation import period_matrix
from pbcgen.sampling.transition import Transition
from pbcgen.symbolic.real import BITS, approximate, ball, precision, rational

pytestmark = pytest.mark.system

RLC = load("rlc")
BOX = {"x3": ("2.9", "3.0515")}


def adjustable(design: Design):
    return next(c for c in pipeline.check(design).claims if c.claim == "adjustable")


def spring(force, **options) -> Design:
    """A mass on a nonlinear spring: x1' = x2, x2' = -force(x1) - x2 + u."""
    x1, x2, u = (ca.SX.sym(n) for n in ("x1", "x2", "u"))
    energy = {"cubic": x1**4 / 4, "linear": x1**2 / 2, "sine": 1 - ca.cos(x1)}[force]
    push = {"cubic": x1**3, "linear": x1, "sine": ca.sin(x1)}[force]
    system = AffineSystem(
        x=[x1, x2], u=[u], f=[x2, -push - x2], g=[0, 1], S=x2**2 / 2 + energy, measured=["x1"], gamma=[x1]
    )
    law = DynamicExtension(alpha=2, beta=2, K_c=1, R_c=1)
    given = {"law": law, "target": {"x1": "0.5"}, "limits": Limits.symmetric(5), "sample_period": "1e-3"} | options
    return Design(system, name="spring", **given)


def test_designs_without_settings_have_no_such_claim() -> None:
    assert "adjustable" not in [c.claim for c in pipeline.check(RLC).claims]


def test_a_box_of_targets_is_proved_up_to_the_limit_of_the_actuator() -> None:
    claim = adjustable(RLC.with_(target_box=BOX))
    assert claim.status is Status.PROVED
    assert claim.domain == "x3 in [2.9, 3.0515]"


def test_a_target_beyond_the_actuator_is_a_counterexample() -> None:
    claim = adjustable(RLC.with_(target_box={"x3": ("2.9", "3.06")}))
    assert claim.status is Status.REFUTED
    assert claim.counterexample == {"x3": "3.06"}
    assert "exceeded by 0.0085" in claim.evidence


def test_the_inverted_pendulum_is_inside_the_box_and_refuted() -> None:
    design = spring("sine", target_box={"x1": (0, "3.1")}, target={"x1": "0.5"})
    weak = design.with_(law=DynamicExtension(alpha="0.2", beta=1, K_c=1, R_c=1), limits=None)
    claim = adjustable(weak)
    assert claim.status is Status.REFUTED
    assert "not stable" in claim.evidence or "Hessian" in claim.evidence


def test_an_unstable_setting_between_stable_corners_is_a_counterexample() -> None:
    """The ends are stable, the middle (the upright pendulum) is not."""
    design = spring("sine", target_box={"x1": ("0.5", "5.8")})
    weak = design.with_(law=DynamicExtension(alpha="0.2", beta=1, K_c=1, R_c=1), limits=None)
    claim = adjustable(weak)
    assert claim.status is Status.REFUTED
    assert 1.5 < float(claim.counterexample["x1"]) < 4.7
    assert "narrow it: x1 in [" in claim.hint
    lo, hi = claim.hint.split("[")[1].split("]")[0].split(", ")
    assert adjustable(weak.with_(target_box={"x1": (lo, hi)})).status is Status.PROVED


def test_the_narrower_range_of_an_open_claim_is_proved(monkeypatch) -> None:
    design = load("pera").with_(gain_ranges={"beta": [(40, 150), (50, 180), (40, 150)]})
    monkeypatch.setattr("pbcgen.control.box._CELLS", 30)
    monkeypatch.setattr("pbcgen.control.box._SHARE_CELLS", 40)
    claim = adjustable(design)
    assert claim.status is Status.UNDECIDED
    ranges = [tuple(part.split("]")[0].split(", ")) for part in claim.hint.split("[")[1:]]
    assert len(ranges) == 3
    assert adjustable(design.with_(gain_ranges={"beta": ranges})).status is Status.PROVED


def test_conditions_that_depend_on_each_other_are_refuted() -> None:
    design = spring("linear", target={"x1": "0.5", "x2": 0}, target_box={"x2": (-1, 1)})
    claim = adjustable(design)
    assert claim.status is Status.REFUTED
    assert "not independent" in claim.evidence


def forced(kind: str, value: str, near: str, box: tuple[str, str]) -> Design:
    """A spring whose target is its force: x* has no formula."""
    design = spring(kind)
    x1 = design.system.x[0]
    force = {"cubic": x1**3 + x1, "sine": ca.sin(x1)}[kind]
    return design.with_(target={"force": (force, value)}, near={"x1": near}, target_box={"force": box})


def test_a_target_without_formula_is_followed_by_newton_steps() -> None:
    claim = adjustable(forced("cubic", "0.625", "0.5", ("0.5", "1")))
    assert claim.status is Status.PROVED
    assert "Newton steps from a polynomial of degree 6 reach it" in claim.evidence


def test_a_box_beyond_the_turning_point_of_the_equilibrium_is_undecided_with_advice() -> None:
    assert adjustable(forced("sine", "0.479426", "0.5", ("-0.9", "0.95"))).status is Status.PROVED
    design = forced("sine", "0.479426", "0.5", ("-0.9", "1.1"))
    claim = adjustable(design)
    assert claim.status is Status.UNDECIDED
    assert "could not be followed" in claim.evidence
    assert "narrow the box" in claim.hint
    with pytest.raises(NotProved, match="adjustable is UNDECIDED"):
        pipeline.package(pipeline.check(design))


@pytest.mark.parametrize(("precision", "error"), [("float", 3e-7), ("double", 2e-15)])
def test_the_c_solves_for_the_equilibrium_of_a_target_without_formula(precision, error) -> None:
    report = pipeline.check(forced("cubic", "0.625", "0.5", ("0.5", "1")).with_(precision=precision))
    with Controller.of_package(pipeline.package(report)) as controller:
        for force in np.linspace(0.5, 1, 21):
            assert controller.set_target(force=force) == "SPRING_OK"
            x = controller.state["x1_star"]
            assert x**3 + x == pytest.approx(np.float32(force) if precision == "float" else force, rel=error)
        before = controller.state
        for refused in (0.4999, 1.0001, float("nan"), float("-inf")):
            assert controller.set_target(force=refused) == "SPRING_INVALID_SETTING"
        assert controller.state == before


def test_the_map_solves_through_an_exponential() -> None:
    p, x3 = RLC.system.parameters, RLC.system.x[2]
    current = p["a"] * (ca.exp(x3 / p["b"]) - 1)
    design = RLC.with_(target={"i_D": (current, "0.0199")}, target_box={"i_D": ("0.015", "0.0199")})
    found = target_map(Plant(design.system), design)
    assert isinstance(found, TargetMap)
    (values,) = found.walk(found.tape(ca.vertcat(found.x, found.u)), [rational(2) / 100])
    assert approximate(values[2]) == pytest.approx(np.log(200001) / 4, rel=1e-14)


def test_the_map_is_an_equilibrium_of_the_arm() -> None:
    arm = load("pera").with_(target_box={"q1": (-2, 0), "q2": (0, "1.6"), "q3": (0, 1)})
    found = target_map(Plant(arm.system), arm)
    assert isinstance(found, TargetMap)
    (values,) = found.walk(found.tape(ca.vertcat(found.x, found.u)), [rational(-1), rational(1), rational(0)])
    assert [approximate(v) for v in values] == pytest.approx([-1, 1, 0, 0, 0, 0, 0, 1.5696 * np.sin(1), 0])


def test_too_few_conditions_are_not_explicit() -> None:
    design = spring("linear", target_box={"x1": (0, 1)})
    object.__setattr__(design.target, "conditions", ())
    assert isinstance(target_map(Plant(design.system), design), NotExplicit)


@pytest.mark.parametrize("name", ["rlc", "coupling_device", "pera_integral"])
def test_the_loops_over_a_point_are_those_of_the_linearisation(name: str) -> None:
    design = load(name)
    alpha = {"alpha_c" if name == "coupling_device" else "alpha"}
    if name == "pera_integral":
        alpha = {"alpha_psi"}
    values = {n: [(v / 2, v) for v in _gains(design)[n]] for n in alpha}
    derivation = pipeline.check(design.with_(gain_ranges=values)).derivation
    situation, graph = derivation.situation, derivation.graph
    assert situation is not None
    assert graph is not None
    loops = Loops.of(situation.plant, situation.point, graph, design.sample_period)
    middle = [rational(s.value) for s in graph.settings.settings]
    jets = loops.at(middle)
    sampled = period_matrix(situation.loop, design.sample_period)
    for kind, matrix in (("hurwitz", situation.loop.continuous()), ("schur", sampled)):
        expected = np.array([[approximate(v) for v in row] for row in matrix])
        found = np.array([[float(v.mid()) for v in row] for row in jets[kind].value.tolist()])
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
        step = [v * (rational(10**6 + 1) / 10**6) if k == 0 else v for k, v in enumerate(middle)]
        moved = np.array([[float(v.mid()) for v in row] for row in loops.at(step)[kind].value.tolist()])
        slope = (moved - found) / (approximate(middle[0]) * 1e-6)
        exact = np.array([[float(v.mid()) for v in row] for row in jets[kind].slopes[0].tolist()])
        np.testing.assert_allclose(slope, exact, rtol=1e-3, atol=1e-4 * np.abs(exact).max())


def _gains(design: Design):
    from pbcgen.models.laws import gains

    return gains(design.law.resolve(design.system.m))


@pytest.mark.parametrize("delay", ["0", "1/4", "1", "3/2", "2"])
@pytest.mark.parametrize("name", ["rlc", "coupling_device"])
def test_the_loops_over_a_point_know_delay_and_period(name: str, delay: str) -> None:
    alpha = "alpha" if name == "rlc" else "alpha_l"
    design = load(name)
    value = _gains(design)[alpha][0]
    derivation = pipeline.check(design.with_(gain_ranges={alpha: (value / 2, value)})).derivation
    h, situation = design.sample_period, derivation.situation
    loops = Loops.of(situation.plant, situation.point, derivation.graph, h, Fraction(delay))
    transition = Transition(situation.loop, Fraction(delay), steps=h)
    for share in (1, Fraction(9, 10)):
        with precision(BITS):
            period = ball(rational(h * share))
            expected = transition.real(transition.jet(period))
        found = loops.at([rational(value)], None if share == 1 else period)["schur"]
        scale = np.abs(_middle(expected.c0)).max()
        np.testing.assert_allclose(_middle(found.value), _middle(expected.c0), rtol=1e-9, atol=1e-12 * scale)
    slope = _middle(expected.c1)
    np.testing.assert_allclose(_middle(found.slopes[-1]), slope, rtol=1e-9, atol=1e-12 * np.abs(slope).max())


def _middle(matrix) -> np.ndarray:
    return np.array([[float(v.mid()) for v in row] for row in matrix.tolist()])


def _adjustable_with(design: Design, **sampling):
    return next(c for c in pipeline.check(design.with_(**sampling)).claims if c.claim == "adjustable")


def test_delay_and_jitter_are_part_of_the_claim() -> None:
    design = RLC.with_(target_box=BOX, gain_ranges={"alpha": ("0.04", "0.0485")})
    proved = _adjustable_with(design, delay="1/2", jitter="1/100")
    assert proved.status is Status.PROVED
    assert "a delay of 0.5 samples" in proved.evidence
    assert "periods that vary by 1 %" in proved.evidence


def test_a_delay_that_makes_some_setting_unstable_refutes_the_claim() -> None:
    steep = RLC.with_(gain_ranges={"beta": (1, "2.5")})
    assert adjustable(steep).status is Status.PROVED
    late = _adjustable_with(steep, delay="2")
    assert late.status is Status.REFUTED
    own = RLC.with_(law=DynamicExtension(RLC.law.alpha, late.counterexample["beta"], RLC.law.K_c, RLC.law.R_c))
    claims = {c.claim: c.status for c in pipeline.check(own.with_(delay=2)).claims}
    assert claims["sampled-stable"] is not Status.PROVED


def test_periods_that_vary_too_much_are_not_proved(monkeypatch) -> None:
    monkeypatch.setattr("pbcgen.control.box._SHARES", ())
    claim = _adjustable_with(RLC.with_(gain_ranges={"alpha": ("0.04", "0.0485")}), jitter="9/10")
    assert claim.status is not Status.PROVED


MATRIX_GAINS = {
    "rlc": {"K_c": (5, 20), "R_c": (5, 20)},
    "coupling_device": {"K_c": ("5e5", "2e6"), "R_c": ("0.2", "0.5"), "R_l": (30, 36)},
    "pera_integral": {"R_psi": [(0, 2), (0, 2), (30, 40)], "K_c": ("0.5", 2)},
}


@pytest.mark.parametrize("name", MATRIX_GAINS)
def test_entries_of_diagonal_matrices_change_at_run_time(name: str) -> None:
    design = load(name).with_(gain_ranges=MATRIX_GAINS[name])
    report = pipeline.check(design)
    assert next(c for c in report.claims if c.claim == "adjustable").status is Status.PROVED
    fixed = ReferenceStep(pipeline.check(load(name)).control)
    step = ReferenceStep(report.control)
    rng = np.random.default_rng(1)
    m = rng.normal(scale=np.abs(report.control.rest) * 0.01 + 1e-3, size=(20, len(report.control.inputs)))
    xi_fixed, xi = fixed.initial, step.initial
    last = None
    for row in m + report.control.rest:
        xi_fixed, u_fixed, _ = fixed(row, xi_fixed, last)
        xi, last, status = step(row, xi, last)
        assert status == 0
        np.testing.assert_allclose(last, u_fixed, rtol=2e-5, atol=1e-4)


def test_full_matrices_do_not_change_at_run_time() -> None:
    law = DynamicExtension(alpha=[1, 1, 1], beta=1, K_c=[[2, 1, 0], [1, 2, 0], [0, 0, 1]], R_c=1)
    with pytest.raises(ModelError, match=r"`R_c`, but K_c is a full matrix.*diagonal"):
        load("pera").with_(law=law, gain_ranges={"R_c": (1, 2)})
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=1, R_l=1, Upsilon=[[2]])
    with pytest.raises(ModelError, match="`Upsilon`: it mixes the channels"):
        load("coupling_device").with_(law=law, gain_ranges={"Upsilon": (1, 2)})


def test_the_least_stiffness_of_the_filter_decides() -> None:
    """K_c holds up the pendulum: below a bound the storage has no minimum, and the loop is unstable."""
    design = spring("sine", target={"x1": "3.1"}, law=DynamicExtension(alpha=2, beta=1, K_c=4, R_c=1), limits=None)
    assert adjustable(design.with_(gain_ranges={"K_c": (3, 5)})).status is Status.PROVED
    assert adjustable(design.with_(gain_ranges={"K_c": (1, 5)})).status is Status.REFUTED


def test_gains_in_a_range_keep_the_claims_and_bound_the_iterations() -> None:
    design = RLC.with_(gain_ranges={"alpha": ("0.03", "0.0485")})
    report = pipeline.check(design)
    assert adjustable(design).status is Status.PROVED
    assert report.control is not None
    (solve,) = report.control.solves
    assert solve.iterations <= 4
    assert report.control.intervals[0] == pytest.approx((3.003, 3.1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target_box": {"x9": (0, 1)}}, "no condition of the target"),
        ({"target_box": {"x3": (0, 1)}}, "must hold the value that the target has, 3.0515"),
        ({"target_box": {"x3": (4, 3)}}, "the lowest value must be below"),
        ({"target_box": {"x3": 3}}, "a pair"),
        ({"gain_ranges": {"alfa": (1, 20)}}, "did you mean `alpha`"),
        ({"gain_ranges": {"alpha": (0, "0.05")}}, "gains are positive"),
        ({"gain_ranges": {"alpha": [("0.01", "0.05"), (1, 2)]}}, "has 2 ranges: one, or 1"),
    ],
)
def test_bad_ranges_are_named(options, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        RLC.with_(**options)


def test_the_c_moves_the_plant_to_another_target() -> None:
    design = RLC.with_(target_box=BOX)
    report = pipeline.check(design)
    assert report.loop is not None

    class Moved(Controller):
        def reset(self) -> None:
            super().reset()
            if "target" in dict(self.interface.settings):
                assert self.set_target(x3=2.95) == "RLC_OK"

    with Moved.of_package(pipeline.package(report)) as controller:
        run = simulate_sampled(report.loop, controller, design.sample_period, 0.3)
        assert run.x[-1, 2] == pytest.approx(2.95, abs=1e-4)
        before = controller.state
        for refused in (2.89, 3.06, float("nan"), float("inf")):
            assert controller.set_target(x3=refused) == "RLC_INVALID_SETTING"
        assert controller.state == before
        with pytest.raises(ModelError, match="gains of this package cannot be changed"):
            controller.set_gains(alpha=0.03)
        controller.step(x3=float("nan"))
        assert controller.step(x3=float("nan"))["u"] == pytest.approx(2.95, abs=1e-6)  # -kappa of this target


def test_validation_tries_targets_and_gains() -> None:
    design = RLC.with_(target_box=BOX, gain_ranges={"alpha": ("0.04", "0.0485"), "K_c": (5, 20), "R_c": (8, 12)})
    validation = pipeline.validate(design, steps=200)
    assert validation.passed
    assert validation.settings is not None
    assert validation.settings.refused >= 10
    assert validation.as_json()["settings"]["mismatches"] == 0


def test_a_start_without_a_jump_gives_the_equilibrium_input() -> None:
    from pbcgen.emit import Extras

    report = pipeline.check(load("coupling_device"))
    package = pipeline.package(report, extras=Extras(start=True, selftest=True))
    with Controller.of_package(package) as controller:
        far = {"x1": 1e-4, "x2": 0.03, "x3": -0.01}
        assert controller.step(**far)["u"] != 0
        controller.reset()
        assert controller.start_at(**far) == "COUPLING_DEVICE_OK"
        assert controller.step(**far)["u"] == pytest.approx(0, abs=0.05)
        before = controller.state
        assert controller.start_at(x1=float("nan"), x2=0.0, x3=0.0) == "COUPLING_DEVICE_INVALID_INPUT"
        assert controller.state == before
        assert controller.selftest() == 0


def test_the_range_that_is_reported_is_that_of_all_settings():
    law = DynamicExtension(alpha=2, beta=6, K_c=12, R_c=1)
    design = load("elastic_pendulum").with_(law=law, gain_ranges={"alpha": (2, "2.5")})
    assert pipeline.check(design).derived["input_intervals"] == [[-2.5, 2.5]]


@pytest.mark.parametrize("seed", range(3))
def test_any_setting_of_a_proved_box_passes_as_a_design_of_its_own(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = {"q1": (-2, 0), "q2": (0, 1.5), "q3": (0, 0.8)}
    arm = load("pera")
    assert adjustable(arm.with_(target_box={**box, "q2": (0, "1.6")})).status is Status.PROVED
    target = {name: round(float(rng.uniform(*bounds)), 6) for name, bounds in box.items()}
    own = {c.claim: c.status for c in pipeline.check(arm.with_(target=target)).claims}
    needed = ("equilibrium", "measurability", "saturation", "asymptotically-stable", "sampled-stable")
    assert all(own[name] is Status.PROVED for name in needed)


def _cover(passes, budget=1000):
    """The search for cells, each of which passes or not; halved across its longest side."""
    tried = []

    def decide(cell):
        tried.append(cell)
        return (Status.PROVED if passes(*(hi - lo for lo, hi in cell), cell[0][0]) else Status.UNDECIDED), "why"

    def cut(cell):
        return [*reversed(halves(cell, longest_side(cell, [Fraction(1), Fraction(1)])))]

    parts = {"sampling": Sampling(), "decide": decide, "_halves": cut, "_show": lambda cell: "a cell"}
    one = (Fraction(0), Fraction(1))
    return _Box.cover(SimpleNamespace(**parts), (one, one), budget), len(tried)


def test_a_box_that_needs_too_many_cells_is_given_up_early() -> None:
    """Cells below 2^-4 take 256 of them, below 2^-12 millions; an edge that is hard is no reason to give up."""
    assert _cover(lambda width, height, left: max(width, height) <= Fraction(1, 16))[0] == 256
    found, tried = _cover(lambda width, height, left: max(width, height) <= Fraction(1, 2**12))
    assert "after 100 cells" in found.where
    assert tried < 200
    found, _ = _cover(lambda width, height, left: width <= (Fraction(1, 2) if left else Fraction(1, 2**7)))
    assert isinstance(found, int)
    found, _ = _cover(lambda width, height, left: False)
    assert not isinstance(found, int)
