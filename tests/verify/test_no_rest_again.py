"""Targets that no real state meets: what the steps of a certificate may conclude."""

from certificates import outcomes, signed
from documents import document_of

EQUILIBRIUM = "equilibrium"


def refuted(document, *terms, **found):
    """The document with `equilibrium` REFUTED by other data; terms are added, and named by their places."""
    n = len([line for line in document["terms"] if line.startswith(" ")])
    document["terms"] += [f"  {n + k} {term.format(*range(n, n + k))}" for k, term in enumerate(terms)]
    for entry in document["claims"]:
        if entry["claim"] == EQUILIBRIUM:
            entry.update(status="REFUTED", witness=found)
    return outcomes(signed(document))[EQUILIBRIUM]


def test_a_weight_with_a_pole_contradicts_nothing():
    """At rest p = 0; p times 1 / p is one, wherever p is not zero. No step may take that for a contradiction."""
    document = document_of("hardening_spring")
    n = len([line for line in document["terms"] if line.startswith(" ")])
    assert refuted(document, "state 1", "inv {0}", steps=[[None, {"0": n + 1}]]) == "fails"
