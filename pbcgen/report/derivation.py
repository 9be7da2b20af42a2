"""The derivation of a controller, step by step, as formulas with the names that the literature gives them.

Every step shows what the check computed. The page and the notebook print the same steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca

from pbcgen.control.derive import Derivation
from pbcgen.models.laws import Integral, NaturalDamping, PassiveOutput, PotentialCompensation, base_law, shaping
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.shaping import Shape, shape_at
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.definite import eigenvalues
from pbcgen.report.law_formulas import LAWS, formulas_of
from pbcgen.report.mathematics import (
    Formula,
    Step,
    column,
    exactly,
    matrix,
    number,
    number_matrix,
    numbers,
    rate,
    symbols,
)
from pbcgen.report.stability_steps import lyapunov_step, proved, sampled_step
from pbcgen.symbolic.real import BITS, precision, rational
from pbcgen.symbolic.real_matrices import dense, diagonal
from pbcgen.symbolic.sympy_form import name_as_latex


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
        lyapunov_step,
        sampled_step,
    ]
    return [step for step in (maker(derivation) for maker in makers) if step is not None]


def _equilibrium(d: Derivation) -> Step:
    system, formulas = d.plant.system, []
    wanted = ", ".join(rf"{name_as_latex(c.name)} = {number(c.value, 12)}" for c in d.design.target.conditions)
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


def _row(values: Any) -> str:
    return rf"\left({', '.join(number(float(v), 9) for v in values)}\right)"


def _storage(d: Derivation) -> Step:
    plant = d.plant
    formulas = []
    mechanical = plant.system.mechanical is not None
    if not mechanical:
        gradient = [row[0] for row in exactly(plant, plant.gradient)]
        formulas.append(Formula("Gradient of the storage", rf"\nabla S(x) = {column(gradient)}"))
    structure = d.structure
    if structure is not None and not mechanical:
        relation = r"f = F \nabla S - \rho" if structure.form == "F" else r"\nabla S = A f"
        value = rf"{structure.form} = {matrix(exactly(plant, ca.densify(structure.matrix)))}"
        if structure.remainder.nnz():
            value += rf", \quad \rho = {column([row[0] for row in exactly(plant, structure.remainder)])}"
        formulas.append(Formula(f"Power structure, {structure.origin}", rf"{relation}, \quad {value}"))
    if mechanical:
        loss = r"-\nabla S^{\top} f = \dot q^{\top} D \dot q = \lVert \ell \rVert^2 \ge 0"
    else:
        loss = rf"-\nabla S^{{\top}} f = \lVert \ell(x) \rVert^2 = {_loss(plant, structure)}"
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


def _loss(plant: Plant, structure: PowerStructure | None) -> str:
    """In the rates of the free motion where grad S = A f, which is short; else in the states."""
    if structure is None or structure.form != "A":
        return exactly(plant, -ca.dot(plant.gradient, plant.system.f))[0][0]
    B = ca.sparsify(ca.densify(structure.dissipation()))
    if any(row != col for row, col in zip(*B.sparsity().get_triplet(), strict=True)):
        return rf"\dot x^{{\top}} {matrix(exactly(plant, ca.densify(B)))} \dot x, \quad \dot x = f"
    losses = [row[0] for row in exactly(plant, ca.densify(ca.diag(B)))]
    return _combination(losses, [f"{rate(name)}^2" for name in plant.system.state_names]) + r", \quad \dot x = f"


def _output(d: Derivation) -> Step:
    formulas = []
    if d.gamma is not None:
        passive = proved(d, "passive-output")
        names = ("Found", "Passive output (ypas)") if passive else ("Tried", "Its rate: it may be no passive output")
        formulas.append(Formula(names[0], rf"\gamma(x) = {column([row[0] for row in exactly(d.plant, d.gamma)])}"))
        slope = ca.jacobian(d.gamma, d.plant.system.x)
        terms = exactly(d.plant, ca.densify(slope))
        rates = [rate(name) for name in d.plant.system.state_names]
        outputs = [_combination(row, rates) for row in terms]
        formulas.append(Formula(names[1], rf"y = \dot\gamma = {column(outputs)}"))
        if passive:
            through = _feedthrough(d.plant, slope)
            formulas.append(Formula("Feedthrough of the output: y contains w^T w u (ypas)", through))
    return Step(
        "output",
        "Passive output: a function gamma whose rate is y",
        ("ypas", "hesscond, line 1"),
        "gamma gives a passive output for S if and only if the Hill-Moylan matrix Z(x) is positive semidefinite for "
        "all x; Z collects Assumption 1, the output and its feedthrough in one matrix.",
        (*formulas, Formula("Hill-Moylan", _HILL_MOYLAN)),
        ("passive-output",),
    )


def _feedthrough(plant: Plant, slope: ca.SX) -> str:
    """w^T w = sym(grad gamma^T g); with w = 0 the law needs no algebraic loop."""
    through = ca.mtimes(slope, plant.system.g)
    rows = exactly(plant, ca.densify((through + through.T) / 2))
    value = "0" if all(item == "0" for row in rows for item in row) else matrix(rows)
    return rf"w^{{\top}} w = \text{{sym}}(\nabla\gamma^{{\top}} g) = {value}"


_HILL_MOYLAN = (
    r"Z(x) = \begin{bmatrix} -\nabla S^{\top} f & \tfrac12 (\nabla\gamma^{\top} f - g^{\top} \nabla S)^{\top} \\ "
    r"\tfrac12 (\nabla\gamma^{\top} f - g^{\top} \nabla S) & \text{sym}(\nabla\gamma^{\top} g) \end{bmatrix} \ge 0"
)


def _combination(coefficients: list[str], factors: list[str]) -> str:
    terms = []
    for coefficient, factor in zip(coefficients, factors, strict=True):
        if coefficient == "0":
            continue
        simple = not any(sign in coefficient for sign in (" + ", " - "))
        shown = coefficient if simple or coefficient.startswith(r"\frac") else rf"\left({coefficient}\right)"
        terms.append(factor if coefficient == "1" else f"-{factor}" if coefficient == "-1" else f"{shown} {factor}")
    return " + ".join(terms).replace("+ -", "- ") or "0"


def _shape(d: Derivation) -> tuple[Shape, Any] | None:
    if d.point is None or d.gamma is None or d.law is None:
        return None
    shape = shape_at(d.plant, d.point, d.gamma, d.law)
    return shape, diagonal([rational(v) for v in shaping(d.law).stiffness])


def _shaping(d: Derivation) -> Step:
    formulas = []
    found = _shape(d)
    compensated = isinstance(base_law(d.law), PotentialCompensation)
    storage = r"\tfrac12 p^{\top} M^{-1} p" if compensated else r"S + \kappa^{\top}\gamma"
    if found is not None:
        shape, stiffness = found
        formulas.append(Formula("Stiffness of the law", rf"\text{{diag}}(\alpha\beta) = {number_matrix(stiffness, 8)}"))
        with precision(BITS):
            hessian = dense(shape.hessian(stiffness), len(shape.N))
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
    law = base_law(d.law)
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
    law = base_law(d.law)
    if not isinstance(law, NaturalDamping):
        return None
    formulas = []
    if d.eta is not None:
        formulas.append(Formula("Damped coordinates", rf"\eta(x) = {column([r[0] for r in exactly(d.plant, d.eta)])}"))
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


def _law(d: Derivation) -> Step:
    law = d.law if d.law is not None else d.design.law.resolve(d.plant.system.m)
    base = base_law(law)
    equations = LAWS[base.name][0] + (("conint", "dpsi") if isinstance(law, Integral) else ())
    formulas = formulas_of(law)
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
