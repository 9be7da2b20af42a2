"""Certificates of `adjustable`: what holds for every setting is checked on cells, what fails at one of them."""

import copy
import functools
import json
from dataclasses import replace
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from certificates import outcomes, signed
from scipy.linalg import expm

from pbcgen import AffineSystem, Design, DynamicExtension, Limits, load
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.proof.claim import Status
from pbcgen.reading import settings
from pbcgen.symbolic.plain.formulas import rational
from pbcgen.symbolic.plain.spectra import all_stable, inverse, zero_order_hold
from pbcgen.symbolic.plain.values import Dual, partial, plain, variables

pytestmark = pytest.mark.system

ADJUSTABLE = "adjustable"
WEAK = DynamicExtension(alpha="0.2", beta=1, K_c=1, R_c=1)


def _spring(force, **options):
    x, y, u = (ca.SX.sym(name) for name in ("x1", "x2", "u"))
    S = {"cubic": x**4 / 4, "linear": x**2 / 2, "sine": 1 - ca.cos(x), "exp": ca.exp(x)}[force]
    system = AffineSystem([x, y], [u], [y, -ca.gradient(S, x) - y], [0, 1], S + y**2 / 2, measured=["x1"], gamma=[x])
    law = DynamicExtension(alpha=2, beta=2, K_c=1, R_c=1)
    given = {"law": law, "target": {"x1": "0.5"}, "limits": Limits.symmetric(5), "sample_period": "1e-3"} | options
    return Design(system, name="spring", **given)


def _by_force(**options):
    """A target whose equilibrium has no formula."""
    design = _spring("cubic")
    x = design.system.x[0]
    return design.with_(target={"force": (x**3 + x, "0.625")}, near={"x1": "0.5"}, **options)


DESIGNS = {
    "a target": (lambda: _spring("cubic", target_box={"x1": ("0.4", "0.8")}), "PROVED"),
    "a target at the limit": (lambda: load("rlc").with_(target_box={"x3": ("2.9", "3.0515")}), "PROVED"),
    "a target beyond the limit": (lambda: load("rlc").with_(target_box={"x3": ("2.9", "3.06")}), "REFUTED"),
    "a gain": (lambda: _spring("linear", gain_ranges={"beta": ("0.01", 3)}), "PROVED"),
    "target and gains": (
        lambda: _spring("sine", target_box={"x1": ("0.2", "0.8")}, gain_ranges={"beta": (1, 3), "K_c": (1, 2)}),
        "PROVED",
    ),
    "an unstable target": (
        lambda: _spring("sine", target_box={"x1": ("0.5", "5.8")}, law=WEAK, limits=None),
        "REFUTED",
    ),
    "an unstable gain": (
        lambda: _spring(
            "sine",
            target={"x1": "3.1"},
            gain_ranges={"K_c": (1, 5)},
            law=DynamicExtension(alpha=2, beta=1, K_c=4, R_c=1),
            limits=None,
        ),
        "REFUTED",
    ),
    "an equilibrium without formula": (lambda: _by_force(target_box={"force": ("0.5", 1)}), "PROVED"),
    "dependent conditions": (
        lambda: _spring("linear", target={"x1": "0.5", "x2": 0}, target_box={"x2": (-1, 1)}),
        "REFUTED",
    ),
    "a compensated arm": (lambda: load("pera").with_(target_box={"q1": (-2, 0), "q2": (0, "1.6")}), "PROVED"),
}


@functools.cache
def _written(name):
    return json.dumps(certificate(derive(DESIGNS[name][0]())))


def _document(name):
    document = json.loads(_written(name))
    entry = next(e for e in document["claims"] if e["claim"] == ADJUSTABLE)
    return document, entry


def _with(document, **changes):
    document = copy.deepcopy(document)
    entry = next(e for e in document["claims"] if e["claim"] == ADJUSTABLE)
    entry["witness"] = {**entry["witness"], **changes}
    return signed(document)


