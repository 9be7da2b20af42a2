"""Certificates of models with moduli, powers and functions of numbers."""

import json

import casadi as ca
import pytest
from certificates import forged, outcomes, signed

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical, Parameters
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive

pytestmark = pytest.mark.system

LOCAL, GLOBAL = "asymptotically-stable", "globally-asymptotically-stable"


def _design(friction, spring=lambda x: x, energy=lambda x: x**2 / 2, parameters=None):
    x, v, u = (ca.SX.sym(name) for name in "xvu")
    options = {} if parameters is None else {"parameters": parameters}
    f = [v, -spring(x) - friction(v)]
    system = AffineSystem([x, v], [u], f, [0, 1], energy(x) + v**2 / 2, **options)
    return Design(system, {"x": "0.5"}, DynamicExtension(2, 3, 5, 1), sample_period="1e-3", name="functions")


def _document(design):
    return json.loads(json.dumps(certificate(derive(design))))


def _unchecked(document):
    found = outcomes(document)
    return {e["claim"]: found[e["claim"]] for e in document["claims"] if found[e["claim"]] not in ("checked", "open")}


P = Parameters(a=1, b=2, c="7/5", e="1/3")

#: Friction and spring with the energy of the spring.
MODELS = {
    "drag": (lambda v: v * ca.fabs(v),),
    "drag beside friction": (lambda v: v / 5 + v * ca.fabs(v) / 3,),
    "drag of higher order": (lambda v: v * ca.fabs(v) * (1 + ca.fabs(v)),),
    "drag on one side": (lambda v: v * (v + ca.fabs(v)),),
    "friction with a kink": (lambda v: 2 * v + ca.fabs(v),),
    "a sine of a number": (lambda v: ca.sin(P.a) * v,),
    "a root of a number": (lambda v: v, lambda x: ca.sqrt(P.b) * x, lambda x: ca.sqrt(P.b) * x**2 / 2),
    "a power": (
        lambda v: v,
        lambda x: x + 2 * P.c * x * (1 + x**2) ** (P.c - 1),
        lambda x: x**2 / 2 + (1 + x**2) ** P.c,
    ),
    "a cube root": (lambda v: v * (1 + v**2) ** P.e,),
    "an error function": (lambda v: v + ca.erf(v),),
}


@pytest.mark.parametrize("name", MODELS)
def test_every_verdict_is_checked_again(name):
    document = _document(_design(*MODELS[name], parameters=P))
    assert {e["claim"]: e["status"] for e in document["claims"]}["asymptotically-stable"] == "PROVED"
    assert _unchecked(document) == {}


@pytest.mark.parametrize(
    ("good", "bad"),
    [
        ("drag", lambda v: -v * ca.fabs(v)),
        ("drag", lambda v: v * v),
        ("drag beside friction", lambda v: v * ca.fabs(v) / 3 - v / 5),
        ("drag on one side", lambda v: v * (ca.fabs(v) / 2 - v)),
        ("friction with a kink", lambda v: v / 2 + ca.fabs(v)),
        ("an error function", lambda v: v - 2 * ca.erf(v)),
        ("a sine of a number", lambda v: ca.sin(4 * P.a) * v),
    ],
)
def test_friction_that_drives_is_not_believed(good, bad):
    """Under the certificate of friction that brakes, and under its own with every verdict PROVED."""
    design = _design(bad, parameters=P)
    for document in (_document(_design(*MODELS[good], parameters=P)), _document(design)):
        found = outcomes(forged(document, design))
        assert "checked" not in {found["assumption-1"], found["passive-output"], found[GLOBAL]}


