"""Claims about actuator limits and amplitudes."""

from fractions import Fraction

from pbcgen import Limits
from pbcgen.control.amplitudes import Room, blocking, largest_amplitudes, rooms
from pbcgen.control.derive import derive
from pbcgen.models.loader import load
from pbcgen.symbolic.real import rational


def room(limit, weights, value):
    return Room(limit, tuple(Fraction(w) for w in weights), Fraction(value))


def test_a_polyhedron_is_used_up_exactly():
    limits = [room("a", (1, 1), "7.901"), room("b", (1, 0), 5)]
    s = largest_amplitudes(limits, (Fraction(3), Fraction("3.3")))
    assert all(r.slack(s) >= 0 for r in limits)
    assert min(r.slack(s) for r in limits) <= Fraction("0.01")
    assert all(v > 0 for v in s)


def test_touching_a_short_decimal_limit_is_kept():
    assert largest_amplitudes([room("u <= 5", (1,), 5)], (Fraction(1),)) == (Fraction(5),)


def test_an_input_without_limit_keeps_its_amplitude():
    s = largest_amplitudes([room("a", (1, 0), 2)], (Fraction(1), Fraction(9)))
    assert s == (Fraction(2), Fraction(9))


def test_a_limit_without_room_blocks():
    limits = [room("u1 <= 3", (1, 0), 1), room("u2 >= 0", (0, 1), "-0.5")]
    assert blocking(limits).limit == "u2 >= 0"
    assert largest_amplitudes(limits, (Fraction(1), Fraction(1))) is None


def test_rooms_of_intervals_and_rows():
    design = load("pera").with_(limits=Limits({"u1": (-20, 19)}, A=[[0, 1, -2]], b=[8]))
    centres = [(Fraction(0), Fraction(0)), (Fraction(-1), Fraction(2)), (Fraction(0), Fraction(0))]
    found = rooms(design, [(rational(a), rational(b)) for a, b in centres])
    assert [(r.limit, r.room) for r in found] == [("u1 <= 19", 19), ("u1 >= -20", 20), ("u2 - 2*u3 <= 8", 6)]


def test_infeasible_target_is_named_with_its_limit():
    design = load("rlc").with_(limits=Limits({"u": (0, 3)}))
    claim = {c.claim: c for c in derive(design).claims}["saturation"]
    assert "no alpha can help" in claim.hint
    assert "u <= 3" in claim.hint


def test_slack_of_the_nearest_limit_is_reported():
    claim = {c.claim: c for c in derive(load("pera")).claims}["saturation"]
    assert "0.0314 left to u2 + u3 <= 7.901" in claim.evidence
