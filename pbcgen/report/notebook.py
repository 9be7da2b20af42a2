"""How designs, verdicts and derivations show themselves in a notebook.

``import pbcgen`` inside IPython registers the functions of :data:`FORMATS` by the names of the types; nothing of
this is imported before the first object is shown.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import jinja2
import matplotlib as mpl

from pbcgen.control.derive import Derivation
from pbcgen.emit.templating import template_directory, templates_in
from pbcgen.models.design import Design
from pbcgen.models.exact import decimal
from pbcgen.passivity.plant import Plant
from pbcgen.pipeline import Report, Simulation
from pbcgen.proof.claim import Claim
from pbcgen.report.derivation import steps
from pbcgen.report.law_formulas import law_formulas
from pbcgen.report.mathematics import Formula, Step
from pbcgen.report.model_formulas import model_formulas
from pbcgen.report.page import ICONS, MEANINGS, block_filter, counterexample, symbol_filter
from pbcgen.report.plots import STYLE, Bounds, plot_closed_loop
from pbcgen.report.sentence import meaning


@cache
def _environment() -> jinja2.Environment:
    environment = templates_in(template_directory() / "report", html=True)
    environment.filters |= {"formula": block_filter, "symbol": symbol_filter}
    environment.globals |= {"icons": ICONS, "meanings": MEANINGS, "counterexample": counterexample}
    return environment


def _render(part: str, **context: Any) -> str:
    return _environment().get_template("notebook.html.j2").render(part=part, **context)


def report_html(report: Report) -> str:
    """The verdict in a sentence, the table of claims, the derivation to unfold."""
    return _render("report", report=report, verdict=meaning(report), steps=steps(report.derivation))


def claim_html(claim: Claim) -> str:
    """One claim as a table of one row."""
    return _render("claim", claim=claim)


def design_html(design: Design) -> str:
    """The model in formulas, the target, the law and its gains."""
    formulas = [*model_formulas(Plant(design.system)), *law_formulas(design)]
    return _render("design", design=design, formulas=formulas, period=decimal(design.sample_period))


def derivation_html(derivation: Derivation) -> str:
    """All steps."""
    return _render("derivation", steps=steps(derivation))


def design_latex(design: Design) -> str:
    """The formulas of a design, for export to LaTeX."""
    return _latex([*model_formulas(Plant(design.system)), *law_formulas(design)])


def derivation_latex(derivation: Derivation) -> str:
    """The formulas of all steps, for export to LaTeX."""
    return "\n\n".join(_step_latex(step) for step in steps(derivation))


def report_latex(report: Report) -> str:
    """The formulas of the derivation, for export to LaTeX."""
    return derivation_latex(report.derivation)


def simulation_png(simulation: Simulation) -> bytes:
    """States and inputs, continuous and sampled."""
    loop = simulation.report.loop
    targets = [None if loop is None else float(v) for v in ([] if loop is None else loop.x_star)]
    title = simulation.report.design.name or ""
    bounds = Bounds(simulation.intervals, simulation.report.design.input_set.intervals)
    figure = plot_closed_loop(simulation.continuous, simulation.sampled, bounds, targets, title)
    target = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(target, format="png", dpi=60, metadata={"Software": None})
    return target.getvalue()


def _step_latex(step: Step) -> str:
    return rf"\textbf{{{step.title}}}" + "\n" + _latex(list(step.formulas))


def _latex(formulas: list[Formula]) -> str:
    return "\n".join(f"$$\n{formula.latex}\n$$" for formula in formulas)


#: For each type (module, name) how it shows itself, by MIME type.
FORMATS: Mapping[tuple[str, str], Mapping[str, Callable[[Any], Any]]] = {
    ("pbcgen.pipeline", "Report"): {"text/html": report_html, "text/latex": report_latex},
    ("pbcgen.pipeline", "Simulation"): {"image/png": simulation_png},
    ("pbcgen.proof.claim", "Claim"): {"text/html": claim_html},
    ("pbcgen.control.derive", "Derivation"): {"text/html": derivation_html, "text/latex": derivation_latex},
    ("pbcgen.models.design", "Design"): {"text/html": design_html, "text/latex": design_latex},
}
