"""Designs, reports and derivations show themselves richly in a notebook, and cost nothing before that."""

import subprocess
import sys

import pytest
from shown_designs import circuit, refused

from pbcgen.report import notebook

interactive = pytest.importorskip("IPython.core.interactiveshell", reason="needs IPython")


@pytest.fixture
def shell():
    import pbcgen

    made = interactive.InteractiveShell.instance()
    pbcgen.load_ipython_extension(made)
    return made


def shown(shell, value):
    return shell.display_formatter.format(value)[0]


def test_a_report_is_a_table_of_verdicts_with_its_derivation(shell):
    report, _ = circuit()
    formats = shown(shell, report)
    assert formats["text/html"].count("<tr>") == len(report.claims) + 1
    assert "<math " in formats["text/html"]
    assert r"\nabla S" in formats["text/latex"]


def test_a_refuted_claim_shows_its_counterexample(shell):
    claim = next(c for c in refused().claims if c.counterexample)
    text = shown(shell, claim)["text/html"]
    assert "✗" in text
    assert "REFUTED" in text
    assert "Counterexample:" in text


def test_a_design_shows_model_and_law(shell):
    report, _ = circuit()
    formats = shown(shell, report.design)
    assert "nonlinear RLC circuit" in formats["text/html"]
    assert r"\tanh" in formats["text/latex"]


def test_a_derivation_has_formulas(shell):
    report, _ = circuit()
    assert shown(shell, report.derivation)["text/html"].count("<math ") > 15


def test_what_is_registered_is_what_there_is():
    import pbcgen

    class Formatters(dict):
        def __missing__(self, kind):
            self[kind] = type("F", (list,), {"for_type_by_name": lambda s, m, n, f: s.append((m, n))})()
            return self[kind]

    formatters = Formatters()
    pbcgen.load_ipython_extension(type("Shell", (), {"display_formatter": type("D", (), {"formatters": formatters})}))
    registered = {(key, kind) for kind, keys in formatters.items() for key in keys}
    assert registered == {(key, kind) for key, kinds in notebook.FORMATS.items() for kind in kinds}


def test_importing_pbcgen_in_a_notebook_does_not_import_the_report():
    code = "import IPython, sys, pbcgen; assert 'pbcgen.report' not in sys.modules and 'casadi' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
