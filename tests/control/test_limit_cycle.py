"""A periodic motion of the closed loop refutes that x* attracts from everywhere."""

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Design, Limits, NaturalDamping, Parameters
from pbcgen.control.derive import derive
from pbcgen.control.limit_cycle import METHOD, limit_cycle
from pbcgen.control.whole_loop import WholeLoop
from pbcgen.proof.claim import Status
from pbcgen.proof.collocation import Rule, arcs
from pbcgen.symbolic.doubles import Doubles
from pbcgen.symbolic.real import approximate

pytestmark = pytest.mark.system


def coupled(domain=None, lean=0, **gains):
    """Two masses, a spring between them, and a motor at the first; friction that may lean to one side."""
    p = Parameters(R1=100, R2=100, C="2.2e-4", m1="0.01", m2="0.015", a0="0.005", a1="6e-4", a2="8e-5", a3=40, k="0.3")
    p_lean = ca.SX(lean)
    x1, x2, x3, x4, x5 = (ca.SX.sym(f"x{k}") for k in range(1, 6))
    spring, motor = p.k * (x2 - x3), (x1 / p.C - x4 / (p.a0 * p.m1)) / p.R2
    dry = ca.tanh(p.a3 * x5)
    friction = p.a1 * x5 / p.m2 + p.a2 * dry * (1 + p_lean * dry)
    device = AffineSystem(
        x=[x1, x2, x3, x4, x5],
        u=[ca.SX.sym("u")],
        f=[
            -(1 / p.R1 + 1 / p.R2) * x1 / p.C + x4 / (p.a0 * p.m1 * p.R2),
            x4 / p.m1,
            x5 / p.m2,
            -spring + motor / p.a0,
            spring - friction,
        ],
        g=[1 / p.R1, 0, 0, 0, 0],
        S=x1**2 / (2 * p.C) + p.k * (x2 - x3) ** 2 / 2 + x4**2 / (2 * p.m1) + x5**2 / (2 * p.m2),
        parameters=p,
        measured=["x1", "x2", "x3"],
        domain=domain,
        units={"x3": "m"},
    )
    chosen = {"alpha_c": "2.5", "beta_c": 450, "K_c": "1e6", "R_c": "0.3"}
    chosen |= {"alpha_l": "2.5", "beta_l": "2e6", "K_l": "5.5e-4", "R_l": 33} | gains
    law = NaturalDamping(**chosen)
    return Design(device, target={"x3": "0.025"}, law=law, limits=Limits.symmetric(10), sample_period="1e-3")


def overall(found):
    return next(c for c in found.claims if c.claim == "globally-asymptotically-stable")


CYCLES = {
    "as it is": {},
    "a soft natural damping": {"beta_l": 200},
    "a slower filter": {"R_l": "3.3"},
    "friction to one side": {"beta_l": 2000, "lean": 0.25},
    "a domain around it": {"beta_l": 200, "domain": {"x3": ("-0.3", "0.35")}},
}


@pytest.mark.parametrize("name", CYCLES)
def test_the_loop_goes_around_for_ever(name):
    found = derive(coupled(**CYCLES[name]))
    claim = overall(found)
    assert claim.status is Status.REFUTED
    assert claim.method == METHOD
    assert "x3 from -0.1" in claim.evidence
    loop = WholeLoop.of(found.situation)
    rate = loop.closed
    for symbols, values in zip(loop.symbols, loop.values, strict=True):
        rate = ca.substitute(rate, symbols, ca.DM([approximate(v) for v in values]))
    states = {**claim.counterexample["x"], **claim.counterexample["filters"]}
    start = np.array([float(states[name]) for name in loop.names])
    scale = np.array([1e-3, 0.02, 0.2, 2e-4, 0.01, 2e-6, 30.0])
    y = ca.SX.sym("y", 7)
    scaled = ca.substitute(rate, loop.z, ca.DM(scale) * y) / scale
    doubles = Doubles([y], [scaled, ca.jacobian(scaled, y)])

    def field(points):
        value, slope = doubles.many(points)
        return value[:, :, 0], slope

    period = float(claim.counterexample["period"].removesuffix(" s"))
    last = [*arcs(field, Rule.of(12), start / scale, period, 1e-9)][-1]
    assert np.allclose(last.states[-1] * scale, start, rtol=1e-4, atol=1e-4 * scale)


NONE = {
    "a faster filter": {"R_l": 330},
    "a stiffer filter": {"K_l": 1},
    "a domain that it leaves": {"beta_l": 200, "domain": {"x3": ("-0.1", "0.15")}},
}


@pytest.mark.parametrize("name", NONE)
def test_no_cycle_is_shown_where_there_is_none(name):
    found = derive(coupled(**NONE[name]))
    assert isinstance(limit_cycle(found.situation), str)
    assert overall(found).method != METHOD
