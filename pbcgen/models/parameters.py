"""Named parameters with exact values."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from pbcgen.errors import ModelError
from pbcgen.models.exact import Number, exact
from pbcgen.models.expressions import suggestion, unique

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from fractions import Fraction

    from numpy.typing import NDArray

_OWN_NAMES = frozenset({"names", "numbers", "values", "symbols", "numeric", "with_values"})


class Parameters:
    """The constants of a model: each has a symbol to build expressions with and an exact value.

    ``p = Parameters(R1=100, C="2.2e-4")`` gives ``p.R1`` and ``p["C"]`` as SX symbols, and ``p.values["C"]`` as the
    fraction 11/50000. A float is read as its shortest decimal: ``0.1`` is 1/10.
    """

    __slots__ = ("_numbers", "_symbols", "_values")

    _numbers: frozenset[str]
    _symbols: Mapping[str, ca.SX]
    _values: Mapping[str, Fraction]

    def __init__(self, **values: Number) -> None:
        """Declare parameters by name.

        Raises:
            ModelError: naming the parameter, if a value is missing, is not a finite number, or the name is taken.
        """
        unique(values)
        for name in values:
            if name.startswith("_") or name in _OWN_NAMES:
                raise ModelError(f"a parameter cannot be called `{name}`: the name is reserved")
        exact_values = {name: exact(value, f"the parameter `{name}`") for name, value in values.items()}
        object.__setattr__(self, "_symbols", {name: ca.SX.sym(name) for name in exact_values})
        object.__setattr__(self, "_values", exact_values)
        object.__setattr__(self, "_numbers", frozenset())

    def __getattr__(self, name: str) -> ca.SX:
        """The symbol of a parameter."""
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self._symbols[name]
        except KeyError:
            raise AttributeError(self._unknown(name)) from None

    def __getitem__(self, name: str) -> ca.SX:
        """The symbol of a parameter. Raises ModelError for an unknown name."""
        if name not in self._symbols:
            raise ModelError(self._unknown(name))
        return self._symbols[name]

    def __setattr__(self, name: str, value: Any) -> None:
        """Refused: parameters do not change."""
        raise AttributeError(f"parameters do not change: use with_values({name}=...) for a copy with another value")

    def __contains__(self, name: object) -> bool:
        """Whether there is a parameter of this name."""
        return name in self._symbols

    def __iter__(self) -> Iterator[str]:
        """The names, in the order of declaration."""
        return iter(self._symbols)

    def __len__(self) -> int:
        """The number of parameters."""
        return len(self._symbols)

    def __repr__(self) -> str:
        """The call that makes these parameters."""
        return f"Parameters({', '.join(f'{name}={str(value)!r}' for name, value in self._values.items())})"

    @property
    def names(self) -> tuple[str, ...]:
        """The names, in the order of declaration."""
        return tuple(self._symbols)

    @property
    def values(self) -> Mapping[str, Fraction]:
        """The exact values by name."""
        return MappingProxyType(dict(self._values))

    @property
    def numbers(self) -> frozenset[str]:
        """The names that stand for numbers in the model's expressions; formulas show the numbers instead."""
        return self._numbers

    @property
    def symbols(self) -> ca.SX:
        """The symbols as an SX column, in the order of ``names``."""
        return ca.vertcat(*self._symbols.values()) if self._symbols else ca.SX(0, 1)

    @property
    def numeric(self) -> NDArray[np.float64]:
        """The values rounded to double, in the order of ``names``."""
        return np.array([float(value) for value in self._values.values()], dtype=float)

    def with_values(self, **values: Number) -> Parameters:
        """A copy on the same symbols in which the named parameters have other values."""
        for name in values:
            if name not in self._symbols:
                raise ModelError(self._unknown(name))
        changed = {name: exact(value, f"the parameter `{name}`") for name, value in values.items()}
        copy = Parameters()
        object.__setattr__(copy, "_symbols", self._symbols)
        object.__setattr__(copy, "_values", {**self._values, **changed})
        object.__setattr__(copy, "_numbers", self._numbers)
        return copy

    def joined(self, **values: Number) -> Parameters:
        """A copy with parameters for numbers of the model's expressions.

        Raises ModelError for a name that is taken or a value that is no number.
        """
        for name in values:
            if name in self._symbols:
                raise ModelError(f"there is a parameter `{name}` already")
        added = Parameters(**values)
        copy = Parameters()
        object.__setattr__(copy, "_symbols", {**self._symbols, **added._symbols})
        object.__setattr__(copy, "_values", {**self._values, **added._values})
        object.__setattr__(copy, "_numbers", self._numbers | added._symbols.keys())
        return copy

    def _unknown(self, name: object) -> str:
        return f"there is no parameter `{name}`: {suggestion(name, self._symbols)}"
