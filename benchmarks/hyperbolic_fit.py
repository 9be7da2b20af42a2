"""The coefficients of the fast tanh and cosh: python -m benchmarks.hyperbolic_fit

The printed errors are relative and before the coefficients are rounded. Those of tanh have P(0) = Q(0) = 1; what the
code computes with is divided by Q's highest one, which is therefore chosen as a power of two.
"""

from __future__ import annotations

from flint import arb, ctx

from pbcgen.law.minimax import chebyshev, rational

POINTS = 200


def tanh_fit(degree: int, end: float, highest: int) -> tuple[float, list[float], list[float]]:
    """Error, numerator and denominator of x P(x^2)/Q(x^2) on (0, end], Q's highest coefficient 2^highest."""
    x = chebyshev(0, end, POINTS)
    scale = arb(end) ** 2
    weights = [v / v.tanh() for v in x]
    values = [1 / w for w in weights]
    degrees, last = (degree, degree), arb(2) ** highest * scale**degree
    error, P, Q = rational([v * v / scale for v in x], values, weights, degrees, arb(1), last)
    return error, *([float(v / scale**k) for k, v in enumerate(c)] for c in (P, Q))


def cosh_fit(count: int, end: float) -> tuple[float, list[float]]:
    """Error and coefficients of 2 (cosh(z) - 1)/z^2 in z^2 on (0, end], the first one 1."""
    y = [v * v for v in chebyshev(0, end, POINTS)]
    values = [2 * (v.sqrt().cosh() - 1) / v for v in y]
    error, P, _ = rational(y, values, [1 / v for v in values], (count - 1, 0), arb(1))
    return error, [float(v) for v in P]


def main() -> None:
    ctx.prec = 300
    for name, degree, end, highest in (("float", 4, 8.2, -20), ("double", 9, 19.1, -67)):
        error, numerator, denominator = tanh_fit(degree, end, highest)
        print(f"tanh, {name}: {error:.2g}\n  {numerator}\n  {denominator}")
    error, coefficients = cosh_fit(4, 89.5 / 64)
    print(f"cosh: {error:.2g}\n  {coefficients}")


if __name__ == "__main__":
    main()
