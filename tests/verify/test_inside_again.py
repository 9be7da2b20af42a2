"""Global claims on a domain are checked again, and not believed of loops that leave it or rest elsewhere in it."""

import copy
import functools

import casadi as ca
import pytest
from certificates import forged, outcomes, signed
from documents import GLOBAL, status, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical, PassiveOutput

pytestmark = pytest.mark.system

OPEN = {"h1": (0, None), "h2": (0, None)}
RIMS = {"h1": (0, 5), "h2": (0, 3)}


def tanks(
    alpha=1,
    domain=OPEN,
    drain=1,
    joint=1,
    loss=lambda a: 0,
    law=None,
    potential=lambda h: h,
    energy=lambda h: h**2 / 2,
    target=1,
):
    """Two tanks that a pump fills, with flows by the potentials of their levels; the first has a loss of its own."""
    h1, h2 = ca.SX.sym("h1"), ca.SX.sym("h2")
    a, b = potential(h1), potential(h2)
    f = [joint * (b - a) - loss(a), a - b - drain * b]
    system = AffineSystem([h1, h2], ca.SX.sym("pump"), f, [1, 0], energy(h1) + energy(h2), domain=domain)
    return Design(system, {"h2": target}, law or DynamicExtension(alpha, 2, 1, 1), sample_period="1e-2", name="tanks")


def pumps(alpha="0.2", sink=0):
    """Three tanks with two pumps."""
    h = [ca.SX.sym(f"h{k}") for k in (1, 2, 3)]
    f = [h[1] - h[0] - sink, h[0] + h[2] - 5 * h[1] / 2, h[1] - h[2]]
    S = sum(v**2 for v in h) / 2
    system = AffineSystem(
        h, ca.SX.sym("u", 2), f, [[1, 0], [0, 0], [0, 1]], S, domain=dict.fromkeys(("h1", "h2", "h3"), (0, None))
    )
    law = DynamicExtension([alpha] * 2, [2, 2], [1, 1], [1, 1])
    return Design(system, {"h1": "1.5", "h3": "1.5"}, law, sample_period="1e-2", name="pumps")


def steep(alpha="0.9", **changes):
    """Levels whose potentials are not linear."""
    parts = {"potential": lambda h: h + h**3, "energy": lambda h: h**2 / 2 + h**4 / 4, "alpha": alpha}
    return tanks(**{**parts, **changes})


def piston(V, domain=(0, None), D=lambda q, p: 1, target="1.3", alpha=2):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[[1]], V=V(q), D=[D(q, p)], G=[[1]], domain={"q": domain})
    return Design(system, {"q": target}, DynamicExtension(alpha, 1, 1, 1), sample_period="1e-2", name="piston")


def gas(q):
    return q - ca.log(q)


def stops(q):
    return 1 / q + 1 / (1 - q)


def species(loss="0.2", domain=(0, None), hunt=1, S=lambda h: h - ca.log(h)):
    """Prey a, which is fed or hunted by the input, and predators b."""
    a, b, u = (ca.SX.sym(name) for name in "abu")
    f = [a * (1 - b), hunt * b * (a - 1) - float(loss) * b * (b - 1)]
    system = AffineSystem([a, b], [u], f, [a, 0], S(a) + S(b), domain={"a": domain, "b": domain})
    return Design(
        system, {"b": "1.2"}, DynamicExtension("0.9", 1, 1, 1), sample_period="1e-2", near={"a": 1}, name="species"
    )


KEPT = {
    "a pump that does not suck": tanks(),
    "tanks that do not run over": tanks(domain=RIMS),
    "two pumps": pumps(),
    "steep levels": steep(),
    "steep levels below rims": steep("0.3", domain={"h1": (0, 2), "h2": (0, "1.8")}),
    "the law that measures its output": tanks(law=PassiveOutput("0.5", 1, "0.4")),
}
RISING = {
    "a gas spring": piston(gas),
    "a polytropic one": piston(lambda q: q**-0.4 / 0.4 + q),
    "friction that varies": piston(lambda q: gas(q) + q**2 / 3, D=lambda q, p: 1 + p**2, target="0.7", alpha=3),
    "an upper end": piston(lambda q: q**2 - 3 * ca.log(2 - q), (None, 2), D=lambda q, p: ca.exp(q), alpha=6),
    "two stops": piston(stops, (0, 1), target="0.6"),
    "logarithms at both": piston(lambda q: -ca.log(q) - ca.log(1 - q), (0, 1), target="0.6"),
    "two species": species(),
}
SHOWN = KEPT | RISING


