"""SX functions of NumPy arrays in double precision.

CasADi converts arguments and results entry by entry when a function is called, which takes longer than most functions
do. Its buffers read and write the memory of arrays; the values are the same.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Doubles:
    """``outputs`` as functions of the symbols ``inputs``.

    Attributes:
        function: the same as a CasADi function; structural zeros are entries of its outputs too.
    """

    def __init__(self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> None:
        self.function = ca.Function("doubles", list(inputs), [ca.densify(output) for output in outputs])
        self._shapes = [self.function.size_out(k) for k in range(self.function.n_out())]
        self._buffers: dict[int, _Buffers] = {}

    def __call__(self, *values: ArrayLike) -> list[Array]:
        """The outputs as matrices, for one array of the right size for each input."""
        return [v.reshape(shape, order="F") for v, shape in zip(self._at(1, values), self._shapes, strict=True)]

    def many(self, *points: Array) -> list[Array]:
        """The outputs at N points, N x rows x columns each; an array N x size for each input."""
        count = len(points[0])
        found = zip(self._at(count, points), self._shapes, strict=True)
        return [v.reshape(count, columns, rows).transpose(0, 2, 1) for v, (rows, columns) in found]

    def _at(self, count: int, values: Sequence[ArrayLike]) -> list[Array]:
        if count not in self._buffers:
            self._buffers[count] = _Buffers(self.function if count == 1 else self.function.map(count))
        return self._buffers[count].evaluate(values)


class _Buffers:
    """A function with arrays that it reads and writes."""

    def __init__(self, function: ca.Function) -> None:
        self._buffer, self._run = function.buffer()
        self._arguments = [np.zeros(function.nnz_in(k)) for k in range(function.n_in())]
        self._results = [np.zeros(function.nnz_out(k)) for k in range(function.n_out())]
        for attach, arrays in ((self._buffer.set_arg, self._arguments), (self._buffer.set_res, self._results)):
            for k, array in enumerate(arrays):
                if array.size:
                    attach(k, array.data)  # type: ignore[call-arg]  # a memory view is pointer and size at once

    def evaluate(self, values: Sequence[ArrayLike]) -> list[Array]:
        for array, value in zip(self._arguments, values, strict=True):
            array[:] = np.ravel(value)
        self._run()
        return [array.copy() for array in self._results]
