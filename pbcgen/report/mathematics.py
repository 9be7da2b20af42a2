"""LaTeX of vectors and matrices, and MathML for pages.

LaTeX is the one source: notebooks take it as it is, pages take the MathML that latex2mathml makes of it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from html import escape
from typing import TYPE_CHECKING

from latex2mathml.converter import convert

from pbcgen.errors import UnsupportedOperation
from pbcgen.symbolic.real import Real, approximate
from pbcgen.symbolic.sympy_form import decimal_as_latex, from_function, from_sx, latex, name_as_latex

if TYPE_CHECKING:
    import casadi as ca

    from pbcgen.passivity.plant import Plant

#: Entries of a matrix beyond this are named but not printed.
LARGEST_MATRIX = 144


@dataclass(frozen=True)
class Formula:
    """A displayed formula with the words before it."""

    caption: str
    latex: str


@dataclass(frozen=True)
class Step:
    """One step.

    Attributes:
        key: for links.
        title: what is done.
        equations: names of the equations in the literature.
        text: what it means, in a sentence or two.
        formulas: what was found.
        claims: the verdicts that belong here.
    """

    key: str
    title: str
    equations: tuple[str, ...]
    text: str
    formulas: tuple[Formula, ...]
    claims: tuple[str, ...]


_FUNCTIONS = "sinh?|cosh?|tanh?|sech|arcsin|arccos|arctan|atan|asinh?|acosh|atanh|ln|log|exp|sqrt|erf"

#: Behind one of these a function needs a space.
_AFTER = "(?:" + "|".join(f"(?<=</{tag}>)" for tag in ("mi", "mn", "mrow", "msub", "msup", "msubsup", "mfrac")) + ")"

#: What latex2mathml leaves undone: a space before functions, arrows as operators, bars of norms that do not stretch
#: with their exponents, a minus sign as that of a number.
_TYPOGRAPHY = (
    (re.compile(rf"{_AFTER}(<mi>(?:{_FUNCTIONS})</mi>)"), r'<mspace width="0.17em"/>\1'),
    (re.compile(r"<mi>(&#x027F[9A];)</mi>"), r'<mo lspace="0.3em" rspace="0.3em" stretchy="false">\1</mo>'),
    (re.compile(r"<mo>(&#x02016;)</mo>"), r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>'),
    (
        re.compile(r"(<mo[^>]*>(?:&#x0003[CDE];|&#x0226[45];|&#x02208;|&#x0002[8C];|\[|,)</mo>)<mo>(&#x02212;)</mo>"),
        r'\1<mo form="prefix">\2</mo>',
    ),
)


@cache
def mathml(formula: str, *, block: bool = False) -> str:
    """MathML of a LaTeX formula, with the LaTeX as its alternative text."""
    # latex2mathml knows align*, not aligned, which is the one that notebooks understand.
    text = convert(formula.replace("{aligned}", "{align*}"), display="block" if block else "inline")
    for found, instead in _TYPOGRAPHY:
        text = found.sub(instead, text)
    return text.replace("<math ", f'<math alttext="{escape(formula, quote=True)}" ', 1)


def symbols(names: Sequence[str]) -> str:
    """``(x_1, x_2)``."""
    return rf"\left({', '.join(map(name_as_latex, names))}\right)"


def rate(name: str) -> str:
    """The time derivative of a signal, with the dot over its base."""
    base, index, rest = name_as_latex(name).partition("_{")
    return rf"\dot{{{base}}}{index}{rest}"


def matrix(rows: Sequence[Sequence[str]]) -> str:
    """A matrix of LaTeX entries; zeros as dots would hide signs, so they stay zeros."""
    if len(rows) == 1 and len(rows[0]) == 1:
        return rows[0][0]
    return r"\begin{bmatrix}" + r" \\ ".join(" & ".join(row) for row in rows) + r"\end{bmatrix}"


def column(entries: Sequence[str]) -> str:
    """A column vector."""
    return matrix([[entry] for entry in entries])


def number(value: float | Fraction | Real, digits: int = 6) -> str:
    """A number in the given digits."""
    return decimal_as_latex(
        approximate(value) if not isinstance(value, float | int | Fraction) else float(value), digits
    )


def numbers(values: Sequence[float | Fraction | Real], digits: int = 6) -> str:
    """One number as it is, several as a column."""
    return column([number(v, digits) for v in values])


def number_matrix(rows: Sequence[Sequence[float | Fraction | Real]], digits: int = 5) -> str:
    """A matrix of numbers; a diagonal one as ``diag(...)``."""
    if len(rows) > 1 and _is_diagonal(rows):
        return rf"\text{{diag}}\left({', '.join(number(rows[i][i], digits) for i in range(len(rows)))}\right)"
    return matrix([[number(v, digits) for v in row] for row in rows])


def _is_diagonal(rows: Sequence[Sequence[float | Fraction | Real]]) -> bool:
    return all(v == 0 for i, row in enumerate(rows) for j, v in enumerate(row) if i != j) and len(rows) == len(rows[0])


def expressions(plant: Plant, expression: ca.SX) -> list[list[str]]:
    """LaTeX of the entries of an SX matrix in x, u and the parameters, in the form that they were written in."""
    return [[latex(entry) for entry in row] for row in from_sx(expression, list(plant.symbols))]


def entry(plant: Plant, expression: ca.SX) -> str:
    """LaTeX of a scalar expression."""
    return expressions(plant, expression)[0][0]


def written_matrix(plant: Plant, expression: ca.SX) -> str:
    """LaTeX of an SX matrix, or that it is too large to be written out."""
    if expression.numel() > LARGEST_MATRIX:
        return rf"\text{{({expression.shape[0]} by {expression.shape[1]} matrix: not written out)}}"
    return matrix(expressions(plant, expression))


def exactly(plant: Plant, expression: ca.SX) -> list[list[str]]:
    """The entries as exact functions with factored coefficients; as they stand where that is not possible."""
    try:
        field, (values,) = plant.exact(expression, symbolic=True)
    except (UnsupportedOperation, ZeroDivisionError):
        return expressions(plant, expression)
    parameters = plant.parameter_positions()
    return [[latex(from_function(v, parameters)) for v in row] for row in values.dense(field.const(0))]
