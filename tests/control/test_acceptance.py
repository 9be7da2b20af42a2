"""Systems whose verdicts follow by hand, each on one side of a margin or with one trap; no two are alike."""

import casadi as ca
import pytest

from pbcgen import (
    AffineSystem,
    Circuit,
    Design,
    DynamicExtension,
    Limits,
    Mechanical,
    NaturalDamping,
    Parameters,
    PotentialCompensation,
)
from pbcgen.control.derive import derive

pytestmark = pytest.mark.system

STABLE, ASYMPTOTIC, GLOBAL = "stable", "asymptotically-stable", "globally-asymptotically-stable"


def filtered(alpha=9, beta=2, K_c=10, R_c=1):
    return DynamicExtension(alpha=alpha, beta=beta, K_c=K_c, R_c=R_c)


def masses(n, V, D, G, target, law=None, M=None, **keywords):
    q, p = ([ca.SX.sym(f"{name}{k + 1}") for k in range(n)] for name in "qp")
    friction = D(*q, *p) if callable(D) else D
    limits = keywords.pop("limits", None)
    inertia = M(*q) if M else [1 + k / 2 for k in range(n)]
    system = Mechanical(q, p, M=inertia, V=V(*q), D=friction, G=G, **keywords)
    return Design(system, target, law or filtered(), sample_period="1e-3", limits=limits, name="masses")


def balanced(alpha_beta, K_c, length=1):
    """A link upright behind a spring of 6, m g l = 2: alpha beta > 3 is needed, and K_c > 4 for alpha beta = 12."""
    p = Parameters(s=length, d="0.1", I="0.05", J="0.02")
    link, motor, p1, p2 = (ca.SX.sym(name) for name in ("link", "motor", "p1", "p2"))
    V = 2 * ca.cos(p.s * link) + 3 * (p.s * link - motor) ** 2
    damping = [p.d * p.s**2, p.d]
    system = Mechanical([link, motor], [p1, p2], M=[p.I * p.s**2, p.J], V=V, D=damping, G=[0, 1], parameters=p)
    return Design(system, {"link": 0}, filtered(alpha_beta, 1, K_c), sample_period="1e-4", name="balanced")


def two_channels(coupling):
    """Two of them: K_c > 4 I is needed in the Loewner order; [[5, k], [k, 5]] has the eigenvalues 5 - k, 5 + k."""
    q, p = ([ca.SX.sym(f"{name}{k}") for k in range(4)] for name in "qp")
    V = 2 * ca.cos(q[0]) + 2 * ca.cos(q[1]) + 3 * ((q[0] - q[2]) ** 2 + (q[1] - q[3]) ** 2)
    G = [[0, 0], [0, 0], [1, 0], [0, 1]]
    system = Mechanical(q, p, M=[0.05, 0.04, 0.02, 0.03], V=V, D=[0.1] * 4, G=G)
    law = filtered([12, 12], 1, [[5, coupling], [coupling, 5]], [[1, "0.2"], ["0.2", 1]])
    return Design(system, {"q0": 0, "q1": 0}, law, sample_period="1e-4", name="channels")


def shared_friction(R_l, Upsilon):
    """Lambda_l = (0.25, 0.2), Lambda_c = (0.5, 0.4): (Upsilon diag(4, 5) Upsilon^T + diag(2, 2.5)) / 4 is the bound."""
    q, p = ([ca.SX.sym(f"{name}{k}") for k in range(4)] for name in "qp")
    V = 2 * (q[0] - q[2]) ** 2 + 2 * (q[1] - q[3]) ** 2 + (q[2] - q[3]) ** 2 / 2 + (q[0] - q[1]) ** 2 / 3
    G = [[1, 0], [0, 1], [0, 0], [0, 0]]
    system = Mechanical(q, p, M=[1, 2, 1, 2], V=V, D=[0.5, 0.4, 0.25, 0.2], G=G)
    law = NaturalDamping(
        alpha_c=[2, 3], beta_c=[3, 2], K_c=[[20, 2], [2, 30]], R_c=[["0.5", "0.1"], ["0.1", "0.4"]],
        alpha_l=[1, 1], beta_l=[1, 1], K_l=[1, 1], R_l=R_l, Upsilon=Upsilon,
    )  # fmt: skip
    near = {"q2": 0, "q3": 0}
    return Design(system, {"q0": "0.2", "q1": "-0.1"}, law, sample_period="1e-3", near=near, name="shared")


