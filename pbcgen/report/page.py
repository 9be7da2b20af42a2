"""The report: one HTML page that carries everything with it, to be read, reviewed and filed with a release."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import Any

import jinja2
from markupsafe import Markup

import pbcgen
from pbcgen.control.attraction import Region
from pbcgen.emit import Package
from pbcgen.emit.templating import template_directory, templates_in
from pbcgen.emit.wording import timing
from pbcgen.models.exact import decimal
from pbcgen.models.laws import gains
from pbcgen.models.limits import row_text
from pbcgen.pipeline import Report, certificate
from pbcgen.proof.claim import EMISSION_CLAIMS, Claim, Status
from pbcgen.report.curves import Curves, signal_figures, simulate
from pbcgen.report.derivation import steps
from pbcgen.report.mathematics import mathml
from pbcgen.report.model_formulas import model_formulas
from pbcgen.report.plot_data import plot_data
from pbcgen.report.sentence import meaning, open_points
from pbcgen.symbolic.sympy_form import decimal_as_latex, name_as_latex

Progress = Callable[[str], None] | None

#: A true minus sign and the dash of an empty cell.
MINUS, DASH = "\N{MINUS SIGN}", "\N{EN DASH}"

#: The sign that stands beside the word of a status, so that colour is never all there is.
ICONS: Mapping[Status, str] = {Status.PROVED: "✓", Status.REFUTED: "✗", Status.UNDECIDED: "?"}

#: What each claim says, in a line.
MEANINGS: Mapping[str, str] = {
    "input-rank": "the inputs act independently: g has full column rank",
    "equilibrium": "a constant input holds the system at x*",
    "assumption-1": "the stored energy does not grow by itself",
    "passive-output": "gamma exists with rate y, the passive output",
    "gradient-condition": "x* is a critical point of the shaped storage",
    "hessian-condition": "the shaped storage has a strict minimum at x*",
    "gain-definiteness": "the matrix gains are positive definite",
    "kc-bound": "K_c is stiff enough for the minimum to survive the filter",
    "assumption-3": "some coordinates are damped by nature",
    "theta": "K_l R_l is large enough for the Lyapunov function to decrease",
    "measurability": "the law needs only what is measured",
    "saturation": "every input stays in its interval, whatever is measured",
    "stable": "trajectories that start near x* stay near it",
    "asymptotically-stable": "trajectories that start near x* converge to it",
    "globally-asymptotically-stable": "every trajectory converges to x*",
    "sampled-stable": "the loop with the C at this sample period converges from nearby",
    "adjustable": "all of this holds for every target and gain that may be set at run time",
    "region-of-attraction": "every trajectory that starts in this set converges to x*",
}


@dataclass(frozen=True)
class Comparison:
    """One quantity of two designs."""

    name: str
    before: str
    after: str


def page(
    report: Report,
    package: Package | None = None,
    *,
    before: Report | None = None,
    region: Region | None = None,
    progress: Progress = None,
) -> str:
    """The page of a checked design as HTML.

    Args:
        report: the check.
        package: the C that was generated from it, or None when there is none.
        before: the check of an earlier design to compare with, such as the one before tuning.
        region: the region of attraction, if one was looked for.
        progress: told the name of each stage.

    Returns:
        One document without references to anything outside it. Equal inputs give equal text: it holds no dates.
    """
    curves = simulate(report, package, before, progress)
    if progress:
        progress("page")
    return _environment().get_template("page.html.j2").render(_context(report, package, before, region, curves))


@cache
def _environment() -> jinja2.Environment:
    environment = templates_in(template_directory() / "report", html=True)
    environment.filters |= {"math": _math, "formula": block_filter, "symbol": symbol_filter, "figure": figure}
    environment.filters |= {"zip_names": _zip_names, "interval": _interval}
    environment.globals |= {"asset": _asset, "icons": ICONS, "meanings": MEANINGS}
    return environment


def _math(latex: str) -> Markup:
    return Markup(mathml(latex))  # latex2mathml escapes what it is given


def block_filter(latex: str) -> Markup:
    """A displayed formula as MathML."""
    return Markup(mathml(latex, block=True))


def symbol_filter(name: str) -> Markup:
    """A name of the model as MathML."""
    return _math(name_as_latex(name))


def _asset(name: str) -> Markup:
    """The text of a file beside the template, such as a script."""
    return Markup((template_directory() / "report" / name).read_text(encoding="utf-8"))


def _style() -> Markup:
    """The style sheet with the font of the formulas in it."""
    font = base64.b64encode((template_directory() / "report" / "math.woff2").read_bytes()).decode("ascii")
    return Markup(_asset("page.css").replace("MATH_FONT", font))


def figure(value: float | None, digits: int = 5) -> str:
    """A number for a table; a dash where there is none."""
    return DASH if value is None else f"{value + 0.0:.{digits}g}".replace("-", MINUS)


def _context(
    report: Report, package: Package | None, before: Report | None, region: Region | None, curves: Curves | None
) -> dict[str, Any]:
    design, system = report.design, report.design.system
    states, inputs = ([], []) if curves is None else signal_figures(report, curves)
    plots = None if curves is None else plot_data(report, curves, region)
    text = certificate(report)
    return {
        "report": report,
        "design": design,
        "system": system,
        "title": system.name or design.name or "controller",
        "verdict": meaning(report)
        if package is None or report.emittable
        else f"Code by consent: {open_points(report)}.",
        "emission_claims": EMISSION_CLAIMS,
        "claims": {claim.claim: claim for claim in report.claims},
        "counterexamples": {c.claim: counterexample(c) for c in report.claims if c.counterexample},
        "counts": {status: sum(c.status is status for c in report.claims) for status in Status},
        "period": decimal(design.sample_period),
        "timing": timing(design.delay, design.jitter),
        "shared_limits": [
            f"{row_text(row, system.input_names)} ≤ {decimal(bound)}"
            for row, bound in zip(design.input_set.A, design.input_set.b, strict=True)
        ],
        "parameters": [(name, _parameter(value)) for name, value in system.parameters.values.items()],
        "model_formulas": model_formulas(report.derivation.plant),
        "steps": steps(report.derivation),
        "curves": curves,
        "states": states,
        "inputs": inputs,
        "plots": plots,
        "plots_json": _json_for_html(plots),
        "package": package,
        "manifest": None if package is None else json.loads(package.files["manifest.json"]),
        "prototypes": [] if package is None else prototypes(package),
        "certificate_hash": hashlib.sha256(text.encode()).hexdigest(),
        "comparison": [] if before is None else compare(before, report),
        "before": before,
        "region": region,
        "starts_inside": region is not None
        and report.loop is not None
        and region.contains(list(report.loop.initial), at_zero=True),
        "version": pbcgen.__version__,
        "style": _style(),
    }


def prototypes(package: Package) -> list[str]:
    """The functions that the header declares, each on one line."""
    header = package.files[f"{package.prefix}.h"]
    found = re.findall(rf"^\w[\w ]*\b{package.prefix}_\w+\([^;{{]*\);", header, re.MULTILINE)
    return [" ".join(text.split()) for text in found]


def _parameter(value: Fraction) -> str:
    """LaTeX of an exact value: a decimal where there is a short one, else p/q."""
    text = decimal(value)
    return text if "/" in text else decimal_as_latex(float(value), 15)


def _json_for_html(document: Any) -> Markup:
    """JSON that may stand in a script element."""
    text = json.dumps(document, separators=(",", ":"), sort_keys=True, allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))


def counterexample(claim: Claim) -> list[tuple[str, str]]:
    """The counterexample as rows of name and value."""
    return [(name, _plain(value)) for name, value in (claim.counterexample or {}).items()]


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{k} = {_plain(v)}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(_plain(v) for v in value) + ")"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


_COMPARED = (
    ("spectral_abscissa", "largest real part of the linearised loop [1/s]"),
    ("hessian_min_eigenvalue", "smallest eigenvalue of the shaped storage's Hessian"),
    ("max_sample_period", "largest stable sample period [s]"),
    ("input_intervals", "range of the input"),
)


def compare(before: Report, after: Report) -> list[Comparison]:
    """What two designs differ in: gains, and the figures that decide."""
    old, new = _gains(before), _gains(after)
    rows = [Comparison(f"gain {k}", old.get(k, DASH), new.get(k, DASH)) for k in sorted({*old, *new})]
    for key, name in _COMPARED:
        rows.append(Comparison(name, _value(before.derived.get(key)), _value(after.derived.get(key))))
    return [row for row in rows if row.before != row.after]


def _gains(report: Report) -> dict[str, str]:
    law = report.derivation.law or report.design.law
    return {name: _value(value) for name, value in gains(law).items()}


def _value(value: Any) -> str:
    if value is None:
        return DASH
    if isinstance(value, Sequence) and not isinstance(value, str):
        if len(value) == 1 and not isinstance(value[0], str):
            return _value(value[0])
        return ", ".join(f"[{_value(v)}]" if isinstance(v, (list, tuple)) else _value(v) for v in value)
    return figure(float(value), 6)


def _zip_names(values: Sequence[Any], names: Sequence[str]) -> list[tuple[str, Any]]:
    return list(zip(names, values, strict=False))


def _interval(bounds: Any) -> str:
    """``[lo, hi]``, exact; nothing where there is no bound."""
    if not isinstance(bounds, (list, tuple)) or all(bound is None for bound in bounds):
        return ""
    lo, hi = ("∞" if bound is None else decimal(Fraction(bound)) for bound in bounds)
    return f"[{MINUS if lo == '∞' else ''}{lo}, {hi}]".replace("[-", f"[{MINUS}").replace(" -", f" {MINUS}")
