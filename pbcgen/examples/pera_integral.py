"""Robot arm PERA with three joints and a filter against steady-state errors (law integral on dynamic-extension)."""

import math

from pbcgen import Design, DynamicExtension, Integral, Limits
from pbcgen.examples.pera import arm  # to change the arm, copy that file beside this one and import it from there

design = Design(
    arm,
    target={"q1": "-1.81", "q2": math.pi / 2, "q3": "0.78"},
    law=Integral(
        DynamicExtension(
            alpha=[6, "1.4", 1],
            beta=[120, 120, 120],
            K_c=[1, 1, 1],
            R_c=["0.1", "0.005", "0.05"],
        ),
        alpha_psi=[11, "1.5", "2.4"],
        beta_psi=[7, 7, 7],
        R_psi=[1, 1, 35],
    ),
    # Joint 1 has a motor of its own; joints 2 and 3 are driven by two motors through a differential.
    limits=Limits.absolute([[1, 0, 0], [0, 1, 1], [0, 1, -1]], ["17.1007", "7.901", "7.901"]),
    # Stable at 1 kHz because of the joint friction. Without it the linearised loop is stable too, but the filter winds
    # up and the arm does not settle from the posture below.
    sample_period="1e-3",
    initial={"q1": "-2.23", "q2": "-0.212", "q3": "0.086"},
    duration=10,
    description="The arm moves to a posture, and constant disturbances shift it less.",
)