def arm(limit):
    """The largest torques of gravity are 5 + 2 and 2, those of the law 2 and 1."""
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    c = 0.8 * ca.cos(q2)
    V = 5 * ca.cos(q1) + 2 * ca.cos(q1 + q2)
    system = Mechanical([q1, q2], [p1, p2], M=[[3 + 2 * c, 1 + c], [1 + c, 1]], V=V, D=[1, 1], G=[[1, 0], [0, 1]])
    law = PotentialCompensation(alpha=[2, 1], beta=[2, 3], K_c=[1, 1], R_c=[1, 1])
    limits = Limits({"u_1": (-9, limit), "u_2": (-3, 3)})
    return Design(system, {"q1": "0.5", "q2": "-0.3"}, law, sample_period="1e-3", limits=limits, name="arm")


def radiator():
    """Two bodies, one of which radiates: the storage is the integral of the flows, on a domain of temperatures."""
    T, C, u = (ca.SX.sym(name) for name in ("T", "C", "u"))
    p = Parameters(s="5.67e-8", r="0.5")
    f = [-(T - C) / p.r / 500, ((T - C) / p.r - p.s * C**4) / 2000]
    S = (T - C) ** 2 / (2 * p.r) + p.s * C**5 / 5
    domain = {"T": (200, 800), "C": (200, 700)}
    system = AffineSystem([T, C], [u], f, [1 / 500, 0], S, parameters=p, domain=domain)
    return Design(system, {"C": 350}, filtered(300, "0.01"), sample_period=1, name="radiator")


def tunnel_diode():
    """The slope of the load 3 v^2 - 3 v + 0.9 is positive everywhere, by 0.15."""
    i, v = ca.SX.sym("i"), ca.SX.sym("v")
    load = v**3 - 1.5 * v**2 + 0.9 * v
    circuit = Circuit([i], [v], L=[0.1], C=[0.1], Gamma=[[1]], v_R=[i], i_G=[load], g_L=[-1])
    return Design(circuit, {"v": "0.3"}, filtered("0.2", 1, 1), sample_period="1e-3", name="diode")


def single(V, D=1, target=0, law=None, **keywords):
    friction = (lambda q, p: [D(q, p)]) if callable(D) else [D]
    return masses(1, V, friction, [1], {"q1": target}, law, **keywords)


def hanging(q):
    """A pendulum with m g l = 1."""
    return -ca.cos(q)


def star(second, third):
    """Two masses hang on a damped and driven one; alike, they can swing against each other unseen."""
    V = lambda a, b, c: ca.cosh(a - b) + ca.cosh(a - c) + a**2  # noqa: E731
    return masses(3, V, [0.4, 0, 0], [1, 0, 0], {"q1": 0}, M=lambda *q: [1, second, third])


