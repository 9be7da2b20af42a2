"""The derivation of a controller, step by step, as formulas with the names that the literature gives them.

Every step shows what the check computed. The page and the notebook print the same steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca

from pbcgen.control.derive import Derivation
from pbcgen.errors import UnsupportedOperation
from pbcgen.models.design import Design
from pbcgen.models.laws import Integral, NaturalDamping, PassiveOutput, PotentialCompensation, gains
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.shaping import Shape, diagonal, shape_at
from pbcgen.proof.definite import eigenvalues
from pbcgen.report.mathematics import (
    LARGEST_MATRIX,
    column,
    expressions,
    matrix,
    number,
    number_matrix,
    numbers,
    rate,
    symbols,
)
from pbcgen.symbolic.real import BITS, precision, rational
from pbcgen.symbolic.sympy_form import from_function, from_sx, latex, name_as_latex


@dataclass(frozen=True)
class Formula:
    """A displayed formula with the words before it."""

    caption: str
    latex: str


@dataclass(frozen=True)
class Step:
    """One step.

    Attributes:
        key: for links.
        title: what is done.
        equations: names of the equations in the literature.
        text: what it means, in a sentence or two.
        formulas: what was found.
        claims: the verdicts that belong here.
    """

    key: str
    title: str
    equations: tuple[str, ...]
    text: str
    formulas: tuple[Formula, ...]
    claims: tuple[str, ...]


def model_formulas(plant: Plant) -> list[Formula]:
    """The system as it was written down."""
    system = plant.system
    if system.mechanical is not None:
        return list(_mechanical(plant))
    if system.circuit is not None:
        return list(_circuit(plant))
    return list(_affine(plant))


def steps(derivation: Derivation) -> list[Step]:
    """All steps that concern the law, in the order of the theory."""
    makers: list[Callable[[Derivation], Step | None]] = [
        _equilibrium,
        _storage,
        _output,
        _shaping,
        _filter_gain,
        _natural_damping,
        _law,
        _lyapunov,
        _sampled,
    ]
    return [step for step in (maker(derivation) for maker in makers) if step is not None]


# --- the model ---------------------------------------------------------------------------------------------------


def _rates(plant: Plant) -> str:
    rows = [
        f"{rate(name)} &= {row[0]}"
        for name, row in zip(plant.system.state_names, expressions(plant, plant.system.xdot), strict=True)
    ]
    return r"\begin{aligned}" + r" \\ ".join(rows) + r"\end{aligned}"


def _affine(plant: Plant) -> Iterator[Formula]:
    yield Formula("Dynamics x' = f(x) + g(x) u (afsys)", _rates(plant))
    yield Formula("Storage function", f"S(x) = {_one(plant, plant.system.S)}")


def _mechanical(plant: Plant) -> Iterator[Formula]:
    parts = plant.system.mechanical
    assert parts is not None
    q, p = ([e.name() for e in ca.vertsplit(s)] for s in (parts.q, parts.p))
    yield Formula(
        "Dynamics in port-Hamiltonian form (phmec)",
        r"\begin{bmatrix} \dot q \\ \dot p \end{bmatrix} = \begin{bmatrix} 0 & I \\ -I & -D \end{bmatrix} "
        r"\begin{bmatrix} \nabla_q H \\ \nabla_p H \end{bmatrix} + \begin{bmatrix} 0 \\ G \end{bmatrix} u, \quad "
        rf"q = {symbols(q)}, \quad p = {symbols(p)}, \quad u = {symbols(plant.system.input_names)}",
    )
    yield Formula(
        "Storage function: the energy",
        r"S(x) = H(q, p) = \tfrac{1}{2} p^{\top} M(q)^{-1} p + V(q), \quad q' = M^{-1} p",
    )
    yield Formula("Inertia matrix", f"M(q) = {_matrix(plant, parts.M)}")
    yield Formula("Potential energy", f"V(q) = {_one(plant, parts.V)}")
    yield Formula("Damping and input matrices", f"D = {_matrix(plant, parts.D)}, \\quad G = {_matrix(plant, parts.G)}")


def _circuit(plant: Plant) -> Iterator[Formula]:
    parts = plant.system.circuit
    assert parts is not None
    yield Formula(
        "Brayton-Moser form (BMrlc)",
        rf"Q \dot x = \nabla P(x) + \tilde g u, \quad Q = {_matrix(plant, parts.Q)}, \quad "
        rf"\tilde g = {_matrix(plant, parts.g_tilde)}",
    )
    yield Formula("Dynamics (afsys)", _rates(plant))
    yield Formula(
        "Storage function (PQtilde)",
        rf"S(x) = \tilde P(x) = \tfrac12 \nabla P^{{\top}} \Xi \nabla P = {_one(plant, plant.system.S)}",
    )


def _one(plant: Plant, expression: ca.SX) -> str:
    return expressions(plant, expression)[0][0]


def _matrix(plant: Plant, expression: ca.SX) -> str:
    if expression.numel() > LARGEST_MATRIX:
        return rf"\text{{({expression.shape[0]} by {expression.shape[1]} matrix: not written out)}}"
    return matrix(expressions(plant, expression))


def _exactly(plant: Plant, expression: ca.SX) -> list[list[str]]:
    """The entries as exact functions with factored coefficients; as they stand where that is not possible."""
    try:
        field, (values,) = plant.exact(expression, symbolic=True)
    except (UnsupportedOperation, ZeroDivisionError):
        return expressions(plant, expression)
    parameters = plant.parameter_positions()
    return [[latex(from_function(v, parameters)) for v in row] for row in values.dense(field.const(0))]


# --- the steps ---------------------------------------------------------------------------------------------------


def _equilibrium(d: Derivation) -> Step:
    system, formulas = d.plant.system, []
    wanted = ", ".join(rf"{_condition(c.name)} = {number(c.value, 12)}" for c in d.design.target.conditions)
    formulas.append(Formula("Asked for", wanted))
    if d.point is not None:
        formulas.append(
            Formula(
                "Equilibrium", rf"x_* = {symbols(system.state_names)}_{{*}} = {_row(d.derived.get('x_star') or ())}"
            )
        )
        formulas.append(
            Formula(
                "Input that holds it, -kappa (kappa)",
                rf"\kappa = {numbers(d.derived.get('kappa') or [0.0], 9)}, \quad u_* = -\kappa",
            )
        )
    return Step(
        "equilibrium",
        "Where the system can rest",
        ("E", "kappa"),
        "The target is completed to a state at which a constant input holds the system: f(x*) + g(x*) u* = 0.",
        tuple(formulas),
        ("input-rank", "equilibrium"),
    )


def _condition(name: str) -> str:
    return name_as_latex(name)


def _row(values: Any) -> str:
    return rf"\left({', '.join(number(float(v), 9) for v in values)}\right)"


def _storage(d: Derivation) -> Step:
    plant = d.plant
    formulas = []
    mechanical = plant.system.mechanical is not None
    if not mechanical:
        gradient = [row[0] for row in _exactly(plant, plant.gradient)]
        formulas.append(Formula("Gradient of the storage", rf"\nabla S(x) = {column(gradient)}"))
    structure = d.structure
    if structure is not None and not mechanical:
        relation = r"f = F \nabla S - \rho" if structure.form == "F" else r"\nabla S = A f"
        value = rf"{structure.form} = {matrix(_exactly(plant, ca.densify(structure.matrix)))}"
        if structure.remainder.nnz():
            value += rf", \quad \rho = {column([row[0] for row in _exactly(plant, structure.remainder)])}"
        formulas.append(Formula(f"Power structure, {structure.origin}", rf"{relation}, \quad {value}"))
    if mechanical:
        loss = r"-\nabla S^{\top} f = \dot q^{\top} D \dot q = \lVert \ell \rVert^2 \ge 0"
    else:
        loss = rf"-\nabla S^{{\top}} f = \lVert \ell(x) \rVert^2 = {_loss(plant)}"
    formulas.append(Formula("Dissipation of the system left alone (pascond)", loss))
    return Step(
        "storage",
        "Assumption 1: the stored energy does not grow by itself",
        ("pascond", "dS"),
        "Without input the storage cannot increase. Where a power structure is found, the sign of its symmetric part "
        "decides; the certificate holds the matrices.",
        tuple(formulas),
        ("assumption-1",),
    )


def _loss(plant: Plant) -> str:
    return _exactly(plant, -ca.dot(plant.gradient, plant.system.f))[0][0]


def _output(d: Derivation) -> Step:
    formulas = []
    if d.gamma is not None:
        formulas.append(Formula("Found", rf"\gamma(x) = {column([row[0] for row in _exactly(d.plant, d.gamma)])}"))
        slope = ca.jacobian(d.gamma, d.plant.system.x)
        terms = _exactly(d.plant, ca.densify(slope))
        outputs = [_combination(row, d.plant.system.state_names) for row in terms]
        formulas.append(Formula("Passive output (ypas)", rf"y = \dot\gamma = {column(outputs)}"))
    return Step(
        "output",
        "Passive output: a function gamma whose rate is y",
        ("ypas", "hesscond, line 1"),
        "gamma gives a passive output for S if and only if the Hill-Moylan matrix Z(x) is positive semidefinite for "
        "all x; Z collects Assumption 1, the output and its feedthrough in one matrix.",
        (*formulas, Formula("Hill-Moylan", _HILL_MOYLAN)),
        ("passive-output",),
    )


_HILL_MOYLAN = (
    r"Z(x) = \begin{bmatrix} -\nabla S^{\top} f & \tfrac12 (\nabla\gamma^{\top} f - g^{\top} \nabla S)^{\top} \\ "
    r"\tfrac12 (\nabla\gamma^{\top} f - g^{\top} \nabla S) & \text{sym}(\nabla\gamma^{\top} g) \end{bmatrix} \ge 0"
)


def _combination(coefficients: list[str], names: tuple[str, ...]) -> str:
    terms = []
    for coefficient, name in zip(coefficients, names, strict=True):
        dotted = rate(name)
        if coefficient == "0":
            continue
        simple = not any(sign in coefficient for sign in (" + ", " - "))
        shown = coefficient if simple or coefficient.startswith(r"\frac") else rf"\left({coefficient}\right)"
        terms.append(dotted if coefficient == "1" else f"-{dotted}" if coefficient == "-1" else f"{shown} {dotted}")
    return " + ".join(terms).replace("+ -", "- ") or "0"


def _gains(d: Derivation) -> tuple[tuple[Any, ...], tuple[Any, ...], Any]:
    """(alpha, beta, K_c) of the energy shaping."""
    law = d.law.base if isinstance(d.law, Integral) else d.law
    if isinstance(law, NaturalDamping):
        return law.alpha_c, law.beta_c, law.K_c
    return law.alpha, law.beta, getattr(law, "K_c", None)  # type: ignore[union-attr]


def _shape(d: Derivation) -> tuple[Shape, Any] | None:
    if d.point is None or d.gamma is None or d.law is None:
        return None
    law = d.law.base if isinstance(d.law, Integral) else d.law
    shape = shape_at(d.plant, d.point, d.gamma, compensated=isinstance(law, PotentialCompensation))
    alpha, beta, _ = _gains(d)
    return shape, diagonal([rational(a * b) for a, b in zip(alpha, beta, strict=True)])


def _shaping(d: Derivation) -> Step:
    formulas = []
    found = _shape(d)
    compensated = isinstance(d.law.base if isinstance(d.law, Integral) else d.law, PotentialCompensation)
    storage = r"\tfrac12 p^{\top} M^{-1} p" if compensated else r"S + \kappa^{\top}\gamma"
    if found is not None:
        shape, stiffness = found
        formulas.append(Formula("Stiffness of the law", rf"\text{{diag}}(\alpha\beta) = {number_matrix(stiffness, 8)}"))
        with precision(BITS):
            hessian = shape.hessian(stiffness)
            values = eigenvalues(hessian)
        label = (
            rf"\nabla^2\left({storage}\right)_* + \nabla\gamma_* \,\text{{diag}}(\alpha\beta)\, \nabla\gamma_*^{{\top}}"
        )
        formulas.append(Formula("Hessian of the shaped storage at x* (HessSd)", rf"{label} = {number_matrix(hessian)}"))
        formulas.append(
            Formula("Its eigenvalues, all positive when (hesscond) holds", ", ".join(number(v, 6) for v in values))
        )
    minimum = d.derived.get("alpha_beta_min")
    if minimum is not None:
        bounds = minimum if isinstance(minimum, (list, tuple)) else [minimum]
        least = ", ".join(number(float(v), 9) for v in bounds)
        shown = rf"\alpha\beta > {least}" if any(bounds) else r"\text{any } \alpha\beta > 0"
        formulas.append(Formula("Smallest stiffness of this proportion that does it", shown))
    return Step(
        "shaping",
        "Energy shaping: x* becomes a minimum",
        ("hesscond", "Phi", "HessSd"),
        "The saturated term adds a spring of stiffness alpha beta along gamma. The shaped storage must have zero "
        "gradient and a positive definite Hessian at x*. The term of gamma's own curvature counts whenever "
        "gamma is not linear.",
        tuple(formulas),
        ("gradient-condition", "hessian-condition"),
    )


def _filter_gain(d: Derivation) -> Step | None:
    law = d.law.base if isinstance(d.law, Integral) else d.law
    if law is None or isinstance(law, PassiveOutput):
        return None
    formulas = [
        Formula(
            "Springs in series: alpha beta and K_c",
            r"\nabla^2 S_{d_c} > 0 \iff H_0 + N\,(\text{diag}(\alpha\beta)^{-1} + K_c^{-1})^{-1} N^{\top} > 0",
        )
    ]
    minimum = d.derived.get("kc_min")
    if minimum is not None:
        bound = rf"K_c = k I,\; k > {number(float(minimum), 9)}" if minimum > 0 else r"\text{any } K_c > 0"
        formulas.append(Formula("What K_c must be", bound))
    formulas.append(
        Formula("What it is", rf"K_c = {number_matrix(law.K_c, 8)}, \quad R_c = {number_matrix(law.R_c, 8)}")
    )
    return Step(
        "filter",
        "Damping without measuring y: the filter x_c",
        ("dxc", "hessSdc"),
        "The filter yields like a spring K_c in series with alpha beta, so it softens the minimum; the bound says how "
        "stiff it must be.",
        tuple(formulas),
        ("gain-definiteness", "kc-bound"),
    )


def _natural_damping(d: Derivation) -> Step | None:
    law = d.law.base if isinstance(d.law, Integral) else d.law
    if not isinstance(law, NaturalDamping):
        return None
    formulas = []
    if d.eta is not None:
        formulas.append(Formula("Damped coordinates", rf"\eta(x) = {column([r[0] for r in _exactly(d.plant, d.eta)])}"))
    for key, name in (("Lambda_l", r"\Lambda_\ell"), ("Lambda_c", r"\Lambda_c")):
        if d.derived.get(key):
            formulas.append(Formula(f"Damping {key}", rf"{name} = {_diagonal(d.derived[key])}"))
    formulas.append(
        Formula(
            "Condition, in the Loewner order (schurcond1)",
            r"\Theta \ge 0 \iff K_\ell R_\ell \ge \tfrac14 \left(\Upsilon \Lambda_\ell^{-1} \Upsilon^{\top} + "
            r"\Lambda_c^{-1}\right)",
        )
    )
    products = [law.K_l[i][i] * law.R_l[i][i] for i in range(len(law.alpha_l))]
    shown = rf"K_\ell R_\ell = {_diagonal([float(p) for p in products])}"
    if d.derived.get("theta_bound") is not None:
        shown += rf", \quad \text{{needed: }} {number(float(d.derived['theta_bound']), 8)}"
    formulas.append(Formula("For these gains", shown))
    return Step(
        "natural-damping",
        "Assumption 3: damping that the system has already",
        ("Assumption 3", "Th", "schurcond1"),
        "Where coordinates eta are damped by nature, the filter x_l feeds on them. The Lyapunov function carries over "
        "when Theta is positive semidefinite.",
        tuple(formulas),
        ("assumption-3", "theta"),
    )


def _diagonal(values: Any) -> str:
    shown = ", ".join(number(float(v), 8) for v in values)
    return shown if len(values) == 1 else rf"\text{{diag}}\left({shown}\right)"


_LAWS: dict[str, tuple[tuple[str, ...], str]] = {
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
    return [Formula("Target", wanted), *_law_formulas(design.law.resolve(design.system.m))]


def _law_formulas(law: Any) -> list[Formula]:
    base = law.base if isinstance(law, Integral) else law
    formulas = [Formula("Control law", _LAWS[base.name][1])]
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


def _law(d: Derivation) -> Step:
    law = d.law if d.law is not None else d.design.law.resolve(d.plant.system.m)
    base = law.base if isinstance(law, Integral) else law
    equations = _LAWS[base.name][0] + (("conint", "dpsi") if isinstance(law, Integral) else ())
    formulas = _law_formulas(law)
    intervals = d.derived.get("input_intervals") or ()
    bounds = [
        rf"{name_as_latex(name)} \in \left[{number(float(pair[0]), 9)}, {number(float(pair[1]), 9)}\right]"
        for name, pair in zip(d.plant.system.input_names, intervals, strict=False)
        if pair is not None
    ]
    if bounds:
        formulas.append(Formula("Range of the input, for every state and every measurement", r", \quad ".join(bounds)))
    measured = ", ".join(d.plant.system.measured_names)
    return Step(
        "law",
        "The saturated law",
        equations,
        f"It reads the measured signals {measured} and nothing else.",
        tuple(formulas),
        ("measurability", "saturation"),
    )


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


_ENERGY = {
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


def _lyapunov(d: Derivation) -> Step:
    formulas = []
    if d.law is not None and not isinstance(d.law, Integral):
        energy, change = _ENERGY[d.law.name]
        formulas.append(Formula("Lyapunov function", energy))
        formulas.append(Formula("Its rate along the closed loop", change))
        formulas.append(
            Formula("where", r"\Phi(z) = \sum_i \frac{\alpha_i}{\beta_i} \ln\cosh(\beta_i z_i) \quad \text{(Phi)}")
        )
    formulas += list(_lasalle(d))
    abscissa = d.derived.get("spectral_abscissa")
    if abscissa is not None:
        formulas.append(
            Formula(
                "Linearised closed loop: largest real part of an eigenvalue",
                rf"\max_k \text{{Re}}\,\lambda_k = {number(float(abscissa), 6)}\ \text{{1/s}}",
            )
        )
    text = "Near x* the loop is stable when the Lyapunov function has a minimum there and does not grow. "
    if isinstance(d.law, Integral):
        text = "With the filter psi there is no Lyapunov function; the linearisation decides, so the result is local. "
    return Step(
        "stability",
        "Stability",
        ("dSd2", "dSdc", "detect"),
        text
        + "Asymptotic stability needs that no other trajectory stays where the rate is zero (LaSalle), or a linearised "
        "loop whose eigenvalues all lie in the left half-plane, which is decided by a Routh array in exact arithmetic.",
        tuple(formulas),
        ("stable", "asymptotically-stable", "globally-asymptotically-stable"),
    )


def _lasalle(d: Derivation) -> Iterator[Formula]:
    """What elimination leaves of the set where the rate vanishes for all times, as a chain of implications."""
    situation = d.situation
    found = situation.invariant if situation is not None else None
    if situation is None or found is None or situation.flow is None:
        return
    system = d.plant.system
    symbols_of_set = [system.x, situation.flow.constant, ca.SX(system.parameters.symbols)]

    def shown(expression: ca.SX) -> str:
        return latex(from_sx(ca.SX(expression), symbols_of_set)[0][0])

    chain = [f"{name_as_latex(system.state_names[k])} = {shown(value)}" for k, value in found.solved.items()]
    chain += [rf"\bar{{u}}_{{{k + 1}}} = {shown(value)}" for k, value in found.inputs.items()]
    if not chain:
        return
    if found.resting:
        chain.append(r"\dot x = 0")
    lines = r" \\ ".join(rf"& \implies {item}" for item in chain)
    caption = (
        "LaSalle: on the invariant set where the rate vanishes, y = 0 and u is constant; elimination along the flow "
        "leaves, at the parameter values,"
    )
    yield Formula(caption, rf"\begin{{aligned}}{lines}\end{{aligned}}")


def _sampled(d: Derivation) -> Step:
    formulas = [
        Formula(
            "Step of the filters: backward Euler, one equation for each saturated argument",
            r"s + N \tanh(s) = c, \quad s = \beta z^{+}",
        )
    ]
    h = rf"h = {number(d.design.sample_period, 9)}\ \text{{s}}"
    radius, largest = d.derived.get("spectral_radius"), d.derived.get("max_sample_period")
    if radius is not None:
        h += rf", \quad \max_k \lvert \mu_k \rvert = {number(float(radius), 9)} < 1"
    if radius is not None and radius >= 1:
        h = h.replace("< 1", r"\ge 1")
    formulas.append(Formula("Spectral radius of the sampled loop (zero-order hold)", h))
    if largest:
        formulas.append(Formula("Largest stable sample period (estimate)", rf"{number(float(largest), 4)}\ \text{{s}}"))
    formulas += list(_sampled_bound(d))
    return Step(
        "sampled",
        "The loop as firmware runs it",
        ("sampled-data bound",),
        "The controller measures, updates its filters implicitly with the new measurement and holds u for the sample "
        "period. Explicit integration of these stiff filters would not be stable.",
        tuple(formulas),
        ("sampled-stable",),
    )


def _sampled_bound(d: Derivation) -> Iterator[Formula]:
    """h <= 2 lambda_min(Lambda_c diag(alpha beta)^-1) where the damping of the output is known (law (uc))."""
    bound = (d.derived.get("sample_periods") or {}).get("lyapunov_stable_to")
    if bound is None:
        return
    law = d.law.base if isinstance(d.law, Integral) else d.law
    of_gains = r"2 \lambda_{\min}\left(\Lambda_c\, \text{diag}(\alpha\beta)^{-1}\right) = "
    yield Formula(
        "The Lyapunov function does not grow from sample to sample for",
        rf"h \le {'' if isinstance(law, NaturalDamping) else of_gains}{number(float(bound))}\ \text{{s}}",
    )
