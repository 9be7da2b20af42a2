"""Inverted pendulum behind a series spring: the motor balances a link that it only reaches through a spring.

The motor turns one end of a torsion spring, the link hangs on the other end and shall stand upright. The motor angle is
all that is measured. How stiff must the controller hold the motor?

At the upright rest the stiffness matrix of the closed loop in (link, motor) is

    [ k - m g l        -k         ]
    [    -k        k + alpha beta ]

because gravity acts like a negative spring m g l on the link and the law adds alpha beta at the motor. It is positive
definite if and only if k > m g l, and then

    (k - m g l) (k + alpha beta) > k^2,   that is   alpha beta > k m g l / (k - m g l).

Here m g l = 1.4715 N m/rad and k = 6 N m/rad, so alpha beta must exceed 1.9497 N m/rad. The filter x_c yields like a
spring K_c in series: what counts with it is alpha beta K_c / (alpha beta + K_c).
"""

import casadi as ca

from pbcgen import Design, DynamicExtension, Limits, Mechanical, Parameters

p = Parameters(
    m="0.5",  # mass of the link, kg
    l="0.3",  # distance of its centre of mass from the joint, m
    g="9.81",  # gravity, m/s^2
    I="0.045",  # inertia of the link about the joint, kg m^2
    J="0.02",  # inertia of the motor, kg m^2
    k=6,  # stiffness of the spring, N m/rad
    d_link="0.01",  # friction of the link, N m s/rad
    d_motor="0.05",  # friction of the motor, N m s/rad
)

link = ca.SX.sym("link")  # angle of the link from the upright position
motor = ca.SX.sym("motor")  # angle of the motor
link_momentum = ca.SX.sym("link_momentum")
motor_momentum = ca.SX.sym("motor_momentum")

pendulum = Mechanical(
    q=[link, motor],
    p=[link_momentum, motor_momentum],
    M=[p.I, p.J],
    V=p.m * p.g * p.l * ca.cos(link) + p.k * (link - motor) ** 2 / 2,
    D=[p.d_link, p.d_motor],
    G=[0, 1],
    parameters=p,
    inputs=["torque"],
    measured=["motor"],
    units={
        "link": "rad",
        "motor": "rad",
        "link_momentum": "kg m^2/s",
        "motor_momentum": "kg m^2/s",
        "torque": "N m",
    },
    name="inverted pendulum behind a series spring",
)

design = Design(
    pendulum,
    target={"link": 0},  # upright; the angle of the motor follows from it
    law=DynamicExtension(alpha=3, beta=4, K_c=12, R_c=1),
    limits=Limits.symmetric(3),
    sample_period="1e-3",
    initial={"link": "0.2"},
    duration=10,
    description="The link is balanced upright from a start at 0.2 rad.",
)
