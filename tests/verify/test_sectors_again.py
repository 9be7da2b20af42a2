"""Global stability by sectors of the saturations is checked again, and not believed of loops that are not stable."""

import functools

import casadi as ca
import pytest
from certificates import forged, outcomes, signed
from documents import GLOBAL, status, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension, Integral, Mechanical


def planar(turn=3, drag=lambda x: 0, damping=1, gain=1, stiff=1, **options):
    """Two states that turn into each other; gamma is no passive output, as the turning is not that of an energy."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    f = [-damping * x + turn * y, -x - y + drag(x)]
    system = AffineSystem([x, y], [ca.SX.sym("u")], f, [gain, 0], x**2 + y**2, gamma=[x + y], **options)
    return Design(system, {"x": 0, "y": 0}, DynamicExtension(stiff, 1, 1, 1), sample_period="1e-3", name="planar")


def spacecraft(turns=(-1, 2, -1)):
    """Three rates that exchange energy by products."""
    w, u = ca.SX.sym("w", 3), ca.SX.sym("u", 3)
    f = [turns[k] * w[(k + 1) % 3] * w[(k + 2) % 3] - w[k] / 10 for k in range(3)]
    law = DynamicExtension([1] * 3, [1] * 3, [1] * 3, [1] * 3)
    system = AffineSystem(w, u, f, ca.SX.eye(3), ca.sumsqr(w) / 2, gamma=[10 * w[k] for k in range(3)])
    return Design(system, {f"w_{k}": 0 for k in range(3)}, law, sample_period="1e-2", name="spacecraft")


def carts():
    """Two carts between springs; an integral term pulls at the first."""
    q, p = ([ca.SX.sym(f"{letter}{k}") for k in (1, 2)] for letter in "qp")
    V = (3 * q[0] ** 2 + 3 * (q[1] - q[0]) ** 2 + q[1] ** 2) / 2
    system = Mechanical(q, p, M=[1, 2], V=V, D=[1, 1], G=[[1], [0]])
    law = Integral(DynamicExtension(3, 2, 20, "0.5"), alpha_psi=1, beta_psi="0.3", R_psi="0.5")
    return Design(system, {"q2": "0.5"}, law, sample_period="1e-3", name="carts")


SHOWN = {"turning": planar(), "with an integral": carts(), "products": spacecraft()}


@functools.cache
def document_of(name):
    return written_for(SHOWN[name])


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
    P = found["P"]
    changes = [{"P": [["0"] * len(row) for row in P]}, {"P": [[f"-{v}" for v in row] for row in P]}, {"P": P[:-1]}]
    changes += [{"P": [*P[:-1], [*P[-1][:-1], "-1"]]}, {"P": [[*P[0][:-1], "1000000"], *P[1:]]}]
    for name in ("popov", "sectors", "integral"):
        changes += [{name: ["-1"] * len(found[name])}] if found[name] else [{name: ["1"]}]
        changes += [{name: found[name][:-1]}] if found[name] else []
    changes += [{"sectors": ["1000000"] * len(found["sectors"])}]
    changes += [{"integral": ["0"] * len(found["integral"])}] if found["integral"] else []
    for change in changes:
        assert outcomes(with_witness(shown, GLOBAL, **change))[GLOBAL] == "fails", change


FALSE = {
    "unstable by itself": planar(damping=-2),
    "with a saddle": planar(turn=-3),
    "with a push that grows": planar(drag=lambda x: x**3),
    "with a kink": planar(drag=ca.fabs),
    "with a pole": planar(drag=lambda x: 1 / (1 + x) - 1),
    "pushed the wrong way": planar(gain=-9, stiff=2),
    "stated on a domain": planar(domain={"x": (-1, 1)}),
}


@pytest.mark.parametrize("name", FALSE)
def test_it_is_not_believed_of_a_loop_that_it_is_not_true_of(name):
    document = forged(document_of("turning"), FALSE[name])
    assert outcomes(document)[GLOBAL] in ("fails", "recorded")


def test_products_that_feed_themselves_are_not_believed():
    assert outcomes(forged(document_of("products"), spacecraft((1, 2, -1))))[GLOBAL] == "fails"


@pytest.mark.parametrize("leak", ["[[0]]", "[[-1/2]]"])
def test_an_integral_that_does_not_leak_is_not_believed(leak):
    document = document_of("with an integral")
    lines = [f"gain R_psi = {leak}" if line.startswith("gain R_psi") else line for line in document["model"]]
    assert lines != document["model"]
    assert outcomes(signed(document | {"model": lines}))[GLOBAL] == "fails"


def test_it_is_for_this_law_only():
    document = document_of("turning")
    for law in ("law passive-output", "law natural-damping", "law potential-compensation", "law integral"):
        lines = [law if line.startswith("law ") else line for line in document["model"]]
        assert outcomes(signed(document | {"model": lines}))[GLOBAL] == "fails", law