@functools.cache
def _written(name):
    return written_for(SHOWN[name])


def _document(name):
    return copy.deepcopy(_written(name))


def stated(document, text):
    """The document with another domain of the global claim."""
    document = copy.deepcopy(document)
    for entry in document["claims"]:
        if entry["claim"] == GLOBAL:
            entry["domain"] = text
    return signed(document)


def text_of(design, closed):
    """The domain of a design in words."""
    parts = []
    for name, ends in design.system.domain.items():
        lo, hi = (None if v is None else f"{float(v):g}" for v in ends)
        both = f"{name} in [{lo}, {hi}]" if closed else f"{name} in ({lo}, {hi})"
        one = f"{name} > {lo}" if hi is None else f"{name} < {hi}"
        parts.append(
            both if None not in (lo, hi) else one if not closed else one.replace("> ", ">= ").replace("< ", "<= ")
        )
    return ", ".join(parts)


@pytest.mark.parametrize("name", SHOWN)
def test_every_verdict_is_checked_again(name):
    document = _document(name)
    assert status(document, GLOBAL) == "PROVED"
    assert next(e["domain"] for e in document["claims"] if e["claim"] == GLOBAL) == text_of(SHOWN[name], name in KEPT)
    assert ("kept" in witness(document, GLOBAL)) == (name in KEPT)
    assert set(outcomes(document).values()) <= {"checked", "open"}


LEFT = {
    "a pump that sucks": tanks("1.001"),
    "a rim that is too low": tanks(domain=RIMS | {"h1": (0, "4.999")}),
    "the other rim": tanks(domain=RIMS | {"h2": (0, "2.4")}),
    "a tank in debt": tanks(domain={"h1": (None, 5), "h2": (0, 3)}),
    "an outlet that fills": tanks(drain=-1),
    "a joint that pulls": tanks(joint=-1),
    "a leak that levels do not know of": tanks(loss=lambda a: 1),
}


@pytest.mark.parametrize("name", LEFT)
@pytest.mark.parametrize("honest", ["a pump that does not suck", "tanks that do not run over"])
def test_a_domain_that_may_be_left_is_not_believed(name, honest):
    document = forged(_document(honest), LEFT[name])
    for text in ("all x", text_of(LEFT[name], True)):
        assert outcomes(stated(document, text))[GLOBAL] == "fails"


def test_two_pumps_are_not_believed_of_a_sink_or_larger_pulls():
    for design in (pumps(sink=0.25), pumps(alpha="0.7")):
        assert outcomes(forged(_document("two pumps"), design))[GLOBAL] == "fails"


def test_steep_levels_are_not_believed_to_stay_below_lower_rims():
    for change in ({"h1": (0, "1.9")}, {"h2": (0, "1.7")}, {"h1": ("0.1", 2)}, {"h2": ("0.5", "1.8")}):
        design = steep("0.3", domain={"h1": (0, 2), "h2": (0, "1.8")} | change)
        document = stated(forged(_document("steep levels below rims"), design), text_of(design, True))
        assert outcomes(document)[GLOBAL] == "fails", change


FALSE = {
    "nothing stops it": ("a gas spring", piston(lambda q: q**2 / 2)),
    "a stop of finite height": ("a gas spring", piston(lambda q: q**2 / 2 + q * ca.log(q))),
    "it pulls towards zero": ("a gas spring", piston(lambda q: q + ca.log(q))),
    "undefined on a part": ("a gas spring", piston(gas, (-1, None))),
    "a second rest": ("a gas spring", piston(lambda q: gas(q) + 5 * ca.exp(-4 * (q - 3) ** 2))),
    "the other end is open": ("a gas spring", piston(gas, (0, 10))),
    "it flies away": ("a gas spring", piston(lambda q: 1 / q - q**2 / 4)),
    "it drives": ("a gas spring", piston(gas, D=lambda q, p: -1)),
    "it does not rub": ("a gas spring", piston(gas, D=lambda q, p: 0)),
    "one stop is open": ("two stops", piston(lambda q: 1 / q + q, (0, 1), target="0.6")),
    "one that pulls": ("two stops", piston(lambda q: -ca.log(q) + ca.log(1 - q), (0, 1), target="0.6")),
    "stops inside": ("two stops", piston(stops, (0, 2), target="0.6")),
    "a second rest between": (
        "two stops",
        piston(lambda q: stops(q) - 60 * ca.exp(-200 * (q - 0.3) ** 2), (0, 1), target="0.6"),
    ),
    "species that feed themselves": ("two species", species("-0.2")),
    "species without losses": ("two species", species(0)),
    "hunters that starve": ("two species", species(hunt=-1)),
    "species stored by squares": ("two species", species(S=lambda h: h**2 / 2)),
}


