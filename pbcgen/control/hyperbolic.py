"""tanh and cosh as the generated code computes them: with the math library, or with a few multiplications.

**tanh.** The rational function is ``x P(x^2) / Q(x^2)`` with P and Q of degree 4 (float) or 9 (double), positive
coefficients and P(0) = Q(0) = 1, and its magnitude is cut at 1. Three properties follow from the form, for any
rounding: it is odd, its magnitude is at most 1, and a tiny x is returned unchanged. Beyond the interval of the fit the
quotient grows, so that the cut alone makes it 1 there; where x^2 or P overflow the quotient is NaN, which the cut, the
quotient of x and its magnitude, turns into 1 as well. NaN and the infinities give NaN, so that what follows can see
them. P and Q are sums of positive terms, so that nothing cancels.

The result is not monotone: between neighbouring floats it drops by at most 5.4e-7.

**cosh**, in float only. ``w = 2 (cosh(x / 64) - 1)`` is a polynomial, and ``w <- w (w + 4)`` doubles the argument, six
times. Nothing cancels. The relative error is at most ``(4 + 2|x|) 2^-23``: like any error of x, it grows with |x|.

``benchmarks/hyperbolic_fit.py`` computes such coefficients (its iteration ends within a few digits of these). Those of
tanh in float were then moved by single units in the last place until the largest error over all floats, rounding
included, was least. ``benchmarks/hyperbolic_bound.c`` tries all floats.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pbcgen.control.law import Precision

Tanh = Literal["fast", "libm"]

#: Coefficients of P and Q from x^2 upwards; those of x^0 are 1.
NUMERATOR: Final[dict[Precision, tuple[float, ...]]] = {
    "float": (0.133826792, 0.0034974569, 2.06358054e-05, 1.33842937e-08),
    "double": (
        *(0.15180501371772467, 0.0059746606001301866, 9.360087809182943e-05, 6.830071053364408e-07),
        *(2.440137598815802e-09, 4.169560021910884e-12, 3.061681829037127e-15, 7.405621534418611e-19),
        2.497202732148774e-23,
    ),
}
DENOMINATOR: Final[dict[Precision, tuple[float, ...]]] = {
    "float": (0.467159986, 0.0258843414, 0.000328851806, 7.79022628e-07),
    "double": (
        *(0.4851383470510574, 0.0343541096171508, 0.0008281117785869925, 8.753304916920588e-06),
        *(4.4627922700710205e-08, 1.1108895801181118e-10, 1.2698036199915238e-13, 5.62681730837384e-17),
        6.214740230105882e-21,
    ),
}

#: How far the rational function is from tanh: units in the last place, absolute. For float tried on every float without
#: contraction (5.76 ulp and 3.43e-7; with it 5.38 ulp and 3.20e-7). For double proved on the whole line by
#: ``benchmarks/tanh_bound.py``; what was seen is FAST_SEEN.
FAST_ULP: Final[dict[Precision, float]] = {"float": 5.8, "double": 53.0}
FAST_ERROR: Final[dict[Precision, float]] = {"float": 3.5e-7, "double": 5.9e-15}
FAST_SEEN: Final = (12.0, 1.3e-15)

#: Units in the last place by which the tanh of glibc and musl is off: every float, and doubles that were tried.
LIBM_ULP: Final[dict[Precision, float]] = {"float": 2.2, "double": 2.3}


#: How often the argument is doubled, and 2 (cosh(z) - 1) = x^2 (C_0 + C_1 x^2 + ...) for z = x / 2^DOUBLINGS.
DOUBLINGS: Final = 6
COSH: Final = tuple(
    coefficient * 0.25 ** (DOUBLINGS * (k + 1))
    for k, coefficient in enumerate((1.0, 0.083334082, 0.0027754192, 5.169666e-05))
)


def default_tanh(precision: Precision) -> Tanh:
    """What a law uses unless told otherwise."""
    return "fast" if precision == "float" else "libm"


def fast_tanh(x: NDArray[Any]) -> NDArray[Any]:
    """The rational function, elementwise, with the operations of the C in their order."""
    working: Precision = "float" if x.dtype == np.float32 else "double"
    return cut_ratio((1.0, *NUMERATOR[working]), DENOMINATOR[working], x, x * x)


def cut_ratio(
    numerator: Sequence[float], denominator: Sequence[float], x: NDArray[Any], y: NDArray[Any]
) -> NDArray[Any]:
    """``x P(y)/Q(y)``, elementwise, its magnitude cut at 1; coefficients from the constant up, that of Q is 1."""
    p, q = _horner(numerator, y), _horner((1.0, *denominator), y)
    quotient = x * p / q
    result: NDArray[Any] = np.where(np.abs(quotient) <= x.dtype.type(1), quotient, x / np.abs(x))
    return result


def fast_cosh(x: NDArray[Any]) -> NDArray[Any]:
    """The cosh of doubled arguments, elementwise, with the operations of the C in their order."""
    real = x.dtype.type
    y = x * x
    w = _horner(COSH, y) * y
    for _ in range(DOUBLINGS - 1):
        w = w * (w + real(4))
    result: NDArray[Any] = real(0.5) * w * (w + real(4)) + real(1)
    return result


def _horner(coefficients: Sequence[float], y: NDArray[Any]) -> NDArray[Any]:
    """The polynomial, coefficients from the constant up."""
    real = y.dtype.type
    result: NDArray[Any] = np.full_like(y, real(coefficients[-1]))
    for coefficient in reversed(coefficients[:-1]):
        result = result * y + real(coefficient)
    return result
