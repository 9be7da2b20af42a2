"""What front ends ask of the SX expressions that a user passes: shape, symbols, constants."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import casadi as ca
import numpy as np

from pbcgen.errors import ModelError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

T = TypeVar("T")


def expression(value: Any, what: str) -> ca.SX:
    """``value`` as an SX matrix: SX, DM, numbers, NumPy arrays, a list (a column) or a list of lists (rows).

    Raises:
        ModelError: for MX and for anything that is not a matrix of expressions.
    """
    if isinstance(value, ca.SX):
        return value
    if isinstance(value, ca.MX):
        raise ModelError(f"{what} is a casadi.MX: build the model with casadi.SX")
    if value is None:
        raise ModelError(f"{what} is missing")
    if isinstance(value, list | tuple):
        return _stacked(value, what)
    if isinstance(value, str):
        raise ModelError(
            f"{what} contains the text '{value}': give an expression or a number; for an exact decimal declare "
            f"Parameters(name='{value}')"
        )
    try:
        return ca.SX(value)
    except (NotImplementedError, TypeError, RuntimeError):
        raise ModelError(f"{what} is {value!r}: a casadi.SX expression was expected") from None


def _stacked(rows: Sequence[Any], what: str) -> ca.SX:
    parts = [_row(row, what) for row in rows]
    if not parts:
        return ca.SX(0, 1)
    widths = {part.shape[1] for part in parts}
    if len(widths) > 1:
        raise ModelError(f"{what} has rows of different lengths")
    return ca.vertcat(*parts)


def _row(row: Any, what: str) -> ca.SX:
    if isinstance(row, list | tuple):
        return ca.horzcat(*[expression(entry, what) for entry in row])
    return expression(row, what)


def shaped(value: Any, shape: tuple[int, int], what: str) -> ca.SX:
    """``value`` as an SX matrix of this shape; a list stands for a column, and an empty one for any empty matrix.

    Raises:
        ModelError: with the expected and the given shape.
    """
    matrix = expression(value, what)
    if matrix.numel() == 0 and 0 in shape:
        return ca.SX(*shape)
    if matrix.shape != shape:
        given, expected = (f"{rows}x{columns}" for rows, columns in (matrix.shape, shape))
        raise ModelError(f"{what} must be {expected}, it is {given}")
    return matrix


def column(value: Any, what: str) -> ca.SX:
    """``value`` as an SX column of any length. Raises ModelError for a row or a matrix."""
    matrix = expression(value, what)
    return shaped(matrix, (matrix.numel() if 1 in matrix.shape else matrix.shape[0], 1), what)


def square(value: Any, n: int, what: str) -> ca.SX:
    """An n x n matrix; a list or column of n entries (n > 1) is its diagonal."""
    matrix = expression(value, what)
    if matrix.shape == (n, 1) and n != 1:
        return ca.diag(matrix)
    return shaped(matrix, (n, n), what)


def symbols(value: Any, what: str) -> ca.SX:
    """A column of SX symbols, from a column, one symbol or a list of these.

    Raises:
        ModelError: if an entry is not a symbol, or two of them are the same.
    """
    stacked = column(value, what)
    seen = set()
    for entry in entries(ca.densify(stacked)):
        if not entry.is_symbolic():
            raise ModelError(f"{what} contains `{entry}`: every entry must be a symbol, made by casadi.SX.sym")
        if entry.element_hash() in seen:
            raise ModelError(f"{what} contains the symbol `{entry.name()}` twice")
        seen.add(entry.element_hash())
    return stacked


def entries(values: ca.SX) -> list[ca.SX]:
    """The scalar entries of a column."""
    return list(ca.vertsplit(values)) if values.numel() else []


def names(column_of_symbols: ca.SX) -> tuple[str, ...]:
    """The names of the symbols of a column."""
    return tuple(entry.name() for entry in entries(column_of_symbols))


def unique(all_names: Iterable[str]) -> None:
    """Raise ModelError if a name of a state, input, measurement or parameter is used twice or cannot be written."""
    seen: set[str] = set()
    for name in all_names:
        if not name.isidentifier():
            raise ModelError(f"the name `{name}` is no identifier: use letters, digits and underscores")
        if name in seen:
            raise ModelError(f"the name `{name}` is used twice: states, inputs and parameters need different names")
        seen.add(name)


def check_symbols(value: ca.SX, allowed: Sequence[ca.SX], what: str, forbidden: ca.SX, kind: str) -> None:
    """Raise ModelError if ``value`` contains a symbol that is not allowed, and name it.

    Args:
        value: the expression.
        allowed: columns of symbols that may occur.
        what: how the message calls the expression.
        forbidden: symbols that the model knows but that may not occur here, such as the input u in S.
        kind: how the message calls a forbidden symbol, for example "the input".
    """
    known = {entry.element_hash() for group in allowed for entry in entries(group)}
    banned = {entry.element_hash() for entry in entries(forbidden)}
    for symbol in ca.symvar(value):
        if symbol.element_hash() in known:
            continue
        if symbol.element_hash() in banned:
            raise ModelError(f"{what} depends on {kind} `{symbol.name()}`: it may not")
        raise ModelError(
            f"{what} contains the symbol `{symbol.name()}`, which is neither a state, an input nor a parameter: "
            "declare it; a symbol of Parameters is known where they are given as `parameters=`"
        )


def check_finite(value: ca.SX, what: str) -> None:
    """Raise ModelError if a constant in the expression is NaN or infinite, and say in which entry."""
    if _is_finite(value):
        return
    for row, col in zip(*value.sparsity().get_triplet(), strict=True):
        if not _is_finite(value[row, col]):
            where = what if value.numel() == 1 else f"entry ({row + 1}, {col + 1}) of {what}"
            raise ModelError(
                f"{where} contains a constant that is not a finite number: a division by zero, or a function that is "
                "not CasADi's (math.sin in place of ca.sin)"
            )


def _is_finite(value: ca.SX) -> bool:
    return all(np.isfinite(c) for c in _constants(value))


def _constants(value: ca.SX) -> list[float]:
    """The numbers in an expression."""
    function = ca.Function("f", [], [value], {"allow_free": True})
    return [
        function.instruction_constant(k)
        for k in range(function.n_instructions())
        if function.instruction_id(k) == ca.OP_CONST
    ]


def depends(value: ca.SX, on: ca.SX) -> bool:
    """Whether a symbol of the column ``on`` occurs in the expression."""
    wanted = {entry.element_hash() for entry in entries(on)}
    return any(symbol.element_hash() in wanted for symbol in ca.symvar(value))


def vanishes_at_samples(
    value: ca.SX, scale: ca.SX, variables: ca.SX, parameters: ca.SX, numeric: NDArray[np.float64]
) -> bool:
    """Whether ``value`` is zero to rounding, relative to ``scale``, at fixed pseudo-random points.

    This is evidence, never proof. Points where the value is not finite are skipped.
    """
    function = ca.Function("f", [variables, parameters], [ca.densify(value), scale])
    for point in _samples(variables.numel()):
        entries_there, scale_there = function(point, numeric)
        worst = np.abs(np.asarray(entries_there, dtype=float)).max(initial=0.0)
        if np.isfinite(worst) and worst > 1e-9 * float(scale_there):
            return False
    return True


def never_positive_definite(matrix: ca.SX, variables: ca.SX, parameters: ca.SX, numeric: NDArray[np.float64]) -> bool:
    """Whether a symmetric matrix has an eigenvalue that is not positive at every one of fixed pseudo-random points."""
    if matrix.numel() == 0:
        return False
    function = ca.Function("f", [variables, parameters], [ca.densify(matrix)])
    values = [np.asarray(function(point, numeric), dtype=float) for point in _samples(variables.numel())]
    known = [value for value in values if np.isfinite(value).all()]
    return bool(known) and all(np.linalg.eigvalsh(value).min() <= 0 for value in known)


def _samples(size: int) -> list[NDArray[np.float64]]:
    generator = np.random.default_rng(20240229)
    return [generator.uniform(-1, 1, size) for _ in range(5)]


def by_name(value: Mapping[str, T] | None, what: str) -> Mapping[str, T]:
    """A mapping from names, empty for None. Raises ModelError, which calls it ``what``, for anything else."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ModelError(f"{what} is {value!r}: a dict by name was expected")
    return value


def suggestion(name: object, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: the closest known one, or all of them."""
    options = list(known)
    close = difflib.get_close_matches(str(name), options, n=1)
    if close:
        return f"did you mean `{close[0]}`?"
    return "known are " + ", ".join(f"`{option}`" for option in options) if options else "there are none"
