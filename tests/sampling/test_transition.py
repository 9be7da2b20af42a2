"""Enclosures of the matrix exponential and of its integral."""

import pytest
from flint import acb, acb_mat, arb

from pbcgen.sampling.transition import Basis
from pbcgen.symbolic.real import precision


def almost_diagonal(slow, coupling):
    """A stable plant in coordinates that leave a coupling, whose bound the basis knows."""
    basis = Basis(acb_mat(0, 0, []))
    basis.values = [acb(-slow), acb(-2 * slow)]
    basis.matrix = acb_mat(2, 2, [-slow, coupling, 0, -2 * slow])
    basis.error = arb(coupling)
    return basis


@pytest.mark.parametrize("t", [arb("0.01"), arb(1), arb(100), arb(0).union(arb(100)), arb(3).union(arb(40))])
def test_what_the_coordinates_leave_is_enclosed_for_periods_of_all_lengths(t):
    """A stable mode forgets the coupling at the end of a long period, but its integral does not."""
    with precision(300):
        basis = almost_diagonal(1, arb(10) ** -30)
        exponential, integral = basis.exponential(t)
        for end in (t.lower(), t.mid(), t.upper()):
            block = acb_mat(4, 4)
            for i in range(2):
                block[i, 2 + i] = end
                for j in range(2):
                    block[i, j] = basis.matrix[i, j] * end
            truth = block.exp()
            for i in range(2):
                for j in range(2):
                    assert exponential[i, j].contains(truth[i, j].mid())
                    assert integral[i, j].contains(truth[i, 2 + j].mid())
