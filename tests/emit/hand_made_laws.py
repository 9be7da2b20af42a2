"""Small control laws that between them use every feature of the emitter: built by hand, the last one derived."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import cache

import casadi as ca

from pbcgen import AffineSystem, Design, DynamicExtension, Limits, pipeline
from pbcgen.emit import Extras, Provenance
from pbcgen.law.law import (
    ControlLaw,
    Fallback,
    Precision,
    ScalarSolve,
    Setter,
    SetterInput,
    Signal,
    VectorSolve,
)
from pbcgen.law.solves import with_tanh
from pbcgen.symbolic.tape import Tape

PROVENANCE = Provenance(
    model_hash="0" * 64,
    verdicts=(("equilibrium", "PROVED", "at x*"), ("sampled-stable", "UNDECIDED", "sampled loop")),
    allowed=("sampled-stable",),
    notes=("Joint friction of 0.1 N m s was assumed.",),
    derived={"kappa": [0.25], "gamma": ["q"]},
)


def two_channels(precision: Precision = "double", fallback: Fallback = Fallback.EQUILIBRIUM) -> ControlLaw:
    """A stiff channel (mu = 90) and a soft one whose mu depends on the measurement."""
    m, xi, t = ca.SX.sym("m", 2), ca.SX.sym("xi", 2), ca.SX.sym("t", 2)
    c = ca.vertcat(100 * (m[0] - 1 + xi[0] / 1.7), 2 * m[1] + xi[1])
    N = ca.SX(2, 2)
    N[0, 0], N[1, 1] = 90, 0.001 * (1 + m[0] ** 2)
    following = ca.vertcat((xi[0] - 0.9 * t[0]) / 1.7, xi[1] - 0.001 * t[1] * ca.cos(m[1]))
    u = ca.vertcat(-2.5 * t[0] - 0.25, -0.5 * t[1] * ca.cos(m[1]))
    return ControlLaw(
        name="two channels",
        law="natural-damping",
        precision=precision,
        sample_period=Fraction(1, 1000),
        inputs=(Signal("i_L", "A", "coil current"), Signal("θ", "rad")),
        outputs=(Signal("u", "V", "drive"), Signal("class", "N m")),
        states=(Signal("x_c"), Signal("x_l")),
        prepare=Tape.of([m, xi], [c, N]),
        update=Tape.of([m, xi, t], [following, u]),
        solves=(ScalarSolve(0, 8, 1e-12), ScalarSolve(1, 2, 1e-15)),
        intervals=((Fraction(-275, 100), Fraction(225, 100)), (Fraction(-1, 3), Fraction(1, 3))),
        equilibrium_output=(-0.25, 0.0),
        fallback=fallback,
        ranges={"i_L": (Fraction(0), Fraction(10))},
    )


def block(precision: Precision = "double", size: int = 3, stiffness: float = 20.0) -> ControlLaw:
    """A full nonsymmetric block N = P Lambda, and a held output.

    P(m) = S C(m) S with C a correlation matrix and S of very different sizes, so that elimination needs its pivots.
    """
    m, xi, t = ca.SX.sym("m", size), ca.SX.sym("xi", size), ca.SX.sym("t", size)
    sizes = [0.2, 1.0, 3.0, 0.5, 2.0][:size]
    P = ca.SX(size, size)
    for i in range(size):
        for j in range(size):
            P[i, j] = sizes[i] * sizes[j] * (1 if i == j else 0.45 + 0.45 * ca.cos(m[0]))
    N = stiffness * P @ ca.diag(ca.SX([1 + 0.5 * i for i in range(size)]))
    c = 3 * m + xi
    return ControlLaw(
        name="block",
        law="dynamic-extension",
        precision=precision,
        sample_period=Fraction(1, 500),
        inputs=tuple(Signal(f"q{i}", "rad") for i in range(size)),
        outputs=tuple(Signal(f"u{i}", "N m") for i in range(size)),
        states=tuple(Signal(f"x{i}") for i in range(size)),
        prepare=Tape.of([m, xi], [c, N]),
        update=Tape.of([m, xi, t], [0.9 * xi - 0.1 * t, -2 * t]),
        solves=(VectorSolve(tuple(range(size)), 20, 1e-5 if precision == "float" else 1e-12),),
        intervals=((Fraction(-2), Fraction(2)),) * size,
        equilibrium_output=(0.0,) * size,
        fallback=Fallback.LAST_OUTPUT,
    )


def mixed(precision: Precision = "double") -> ControlLaw:
    """A constant block of channels 0 and 2, and a scalar channel 1 between them without iterations."""
    m, xi, t = ca.SX.sym("m", 3), ca.SX.sym("xi", 1), ca.SX.sym("t", 3)
    N = ca.SX(3, 3)
    N[0, 0], N[0, 2], N[2, 0], N[2, 2] = 3, 1, 0.5, 2
    solves = (
        VectorSolve((0, 2), 15, 1e-5 if precision == "float" else 1e-12),
        ScalarSolve(1, 0, 0.0),
    )
    return replace(
        block(precision),
        name="mixed",
        states=(Signal("x"),),
        outputs=(Signal("u"),),
        prepare=Tape.of([m, xi], [m - xi, N]),
        update=Tape.of([m, xi, t], [xi / 2 + t[0] / 8, ca.sum1(t)]),
        solves=solves,
        intervals=((Fraction(-3), Fraction(3)),),
        equilibrium_output=(0.0,),
        fallback=Fallback.EQUILIBRIUM,
    )


def stateless(precision: Precision = "double") -> ControlLaw:
    """No memory and no loop equation; u uses its own tanh and grows without bound before the clamp."""
    m, xi, t = ca.SX.sym("m", 1), ca.SX.sym("xi", 0), ca.SX.sym("t", 0)
    return ControlLaw(
        name="stateless",
        law="passive-output",
        precision=precision,
        sample_period=Fraction(1, 100),
        inputs=(Signal("v", "m/s"),),
        outputs=(Signal("F", "N"),),
        states=(),
        prepare=Tape.of([m, xi], [ca.SX(0, 1), ca.SX(0, 0)]),
        update=Tape.of([m, xi, t], [ca.SX(0, 1), ca.tanh(m) - m**3]),
        solves=(),
        intervals=((Fraction(0), Fraction(31, 10)),),
        equilibrium_output=(1.0,),
        fallback=Fallback.EQUILIBRIUM,
    )


def constant_channels(precision: Precision = "float") -> ControlLaw:
    """One channel for each form of the solve with one tanh, and no function but tanh: no two machines differ."""
    mus = [1.1e-3, 0.0132, 0.136, 3.0, 90.75]
    size = len(mus)
    m, xi, t = ca.SX.sym("m", size), ca.SX.sym("xi", size), ca.SX.sym("t", size)
    law = ControlLaw(
        name="constant channels",
        law="dynamic-extension",
        precision=precision,
        sample_period=Fraction(1, 1000),
        inputs=tuple(Signal(f"q{i}") for i in range(size)),
        outputs=tuple(Signal(f"u{i}") for i in range(size)),
        states=tuple(Signal(f"x{i}") for i in range(size)),
        prepare=Tape.of([m, xi], [10 * m + xi, ca.diag(ca.DM(mus))]),
        update=Tape.of([m, xi, t], [xi / 2 - t, -2 * t + ca.tanh(xi) / 4]),
        solves=(),
        intervals=((Fraction(-2), Fraction(2)),) * size,
        equilibrium_output=(0.0,) * size,
        fallback=Fallback.EQUILIBRIUM,
    )
    return with_tanh(law, "fast")


EXTRAS = Extras(start=True, selftest=True)


def adjustable(precision: Precision = "float") -> ControlLaw:
    """A target through a logarithm, a gain that scales mu, an equilibrium input that moves."""
    m, xi, t, given = ca.SX.sym("m", 1), ca.SX.sym("xi", 3), ca.SX.sym("t", 1), ca.SX.sym("r", 1)
    x_c, star, alpha = ca.vertsplit(xi)
    c = 2 * (m - star + x_c / 1.1)
    N = ca.SX(1, 1)
    N[0, 0] = 0.1 * alpha
    states = (Signal("x_c"), Signal("x_star", "V", "at the target"), Signal("alpha", "", "gain"))
    setters = (
        Setter(
            "target",
            (SetterInput(Signal("i_D", "A"), (Fraction(1, 100), Fraction(3, 100)), Fraction(2, 100)),),
            (1,),
            Tape.of([given], [ca.log(1 + 1000 * given)]),
        ),
        Setter(
            "gains",
            (SetterInput(Signal("alpha"), (Fraction(1, 2), Fraction(2)), Fraction(1)),),
            (2,),
            Tape.of([given], [given]),
        ),
    )
    return ControlLaw(
        name="adjustable",
        law="dynamic-extension",
        precision=precision,
        sample_period=Fraction(1, 1000),
        inputs=(Signal("v", "V"),),
        outputs=(Signal("u", "V", "drive"),),
        states=states,
        prepare=Tape.of([m, xi], [c, N]),
        update=Tape.of([m, xi, t], [ca.vertcat((x_c - 0.01 * alpha * t) / 1.1, star, alpha), star - alpha * t]),
        solves=(ScalarSolve(0, 3, 1e-9),),
        intervals=((Fraction(0), Fraction(6)),),
        equilibrium_output=(3.044522437723423,),
        fallback=Fallback.EQUILIBRIUM,
        tanh="fast" if precision == "float" else "libm",
        kept=(3.044522437723423, 1.0),
        equilibrium_states=(1,),
        setters=setters,
        rest=(3.044522437723423,),
        start=Tape.of([m, xi], [ca.vertcat(1.1 * (star - m), star, alpha)]),
    )


@cache
def steered(precision: Precision = "float") -> ControlLaw:
    """A derived law with everything that may change: a target without formula, gains in diagonal matrices."""
    x1, x2, u = (ca.SX.sym(n) for n in ("class", "θ", "IN"))
    energy = x2**2 / 2 + x1**4 / 4 + x1**2 / 2
    system = AffineSystem(
        x=[x1, x2], u=[u], f=[x2, -(x1**3) - x1 - 2 * x2], g=[0, 1], S=energy, measured=["class", "θ"], gamma=[x1]
    )
    design = Design(
        system,
        law=DynamicExtension(alpha=2, beta=2, K_c=1, R_c=1),
        limits=Limits.symmetric(5),
        sample_period="1e-3",
        target={"force": (x1**3 + x1, "0.625")},
        target_box={"force": ("0.5", "0.8")},
        gain_ranges={"alpha": ("1.8", "2.2"), "K_c": ("0.8", "1.3"), "R_c": ("0.9", "1.1")},
        precision=precision,
        name="steered",
    )
    report = pipeline.check(design)
    assert report.emittable
    assert report.control is not None
    return report.control
