"""gamma with gamma' = y: found, proved through Z(x) >= 0, or not claimed."""

import casadi as ca

from pbcgen import AffineSystem
from pbcgen.passivity import passive_output
from pbcgen.passivity.passive_output import PassiveOutput
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.storage import assumption_1
from pbcgen.proof.claim import Status


def _find(system):
    plant = Plant(system)
    storage = assumption_1(plant)
    return passive_output.find(plant, storage.structure, storage.proved, storage.by_structure)


def _status(found):
    return found.claim.status if isinstance(found, PassiveOutput) else found.status


def test_an_output_is_not_passive_because_the_storage_happens_to_decrease():
    """u^T y - dS/dt is v^T B v with B indefinite for some u; the closed loop of this model is unstable."""
    x, y, u = (ca.SX.sym(name) for name in ("x", "y", "u"))
    a, b = ca.exp(x), ca.exp(y)
    found = _find(AffineSystem([x, y], [u], [-a - 2 * b, -2 * a - b], [3, 3], a + b))
    assert _status(found) is not Status.PROVED
