"""Motions that nothing stops refute `stable`; on the leaves of what is conserved, and beside friction, it is proved."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical
from pbcgen.control.derive import derive

LAW = DynamicExtension(3, 1, 2, 1)


def pair(masses=(1, 2), D=(0, 0), ground=0.0, G=(1, -1), spring=1.0):
    """Two masses that a spring joins, with a force between them."""
    q, p = ([ca.SX.sym(f"{letter}{k}") for k in (1, 2)] for letter in "qp")
    r = q[0] - q[1]
    V = spring * r**2 / 2 + r**4 / 4 + ground * (q[0] + q[1]) ** 2 / 2
    system = Mechanical(q, p, M=list(masses), V=V, D=list(D), G=list(G))
    return Design(system, {"q1": 1, "q2": 0}, LAW, sample_period="1e-2")


def relative(speed=0):
    """The same in the distance of the masses and their momenta; both have the given speed."""
    r, p1, p2 = (ca.SX.sym(name) for name in ("r", "p1", "p2"))
    S = r**2 / 2 + p1**2 / 2 + p2**2 / 4
    system = AffineSystem([r, p1, p2], ca.SX.sym("u"), [p1 - p2 / 2, -r, r], [0, 1, -1], S)
    return Design(system, {"r": 1, "p1": speed}, LAW, sample_period="1e-2", near={"p2": 2 * speed})


def _stable(design):
    found = derive(design)
    return found, next(c for c in found.claims if c.claim == "stable")


@pytest.mark.parametrize("design", [pair(), pair((3, 3)), pair(D=[[1, -1], [-1, 1]]), pair(spring=-0.5)])
def test_a_free_pair_drifts_away(design):
    found, claim = _stable(design)
    assert claim.status == "REFUTED"
    rate = found.plant.numeric(found.plant.system.xdot)
    gamma = found.plant.numeric(found.gamma)
    names = found.plant.system.state_names
    star, u = (np.array([float(v) for v in part]) for part in (found.point.x, found.point.u))
    start, speed = (
        np.array([float(Fraction(claim.counterexample[key].get(n, "0"))) for n in names]) for key in ("start", "rate")
    )
    for s, t in ((0.01, 0.0), (0.01, 50.0), (-2.0, 7.0)):
        x = star + s * (start + t * speed)
        assert np.allclose(np.array(rate(x, u)).ravel(), s * speed, atol=1e-12)
        assert np.allclose(np.array(gamma(x, u)), np.array(gamma(star, u)))
    assert np.any(speed)


@pytest.mark.parametrize("design", [relative(), relative(3), pair(D=(1, 1))])
def test_on_leaves_of_what_is_conserved_the_pair_is_stable(design):
    assert _stable(design)[1].status == "PROVED"


@pytest.mark.parametrize("design", [pair(ground=1.0), pair(G=(1, 0)), pair(ground=1.0, D=(1, 1))])
def test_what_is_tied_to_the_ground_does_not_drift(design):
    assert _stable(design)[1].status != "REFUTED"
