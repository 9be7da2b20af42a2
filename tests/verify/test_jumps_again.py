"""Certificates of models that jump: what is said at x* holds beside the jumps, and nothing is concluded across one."""

import json
from functools import cache

import casadi as ca
import pytest
from certificates import forged, outcomes, signed
from flint import arb, fmpq

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.symbolic.plain.boxes import shown
from pbcgen.symbolic.plain.values import apply

pytestmark = pytest.mark.system

q, p, u = (ca.SX.sym(name) for name in "qpu")
GLOBAL = "globally-asymptotically-stable"
AT_TARGET = {"hessian-condition", "kc-bound", "stable", "asymptotically-stable", "sampled-stable"}
LAW = DynamicExtension(alpha=3, beta=1, K_c=5, R_c=1)


def _design(gamma=q, force=0, energy=0, target="0.3"):
    """A body on a spring with friction, a force beside it, and something added to its storage."""
    plant = AffineSystem([q, p], [u], [p, force - q - p], [0, 1], p**2 / 2 + q**2 / 2 + energy, gamma=[gamma])
    return Design(plant, {"q": target}, LAW, sample_period="1e-2", near={"q": target}, name="body")


def _document(design):
    return json.loads(json.dumps(certificate(derive(design))))


@cache
def _smooth():
    return _document(_design())


#: Functions of q that jump, each at 3/10 or within 1/10^200 of it.
JUMPS = {
    "floor": lambda a: ca.floor(a - 0.3),
    "ceil": lambda a: ca.ceil(a - 0.3),
    "fmod": lambda a: ca.fmod(a + 0.7, 1),
    "remainder": lambda a: ca.remainder(a + 0.2, 1),
    "sign": lambda a: ca.sign(a - 0.3),
    "copysign": lambda a: ca.copysign(1, a - 0.3),
    "lt": lambda a: a < 0.3,
    "le": lambda a: a <= 0.3,
    "eq": lambda a: a == 0.3,
    "ne": lambda a: a != 0.3,
    "not": lambda a: ca.logic_not(a - 0.3),
    "and": lambda a: ca.logic_and(a > 0.3, a < 5),
    "or": lambda a: ca.logic_or(a > 0.3, a < -5),
    "if": lambda a: ca.if_else(a > 0.3, 1, -1),
    "if without a comparison": lambda a: ca.if_else(a - 0.3, 1, -1),
}


@pytest.mark.parametrize("name", JUMPS)
def test_a_jump_elsewhere_leaves_what_is_said_at_the_target(name):
    document = _document(_design(q + JUMPS[name](q - 0.25)))
    found = outcomes(document)
    status = {e["claim"]: e["status"] for e in document["claims"]}
    assert {status[claim] for claim in AT_TARGET} == {"PROVED"}
    assert not {"recorded", "fails"} & {*found.values()}
    stated = next(e for e in document["claims"] if e["claim"] == "passive-output")
    stated |= {"status": "PROVED", "witness": next(e for e in _smooth()["claims"] if e["claim"] == stated["claim"])}
    assert outcomes(signed(document))["passive-output"] != "checked"


@pytest.mark.parametrize("name", JUMPS)
def test_a_jump_at_the_target_shows_nothing_there(name):
    found = outcomes(forged(_smooth(), _design(q + JUMPS[name](q))))
    assert {claim for claim in found if found[claim] == "checked"} <= {"input-rank", "equilibrium", *_UP_TO_THERE}
    found = outcomes(forged(_smooth(), _design(force=JUMPS[name](q))))
    assert not {"equilibrium", *AT_TARGET} & {claim for claim in found if found[claim] == "checked"}


_UP_TO_THERE = ("assumption-1", "gain-definiteness", "measurability", "saturation")


@pytest.mark.parametrize(
    "jump", [*JUMPS.values(), lambda a: 1 - ca.sign(a - 0.3) ** 2, lambda a: 1 - ca.copysign(1, a - 0.3) ** 2]
)
@pytest.mark.parametrize("part", ["gamma", "force", "energy"])
def test_what_is_said_of_all_states_is_not_shown_across_a_jump(part, jump):
    """Also not by a jump at a single state."""
    there = {"gamma": q}.get(part, 0) + 5 * jump(q - 1)
    found = outcomes(forged(_smooth(), _design(**{part: there})))
    claims = {"passive-output", GLOBAL, *(() if part == "gamma" else ("assumption-1",))}
    assert not claims & {claim for claim in found if found[claim] == "checked"}


