"""What no input, no output and no damping can do: refutations, and limits of the inputs."""

import contextlib
import copy
import json
import re
from fractions import Fraction

import casadi as ca
import pytest
from certificates import outcomes, signed
from designs import DESIGNS, two_links
from documents import document_of, status, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension, Limits, Mechanical, NaturalDamping, PotentialCompensation

pytestmark = pytest.mark.system


def _pulled(target, **options):
    """y + e^y = 1 - x has no rational root at x = 1/2, and u* = y + e^y + x = 1 follows."""
    x, y, u = (ca.SX.sym(name) for name in "xyu")
    pull = y + ca.exp(y)
    system = AffineSystem([x, y], [u], [-pull - x, pull - 1 + x], [1, 0], x**2 / 2 + y**2 / 2 + ca.exp(y), **options)
    return Design(system, target, DynamicExtension(alpha=2, beta=3, K_c=4, R_c=1), sample_period="1e-3", name="pulled")


def test_an_equation_that_follows_from_the_others_is_shown_by_its_combination():
    document = written_for(_pulled({"x": "0.5"}))
    found = witness(document, "equilibrium")
    assert status(document, "equilibrium") == "PROVED"
    assert outcomes(document)["equilibrium"] == "checked"
    assert found["follows"] == {"1": {"0": "-1"}}
    for follows in ({}, {"1": {"0": "1"}}, {"1": {"0": "-2"}}, {"1": {"1": "1"}}, {"1": {}}, {"0": {"0": "1"}}):
        assert outcomes(with_witness(document, "equilibrium", follows=follows))["equilibrium"] == "fails", follows


#: Targets that no input holds: the equations contradict each other after some steps, or leave the domain.
UNASSIGNABLE = {
    "linear": lambda: _planar_design([lambda x, y: -x, lambda x, y: x + y - 1], {"x0": 1, "x1": "0.5"}),
    "polynomial": lambda: _planar_design([lambda x, y: -x, lambda x, y: x**2 + 1], {"x0": "0.25"}),
    "transcendental": lambda: _planar_design([lambda x, y: -x, lambda x, y: ca.sin(x) - 3 * y], {"x0": 1, "x1": 1}),
    "three": lambda: _planar_design([lambda x, y: -x, lambda x, y: x**3 - y], {"x0": "0.5", "x1": "0.5"}),
    "domain": lambda: _planar_design([lambda x, y: -x, lambda x, y: x - y], {"x0": "0.5"}, domain={"x1": (-1, "0.4")}),
}


def _planar_design(f, target, **options):
    x, y = ca.SX.sym("x0"), ca.SX.sym("x1")
    system = AffineSystem([x, y], [ca.SX.sym("u")], [f[0](x, y), f[1](x, y)], [1, 0], x**2 / 2 + y**2 / 2, **options)
    return Design(system, target, DynamicExtension(2, 3, 4, 1), sample_period="1e-3", name="planar")


@pytest.mark.parametrize("name", UNASSIGNABLE)
def test_a_target_that_no_input_holds_is_refuted_again(name):
    document = written_for(UNASSIGNABLE[name]())
    assert status(document, "equilibrium") == "REFUTED"
    assert outcomes(document)["equilibrium"] == "checked"
    steps = witness(document, "equilibrium")["steps"] if name in ("linear", "three", "domain") else []
    for k, (source, variable, place) in enumerate(steps):  # of an equation without solution anything follows
        for other in ([source, variable, place + 1], [source + 1, variable, place], [source, variable + 1, place]):
            changed = with_witness(document, "equilibrium", steps=[*steps[:k], other, *steps[k + 1 :]])
            assert outcomes(changed)["equilibrium"] == "fails"


@pytest.mark.parametrize("name", ["hardening_spring", "buck_converter", "compensated_pendulum"])
def test_no_steps_refute_a_target_that_an_input_holds(name):
    """Whatever is solved for what: the equations have a solution."""
    document = document_of(name)
    for entry in document["claims"]:
        entry["status"] = "REFUTED" if entry["claim"] == "equilibrium" else entry["status"]
    for steps in ([], [[0]], [[0], [1], [4]]):
        assert outcomes(with_witness(document, "equilibrium", steps=steps))["equilibrium"] == "fails"


def _without(f, g, S, **options):
    x = ca.SX.sym("x", len(f(*[ca.SX(1)] * 9)))
    parts = ca.vertsplit(x)
    system = AffineSystem(x, [ca.SX.sym("u")], f(*parts), g(*parts), S(*parts), **options)
    return Design(system, {"x_0": "0.25"}, DynamicExtension(2, 3, 4, 1), sample_period="1e-3", name="without")


def _half(*x):
    return sum(v**2 for v in x) / 2


