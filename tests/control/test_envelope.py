"""The envelope of the ln cosh terms: bounds hold, and are tight, for filters with and without coupling."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from flint import arb

from pbcgen.control.envelope import Envelope
from pbcgen.symbolic.real import ball, lower, precision, rational

ALPHA, BETA = (Fraction(3), Fraction(1, 2)), (Fraction(2), Fraction(5))
FILTERS = {
    "none": None,
    "diagonal": ((Fraction(4), Fraction(0)), (Fraction(0), Fraction(1, 3))),
    "coupled": ((Fraction(4), Fraction(-1)), (Fraction(-1), Fraction(2))),
    "strongly coupled": ((Fraction(1), Fraction(9, 10)), (Fraction(9, 10), Fraction(1))),
}


def brute_force(envelope: Envelope, K_c: object, s: np.ndarray) -> float:
    """The least of Phi(s + x_c) + x_c^T K_c x_c / 2 by a minimiser that knows nothing of envelopes."""
    from scipy.optimize import minimize

    alpha, beta = np.array(ALPHA, dtype=float), np.array(BETA, dtype=float)
    K = np.array(K_c, dtype=float)

    def energy(x: np.ndarray) -> float:
        return float(np.sum(alpha / beta * np.log(np.cosh(beta * (s + x)))) + x @ K @ x / 2)

    return float(minimize(energy, np.zeros(2), tol=1e-13).fun)


@pytest.mark.parametrize("name", FILTERS)
def test_points_are_evaluated_closely_from_below(name: str) -> None:
    envelope = Envelope(ALPHA, BETA, FILTERS[name])
    generator = np.random.default_rng(1)
    with precision(64):
        for s in generator.normal(scale=1.5, size=(20, 2)):
            least = envelope.least([ball(rational(Fraction(float(v)))) for v in s])
            assert lower(least) <= envelope.value(s) + 1e-12
            assert float(lower(least)) >= envelope.value(s) - 1e-9 * (1 + envelope.value(s))


@pytest.mark.parametrize("name", ["diagonal", "coupled", "strongly coupled"])
def test_the_value_is_the_least_over_the_filter(name: str) -> None:
    envelope = Envelope(ALPHA, BETA, FILTERS[name])
    for s in np.random.default_rng(2).normal(scale=1.0, size=(10, 2)):
        assert envelope.value(s) == pytest.approx(brute_force(envelope, FILTERS[name], s), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("name", FILTERS)
def test_boxes_are_bounded_from_below_and_their_forces_and_slopes_enclosed(name: str) -> None:
    envelope = Envelope(ALPHA, BETA, FILTERS[name])
    generator = np.random.default_rng(3)
    with precision(64):
        for centre in generator.normal(scale=1.5, size=(12, 2)):
            radius = generator.uniform(0, 0.5, size=2)
            box = [arb(float(c), float(r)) for c, r in zip(centre, radius, strict=True)]
            least, forces, slopes = envelope.least(box), envelope.forces(box), envelope.stiffness(box)
            for _ in range(10):
                s = centre + radius * generator.uniform(-1, 1, size=2)
                assert float(lower(least)) <= envelope.value(s) + 1e-12
                gradient = [(envelope.value(s + 1e-5 * e) - envelope.value(s - 1e-5 * e)) / 2e-5 for e in np.eye(2)]
                for f, g in zip(forces, gradient, strict=True):
                    assert (f + arb(0, 1e-6)).contains(arb(float(g)))
                inside = envelope.forces([arb(float(v)) for v in s + np.array([1e-6, 0])])
                here = envelope.forces([arb(float(v)) for v in s])
                for i in range(2):
                    rise = (float(inside[i].mid()) - float(here[i].mid())) / 1e-6
                    assert not slopes[i][0].is_finite() or (slopes[i][0] + arb(0, 1e-3)).contains(arb(rise))
