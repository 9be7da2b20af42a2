"""Theta in the Loewner order: eta and gamma may share their damping, and Lambda need not be diagonal."""

from fractions import Fraction
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from flint import fmpq

from pbcgen import AffineSystem, Design, Mechanical, NaturalDamping
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.models.affine import Structure
from pbcgen.proof.claim import Status
from pbcgen.symbolic.plain.formulas import rational
from pbcgen.verify.claims import examine
from pbcgen.verify.files import digest

pytestmark = pytest.mark.system


def _design(D, G, gain, upsilon=None, target=("q1",)):
    n = len(D)
    q, p = ([ca.SX.sym(f"{letter}{k + 1}") for k in range(n)] for letter in "qp")
    V = sum(v**2 for v in q) + sum((a - b) ** 2 for a, b in pairwise(q))
    D = [[entry(q[0]) if callable(entry) else entry for entry in row] for row in D]
    m = len(G[0])
    system = Mechanical(q, p, M=[1] * n, V=V, D=D, G=G, eta=q[m:])
    gains = {"alpha_l": [1] * m, "beta_l": [1] * m, "K_l": gain, "R_l": [1] * m}
    law = NaturalDamping([1] * m, [1] * m, [1] * m, [1] * m, Upsilon=upsilon, **gains)
    return Design(system, target=dict.fromkeys(target, 0), law=law, sample_period="1e-3")


def _two(own, shared, driven, gain):
    """Mass 1 is driven; ``shared`` is the damping between its velocity and that of mass 2."""
    return _design([[driven, shared], [shared, own]], [[1], [0]], [gain])


def _theta(design):
    derivation = derive(design)
    return derivation, next(c for c in derivation.claims if c.claim == "theta")


#: Shared damping c beside 1 and 1: K_l R_l >= 1 / (2 (1 - c)). A diagonal Lambda asks for 1 / (2 (1 - |c|)).
MARGINS = [(-0.5, "1/3"), (0.5, "1"), (0.75, "2"), (-0.75, "2/7"), (-0.25, "0.4"), (0, "0.5")]


@pytest.mark.parametrize(("shared", "least"), MARGINS)
def test_the_bound_is_met_exactly(shared, least):
    for gain, status in ((least, "PROVED"), (_below(least), "REFUTED")):
        derivation, claim = _theta(_two(1, shared, 1, gain))
        assert claim.status == status
        assert {f.claim: f.outcome for f in examine(certificate(derivation))}["theta"] == "checked"


def _below(value):
    return Fraction(value) * (1 - Fraction(1, 10**9))


def _slow(q):
    return 2 + ca.sin(q)  # between 1 and 3


@pytest.mark.parametrize(
    ("gain", "shared", "driven", "status"),
    [
        ("0.34", -0.5, _slow, "PROVED"),  # a third is enough where sin = -1; diagonal constants need 1
        ("0.33", -0.5, _slow, "REFUTED"),
        ("1.01", 0.5, _slow, "PROVED"),
        ("0.99", 0.5, _slow, "REFUTED"),
        ("0.34", -0.5, lambda q: 2 - 1.1 * ca.sin(q), None),
        ("0.34", -0.5, lambda q: 1 + 0.2 * q, None),
        ("0.34", -0.5, lambda q: 1 - q**2, None),
        ("0.34", -0.5, lambda q: 1 + 1 / (1 + q**2), "PROVED"),
        ("0.33", -0.5, lambda q: 1 + 1 / (1 + q**2), None),
        ("0.33", -0.51, lambda q: 0.99 + q**2, None),
        ("1", 0.5, lambda q: 1 - 1e-6 * ca.exp(-(q**2)), None),
        ("1", 0.5, lambda q: 1 + ca.exp(q), "PROVED"),
    ],
)
def test_damping_that_varies_carries_the_filter_or_does_not(gain, shared, driven, status):
    derivation, claim = _theta(_two(1, shared, driven, gain))
    if status is None:
        assert claim.status is not Status.PROVED
    else:
        assert claim.status == status
    if claim.status is Status.PROVED:
        found = {f.claim: f.outcome for f in examine(certificate(derivation))}
        assert found["theta"] == found["asymptotically-stable"] == "checked"


@pytest.mark.parametrize("seed", range(8))
def test_it_agrees_with_eigenvalues(seed):
    """``[[D, (E C)^T / 2], [E C / 2, K_l R_l]] >= 0`` decides it, C picking (eta', y)."""
    rng = np.random.default_rng(seed)
    root = rng.integers(-3, 4, (3, 3)) / 4
    D = root @ root.T + np.eye(3) / 8
    upsilon = rng.integers(-2, 3, (2, 1)) / 2
    upsilon[0] += 0.5 * (not upsilon.any())
    gain = rng.integers(1, 40, 2) / 8
    E = np.hstack([upsilon, -np.eye(2)])[:, [1, 2, 0]]
    least = np.linalg.eigvalsh(np.block([[D, E.T / 2], [E / 2, np.diag(gain)]]))[0]
    design = _design(D.tolist(), [[1, 0], [0, 1], [0, 0]], list(map(str, gain)), upsilon.tolist(), ("q1", "q2"))
    _, claim = _theta(design)
    assert abs(least) > 1e-9
    assert claim.status == ("PROVED" if least > 0 else "REFUTED")


