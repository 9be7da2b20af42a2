"""Global stability by sectors is checked again, and not believed of loops that are not stable."""

import functools

import casadi as ca
import pytest
from certificates import forged, outcomes, signed
from documents import GLOBAL, status, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension, Integral, Mechanical, NaturalDamping
from pbcgen.certify.sectors_witness import in_sectors
from pbcgen.verify.stability import Stability

pytestmark = pytest.mark.system

LAW = DynamicExtension(1, 1, 1, 1)


def planar(turn=3, drag=lambda x, y: 0, damping=1, gain=lambda x, y: 1, law=LAW, target=0, **options):
    """Two states that turn into each other; gamma is no passive output, as the turning is not that of an energy."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    f = [-damping * x + turn * y, -x - y + drag(x, y)]
    options = {"gamma": [x + y]} | {name: value(x, y) for name, value in options.items()}
    system = AffineSystem([x, y], [ca.SX.sym("u")], f, [gain(x, y), 0], x**2 + y**2, **options)
    return Design(system, {"x": target}, law, sample_period="1e-3", name="planar")


def natural(damping=1, read=1):
    """A mass on a spring that a coil pulls at; the law reads where the mass is, and Theta does not hold."""
    q, w, i = (ca.SX.sym(name) for name in "qwi")
    f, S = [w, -q - damping * w + i, -2 * i - w], (q**2 + w**2 + i**2) / 2
    system = AffineSystem([q, w, i], ca.SX.sym("u"), f, [0, 0, 1], S, gamma=[q + i], eta=[read * q])
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l="0.5", R_l=1)
    return Design(system, {"q": 0}, law, sample_period="1e-3", name="natural")


def shaft(friction=1, pull=1, read=1):
    """A shaft that stands anywhere without the law."""
    q, w = ca.SX.sym("q"), ca.SX.sym("w")
    f = [w, -friction * w]
    system = AffineSystem([q, w], ca.SX.sym("u"), f, [0, pull], q**2 + w**2, gamma=[read * q])
    return Design(system, {"q": 0}, LAW, sample_period="1e-3", name="shaft")


def spacecraft(turns=(-1, 2, -1)):
    """Three rates that exchange energy by products."""
    w, u = ca.SX.sym("w", 3), ca.SX.sym("u", 3)
    f = [turns[k] * w[(k + 1) % 3] * w[(k + 2) % 3] - w[k] / 10 for k in range(3)]
    law = DynamicExtension([1] * 3, [1] * 3, [1] * 3, [1] * 3)
    system = AffineSystem(w, u, f, ca.SX.eye(3), ca.sumsqr(w) / 2, gamma=[10 * w[k] for k in range(3)])
    return Design(system, {f"w_{k}": 0 for k in range(3)}, law, sample_period="1e-2", name="spacecraft")


def carts(springs=(3, 3, 1), friction=1, **more):
    """Two carts between springs; an integral term pulls at the first."""
    q, p = ([ca.SX.sym(f"{letter}{k}") for k in (1, 2)] for letter in "qp")
    V = (springs[0] * q[0] ** 2 + springs[1] * (q[1] - q[0]) ** 2 + springs[2] * q[1] ** 2) / 2
    system = Mechanical(q, p, M=[1, 2], V=V, D=[friction, friction], G=[[1], [0]])
    kind = NaturalDamping if more else DynamicExtension
    law = Integral(kind(3, 2, 20, "0.5", **more), alpha_psi=1, beta_psi="0.3", R_psi="0.5")
    return Design(system, {"q2": "0.5"}, law, sample_period="1e-3", name="carts")


SHOWN = {
    "turning": planar,
    "with an integral": carts,
    "products": spacecraft,
    "friction": lambda: planar(drag=lambda x, y: -ca.tanh(2 * y) - ca.atan(y) / 2, target=1),
    "a diode": lambda: planar(drag=lambda x, y: -(ca.exp(y) - 1) / 5, target=1),
    "gravity": lambda: planar(drag=lambda x, y: ca.sin(y) / 3 + ca.cos(x) / 5 - ca.asinh(x + y) / 9, target="0.5"),
    "natural damping": natural,
    "natural damping with an integral": lambda: carts(alpha_l=1, beta_l=1, K_l=5, R_l=1),
    "nothing holds it": shaft,
    "nothing holds them": lambda: carts(springs=(0, 3, 0)),
}


@functools.cache
def document_of(name):
    return written_for(SHOWN[name]())


@pytest.fixture(scope="module", params=SHOWN)
def shown(request):
    document = document_of(request.param)
    assert status(document, GLOBAL) == "PROVED"
    assert "popov" in witness(document, GLOBAL)
    assert set(outcomes(document).values()) <= {"checked", "open"}
    return document


def test_the_numbers_must_show_it(shown):
    """Many numbers serve; those that do not are refused, whichever of them it is."""
    found = witness(shown, GLOBAL)
    P, count = found["P"], len(found["sectors"])
    nothing = [["0"] * len(row) for row in P]
    changes = [{"P": nothing}, {"P": nothing, "popov": ["0"] * count}, {"P": [[f"-{v}" for v in row] for row in P]}]
    changes += [{"P": P[:-1]}, {"P": []}, {"P": [*P[:-1], [*P[-1][:-1], "-1"]]}, {"P": [["1000000"], *P[1:]]}]
    for name in ("popov", "sectors", "integral"):
        changes += [{name: ["-1"] * len(found[name])}] if found[name] else [{name: ["1"]}]
        changes += [{name: found[name][:-1]}] if found[name] else []
        changes += [{name: [*found[name], "0"]}]
    changes += [{"sectors": ["1000000"] * count}, {"sectors": ["0"] * count}]
    changes += [{"integral": ["0"] * len(found["integral"])}] if found["integral"] else []
    for change in changes:
        assert outcomes(with_witness(shown, GLOBAL, **change))[GLOBAL] == "fails", change


@pytest.mark.parametrize("name", ["nothing holds it", "nothing holds them"])
def test_what_stands_anywhere_must_be_held_by_the_integrals(name):
    """P without the place, and no integral that grows with it: V' < 0 would not keep the states together."""
    document = document_of(name)
    P = witness(document, GLOBAL)["P"]
    without = [["0" if 0 in (i, j) else v for j, v in enumerate(row)] for i, row in enumerate(P)]
    zero = ["0"] * len(witness(document, GLOBAL)["popov"])
    assert outcomes(with_witness(document, GLOBAL, P=without))[GLOBAL] == "fails"
    assert outcomes(with_witness(document, GLOBAL, P=without, popov=zero))[GLOBAL] == "fails"


