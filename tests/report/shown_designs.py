"""A checked and generated design that the tests of the page share."""

from functools import cache

from pbcgen import pipeline
from pbcgen.models.laws import DynamicExtension
from pbcgen.models.loader import load
from pbcgen.report.page import page


@cache
def circuit():
    """(report, package) of the circuit, with a shorter run."""
    report = pipeline.check(load("rlc").with_(duration="0.05"))
    return report, pipeline.package(report)


@cache
def circuit_page():
    report, package = circuit()
    return page(report, package)


@cache
def refused():
    """A design below its stiffness threshold."""
    law = DynamicExtension(alpha=3, beta="0.6", K_c=12, R_c=1)
    return pipeline.check(load("elastic_pendulum").with_(law=law, duration="0.5"))
