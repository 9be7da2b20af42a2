"""Functions that jump: CasADi's derivatives do not show it, so nothing may be concluded from these alone."""

import casadi as ca
import pytest

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical, NaturalDamping, pipeline
from pbcgen.control.derive import derive
from pbcgen.control.ellipsoid import certified_ellipsoid
from pbcgen.proof.claim import Status

q, p, u = (ca.SX.sym(name) for name in ("q", "p", "u"))
LAW = DynamicExtension(alpha=3, beta=1, K_c=5, R_c=1)


def _claims(derivation):
    return {c.claim: c for c in derivation.claims}


def _body(gamma=q, force=0, spring=0):
    """A body with friction, a spring, and a force beside it; S knows nothing of the force."""
    S = p**2 / 2 + spring * q**2 / 2
    plant = AffineSystem([q, p], [u], [p, force - spring * q - p], [0, 1], S, gamma=[gamma])
    return Design(plant, {"q": "0.3"}, LAW, sample_period="1e-2", near={"q": "0.3"}, name="body")


@pytest.mark.parametrize("spring", [0, 1])
@pytest.mark.parametrize(
    "gamma",
    [
        q - 2 * ca.floor(q / 2),
        q - 2 * ca.ceil(q / 2),
        ca.fmod(q, 1),
        q + ca.sign(q),
        ca.copysign(1, q) + q,
        q + ca.if_else(q > 1, 2, 0),
        q - (q < -1),
        ca.atan2(ca.sin(q), ca.cos(q)),
    ],
)
def test_a_gamma_that_jumps_has_no_region_and_nothing_global(gamma, spring):
    """The wrapped angle of a body that is free: a start within the level left over the jump for another rest."""
    report = pipeline.check(_body(gamma, spring=spring))
    claims = _claims(report.derivation)
    assert claims["passive-output"].status is Status.UNDECIDED
    assert "may jump" in claims["passive-output"].evidence
    assert claims["globally-asymptotically-stable"].status is not Status.PROVED
    assert pipeline.region(report, 300).status is Status.UNDECIDED
    assert certified_ellipsoid(report.derivation) is None
    assert claims["asymptotically-stable"].status is Status.PROVED  # near x* there is no jump


@pytest.mark.parametrize("gamma", [q + ca.floor(q - 0.3), q + ca.if_else(q > 0.3, 1, 0), q + ca.sign(q - 0.3)])
def test_nothing_is_said_of_a_target_on_a_jump(gamma):
    claims = _claims(derive(_body(gamma)))
    for name in ("hessian-condition", "stable", "asymptotically-stable", "sampled-stable"):
        assert claims[name].status is Status.UNDECIDED, name
    assert "jumps there" in claims["asymptotically-stable"].evidence


@pytest.mark.parametrize(
    "force",
    [-3 * ca.floor(2 * q), -3 * ca.sign(q), ca.if_else(q < -0.2, -8, 0), 2 * ca.copysign(1, q), -8 * (q < -0.2)],
)
def test_no_ellipsoid_reaches_over_a_force_that_jumps(force):
    assert certified_ellipsoid(derive(_body(force=force, spring=1))) is None


def test_a_potential_that_jumps_is_not_global():
    """The slope of floor is zero: f does not have the blow at every whole q."""
    plant = Mechanical([q], [p], M=[1], V=q**2 / 2 + ca.floor(q), D=[1], G=[1])
    derivation = derive(Design(plant, {"q": "0.5"}, LAW, sample_period="1e-2", name="stairs"))
    assert _claims(derivation)["globally-asymptotically-stable"].status is Status.UNDECIDED
    assert certified_ellipsoid(derivation) is None


def test_an_eta_that_jumps_is_not_damped():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    plant = AffineSystem([x, y], [u], [-x, -y], [1, 0], (x**2 + y**2) / 2, eta=[y + ca.floor(y)], gamma=[x])
    law = NaturalDamping(2, 1, 1, 1, alpha_l=1, beta_l=1, K_l=10, R_l=10)
    claims = _claims(derive(Design(plant, {"x": 1, "y": "0.5"}, law, sample_period="1e-2", near={"y": 0}, name="e")))
    assert claims["assumption-3"].status is Status.UNDECIDED


@pytest.mark.parametrize("sensor", [ca.atan(ca.tan(q)), q + ca.atan(q) + ca.atan(1 / q), q + ca.floor(q)])
def test_a_sensor_that_jumps_does_not_give_the_position(sensor):
    """Its slope is one, and it is another number after a quarter turn."""
    plant = Mechanical([q], [p], M=[1], V=q**2 / 2, D=[1], G=[1], measured={"sensor": sensor})
    claims = _claims(derive(Design(plant, {"q": "0.3"}, LAW, sample_period="1e-2", name="wrapped")))
    assert claims["measurability"].status is not Status.PROVED


def test_a_sensor_that_jumps_at_the_target_is_named():
    plant = Mechanical([q], [p], M=[1], V=q**2 / 2, D=[1], G=[1], measured={"sensor": q + ca.sign(p)})
    claims = _claims(derive(Design(plant, {"q": "0.3"}, LAW, sample_period="1e-2", name="jumping")))
    assert "measured signal" in claims["stable"].evidence


def test_no_setting_is_proved_across_a_jump_of_gamma():
    design = _body(q + ca.floor(q), spring=1).with_(target_box={"q": ("0.1", "1.5")})
    assert _claims(derive(design))["adjustable"].status is Status.UNDECIDED
