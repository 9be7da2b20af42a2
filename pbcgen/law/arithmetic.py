"""What the generated code computes with, as far as it can be chosen."""

from typing import Literal

#: The type of every number.
Precision = Literal["float", "double"]

#: How tanh is computed: by the functions of :mod:`pbcgen.law.hyperbolic`, or by the math library.
Tanh = Literal["fast", "libm"]


def default_tanh(precision: Precision) -> Tanh:
    """What a law uses unless told otherwise."""
    return "fast" if precision == "float" else "libm"
