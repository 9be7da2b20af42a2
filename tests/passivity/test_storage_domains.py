"""Assumption 1 on the whole space and on the stated box; passive outputs that do not exist."""

from __future__ import annotations

from fractions import Fraction
from importlib import import_module

import casadi as ca
import pytest

from pbcgen import AffineSystem
from pbcgen.passivity.obstruction import obstruction
from pbcgen.passivity.passive_output import PassiveOutput, find
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.storage import assumption_1
from pbcgen.proof import sos
from pbcgen.proof.claim import Status

PROVED, REFUTED, UNDECIDED = Status.PROVED, Status.REFUTED, Status.UNDECIDED


def _plant(f, S, g=None, **keywords):
    x = [ca.SX.sym(f"x{k}") for k in range(f.__code__.co_argcount)]
    g = [0] * (len(x) - 1) + [1] if g is None else g(*x)
    return Plant(AffineSystem(x, [ca.SX.sym("u")], f(*x), g, S(*x), **keywords))


def _energy(*x):
    return sum(e**2 for e in x) / 2


def _van_der_pol(**keywords):
    return _plant(lambda x, y: [y, -x - (1 - x**2) * y], _energy, **keywords)


def _output(plant):
    storage = assumption_1(plant)
    return find(plant, storage.structure, storage.proved, storage.by_structure, storage.region)


def test_damping_that_is_positive_near_the_origin_only_is_refuted_on_the_whole_space():
    claim = assumption_1(_van_der_pol()).claim
    assert (claim.status, claim.domain) == (REFUTED, "all x")


def test_the_stated_box_is_the_domain_of_the_proof():
    claim = assumption_1(_van_der_pol(domain={"x0": ("-0.9", "0.9")})).claim
    assert (claim.status, claim.domain) == (PROVED, "x0 in [-0.9, 0.9]")


def test_a_box_on_whose_edge_the_damping_vanishes_is_enough():
    assert assumption_1(_van_der_pol(domain={"x0": (-1, 1)})).proved


def test_a_box_that_is_a_little_too_large_is_refuted_inside_it():
    claim = assumption_1(_van_der_pol(domain={"x0": (-1, "1.000001")})).claim
    assert claim.status is REFUTED
    assert Fraction(claim.counterexample["x"]["x0"]) > 1


def test_the_box_is_proved_without_the_solver_too(monkeypatch):
    monkeypatch.setattr(sos, "available", lambda: False)
    claim = assumption_1(_van_der_pol(domain={"x0": ("-0.9", "0.9")})).claim
    assert claim.status is PROVED
    assert "branch" in claim.method or "structure" in claim.method


def test_a_half_line_is_a_domain():
    claim = assumption_1(_plant(lambda x, y: [y, -x - x * y], _energy, domain={"x0": (0, None)})).claim
    assert (claim.status, claim.domain) == (PROVED, "x0 >= 0")


def test_a_band_of_negative_damping_is_refuted_and_its_harmless_variant_is_not():
    def friction(excess):
        return lambda x, y: [y, -x - (1 - (1 + excess) * ca.exp(-(((y - 2) / 2e-4) ** 2))) * y]

    box = {"x0": (-5, 5), "x1": (-5, 5)}
    assert assumption_1(_plant(friction(1e-6), _energy)).claim.status is REFUTED
    assert assumption_1(_plant(friction(1e-6), _energy, domain=box)).claim.status is REFUTED
    assert assumption_1(_plant(friction(-1e-6), _energy)).claim.status is not REFUTED
    assert assumption_1(_plant(friction(-1e-6), _energy, domain=box)).claim.status is PROVED


def test_a_quartic_that_needs_a_sum_of_squares_holds_everywhere():
    pytest.importorskip("clarabel")
    plant = _plant(lambda x, y: [y - (2 * x**3 + 2 * x**2 * y), -x + x**2 * y - 5 * y**3], _energy)
    claim = assumption_1(plant).claim
    assert (claim.status, claim.domain) == (PROVED, "all x")


def test_a_formula_that_is_not_defined_everywhere_is_not_proved_on_the_whole_space():
    def drift(x, y):
        return [y / x, -1 + 0 * y]

    assert assumption_1(_plant(drift, _energy)).claim.domain != "all x"
    assert assumption_1(_plant(drift, _energy, domain={"x0": (1, 3)})).claim.domain == "x0 in [1, 3]"


def test_a_model_with_a_kink_is_never_refuted_without_a_counterexample():
    plant = _plant(lambda x, y: [y, -x - ca.fmax(y, 2 * y)], _energy)
    assert assumption_1(plant).claim.status is UNDECIDED


def test_the_passive_output_is_claimed_on_the_same_box():
    found = _output(_van_der_pol(domain={"x0": ("-0.9", "0.9")}))
    assert isinstance(found, PassiveOutput)
    assert (found.claim.status, found.claim.domain) == (PROVED, "x0 in [-0.9, 0.9]")


def _free(G):
    """A free body with inputs G(q): no potential, no dissipation."""
    return _plant(lambda a, c, p, r: [p, r, 0, 0], lambda a, c, p, r: (p**2 + r**2) / 2, lambda a, c, p, r: G(a, c))


def test_an_output_that_cannot_be_integrated_is_refuted_with_its_curl():
    claim = _output(_free(lambda a, c: [0, 0, c, 2]))
    assert claim.status is REFUTED
    assert "d psi_x0/dx1" in claim.evidence


def test_an_output_that_can_be_integrated_is_found():
    found = _output(_free(lambda a, c: [0, 0, a, 2]))
    assert isinstance(found, PassiveOutput)
    assert obstruction(_free(lambda a, c: [0, 0, a, 2])) is None


def test_with_dissipation_the_curl_alone_refutes_nothing():
    plant = _plant(
        lambda a, c, p, r: [p, r, -p, -r],
        lambda a, c, p, r: (p**2 + r**2) / 2,
        lambda a, c, p, r: [0, 0, c, 2],
    )
    claim = _output(plant)
    assert claim.status is UNDECIDED
    assert "d psi_x0/dx1" in claim.evidence


def test_a_natural_output_that_does_not_vanish_at_rest_leaves_no_gamma():
    plant = _plant(lambda x, y: [0 * x, -y], lambda x, y: x + y**2 / 2, lambda x, y: [1, 1])
    assert _output(plant).status is REFUTED


@pytest.mark.parametrize("name", ["coupling_device", "rlc", "pera", "pera_integral", "elastic_pendulum"])
def test_where_a_gamma_exists_there_is_no_obstruction(name):
    system = import_module(f"pbcgen.examples.{name}").design.system
    assert obstruction(Plant(system if isinstance(system, AffineSystem) else system.lower())) is None


def test_a_given_gamma_with_the_wrong_sign_is_refuted():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    make = lambda gamma: Plant(  # noqa: E731
        AffineSystem([x, y], [ca.SX.sym("u")], [y, -x - y], [0, 1], (x**2 + y**2) / 2, gamma=[gamma])
    )
    assert _output(make(x)).claim.status is PROVED
    assert _output(make(-x)).claim.status is REFUTED


def test_gamma_with_w_is_found_by_semidefinite_programming():
    """The coupling device without its power structure: gamma = x1/2 + x2, as the structure gives it."""
    pytest.importorskip("clarabel")
    from pbcgen.examples.coupling_device import device

    plant = Plant(device)
    found = find(plant, None, True, False)
    assert isinstance(found, PassiveOutput)
    assert found.claim.status is PROVED
