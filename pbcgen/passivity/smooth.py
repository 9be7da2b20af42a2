"""What to write in place of an operation that has no derivative."""

from __future__ import annotations

import casadi as ca

from pbcgen.passivity.plant import Plant

_SMOOTH = {
    "sign": "sign jumps at 0: write tanh(v / 0.01) for sign(v)",
    "fabs": "fabs has no derivative at 0: where no factor vanishes with it, write sqrt(v**2 + 1e-6) for fabs(v)",
    "fmin": "fmin has a kink: write (a + b - sqrt((a - b)**2 + 1e-6)) / 2 for fmin(a, b)",
    "fmax": "fmax has a kink: write (a + b + sqrt((a - b)**2 + 1e-6)) / 2 for fmax(a, b)",
    "if_else_zero": "if_else has a jump or a kink: blend the two sides with (1 + tanh(v / 0.01)) / 2",
}


def smooth_forms(plant: Plant) -> str:
    """Advice for the first operation of the model that is not smooth, or the empty text."""
    system = plant.system
    tape = plant.tape(ca.vertcat(system.S, system.f, ca.vec(ca.densify(system.g))))
    return next((advice for name, advice in _SMOOTH.items() if tape.uses(name)), "")