FALSE = {
    "turning": {
        "unstable by itself": lambda: planar(damping=-2),
        "with a saddle": lambda: planar(turn=-3),
        "with a push that grows": lambda: planar(drag=lambda x, y: x**3),
        "with a kink": lambda: planar(drag=lambda x, y: ca.fabs(x)),
        "with a pole": lambda: planar(drag=lambda x, y: 1 / (1 + x) - 1),
        "with a pole that cancels": lambda: planar(drag=lambda x, y: y * (x + 3) / (x + 2) - y / (x + 2) - y),
        "with cancelled logarithms": lambda: planar(
            drag=lambda x, y: ca.log(x + 2) * y - y * (ca.log(x + 2) + x) + x * y
        ),
        "with roots that cancel": lambda: planar(drag=lambda x, y: ca.sqrt(x + 2) * (y * ca.sqrt(x + 2)) - y * (x + 2)),
        "with an output that is not affine": lambda: planar(gamma=lambda x, y: [x + y + x**2]),
        "with an output that saturates": lambda: planar(gamma=lambda x, y: [x + ca.tanh(y)]),
        "with an input that acts twice as much there": lambda: planar(gain=lambda x, y: 1 + ca.tanh(x)),
        "with an input that acts as it stands": lambda: planar(gain=lambda x, y: x),
        "pushed the wrong way": lambda: planar(gain=lambda x, y: -9, law=DynamicExtension(2, 1, 1, 1)),
        "stated on a domain": lambda: planar(domain=lambda x, y: {"x": (-1, 1)}),
        "with another function": lambda: planar(drag=lambda x, y: 5 * ca.tanh(x)),
    },
    "products": {"that feed themselves": lambda: spacecraft((1, 2, -1))},
    "friction": {
        "that drives": lambda: planar(drag=lambda x, y: 0.45 * ca.tanh(2 * y) - ca.atan(x) * 9, target=1),
        "of the speed, and of the place": lambda: planar(drag=lambda x, y: -ca.tanh(2 * y) + 9 * ca.atan(x), target=1),
        "of the place": lambda: planar(drag=lambda x, y: 5 * ca.tanh(2 * x) - ca.atan(y) / 2, target=1),
        "of a product": lambda: planar(drag=lambda x, y: -ca.tanh(2 * y * x) - ca.atan(y) / 2, target=1),
        "times a state": lambda: planar(drag=lambda x, y: -ca.tanh(2 * y) * x - ca.atan(y) / 2, target=1),
        "squared": lambda: planar(drag=lambda x, y: -(ca.tanh(2 * y) ** 2) - ca.atan(y) / 2, target=1),
        "in a function": lambda: planar(drag=lambda x, y: -ca.tanh(ca.tanh(2 * y)) - ca.atan(y) / 2, target=1),
        "beside a square about an x* that is not exact": lambda: planar(
            drag=lambda x, y: -ca.tanh(2 * y) - ca.atan(y) / 2 + y**2 / 100, target=1
        ),
        "that turns over": lambda: planar(drag=lambda x, y: -ca.tanh(2 * y) - ca.sin(9 * y) / 20, target=1),
        "that grows without measure": lambda: planar(drag=lambda x, y: -ca.tanh(2 * y) - ca.exp(y), target=1),
    },
    "a diode": {
        "of the other sign": lambda: planar(drag=lambda x, y: (ca.exp(x) - 1) / 5, target=1),
        "that is none": lambda: planar(drag=lambda x, y: -9 * ca.sin(x), target=1),
    },
    "gravity": {
        "that is too strong": lambda: planar(
            drag=lambda x, y: ca.sin(y) / 3 + 9 * ca.cos(x) - ca.asinh(x + y) / 9, target="0.5"
        ),
        "and a push that grows": lambda: planar(
            drag=lambda x, y: ca.sin(y) / 3 + ca.cos(x) / 5 + 9 * ca.asinh(x), target="0.5"
        ),
    },
    "natural damping": {
        "that drives": lambda: natural(damping=-2),
        "of another signal": lambda: natural(read=-9),
    },
    "nothing holds it": {
        "and it is driven": lambda: shaft(friction=-1),
        "and it is pushed away": lambda: shaft(pull=-1),
        "and the law does not see it": lambda: shaft(read=0),
        "and nothing brakes it": lambda: shaft(friction=0),
    },
    "nothing holds them": {
        "and they are driven": lambda: carts(springs=(0, 3, 0), friction=-1),
        "and nothing brakes them": lambda: carts(springs=(0, 3, 0), friction=0),
        "and nothing joins them": lambda: carts(springs=(0, 0, 0)),
        "and a spring pushes": lambda: carts(springs=(0, 3, -1)),
    },
}


