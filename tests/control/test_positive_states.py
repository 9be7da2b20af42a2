"""Global claims for states that are positive: proved inside the domain where the storage grows at its edge."""

from __future__ import annotations

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical, check

LAW = DynamicExtension(2, 1, 1, 1)
NAME = "globally-asymptotically-stable"


def _claims(system, target, near=None, law=LAW):
    report = check(Design(system, target, law, sample_period="1e-2", near=near or {}))
    return {c.claim: c for c in report.claims}


def _verdict(*arguments, **keywords):
    claim = _claims(*arguments, **keywords)[NAME]
    return str(claim.status), claim.domain


def _piston(V, domain=(0, None), damping=1):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    return Mechanical([q], [p], M=[[1]], V=V(q), D=[damping], G=[[1]], domain={"q": domain})


@pytest.mark.parametrize("V", [lambda q: q - ca.log(q), lambda q: q + 1 / q, lambda q: 2 * q + 1 / q**2 - ca.log(q)])
def test_a_piston_on_a_gas_spring_returns_from_every_volume(V):
    assert _verdict(_piston(V), {"q": "1.3"}) == ("PROVED", "q > 0")


def test_what_a_gas_spring_stores_has_no_value_where_it_is_crushed():
    claims = _claims(_piston(lambda q: q - ca.log(q)), {"q": "1.3"})
    where = {claims[name].domain for name in ("assumption-1", "passive-output")}
    assert where == {"all x where the model is defined"}


def test_an_upper_end_and_another_place_serve_too():
    assert _verdict(_piston(lambda q: -q - ca.log(2 - q), (None, 2)), {"q": "1.5"}) == ("PROVED", "q < 2")
    assert _verdict(_piston(lambda q: q - ca.log(q - 0.5), ("0.5", None)), {"q": "1.3"}) == ("PROVED", "q > 0.5")


@pytest.mark.parametrize(
    ("V", "domain"),
    [
        (lambda q: -ca.log(q) - ca.log(1 - q), (0, 1)),
        (lambda q: 1 / q + 1 / (1 - q), (0, 1)),
        (lambda q: 1 / (q - 0.2) + 2 / (1.7 - q), ("0.2", "1.7")),
    ],
)
def test_two_stops_that_store_more_and_more_are_never_reached(V, domain):
    text = f"q in ({domain[0]}, {domain[1]})"
    assert _verdict(_piston(V, domain), {"q": "0.6"}) == ("PROVED", text)


@pytest.mark.parametrize(
    "broken",
    [
        {"V": lambda q: (q - 0.5) ** 2},  # nothing stops it
        {"V": lambda q: 1 / q + q},  # one stop is open
        {"V": lambda q: q * ca.log(q) + (1 - q) * ca.log(1 - q)},  # stops of finite height
        {"V": lambda q: -ca.log(q) + ca.log(1 - q)},  # one that pulls
        {"V": lambda q: 1 / q + 1 / (1 - q), "domain": (0, 2)},  # undefined inside
        {"V": lambda q: 1 / q + 1 / (1 - q), "damping": -1},
        {"V": lambda q: 1 / q + 1 / (1 - q) - 60 * ca.exp(-200 * (q - 0.3) ** 2)},  # a second rest
    ],
)
def test_between_two_stops_what_is_not_kept_is_not_proved(broken):
    arguments = {"domain": (0, 1), "damping": 1, **broken}
    assert _verdict(_piston(**arguments), {"q": "0.6"})[0] != "PROVED"


@pytest.mark.parametrize(
    "broken",
    [
        {"V": lambda q: q**2 / 2},  # nothing keeps q from zero
        {"V": lambda q: q**2 / 2 + q * ca.log(q)},  # nor here: q ln q has a limit
        {"V": lambda q: q + ca.log(q)},  # it pulls towards zero
        {"V": lambda q: q - ca.log(q), "domain": (-1, None)},  # undefined on a part
        {"V": lambda q: q - ca.log(q) + 5 * ca.exp(-4 * (q - 3) ** 2)},  # a second rest
        {"V": lambda q: q - ca.log(q), "domain": (0, 10)},  # the other end is open
        {"V": lambda q: 1 / q - q**2 / 4},  # it flies away
        {"V": lambda q: q - ca.log(q), "damping": -1},
    ],
)
def test_what_is_not_kept_inside_is_not_proved(broken):
    arguments = {"domain": (0, None), "damping": 1, **broken}
    assert _verdict(_piston(**arguments), {"q": "1.3"})[0] != "PROVED"


def _species(loss, S=lambda h: h - ca.log(h), domain=(0, None)):
    """Prey a, which is fed or hunted by the input, and predators b."""
    a, b, u = (ca.SX.sym(name) for name in "abu")
    f = [a * (1 - b), b * (a - 1) - loss * b * (b - 1)]
    return AffineSystem([a, b], [u], f, [a, 0], S(a) + S(b), domain={"a": domain, "b": domain})


def test_two_species_return_to_any_target_that_the_law_holds():
    law = DynamicExtension("0.9", 1, 1, 1)
    claims = _claims(_species(0.2), {"a": 1, "b": 1}, law=law)
    assert (str(claims[NAME].status), claims[NAME].domain) == ("PROVED", "a > 0, b > 0")
    assert claims["sampled-stable"].domain == "sampled loop"
    assert _verdict(_species(0.2), {"b": "1.2"}, {"a": 1}, law) == ("PROVED", "a > 0, b > 0")


def test_species_without_losses_of_their_own_are_not_damped():
    claims = _claims(_species(-0.2), {"a": 1, "b": 1})
    assert claims["assumption-1"].status == "REFUTED"
    assert claims[NAME].status != "PROVED"


def test_a_bounded_domain_of_positive_states_stays_local():
    assert _verdict(_species(0.2, domain=("0.1", 5)), {"a": 1, "b": 1})[0] != "PROVED"


def test_logarithmic_coordinates_themselves_are_global():
    z, w, u = (ca.SX.sym(name) for name in "zwu")
    f = [1 - ca.exp(w), ca.exp(z) - 1 - (ca.exp(w) - 1) / 5]
    system = AffineSystem([z, w], [u], f, [1, 0], ca.exp(z) - z + ca.exp(w) - w)
    assert _verdict(system, {"w": "0.2"}, {"z": 0}) == ("PROVED", "all x")
