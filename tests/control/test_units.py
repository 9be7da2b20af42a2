"""Verdicts do not depend on units: lengths, times and forces of nine powers of ten leave them as they are."""

from fractions import Fraction

import casadi as ca
import pytest

from pbcgen import Design, DynamicExtension, Limits, Mechanical, Parameters
from pbcgen.control.derive import derive

pytestmark = pytest.mark.system

TEN = Fraction(10)
UNITS = [(-9, -1, 6), (4, -3, 9)]


def pair(kind, length, time, force):
    """A driven mass that pulls another one, on a curve that is the same in units of these sizes."""
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    mass, damping = force * time**2 / length, force * time / length
    p = Parameters(m=mass, k=4 * force / length, d=damping / 2, E=force * length, w=1 / length)
    curve = {
        "pendulum": lambda z: 1 - ca.cos(z),
        "upright": ca.cos,
        "diode": lambda z: ca.exp(z) - z,
        "well": lambda z: (z**2 - 1) ** 2 / 4,
    }[kind]
    system = Mechanical(
        [q1, q2],
        [p1, p2],
        M=[2 * p.m, p.m],
        V=p.k * (q1 - q2) ** 2 / 2 + p.E * curve(p.w * q2),
        D=[p.d, p.d * (1 + (p.w * q2) ** 2)],
        G=[1, 0],
        parameters=p,
        measured=["q1"],
    )
    target = {"pendulum": Fraction(3, 10), "upright": 0, "diode": Fraction(3, 10), "well": 1}[kind]
    law = DynamicExtension(alpha=force / 10, beta=1 / length, K_c=5 * force / length, R_c=length / force / time)
    limits = Limits({"u_1": (-9 * force, 9 * force)})
    return Design(system, {"q2": target * length}, law, limits=limits, sample_period=time / 100, name=kind)


def statuses(kind, *sizes):
    return {claim.claim: claim.status.name for claim in derive(pair(kind, *sizes)).claims}


@pytest.mark.parametrize("kind", ["pendulum", "upright", "diode", "well"])
def test_verdicts_are_the_same_in_all_units(kind):
    expected = statuses(kind, Fraction(1), Fraction(1), Fraction(1))
    assert expected["globally-asymptotically-stable"] == ("PROVED" if kind == "diode" else "REFUTED")
    for powers in UNITS:
        assert statuses(kind, *(TEN**power for power in powers)) == expected
