"""What the actuators can do: intervals and polyhedra of inputs, exact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from pbcgen.errors import ModelError
from pbcgen.models.affine import Interval, IntervalLike, interval
from pbcgen.models.exact import Number, decimal, exact, positive
from pbcgen.models.expressions import suggestion
from pbcgen.models.gains import Matrix, Vector, rectangle


@dataclass(frozen=True)
class InputSet:
    """The inputs that the actuators allow, in the order of u: intervals and ``A u <= b``.

    Attributes:
        intervals: (lo, hi) of each input; None is unbounded.
        A: rows of m numbers; may be empty.
        b: one bound for each row of A.
    """

    intervals: tuple[Interval, ...]
    A: Matrix
    b: Vector

    def rows(self) -> tuple[tuple[Vector, Fraction], ...]:
        """All limits as rows ``a u <= b``: upper and lower bounds, then the polyhedron."""
        m = len(self.intervals)
        found: list[tuple[Vector, Fraction]] = []
        for i, (lo, hi) in enumerate(self.intervals):
            unit = tuple(Fraction(i == j) for j in range(m))
            found += [(unit, hi)] if hi is not None else []
            found += [(tuple(-v for v in unit), -lo)] if lo is not None else []
        return (*found, *zip(self.A, self.b, strict=True))

    def check(self, input_names: Sequence[str]) -> None:
        """Raise ModelError naming limits that contradict each other, if no input keeps them all."""
        rows = self.rows()
        conflict = _conflict(rows) if self.A else ()
        if conflict:
            listed = ", ".join(f"`{row_text(rows[k][0], input_names)} <= {decimal(rows[k][1])}`" for k in conflict)
            raise ModelError(f"no input keeps the limits {listed} together: widen one of them")


def row_text(row: Sequence[Fraction], names: Sequence[str]) -> str:
    """A row of the polyhedron as a sum."""
    result = ""
    for a, name in zip(row, names, strict=True):
        if a:
            size = "" if abs(a) == 1 else f"{decimal(abs(a))}*"
            sign = ("-" if a < 0 else "") if not result else (" - " if a < 0 else " + ")
            result += f"{sign}{size}{name}"
    return result


#: Rows whose least common excess is above this share of their size contradict each other.
_CONTRADICTION = 1e-9


def _conflict(rows: Sequence[tuple[Vector, Fraction]]) -> tuple[int, ...]:
    """The rows of a clear contradiction, by the linear program ``min t : a u <= b + t |a|``; else none."""
    import numpy as np
    from scipy.optimize import linprog

    A = np.array([[float(v) for v in a] for a, _ in rows])
    size = np.abs(A).sum(axis=1)
    b = np.array([float(v) for _, v in rows])
    least = linprog(
        [0.0] * A.shape[1] + [1.0],
        A_ub=np.hstack([A / size[:, None], -np.ones((len(A), 1))]),
        b_ub=b / size,
        bounds=[(None, None)] * (A.shape[1] + 1),
        method="highs",
    )
    if least.status != 0 or least.fun <= _CONTRADICTION * (1 + float(np.max(np.abs(b / size)))):
        return ()
    return tuple(int(k) for k in np.nonzero(np.abs(least.ineqlin.marginals) > 1e-9)[0])


@dataclass(frozen=True, init=False)
class Limits:
    """Actuator limits, as intervals of single inputs and as a polyhedron ``A u <= b``.

    ``Limits({"u": (0, "3.1")})``, ``Limits.symmetric(5)``, ``Limits(A=[[0, 1, 1]], b=["7.901"])``.

    Attributes:
        intervals: (lo, hi) by input name, or in the order of u, or one Interval for every input in ``every``.
        every: the interval of each input that ``intervals`` does not bound.
        A: the polyhedron, rows in the order of u.
        b: likewise.
    """

    intervals: Mapping[str, Interval] | tuple[Interval, ...]
    every: Interval
    A: Matrix
    b: Vector

    def __init__(
        self,
        intervals: Mapping[str, IntervalLike] | Sequence[IntervalLike] | None = None,
        A: Sequence[Sequence[Number]] | None = None,
        b: Sequence[Number] | None = None,
        *,
        every: IntervalLike = (None, None),
    ) -> None:
        """Store exact limits.

        Args:
            intervals: (lo, hi) by input name, or a sequence of pairs in the order of u; None is unbounded.
            A: rows of the polyhedron ``A u <= b``.
            b: right side of the polyhedron.
            every: the interval of all inputs without one of their own.

        Raises:
            ModelError: for an empty interval, a row of another length, or a number that is not finite.
        """
        named: Mapping[str, Interval] | tuple[Interval, ...]
        if isinstance(intervals, Mapping):
            named = {name: interval(pair, f"the interval of `{name}`") for name, pair in intervals.items()}
        else:
            named = tuple(interval(pair, f"the interval {i + 1}") for i, pair in enumerate(intervals or ()))
        rows, bounds = _polyhedron(A, b)
        object.__setattr__(self, "intervals", named)
        object.__setattr__(self, "every", interval(every, "the interval of all inputs"))
        object.__setattr__(self, "A", rows)
        object.__setattr__(self, "b", bounds)

    @classmethod
    def symmetric(cls, bound: Number | Mapping[str, Number] | Sequence[Number]) -> Limits:
        """``|u_i| <= bound``: one bound for all inputs, by input name, or in the order of u."""
        if isinstance(bound, Mapping):
            return cls({name: _both_signs(value, f"the bound of `{name}`") for name, value in bound.items()})
        if isinstance(bound, Sequence) and not isinstance(bound, str):
            return cls([_both_signs(value, f"the bound {i + 1}") for i, value in enumerate(bound)])
        return cls(every=_both_signs(bound, "the bound of the inputs"))

    @classmethod
    def absolute(cls, A: Sequence[Sequence[Number]], b: Sequence[Number]) -> Limits:
        """``|A u| <= b`` row by row, for example ``absolute([[0, 1, 1], [0, 1, -1]], ["7.901", "7.901"])``."""
        rows, bounds = _polyhedron(A, b)
        for i, value in enumerate(bounds):
            positive(value, f"the bound {i + 1} of the polyhedron")
        negated = tuple(tuple(-entry for entry in row) for row in rows)
        return cls(A=[*rows, *negated], b=[*bounds, *bounds])

    def resolve(self, input_names: Sequence[str]) -> InputSet:
        """The limits in the order of u.

        Raises:
            ModelError: for the name of no input, or a number of intervals or columns that is not the number of inputs.
        """
        m = len(input_names)
        if any(len(row) != m for row in self.A):
            raise ModelError(f"the rows of the limits' A have {len(self.A[0])} entries, the system has {m} inputs")
        return InputSet(self._in_order(input_names), self.A, self.b)

    def _in_order(self, input_names: Sequence[str]) -> tuple[Interval, ...]:
        if isinstance(self.intervals, tuple):
            if self.intervals and len(self.intervals) != len(input_names):
                raise ModelError(
                    f"the limits have {len(self.intervals)} intervals, the system has {len(input_names)} inputs"
                )
            return self.intervals or (self.every,) * len(input_names)
        for name in self.intervals:
            if name not in input_names:
                raise ModelError(f"the limits bound `{name}`, which is not an input: {suggestion(name, input_names)}")
        return tuple(self.intervals.get(name, self.every) for name in input_names)


def _both_signs(bound: Number, what: str) -> tuple[Fraction, Fraction]:
    value = positive(bound, what)
    return -value, value


def _polyhedron(A: Sequence[Sequence[Number]] | None, b: Sequence[Number] | None) -> tuple[Matrix, Vector]:
    if A is None and b is None:
        return (), ()
    if A is None or b is None:
        raise ModelError("the limits have A without b, or b without A: A u <= b needs both")
    rows = rectangle(list(A), "A of the limits") if len(A) else ()
    bounds = tuple(exact(value, f"entry {i + 1} of b of the limits") for i, value in enumerate(b))
    if len(rows) != len(bounds):
        raise ModelError(f"the limits' A has {len(rows)} rows and b has {len(bounds)} entries")
    for i, row in enumerate(rows):
        if not any(row):
            raise ModelError(f"row {i + 1} of the limits' A is zero: it bounds nothing")
    return rows, bounds
