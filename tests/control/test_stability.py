"""Stable, asymptotically stable, global: the right status, and none that contradicts another."""

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Integral, Mechanical, PassiveOutput
from pbcgen.certify.certificate import certificate
from pbcgen.control.derive import derive
from pbcgen.pipeline import check
from pbcgen.proof.claim import Status
from pbcgen.verify.claims import examine

PROVED, REFUTED, UNDECIDED = Status.PROVED, Status.REFUTED, Status.UNDECIDED


def _claims(system, target, **gains):
    law = DynamicExtension(**{"alpha": 1, "beta": 1, "K_c": 1, "R_c": 1, **gains})
    derivation = derive(Design(system, target=target, law=law, sample_period="1e-3", name="d"))
    return {c.claim: c for c in derivation.claims}


def _plane(f, g=(0, 1), S=None):
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    return AffineSystem([x, y], [u], f(x, y), list(g), x**2 / 2 + y**2 / 2 if S is None else S(x, y))


def _pendulums(G, D):
    q, p = [ca.SX.sym("q1"), ca.SX.sym("q2")], [ca.SX.sym("p1"), ca.SX.sym("p2")]
    V = 9.81 * (2 - ca.cos(q[0]) - ca.cos(q[1])) + (q[0] - q[1]) ** 2
    return Mechanical(q, p, M=[1, 1], V=V, D=D, G=G)


def test_cubic_damping_is_asymptotically_stable_although_the_linearisation_does_not_say_so():
    """x' = -x^3 has an eigenvalue 0; the global claim implies the local one."""
    claims = _claims(_plane(lambda x, y: [-(x**3), -y]), {"x": 0, "y": 0})
    assert claims["globally-asymptotically-stable"].status is PROVED
    assert claims["asymptotically-stable"].status is PROVED


@pytest.mark.parametrize("power", [2, 3])
def test_a_growing_nonlinearity_with_eigenvalue_zero_is_not_proved(power):
    claims = _claims(_plane(lambda x, y: [x**power, -y]), {"x": 0, "y": 0})
    for claim in ("stable", "asymptotically-stable", "globally-asymptotically-stable", "sampled-stable"):
        assert claims[claim].status is not PROVED


@pytest.mark.system
def test_an_undamped_symmetric_mode_is_stable_and_not_asymptotically_stable():
    """Two equal pendulums, the same force on both: the motion against each other is not seen."""
    claims = _claims(_pendulums([1, 1], [0, 0]), {"q1": 0, "q2": 0}, alpha=5)
    assert claims["stable"].status is PROVED
    assert claims["asymptotically-stable"].status is not PROVED


def test_damping_of_one_pendulum_reaches_the_symmetric_mode():
    claims = _claims(_pendulums([1, 1], [0.1, 0]), {"q1": 0, "q2": 0}, alpha=5)
    assert claims["asymptotically-stable"].status is PROVED
    assert claims["globally-asymptotically-stable"].status is REFUTED