def test_a_larger_lambda_is_refused():
    derivation, claim = _theta(_two(1, -0.5, _slow, "0.34"))
    assert claim.status is Status.PROVED
    for change in (lambda v: v * fmpq(101, 100), lambda v: v * 0, lambda v: -v):
        document = certificate(derivation)
        witness = next(c["witness"] for c in document["claims"] if c["claim"] == "theta")
        witness["Lambda"] = [[str(change(rational(v))) for v in row] for row in witness["Lambda"]]
        document["digest"] = digest(document)
        assert {f.claim: f.outcome for f in examine(document)}["theta"] == "fails"


def _springs(friction, gain):
    """Two masses on springs with a friction that is a function of the velocity."""
    q, p = ([ca.SX.sym(f"{letter}{k}") for k in (1, 2)] for letter in "qp")
    pull = q[0] - q[1]
    f = [p[0], -q[0] - pull - friction(p[0]), p[1], pull - friction(p[1])]
    S = (q[0] ** 2 + pull**2 + p[0] ** 2 + p[1] ** 2) / 2
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=gain, R_l=1, Upsilon=1)
    system = AffineSystem(
        [q[0], p[0], q[1], p[1]], ca.SX.sym("u"), f, [0, 1, 0, 0], S, eta=[q[1]], measured=["q1", "q2"]
    )
    return Design(system, {"q1": 0, "q2": 0}, law, sample_period="1e-3")


@pytest.mark.parametrize(
    ("friction", "least"),
    [
        (lambda p: p + p * ca.cosh(p), "0.25"),
        (lambda p: p + p * ca.exp(p**2), "0.25"),
        (lambda p: p * (1 + p**2) + p**3 * ca.exp(p), "0.5"),
        (lambda p: 2 * p + ca.tanh(p), "0.25"),
    ],
)
def test_friction_beside_the_structure_damps_too(friction, least):
    for gain, status in ((least, "PROVED"), (Fraction(least) * Fraction(999, 1000), "REFUTED")):
        derivation, claim = _theta(_springs(friction, gain))
        assert claim.status == status
        assert {f.claim: f.outcome for f in examine(certificate(derivation))}["theta"] == "checked"


@pytest.mark.parametrize("friction", [lambda p: p + ca.sinh(p), lambda p: p + p * ca.sqrt(1 + p**2)])
def test_a_constant_that_is_only_not_the_largest_refutes_nothing(friction):
    """A quarter is enough, though the constants that are found ask for a half."""
    for gain in ("0.3", "0.26"):
        assert _theta(_springs(friction, gain))[1].status is not Status.REFUTED
    assert _theta(_springs(friction, "0.24"))[1].status == "REFUTED"


def test_what_no_state_brings_about_refutes_nothing():
    """S does not depend on z, so that F may have any column for it: what it says there is lost never is."""
    q, p, z = (ca.SX.sym(name) for name in "qpz")
    F = ca.SX([[0, 1, 0], [-1, -1, -1], [0, 1, -1]])
    system = AffineSystem(
        [q, p, z], ca.SX.sym("u"), [p, -q - p, p], [0, 1, 0], (q**2 + p**2) / 2, structure=Structure(F=F), eta=[z]
    )
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l="0.1", R_l=1, Upsilon=1)
    assert _theta(Design(system, {"q": 0, "z": 0}, law, sample_period="1e-3"))[1].status is not Status.REFUTED


def test_a_state_with_enough_damping_refutes_nothing_in_a_certificate():
    derivation, claim = _theta(_two(1, -0.5, 1, "0.3"))
    assert claim.status == "REFUTED"
    document = certificate(derivation)
    (entry,) = [e for e in document["claims"] if e["claim"] == "theta"]
    found = entry["witness"]["x"]
    for x in (["0"] * len(found), [*found[:2], "1", "1", "0"], found[:-1], [*found, "0"]):
        entry["witness"] = {"x": x}
        assert {f.claim: f.outcome for f in examine(document)}["theta"] == "fails"


@pytest.mark.parametrize(
    "friction", [ca.sinh, lambda p: p * ca.sqrt(1 + p**2), lambda p: p**3 + ca.tanh(p), lambda p: ca.asinh(p) + p**3]
)
def test_friction_beside_a_lossless_structure_is_not_overlooked(friction):
    """Each is at least a multiple of p, so that there is a Lambda; the structure alone loses nothing."""
    derivation, _ = _theta(_springs(friction, "1"))
    claims = {c.claim: c.status for c in derivation.claims}
    assert claims["assumption-3"] is not Status.REFUTED
    assert claims["theta"] is not Status.REFUTED


@pytest.mark.parametrize("friction", [lambda p: 0 * p, lambda p: p**3])
def test_a_port_without_linear_friction_is_refuted_at_most_by_a_state(friction):
    derivation, _ = _theta(_springs(friction, "1"))
    claim = next(c for c in derivation.claims if c.claim == "assumption-3")
    lossless = Fraction(0) == friction(Fraction(1))
    assert claim.status == ("REFUTED" if lossless else "UNDECIDED")
    if lossless:
        assert claim.counterexample["u^T y - S'"] == "0"
        assert {f.claim: f.outcome for f in examine(certificate(derivation))}["assumption-3"] == "checked"
