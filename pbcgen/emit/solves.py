"""The equations ``s + N tanh(s) = c`` of a law in C: functions that solve them, what these read, and their calls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from pbcgen.emit.expressions import Graph, Node
from pbcgen.emit.literals import literal
from pbcgen.emit.program import BlockCall, BlockFunction, FittedFunction, FittedPiece, ScalarCall, ScalarFunction
from pbcgen.errors import EmitError
from pbcgen.law.law import ControlLaw, Fit, ScalarSolve, VectorSolve
from pbcgen.law.rounding import nearest
from pbcgen.symbolic.tape import Matrix


def constant_mus(law: ControlLaw) -> dict[int, str]:
    """The literal mu of every channel with a fit. Raises ValueError if one is no constant."""
    graph = Graph()
    arguments = [[graph.name("")] * size for size in law.prepare.input_sizes]
    N = law.prepare.walk(graph, arguments)[1].entries
    mus = {}
    for solve in law.solves:
        if isinstance(solve, ScalarSolve) and solve.fit:
            node = N.get((solve.index, solve.index))
            if node is None or node.value is None:
                raise ValueError(f"channel {solve.index} has a fit, but its mu is no constant")
            mus[solve.index] = literal(nearest(node.value, law.precision))
    return mus


@dataclass(frozen=True)
class SolverFunctions:
    """The solver functions, each for the solves that can share it."""

    fitted: Mapping[tuple[str, Fit], FittedFunction]
    scalar: Mapping[int, ScalarFunction]
    block: Mapping[tuple[int, int, float], BlockFunction]

    @staticmethod
    def of(law: ControlLaw, prefix: str, mus: Mapping[int, str]) -> SolverFunctions:
        """``mus`` has the literal mu of every channel with a fit."""
        fitted: dict[tuple[str, Fit], FittedFunction] = {}
        scalar: dict[int, ScalarFunction] = {}
        block: dict[tuple[int, int, float], BlockFunction] = {}
        bounds: dict[int, float] = {}
        for solve in law.solves:
            if isinstance(solve, ScalarSolve) and solve.fit:
                key = (mus[solve.index], solve.fit)
                if key not in fitted:
                    fitted[key] = _fitted_function(f"{prefix}_solve_{solve.index}", *key)
            elif isinstance(solve, ScalarSolve):
                bounds[solve.iterations] = max(bounds.get(solve.iterations, 0.0), solve.error_bound)
            elif _key(solve) not in block:
                name = f"{prefix}_solve_block{len(block) or ''}"
                tolerance = literal(nearest(Fraction(solve.tolerance), law.precision, "the tolerance"))
                m = len(solve.indices)
                block[_key(solve)] = BlockFunction(name, m, solve.iterations, tolerance)
        for iterations, bound in sorted(bounds.items()):
            name = f"{prefix}_solve" if len(bounds) == 1 else f"{prefix}_solve_in_{iterations}"
            scalar[iterations] = ScalarFunction(name, iterations, f"{bound:.2g}")
        return SolverFunctions(fitted, scalar, block)


def _fitted_function(name: str, mu: str, fit: Fit) -> FittedFunction:
    def text(value: float) -> str:
        return literal(np.float32(value))

    pieces = tuple(
        FittedPiece(
            text(piece.knot),
            text(piece.length),
            tuple(map(text, reversed(piece.numerator))),
            tuple(map(text, reversed(piece.denominator))),
        )
        for piece in fit.pieces
    )
    origin = pieces[0].length if pieces and fit.pieces[0].length else ""
    correction = tuple(map(text, reversed(fit.correction)))
    return FittedFunction(name, mu, correction, pieces, origin, f"{fit.error_bound:.2g}")


def _key(solve: VectorSolve) -> tuple[int, int, float]:
    return (len(solve.indices), solve.iterations, solve.tolerance)


def t_names_of(law: ControlLaw) -> list[str]:
    """The C expression of t, by channel."""
    names = [""] * law.channels
    block = 0
    for solve in law.solves:
        if isinstance(solve, ScalarSolve):
            names[solve.index] = f"t{solve.index}"
            continue
        for k, channel in enumerate(solve.indices):
            names[channel] = f"t_block{block}[{k}]"
        block += 1
    return names


@dataclass(frozen=True)
class Coefficients:
    """The entries of N that the solves read.

    Attributes:
        texts: by position, a literal or the local variable that holds the entry; equal entries share one.
        roots: the local variables, and what they hold.
        checks: what must hold of them.
    """

    texts: dict[tuple[int, int], str]
    roots: dict[str, Node]
    checks: tuple[str, ...]

    @staticmethod
    def of(law: ControlLaw, prefix: str, N: Matrix[Node], zero: Node) -> Coefficients:
        """Raises EmitError for a constant mu below zero."""
        texts: dict[tuple[int, int], str] = {}
        roots: dict[str, Node] = {}
        signs = []
        for solve in law.solves:
            indices = (solve.index,) if isinstance(solve, ScalarSolve) else solve.indices
            for at in [(i, j) for i in indices for j in indices]:
                node = N.entries.get(at, zero)
                texts[at] = _coefficient(law, node, at, roots)
                if isinstance(solve, ScalarSolve):
                    signs += _sign_check(law, node, texts[at])
        finite = [f"{prefix}_is_finite({name})" for name in roots]
        return Coefficients(texts, roots, (*finite, *signs))


def _coefficient(law: ControlLaw, node: Node, at: tuple[int, int], roots: dict[str, Node]) -> str:
    """The text of one entry of N; a new local variable joins ``roots`` if it needs one."""
    if node.value is not None:
        return literal(nearest(node.value, law.precision, f"the coefficient N[{at[0]}, {at[1]}]"))
    for name, known in roots.items():
        if known is node:
            return name
    name = f"n{at[0]}_{at[1]}"
    roots[name] = node
    return name


def _sign_check(law: ControlLaw, node: Node, text: str) -> list[str]:
    """The condition mu >= 0 if it must be checked at run time."""
    if node.value is None:
        return [f"({text} >= {literal(nearest(Fraction(0), law.precision))})"]
    if node.value < 0:
        raise EmitError(f"a channel has mu = {float(node.value)}: mu must not be negative")
    return []


def calls_of(
    law: ControlLaw, functions: SolverFunctions, coefficients: Mapping[tuple[int, int], str], t_names: Sequence[str]
) -> tuple[tuple[ScalarCall, ...], tuple[BlockCall, ...]]:
    """The calls of the functions, one for each solve; ``coefficients`` has the texts of the entries of N."""
    scalars: list[ScalarCall] = []
    blocks: list[BlockCall] = []
    arguments: tuple[str, ...]
    for solve in law.solves:
        if isinstance(solve, ScalarSolve):
            i = solve.index
            if solve.fit:
                name, arguments = functions.fitted[coefficients[i, i], solve.fit].name, (f"c{i}",)
            else:
                name, arguments = functions.scalar[solve.iterations].name, (coefficients[i, i], f"c{i}")
            scalars.append(ScalarCall(t_names[i], name, arguments))
            continue
        rows, k = solve.indices, len(blocks)
        blocks.append(
            BlockCall(
                t=f"t_block{k}",
                n=f"n_block{k}",
                c=f"c_block{k}",
                function=functions.block[_key(solve)].name,
                size=len(rows),
                entries=tuple(coefficients[i, j] for i in rows for j in rows),
                right_side=tuple(f"c{i}" for i in rows),
            )
        )
    return tuple(scalars), tuple(blocks)
