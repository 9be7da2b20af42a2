"""The coefficients of the fast tanh and cosh: python -m benchmarks.hyperbolic_fit

Minimax fits of the relative error by Lawson's iteration: least squares whose weights grow where the error is largest,
solved in 300 bits. The printed errors are before the coefficients are rounded.
"""

from __future__ import annotations

from flint import arb, arb_mat, ctx

ITERATIONS = 60
POINTS = 260


def chebyshev(end: float) -> list[arb]:
    """Points of (0, end], dense at both ends."""
    points = [arb(end) * (1 - (arb.pi() * k / POINTS).cos()) / 2 for k in range(1, POINTS + 1)]
    return [arb(point.mid()) for point in points]


def least_squares(rows: list[list[arb]], weights: list[arb]) -> list[arb]:
    """The solution of rows[:-1] c = rows[-1] with these weights."""
    A = arb_mat([[value * w for value in row[:-1]] for row, w in zip(rows, weights, strict=True)])
    b = arb_mat([[row[-1] * w] for row, w in zip(rows, weights, strict=True)])
    solution = (A.transpose() * A).solve(A.transpose() * b)
    return [arb(solution[i, 0].mid()) for i in range(solution.nrows())]


def tanh_fit(degree: int, end: float) -> tuple[float, list[float], list[float]]:
    """Error, numerator and denominator of x P(x^2)/Q(x^2) on (0, end], P(0) = Q(0) = 1."""
    x = chebyshev(end)
    y = [(v / end) ** 2 for v in x]
    g = [v.tanh() / v for v in x]
    rows = [
        [*(u**i / h for i in range(1, degree + 1)), *(-(u**i) for i in range(1, degree + 1)), 1 - 1 / h]
        for u, h in zip(y, g, strict=True)
    ]
    weights, scale = [arb(1)] * POINTS, [arb(1)] * POINTS
    best, coefficients = float("inf"), []
    for iteration in range(ITERATIONS):
        c = least_squares(rows, [w.sqrt() / q for w, q in zip(weights, scale, strict=True)])
        P = [1 + sum((c[i] * u ** (i + 1) for i in range(degree)), arb(0)) for u in y]
        scale = [1 + sum((c[degree + i] * u ** (i + 1) for i in range(degree)), arb(0)) for u in y]
        errors = [abs(float(p / q / h - 1)) for p, q, h in zip(P, scale, g, strict=True)]
        if max(errors) < best:
            best, coefficients = max(errors), c
        weights = reweighted(weights, errors, 1.0 if iteration < ITERATIONS - 20 else 0.5)
    unscaled = [float(v / arb(end) ** (2 * (i % degree + 1))) for i, v in enumerate(coefficients)]
    return best, unscaled[:degree], unscaled[degree:]


def cosh_fit(count: int, end: float) -> tuple[float, list[float]]:
    """Error and coefficients of (cosh(z) - 1)/z^2 in z^2 on (0, end], the first one 1/2."""
    y = [v * v for v in chebyshev(end)]
    g = [(v.sqrt().cosh() - 1) / v for v in y]
    rows = [[*(u**i / h for i in range(1, count)), 1 - arb(1) / 2 / h] for u, h in zip(y, g, strict=True)]
    weights, best, coefficients = [arb(1)] * POINTS, float("inf"), []
    for _ in range(ITERATIONS):
        c = least_squares(rows, [w.sqrt() for w in weights])
        values = [arb(1) / 2 + sum((c[i] * u ** (i + 1) for i in range(count - 1)), arb(0)) for u in y]
        errors = [abs(float(v / h - 1)) for v, h in zip(values, g, strict=True)]
        if max(errors) < best:
            best, coefficients = max(errors), c
        weights = reweighted(weights, errors, 1.0)
    return best, [0.5, *map(float, coefficients)]


def reweighted(weights: list[arb], errors: list[float], power: float) -> list[arb]:
    largest = max(errors)
    return [arb(float(w) * (e / largest + 1e-9) ** power) for w, e in zip(weights, errors, strict=True)]


def main() -> None:
    ctx.prec = 300
    for name, degree, end in (("float", 4, 9.02), ("double", 9, 19.1)):
        error, numerator, denominator = tanh_fit(degree, end)
        print(f"tanh, {name}: {error:.2g}\n  {numerator}\n  {denominator}")
    error, coefficients = cosh_fit(4, 89.5 / 64)
    print(f"cosh: {error:.2g}\n  {coefficients}")


if __name__ == "__main__":
    main()
