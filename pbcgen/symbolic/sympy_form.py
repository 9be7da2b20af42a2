"""Formulas as SymPy expressions, for LaTeX and MathML.

Two ways lead here: the instruction tape, which keeps the form that the user wrote, and exact rational functions, whose
coefficients are factored. SymPy expressions are trees, and a tree may be exponentially larger than the tape that it
comes from; therefore the size is counted on the tape first, and what is too large becomes :class:`TooLarge`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeAlias

import casadi as ca
import sympy
from flint import fmpq, fmpq_mpoly
from sympy.printing.latex import LatexPrinter

from pbcgen.symbolic.coefficients import Coefficients
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.real import fraction
from pbcgen.symbolic.tape import Matrix, Tape

#: A formula of more operations than this is not worth reading.
LARGEST = 160

_GREEK_NAMES = """
    alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau phi chi psi omega
    Gamma Delta Theta Lambda Xi Pi Sigma Phi Psi Omega Upsilon
"""
_GREEK = frozenset(_GREEK_NAMES.split())

#: Operations of the tape that SymPy knows by the same name.
_SAME_NAME = """
    exp log sqrt sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh atan2 erf erfinv floor sign
"""


@dataclass(frozen=True)
class TooLarge:
    """A formula that is not written out, and how many operations it has as a tree."""

    operations: int

    @property
    def latex(self) -> str:
        """What stands in its place."""
        return rf"\text{{({size_text(self.operations)}: not written out)}}"


#: A SymPy expression, or what stands in its place.
Formula: TypeAlias = "sympy.Expr | TooLarge"


def size_text(operations: int) -> str:
    """``1234 operations``; beyond a million only the order of magnitude, which is all that matters then."""
    return f"{operations} operations" if operations < 10**6 else f"more than 10^{len(str(operations)) - 1} operations"


# --- numbers and names -------------------------------------------------------------------------------------------


def number(value: Fraction) -> Any:
    """A rational for a reader: a small fraction stays one, anything else is a decimal of twelve digits."""
    if value.denominator <= 16:
        return sympy.Rational(value.numerator, value.denominator)
    return sympy.Float(f"{float(value):.12g}", 12)


def symbol(name: str) -> Any:
    """The symbol for a name of the model; an exact number stands in formulas as a symbol called ``(p/q)``."""
    return number(Fraction(name[1:-1])) if name.startswith("(") else sympy.Symbol(name, real=True)


def name_as_latex(name: str) -> str:
    """``x1`` is x_{1}, ``alpha_c`` is alpha with an index, ``link_momentum`` has a word as its base and its index."""
    base, _, index = name.strip("_").partition("_")
    if not index and (split := re.fullmatch(r"([A-Za-z]+?)(\d+)", base)):
        base, index = split.groups()
    word = _word(base)
    return f"{word}_{{{_word(index)}}}" if index else word


def _word(text: str) -> str:
    if text == "ubar":
        return r"\bar{u}"
    if text in _GREEK:
        return rf"\{text}"
    if len(text) == 1 or text.isdigit():
        return text
    return rf"\text{{{text.replace('_', ' ')}}}"


# --- from the tape -----------------------------------------------------------------------------------------------


class SympyAlgebra:
    """The operations of the tape on SymPy expressions. A condition in a sum is 1 or 0, a number as a condition != 0."""

    title = "SymPy"

    def const(self, value: Fraction) -> Any:
        return number(value)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        try:
            operation = _OPERATIONS[name]
        except KeyError:
            raise AttributeError(name) from None
        conditions = _CONDITIONS.get(name, 0)

        def apply(*operands: Any) -> Any:
            return operation(*(_condition(o) if k < conditions else _numeric(o) for k, o in enumerate(operands)))

        return apply


#: How many of the first operands are conditions.
_CONDITIONS: Mapping[str, int] = {"not_": 1, "and_": 2, "or_": 2, "if_else_zero": 1}


def _condition(value: Any) -> Any:
    return sympy.Ne(value, 0) if isinstance(value, sympy.Expr) else value


def _numeric(value: Any) -> Any:
    return value if isinstance(value, sympy.Expr) else sympy.Piecewise((1, value), (0, True))


_OPERATIONS: Mapping[str, Callable[..., Any]] = {
    "assign": lambda a: a,
    "assign_first": lambda a, _: a,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
    "twice": lambda a: 2 * a,
    "sq": lambda a: a**2,
    "inv": lambda a: 1 / a,
    "pow": lambda a, b: a**b,
    "hypot": lambda a, b: sympy.sqrt(a**2 + b**2),
    "expm1": lambda a: sympy.exp(a) - 1,
    "log1p": lambda a: sympy.log(1 + a),
    "fabs": sympy.Abs,
    "fmin": sympy.Min,
    "fmax": sympy.Max,
    "fmod": lambda a, b: sympy.sign(a) * sympy.Mod(sympy.Abs(a), sympy.Abs(b)),
    "ceil": sympy.ceiling,
    "lt": sympy.StrictLessThan,
    "le": sympy.LessThan,
    "eq": sympy.Eq,
    "ne": sympy.Ne,
    "not_": sympy.Not,
    "and_": sympy.And,
    "or_": sympy.Or,
    "if_else_zero": lambda c, a: sympy.Piecewise((a, c), (0, True)),
    **{name: getattr(sympy, name) for name in _SAME_NAME.split()},
}


class _TreeSize:
    """How many operations the tree of a value has; an algebra of the tape."""

    def const(self, _: Fraction) -> int:
        return 0

    def __getattr__(self, _: str) -> Callable[..., int]:
        return lambda *operands: 1 + sum(operands)


def from_sx(expression: ca.SX, symbols: Sequence[ca.SX], largest: int = LARGEST) -> list[list[Formula]]:
    """The entries of an SX matrix, in the names of ``symbols``; beyond ``largest`` operations they are too large.

    Raises:
        ModelError: the expression contains a symbol that is not among ``symbols``.
        UnsupportedOperation: an operation has no SymPy counterpart.
    """
    columns = [ca.vertsplit(ca.vec(ca.SX(s))) if ca.SX(s).numel() else [] for s in symbols]
    names = [[symbol(entry.name()) for entry in column] for column in columns]
    expression = ca.SX(expression)
    return [
        [_entry(expression[i, j], symbols, names, largest) for j in range(expression.shape[1])]
        for i in range(expression.shape[0])
    ]


def _entry(
    expression: ca.SX, symbols: Sequence[ca.SX], names: Sequence[Sequence[sympy.Symbol]], largest: int
) -> Formula:
    tape = Tape.of(list(symbols), [ca.densify(expression)])
    sizes: list[Matrix[int]] = tape.walk(_TreeSize(), [[0] * len(column) for column in names])
    operations = sizes[0].scalar(0)
    if operations > largest:
        return TooLarge(operations)
    values: list[Matrix[Any]] = tape.walk(SympyAlgebra(), names)
    result: Formula = sympy.sympify(values[0].scalar(sympy.Integer(0)))
    return result


# --- from exact functions ----------------------------------------------------------------------------------------


def from_function(function: Quotient, parameters: Iterable[int] = (), largest: int = LARGEST) -> Formula:
    """An exact function, grouped by state and atom; symbols in ``parameters`` form the factored coefficients."""
    operations = len(function.numerator) + len(function.denominator)
    if operations > largest:
        return TooLarge(operations)
    result: Formula = _Exact(Coefficients(function.field, parameters)).function(function)
    return result


class _Exact:
    """Functions of one field as SymPy expressions."""

    def __init__(self, coefficients: Coefficients) -> None:
        self.field, self.coefficients = coefficients.field, coefficients
        self._generators: dict[int, Any] = {}

    def generator(self, k: int) -> Any:
        if k not in self._generators:
            if k < self.field.symbol_count:
                self._generators[k] = symbol(self.field.names[k])
            else:
                atom = self.field.atoms[k]
                kind = "Abs" if atom.kind == "fabs" else atom.kind
                self._generators[k] = getattr(sympy, kind)(self.function(atom.argument))
        return self._generators[k]

    def function(self, function: Quotient) -> Any:
        groups = self.coefficients.split(function)
        if groups is None:
            return self._ratio(function.numerator, function.denominator)
        total: Any = sympy.Integer(0)
        for state, coefficient in sorted(groups.items()):
            total += self._ratio(coefficient.numerator, coefficient.denominator) * self._power_product(state)
        return total

    def _ratio(self, numerator: fmpq_mpoly, denominator: fmpq_mpoly) -> Any:
        return self._factored(numerator) / self._factored(denominator)

    def _factored(self, polynomial: fmpq_mpoly) -> Any:
        if polynomial.is_zero():
            return sympy.Integer(0)
        scale, factors = polynomial.factor()
        result = number(fraction(fmpq(scale)))
        for factor, exponent in factors:
            result *= self._sum(factor) ** int(exponent)
        return result

    def _sum(self, polynomial: fmpq_mpoly) -> Any:
        total: Any = sympy.Integer(0)
        for raw, coefficient in polynomial.to_dict().items():
            total += number(fraction(coefficient)) * self._power_product(tuple(int(e) for e in raw))
        return total

    def _power_product(self, exponents: tuple[int, ...]) -> Any:
        result: Any = sympy.Integer(1)
        for k, exponent in enumerate(exponents):
            if exponent:
                result *= self.generator(k) ** exponent
        return result


# --- to LaTeX ----------------------------------------------------------------------------------------------------


class _Printer(LatexPrinter):  # type: ignore[misc]
    """SymPy's LaTeX printer with the names of the model, short decimals and plain brackets."""

    def _print_Symbol(self, expr: sympy.Symbol, style: str = "plain") -> str:
        return name_as_latex(expr.name)

    def _print_Float(self, expr: sympy.Float) -> str:
        return decimal_as_latex(float(expr), 10)


def decimal_as_latex(value: float, digits: int = 6) -> str:
    """A number in the given digits; 2.2e-07 is 2.2 times a power of ten."""
    shown = f"{value:.{digits}g}"
    mantissa, _, exponent = shown.partition("e")
    if not exponent:
        return mantissa
    power = rf"10^{{{int(exponent)}}}"
    return power if mantissa == "1" else rf"{mantissa} \cdot {power}"


def latex(formula: Formula) -> str:
    """LaTeX of a formula."""
    if isinstance(formula, TooLarge):
        return formula.latex
    text: str = _Printer({"ln_notation": True, "mul_symbol": r"\,"}).doprint(formula)
    return text
