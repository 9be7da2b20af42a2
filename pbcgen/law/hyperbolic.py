"""tanh and cosh as the generated code computes them: with the math library, or with a few multiplications.

**tanh.** The rational function is ``x P(x^2) / Q(x^2)`` with P and Q of degree 4 (float) or 9 (double) and positive
coefficients, and its magnitude is cut at 1. The highest coefficient of Q is 1, which saves an instruction, and P(0) =
Q(0) is a power of two. Three properties follow from the form, for any rounding: it is odd, its magnitude is at most 1,
and a tiny x is returned unchanged. Beyond the interval of the fit the
quotient grows, so that the cut alone makes it 1 there; where x^2 or P overflow the quotient is NaN, which the cut, the
quotient of x and its magnitude, turns into 1 as well. NaN and the infinities give NaN, so that what follows can see
them. P and Q are sums of positive terms, so that nothing cancels.

The result is not monotone: between neighbouring floats it drops by at most 4.8e-7.

**cosh**, in float only. ``w = 2 (cosh(x / 64) - 1)`` is a polynomial, and ``w <- w (w + 4)`` doubles the argument, six
times. Nothing cancels. The relative error is at most ``(4 + 2|x|) 2^-23``: like any error of x, it grows with |x|.

``benchmarks/hyperbolic_fit.py`` computes such coefficients (its iteration ends within a few digits of these). Those of
tanh in float were then moved by single units in the last place until the largest error over all floats, rounding
included, was least. ``benchmarks/hyperbolic_bound.c`` tries all floats.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pbcgen.law.arithmetic import Precision

#: Coefficients of P and Q from the constant up; that of the highest power of Q is 1 and left out.
NUMERATOR: Final[dict[Precision, tuple[float, ...]]] = {
    "float": (1048576.0, 141924.53125, 3857.889892578125, 24.823596954345703, 0.018589608371257782),
    "double": (
        *(1.4757395258967641e20, 2.2418302469127115e19, 8.840704831594996e17, 1.3902048946979696e16),
        *(102068983369430.23, 368056463061.8677, 637220112.2838985, 476133.959410676),
        *(117.70002801827637, 0.00407152022705833),
    ),
}
DENOMINATOR: Final[dict[Precision, tuple[float, ...]]] = {
    "float": (1048576.0, 491450.03125, 27864.201171875, 376.1784362792969),
    "double": (
        *(1.4757395258967641e20, 7.160961999901942e19, 5.077416804208764e18, 1.2273353627300466e17),
        *(1303634795241041.2, 6697311368958.068, 16857602393.543854, 19565052.936142813),
        *(8841.572500299559,),
    ),
}

#: How far the rational function is from tanh: units in the last place, absolute. For float tried on every float without
#: contraction (5.86 ulp and 3.49e-7; with it 5.48 ulp and 3.27e-7). For double proved on the whole line by
#: ``benchmarks/tanh_bound.py``; what was seen is FAST_SEEN.
FAST_ULP: Final[dict[Precision, float]] = {"float": 5.9, "double": 53.0}
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


def fast_tanh(x: NDArray[Any]) -> NDArray[Any]:
    """The rational function, elementwise, with the operations of the C in their order."""
    working: Precision = "float" if x.dtype == np.float32 else "double"
    return cut_ratio(NUMERATOR[working], DENOMINATOR[working], x, x * x)


def cut_ratio(
    numerator: Sequence[float], denominator: Sequence[float], x: NDArray[Any], y: NDArray[Any]
) -> NDArray[Any]:
    """``x P(y)/Q(y)``, elementwise, its magnitude cut at 1; coefficients from the constant up.

    The coefficient of Q's highest power is 1 and left out.
    """
    p, q = polynomial(numerator, y), polynomial((*denominator[:-1], y + x.dtype.type(denominator[-1])), y)
    quotient = x * p / q
    result: NDArray[Any] = np.where(np.abs(quotient) <= x.dtype.type(1), quotient, x / np.abs(x))
    return result


def fast_cosh(x: NDArray[Any]) -> NDArray[Any]:
    """The cosh of doubled arguments, elementwise, with the operations of the C in their order."""
    real = x.dtype.type
    y = x * x
    w = polynomial(COSH, y) * y
    for _ in range(DOUBLINGS - 1):
        w = w * (w + real(4))
    result: NDArray[Any] = real(0.5) * w * (w + real(4)) + real(1)
    return result


def polynomial(coefficients: Sequence[Any], y: NDArray[Any]) -> NDArray[Any]:
    """The polynomial, coefficients from the constant up; the last one may be an array."""
    real = y.dtype.type
    result: NDArray[Any] = coefficients[-1] + np.zeros_like(y)
    for coefficient in reversed(coefficients[:-1]):
        result = result * y + real(coefficient)
    return result
