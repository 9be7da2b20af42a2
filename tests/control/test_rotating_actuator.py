"""A cart on a spring with a rotating mass that is driven: the coupling e cos(theta) vanishes at some angles."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen import Design, DynamicExtension, Mechanical, check

NAMES = ("stable", "asymptotically-stable", "globally-asymptotically-stable")


def _statuses(coupling=ca.cos, target=0, damping=0, stiffness=1, spring=lambda x: 0, law=(1, 1, 1, 1)):
    x, th, px, pt = (ca.SX.sym(name) for name in ("x", "th", "px", "pt"))
    e = 0.2 * coupling(th)
    V = stiffness * x**2 / 2 + spring(x)
    model = Mechanical([x, th], [px, pt], M=[[1, e], [e, 1]], V=V, D=[damping, 0], G=[[0], [1]])
    report = check(Design(model, {"th": target}, DynamicExtension(*law), sample_period="1e-3", near={"x": 0}))
    claims = {c.claim: str(c.status) for c in report.claims}
    return tuple(claims[name] for name in NAMES)


@pytest.mark.parametrize("target", [0, "1.5", "-0.7"])
def test_the_cart_comes_to_rest_from_everywhere(target):
    """Where cos(theta) = 0 the cart may swing unseen, with u = 0; the law rests at theta* only with that input."""
    assert _statuses(target=target) == ("PROVED",) * 3


def test_at_an_angle_without_coupling_the_cart_swings_on():
    assert _statuses(ca.sin) == ("PROVED", "REFUTED", "REFUTED")
    assert _statuses(ca.sin, target=1) == ("PROVED",) * 3


@pytest.mark.parametrize(
    "broken",
    [{"coupling": lambda th: 0 * th}, {"damping": -0.1}, {"stiffness": -1}, {"spring": lambda x: -(x**4) / 40}],
)
def test_what_is_broken_is_not_global(broken):
    assert _statuses(**broken)[2] != "PROVED"
