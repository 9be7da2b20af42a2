"""That no gamma exists, by the response at a rest; and the gradient condition by the rank of [A, g]: checked again."""

import casadi as ca
import pytest
from certificates import forged, outcomes
from documents import status, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension

OUTPUT, GRADIENT = "passive-output", "gradient-condition"


def motor(target, k=1, loss=0.1, kink=0, domain=None):
    """A motor with a wound field, its currents and speed; ``kink`` bends the storage where the speed is 5."""
    field, armature, speed = x = [ca.SX.sym(name) for name in ("i_f", "i_a", "omega")]
    u = [ca.SX.sym("u_f"), ca.SX.sym("u_a")]
    f = [-field, -armature - k * field * speed, k * field * armature - loss * speed]
    S = ca.sumsqr(ca.vertcat(*x)) / 2 + kink * (speed - 5) * ca.fabs(speed - 5)
    system = AffineSystem(x, u, f, [[1, 0], [0, 1], [0, 0]], S, domain=domain)
    law = DynamicExtension(alpha=[1, 1], beta=[1, 1], R_c=[1, 1], K_c=[1, 1])
    return Design(system, target, law, sample_period="1e-3", name="motor")


@pytest.mark.parametrize("target", [{"i_f": 1, "omega": 5}, {"i_f": 1, "omega": 0}])
def test_the_response_is_checked(target):
    document = written_for(motor(target))
    assert status(document, OUTPUT) == "REFUTED"
    assert ("rest" in witness(document, OUTPUT)) == (target["omega"] == 0)
    assert outcomes(document)[OUTPUT] == "checked"


def test_a_motor_that_has_an_output_is_not_refuted_by_it():
    document = written_for(motor({"i_f": 1, "omega": 5}))
    for other in (motor({"i_f": 1, "omega": 5}, loss=-0.1), motor({"i_f": 1, "omega": 5}, kink=0.25)):
        assert outcomes(forged(document, other, claims=()))[OUTPUT] == "fails"


@pytest.mark.parametrize("omega", ["0", "1", "100", "-1/0", "x"])
def test_at_another_frequency_it_is_passive(omega):
    document = written_for(motor({"i_f": 1, "omega": 5}))
    assert outcomes(with_witness(document, OUTPUT, omega=omega))[OUTPUT] == "fails"


def test_the_rest_must_be_one():
    document = written_for(motor({"i_f": 1, "omega": 0}))
    rest = witness(document, OUTPUT)["rest"]
    unknown = rest["unknown"]
    spoiled = [
        {**rest, "known": {**rest["known"], "u_f": "-2"}},
        {**rest, "known": {"u_f": "-1"}},
        {**rest, "unknown": {**unknown, "omega": "1"}},
        {**rest, "rows": [0, 1]},
        {**rest, "rows": [0, 1, 1]},
        {"known": {**rest["known"], **unknown}, "unknown": {}, "rows": [], "radius": "0"},
    ]
    for other in spoiled:
        assert outcomes(with_witness(document, OUTPUT, rest=other))[OUTPUT] == "fails"


def test_another_rest_is_inside_of_the_domain():
    document = written_for(motor({"i_f": 1, "omega": 0}))
    narrow = motor({"i_f": 1, "omega": 0}, domain={"omega": ("-1e-6", "1e-6")})
    assert outcomes(forged(document, narrow, claims=()))[OUTPUT] == "fails"


def _coupled(gamma=None, still=0):
    """A system whose x* is irrational; ``still`` adds a state that no input reaches."""
    x, y, z, u = (ca.SX.sym(name) for name in "xyzu")
    F = ca.vertcat(ca.horzcat(-1, 1 + x**2), ca.horzcat(-(1 + x**2), -2))
    psi = ca.vertcat(ca.cos(x), 1)
    f, g, S = ca.mtimes(F, ca.vertcat(x, y)), -ca.mtimes(F, psi), x**2 / 2 + y**2 / 2
    states = [x, y]
    if still:
        states, f, g, S = [x, y, z], ca.vertcat(f, 0), ca.vertcat(g, 0), S + z**2 / 2
    system = AffineSystem(states, [u], f, g, S, gamma=[ca.sin(x) + y if gamma is None else gamma(x, y)])
    law = DynamicExtension(alpha=1, beta=1, R_c=1, K_c=1)
    target = {"x": "0.3"} | ({"z": 0} if still else {})
    return Design(system, target=target, law=law, sample_period="1e-3", name="coupled")


def test_the_gradient_vanishes_where_the_inputs_reach_every_mode():
    document = written_for(_coupled())
    assert "rank" in witness(document, GRADIENT)
    assert outcomes(document)[GRADIENT] == "checked"
    assert outcomes(forged(document, _coupled(lambda x, y: ca.sin(x) + 2 * y), claims=()))[GRADIENT] == "fails"
    assert outcomes(forged(document, _coupled(still=1), claims=()))[GRADIENT] == "fails"