@pytest.mark.parametrize("target", [0, "0.5"])
def test_a_spring_with_a_bend_is_checked_again(target):
    """CasADi writes the sign of q into the force; at the bend no Hessian is known, and none is claimed."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    spring = Mechanical([q], [p], V=q**2 / 2 + q * ca.fabs(q) / 5, G=[1], M=[1], D=[1])
    document = _document(Design(spring, {"q": target}, DynamicExtension(2, 3, 5, 1), sample_period="1e-3"))
    assert any(line.split()[1:2] == ["sign"] for line in document["model"])
    assert _unchecked(document) == {}


@pytest.mark.parametrize("friction", [ca.sign, lambda v: v + ca.sign(v) / 9, lambda v: ca.copysign(1, v) + v])
def test_friction_that_jumps_shows_nothing_of_the_loop(friction):
    """It never takes power; but no solution of the equations goes on where it jumps."""
    design = _design(friction)
    for document in (_document(_design(*MODELS["drag beside friction"], parameters=P)), _document(design)):
        found = outcomes(forged(document, design))
        assert "checked" not in {found["stable"], found[LOCAL], found[GLOBAL], found["sampled-stable"]}


def test_friction_with_a_kink_is_not_linearised():
    """``v / 2 + |v|`` pulls on one side: the slopes at rest are between -1/2 and 3/2."""
    document = _document(_design(lambda v: v / 2 + ca.fabs(v)))
    for status in ("PROVED", "REFUTED"):
        for entry in document["claims"]:
            if entry["claim"] in ("stable", LOCAL, "sampled-stable"):
                entry |= {"status": status, "witness": None, "domain": "near x*"}
                entry["domain"] = "sampled loop" if entry["claim"] == "sampled-stable" else "near x*"
        found = outcomes(signed(document))
        assert "checked" not in {found["stable"], found[LOCAL], found["sampled-stable"]}


def test_a_storage_with_a_kink_shows_nothing():
    """|x| / 10 has a slope on each side of zero, but none at zero."""
    design = _design(lambda v: v, energy=lambda x: x**2 / 2 + ca.fabs(x) / 10)
    for document in (_document(design), _document(_design(lambda v: v))):
        found = outcomes(forged(document, design))
        assert "checked" not in {found["assumption-1"], found["passive-output"], found[GLOBAL]}


def test_a_storage_that_jumps_shows_nothing():
    """The derivative of sign(x - 1) is zero beside its jump, as if there were none."""
    smooth = _document(_design(lambda v: v))
    found = outcomes(forged(smooth, _design(lambda v: v, energy=lambda x: x**2 / 2 - 2 * ca.sign(x - 1) / 5)))
    assert "checked" not in {found["assumption-1"], found["passive-output"], found[GLOBAL]}


def test_a_gamma_that_jumps_shows_nothing():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")

    def design(gamma):
        system = AffineSystem([x], [u], [-x], [1], x**2 / 2, gamma=[gamma])
        return Design(system, {"x": 0}, DynamicExtension(2, 1, 1, 1), sample_period="1e-2", name="step")

    smooth = _document(design(x))
    assert outcomes(smooth)["passive-output"] == "checked"
    found = outcomes(forged(smooth, design(x + ca.sign(x - 1) / 2)))
    assert "checked" not in {found["passive-output"], found["measurability"], found[GLOBAL]}


def test_a_storage_with_poles_shows_nothing_of_the_whole_space():
    """The angle jumps where the pole of the half angle is; the motion turns through it."""
    x, y, u, v = (ca.SX.sym(name) for name in "xyuv")

    def design(angle):
        S = (x**2 + y**2) / 2 + angle / 4
        system = AffineSystem([x, y], [u, v], [-x + y, -y - x], [[1, 0], [0, 1]], S, gamma=[x, y])
        return Design(
            system, {"x": 1, "y": 0}, DynamicExtension([5, 5], [1, 1], 1, 1), sample_period="1e-2", name="turn"
        )

    document = _document(design(2 * ca.atan(y / (ca.sqrt(x**2 + y**2) + x))))
    stated = next(e for e in document["claims"] if e["claim"] == "assumption-1")
    assert (stated["status"], stated["domain"]) == ("PROVED", "all x where the model is defined")
    assert outcomes(document)["assumption-1"] == "checked"
    stated["domain"] = "all x"
    for claimed in (signed(document), forged(document, design(ca.atan2(y, x)))):
        assert outcomes(claimed)["assumption-1"] != "checked"
    assert derive(design(ca.atan2(y, x))).claims[2].status.name == "UNDECIDED"
