"""Domains that a saturated law keeps: claims for all states inside, and what leads out or is not kept is not proved."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical, Parameters
from pbcgen.control.attraction import attracted_level_set
from pbcgen.control.derive import derive
from pbcgen.control.kept_domain import is_kept
from pbcgen.sampling.common_storage import Array

NAME = "globally-asymptotically-stable"
TANKS = {"h1": (0, None), "h2": (0, None)}


def tanks(alpha=1, domain=None, drain=1):
    """Two tanks, the second with an outlet; a pump fills the first one."""
    p = Parameters(d=drain)
    h1, h2 = ca.SX.sym("h1"), ca.SX.sym("h2")
    f = [h2 - h1, h1 - h2 - p.d * h2]
    S = h1**2 / 2 + h2**2 / 2
    system = AffineSystem([h1, h2], ca.SX.sym("pump"), f, [1, 0], S, parameters=p, domain=domain or TANKS)
    return Design(system, {"h2": 1}, DynamicExtension(alpha, 2, 1, 1), sample_period="1e-2")


def gap(domain=(0, 1)):
    """A plate on a spring between two electrodes, drawn by a charge."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[1], V=(q - 0.5) ** 2, D=[1], G=[1], domain={"q": domain})
    return Design(system, {"q": "0.5"}, DynamicExtension(1, 1, 1, 1), sample_period="1e-2")


def _claim(design):
    found = derive(design)
    return found, next(c for c in found.claims if c.claim == NAME)


KEPT = {
    "a pump that does not suck": (tanks(), "h1 >= 0, h2 >= 0"),
    "a pump that never stops": (tanks("0.9"), "h1 >= 0, h2 >= 0"),
    "tanks that do not run over": (tanks(domain={"h1": (0, 5), "h2": (0, 3)}), "h1 in [0, 5], h2 in [0, 3]"),
    "one tank that does not": (tanks(domain={"h1": (0, None), "h2": (0, None)}), "h1 >= 0, h2 >= 0"),
}


@pytest.mark.parametrize("name", KEPT)
def test_a_domain_that_is_kept_has_a_claim_for_all_of_it(name):
    design, text = KEPT[name]
    found, claim = _claim(design)
    assert (str(claim.status), claim.domain) == ("PROVED", text)
    assert "the rates point inside" in claim.evidence
    assert next(c for c in found.claims if c.claim == "sampled-stable").domain == "sampled loop"


@pytest.mark.parametrize(
    "design",
    [
        tanks("1.001"),  # the pump may suck a little
        tanks(domain={"h1": (0, "4.999"), "h2": (0, 3)}),  # it may fill the first tank above its rim
        tanks(domain={"h1": (0, 5), "h2": (0, "2.4")}),  # or the second
        tanks(domain={"h1": (None, 5), "h2": (0, 3)}),  # the first tank may be in debt
        tanks(domain={"h1": (0, 5), "h2": (0, 3)}, drain=-1),
        gap(),
    ],
)
def test_what_may_be_left_is_not_proved(design):
    found, claim = _claim(design)
    assert claim.status != "PROVED"
    assert found.situation is None or not is_kept(found.situation)


def test_a_plate_that_strikes_its_stop_is_shown():
    _, claim = _claim(gap())
    assert "every input of the law leads out of it" in claim.evidence
    assert "at q = 0" in claim.evidence


def test_the_tanks_stay_where_it_is_proved():
    found, _ = _claim(KEPT["tanks that do not run over"][0])
    rate = found.plant.numeric(found.plant.system.xdot)
    generator = np.random.default_rng(2)
    for _ in range(20):
        x: Array = generator.uniform([0, 0], [5, 3])
        for _ in range(400):
            x = x + 0.01 * np.array(rate(x, generator.choice([0.0, 2.0]))).ravel()
            assert np.all(x >= 0)
            assert np.all(x <= [5, 3])


def test_the_region_of_attraction_is_the_whole_domain():
    found, claim = _claim(KEPT["tanks that do not run over"][0])
    region = attracted_level_set(found)
    assert claim.domain == "h1 in [0, 5], h2 in [0, 3]"
    assert region.box == {"h1": (0, 5), "h2": (0, 3)}
    assert region.contains([0, 3], at_zero=True)
    assert not region.contains([0, 3.001])
    assert region.as_json()["level"] is None
