"""Sums of squares and trees of boxes: what is left out, or shows another function, is not believed."""

import copy

import casadi as ca
import pytest
from certificates import outcomes, signed
from documents import document_of, with_witness, witness, written_for

from pbcgen import AffineSystem, Design, DynamicExtension

pytestmark = pytest.mark.system


def test_a_sum_of_squares_from_semidefinite_programming_is_checked():
    pytest.importorskip("clarabel")
    document = document_of("quartic_dissipation")
    assert outcomes(document)["assumption-1"] == "checked"
    squares = witness(document, "assumption-1")["squares"]
    k = next(k for k, (_, factors, _) in enumerate(squares) if not factors)
    for changed in (squares[:k] + squares[k + 1 :], [*squares, squares[k]]):
        assert outcomes(with_witness(document, "assumption-1", squares=changed))["assumption-1"] == "fails"
    other = copy.deepcopy(squares)
    other[k][2] = [place and place + 1 for place in other[k][2]]
    assert outcomes(with_witness(document, "assumption-1", squares=other))["assumption-1"] == "fails"


def test_a_sum_of_squares_over_exponentials_is_checked():
    """The power is a quotient of polynomials in exp(x1), and friction beside the structure leaves it none."""
    pytest.importorskip("clarabel")
    x = ca.SX.sym("x", 2)
    S = ca.cosh(x[1]) + x[0] ** 4 / 4 + ca.sumsqr(x) / 2
    e = ca.gradient(S, x)
    f = [e[1] - e[0] / 2 - 0.3 * x[0], -e[0] - e[1] / 2]
    system = AffineSystem(x, [ca.SX.sym("u")], f, [0, 1], S)
    design = Design(system, {"x_1": 0}, DynamicExtension(1, 1, 1, 1), sample_period="1e-3", name="d")
    document = written_for(design)
    assert outcomes(document)["assumption-1"] == "checked"
    assert outcomes(with_witness(document, "assumption-1", squares=[]))["assumption-1"] == "fails"


def _with_tree(document, change):
    squares = copy.deepcopy(witness(document, "assumption-1")["squares"])
    for _, factors, _ in squares:
        for factor in factors:
            if factor[0] == "box":
                factor[2][0] = change(factor[2][0])
    return with_witness(document, "assumption-1", squares=squares)


@pytest.mark.parametrize(
    "change",
    [
        lambda tree: tree[:-1],
        lambda tree: tree + ".",
        lambda tree: "",
        lambda tree: ".",
        lambda tree: ("b" if tree[0] == "a" else "a") + tree[1:],
        lambda tree: "z" + tree[1:],
        lambda tree: "1" + tree[1:],
    ],
    ids=["a leaf is missing", "a leaf too many", "empty", "one leaf", "another coordinate", "no coordinate", "a digit"],
)
def test_a_tree_that_does_not_cover_the_box_is_refused(change):
    document = document_of("narrow_band")
    trees = [f[2][0] for _, factors, _ in witness(document, "assumption-1")["squares"] for f in factors]
    assert all(len(tree) > 20 for tree in trees)
    assert outcomes(_with_tree(document, change))["assumption-1"] == "fails"


def test_a_box_is_no_proof_for_another_domain():
    document = document_of("narrow_band")
    for domain in ("all x", "all x where the model is defined", "x0 in [-5, 6], x1 in [-5, 5]", "x0 in [-5, 5]"):
        changed = copy.deepcopy(document)
        for entry in changed["claims"]:
            entry["domain"] = domain if entry["claim"] == "assumption-1" else entry["domain"]
        assert outcomes(signed(changed))["assumption-1"] == "fails", domain
    wider = document | {"model": [line.replace("domain x1 -5 5", "domain x1 -5 7") for line in document["model"]]}
    assert outcomes(signed(wider))["assumption-1"] == "fails"


def test_half_a_line_is_no_proof_for_the_other_half():
    x, y = ca.SX.sym("x0"), ca.SX.sym("x1")
    system = AffineSystem(
        [x, y], [ca.SX.sym("u")], [y, -x - (1 + x) * y], [0, 1], (x**2 + y**2) / 2, domain={"x0": (-1, None)}
    )
    document = written_for(Design(system, [0, 0], DynamicExtension(2, 3, 5, 1), sample_period="1e-3"))
    assert next(e for e in document["claims"] if e["claim"] == "assumption-1")["domain"] == "x0 >= -1"
    assert outcomes(document)["assumption-1"] == "checked"
    for domain, bounds in (("x0 <= -1", "unbounded -1"), ("x0 <= 1", "unbounded 1"), ("x0 >= -2", "-2 unbounded")):
        changed = copy.deepcopy(document)
        for entry in changed["claims"]:
            entry["domain"] = domain if entry["claim"] == "assumption-1" else entry["domain"]
        assert outcomes(signed(changed))["assumption-1"] == "fails", domain
        changed["model"] = [
            f"domain x0 {bounds}" if line.startswith("domain x0") else line for line in changed["model"]
        ]
        assert outcomes(signed(changed))["assumption-1"] == "fails", bounds
