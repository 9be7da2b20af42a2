"""Electromechanical coupling device: a motor moves two masses that a spring joins (law natural-damping).

A voltage source drives an RC circuit and a motor; the motor pushes mass 1, a spring carries mass 2 along. Mass 2 has
friction that the controller uses: its position, not its velocity, is measured. Mass 2 shall rest at 25 mm.
"""

import casadi as ca

from pbcgen import AffineSystem, Design, Limits, NaturalDamping, Parameters

p = Parameters(
    R1=100,  # resistance at the source, ohm
    R2=100,  # resistance of the motor, ohm
    C="2.2e-4",  # capacitance, F
    m1="0.01",  # masses, kg
    m2="0.015",
    a0="0.005",  # motor constant
    a1="6e-4",  # friction of mass 2: viscous part,
    a2="8e-5",  # and dry part, smoothed by tanh
    a3=40,
    k="0.3",  # stiffness of the spring, N/m
)

x1 = ca.SX.sym("x1")  # charge of the capacitor
x2 = ca.SX.sym("x2")  # position of mass 1
x3 = ca.SX.sym("x3")  # position of mass 2
x4 = ca.SX.sym("x4")  # momentum of mass 1
x5 = ca.SX.sym("x5")  # momentum of mass 2
u = ca.SX.sym("u")  # voltage of the source

spring = p.k * (x2 - x3)
motor = (x1 / p.C - x4 / (p.a0 * p.m1)) / p.R2  # current through the motor branch
friction = p.a1 * x5 / p.m2 + p.a2 * ca.tanh(p.a3 * x5)

device = AffineSystem(
    x=[x1, x2, x3, x4, x5],
    u=[u],
    f=[
        -(1 / p.R1 + 1 / p.R2) * x1 / p.C + x4 / (p.a0 * p.m1 * p.R2),
        x4 / p.m1,
        x5 / p.m2,
        -spring + motor / p.a0,
        spring - friction,
    ],
    g=[1 / p.R1, 0, 0, 0, 0],
    S=x1**2 / (2 * p.C) + p.k * (x2 - x3) ** 2 / 2 + x4**2 / (2 * p.m1) + x5**2 / (2 * p.m2),
    parameters=p,
    measured=["x1", "x2", "x3"],  # no velocities
    units={"x1": "C", "x2": "m", "x3": "m", "x4": "kg m/s", "x5": "kg m/s", "u": "V"},
    name="electromechanical coupling device",
)

design = Design(
    device,
    target={"x3": "0.025"},
    law=NaturalDamping(
        alpha_c="2.5",
        beta_c=450,
        K_c="1e6",
        R_c="0.3",
        alpha_l="2.5",
        beta_l="2e6",
        K_l="5.5e-4",
        R_l=33,
    ),
    limits=Limits.symmetric(5),
    sample_period="1e-3",
    duration=20,
    description="Mass 2 is brought to 25 mm with at most 5 V and without measuring a velocity.",
)
