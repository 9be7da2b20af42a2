"""Targets that no real state meets: what the steps of a certificate may conclude."""

import copy

import casadi as ca
import pytest
from certificates import forged, outcomes, signed
from documents import document_of, status, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension

EQUILIBRIUM = "equilibrium"
LAW = DynamicExtension(1, 1, 1, 1)


def refuted(document, *terms, **found):
    """The document with `equilibrium` REFUTED by other data; terms are added, and named by their places."""
    document = copy.deepcopy(document)
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
    assert refuted(document, "state 1", "inv {0}", "exp {1}", "neg {1}", steps=[[None, {"0": n + 2}]]) == "fails"


def test_neither_is_there_a_contradiction_in_nothing():
    document = document_of("hardening_spring")
    for found in ({}, {"squares": []}, {"cases": [0]}, {"cases": [0, [0, {"steps": []}]]}):
        assert refuted(document, steps=[], **found) == "fails"


def plane(rest, target, domain=None):
    """x' = -x - y + u and y' = x - rest(y), with x asked for."""
    x, y, u = (ca.SX.sym(name) for name in "xyu")
    system = AffineSystem([x, y], [u], [-x - y, x - rest(y)], [1, 0], x**2 / 2 + y**2 / 2, domain=domain)
    return Design(system, target={"x": target}, law=LAW, sample_period=1, name="plane")


def space(first, second, domain=None):
    """Two equations for y and z, beside a state that the input moves."""
    x, y, z, u = (ca.SX.sym(name) for name in "xyzu")
    S = x**2 / 2 + y**2 / 2 + z**2 / 2
    system = AffineSystem([x, y, z], [u], [-x, first(y, z), second(y, z)], [1, 0, 0], S, domain=domain)
    return Design(system, target={"x": 0}, law=LAW, sample_period=1, name="space")


EMPTY = {
    "square": (lambda: plane(lambda y: -(y**2), 1), lambda: plane(lambda y: -(y**2), "-1e-6")),
    "tanh": (lambda: plane(ca.tanh, "1.000001"), lambda: plane(ca.tanh, "0.999999")),
    "exp": (lambda: plane(ca.exp, 0), lambda: plane(ca.exp, "1e-9")),
    "quartic": (
        lambda: plane(lambda y: -(y**4) - y**3 - 3 * y**2 - y, 3),
        lambda: plane(lambda y: -(y**4) - y**3 - 3 * y**2 - y, "-1e-3"),
    ),
    "fraction": (lambda: plane(lambda y: y / (1 + y**2), "0.500001"), lambda: plane(lambda y: y / (1 + y**2), "0.49")),
    "domain": (
        lambda: plane(lambda y: y**3, 3, {"y": (-1, "1.44")}),
        lambda: plane(lambda y: y**3, 3, {"y": (-1, "1.45")}),
    ),
    "factors": (
        lambda: space(lambda y, z: y * (y - 1), lambda y, z: ca.exp(z) + y**3 + y**2 * z**2),
        lambda: space(lambda y, z: y * (y - 1), lambda y, z: ca.exp(z) - y**3 - y**2 * z**2),
    ),
    "circle": (
        lambda: space(lambda y, z: y**2 + z**2 - 1, lambda y, z: y * z - 1),
        lambda: space(lambda y, z: y**2 + z**2 - 2, lambda y, z: y * z - 1),
    ),
}


@pytest.mark.parametrize("name", EMPTY)
def test_targets_that_nothing_meets_are_checked(name):
    if name == "circle":
        pytest.importorskip("clarabel")
    empty, met = (make() for make in EMPTY[name])
    document = written_for(empty)
    assert status(document, EQUILIBRIUM) == "REFUTED"
    assert outcomes(document)[EQUILIBRIUM] == "checked"
    assert outcomes(forged(document, met, claims=()))[EQUILIBRIUM] == "fails"


def test_no_case_can_be_left_out():
    document = written_for(EMPTY["factors"][0]())
    found = witness(document, EQUILIBRIUM)
    source, first, second = found["cases"]
    for cases in ([source, first], [source, second], [source], [source + 1, first, second], [source, first, first]):
        assert outcomes(with_witness(document, EQUILIBRIUM, cases=cases))[EQUILIBRIUM] == "fails"


def test_squares_with_poles_add_up_to_nothing():
    """``x = -y^2`` meets ``x >= 0`` at zero; ``-1 = x / y^2`` on that curve, where y is not zero."""
    y, z, x, u = (ca.SX.sym(name) for name in "yzxu")
    S = (x**2 + y**2 + z**2) / 2
    system = AffineSystem([x, y, z], [u], [-x - (y**2), -y, -z], [0, 0, 1], S, domain={"x": (0, 5)})
    document = written_for(Design(system, target={"z": 1}, law=LAW, sample_period=1, name="curve"))
    more = ["state 1", "mul {0} {0}", "neg {1}", "inv {0}", "constant 0"]
    n = len([line for line in document["terms"] if line.startswith(" ")])
    steps = [[0, 0, n + 2], [None, {}]]
    squares = [["1", [["above", 0, None, False]], [n + 3]]]
    assert refuted(document, *more, steps=steps, squares=squares) == "fails"
    steps = [[0, 0, n + 2], [None, {"0": n + 4}]]
    assert refuted(document, *more, steps=steps, squares=squares) == "fails"
