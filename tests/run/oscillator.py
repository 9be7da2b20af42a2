"""A mass on a spring with a dynamic-extension controller, written out by hand: loop, law and C."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np

from pbcgen.law.closed_loop import ClosedLoop
from pbcgen.law.law import ControlLaw, Fallback, ScalarSolve, Signal
from pbcgen.run.wrapper import Interface, Member
from pbcgen.symbolic.tape import Tape

MASS, STIFFNESS, DAMPING = 1.0, 2.0, 0.4
ALPHA, BETA, K_C, R_C = 0.75, 4.0, 1.5, 2.0
PERIOD = Fraction(1, 50)
INTERFACE_NAMES = ("OK", "NOT_CONVERGED", "STATE_RESET", "OUT_OF_RANGE", "INVALID_INPUT", "INVALID_ARGUMENT")


def loop(duration: float = 8.0) -> ClosedLoop:
    x, u, x_c = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("x_c")
    t = ca.tanh(BETA * (x[0] + x_c))
    return ClosedLoop(
        plant=ca.Function("plant", [x, u], [ca.vertcat(x[1], (-STIFFNESS * x[0] - DAMPING * x[1] + u) / MASS)]),
        measure=ca.Function("measure", [x], [x[0]]),
        controller=ca.Function("controller", [x, x_c], [-R_C * (ALPHA * t + K_C * x_c), -ALPHA * t]),
        lyapunov=None,
        x_star=np.zeros(2),
        u_star=np.zeros(1),
        controller_states=("x_c",),
        initial=np.array([1.0, 0.0]),
        duration=duration,
        state_names=("q", "p"),
        state_units=("m", "kg m/s"),
        input_names=("force",),
        input_units=("N",),
    )


def coefficients(h: Fraction) -> tuple[float, float, float]:
    """(1/d, mu, h R alpha / d) with d = 1 + h R K."""
    d = 1 + float(h) * R_C * K_C
    return 1 / d, float(h) * R_C * ALPHA * BETA / d, float(h) * R_C * ALPHA / d


def law(precision: str = "double", h: Fraction = PERIOD, stated: Fraction | None = None) -> ControlLaw:
    """Backward Euler with the period ``h``; ``stated`` is the period that the law claims to have."""
    q, x_c, t = ca.SX.sym("q"), ca.SX.sym("x_c"), ca.SX.sym("t")
    shrink, mu, pull = coefficients(h)
    return ControlLaw(
        name="oscillator",
        law="dynamic-extension",
        precision=precision,
        sample_period=h if stated is None else stated,
        inputs=(Signal("position", "m"),),
        outputs=(Signal("force", "N"),),
        states=(Signal("x_c"),),
        prepare=Tape.of([q, x_c], [BETA * (q + shrink * x_c), ca.SX(mu)]),
        update=Tape.of([q, x_c, t], [shrink * x_c - pull * t, -ALPHA * t]),
        solves=(ScalarSolve(0, 6, 1e-12),),
        intervals=((Fraction(-3, 4), Fraction(3, 4)),),
        equilibrium_output=(0.0,),
        fallback=Fallback.EQUILIBRIUM,
    )


def interface(precision: str = "double") -> Interface:
    return Interface(
        prefix="osc",
        precision=precision,
        inputs=(Member("position", "position"),),
        outputs=(Member("force", "force"),),
        states=(Member("x_c", "x_c"),),
        statuses=tuple(f"OSC_{name}" for name in INTERFACE_NAMES),
    )


def files(
    precision: str = "double", h: Fraction = PERIOD, *, alpha: float = ALPHA, beta: float = BETA, clamp: bool = True
) -> dict[str, str]:
    """The package as text; the keyword arguments plant a fault."""
    shrink, mu, pull = coefficients(h)

    def literal(value: float) -> str:
        return f"{float(np.float32(value)).hex()}f" if precision == "float" else float(value).hex()

    suffix = "f" if precision == "float" else ""
    limit = 2.0**63 if precision == "float" else 2.0**511
    header = f"""#ifndef OSC_H
#define OSC_H
typedef enum {{ {", ".join(f"OSC_{name}" for name in INTERFACE_NAMES)} }} osc_status_t;
typedef struct {{ {precision} position; }} osc_input_t;
typedef struct {{ {precision} force; }} osc_output_t;
typedef struct {{ {precision} x_c; }} osc_state_t;
void osc_init(osc_state_t *state);
osc_status_t osc_step(osc_state_t *state, const osc_input_t *input, osc_output_t *output);
#endif
"""
    source = f"""#include "osc.h"
#include <math.h>
typedef {precision} real;
void osc_init(osc_state_t *state) {{ state->x_c = {literal(0.0)}; }}
osc_status_t osc_step(osc_state_t *state, const osc_input_t *input, osc_output_t *output)
{{
    const real one = {literal(1.0)}, mu = {literal(mu)}, limit = {literal(limit)};
    const real low = {literal(-0.75)}, high = {literal(0.75)}, shrink = {literal(shrink)};
    real c, r, a, b, s, t, next, u;
    int k;
    osc_status_t status = OSC_OK;
    if (!(fabs{suffix}(state->x_c) <= limit)) {{
        state->x_c = {literal(0.0)};
        status = OSC_STATE_RESET;
    }}
    output->force = {literal(0.0)};
    if (!(fabs{suffix}(input->position) <= limit)) return OSC_INVALID_INPUT;
    c = {literal(beta)} * (input->position + shrink * state->x_c);
    if (!isfinite(c)) return OSC_OUT_OF_RANGE;
    r = fabs{suffix}(c);
    a = r / (one + mu);
    b = r - mu;
    s = a > b ? a : b;
    t = tanh{suffix}(s);
    for (k = 0; k < 6; ++k) {{
        s = s - ((s - r) + mu * t) / (one + mu * (one - t * t));
        t = tanh{suffix}(s);
    }}
    t = c < {literal(0.0)} ? -t : t;
    next = shrink * state->x_c - {literal(pull)} * t;
    if (!(fabs{suffix}(next) <= limit)) return OSC_OUT_OF_RANGE;
    u = -({literal(alpha)}) * t;
    state->x_c = next;
    output->force = {"u >= low ? (u <= high ? u : high) : low" if clamp else "u + (low + high)"};
    return status;
}}
"""
    return {"osc.h": header, "osc.c": source}
