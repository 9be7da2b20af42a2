"""C literals of machine numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pbcgen.law.rounding import Real


def literal(value: Real) -> str:
    """The shortest literal that a compiler reads back as ``value``, with the suffix of its type.

    >>> literal(np.float32(0.1)), literal(np.float64(1.23e-7)), literal(np.float32(-3)), literal(np.float32(1e20))
    ('0.1f', '1.23e-07', '-3.0f', '1e+20f')
    """
    suffix = "f" if isinstance(value, np.float32) else ""
    text = str(value)
    if not any(mark in text for mark in ".en"):
        text += ".0"
    return text + suffix
