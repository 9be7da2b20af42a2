"""Mechanical systems whose certificate is read in positions and velocities: nothing but M^-1 p passes for v."""

import copy
import json
from dataclasses import replace

import casadi as ca
import pytest
from certificates import outcomes, signed
from designs import DESIGNS, planar_arm

from pbcgen import Design, DynamicExtension, Mechanical
from pbcgen.certify.certificate import certificate
from pbcgen.certify.writing import Writing
from pbcgen.control.derive import derive
from pbcgen.models.identity import canonical_text
from pbcgen.models.inertia import solve
from pbcgen.proof.claim import Status
from pbcgen.reading.velocity import solves
from pbcgen.symbolic.plain.formulas import Formulas
from pbcgen.symbolic.tape import Tape

pytestmark = pytest.mark.system

A = ca.SX.sym("a")

#: What rests on M^-1 p.
RESTS = {"assumption-1", "passive-output"}

BROKEN = {
    "a velocity that is not M^-1 p": {"velocity": 1.001},
    "Coriolis forces that take power": {"coupling": 1.001},
    "no Coriolis forces": {"coupling": 0},
    "a storage that is not the energy": {"energy": 0.999},
    "friction with the wrong sign": {"friction": -1},
}


@pytest.fixture(scope="module")
def document():
    return json.loads(json.dumps(certificate(derive(DESIGNS["three_links"]()))))


def test_it_is_read_in_velocities(document):
    assert len(document["inertia"]) == 3
    assert {*outcomes(document).values()} == {"checked", "open"}


@pytest.mark.parametrize("defect", BROKEN)
def test_a_broken_arm_is_not_believed(document, defect):
    """With the certificate of the good arm, and with its own in which every verdict is forced to PROVED."""
    derivation = derive(planar_arm(3, factors=False, **BROKEN[defect]))
    wrong = {c.claim for c in derivation.claims if c.status is not Status.PROVED}
    assert "assumption-1" in wrong
    claims = tuple(
        replace(c, status=Status.PROVED, domain="all x" if c.claim in RESTS else c.domain) for c in derivation.claims
    )
    own = json.loads(json.dumps(certificate(replace(derivation, claims=claims))))
    text = canonical_text(derivation.design).splitlines()
    good = {entry["claim"]: entry["witness"] for entry in document["claims"]}
    lent = copy.deepcopy(own | {"inertia": own.get("inertia", document["inertia"]), "terms": document["terms"]})
    for entry in lent["claims"]:
        entry["witness"] = good[entry["claim"]]
    for forged in (signed(document | {"model": text}), signed(own), signed(lent)):
        assert {claim for claim in wrong if outcomes(forged).get(claim) == "checked"} == set()


def test_the_inertia_must_be_shown_to_be_definite_for_what_is_said_of_all_states():
    """M(q) > 0 by the squares of the kinetic energy, all of them and with positive weights."""
    document = json.loads(json.dumps(certificate(derive(planar_arm(3)))))
    witness = next(e for e in document["claims"] if e["claim"] == "assumption-1")
    assert witness["domain"] == "all x"
    parts = witness["witness"]["inertia"]
    assert {outcomes(document)[claim] for claim in RESTS} == {"checked"}
    for changed in ([], parts[1:], [*parts, parts[0]], [[t, s] for s, t in parts]):
        witness["witness"]["inertia"] = changed
        assert not {outcomes(signed(document))[claim] for claim in RESTS} & {"checked"}
    del witness["witness"]["inertia"]
    assert {outcomes(signed(document))[claim] for claim in RESTS} == {"recorded"}


