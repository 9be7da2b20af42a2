"""Assumption 3 and Theta: natural damping, its largest constants, and the bound on K_l R_l."""

import casadi as ca

from pbcgen import Circuit, Design, NaturalDamping
from pbcgen.control.derive import derive
from pbcgen.proof.claim import Status


def _claims(design):
    return {c.claim: c for c in derive(design).claims}


def test_constants_below_the_dissipation_are_not_taken_from_an_indefinite_matrix():
    """B = [[1 + 1/(1 + i1^2), 1/2], [1/2, 3/10]] > 0, but with its diagonal lowered to constants it is indefinite."""
    i1, i2, v = (ca.SX.sym(name) for name in ("i1", "i2", "v"))
    circuit = Circuit(
        [i1, i2],
        [v],
        L=[1, 1],
        C=[1],
        Gamma=[[1], [0]],
        v_R=[i1 + ca.atan(i1) + 0.5 * i2, 0.5 * i1 + 0.3 * i2],
        i_G=[v],
        g_L=[[0], [-1]],
        inputs=["u"],
        eta=[0.3 * i1 - 0.5 * i2],
    )
    law = NaturalDamping(1, 1, 1, 1, alpha_l=1, beta_l=1, K_l=1, R_l=1)
    claims = _claims(Design(circuit, target={"i1": 0, "i2": 0, "v": 0}, law=law, sample_period="1e-3", name="d"))
    assert claims["assumption-1"].status is Status.PROVED
    assert claims["assumption-3"].status is not Status.PROVED
    assert claims["theta"].status is not Status.PROVED