@pytest.mark.parametrize("name", FALSE)
def test_an_end_that_may_be_reached_is_not_believed(name):
    honest, design = FALSE[name]
    document = forged(_document(honest), design)
    for closed in (False, True):
        assert outcomes(stated(document, text_of(design, closed)))[GLOBAL] != "checked"


@pytest.mark.parametrize("name", KEPT)
def test_what_keeps_a_domain_must_show_it(name):
    document = _document(name)
    kept = witness(document, GLOBAL)["kept"]
    changes = [{"inputs": [["-1/100", "1/100"]] * len(kept["inputs"])}, {"inputs": kept["inputs"][:-1]}]
    changes += [{"inputs": [["-1e9", "1e9"]] * len(kept["inputs"])}, {"inputs": []}]
    changes += [{"ends": []}, {"ends": kept["ends"][:-1]}, {"ends": [[] for _ in kept["ends"]]}]
    changes += [{"ends": kept["ends"][::-1]}] if kept["ends"] != kept["ends"][::-1] else []
    for change in changes:
        assert outcomes(with_witness(document, GLOBAL, kept=kept | change))[GLOBAL] == "fails", change


@pytest.mark.parametrize("name", RISING)
def test_what_rises_towards_the_ends_must_show_it(name):
    document = _document(name)
    growth = witness(document, GLOBAL)["growth"]
    convex = growth["convex"]
    changes = [{"convex": convex | {"states": []}}, {"convex": convex | {"squares": [], "corners": [{"squares": []}]}}]
    changes += (
        [{"convex": {"states": convex["states"], "squares": convex.get("squares", [])}}] if "forces" in convex else []
    )
    changes += [{"convex": convex | {"forces": [["0", "0"]]}}, {"convex": convex | {"forces": [["5", "6"]]}}]
    changes += [{"terms": []}, {"terms": growth["terms"][:-1]}]
    changes += [{"spans": []}, {"parts": []}] if growth["parts"] else []
    for change in changes:
        assert outcomes(with_witness(document, GLOBAL, growth=growth | change))[GLOBAL] == "fails", change


@pytest.mark.parametrize(("name", "texts"), [
    ("a gas spring", ["q >= 0", "all x", "q > -1", "q > 0, p > 0", "all x but q > 0", "q > 0 or not"]),
    ("two stops", ["q in [0, 1]", "q in (0, 1]", "q in [0, 1)", "q in (0, 2)", "q > 0", "all x", "q > 0, q < 1"]),
    ("a pump that does not suck", ["h1 >= 0", "h1 >= -1, h2 >= 0", "all x", "not h1 >= 0, h2 >= 0", "h1 > 0, h2 <= 0"]),
])  # fmt: skip
def test_it_is_shown_for_the_domain_that_is_stated(name, texts):
    for text in texts:
        assert outcomes(stated(_document(name), text))[GLOBAL] != "checked", text


def test_what_is_kept_settles_from_the_inside_too():
    assert outcomes(stated(_document("a pump that does not suck"), "h1 > 0, h2 > 0"))[GLOBAL] == "checked"


def test_a_function_that_is_another_beyond_the_domain_is_not_taken_for_one_that_varies():
    """``sqrt((q - 3)^2) - 3 + q`` is zero where q < 3, and a motion there rests on nothing."""

    def bent(q):
        return ca.sqrt((q - 3) ** 2) - 3 + q

    for V in (lambda q: gas(q) + bent(q), lambda q: bent(q) - ca.log(q), bent):
        design = piston(V, (0, 2))
        assert outcomes(stated(forged(_document("a gas spring"), design), "q in (0, 2)"))[GLOBAL] != "checked"


@pytest.mark.parametrize("name", ["a pump that does not suck", "a gas spring"])
def test_it_says_nothing_of_all_states_of_a_sampled_loop(name):
    """The storage argument for the samples holds while the states are in the domain, which held inputs may leave."""
    document = with_witness(_document(name), "sampled-stable", Lambda=[["1/2"]])
    for entry in document["claims"]:
        entry["domain"] = "sampled loop, all x" if entry["claim"] == "sampled-stable" else entry["domain"]
    assert outcomes(signed(document))["sampled-stable"] != "checked"
