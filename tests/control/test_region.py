"""Claims about the ellipsoid of attraction of the linearisation route."""

from dataclasses import replace

import numpy as np
import pytest

from pbcgen.control.derive import derive
from pbcgen.control.region import certified_region
from pbcgen.models.loader import load
from pbcgen.run.simulate import simulate_continuous


@pytest.fixture(scope="module")
def pendulum():
    found = derive(load("elastic_pendulum"))
    return found, certified_region(found)


def test_the_region_is_certified_and_not_vacuous(pendulum):
    _, region = pendulum
    assert region is not None
    assert min(region.reach) > 1e-3
    assert "link +-" in region.sentence


def test_the_storage_falls_from_the_edge_of_the_region(pendulum):
    found, region = pendulum
    inverse = np.linalg.inv(region.P)
    for k in range(4):
        # the point of the ellipsoid that is farthest along coordinate k; the filter starts at rest: x_c = 0
        edge = inverse[:, k] / np.sqrt(inverse[k, k]) * np.sqrt(region.level)
        start = found.loop.x_star + edge[:4]
        z = np.array([*edge[:4], edge[1]])  # z_c = gamma~ with x_c = 0, gamma = motor angle
        scale = min(1.0, float(np.sqrt(region.level / (z @ region.P @ z))))
        loop = replace(found.loop, initial=found.loop.x_star + scale * (start - found.loop.x_star))
        run = simulate_continuous(loop, np.linspace(0.0, 5.0, 200))
        deviation = run.x - found.loop.x_star
        zeta = np.hstack([deviation, deviation[:, 1:2] + run.xi])
        values = np.einsum("ki,ij,kj->k", zeta, region.P, zeta)
        assert np.all(np.diff(values) <= 1e-9 * values[0])