CASES = {
    "alpha beta exactly at its threshold": (lambda: balanced(3, 10**6), {"hessian-condition": "REFUTED"}),
    "the same in units of 1e-6": (lambda: balanced(3, 10**6, "1e6"), {"hessian-condition": "REFUTED"}),
    "alpha beta above by 1e-12": (lambda: balanced("3.000000000003", 10**15), {"hessian-condition": "PROVED"}),
    "K_c exactly at its bound": (lambda: balanced(12, 4), {"kc-bound": "REFUTED"}),
    "K_c above by 1e-6": (lambda: balanced(12, "4.000004"), {"kc-bound": "PROVED", ASYMPTOTIC: "PROVED"}),
    "K_c below by 1e-6": (lambda: balanced(12, "3.999996"), {"kc-bound": "REFUTED", ASYMPTOTIC: "REFUTED"}),
    "K_c with 5 - k = 4": (lambda: two_channels(1), {"kc-bound": "REFUTED"}),
    "K_c with 5 - k below 4": (lambda: two_channels("1.000001"), {"kc-bound": "REFUTED", STABLE: "REFUTED"}),
    "Theta touches zero": (
        lambda: shared_friction([4, "3.125"], [[1, 1], [0, 1]]),
        {"assumption-3": "PROVED", "theta": "PROVED"},
    ),
    "Theta is negative by 1e-6": (lambda: shared_friction([4, "3.124997"], [[1, 1], [0, 1]]), {"theta": "REFUTED"}),
    "two harmonics touch a limit": (lambda: arm(9), {"saturation": "PROVED", GLOBAL: "PROVED"}),
    "two harmonics exceed a limit": (lambda: arm("8.999999"), {"saturation": "REFUTED"}),
    "friction that ends at the edge of the domain": (
        lambda: single(lambda q: q**2, lambda q, p: 1 - q**2, "0.1", domain={"q1": (-1, 1)}),
        {"assumption-1": "PROVED", ASYMPTOTIC: "PROVED", GLOBAL: "UNDECIDED"},
    ),
    "friction that ends just inside of it": (
        lambda: single(lambda q: q**2, lambda q, p: 1 - q**2, "0.1", domain={"q1": (-1, "1.0000001")}),
        {"assumption-1": "REFUTED", ASYMPTOTIC: "PROVED"},
    ),
    "friction that touches zero": (
        lambda: single(lambda q: q**2, lambda q, p: (q - 1) ** 2, 1),
        {"assumption-1": "PROVED", GLOBAL: "PROVED"},
    ),
    "friction with a pole elsewhere": (
        lambda: single(lambda q: q**2, lambda q, p: 1 + 1 / (q - 3) ** 2, "0.1"),
        {ASYMPTOTIC: "PROVED", GLOBAL: "UNDECIDED"},
    ),
    "a force that alpha does not reach but S carries": (
        lambda: single(lambda q: 4 * ca.sqrt(1 + q**2), 1, 1, filtered("0.1", 1, 1)),
        {GLOBAL: "PROVED"},
    ),
    "a pendulum held strongly": (lambda: single(hanging, 1, 0, filtered("1.5", 4, 100)), {GLOBAL: "PROVED"}),
    "a pendulum held weakly": (lambda: single(hanging, 1, 0, filtered("0.5", 4, 100)), {GLOBAL: "REFUTED"}),
    "two masses that swing unseen": (lambda: star(2, 2), {STABLE: "PROVED", ASYMPTOTIC: "REFUTED"}),
    "two masses that cubic friction slows down": (
        lambda: masses(2, lambda a, b: a**2 + b**2, lambda a, b, p, r: [0.1, r**2], [1, 0], {"q1": 0}),
        {ASYMPTOTIC: "PROVED", GLOBAL: "PROVED"},
    ),
    "no friction but that of the filter": (
        lambda: masses(2, lambda a, b: ca.cosh(a - b) + ca.cosh(b), [0, 0], [1, 0], {"q1": 0}),
        {ASYMPTOTIC: "PROVED", GLOBAL: "PROVED"},
    ),
    "a body that radiates": (radiator, {"assumption-1": "PROVED", "passive-output": "PROVED", ASYMPTOTIC: "PROVED"}),
    "a load with little slope": (tunnel_diode, {GLOBAL: "PROVED"}),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_verdicts_are_those_of_a_calculation_by_hand(name):
    make, expected = CASES[name]
    found = {claim.claim: claim for claim in derive(make()).claims}
    assert {claim: found[claim].status.name for claim in expected} == expected
    assert all(claim.counterexample is not None for claim in found.values() if claim.status.name == "REFUTED")