#: No gamma exists: the natural output does not vanish at rest; equations for its gradient contradict each other; where
#: they determine it, it has a curl.
WITHOUT_GAMMA = {
    "output": (0, lambda **o: _without(lambda x, y, *_: [0, -y], lambda x, y: [1, 0], _half, **o)),
    "contradiction": (
        1,
        lambda **o: _without(
            lambda x, y, z, *_: [3 * ca.sin(z) - y, x - 3 * ca.sin(z), y - x],
            lambda x, y, z: [1, 0, 0],
            lambda x, y, z: (x**2 + y**2) / 2 - 3 * ca.cos(z),
            **o,
        ),
    ),
    "curl": (
        2,
        lambda **o: _without(
            lambda a, c, p, r, *_: [p, r, 0, 0], lambda a, c, p, r: [0, 0, c, 2], lambda a, c, p, r: _half(p, r), **o
        ),
    ),
}


@pytest.mark.parametrize("name", WITHOUT_GAMMA)
def test_that_no_gamma_exists_is_checked_again(name):
    vectors, make = WITHOUT_GAMMA[name]
    document = written_for(make())
    claim, found = "passive-output", witness(document, "passive-output")
    assert status(document, claim) == "REFUTED"
    assert outcomes(document)[claim] == "checked"
    assert len(found["vectors"]) == vectors
    zero = next(iter(found["set"].values()))
    elsewhere = [[str(k), *found["x"][1:]] for k in (1, 2)] if "0" in found["set"] else []
    changes = [{"x": x} for x in elsewhere]
    changes += [{"set": {k: v for k, v in found["set"].items() if k != left}} for left in found["set"]]
    changes += [{"set": {**found["set"], "0": zero + 1}}]
    for k, (target, places) in enumerate(found["vectors"]):
        others = [None if target is not None else 0, 1 if target == 0 else 0]
        forged = [[other, places] for other in others] + [[target, [None] * len(places)]]
        forged += [[target, [*places[:i], zero + 7, *places[i + 1 :]]] for i in range(len(places))]
        changes += [{"vectors": [*found["vectors"][:k], other, *found["vectors"][k + 1 :]]} for other in forged]
    for change in changes:
        assert outcomes(with_witness(document, claim, **change))[claim] == "fails", change


def test_no_vectors_show_that_a_gamma_that_exists_does_not():
    """With the witness of a model that has none, and with every unit vector."""
    good = written_for(_without(lambda a, c, p, r, *_: [p, r, -a, -c], lambda a, c, p, r: [0, 0, 1, 2], _half))
    assert status(good, "passive-output") == "PROVED"
    bad = written_for(WITHOUT_GAMMA["curl"][1]())
    found = witness(bad, "passive-output")
    forged = copy.deepcopy(good | {"terms": bad["terms"]})
    for entry in forged["claims"]:
        entry["status"] = "REFUTED" if entry["claim"] == "passive-output" else entry["status"]
    for change in (found, found | {"set": {}}, found | {"vectors": []}, found | {"vectors": found["vectors"][:1]}):
        assert outcomes(with_witness(forged, "passive-output", **change))["passive-output"] == "fails"


def _undamped_port(friction):
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    V = (q[0] - q[1]) ** 2 - 3 * ca.cos(q[1]) + ca.sin(q[0])
    system = Mechanical(q, p, M=ca.SX([2, 3]), V=V, G=[[1], [0]], D=[friction, 1])
    law = NaturalDamping(alpha_c=3, beta_c=2, K_c=1, R_c="1/2", alpha_l="1/2", beta_l=1, K_l=10, R_l=1)
    return Design(system, {"q_0": "0.5"}, law, sample_period="1e-3", name="port")


def test_an_output_that_nothing_damps_is_refuted_again():
    claim, document = "assumption-3", written_for(_undamped_port(0))
    found = witness(document, claim)
    assert status(document, claim) == "REFUTED"
    assert outcomes(document)[claim] == "checked"
    zeros = ["0"] * len(found["x"])
    for x in (zeros, [*zeros[:3], "1", "0"], found["x"][:-1], [*zeros[:4], "1"]):
        assert outcomes(with_witness(document, claim, x=x))[claim] == "fails"
    good = written_for(_undamped_port(0.125))
    for entry in good["claims"]:
        entry.update({"status": "REFUTED", "witness": found} if entry["claim"] == claim else {})
    assert outcomes(signed(good | {"terms": document["terms"]}))[claim] == "fails"


def _arm_within(first, second):
    return two_links(side=4).with_(limits=Limits([(-first, first), (-second, second)]))


def _pendulum_within(V, limit, **options):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    arm = Mechanical([q], [p], M=[1], V=V(q), D=[1], G=[1], inputs=["u"], **options)
    law = PotentialCompensation(alpha=1, beta=1, K_c=1, R_c=1)
    return Design(
        arm,
        {"q": 0},
        law,
        limits=Limits({"u": limit if isinstance(limit, tuple) else (-Fraction(limit), limit)}),
        sample_period="1e-3",
    )


