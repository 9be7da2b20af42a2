"""Growth, one rest, and rest by cases: what a certificate holds of them cannot be another."""

import copy

import casadi as ca
import pytest
from certificates import outcomes, signed
from documents import GLOBAL, LOCAL, document_of, status, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical

pytestmark = pytest.mark.system


def _with_alone(document, **changes):
    """The document with parts of what shows x* to be the only rest replaced."""
    return with_witness(document, GLOBAL, alone=witness(document, GLOBAL)["alone"] | changes)


def _outcome(document, claim=GLOBAL):
    return outcomes(document)[claim]


@pytest.mark.parametrize("name", ["balanced_link", "stiff_pendulum", "double_well"])
def test_a_box_of_rests_is_bounded_and_searched(name):
    document = document_of(name)
    box = witness(document, GLOBAL)["alone"]["box"]
    last = len(box["ends"]) - 1
    for k, (i, state, end) in enumerate(box["ends"]):
        tighter = [*box["ends"][:k], [i, state, "1/1000"], *box["ends"][k + 1 :]]
        negative = [*box["ends"][:k], [i, state, f"-{end}"], *box["ends"][k + 1 :]]
        strange = [*box["ends"][:k], [-1, state, end], *box["ends"][k + 1 :]]
        beside = [*box["ends"][:k], [i, -1, end], *box["ends"][k + 1 :]]
        for ends in (tighter, negative, strange, beside):
            for tree in (box["tree"], "."):  # far from x* there is no rest: the box must hold all of them
                changed = box | {"ends": ends, "tree": tree}
                assert _outcome(_with_alone(document, box=changed)) == "fails", (k, last, tree)
    assert _outcome(_with_alone(document, box=box | {"ends": []})) == "fails"
    tree = box["tree"]
    for other in ("", ".", tree[:-1], tree + ".", tree.replace(";", "."), "b" + tree[1:], "z" + tree[1:], "1"):
        assert other == tree or _outcome(_with_alone(document, box=box | {"tree": other})) == "fails", other
    for zero in ([*box["zero"], 0], [-1], [7]):
        assert _outcome(_with_alone(document, box=box | {"zero": zero})) == "fails", zero


def test_another_rest_in_the_box_is_not_overlooked():
    """The tree of the stiff law under a softer one, and trees that are looked for where there are other rests."""
    document, other = document_of("stiff_pendulum"), document_of("heavy_pendulum")
    box = witness(document, GLOBAL)["alone"]["box"]
    forged = copy.deepcopy(document) | {name: other[name] for name in ("model", "formulas", "readings")}
    for depth in range(7):
        tree = ";"
        for _ in range(depth):
            tree = f"a{tree}{tree}"
        for leaves in (tree, tree.replace(";", ".")):
            alone = witness(document, GLOBAL)["alone"] | {"box": box | {"tree": leaves}}
            assert _outcome(with_witness(forged, GLOBAL, alone=alone)) != "checked"


@pytest.mark.parametrize(
    "name", ["hardening_spring", "cubic_load", "plain_diode", "one_sided_spring", "buck_converter"]
)
def test_a_monotone_relation_is_shown_and_fixes_every_state(name):
    document = document_of(name)
    alone = witness(document, GLOBAL)["alone"]
    changes = [{"squares": alone["squares"][:-1]}, {"squares": [*alone["squares"], alone["squares"][-1]]}]
    changes += [{"multipliers": {"99": {"0": "1"}}}] + ([{"multipliers": {}}] if alone["multipliers"] else [])
    changes += [{"multipliers": {j: {k: f"-{c}" for k, c in row.items()}}} for j, row in alone["multipliers"].items()]
    changes += [{"steps": alone["steps"][:k] + alone["steps"][k + 1 :]} for k in range(len(alone["steps"]))]
    for k, step in enumerate(alone["fixed"]):
        others = [{"rows": [{i: f"-{c}" for i, c in row.items()} for row in step["rows"]]}, {"squares": []}]
        others += [{"states": []}, {"rows": [{"-1": "1"}]}, {"rows": [{"99": "1"}]}, {"squares": step["squares"] * 2}]
        steps = [alone["fixed"][:k] + alone["fixed"][k + 1 :]]
        steps += [[*alone["fixed"][:k], step | other, *alone["fixed"][k + 1 :]] for other in others]
        changes += [{"fixed": fixed} for fixed in steps]
    for change in changes:
        assert _outcome(_with_alone(document, **change)) == "fails", change
    assert _outcome(_with_alone(document, squares=None)) == "fails"


@pytest.mark.parametrize("name", ["cubic_load", "plain_diode", "double_well", "balanced_link", "filter_with_load"])
def test_what_the_storage_bounds_is_what_it_holds(name):
    document = document_of(name)
    found = witness(document, GLOBAL)
    places = range(len(document["terms"]))
    zero = next(k for k in places if document["terms"][k].endswith(("constant 1", "constant -1", "constant 0")))
    changes = [{"parts": []}, {"parts": found["parts"][1:]}, {"parts": [[t, s] for s, t in found["parts"]]}]
    changes += [{"parts": [[s, zero] for s, _ in found["parts"]]}, {"linear": ["1000"] * len(found["linear"])}]
    changes += [{"spans": found["spans"][:-1]}, {"rows": None}]
    for span in found["spans"]:
        wider = [s if s is not span else span | {"least": zero, "squares": []} for s in found["spans"]]
        changes += [{"spans": wider}] if span["squares"] else []
    for change in changes:
        assert _outcome(with_witness(document, GLOBAL, **change)) == "fails", change


