"""Robot arm PERA with three joints: gravity compensation, no velocities measured (law potential-compensation)."""

import math

import casadi as ca

from pbcgen import Design, Limits, Mechanical, Parameters, PotentialCompensation

p = Parameters(
    g_r="9.81",  # gravity, m/s^2
    d_c2="0.16",  # distance of the centre of mass of link 2, m
    m_3=1,  # its mass, kg
    I_1="0.0054",  # moments of inertia, kg m^2
    I_2="0.0768",
    I_3="0.00211",
    # Viscous friction of the geared joints, N m s/rad: an assumption, the published model has none (see below).
    d_1=5,
    d_2=1,
    d_3="0.2",
)

q1 = ca.SX.sym("q1")  # shoulder roll
q2 = ca.SX.sym("q2")  # elbow pitch
q3 = ca.SX.sym("q3")  # elbow roll
p1, p2, p3 = (ca.SX.sym(name) for name in ("p1", "p2", "p3"))

m1 = p.I_1 + p.I_2 + p.I_3 + p.m_3 * p.d_c2**2 * ca.sin(q2) ** 2
coupling = p.I_3 * ca.cos(q2)

arm = Mechanical(
    q=[q1, q2, q3],
    p=[p1, p2, p3],
    M=[
        [m1, 0, coupling],
        [0, p.I_2 + p.I_3 + p.m_3 * p.d_c2**2, 0],
        [coupling, 0, p.I_3],
    ],
    V=p.m_3 * p.g_r * p.d_c2 * (1 - ca.cos(q2)),
    D=[p.d_1, p.d_2, p.d_3],
    G=ca.SX.eye(3),
    parameters=p,
    inputs=["u1", "u2", "u3"],
    units={
        **dict.fromkeys(["q1", "q2", "q3"], "rad"),
        **dict.fromkeys(["p1", "p2", "p3"], "kg m^2/s"),
        **dict.fromkeys(["u1", "u2", "u3"], "N m"),
    },
    name="robot arm PERA",
)

design = Design(
    arm,
    target={"q1": "-1.81", "q2": math.pi / 2, "q3": "0.78"},
    law=PotentialCompensation(
        alpha=[17, 3, "3.3"],
        beta=[80, 100, 80],
        K_c=[1, 1, 1],
        R_c=["0.1", "0.005", "0.05"],
    ),
    # Joint 1 has a motor of its own; joints 2 and 3 are driven by two motors through a differential.
    limits=Limits.absolute([[1, 0, 0], [0, 1, 1], [0, 1, -1]], ["17.1007", "7.901", "7.901"]),
    # Stable at 1 kHz because of the joint friction. Without it (d_1 = d_2 = d_3 = 0) these gains are stable only up to
    # h = 0.21 ms: the hold delays the stiff spring alpha*beta by half a sample, and nothing but x_c damps it.
    sample_period="1e-3",
    initial={"q1": "-2.257", "q2": "-0.206", "q3": "0.044"},
    duration=10,
    description="The arm moves to a posture within the torques of its motors.",
)
