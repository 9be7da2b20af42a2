"""Periodic motions are proved by tubes where they attract, and nowhere else."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from numpy.polynomial import chebyshev

from pbcgen.errors import UnsupportedOperation
from pbcgen.proof.collocation import Rule, arc, arcs
from pbcgen.proof.periodic import period, shoot, tube
from pbcgen.proof.tube import Piece, VectorField, closes, motion, passage, turns
from pbcgen.symbolic.doubles import Doubles
from pbcgen.symbolic.tape import Tape

pytestmark = pytest.mark.system


def loop(states, rates):
    """(F, dF/dx) in doubles, and as tapes."""
    z, F = ca.vertcat(*states), ca.vertcat(*rates)
    doubles = Doubles([z], [F, ca.jacobian(F, z)])

    def field(points):
        value, slope = doubles.many(points)
        return value[:, :, 0], slope

    return field, VectorField(Tape.of([z], [F]), Tape.of([z], [ca.jacobian(F, z)]), len(states))


def van_der_pol(mu=1.0):
    x, v = ca.SX.sym("x"), ca.SX.sym("v")
    return loop([x, v], [v, mu * (1 - x**2) * v - x])


def circle(attraction=1.0):
    """The unit circle with period 2 pi, of multiplier exp(-4 pi attraction)."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    r = attraction * (1 - x**2 - y**2)
    return loop([x, y], [r * x - y, r * y + x])


def relay():
    """A mass on a spring, which a steep relay drives on and friction holds back."""
    x, v = ca.SX.sym("x"), ca.SX.sym("v")
    return loop([x, v], [v, -x - v + ca.tanh(200 * v)])


def stiff():
    """The circle with a fast filter behind it, that feeds back a little."""
    x, y, z = (ca.SX.sym(name) for name in "xyz")
    r = 1 - x**2 - y**2
    return loop([x, y, z], [r * x - y + 0.1 * (z - x), r * y + x, -(10**4) * (z - x)])


def proved(system, start, lap, turn=1):
    field, exact = system
    cycle = shoot(field, np.array(start), lap, turn)
    return None if cycle is None else tube(field, exact, cycle)


def test_the_unit_circle_has_period_two_pi():
    found = proved(circle(), [1.1, 0.2], 6.0)
    shortest, longest = period(found)
    assert shortest < 2 * np.pi < longest < shortest + 1e-4
    for piece in found.pieces:
        assert np.allclose(np.hypot(*(piece.centre[0] - piece.centre[2] + piece.centre[4])), 1, atol=1e-2)


@pytest.mark.parametrize("turn", [1, -1])
def test_van_der_pol_has_a_cycle(turn):
    found = proved(van_der_pol(), [2.0, 0.1], 6.6 if turn > 0 else 3.3, turn)
    laps = 2 if turn < 0 else 1
    shortest, longest = (laps * v for v in period(found))
    assert shortest < 6.663286859323130 < longest < shortest + 1e-4


def test_cycles_that_hardly_attract_are_proved():
    assert proved(circle(0.002), [1.0, 0.1], 6.3) is not None


def test_steep_loops_have_cycles():
    found = proved(relay(), [1.2, 0.0], 6.3)
    assert found is not None
    assert max(len(found.pieces), 20) == len(found.pieces)


def test_stiff_loops_have_cycles():
    assert proved(stiff(), [1.0, 0.0, 1.0], 6.3) is not None


def oscillator(pull):
    """``x'' = pull(x, x')``."""
    x, v = ca.SX.sym("x"), ca.SX.sym("v")
    return loop([x, v], [v, pull(x, v)])