def test_a_convex_storage_is_convex_in_all_that_it_depends_on():
    document = document_of("one_sided_spring")
    convex = witness(document, GLOBAL)["convex"]
    for change in ({"states": []}, {"states": [1]}, {"squares": []}, {"squares": convex["squares"] * 2}):
        assert _outcome(with_witness(document, GLOBAL, convex=convex | change)) == "fails", change
    no_part = {"parts": [], "convex": convex | {"states": [0, 1]}, "spans": []}
    assert _outcome(with_witness(document, GLOBAL, **no_part)) == "fails"


def test_a_state_that_gamma_reads_is_no_momentum_of_a_convex_storage():
    """x1 stands in a square of its own, but rests at 0.9: the convex part must hold it."""
    x0, x1, u = (ca.SX.sym(name) for name in ("x0", "x1", "u"))
    plant = AffineSystem([x0, x1], [u], [2 * x1, 1 - ca.exp(x0)], [2, 0], ca.exp(x0) - x0 + x1**2)
    document = written_for(Design(plant, {"x1": "0.9"}, DynamicExtension(9, 8, 7, 2), sample_period="1e-2", name="t"))
    assert status(document, GLOBAL) == "PROVED"
    assert _outcome(document) == "checked"


def test_every_factor_of_a_product_is_a_case():
    document = document_of("seen_mode")
    found = witness(document, LOCAL)
    source, *cases = found["cases"]
    assert len(cases) > 1
    changes = [[source, *cases[:-1]], [source, *cases[1:]], [source + 1, *cases], [source]]
    changes += [
        [source, *[[place, cases[0][1]] for place, _ in cases]],
        [source, *[[cases[0][0], case] for _, case in cases]],
    ]
    for other in changes:
        assert _outcome(with_witness(document, LOCAL, cases=other), LOCAL) == "fails", other
    for k, (place, case) in enumerate(cases):
        idle = [*cases[:k], [place, case | {"steps": []}], *cases[k + 1 :]]
        assert not case["steps"] or _outcome(with_witness(document, LOCAL, cases=[source, *idle]), LOCAL) == "fails"


@pytest.mark.parametrize(("name", "claim"), [("weakly_damped", "theta"), ("partly_negative_damping", "assumption-3")])
def test_a_state_that_loses_enough_refutes_nothing(name, claim):
    document = document_of(name)
    x = witness(document, claim)["x"]
    for other in (["0"] * len(x), x[:-1], [*x, "0"], []):
        assert _outcome(with_witness(document, claim, x=other), claim) == "fails", other


def test_a_force_is_bounded_on_the_domain_of_the_model_only():
    document = document_of("spring_on_a_domain")
    wider = [line.replace("domain q -1 1", "domain q -2 1") for line in document["model"]]
    assert _outcome(document, "saturation") == "checked"
    assert _outcome(signed(document | {"model": wider}), "saturation") == "fails"
    none = [line for line in document["model"] if not line.startswith("domain")]
    assert _outcome(signed(document | {"model": none}), "saturation") != "checked"


def test_places_and_states_are_counted_from_the_first():
    """Python counts from the end where an index is negative: what stands there is another thing than what is meant."""
    from pbcgen.symbolic.plain.formulas import Formulas
    from pbcgen.symbolic.plain.outcomes import Malformed

    for line in ("  0 state -1", "  0 parameter -1"):
        with pytest.raises(Malformed):
            Formulas.parse([line])
    document = document_of("damping_on_a_box")
    squares = copy.deepcopy(witness(document, "assumption-1")["squares"])
    changed = 0
    for _, factors, _ in squares:
        for factor in factors:
            if factor[0] in ("above", "below"):
                factor[1], changed = -1, changed + 1
    outcome = _outcome(with_witness(document, "assumption-1", squares=squares), "assumption-1")
    assert outcome == "fails" or not changed


def test_leaves_hold_in_whatever_order_the_checker_multiplies():
    """Three masses: sines of 6 v0 + v0^3 + 2 v6 are products of many factors, which are bounded one after the other."""
    q, p = ([ca.SX.sym(f"{letter}{k}") for k in range(3)] for letter in "qp")
    V = q[0] ** 2 + q[1] ** 2 / 4 + q[2] ** 2 + (q[0] - q[1]) ** 2 / 2 + (q[1] - q[2]) ** 2 / 4
    V = V + q[0] ** 4 / 8 - ca.cos(2 * q[1])
    system = Mechanical(q, p, M=[0.5, 0.5, 2], V=V, D=[0, 0.5 + p[1] ** 2, 0], G=[1, 0, 0])
    law = DynamicExtension(alpha="5.38", beta="2.609", K_c="3.084", R_c="13.292")
    document = written_for(Design(system, {"q0": -1}, law, sample_period="1e-3", name="masses"))
    assert status(document, GLOBAL) == "PROVED"
    assert outcomes(document)[GLOBAL] == "checked"