def _model(document, old, new):
    assert any(old in line for line in document["model"])
    return signed(document | {"model": [line.replace(old, new) for line in document["model"]]})


@pytest.mark.parametrize("name", DESIGNS)
def test_every_verdict_on_settings_is_checked_again(name):
    document, entry = _document(name)
    assert entry["status"] == DESIGNS[name][1]
    assert outcomes(document)[ADJUSTABLE] == "checked"
    assert "fails" not in outcomes(document).values()


@pytest.mark.parametrize("name", [name for name, (_, status) in DESIGNS.items() if status == "PROVED"])
def test_other_cells_show_nothing(name):
    document, entry = _document(name)
    cells, trees, limits = (entry["witness"].get(part, []) for part in ("cells", "trees", "limits"))
    assert name != "a compensated arm" or limits
    for k in range(len(limits)):  # for the largest amplitudes of the box
        assert outcomes(_with(document, limits=[*limits[:k], [], *limits[k + 1 :]]))[ADJUSTABLE] == "fails"
        assert outcomes(_with(document, limits=limits[:k]))[ADJUSTABLE] == "fails"
    for other in (cells[:-1], cells + ".", "", "z" + cells[1:], "," + cells[1:]):
        assert outcomes(_with(document, cells=other))[ADJUSTABLE] == "fails", other
    for k, tree in enumerate(trees):
        for other in (tree[:-1], tree + ".", "z" + tree):
            assert outcomes(_with(document, trees=[*trees[:k], other, *trees[k + 1 :]]))[ADJUSTABLE] == "fails"
        assert outcomes(_with(document, trees=trees[:k]))[ADJUSTABLE] == "fails"


@pytest.mark.parametrize("name", [name for name, (_, status) in DESIGNS.items() if status == "PROVED"])
def test_a_box_that_is_proved_is_not_refuted(name):
    document, entry = _document(name)
    ends = [line.split()[-2:] for line in document["model"] if line.startswith("adjustable ")]
    entry["status"] = "REFUTED"
    for values in ([lo for lo, _ in ends], [hi for _, hi in ends], ["1000"] * len(ends), []):
        for witness in ({"at": values}, {"at": values, "steps": []}):
            assert outcomes(_with(document, **witness))[ADJUSTABLE] == "fails"


@pytest.mark.parametrize("name", [name for name, (_, status) in DESIGNS.items() if status == "REFUTED"])
def test_a_box_that_is_refuted_is_not_proved(name):
    document, entry = _document(name)
    derivation = derive(DESIGNS[name][0]())
    claims = tuple(replace(c, status=Status.PROVED) if c.claim == ADJUSTABLE else c for c in derivation.claims)
    forced = json.loads(json.dumps(certificate(replace(derivation, claims=claims))))
    assert outcomes(forced)[ADJUSTABLE] != "checked"
    entry["status"] = "PROVED"
    count = sum(line.startswith("limit ") for line in document["model"])
    for cells in (".", "a..", "aa..."):
        for tree in (".", ";", "a.."):
            assert outcomes(_with(document, cells=cells, trees=[tree] * 2 * count))[ADJUSTABLE] == "fails"


@pytest.mark.parametrize("name", ["an unstable target", "a target beyond the limit", "an unstable gain"])
def test_settings_that_do_not_fail_refute_nothing(name):
    document, entry = _document(name)
    lo, hi = next(line.split()[-2:] for line in document["model"] if line.startswith("adjustable "))
    good = hi if name == "an unstable gain" else lo
    assert entry["witness"]["at"] != [good]
    for at in ([good], ["100"], ["-100"], [], [good, good]):
        assert outcomes(_with(document, at=at))[ADJUSTABLE] == "fails", at
    assert outcomes(_with(document, steps=[]))[ADJUSTABLE] == "fails"


