"""Claims about the ellipsoid of attraction of the linearisation route."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from flint import arb, arb_mat

from pbcgen import AffineSystem, Design, DynamicExtension, Mechanical
from pbcgen.control.derive import derive
from pbcgen.control.ellipsoid import _decreases, certified_ellipsoid
from pbcgen.control.saturated_loop import saturated_loop
from pbcgen.models.loader import load
from pbcgen.run.simulate import simulate_continuous
from pbcgen.sampling import common_storage
from pbcgen.symbolic.real import BITS, precision
from tests.control.test_sampled import two_masses

pytestmark = pytest.mark.xdist_group("ellipsoid")  # they share a region


@pytest.fixture(scope="module")
def pendulum():
    found = derive(load("elastic_pendulum"))
    return found, certified_ellipsoid(found)


def test_the_region_is_certified_and_not_vacuous(pendulum):
    _, region = pendulum
    assert region is not None
    assert region.inside is not None
    assert region.inside[0] > 0.3  # rad; the link starts at 0.2
    assert region.start >= 1
    assert "link +- 0." in region.sentence
    assert "rad" in region.sentence
    assert "contains the initial state" in region.sentence


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


def falls(found, region, lift):
    """Whether the storage falls along runs from the edge of the region, the filters at rest."""
    P = lift.T @ region.P @ lift
    inverse = np.linalg.inv(P)
    n = len(found.loop.x_star)
    for k in range(n):
        edge = inverse[:, k] / np.sqrt(inverse[k, k]) * np.sqrt(region.level)
        loop = replace(found.loop, initial=found.loop.x_star + edge)
        run = simulate_continuous(loop, np.linspace(0.0, 4.0, 200))
        z = (run.x - found.loop.x_star) @ lift.T
        z[:, n:] += run.xi
        values = np.einsum("ki,ij,kj->k", z, region.P, z)
        assert values[0] == pytest.approx(region.level, rel=1e-6)
        assert np.all(np.diff(values) <= 1e-9 * values[0])


def test_two_inputs_with_full_gains_and_linear_masses():
    found = derive(two_masses([[7, 2], [2, 9]], [[3, 1], [1, 2]]))
    region = certified_ellipsoid(found)
    # only the saturations bend: the ellipsoid reaches beyond their linear part, z beta > 1
    assert region.reach[4] * 5 > 2
    assert region.start >= 1
    falls(found, region, np.vstack([np.eye(4), np.eye(2, 4)]))


def test_without_the_solver_a_region_is_still_certified(monkeypatch):
    monkeypatch.setattr(common_storage, "solver_available", lambda: False)
    found = derive(two_masses(7, 3))
    region = certified_ellipsoid(found)
    assert min(region.inside) > 1e-3
    falls(found, region, np.vstack([np.eye(4), np.eye(2, 4)]))


def test_an_unstable_loop_has_no_region():
    design = load("elastic_pendulum").with_(law=DynamicExtension(alpha=3, beta="0.1", K_c=12, R_c=1))
    assert certified_ellipsoid(derive(design)) is None


def test_a_region_beyond_what_decreases_is_not_certified(pendulum):
    found, region = pendulum
    loop = saturated_loop(found)
    with precision(BITS):
        factor = np.linalg.cholesky(region.P).T
        F = arb_mat([[arb(float(v)) for v in row] for row in factor])
        scale = float(np.sqrt(region.level))
        assert _decreases(loop, F, F.inv(), 0.9 * scale)
        assert not _decreases(loop, F, F.inv(), 10 * scale)


def test_a_region_stays_inside_the_declared_domain():
    design = two_masses(7, 3)
    narrow = Mechanical(
        q=[(q := ca.SX.sym("q", 2))[0], q[1]],
        p=ca.vertsplit(ca.SX.sym("p", 2)),
        M=[1, 2],
        V=(q[0] ** 2 + (q[0] - q[1]) ** 2) / 2,
        D=[2, 3],
        G=ca.SX.eye(2),
        domain={"q_0": (0.75, 5)},
    )
    wide, bounded = (certified_ellipsoid(derive(d)) for d in (design, design.with_(system=narrow, target=[1, 1])))
    assert wide.reach[0] > 0.25 >= bounded.reach[0] > 0.2


def test_a_gamma_with_a_fraction_that_is_no_decimal_has_a_region():
    """x' = F grad S + g u with F = [[-2, 1], [-1, -1]]: gamma = -(F^-1 g)^T x = (x + y)/3, where 1/3 is no decimal."""
    x, y, u = (ca.SX.sym(name) for name in "xyu")
    S = x**2 / 2 + y**2 / 2 + y**4 / 4
    s = y + y**3
    system = AffineSystem([x, y], [u], [-2 * x + s, -x - s], [0, 1], S)
    law = DynamicExtension(alpha=2, beta=3, K_c=4, R_c=1)
    found = derive(Design(system, {"y": "0.3"}, law, sample_period="1e-3", name="thirds"))
    assert "/3" in str(found.derived["gamma"])
    assert certified_ellipsoid(found) is not None