def grafted(document, design):
    """The certificate of another design with the verdict and the numbers of this one."""
    other = written_for(design)
    proved = next(entry for entry in document["claims"] if entry["claim"] == GLOBAL)
    claims = [proved if entry["claim"] == GLOBAL else entry for entry in other["claims"]]
    return signed(other | {"claims": claims})


@pytest.mark.parametrize(("name", "change"), [(name, change) for name in FALSE for change in FALSE[name]])
def test_it_is_not_believed_of_a_loop_that_it_is_not_true_of(name, change):
    broken = FALSE[name][change]()
    for document in (forged(document_of(name), broken), grafted(document_of(name), broken)):
        assert outcomes(document)[GLOBAL] in ("fails", "recorded")


GAINS = {
    "K_l": ("natural damping", "[[0]]", "[[-1/2]]"),
    "R_l": ("natural damping", "[[-1]]", "[[0]]"),
    "R_c": ("friction", "[[-1]]", "[[0]]"),
    "K_c": ("friction", "[[-1]]", "[[-1/9]]"),
    "beta_l": ("natural damping", "[100]"),
    "R_psi": ("with an integral", "[[0]]", "[[-1/2]]"),
    "alpha_psi": ("natural damping with an integral", "[100]"),
}


@pytest.mark.parametrize(("gain", "value"), [(gain, value) for gain, (_, *values) in GAINS.items() for value in values])
def test_it_is_not_believed_with_gains_that_it_is_not_true_for(gain, value):
    document = document_of(GAINS[gain][0])
    lines = [f"gain {gain} = {value}" if line.startswith(f"gain {gain} ") else line for line in document["model"]]
    assert lines != document["model"]
    assert outcomes(signed(document | {"model": lines}))[GLOBAL] == "fails"


@pytest.mark.parametrize("name", ["turning", "natural damping"])
def test_it_is_for_the_law_that_it_was_found_for(name):
    document = document_of(name)
    laws = ["passive-output", "potential-compensation", "integral"]
    laws += ["dynamic-extension" if name == "natural damping" else "natural-damping"]
    for law in laws:
        lines = [f"law {law}" if line.startswith("law ") else line for line in document["model"]]
        assert outcomes(signed(document | {"model": lines}))[GLOBAL] == "fails", law


def test_nothing_is_said_by_them_of_the_sampled_loop_far_away():
    """That its storage decreases needs one that grows with every state, which sectors do not show."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    spring = Mechanical([q], [p], M=[1], V=q**2 / 2, D=[1], G=[[1]])
    document = written_for(Design(spring, {"q": 0}, LAW, sample_period="1e-3", name="spring"))
    assert outcomes(document)["sampled-stable"] == "checked"
    assert next(c for c in document["claims"] if c["claim"] == "sampled-stable")["domain"] == "sampled loop, all x"
    other = in_sectors(Stability(document, 16))
    claims = [entry | {"witness": other} if entry["claim"] == GLOBAL else entry for entry in document["claims"]]
    found = outcomes(signed(document | {"claims": claims}))
    assert (found[GLOBAL], found["sampled-stable"]) == ("checked", "recorded")