@pytest.mark.parametrize("name", ["a target", "target and gains", "an equilibrium without formula"])
def test_other_formulas_of_the_equilibrium_are_not_believed(name):
    document, entry = _document(name)
    lines = entry["witness"]["rest"]
    tried = 0
    for k, line in enumerate(lines):
        kind = line.split()[1]
        if kind not in ("constant", "setting", "solved") or line.endswith("constant 0") or "start" in lines[-1]:
            continue
        other = line.replace("setting 0", "constant 1/2").replace("solved 0", "setting 0")
        other = other if other != line else line + "1"
        tried += 1
        assert outcomes(_with(document, rest=[*lines[:k], other, *lines[k + 1 :]]))[ADJUSTABLE] == "fails", line
    rest = next(k for k, line in enumerate(lines) if line.startswith("rest "))
    zero = next(int(line.split()[0]) for line in lines if line.endswith(("constant 0", "setting 0")))
    for swapped in ("rest 3x1 0,0:0 1,0:0 2,0:0", f"rest 3x1 0,0:{zero}", "rest 2x1 0,0:0 1,0:0"):
        assert outcomes(_with(document, rest=[*lines[:rest], swapped, *lines[rest + 1 :]]))[ADJUSTABLE] == "fails"


def test_a_wider_box_needs_its_own_certificate():
    document, _ = _document("a target at the limit")
    for old, new in (("2 29/10 ", "2 5/2 "), ("x3 29/10 6103/2000", "x3 29/10 3052/1000")):
        if any(old in line for line in document["model"]):
            assert outcomes(_model(document, old, new))[ADJUSTABLE] == "fails"
    wider = _model(document, "6103/2000", "3052/1000")
    assert outcomes(wider)[ADJUSTABLE] == "fails"
    entry = next(e for e in wider["claims"] if e["claim"] == ADJUSTABLE)
    entry["domain"] = "x3 in [2.9, 3.052]"
    assert outcomes(signed(wider))[ADJUSTABLE] == "fails"


@pytest.mark.parametrize(
    "domain",
    ["x1 in [0.3, 0.8]", "x1 in [0.4, 0.9]", "x2 in [0.4, 0.8]", "all x", "x1", "x1 in [0.4, 0.8], x2 in [0, 1]"],
)
def test_the_domain_names_the_settings_with_their_ranges(domain):
    document, entry = _document("a target")
    entry["domain"] = domain
    assert outcomes(signed(document))[ADJUSTABLE] == "fails"


def test_other_gains_under_the_cells_are_not_believed():
    """A spring that is held up by the law falls where the law is weaker."""
    law = DynamicExtension(alpha=2, beta=2, K_c=8, R_c=1)
    stiff = _spring("sine", target_box={"x1": ("2.9", "3.1")}, target={"x1": 3}, limits=None, law=law)
    document = json.loads(json.dumps(certificate(derive(stiff))))
    assert outcomes(document)[ADJUSTABLE] == "checked"
    assert outcomes(_model(document, "gain beta = [2]", "gain beta = [1/8]"))[ADJUSTABLE] == "fails"
    assert outcomes(_model(document, "sample period 1/1000", "sample period 20"))[ADJUSTABLE] == "fails"


def _random(rng, n, stable):
    A = rng.normal(size=(n, n))
    shift = max(np.linalg.eigvals(A).real)
    return A - (shift + (0.5 if stable else -0.1)) * np.eye(n)