def test_a_compensated_force_is_bounded_over_a_period():
    """``sin q + sin 2q`` is below 1.761, its harmonics at most 2; the law adds 1."""
    claim, document = "saturation", written_for(_pendulum_within(lambda q: -ca.cos(q) - ca.cos(2 * q) / 2, "2.77"))
    assert status(document, claim) == "PROVED"
    assert outcomes(document)[claim] == "checked"
    limits = witness(document, claim)["limits"]
    for k, [[weight, [[kind, place, [tree, *rest], alone]], vector]] in enumerate(limits):
        assert kind == "box"
        for other in (tree[:-1], tree + ".", ".", "", "c" + tree[1:], tree.replace("a", "b", 1)):
            square = [weight, [[kind, place, [other, *rest], alone]], vector]
            changed = [*limits[:k], [square], *limits[k + 1 :]]
            assert outcomes(with_witness(document, claim, limits=changed))[claim] == "fails", (k, other)
    assert outcomes(with_witness(document, claim, limits=limits[:1]))[claim] == "fails"
    for tighter in ("11/4", "2", "276/100"):
        changed = [line.replace("277/100", tighter) for line in document["model"]]
        assert changed != document["model"]
        assert outcomes(signed(document | {"model": changed}))[claim] == "fails"


@pytest.mark.parametrize(
    ("design", "limit", "tighter"),
    [
        (_pendulum_within(lambda q: 3 * ca.sin(q) + 4 * ca.cos(q), 6), "-6 6", "-6 5999999999/1000000000"),
        (_pendulum_within(lambda q: ca.sin(q) + ca.sin(3 * q) / 3, 3), "-3 3", "-2999999999/1000000000 3"),
        (_arm_within(36, 16), "-16 16", "-14 16"),
    ],
)
def test_a_limit_that_harmonics_touch_is_checked_again(design, limit, tighter):
    """Each harmonic with its amplitude is a sum of two squares; nothing is left for a smaller limit."""
    claim, document = "saturation", written_for(design)
    assert status(document, claim) == "PROVED"
    assert outcomes(document)[claim] == "checked"
    limits = witness(document, claim)["limits"]
    for k in range(len(limits)):
        assert outcomes(with_witness(document, claim, limits=[*limits[:k], [], *limits[k + 1 :]]))[claim] == "fails"
    changed = [line.replace(limit, tighter) for line in document["model"]]
    assert changed != document["model"]
    assert outcomes(signed(document | {"model": changed}))[claim] == "fails"
    for other in _spoiled(limits):
        assert outcomes(with_witness(document, claim, limits=other))[claim] == "fails", other


def _spoiled(part):
    """The data with one digit changed, for every digit."""
    text = json.dumps(part)
    for match in re.finditer(r"\d", text):
        changed = text[: match.start()] + str((int(match[0]) + 3) % 10) + text[match.end() :]
        with contextlib.suppress(ValueError):
            yield json.loads(changed)


def test_a_period_is_one_of_the_function():
    """With ``cos(q / 2)`` beside ``cos(q)`` a turn of q is no period; on a domain that counts for nothing."""

    def V(q):
        return 4 * ca.sin(q / 2) - ca.cos(q) - ca.cos(2 * q) / 2

    document = written_for(_pendulum_within(V, (-2, 5), domain={"q": (-1, 1)}))
    assert status(document, "saturation") == "PROVED"
    assert outcomes(document)["saturation"] == "checked"
    everywhere = [line for line in document["model"] if not line.startswith("domain")]
    assert outcomes(signed(document | {"model": everywhere}))["saturation"] == "fails"


def test_positions_at_which_a_compensated_force_is_too_large_are_checked_again():
    claim, document = "saturation", written_for(_arm_within(34, 16))
    assert status(document, claim) == "REFUTED"
    assert outcomes(document)[claim] == "checked"
    assert outcomes(with_witness(document, claim, q=["2", "1"]))[claim] == "fails"  # there is room
    q = witness(document, claim)["q"]
    below = Fraction(q[0]) - 1
    for domain, outcome in ((f"domain q_0 {q[0]} unbounded", "checked"), (f"domain q_0 unbounded {below}", "fails")):
        bounded = [*document["model"], domain]
        assert outcomes(signed(document | {"model": bounded}))[claim] == outcome
    wide = written_for(_arm_within(36, 16))
    for entry in wide["claims"]:
        if entry["claim"] == claim:
            entry.update(status="REFUTED", witness=witness(document, claim))
    assert outcomes(signed(wide))[claim] == "fails"


def test_a_drift_that_the_law_needs_and_no_sensor_sees_is_shown():
    """The law that measures its passive output needs the rate of gamma too."""
    design = DESIGNS["buck_converter_full"]()
    i, v, u = (ca.SX.sym(name) for name in ("i", "v", "d"))
    f = [-v / 0.5, (i - v / 3) / 0.2]
    system = AffineSystem([i, v], [u], f, [20, 0], 0.25 * i**2 + 0.1 * v**2, measured=["i"], gamma=[10 * i])
    document = written_for(Design(system, {"v": 5}, design.law, sample_period="1e-3", name="blind"))
    assert outcomes(document)["measurability"] in ("checked", "open")
    assert "fails" not in outcomes(document).values()
