"""Stability of whole families of matrices by discs around their modes: what is proved, and what must be refused."""

from __future__ import annotations

import numpy as np
import pytest
from flint import arb, arb_mat

from pbcgen.proof.modal import Varying, blurs, contract


def family(centre, *moves) -> Varying:
    """``centre + sum of s_k moves[k]`` for s_k in [-1, 1]."""
    return Varying(_balls(centre), tuple(_balls(m) for m in moves), tuple(arb(0, 1) for _ in moves))


def _balls(rows) -> arb_mat:
    return arb_mat([[arb(float(v)) for v in row] for row in rows])


@pytest.mark.parametrize(
    ("matrix", "hurwitz", "schur"),
    [
        ([[-1, 5], [0, -2]], True, False),
        ([[-1e-9]], True, True),
        ([[1e-9]], False, True),
        ([[0]], False, True),
        ([[0.5, 100], [0, 0.5]], False, True),  # defective: the eigenvectors are parallel
        ([[-3, 1, 0], [0, -3, 1], [0, 0, -3]], True, False),
        ([[0, 1], [-1, 0]], False, False),  # on the boundary
        ([[0, 1], [-1, -1e-3]], True, False),
        ([[-3e5, 1e6], [1e-3, -0.02]], True, False),  # stiff
        ([[1.0]], False, False),
    ],
)
def test_single_matrices(matrix, hurwitz, schur):
    assert contract([family(matrix)], "hurwitz") is hurwitz
    assert contract([family(matrix)], "schur") is schur


def test_a_family_with_an_unstable_member_is_never_proved():
    """s = 0.99 gives a positive eigenvalue, however stable the centre is."""
    assert not contract([family([[-1, 0], [0, -5]], [[1.02, 0], [0, 0]])], "hurwitz")
    assert not contract([family([[0.5]], [[0.51]])], "schur")
    assert contract([family([[-1, 0], [0, -5]], [[0.98, 0], [0, 0]])], "hurwitz")
    assert contract([family([[0.5]], [[0.49]])], "schur")


def test_entries_that_move_together_stay_related():
    """A stiff filter x' = -a (x - y) with a in [1e4, 1e6]: as independent entries the slow mode could be anything."""
    centre = np.array([[-505e3, 505e3], [-1.0, -1e-2]])
    move = np.array([[-495e3, 495e3], [0, 0]])
    assert contract([family(centre, move * 0.5)], "hurwitz")
    apart = family(centre, np.array([[-495e3, 0], [0, 0]]), np.array([[0, 495e3 * 1.1], [0, 0]]))
    assert not contract([apart], "hurwitz") or _all_stable(apart)


def _all_stable(members: Varying) -> bool:
    centre = np.array([[float(v.mid()) for v in row] for row in members.centre.tolist()])
    moves = [np.array([[float(v.mid()) for v in row] for row in s.tolist()]) for s in members.slopes]
    corners = np.array(np.meshgrid(*[[-1, 1]] * len(moves))).T.reshape(-1, len(moves))
    return all(
        np.linalg.eigvals(centre + sum(c * m for c, m in zip(k, moves, strict=True))).real.max() < 0 for k in corners
    )


@pytest.mark.parametrize("seed", range(40))
def test_random_families_that_are_proved_have_stable_members(seed):
    rng = np.random.default_rng(seed)
    size = int(rng.integers(1, 6))
    centre = rng.normal(size=(size, size)) - np.eye(size) * rng.uniform(0, 3)
    moves = [rng.normal(size=(size, size)) * 10 ** rng.uniform(-3, 0.3) for _ in range(int(rng.integers(0, 3)))]
    if contract([family(centre, *moves)], "hurwitz"):
        for _ in range(200):
            member = centre + sum((rng.uniform(-1, 1) * m for m in moves), np.zeros_like(centre))
            assert np.linalg.eigvals(member).real.max() < 0
    if contract([family(centre / 3, *moves)], "schur"):
        for _ in range(200):
            member = centre / 3 + sum((rng.uniform(-1, 1) * m for m in moves), np.zeros_like(centre))
            assert np.abs(np.linalg.eigvals(member)).max() < 1


def test_what_is_not_finite_is_refused():
    assert not contract([Varying(arb_mat([[arb.nan()]]))], "hurwitz")
    broken = Varying(_balls([[-1]]), (arb_mat([[arb.nan()]]),), (arb(0, 1),))
    assert not contract([broken], "hurwitz")
    assert not contract([Varying(arb_mat(0, 0))], "hurwitz")


def test_the_setting_that_blurs_most_is_named():
    now, first, second = blurs(family([[-1, 0], [0, -5]], [[0.5, 0], [0, 0]], [[0, 0], [0, 0.5]]), "hurwitz")
    assert first < now
    assert second == now  # it moves the mode that has room


def test_a_family_that_shrinks_one_norm_may_be_switched_and_others_may_not():
    turned = [family([[0.5, 0.4], [0, 0.5]]), family([[0.5, -0.4], [0, 0.5]])]
    assert contract(turned, "schur")
    growing = [family([[0.5, 2], [0, 0.5]]), family([[0.5, 0], [2, 0.5]])]
    assert all(contract([m], "schur") for m in growing)
    product = np.array([[0.5, 2], [0, 0.5]]) @ np.array([[0.5, 0], [2, 0.5]])
    assert np.abs(np.linalg.eigvals(product)).max() > 1
    assert not contract(growing, "schur")
