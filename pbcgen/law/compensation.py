"""The force that potential compensation holds against."""

from __future__ import annotations

import casadi as ca

from pbcgen.models.affine import AffineSystem
from pbcgen.models.laws import Law, PotentialCompensation, base_law


def compensated_force(system: AffineSystem, law: Law | None) -> ca.SX | None:
    """grad V, m x 1, if the law (or its base) is potential compensation (umec), else None."""
    mechanics = system.mechanical
    if mechanics is None or not isinstance(base_law(law), PotentialCompensation):
        return None
    return ca.gradient(mechanics.V, mechanics.q)