@pytest.mark.parametrize("seed", range(6))
def test_discs_hold_for_all_matrices_of_a_family(seed):
    """What passes has no unstable member; families that have one do not pass."""
    rng = np.random.default_rng(seed)
    n = 4
    A, E = _random(rng, n, True), rng.normal(size=(n, n))
    exact = [[Fraction(float(v)) for v in row] for row in A.tolist()]
    passed = 0
    for width in (0.0, 0.01, 0.05, 0.2, 1.0, 5.0):
        centre = [[_number(v) for v in row] for row in exact]
        moves = [[_number(Fraction(float(e))) for e in row] for row in E.tolist()]
        over = [[Dual(v, {0: e}) for v, e in zip(p, q, strict=True)] for p, q in zip(centre, moves, strict=True)]
        if all_stable([(centre, over, [_number(Fraction(width))])], False):
            passed += 1
            for t in np.linspace(-width, width, 41):
                assert max(np.linalg.eigvals(A + t * E).real) < 0
    assert 2 <= passed < 6
    unstable = [[_number(Fraction(float(v))) for v in row] for row in _random(rng, n, False).tolist()]
    assert not all_stable([(unstable, unstable, [])], False)


def _number(value):
    return rational(str(value))


def test_slopes_of_inverse_and_exponential():
    rng = np.random.default_rng(1)
    A, E = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    (t,) = variables([_number(Fraction(0))])
    moving = [
        [_number(Fraction(float(a))) + t * _number(Fraction(float(e))) for a, e in zip(p, q, strict=True)]
        for p, q in zip(A.tolist(), E.tolist(), strict=True)
    ]
    back = np.linalg.inv(A)
    found = inverse(moving)
    np.testing.assert_allclose([[float(plain(v)) for v in row] for row in found], back, rtol=1e-9)
    np.testing.assert_allclose([[float(partial(v, 0)) for v in row] for row in found], -back @ E @ back, rtol=1e-9)
    held, driven = zero_order_hold(moving, [[t], [t * 2], [t * 0 + 1]], _number(Fraction(1, 2)))
    step = 1e-6
    for rows, part in ((held, slice(0, 3)), (driven, slice(3, 4))):
        ends = [_held(A + s * E, np.array([[s], [2 * s], [1.0]]), 0.5)[:3, part] for s in (-step, step)]
        slope = (ends[1] - ends[0]) / (2 * step)
        np.testing.assert_allclose([[float(partial(v, 0)) for v in row] for row in rows], slope, rtol=1e-5, atol=1e-7)


def _held(A, B, h):
    return expm(np.block([[A, B], [np.zeros((1, 4))]]) * h)


def test_the_continuous_and_the_sampled_loop_must_both_be_stable(monkeypatch):
    document, _ = _document("a target at the limit")
    for stable, outcome in (((True, True), "checked"), ((True, False), "fails"), ((False, True), "fails")):
        monkeypatch.setattr(settings, "all_stable", lambda family, discrete, s=stable: s[discrete])
        assert outcomes(document)[ADJUSTABLE] == outcome, stable


def test_a_witness_that_was_not_found_is_recorded_as_missing():
    document, entry = _document("target and gains")
    entry["witness"] = None
    assert outcomes(signed(document))[ADJUSTABLE] == "recorded"


def test_periods_that_vary_are_part_of_what_is_checked():
    own = load("rlc").with_(gain_ranges={"alpha": ("0.04", "0.0485")}, delay="1/2", jitter="1/100")
    document = json.loads(json.dumps(certificate(derive(own))))
    assert outcomes(document)[ADJUSTABLE] == "checked"
    assert outcomes(_model(document, "jitter 1/100", "jitter 99/100"))[ADJUSTABLE] == "fails"


def test_gains_of_stiff_filters_take_few_cells():
    """What a stiff filter adds up is not subtracted again."""
    ranges = {"K_c": ("5e5", "2e6"), "R_c": ("0.2", "0.5"), "R_l": (30, 36)}
    document = json.loads(json.dumps(certificate(derive(load("coupling_device").with_(gain_ranges=ranges)))))
    assert outcomes(document)[ADJUSTABLE] == "checked"
    entry = next(e for e in document["claims"] if e["claim"] == ADJUSTABLE)
    assert entry["witness"]["cells"].count(".") < 100
    entry["witness"]["cells"] = "."
    assert outcomes(signed(document))[ADJUSTABLE] == "fails"