@pytest.mark.parametrize("domain", [None, {"q": (0, None)}])
def test_a_rest_where_the_model_is_not_stated_refutes_nothing(domain):
    """The spring 1 - 1/q has a rest at negative q too, where its energy q - log(q) is not defined."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[1], V=q - ca.log(q), D=[0.3], G=[1], domain=domain)
    claims = _claims(system, {"q": 1}, alpha=2, beta=2, K_c=20)
    assert claims["asymptotically-stable"].status is PROVED
    assert claims["globally-asymptotically-stable"].status is not REFUTED


@pytest.mark.parametrize(("bounds", "status"), [((-3, 3), UNDECIDED), ((-4, 4), REFUTED)])
def test_a_second_rest_counts_within_the_stated_domain(bounds, status):
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[1], V=2 - 2 * ca.cos(q), D=[0.3], G=[1], domain={"q": bounds})
    claims = _claims(system, {"q": 0}, beta=2, K_c=20)
    assert claims["globally-asymptotically-stable"].status is status


def test_a_conserved_charge_is_not_asymptotically_stable():
    a, b, c, u = (ca.SX.sym(name) for name in "abcu")
    system = AffineSystem([a, b, c], [u], [b - a, a - b, -c], [0, 0, 1], (a**2 + b**2 + c**2) / 2)
    claims = _claims(system, {"a": 1, "b": 1, "c": 0})
    assert claims["asymptotically-stable"].status is REFUTED
    assert claims["sampled-stable"].status is not PROVED


def test_a_storage_that_decreases_by_luck_proves_nothing_for_the_closed_loop():
    """f = -B grad S with an indefinite B and exponentials in grad S: the closed loop is unstable."""
    system = _plane(
        lambda x, y: [-ca.exp(x) - 2 * ca.exp(y), -2 * ca.exp(x) - ca.exp(y)],
        (3, 3),
        lambda x, y: ca.exp(x) + ca.exp(y),
    )
    claims = _claims(system, {"x": 0, "y": 0}, alpha=2, beta=3)
    assert claims["equilibrium"].status is PROVED
    assert claims["stable"].status is not PROVED


@pytest.mark.parametrize("model", ["well", "hanging", "maglev", "negative mass"])
def test_stable_is_never_proved_where_the_linearisation_is_unstable(model):
    q, p, lam = (ca.SX.sym(name) for name in ("q", "p", "lam"))
    u = ca.SX.sym("u")
    systems = {
        "well": (Mechanical([q], [p], M=[1], V=(q**2 - 1) ** 2, D=[0.1], G=[1]), {"q": 0}),
        "hanging": (Mechanical([q], [p], M=[1], V=9.81 * ca.cos(q), D=[0.1], G=[1]), {"q": 0}),
        "negative mass": (AffineSystem([q, p], [u], [-p, 2 * q + p], [0, 1], -(p**2) / 2 - q**2), {"q": 0}),
        "maglev": (
            AffineSystem(
                [lam, q, p],
                [u],
                [-2 * (1 - q) * lam, 10 * p, lam**2 / 2 - 0.981],
                [1, 0, 0],
                (1 - q) * lam**2 / 2 + 5 * p**2 + 0.981 * q,
            ),
            {"q": "0.5", "lam": "1.4"},
        ),
    }
    system, target = systems[model]
    claims = _claims(system, target)
    assert claims["stable"].status is not PROVED
    assert claims["asymptotically-stable"].status is not PROVED
    assert claims["hessian-condition"].status is not PROVED


def test_growth_of_the_storage_in_every_direction_is_refuted():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    claims = _claims(AffineSystem([x], [u], [x], [1], x**2 / 2), {"x": 1})
    assert claims["assumption-1"].status is REFUTED


@pytest.mark.parametrize(
    ("gains", "hint"),
    [
        ({"alpha": 3, "beta": 2, "K_c": 20}, "lower alpha_psi*beta_psi or raise R_psi"),
        ({"alpha": 1, "beta": 1, "K_c": 20}, "satisfy hessian-condition"),
    ],
)
def test_the_hint_for_an_unstable_integral_law_names_what_makes_it_unstable(gains, hint):
    """The inverted pendulum with m g l = 2: alpha beta = 6 holds it, 1 does not; a strong filter upsets it."""
    q, p = ca.SX.sym("q"), ca.SX.sym("p")
    system = Mechanical([q], [p], M=[1], V=2 * ca.cos(q), D=[0.1], G=[1])
    law = Integral(DynamicExtension(**gains, R_c=1), alpha_psi=5, beta_psi=5, R_psi=0)
    derivation = derive(Design(system, {"q": 0}, law, sample_period="1e-3", name="d"))
    claims = {c.claim: c for c in derivation.claims}
    assert claims["asymptotically-stable"].status is REFUTED
    assert claims["asymptotically-stable"].hint.startswith(hint)


@pytest.mark.parametrize(("gamma", "status"), [(1, PROVED), (-1, UNDECIDED)])
def test_an_algebraic_loop_that_is_not_proved_solvable_gives_no_law(gamma, status):
    """x' = -x + u with y = gamma x': W = gamma, and y + W k tanh(y) = c is monotone for W >= 0 only."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = AffineSystem([x], [u], [-x], [1], x**2 / 2, gamma=[gamma * x])
    design = Design(system, {"x": 0}, PassiveOutput(alpha=1, beta=1, k_p=2), sample_period="1e-3", name="d")
    derivation = derive(design)
    assert {c.claim: c.status for c in derivation.claims}["stable"] is status
    assert (derivation.graph is not None) == (status is PROVED)


@pytest.mark.parametrize(("K_c", "R_c"), [([[4, -2], [-2, 1]], 1), ([[1, 2], [2, 1]], 1), ([[1, 2], [2, 1]], 100)])
def test_filters_that_are_singular_or_cannot_take_a_step_are_refused_in_words(K_c, R_c):
    """K_c of rank one leaves the rest of the filters open; with R_c = 100, I + h R_c K_c is singular."""
    x, y, u, v = (ca.SX.sym(name) for name in "xyuv")
    plant = AffineSystem([x, y], [u, v], [-x - y**3, x * y**2 - y], [[1, 0], [0, 1]], (x**2 + y**2) / 2)
    law = DynamicExtension([2, 3], [1, 2], K_c=K_c, R_c=R_c)
    report = check(Design(plant, {"x": 1, "y": 0}, law, sample_period="1e-2", name="trial"))
    assert {c.claim: c.status for c in report.claims}["gain-definiteness"] is Status.REFUTED
    assert ("must be positive definite" in report.unwritable) == (R_c == 100)
    assert "fails" not in {f.outcome for f in examine(certificate(report.derivation))}
