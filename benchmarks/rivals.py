"""The same step as other generators write it: CasADi's C, that C patched to single precision, and SymPy's C.

All compute the algorithm of the law with the math library's tanh and Newton's method, as a user would write it down:
prepare, solve each channel, update. None checks its inputs or clamps its output.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import sympy as sp
from sympy.codegen.ast import float32, real

from pbcgen.law.law import ScalarSolve
from pbcgen.law.solves import with_tanh

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbcgen.law.law import ControlLaw


@dataclass(frozen=True)
class Rival:
    """C of another generator with a wrapper ``void step(real *xi, const real *m, real *u)``."""

    name: str
    source: str
    real: str


def rivals(law: ControlLaw) -> list[Rival]:
    """The rivals for a law whose channels are all scalar."""
    law = with_tanh(law, "libm")
    return [_casadi(law, patched=False), _casadi(law, patched=True), _sympy(law)]


# --- CasADi ----------------------------------------------------------------------------------------------------------


def _casadi(law: ControlLaw, *, patched: bool) -> Rival:
    m, xi = ca.SX.sym("m", len(law.inputs)), ca.SX.sym("xi", len(law.states))
    c, N = _walked(law.prepare, _Casadi(), [m, xi])
    t = []
    for solve in law.solves:
        assert isinstance(solve, ScalarSolve)
        mu, own = N[solve.index, solve.index], c[solve.index]
        r = ca.fabs(own)
        s = ca.fmax(r / (1 + mu), r - mu)
        for _ in range(solve.iterations):
            value = ca.tanh(s)
            s -= (s - r + mu * value) / (1 + mu * (1 - value * value))
        t.append(ca.if_else(own < 0, -1, 1) * ca.tanh(s))
    following, u = _walked(law.update, _Casadi(), [m, xi, ca.vertcat(*t)])
    function = ca.Function("rival", [m, xi], [ca.densify(following), ca.densify(u)])
    generator = ca.CodeGenerator("rival.c", {"casadi_real": "float"} if patched else {})
    generator.add(function)
    text = generator.dump()
    name = "CasADi as generated (double)"
    if patched:
        name = "CasADi patched by hand to float"
        text = re.sub(r"(?<![\w.])(\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])", r"\1f", text)
        text = re.sub(r"\b(tanh|fabs|fmax|fmin|sin|cos|cosh|exp|log|sqrt)\(", r"\1f(", text)
    scalar = "float" if patched else "double"
    wrapper = f"""
void step({scalar} *xi, const {scalar} *m, {scalar} *u);
void step({scalar} *xi, const {scalar} *m, {scalar} *u)
{{
    const {scalar} *arg[2] = {{ m, xi }};
    {scalar} next[{max(len(law.states), 1)}];
    {scalar} *res[2] = {{ next, u }};
    {scalar} w[{max(function.sz_w(), 1)}];
    rival(arg, res, 0, w, 0);
    for (int k = 0; k < {len(law.states)}; ++k) xi[k] = next[k];
}}
"""
    return Rival(name, text + wrapper, scalar)


def _walked(tape: Any, algebra: Any, inputs: list[ca.SX]) -> list[ca.SX]:
    results = []
    for matrix in tape.walk(algebra, [[v[i] for i in range(v.numel())] for v in inputs]):
        dense = ca.SX(*matrix.shape)
        for (i, j), value in matrix.entries.items():
            dense[i, j] = value
        results.append(dense)
    return results


class _Casadi:
    def const(self, value: Any) -> ca.SX:
        return ca.SX(float(value))

    def __getattr__(self, name: str) -> Callable[..., ca.SX]:
        table = {
            "add": lambda a, b: a + b,
            "sub": lambda a, b: a - b,
            "mul": lambda a, b: a * b,
            "div": lambda a, b: a / b,
            "neg": lambda a: -a,
            "sq": lambda a: a * a,
            "twice": lambda a: 2 * a,
            "inv": lambda a: 1 / a,
            "assign": lambda a: a,
        }
        return table.get(name) or getattr(ca, name)


# --- SymPy -----------------------------------------------------------------------------------------------------------


def _sympy(law: ControlLaw) -> Rival:
    m = [sp.Symbol(f"m[{i}]") for i in range(len(law.inputs))]
    xi = [sp.Symbol(f"x{i}") for i in range(len(law.states))]
    c, N = law.prepare.walk(_Sympy(), [m, xi])
    lines = [f"const float x{i} = xi[{i}];" for i in range(len(xi))]
    t = []
    for solve in law.solves:
        assert isinstance(solve, ScalarSolve)
        k = solve.index
        lines += _assigned({f"c{k}": c.entries[k, 0], f"mu{k}": N.entries[k, k]}, f"p{k}_")
        s, r, mu, value = (sp.Symbol(f"{name}{k}") for name in ("s", "r", "mu", "t"))
        lines.append(f"const float r{k} = fabsf(c{k});")
        lines.append(f"float s{k} = {_code(sp.Max(r / (1 + mu), r - mu))};")
        lines.append(f"float t{k} = tanhf(s{k});")
        newton = s - (s - r + mu * value) / (1 + mu * (1 - value**2))
        lines.append(f"for (int k = 0; k < {solve.iterations}; ++k) {{ s{k} = {_code(newton)}; t{k} = tanhf(s{k}); }}")
        lines.append(f"if (c{k} < 0) t{k} = -t{k};")
        t.append(value)
    following, u = law.update.walk(_Sympy(), [m, xi, t])
    results = {f"next{i}": following.entries.get((i, 0), sp.Integer(0)) for i in range(len(xi))}
    results |= {f"out{i}": u.entries.get((i, 0), sp.Integer(0)) for i in range(len(law.outputs))}
    lines += _assigned(results, "q")
    lines += [f"xi[{i}] = next{i};" for i in range(len(xi))] + [f"u[{i}] = out{i};" for i in range(len(law.outputs))]
    body = "\n    ".join(lines)
    head = "void step(float *xi, const float *m, float *u)"
    return Rival("SymPy (cse, float)", f"#include <math.h>\n{head};\n{head}\n{{\n    {body}\n}}\n", "float")


def _assigned(results: dict[str, sp.Expr], prefix: str) -> list[str]:
    shared, reduced = sp.cse(list(results.values()), sp.numbered_symbols(prefix))
    lines = [f"const float {symbol} = {_code(value)};" for symbol, value in shared]
    return lines + [f"const float {name} = {_code(value)};" for name, value in zip(results, reduced, strict=True)]


def _code(expression: sp.Expr) -> str:
    return str(sp.ccode(expression, standard="C99", type_aliases={real: float32}))


class _Sympy:
    def const(self, value: Any) -> sp.Expr:
        return sp.Float(float(value)) if value.denominator != 1 else sp.Integer(int(value))

    def __getattr__(self, name: str) -> Callable[..., sp.Expr]:
        table = {
            "add": lambda a, b: a + b,
            "sub": lambda a, b: a - b,
            "mul": lambda a, b: a * b,
            "div": lambda a, b: a / b,
            "neg": lambda a: -a,
            "sq": lambda a: a**2,
            "twice": lambda a: 2 * a,
            "inv": lambda a: 1 / a,
            "assign": lambda a: a,
            "fmin": sp.Min,
            "fmax": sp.Max,
        }
        return table.get(name) or getattr(sp, name)
