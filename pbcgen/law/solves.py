"""How each channel of the loop equation ``s + N tanh(s) = c`` is solved."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Final

from pbcgen.law.arithmetic import Precision, Tanh
from pbcgen.law.fitted import fitted_solve
from pbcgen.law.implicit import scalar_iterations
from pbcgen.law.law import ControlLaw, ScalarSolve, VectorSolve
from pbcgen.law.rounding import nearest

if TYPE_CHECKING:
    from pbcgen.symbolic.tape import Tape

#: The block solve stops here at the latest; see the description of the step for its globalisation.
BLOCK_ITERATIONS: Final = 40

#: Beyond any mu that occurs; the Newton iterations grow with log(mu) only.
_UNKNOWN: Final = Fraction(10) ** 9

#: A mu that is computed in float is at most this much above its exact value.
_ROUNDED: Final = 1 + Fraction(1, 10**5)


def with_tanh(law: ControlLaw, tanh: Tanh) -> ControlLaw:
    """The same law with another tanh, and the solves that suit it."""
    solves = choose_solves(law.prepare, law.precision, tanh, law.coefficient_bounds)
    return replace(law, tanh=tanh, solves=solves)


def choose_solves(
    prepare: Tape, precision: Precision, tanh: Tanh, bounds: Mapping[int, Fraction] | None = None
) -> tuple[ScalarSolve | VectorSolve, ...]:
    """The solves for the N of a law's prepare tape; ``bounds`` has the largest mu of channels whose mu is computed.

    Channels that N couples are solved together. An uncoupled channel whose mu is a constant is fitted in float with the
    fast tanh; every other one is solved by Newton's method.
    """
    entries = prepare.walk(_Constants(), [[None] * size for size in prepare.input_sizes])[1].entries
    unit = 2.0**-24 if precision == "float" else 2.0**-53
    solves: list[ScalarSolve | VectorSolve] = []
    for block in _blocks(prepare.outputs[0].shape[0], list(entries)):
        if len(block) > 1:
            solves.append(VectorSolve(tuple(block), BLOCK_ITERATIONS, 64 * unit))
            continue
        mu = entries.get((block[0], block[0]), Fraction(0))
        solves.append(_scalar(block[0], mu, precision, tanh, (bounds or {}).get(block[0], _UNKNOWN)))
    return tuple(solves)


def _scalar(index: int, mu: Fraction | None, precision: Precision, tanh: Tanh, largest: Fraction) -> ScalarSolve:
    if mu is not None and mu > 0:
        what = f"mu = N[{index}, {index}] of the loop equation (a product of h, alpha, beta and R)"
        rounded = Fraction(float(nearest(mu, precision, what)))
        fit = fitted_solve(rounded) if precision == "float" and tanh == "fast" else None
        if fit is not None:
            return ScalarSolve(index, 0, fit.error_bound, fit)
    bound = scalar_iterations(largest * _ROUNDED if mu is None else mu, precision)
    return ScalarSolve(index, bound.iterations, bound.error)


def _blocks(size: int, entries: list[tuple[int, int]]) -> list[list[int]]:
    """The connected groups of channels."""
    label = list(range(size))
    for i, j in entries:
        old, new = max(label[i], label[j]), min(label[i], label[j])
        label = [new if k == old else k for k in label]
    return [[i for i in range(size) if label[i] == root] for root in sorted(set(label))]


class _Constants:
    """Tape algebra that knows literals only: a Fraction, or None for everything that is computed."""

    def const(self, value: Fraction) -> Fraction:
        return value

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *operands: operands[0] if name == "assign" else None
