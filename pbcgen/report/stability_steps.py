"""The last steps of a derivation: stability in continuous time, and of the loop as firmware runs it."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca

from pbcgen.control.derive import Derivation
from pbcgen.models.laws import Integral, NaturalDamping, base_law
from pbcgen.proof.claim import Status
from pbcgen.report.law_formulas import ENERGY
from pbcgen.report.mathematics import Formula, Step, number
from pbcgen.symbolic.sympy_form import from_sx, latex, name_as_latex


def proved(d: Derivation, *names: str) -> bool:
    """Whether these claims, as far as they concern the law, are PROVED."""
    return all(claim.status is Status.PROVED for claim in d.claims if claim.claim in names)


def lyapunov_step(d: Derivation) -> Step:
    """The Lyapunov function, LaSalle's set, the linearisation."""
    formulas = []
    passive = proved(d, "passive-output", "gradient-condition")
    if d.law is not None and not isinstance(d.law, Integral) and passive:
        energy, change = ENERGY[d.law.name]
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
    if not passive:
        text = "Without a passive output, or where x* is no critical point, there is no Lyapunov function; the "
        text += "linearisation decides, so the result is local. "
    elif isinstance(d.law, Integral):
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
    symbols_of_set = [system.x, situation.flow.constant, d.plant.parameter_symbols]

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


def sampled_step(d: Derivation) -> Step:
    """The discretised law and the sample periods that are proved."""
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
        known = (d.derived.get("sample_periods") or {}).get("spectral_scan_complete")
        what = "Linearised, it is stable for every period up to" if known else "Largest stable sample period (estimate)"
        formulas.append(Formula(what, rf"{number(float(largest), 4)}\ \text{{s}}"))
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
    law = base_law(d.law)
    of_gains = r"2 \lambda_{\min}\left(\Lambda_c\, \text{diag}(\alpha\beta)^{-1}\right) = "
    yield Formula(
        "The Lyapunov function does not grow from sample to sample for",
        rf"h \le {'' if isinstance(law, NaturalDamping) else of_gains}{number(float(bound))}\ \text{{s}}",
    )
