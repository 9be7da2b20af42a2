"""Best approximations by Lawson's iteration: least squares whose weights grow where the error is largest.

The linear systems are solved in the caller's ball precision, of which the midpoints are kept, and everything else is
exact or a single IEEE operation: with 160 bits or more the coefficients, rounded, are the same on every machine. They
carry no bound; whoever needs one certifies what was found.
"""

from __future__ import annotations

from math import cos, inf, pi, sqrt
from typing import TYPE_CHECKING, Final

from flint import arb, arb_mat

if TYPE_CHECKING:
    from collections.abc import Sequence

#: The weights move by the error itself first, and by its root in the end, where the iteration would oscillate.
_FAST: Final = 20
_SLOW: Final = 12


def chebyshev(low: float, high: float, count: int) -> list[arb]:
    """Chebyshev's points of an interval, dense at both ends, to 12 digits so that every machine has the same."""
    points = (round(cos(pi * (k + 0.5) / count), 12) for k in range(count))
    return [(arb(low) + arb(high)) / 2 - (arb(high) - arb(low)) / 2 * arb(point) for point in points]


def rational(
    x: Sequence[arb],
    values: Sequence[arb],
    weights: Sequence[arb],
    degrees: tuple[int, int],
    constant: arb | None = None,
    highest: arb | None = None,
) -> tuple[float, list[arb], list[arb]]:
    """P and Q with ``weights |P/Q - values|`` about as small as it gets on the points x.

    Args:
        x: the points.
        values: what is to be fitted there.
        weights: of the errors there, positive.
        degrees: of P and of Q; the constant of Q is 1.
        constant: that of P, where it is given.
        highest: the coefficient of Q's highest power, where it is given.

    Returns:
        The largest weighted error, and the coefficients of P and Q from the constant up.
    """
    sought = degrees[0] + (constant is None)  # coefficients of P
    rows = _equations(x, values, degrees, constant, highest)
    lawson, scale = [1.0] * len(x), [arb(1)] * len(x)
    best: tuple[float, list[arb], list[arb]] = (inf, [], [])
    for iteration in range(_FAST + _SLOW):
        factors = [arb(sqrt(v)) * w / q for v, w, q in zip(lawson, weights, scale, strict=True)]
        try:
            c = _least_squares(rows, factors)
        except ZeroDivisionError:
            break
        P = [*([] if constant is None else [constant]), *c[:sought]]
        Q = [arb(1), *c[sought:], *([] if highest is None else [highest])]
        scale = [horner(Q, v) for v in x]
        errors = [abs(float((horner(P, v) / q - g) * w)) for v, q, g, w in zip(x, scale, values, weights, strict=True)]
        largest = max(errors)
        if not largest < inf:
            break
        if largest < best[0] and all(q > 0 for q in scale):  # there may be a pole among the points on the way
            best = (largest, P, Q)
        lawson = _moved(lawson, [e / largest + 1e-9 for e in errors], iteration < _FAST)
    return best


def _equations(
    x: Sequence[arb], values: Sequence[arb], degrees: tuple[int, int], constant: arb | None, highest: arb | None
) -> list[list[arb]]:
    """``P(x) - g Q(x) = 0`` at each point: the factors of the coefficients that are sought, then the right side."""
    n, m = degrees
    first, last = (0 if constant is None else 1), (m if highest is None else m - 1)
    known_P, known_Q = constant or arb(0), highest or arb(0)
    return [
        [
            *(v**i for i in range(first, n + 1)),
            *(-(v**i) * g for i in range(1, last + 1)),
            g * (1 + known_Q * v**m) - known_P,
        ]
        for v, g in zip(x, values, strict=True)
    ]


def _moved(lawson: Sequence[float], errors: Sequence[float], fast: bool) -> list[float]:
    """Lawson's weights, multiplied by the errors or by their roots; their mean is one."""
    grown = [v * (e if fast else sqrt(e)) for v, e in zip(lawson, errors, strict=True)]
    total = sum(grown)
    return [v * len(grown) / total for v in grown]


def horner(coefficients: Sequence[arb], x: arb) -> arb:
    """The polynomial, coefficients from the constant up."""
    result = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        result = result * x + coefficient
    return result


def _least_squares(rows: Sequence[Sequence[arb]], factors: Sequence[arb]) -> list[arb]:
    """The solution of rows[:-1] c = rows[-1], each row times its factor. Raises ZeroDivisionError if there is none."""
    A = arb_mat([[value * f for value in row[:-1]] for row, f in zip(rows, factors, strict=True)])
    b = arb_mat([[row[-1] * f] for row, f in zip(rows, factors, strict=True)])
    solution = (A.transpose() * A).solve(A.transpose() * b)
    return [arb(solution[i, 0].mid()) for i in range(solution.nrows())]