REFUSED = {
    "a centre": (oscillator(lambda x, v: -x), [1.0, 0.0], 6.28),
    "a pendulum": (oscillator(lambda x, v: -ca.sin(x)), [1.0, 0.0], 6.7),
    "a slow decay": (oscillator(lambda x, v: -x - v / 500), [1.0, 0.0], 6.28),
    "a cycle that repels": (circle(-0.1), [1.0, 0.0], 6.28),
    "a rest": (van_der_pol(), [0.0, 0.0], 6.28),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_cycle_that_attracts_is_refused(name):
    system, start, lap = REFUSED[name]
    assert proved(system, start, lap) is None


@pytest.mark.parametrize("other", [van_der_pol(1.0001), circle()])
def test_a_cycle_of_another_field_is_refused(other):
    field, _ = van_der_pol()
    cycle = shoot(field, np.array([2.0, 0.1]), 6.6, 1)
    assert tube(field, other[1], cycle) is None


def test_fields_that_are_not_analytic_are_refused():
    field, exact = van_der_pol()
    found = tube(field, exact, shoot(field, np.array([2.0, 0.1]), 6.6, 1))
    _, bent = oscillator(lambda x, v: (1 - ca.fabs(x) * x) * v - x)
    with pytest.raises(UnsupportedOperation):
        motion(bent, found.pieces[0])
    _, cut = oscillator(lambda x, v: ca.log(x + 2) * v - x)
    assert None in [motion(cut, piece) for piece in found.pieces]


# --- the bounds ------------------------------------------------------------------------------------------------------


def at(piece, series, s, derivative=False):
    """A sum of Chebyshev's polynomials, or its derivative by time."""
    if derivative:
        return chebyshev.chebval(s, chebyshev.chebder(series)) * 2 / piece.duration
    return chebyshev.chebval(s, series)


@pytest.mark.parametrize("system", [van_der_pol(), stiff(), relay()])
def test_the_motion_in_pieces_is_within_its_bounds(system):
    """theta' and y' at random states of the tube, from the equation that they solve."""
    field, exact = system
    start = [2.0, 0.1] if system is not None and exact.n == 2 else [1.0, 0.0, 1.0]
    cycle = shoot(field, np.array(start), 6.3, 1)
    found, generator = tube(field, exact, cycle), np.random.default_rng(0)
    size = 2e4  # a wider tube, so that rounding in doubles does not matter
    for piece in found.pieces:
        wide = Piece(piece.duration, piece.centre, piece.frame * size, piece.rates)
        bounds = motion(exact, wide)
        if bounds is None:
            continue
        for _ in range(20):
            s, y = generator.uniform(-1, 1), generator.uniform(-1, 1, exact.n - 1)
            W, turning = at(wide, wide.frame, s), at(wide, wide.frame, s, derivative=True)
            rate = field((at(wide, wide.centre, s) + W @ y)[None])[0][0]
            z = np.linalg.solve(np.column_stack([at(wide, wide.centre, s, derivative=True) + turning @ y, W]), rate)
            assert abs(z[0] - 1) <= bounds.slip + 1e-9
            slowing = np.sign(y) * z[1:]
            allowed = bounds.matrix @ np.abs(y) + bounds.push
            assert np.all(slowing <= allowed + 1e-6 * (1 + np.abs(bounds.matrix) @ np.abs(y)))


def test_a_tube_that_does_not_close_is_refused():
    field, exact = van_der_pol()
    cycle = shoot(field, np.array([2.0, 0.1]), 6.6, 1)
    found = tube(field, exact, cycle)

    def still_closes(pieces):
        following = [*pieces[1:], pieces[0]]
        motions = [motion(exact, piece) for piece in pieces]
        if None in motions:
            return False
        late, passages = found.passages[-1].late, []
        for piece, moved, then in zip(pieces, motions, following, strict=True):
            passages.append(passage(piece, moved, then, late, 1))
            if passages[-1] is None:
                return False
            late = passages[-1].late
        return closes(passages, pieces, motions) is not None

    assert still_closes(list(found.pieces))
    assert not still_closes(list(found.pieces[:-1]))
    assert not still_closes([*found.pieces[:3], *found.pieces[4:]])
    for change in (1e-4, -1e-5):
        moved = replace(found.pieces[2], centre=found.pieces[2].centre + change)
        assert not still_closes([*found.pieces[:2], moved, *found.pieces[3:]])
    slower = replace(found.pieces[2], duration=found.pieces[2].duration * 1.001)
    assert not still_closes([*found.pieces[:2], slower, *found.pieces[3:]])


def test_a_tube_that_widens_is_refused():
    """Around a cycle that repels the lap ends wider than it began."""
    field, exact = circle(-0.05)
    cycle = shoot(field, np.array([1.0, 0.0]), 6.28, 1)

    def piece(one):
        return Piece(one.duration, one.series, one.series[:, :, None] * 1e-6, np.array([0.1]))

    found = arcs(field, Rule.of(12), cycle.start, cycle.duration, 1e-11, lambda one: 0.8 / turns(piece(one)))
    pieces = [piece(one) for one in found]
    motions = [motion(exact, one) for one in pieces]
    assert None not in motions
    following = [*pieces[1:], pieces[0]]
    parts = zip(pieces, motions, following, strict=True)
    passages = [passage(one, moved, then, 1e-9, 1) for one, moved, then in parts]
    assert None not in passages
    assert closes(passages, pieces, motions) is None


# --- trajectories in doubles -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [4, 8, 12])
def test_collocation_follows_an_oscillator(degree):
    x, v = ca.SX.sym("x"), ca.SX.sym("v")
    field, _ = loop([x, v], [v, -x])
    one = arc(field, Rule.of(degree), np.array([1.0, 0.0]), 0.1)
    turned = np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    assert np.allclose(one.states[-1], turned[:, 0], atol=1e-13 if degree > 4 else 1e-10)
    assert np.allclose(one.spread[-1], turned, atol=1e-13 if degree > 4 else 1e-10)


def test_collocation_follows_riccati():
    """``x' = x^2`` from 1/2 is ``1 / (2 - t)``, and ``dx / dx0 = x^2 / x0^2``."""
    x = ca.SX.sym("x")
    field, _ = loop([x], [x**2])
    found = list(arcs(field, Rule.of(12), np.array([0.5]), 1.5, 1e-12))
    assert np.isclose(found[-1].states[-1, 0], 2.0, rtol=1e-11)
    assert np.isclose(np.prod([one.spread[-1, 0, 0] for one in found]), 16.0, rtol=1e-9)


def test_trajectories_that_end_are_cut_short():
    x = ca.SX.sym("x")
    field, _ = loop([x], [x**2])
    found = list(arcs(field, Rule.of(12), np.array([0.5]), 3.0, 1e-9))
    assert sum(one.duration for one in found) < 2.0


def test_stiff_decay_does_not_shorten_the_steps():
    x, z = ca.SX.sym("x"), ca.SX.sym("z")
    field, _ = loop([x, z], [-x, -(10**6) * (z - x)])
    found = list(arcs(field, Rule.of(12), np.array([1.0, 1 / (1 - 1e-6)]), 5.0, 1e-9))
    assert len(found) < 20
    assert np.isclose(found[-1].states[-1, 0], np.exp(-5), rtol=1e-10)
