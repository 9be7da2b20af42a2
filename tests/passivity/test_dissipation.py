"""Assumption 3 and Theta: natural damping, its largest constants, and the bound on K_l R_l."""

import casadi as ca
import pytest
from flint import fmpq

from pbcgen import AffineSystem, Circuit, Design, Mechanical, NaturalDamping
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.passivity.damping_bounds import tightened
from pbcgen.proof.claim import Status
from pbcgen.verify.claims import examine


def _claims(design):
    return {c.claim: c for c in derive(design).claims}


def test_constants_below_the_dissipation_are_not_taken_from_an_indefinite_matrix():
    """D > 0 with eigenvalues of at least 0.0151, but with its diagonal lowered to constants it is indefinite."""
    x = [ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2")]
    q1, q2, p1, p2 = x
    less, more = 1 - 0.9 * ca.sin(q1), 1 + 0.9 * ca.sin(q1)
    f = [p1, p2, -2 * q1 - more * p1 - 0.4 * p2, -2 * q2 - 0.4 * p1 - less * p2]
    S = q1**2 + q2**2 + (p1**2 + p2**2) / 2
    system = AffineSystem(x, [ca.SX.sym("u")], f, [0, 0, 1, 0], S, eta=[q2])
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=1, R_l=1)
    derivation = derive(Design(system, target={"q1": 0, "q2": 0}, law=law, sample_period="1e-3", name="d"))
    claims = {c.claim: c for c in derivation.claims}
    assert claims["assumption-1"].status is claims["assumption-3"].status is Status.PROVED
    a, b = (float(v) for v in (derivation.bounds.Lambda_c[0], derivation.bounds.Lambda_l[0]))
    assert all((1 + 0.9 * s - a) * (1 - 0.9 * s - b) >= 0.4**2 for s in (-1, 0, 1))
    assert claims["theta"].status is not Status.PROVED


def test_a_constant_below_a_rational_friction_is_found():
    """B = [[1 + 1/(1 + i1^2), 1/2], [1/2, 3/10]] >= [[1, 1/2], [1/2, 3/10]] > 0."""
    i1, i2, v = (ca.SX.sym(name) for name in ("i1", "i2", "v"))
    drops = [i1 + ca.atan(i1) + 0.5 * i2, 0.5 * i1 + 0.3 * i2]
    eta = [0.3 * i1 - 0.5 * i2]
    circuit = Circuit([i1, i2], [v], L=[1, 1], C=[1], Gamma=[[1], [0]], v_R=drops, i_G=[v], g_L=[[0], [-1]], eta=eta)
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=1, R_l=1)
    claims = _claims(Design(circuit, target={"i1": 0, "i2": 0, "v": 0}, law=law, sample_period="1e-3", name="d"))
    assert claims["assumption-3"].status is Status.PROVED


def _bell(z, width=1e-4):
    return ca.exp(-(((z - 1.7) / width) ** 2))


#: The friction of q2 and q1, K_l = R_l, and the verdicts on assumption-3 and theta.
FRICTION = {
    "constant": (lambda a, b, v: (1, 1), 5, "PROVED", "PROVED"),
    "above a constant": (lambda a, b, v: (1 + ca.sin(b) / 2, 1 + 0.3 * ca.cos(a)), 5, "PROVED", "PROVED"),
    "weak in a band": (lambda a, b, v: (1 - 0.999 * _bell(b), 1), 5, "PROVED", "REFUTED"),
    "weak in a band, gains for it": (lambda a, b, v: (1 - 0.999 * _bell(b), 1), 50, "PROVED", "PROVED"),
    "touching zero in a band": (lambda a, b, v: (1 - _bell(b), 1), 5, "REFUTED", "REFUTED"),
    "touching zero in a ball": (lambda a, b, v: (1 - _bell(b, 1e-3) * _bell(v, 1e-3), 1), 5, "REFUTED", "REFUTED"),
    "touching zero at a point": (lambda a, b, v: ((b - 1.7) ** 2, 1), 5, "REFUTED", "REFUTED"),
    "negative in a band": (lambda a, b, v: (1 - 1.001 * _bell(b), 1), 5, "REFUTED", "REFUTED"),
    "vanishing far away": (lambda a, b, v: (1 / (1 + b**2), 1), 5, "UNDECIDED", "REFUTED"),
    "above a constant that nothing shows": (
        lambda a, b, v: (1, (b - 1) ** 2 + ca.exp(-b)),
        5,
        "UNDECIDED",
        "UNDECIDED",
    ),
    "none": (lambda a, b, v: (0, 1), 5, "REFUTED", "REFUTED"),
    "none at the port": (lambda a, b, v: (1, 0), 5, "REFUTED", "REFUTED"),
}