def test_a_condition_that_is_neither_true_nor_false_is_no_condition():
    document = _document(_design(q + ca.if_else(q > 1, 1, 0)))
    lines = document["model"]
    at = next(k for k, line in enumerate(lines) if " if_else_zero " in line)
    number, name, _, value = lines[at].split()
    lines[at] = f"  {number} {name} 0 {value}"
    with pytest.raises(Exception, match="neither true nor false"):
        outcomes(signed(document))


def _on(tree, function, zeros=None, lo=-1, hi=2):
    return shown(tree, [(fmpq(lo), fmpq(hi))], function, zeros or {})


@pytest.mark.parametrize(
    "step",
    [
        lambda a: apply("floor", a) * 4,
        lambda a: apply("lt", fmpq(1), a) * 4,
        lambda a: apply("eq", a, fmpq(1)) * 4,
        lambda a: apply("sign", a - 1) * 2 + 2,
        lambda a: apply("if_else_zero", apply("ne", a, fmpq(1)), a * 0 + 4),
    ],
)
def test_slopes_show_nothing_across_a_jump(step):
    """``a^2`` and 4 less beyond 1: its enclosed slopes, and its curvature, are those of ``a^2``."""
    for leaf in ".,;:":
        assert not _on(leaf, lambda z: z[0] * z[0] - step(z[0]), {0: fmpq(0)})
        for inner in ".,;:":
            assert not _on(f"a{leaf}{inner}", lambda z: z[0] * z[0] + 1 - step(z[0]), {0: fmpq(0)})
    assert _on("aa..a..", lambda z: z[0] * z[0] + step(z[0]) * 0 + arb(0), None, fmpq(11, 10), fmpq(19, 10))


@pytest.mark.parametrize("V", [q - ca.log(q), 1 / (3 - q) + q**2])
def test_a_mechanical_system_with_a_wall_or_a_pole_is_not_claimed_to_be_defined_everywhere(V):
    system = Mechanical([q], [p], M=[1], V=V, D=[1], G=[1])
    _is_restricted(Design(system, {"q": 1}, DynamicExtension(2, 1, 1, 1), sample_period="1e-2", near={"q": 1}))


def _is_restricted(design):
    document = _document(design)
    stated = [e for e in document["claims"] if e["claim"] in ("assumption-1", "passive-output")]
    assert {(e["status"], e["domain"]) for e in stated} == {("PROVED", "all x where the model is defined")}
    assert {outcomes(document)[e["claim"]] for e in stated} == {"checked"}
    for e in stated:
        e["domain"] = "all x"
    assert "checked" not in {outcomes(signed(document))[e["claim"]] for e in stated}


def _in_a_box(friction, box):
    system = AffineSystem([q, p], [u], [p, -q - friction * p], [0, 1], (q**2 + p**2) / 2, domain={"q": box})
    return _document(Design(system, {"q": 0}, LAW, sample_period="1e-2", near={"q": 0}, name="box"))


@pytest.mark.parametrize(
    ("friction", "box", "outcome"),
    [
        (1 / (q - 3) ** 2, (-1, 4), "recorded"),  # a pole inside
        (1 / (q - 3) ** 2, (-1, 3), "recorded"),  # at the end
        (1 / (q - 3) ** 2, (-1, "2.9"), "checked"),
        (1 / (q + 3), (-1, 5), "checked"),
        (1 / (q + 3), (-3, 5), "recorded"),
    ],
)
def test_a_domain_is_not_said_to_be_free_of_poles_that_it_has(friction, box, outcome):
    (lo, hi), document = box, _in_a_box(friction, box)
    for e in document["claims"]:
        if e["claim"] in ("assumption-1", "passive-output"):
            e["domain"] = f"q in [{lo}, {hi}]"
    found = outcomes(signed(document))
    assert {found[name] for name in ("assumption-1", "passive-output")} == {outcome}
