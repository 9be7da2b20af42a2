"""The control laws with their filters, gains and Lyapunov functions, as formulas."""

from __future__ import annotations

from typing import Any

from pbcgen.models.design import Design
from pbcgen.models.laws import Integral, NaturalDamping, PassiveOutput, base_law, gains
from pbcgen.report.mathematics import Formula, number, number_matrix
from pbcgen.symbolic.sympy_form import name_as_latex

#: For each law the names of its equations, and its formula.
LAWS: dict[str, tuple[tuple[str, ...], str]] = {
    "passive-output": (
        ("u",),
        r"u = -\kappa - \alpha \tanh\left(\beta(\gamma - \gamma_*)\right) - k_p \tanh(y)",
    ),
    "dynamic-extension": (("uc", "dxc"), r"u = -\kappa - \alpha \tanh(\beta z_c), \quad z_c = \gamma - \gamma_* + x_c"),
    "natural-damping": (
        ("ulc", "dxc", "dxl"),
        r"u = -\kappa - \alpha_c \tanh(\beta_c z_c) - \alpha_\ell \tanh(\beta_\ell z_\ell), \quad "
        r"z_c = \gamma - \gamma_* + x_c, \quad z_\ell = \Upsilon(\eta - \eta_*) + K_\ell x_\ell",
    ),
    "potential-compensation": (
        ("umec", "dxc"),
        r"u = \nabla V(q) - \alpha \tanh(\beta z_c), \quad z_c = q - q_* + x_c",
    ),
}


def law_formulas(design: Design) -> list[Formula]:
    """The target, the law and its gains, as the user gave them."""
    wanted = ", ".join(f"{name_as_latex(c.name)} = {number(c.value, 12)}" for c in design.target.conditions)
    return [Formula("Target", wanted), *formulas_of(design.law.resolve(design.system.m))]


def formulas_of(law: Any) -> list[Formula]:
    """The law with its filters and gains."""
    base = base_law(law)
    formulas = [Formula("Control law", LAWS[base.name][1])]
    if not isinstance(base, PassiveOutput):
        suffix = "_c" if isinstance(base, NaturalDamping) else ""
        formulas.append(
            Formula("Filter (dxc)", rf"\dot x_c = -R_c \left(\alpha{suffix} \tanh(\beta{suffix} z_c) + K_c x_c\right)")
        )
    if isinstance(base, NaturalDamping):
        formulas.append(Formula("Filter (dxl)", r"\dot x_\ell = -R_\ell\, \alpha_\ell \tanh(\beta_\ell z_\ell)"))
    if isinstance(law, Integral):
        formulas.append(
            Formula(
                "Filter against steady-state errors (dpsi), added to u as the term in psi",
                r"\dot\psi = -R_\psi \psi + \alpha_\psi \beta_\psi\, \text{sech}(\beta_\psi \psi)\,(\gamma - \gamma_*)"
                r", \quad u_\psi = -\alpha_\psi \tanh(\beta_\psi \psi)",
            )
        )
    return [*formulas, Formula("Gains", _gain_line(law))]


def _gain_line(law: Any) -> str:
    shown = []
    for name, value in gains(law).items():
        text = number_matrix(value, 8) if isinstance(value[0], tuple) else _vector(value)
        shown.append(f"{name_as_latex(name)} = {text}".replace("_{l}", r"_{\ell}"))
    lines = [", \\quad ".join(shown[k : k + 4]) for k in range(0, len(shown), 4)]
    return r"\begin{aligned}" + r" \\ ".join(f"& {line}" for line in lines) + r"\end{aligned}"


def _vector(values: Any) -> str:
    shown = [number(float(v), 8) for v in values]
    return shown[0] if len(shown) == 1 else rf"\left({', '.join(shown)}\right)"


#: For each law its Lyapunov function and the rate of that along the closed loop.
ENERGY = {
    "passive-output": (r"S_d = S + \Phi(\gamma) + \kappa^{\top}\gamma", r"\dot S_d \le -\sum_i k_{p_i} y_i \tanh(y_i)"),
    "dynamic-extension": (
        r"S_{d_c} = S + \Phi_c(z_c) + \kappa^{\top}\gamma + \tfrac12 x_c^{\top} K_c x_c",
        r"\dot S_{d_c} = -\lVert \ell + w u \rVert^2 - \lVert \dot x_c \rVert^2_{R_c^{-1}}",
    ),
    "natural-damping": (
        r"S_{d_\ell} = S + \Phi_c(z_c) + \Phi_\ell(z_\ell) + \kappa^{\top}\gamma + \tfrac12 x_c^{\top} K_c x_c",
        r"\dot S_{d_\ell} \le -(\dot\eta, y, \dot x_\ell)\,\Theta\,(\dot\eta, y, \dot x_\ell)^{\top} "
        r"- \lVert \dot x_c \rVert^2_{R_c^{-1}}",
    ),
    "potential-compensation": (
        r"H_d = \tfrac12 p^{\top} M^{-1} p + \Phi_c(z_c) + \tfrac12 x_c^{\top} K_c x_c",
        r"\dot H_d = -\lVert \dot q \rVert^2_D - \lVert \dot x_c \rVert^2_{R_c^{-1}}",
    ),
}