@pytest.mark.parametrize(
    "M", [[[4, 3 * ca.cos(A)], [3 * ca.cos(A), 1]], [[4, 2 * ca.cos(A)], [2 * ca.cos(A), 1]], [[1, A], [A, 2 * A**2]]]
)
def test_an_inertia_that_is_singular_somewhere_is_restricted(M):
    x, p, b = (ca.SX.sym(name) for name in "xpb")
    rows = ca.vertcat(*[ca.horzcat(*row) for row in M])
    system = Mechanical([x, A], [p, b], M=rows, V=5 * A**2, D=[1, 0], G=[1, 0])
    law = DynamicExtension(2, 1, 1, 1)
    document = json.loads(
        json.dumps(certificate(derive(Design(system, {"x": 0}, law, sample_period="1e-2", near={"a": 0}))))
    )
    stated = [e for e in document["claims"] if e["claim"] in RESTS]
    assert {(e["status"], e["domain"]) for e in stated} == {("PROVED", "all x where the model is defined")}
    assert {outcomes(document)[claim] for claim in RESTS} == {"checked"}
    for e in stated:
        e["domain"] = "all x"
    assert "checked" not in {outcomes(signed(document))[claim] for claim in RESTS}


def test_other_places_of_the_inertia_are_not_believed(document):
    rows = document["inertia"]
    for i in range(3):
        for j in range(3):
            for place in (None, rows[i][j] + 1, rows[i][j] - 1, rows[(i + 1) % 3][j], 0):
                changed = copy.deepcopy(rows)
                changed[i][j] = place
                if changed != rows and (i == j or place != rows[j][i]):
                    found = outcomes(signed(document | {"inertia": changed}))
                    assert {found[claim] for claim in RESTS} == {"fails"}, (i, j, place)
    for changed in (rows[:2], [row[:2] for row in rows], [*rows, rows[0]]):
        assert "checked" not in {outcomes(signed(document | {"inertia": changed}))[claim] for claim in RESTS}


def _formulas(M, v, q, p):
    """Formulas with M and v = f, as a model's text has them, and their places."""
    writing = Writing()
    entries, velocity = writing.tape(Tape.of([ca.vertcat(q, p)], [M, v]), ["state"], {})
    size = range(M.shape[0])
    places = [[entries.entries.get((i, j)) for j in size] for i in size]
    return Formulas.parse(writing.lines()), places, [velocity.entries[i, 0] for i in size]


def _entries(names):
    """A symmetric matrix of functions of q by the names of its entries; 0 is a zero, equal names are equal entries."""
    q = ca.SX.sym("q", len(names))
    known = {}
    for k, name in enumerate({name: None for row in names for name in row if name != "0"}):
        known[name] = 3 + k + ca.sin(q[k % len(names)] * (k + 2))
    size = range(len(names))
    M = ca.SX(len(names), len(names))
    for i in size:
        for j in size:
            name = names[max(i, j)][min(i, j)]
            if name != "0":
                M[i, j] = known[name]
    return q, M


PATTERNS = {
    "full": (["a", "bc", "def", "ghij"], True),
    "three full": (["a", "bc", "def"], True),
    "equal entries": (["a", "ba", "dba"], False),
    "equal and alone": (["a", "0a", "00c", "00de"], True),
    "a zero that fills": (["a", "bc", "d0f", "ghij"], False),
    "a chain": (["a", "bc", "0de", "00fg"], True),
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_what_solves_for_the_velocities_is_known(pattern):
    names, positive = PATTERNS[pattern]
    q, M = _entries(names)
    p = ca.SX.sym("p", len(names))
    right = solve(M, p)
    formulas, places, velocity = _formulas(M, right, q, p)
    assert solves(formulas, places, velocity) is positive
    for k in range(len(names)):
        for wrong in (1.0001 * right[k], right[k] + q[0], right[k] + p[0] * q[0], solve(M, 2 * p)[k], p[k]):
            other = ca.SX(right)
            other[k] = wrong
            assert solves(*_formulas(M, other, q, p)) is False
    weight = M[0, 0] - 2 * M[len(names) - 1, len(names) - 1]  # not zero as a function, but for some M > 0
    assert solves(*_formulas(M, (right * weight + weight) / weight - 1, q, p)) is False
    transposed = ca.mtimes(M, p)
    assert solves(*_formulas(M, transposed, q, p)) is False
