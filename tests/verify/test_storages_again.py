"""Storages, invariant sets, and what is conserved: no part of a witness can be left out."""

import copy

import casadi as ca
import pytest
from certificates import forged, outcomes, signed
from documents import GLOBAL, LOCAL, SAMPLED, document_of, status, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical

pytestmark = pytest.mark.system


def _with_storage(P):
    """The certificate of the chain with this storage for its sampled loop, and nothing else for that claim."""
    document = copy.deepcopy(document_of("slowly_sampled_chain"))
    for entry in document["claims"]:
        if entry["claim"] == SAMPLED:
            entry |= {"witness": {"P": P}, "domain": "sampled loop"}
    return outcomes(signed(document))[SAMPLED]


def test_a_storage_that_is_not_definite_or_does_not_fall_is_refused():
    P = witness(document_of("slowly_sampled_chain"), SAMPLED)["P"]
    assert _with_storage(P) == "checked"
    for i in (0, len(P) // 2, len(P) - 1):
        for entry in ("0", "-1"):
            assert _with_storage([*P[:i], [*P[i][:-1], entry], *P[i + 1 :]]) != "checked"
    negative = [[v.removeprefix("-") if v.startswith("-") else f"-{v}" for v in row] for row in P]
    for rows in ([], P[:-1], negative):
        assert _with_storage(rows) != "checked"


def test_a_storage_that_decreases_and_is_not_definite_shows_only_that_a_loop_is_unstable():
    document = document_of("too_slowly_sampled_chain")
    P = witness(document, SAMPLED)["P"]
    forged = copy.deepcopy(document)
    for entry in forged["claims"]:
        entry["status"] = "PROVED" if entry["claim"] == SAMPLED else entry["status"]
    assert outcomes(signed(forged))[SAMPLED] == "fails"
    stable = copy.deepcopy(document_of("slowly_sampled_chain"))
    for entry in stable["claims"]:
        entry["status"] = "REFUTED" if entry["claim"] == SAMPLED else entry["status"]
    assert outcomes(signed(stable))[SAMPLED] == "fails"
    for rows in ([["0"] * (i + 1) for i in range(len(P))], [[f"-{v}".replace("--", "") for v in row] for row in P]):
        assert outcomes(with_witness(document, SAMPLED, P=rows))[SAMPLED] == "fails"


def test_a_local_claim_does_not_rest_on_a_global_one_that_is_not_shown():
    document = document_of("integral_chain")
    assert outcomes(with_witness(document, LOCAL, globally=True))[LOCAL] != "checked"
    for name, claim in (("chain", GLOBAL), ("chain_on_a_domain", LOCAL)):
        assert outcomes(with_witness(document_of(name), claim, steps=[]))[LOCAL] == "fails"


def test_x_star_is_no_second_equilibrium():
    document = document_of("softening_spring")
    centre = ["0"] * len(witness(document, GLOBAL)["centre"])
    assert outcomes(with_witness(document, GLOBAL, centre=centre))[GLOBAL] == "fails"
    moved = [str(float(v) + 0.01) for v in witness(document, GLOBAL)["centre"]]
    assert outcomes(with_witness(document, GLOBAL, centre=moved))[GLOBAL] == "fails"


@pytest.mark.parametrize("vector", [["0", "0"], ["1", "-1"], ["1", "2"]])
def test_what_is_not_conserved_is_refused(vector):
    assert outcomes(with_witness(document_of("conserved_charge"), LOCAL, conserved=vector))[LOCAL] == "fails"


def test_a_set_that_does_not_rest_or_misses_x_star_is_refused():
    document = document_of("undamped_mode")
    found = witness(document, LOCAL)["set"]
    for changed in (
        {},
        {k: v for k, v in found.items() if k != "0"},
        {**found, "1": next(iter(found.values())), "3": next(iter(found.values()))},
        {k: v + 1 for k, v in found.items()},
    ):
        assert outcomes(with_witness(document, LOCAL, set=changed))[LOCAL] == "fails"


def test_a_division_by_what_vanishes_at_x_star_shows_nothing():
    """Mass 2 swings unseen where q1 = 1/2; the equation ``(q1 - 1/2) p2 = 0`` over ``q1 - 1/2`` would stop it."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)
    system = Mechanical(q, p, M=ca.SX.eye(2), V=ca.sumsqr(q) / 2, D=[1, (q[0] - 0.5) ** 2], G=[1, 0])
    design = Design(system, {"q_0": "0.5", "q_1": 0}, DynamicExtension(2, 3, 5, 1), sample_period="1e-3")
    document = written_for(design)
    assert status(document, LOCAL) == "REFUTED"
    n = len(document["terms"])
    more = [
        "state 0",
        "constant 1/2",
        f"sub {n} {n + 1}",
        "constant 1",
        f"div {n + 3} {n + 2}",
        "constant 0",
        "state 4",
    ]
    document["terms"] += [f"  {n + k} {term}" for k, term in enumerate(more)]
    zero, ubar = n + 5, n + 6
    steps = [[None, {"1": n + 4}], [3, 3, zero], [4, 1, zero], [0, 2, zero], [6, 0, ubar]]
    for entry in document["claims"]:
        if entry["claim"] == LOCAL:
            entry.update(status="PROVED", witness={"steps": steps})
    assert outcomes(signed(document))[LOCAL] == "fails"


def _states(document):
    return len(next(line for line in document["model"] if line.startswith("states")).split()) - 1


@pytest.mark.parametrize("name", ["compensated_pendulum", "buck_converter", "hardening_spring", "pera", "rlc"])
def test_no_step_of_a_chain_can_be_left_out_or_be_another(name):
    document = document_of(name)
    steps = witness(document, GLOBAL)["steps"]
    for k, step in enumerate(steps):
        left_out = outcomes(with_witness(document, GLOBAL, steps=steps[:k] + steps[k + 1 :]))[GLOBAL]
        assert left_out == "fails" or step[1] >= _states(document)  # an input that nothing depends on
        if len(step) > 1:
            for at, value in ((1, step[1] + 1), (2, step[2] + 1), (3, "exp")):
                other = [*step[:at], value, *step[at + 1 :]]
                found = outcomes(with_witness(document, GLOBAL, steps=[*steps[:k], other, *steps[k + 1 :]]))
                assert found[GLOBAL] == "fails", (step, other)


@pytest.mark.parametrize("name", ["compensated_pendulum", "buck_converter", "hardening_spring", "pera", "rlc"])
def test_growth_needs_every_coordinate_in_its_place(name):
    document = document_of(name)
    spans = witness(document, GLOBAL)["spans"]
    for k, span in enumerate(spans):
        others = [{"states": [span["states"][0] + 1]}, {"rows": []}, {"rows": [{"7": "1"}]}, {"rows": [{"-1": "1"}]}]
        others += [{"rows": [{i: f"-{c}" for i, c in row.items()} for row in span["rows"]]}, {"squares": None}]
        for changed in (spans[:k] + spans[k + 1 :], *([*spans[:k], span | o, *spans[k + 1 :]] for o in others)):
            assert outcomes(with_witness(document, GLOBAL, spans=changed))[GLOBAL] != "checked"


def test_amplitudes_below_the_load_do_not_make_the_storage_grow():
    """V = 1.5 q is cancelled by kappa; with twice that load, or as `linear` states it, only ln cosh is left."""
    document = document_of("constant_load")
    linear = witness(document, GLOBAL)["linear"]
    assert linear != ["0"]
    assert outcomes(with_witness(document, GLOBAL, linear=["0"]))[GLOBAL] == "fails"


@pytest.mark.parametrize("name", ["hardening_spring", "buck_converter", "pera", "rlc", "damped_modes", "chain"])
def test_a_global_claim_needs_the_whole_space(name):
    document = document_of(name)
    states = next(line for line in document["model"] if line.startswith("states")).split()[1:]
    restricted = document | {"model": [*document["model"], f"domain {states[0]} -1000 1000"]}
    assert outcomes(signed(restricted))[GLOBAL] == "fails"
    changed = copy.deepcopy(document)
    for entry in changed["claims"]:
        entry["domain"] = "all x where the model is defined" if entry["claim"] == "assumption-1" else entry["domain"]
    assert outcomes(signed(changed))[GLOBAL] == "fails"


def test_the_damping_that_sampling_consumes_must_be_there():
    document = document_of("two_links")
    Lambda = witness(document, SAMPLED)["Lambda"]
    more = [[f"{v}0" if i == j else v for j, v in enumerate(row)] for i, row in enumerate(Lambda)]
    assert outcomes(with_witness(document, SAMPLED, Lambda=more))[SAMPLED] == "fails"
    slow = document | {"model": [line.replace("sample period 1/1000", "sample period 3") for line in document["model"]]}
    assert outcomes(signed(slow))[SAMPLED] == "fails"


def test_rates_that_are_no_combination_of_what_vanishes_are_refused():
    """With damping at every state the rates are combinations of the damped quantities."""
    x, y, u = (ca.SX.sym(name) for name in ("x0", "x1", "u0"))
    S = 3 * x**2 / 2 - ca.cos(x) + y**2 / 2 + y**4 / 4
    f = ca.mtimes(ca.SX([[-0.75, -1.25], [1.25, -0.5]]), ca.gradient(S, ca.vertcat(x, y)))
    law = DynamicExtension(2, 3, 4, 1)
    design = Design(AffineSystem([x, y], [u], f, [1, 0], S), {"x0": "0.05"}, law, sample_period="1e-3", name="damped")
    document = written_for(design)
    assert status(document, GLOBAL) == "PROVED"
    assert outcomes(document)[GLOBAL] == "checked"
    rates = witness(document, GLOBAL)["rates"]
    for i, row in rates.items():
        for j in row:
            for weight in ("0", "1"):
                changed = with_witness(document, GLOBAL, rates=rates | {i: row | {j: weight}})
                assert outcomes(changed)[GLOBAL] == "fails"
    assert outcomes(with_witness(document, GLOBAL, rates={}))[GLOBAL] == "fails"


def test_a_fourth_power_outgrows_what_is_negative_beside_it():
    """``q0^4 / 4 - q0^2 / 2 + 4 (q0 - q1)^2 - 4 q1``: no sum of squares of its terms, but of what q0^4 has to spare."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p", 2)

    def certified(quartic):
        V = quartic * q[0] ** 4 - q[0] ** 2 / 2 + 4 * (q[0] - q[1]) ** 2 - 4 * q[1]
        system = Mechanical(q, p, M=[3, 3], V=V, D=[0, 1], G=[1, 0])
        law = DynamicExtension(10, "4.5", 50, "0.1")
        return Design(system, {"q_0": "0.41"}, law, sample_period="1e-2", near={"q_1": 0}, name="trial")

    document = written_for(certified(0.25))
    assert status(document, GLOBAL) == "PROVED"
    assert outcomes(document)[GLOBAL] == "checked"
    for quartic in (0, -0.25):
        assert outcomes(forged(document, certified(quartic)))[GLOBAL] == "fails"
