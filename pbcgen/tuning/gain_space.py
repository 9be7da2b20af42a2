"""Gains as points of a box: what the search of gains moves, and how a point becomes a law."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbcgen.models.exact import decimal
from pbcgen.models.gains import Matrix, Vector, is_diagonal
from pbcgen.models.laws import Integral, Law, NaturalDamping, amplitudes, gains, is_amplitude
from pbcgen.tuning.trial import entries, like

#: How far gains may move from those of the design, in decades.
_DECADES = {"beta": 3.0, "beta_c": 3.0, "R_c": 4.0, "beta_l": 5.0, "R_l": 5.0, "beta_psi": 3.0}
_USUAL_DECADES = 4.0

#: Significant digits of the gains that are proposed.
DIGITS = 3


@dataclass(frozen=True, eq=False)
class Space:
    """Gains as points of a box: shares of the amplitudes, and decades of the other gains around the given ones.

    Attributes:
        origin: the law with the given gains.
        amplitudes: the sum of the amplitudes of each input.
        m: channels.
        common: one number for each gain, the same for all channels; else one for each channel.
    """

    origin: Law
    amplitudes: Vector
    m: int
    common: bool

    @property
    def shares(self) -> list[str]:
        """The amplitudes that are sought as shares of the sum; the last one takes what is left."""
        return [name for name in entries(self.origin) if is_amplitude(name)][:-1]

    @property
    def logs(self) -> list[str]:
        """The other gains that are sought.

        K_l stays: with K_l x_l as the state only the product K_l R_l matters. A gain of zero stays zero.
        """
        found = entries(self.origin)
        return [
            name
            for name, values in found.items()
            if not is_amplitude(name) and name != "K_l" and all(v > 0 for v in values)
        ]

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """The box of the points."""
        m = 1 if self.common else self.m
        box = [(0.03, 0.97)] * (len(self.shares) * m)
        for name in self.logs:
            reach = _DECADES.get(name, _USUAL_DECADES)
            box += [(-reach, reach)] * m
        return box

    def start(self) -> NDArray[np.float64]:
        """The given gains."""
        found, sums = entries(self.origin), amplitudes(self.origin)
        point: list[float] = []
        for name in self.shares:
            shares = [float(found[name][i] / sums[i]) for i in range(self.m)]
            point += [float(np.mean(shares))] if self.common else shares
        point += [0.0] * (len(self.logs) * (1 if self.common else self.m))
        return np.array(point)

    def point(self, law: Law) -> NDArray[np.float64]:
        """The point of a law with diagonal gains, in the space with one number for each channel."""
        found, origin = entries(law), entries(self.origin)
        point = [float(v / t) for name in self.shares for v, t in zip(found[name], self.amplitudes, strict=True)]
        for name in self.logs:
            point += [math.log10(float(v / o)) for v, o in zip(found[name], origin[name], strict=True)]
        return np.array(point)

    def law(self, x: Sequence[float] | NDArray[np.float64], digits: int | None = None) -> Law:
        """The law at a point; with ``digits`` rounded, amplitudes so that the limits still hold."""
        width = 1 if self.common else self.m
        values = iter([list(x[k : k + width]) * (self.m // width) for k in range(0, len(x), width)])
        found = entries(self.origin)
        chosen: dict[str, tuple[Fraction, ...]] = dict(found)
        left = list(self.amplitudes)
        for name in self.shares:
            shares = next(values)
            own = [Fraction(s).limit_denominator(10**6) * a for s, a in zip(shares, self.amplitudes, strict=True)]
            chosen[name] = tuple(_round(v, digits) for v in own)
            left = [a - b for a, b in zip(left, chosen[name], strict=True)]
        last = [name for name in found if is_amplitude(name)][-1]
        chosen[last] = tuple(left)
        for name in self.logs:
            factors = next(values)
            chosen[name] = tuple(
                _round(v * Fraction(10.0**f), digits) for v, f in zip(found[name], factors, strict=True)
            )
        return rebuilt(self.origin, chosen)


def _round(value: Fraction, digits: int | None) -> Fraction:
    return Fraction(f"{float(value):.{digits}g}") if digits is not None else Fraction(float(value))


def rebuilt(law: Law, chosen: dict[str, tuple[Fraction, ...]]) -> Law:
    """The law with other gains; matrices are given by their diagonals, and their other entries are scaled with them."""
    if isinstance(law, Integral):
        base = rebuilt(law.base, chosen)
        R_psi = _with_diagonal(law.R_psi, chosen["R_psi"])
        return Integral(base, chosen["alpha_psi"], chosen["beta_psi"], R_psi)  # type: ignore[arg-type]
    names = entries(law)
    arguments: dict[str, Any] = {name: _with_diagonal(getattr(law, name), chosen[name]) for name in names}
    if isinstance(law, NaturalDamping):
        arguments["Upsilon"] = law.Upsilon
    made: Law = type(law)(**arguments)
    return made


def _with_diagonal(given: Any, diagonal: Vector) -> Any:
    full = isinstance(given[0], tuple) and not is_diagonal(given)
    return like(given, diagonal) if full else list(diagonal)


def expression(law: Law) -> str:
    """The law as Python, to be pasted into a design file."""
    if isinstance(law, Integral):
        own = {name: value for name, value in shown_gains(law).items() if name.endswith("_psi")}
        base = expression(law.base).replace("\n", "\n    ")
        return f"Integral(\n    {base},\n{_arguments(own)})"
    return f"{type(law).__name__}(\n{_arguments(shown_gains(law))}{_upsilon(law)})"


def shown_gains(law: Law) -> dict[str, Vector | Matrix]:
    """The gains by name as they are written: diagonal matrices as vectors, without Upsilon."""
    full = gains(law)
    return {
        name: full[name] if isinstance(full[name][0], tuple) and not is_diagonal(full[name]) else values  # type: ignore[arg-type]
        for name, values in entries(law).items()
    }


def _arguments(values: dict[str, Vector | Matrix]) -> str:
    lines = []
    for name, entry in values.items():
        texts = [_written(v) for v in entry]
        lines.append(f"    {name}={texts[0] if len(texts) == 1 else '[' + ', '.join(texts) + ']'},\n")
    return "".join(lines)


def _written(value: Fraction | Vector) -> str:
    return f"[{', '.join(_written(v) for v in value)}]" if isinstance(value, tuple) else f'"{decimal(value)}"'


def _upsilon(law: Law) -> str:
    given = getattr(law, "Upsilon", None)
    if given is None or all(v == int(i == j) for i, row in enumerate(given) for j, v in enumerate(row)):
        return ""
    return f"    Upsilon=[{', '.join(_written(row) for row in given)}],\n"