@pytest.mark.parametrize("case", FRICTION)
def test_missing_and_weak_damping_is_found_wherever_it_is(case):
    friction, gain, damped, strong = FRICTION[case]
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    V = q1**2 + q2**2 + (q1 - q2) ** 2
    own, driven = friction(q1, q2, p2)
    system = Mechanical([q1, q2], [p1, p2], M=[1, 2], V=V, D=[driven, own], G=[1, 0], eta=[q2])
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=gain, R_l=gain)
    claims = _claims(Design(system, target={"q1": 0, "q2": 0}, law=law, sample_period="1e-3"))
    assert (claims["assumption-3"].status, claims["theta"].status) == (damped, strong)
    for name in ("assumption-3", "theta"):
        assert (claims[name].counterexample is not None) == (claims[name].status is Status.REFUTED)


def _masses(own, domain=None, **options):
    """Two masses; the damping of the second one depends on its position."""
    q1, q2, p1, p2 = (ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2"))
    V = q1**2 + q2**2 + (q1 - q2) ** 2
    parts = {"M": [1, 2], "V": V, "D": [1, own(q2)], "G": [1, 0], "eta": [q2], "domain": domain, **options}
    return Mechanical([q1, q2], [p1, p2], **parts)


def _coupled(damping):
    """The same with a damping between the masses."""
    q1, q2, p1, p2 = x = [ca.SX.sym(name) for name in ("q1", "q2", "p1", "p2")]
    V = q1**2 + q2**2 + (q1 - q2) ** 2
    rates = [p1, p2 / 2, 2 * q2 - 4 * q1 - p1 - damping(q2) * p2 / 2, 2 * q1 - 4 * q2 - damping(q2) * p1 - p2 / 2]
    return AffineSystem(x, [ca.SX.sym("u")], rates, [0, 0, 1, 0], V + p1**2 / 2 + p2**2 / 4, eta=[q2])


def _three_currents(own, domain=None):
    i = i1, i2, i3 = [ca.SX.sym(name) for name in ("i1", "i2", "i3")]
    v = ca.SX.sym("v")
    drops, sources = [2 * i1 - i1**3 / 3, 2 * i2, own(i3)], [[-1, 0], [0, -1], [0, 0]]
    Gamma = [[1], [1], [0]]
    return Circuit(i, [v], L=[1, 1, 1], C=[1], Gamma=Gamma, v_R=drops, i_G=[v], g_L=sources, domain=domain)


_FADING, _BOX = (lambda q: 1 / (1 + q**2)), {"q2": (-2, 2)}
_CURRENTS = {"i1": (-1, 1), "i3": ("-0.5", "0.5")}
#: A system, its verdict, and where constants hold with them.
VARYING = {
    "fading friction": (_masses(_FADING), "UNDECIDED", None, None),
    "fading friction on a box": (_masses(_FADING, _BOX), "PROVED", "q2 in [-2, 2]", ("0.2", "1")),
    "least at the edge": (_masses(lambda q: 1 + q, {"q2": ("-0.5", 2)}), "PROVED", "q2 in [-0.5, 2]", ("0.5", "1")),
    "zero at the edge": (_masses(lambda q: 1 + q, {"q2": (-1, 2)}), "REFUTED", "q2 in [-1, 2]", None),
    "negative beyond the edge": (_masses(lambda q: 1 + q, {"q2": (-1.1, 2)}), "REFUTED", None, None),
    "damping between the masses": (_coupled(lambda q: ca.sin(q) / 2), "PROVED", "all x", ("0.5", "0.5")),
    "damping that becomes singular": (_coupled(ca.sin), "UNDECIDED", None, None),
    "two outputs on a box": (
        _three_currents(lambda i: i - i**3 / 3, _CURRENTS),
        "PROVED",
        "i1 in [-1, 1], i3 in [-0.5, 0.5]",
        ("0.75", "0.25, 0.25"),
    ),
    "two outputs, and a resistor that falls": (_three_currents(lambda i: i**3 - i / 9, _CURRENTS), None, None, None),
}


@pytest.mark.parametrize("case", VARYING)
def test_constants_for_damping_that_varies(case):
    system, status, domain, Lambda = VARYING[case]
    m = system.lower().m
    law = NaturalDamping([1] * m, [1] * m, [1] * m, [1] * m, alpha_l=[1] * m, beta_l=[1] * m, K_l=[5] * m, R_l=[5] * m)
    target = dict.fromkeys(("q1", "q2") if m == 1 else ("i1", "i3", "v"), 0)
    derivation = derive(Design(system, target=target, law=law, sample_period="1e-3"))
    claim = next(c for c in derivation.claims if c.claim == "assumption-3")
    if status is None:
        assert claim.status is not Status.PROVED
        return
    assert claim.status == status
    assert domain is None or claim.domain == domain
    if Lambda is not None:
        assert f"Lambda_l = diag({Lambda[0]}), Lambda_c = diag({Lambda[1]})" in claim.evidence
        theta = next(c for c in derivation.claims if c.claim == "theta")
        assert (theta.status, theta.domain) == (Status.PROVED, domain)
        outcome = {f.claim: f.outcome for f in examine(certificate(derivation))}
        assert outcome["assumption-3"] == outcome["theta"] == "checked"


def test_outputs_that_share_their_damping_get_the_largest_multiple():
    """W = [[1, 1/2, 1/2], [1/2, 1, -1/2], [1/2, -1/2, 1]] has eigenvalue 3/2, but rows that sum up to 2."""
    W = [[fmpq(1), fmpq(1, 2), fmpq(1, 2)], [fmpq(1, 2), fmpq(1), fmpq(-1, 2)], [fmpq(1, 2), fmpq(-1, 2), fmpq(1)]]
    found = tightened(W, [fmpq(2)] * 3)
    assert all(fmpq(3, 2) <= v <= fmpq(151, 100) for v in found)
    assert tightened([[fmpq(2)]], [fmpq(2)]) == [fmpq(2)]


def test_an_input_that_does_nothing_has_no_damping_to_name():
    x, y, u, v = (ca.SX.sym(name) for name in "xyuv")
    plant = AffineSystem([x, y], [u, v], [-x, -y], [[0, 1], [0, 0]], (x**2 + y**2) / 2, eta=[y])
    law = NaturalDamping(2, 1, 1, 1, alpha_l=1, beta_l=1, K_l=1, R_l=1)
    claims = _claims(Design(plant, {"x": 1, "y": 0}, law, sample_period="1e-2", name="idle input"))
    assert claims["input-rank"].status is Status.REFUTED
    assert claims["assumption-3"].status is Status.UNDECIDED
    assert "the input does nothing" in claims["assumption-3"].evidence


def test_an_eta_that_shares_a_direction_with_gamma_is_named_so():
    x, y, u = (ca.SX.sym(name) for name in "xyu")
    plant = AffineSystem([x, y], [u], [-x, -y], [1, 0], (x**2 + y**2) / 2, eta=[x + y])
    law = NaturalDamping(2, 1, 1, 1, alpha_l=1, beta_l=1, K_l=1, R_l=1)
    claim = _claims(Design(plant, {"x": 1}, law, sample_period="1e-2", name="shared"))["assumption-3"]
    assert claim.status is Status.UNDECIDED
    assert "orthogonal" in claim.hint
