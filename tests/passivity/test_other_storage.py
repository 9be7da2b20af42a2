"""A storage that would do is named where the given one does not; put into the model it is proved."""

import re

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Parameters
from pbcgen.control.derive import derive
from pbcgen.passivity.other_storage import other_storage
from pbcgen.proof.claim import Status

PREMISES = ("assumption-1", "passive-output", "gradient-condition", "hessian-condition")


def _symbols(names):
    return [ca.SX.sym(name) for name in names.split()]


def _wall(measured=("T1",), sign=1):
    """Three bodies in a row; the first is heated, the last is cooled."""
    p = Parameters(C1=5, C2=4, C3=10, R12="0.1", R23="0.2", R3=1)
    a, b, c, Q = _symbols("T1 T2 T3 Q")
    f = [
        -sign * (a - b) / p.R12 / p.C1,
        ((a - b) / p.R12 - (b - c) / p.R23) / p.C2,
        ((b - c) / p.R23 - c / p.R3) / p.C3,
    ]
    S = (p.C1 * a**2 + p.C2 * b**2 + p.C3 * c**2) / 2
    return AffineSystem([a, b, c], [Q], f, [1 / p.C1, 0, 0], S, parameters=p, measured=list(measured)), {"T3": 20}


def _tanks():
    p = Parameters(A1=1, A2=2, c1="0.5", c2="0.4")
    h1, h2, q = _symbols("h1 h2 q")
    out = p.c1 * ca.sqrt(h1)
    system = AffineSystem(
        [h1, h2],
        [q],
        [-out / p.A1, (out - p.c2 * ca.sqrt(h2)) / p.A2],
        [1 / p.A1, 0],
        p.A1 * h1 + p.A2 * h2,
        parameters=p,
        domain={"h1": (0, None), "h2": (0, None)},
    )
    return system, {"h2": 1}


def _motor():
    p = Parameters(L="0.1", R="0.5", J=1, b="0.1", k="0.5")
    i, w, v = _symbols("i w v")
    S = p.L * i**2 / 2 + p.J * w**2 / 2
    f = [(-p.R * i - p.k * w) / p.L, (p.k * i - p.b * w) / p.J]
    return AffineSystem([i, w], [v], f, [1 / p.L, 0], S, parameters=p), {"w": 1}


def _reaction():
    """A nonlinear conductance between two capacitors: the potentials of its flows."""
    x, y, u = _symbols("x y u")
    f = [1 - ca.exp(x) - (x - y) ** 3, (x - y) ** 3 - y]
    return AffineSystem([x, y], [u], f, [1, 0], x**2 + y**2, measured=["x"]), {"x": "0.5"}


def _with(system, S):
    names = dict(zip(system.state_names, ca.vertsplit(system.x), strict=True)) | {"sqrt": ca.sqrt, "exp": ca.exp}
    names |= dict(zip(system.parameters.values, ca.vertsplit(ca.SX(system.parameters.symbols)), strict=True))
    text = re.sub(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.])", lambda n: f"ca.SX({n.group()})", S.replace("^", "**"))
    storage = eval(text, {"ca": ca}, names)
    given = {"parameters": system.parameters, "measured": list(system.measured_names), "domain": system.domain}
    return AffineSystem(system.x, system.u, system.f, system.g, storage, **given)


def _claims(system, target):
    law = DynamicExtension(alpha=1, beta=1, K_c=1, R_c=1)
    derivation = derive(Design(system, target, law, sample_period="1e-3", near=dict.fromkeys(system.state_names, 1)))
    return derivation, {c.claim: c for c in derivation.claims}


@pytest.mark.parametrize("build", [_wall, _tanks, _motor, _reaction])
def test_the_named_storage_is_proved_when_it_is_taken(build):
    system, target = build()
    derivation, _ = _claims(system, target)
    found = other_storage(derivation.plant, derivation.point)
    assert found is not None
    _, claims = _claims(_with(system, found.S), target)
    assert [claims[name].status for name in (*PREMISES, "measurability")] == ["PROVED"] * 5


def test_the_hint_names_it_where_the_given_storage_fails():
    _, claims = _claims(*_wall())
    assert claims["measurability"].status is Status.REFUTED
    assert "take another storage, such as S = " in claims["measurability"].hint
    assert "whose gamma is T1/C3" in claims["measurability"].hint
    _, claims = _claims(*_tanks())
    assert "sqrt(h1)" in claims["passive-output"].hint


def test_what_cannot_be_read_is_not_named():
    derivation, claims = _claims(*_wall(measured=("T3",)))
    assert other_storage(derivation.plant, derivation.point, readable=True) is None
    assert "another storage" not in claims["measurability"].hint


@pytest.mark.parametrize("seed", range(12))
def test_random_systems_are_given_none_that_fails(seed):
    """Linear systems, stable or not, with a cubic flow: what is named is proved, and unstable ones are refused."""
    rng = np.random.default_rng(seed)
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    A = rng.integers(-4, 5, (2, 2)) / 2
    cubic = ca.SX([[-1 if seed % 3 == 0 else 0], [0]]) * (x[0] - x[1]) ** 3
    system = AffineSystem(x, u, ca.mtimes(ca.SX(ca.DM(A)), x) + cubic, [1, 0], x[0] ** 2 + x[1] ** 2)
    derivation, _ = _claims(system, {"x_0": 0, "x_1": 0})
    if derivation.point is None:
        return
    found = other_storage(derivation.plant, derivation.point)
    if found is not None:
        _, claims = _claims(_with(system, found.S), {"x_0": 0, "x_1": 0})
        assert [claims[name].status for name in PREMISES[:3]] == ["PROVED"] * 3


@pytest.mark.parametrize("sign", [-1, "far"])
def test_a_source_of_heat_has_none(sign):
    system, target = _wall(sign=-1) if sign == -1 else _pumped()
    derivation, _ = _claims(system, target)
    assert other_storage(derivation.plant, derivation.point) is None


def _pumped():
    """Heat that is pumped from the cold to the warm body."""
    a, b, Q = _symbols("a b Q")
    return AffineSystem([a, b], [Q], [(a - b) - 0.1 * a, 2 * (b - a) + b], [1, 0], a**2 + b**2), {"a": 0, "b": 0}
