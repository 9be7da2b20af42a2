"""SX instructions as C expressions.

Walking a tape with :class:`Graph` gives a directed graph of :class:`Node`, in which equal values are one node, across
all tapes that were walked with it. :class:`Printer` turns nodes into C statements: a value that is used once and
short is written where it is used, every other one becomes ``const <real> v<n> = ...``.

What an operation looks like in C stands in one table, :data:`FORMS`. Comparisons and logic are reals 0 and 1, as in
CasADi; where they decide a selection they are printed as the condition itself.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from typing import TYPE_CHECKING, Final

from pbcgen.emit.literals import literal
from pbcgen.law.rounding import nearest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from pbcgen.law.arithmetic import Precision

#: A longer expression is given a name.
INLINE_LENGTH: Final = 56


class Level(IntEnum):
    """Binding strength of a C expression, as far as this printer needs it."""

    SELECTION = 0
    LOGIC = 1
    COMPARISON = 2
    SUM = 3
    PRODUCT = 4
    SIGN = 5
    ATOM = 6


@dataclass(frozen=True)
class Form:
    """How an operation is written.

    Attributes:
        template: C text; ``{0}`` and ``{1}`` are operands, ``{f}`` is the suffix of math functions, ``{p}`` the
            prefix of the package, ``{zero}``, ``{one}``, ``{two}`` are literals.
        level: binding strength of the text.
        needs: binding strength that each operand must have, else it is put in parentheses.
        conditions: the operands that are read as conditions.
        is_condition: whether the text is a condition; its value is then 1 or 0.
        helper: name of the function of the package that it calls, if any.
    """

    template: str
    level: Level = Level.ATOM
    needs: tuple[Level, ...] = (Level.SELECTION, Level.SELECTION)
    conditions: tuple[int, ...] = ()
    is_condition: bool = False
    helper: str = ""

    def uses(self, operand: int) -> int:
        """How often the text contains the operand."""
        return len(re.findall(rf"\{{{operand}\}}", self.template))


def _call(name: str) -> Form:
    """A function of math.h with one or two arguments."""
    return Form(f"{name}{{f}}({{0}})")


def _call2(name: str) -> Form:
    return Form(f"{name}{{f}}({{0}}, {{1}})")


def _comparison(operator: str) -> Form:
    return Form(f"{{0}} {operator} {{1}}", Level.COMPARISON, (Level.SUM, Level.SUM), is_condition=True)


_ATOM = Level.ATOM

#: Every operation of the tape except those that only pass an operand on (:data:`PASSING`).
FORMS: Final[dict[str, Form]] = {
    "add": Form("{0} + {1}", Level.SUM, (Level.SUM, Level.PRODUCT)),
    "sub": Form("{0} - {1}", Level.SUM, (Level.SUM, Level.PRODUCT)),
    "mul": Form("{0} * {1}", Level.PRODUCT, (Level.PRODUCT, Level.SIGN)),
    "div": Form("{0} / {1}", Level.PRODUCT, (Level.PRODUCT, Level.SIGN)),
    "neg": Form("-{0}", Level.SIGN, (_ATOM,)),
    "inv": Form("{one} / {0}", Level.PRODUCT, (Level.SIGN,)),
    "sq": Form("{0} * {0}", Level.PRODUCT, (_ATOM,)),
    "twice": Form("{two} * {0}", Level.PRODUCT, (Level.SIGN,)),
    "exp": _call("exp"),
    "expm1": _call("expm1"),
    "log": _call("log"),
    "log1p": _call("log1p"),
    "pow": _call2("pow"),
    "sqrt": _call("sqrt"),
    "hypot": _call2("hypot"),
    "sin": _call("sin"),
    "cos": _call("cos"),
    "tan": _call("tan"),
    "asin": _call("asin"),
    "acos": _call("acos"),
    "atan": _call("atan"),
    "atan2": _call2("atan2"),
    "sinh": _call("sinh"),
    "cosh": Form("{p}_cosh({0})", helper="cosh"),
    "tanh": Form("{p}_tanh({0})", helper="tanh"),
    "asinh": _call("asinh"),
    "acosh": _call("acosh"),
    "atanh": _call("atanh"),
    "erf": _call("erf"),
    "erfinv": Form("{p}_erfinv({0})", helper="erfinv"),
    "lt": _comparison("<"),
    "le": _comparison("<="),
    "eq": _comparison("=="),
    "ne": _comparison("!="),
    "not_": Form("!{0}", Level.SIGN, (_ATOM,), conditions=(0,), is_condition=True),
    "and_": Form("{0} && {1}", Level.LOGIC, (_ATOM, _ATOM), conditions=(0, 1), is_condition=True),
    "or_": Form("{0} || {1}", Level.LOGIC, (_ATOM, _ATOM), conditions=(0, 1), is_condition=True),
    "if_else_zero": Form("{0} ? {1} : {zero}", Level.SELECTION, (_ATOM, Level.SUM), conditions=(0,)),
    "floor": _call("floor"),
    "ceil": _call("ceil"),
    "fmod": _call2("fmod"),
    "remainder": _call2("remainder"),
    "fabs": _call("fabs"),
    "sign": Form("({0} > {zero}) ? {one} : (({0} < {zero}) ? -{one} : {0})", Level.SELECTION, (_ATOM,)),
    "copysign": _call2("copysign"),
    "fmin": _call2("fmin"),
    "fmax": _call2("fmax"),
}

#: fmin and fmax with a literal as {1}: the same values, NaN included, without a call.
_FORMS: Final = FORMS | {
    "least": Form("({0} < {1}) ? {0} : {1}", Level.SELECTION, (Level.SUM, Level.SUM)),
    "largest": Form("({0} > {1}) ? {0} : {1}", Level.SELECTION, (Level.SUM, Level.SUM)),
    "limit": Form("{p}_limit({0}, {1})", helper="limit"),  # largest of -{1} and the least of {0} and {1}
}

#: Operations that call a function of the math library; those that compilers have an instruction for are left out.
LIBRARY: Final = frozenset(
    name
    for name, form in FORMS.items()
    if "{f}(" in form.template and name not in ("fabs", "sqrt", "copysign", "fmin", "fmax")
)

#: Operations whose value is their first operand.
PASSING: Final = ("assign", "assign_first")

_OPPOSITE: Final = {"add": "sub", "sub": "add"}
_WITH_LITERAL: Final = {"fmin": "least", "fmax": "largest"}


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """A value: a literal, a text given from outside (``input->q``) or an operation on other nodes.

    Compared by identity; :class:`Graph` makes equal values one node.
    """

    operation: str
    operands: tuple[Node, ...] = ()
    text: str = ""
    value: Fraction | None = None


class Graph:
    """The algebra that collects nodes. Its operations are the keys of :data:`FORMS` and :data:`PASSING`."""

    def __init__(self) -> None:
        self._nodes: dict[object, Node] = {}

    def const(self, value: Fraction) -> Node:
        """A literal."""
        return self._unique(("const", value), Node("const", value=value))

    def name(self, text: str) -> Node:
        """A value that the C code knows as ``text``, a primary expression."""
        return self._unique(("name", text), Node("name", text=text))

    def __getattr__(self, operation: str) -> Callable[..., Node]:
        """The constructor of an operation's node; AttributeError for an operation without a C form."""
        if operation in PASSING:
            return lambda first, *_: first
        if operation not in FORMS:
            raise AttributeError(operation)

        return lambda *operands: self._operation(operation, operands)

    def _operation(self, operation: str, operands: tuple[Node, ...]) -> Node:
        if operation in _OPPOSITE and operands[1].value is not None and operands[1].value < 0:
            # a + (-2) is a - 2, bit for bit
            operation, operands = _OPPOSITE[operation], (operands[0], self.const(-operands[1].value))
        if operation in _WITH_LITERAL and any(operand.value is not None for operand in operands):
            first, last = sorted(operands, key=lambda operand: operand.value is not None)
            operation, operands = _WITH_LITERAL[operation], (first, last)
        if operation == "largest" and operands[0].operation == "least":
            inner, bound = operands[0].operands
            if bound.value is not None and operands[1].value == -bound.value < 0:
                operation, operands = "limit", (inner, bound)
        return self._unique((operation, *map(id, operands)), Node(operation, operands))

    def _unique(self, key: object, node: Node) -> Node:
        return self._nodes.setdefault(key, node)

    def reachable(self, roots: Iterable[Node]) -> list[Node]:
        """The nodes that the roots need, operands first."""
        wanted: set[int] = set()
        stack = list(roots)
        while stack:
            node = stack.pop()
            if id(node) not in wanted:
                wanted.add(id(node))
                stack.extend(node.operands)
        return [node for node in self._nodes.values() if id(node) in wanted]


@dataclass(frozen=True)
class Statement:
    """``const <real> <name> = <expression>;``."""

    name: str
    expression: str


@dataclass(frozen=True)
class _Text:
    """A printed value, and the same as a condition if it is one."""

    text: str
    level: Level
    condition: str | None = None
    condition_level: Level = Level.ATOM

    def at(self, level: Level) -> str:
        return self.text if self.level >= level else f"({self.text})"

    def condition_at(self, level: Level, zero: str) -> str:
        text, own = self.condition, self.condition_level
        if text is None:
            text, own = f"{self.at(Level.SUM)} != {zero}", Level.COMPARISON
        return text if own >= level else f"({text})"


class Printer:
    """Prints the nodes of one function, in one or several stages.

    ``roots`` are all nodes that any stage will ask for: how often a value is used decides where it is written. Those of
    ``named`` get a variable in any case.
    """

    def __init__(
        self, graph: Graph, precision: Precision, prefix: str, roots: Sequence[Node], named: Iterable[Node] = ()
    ) -> None:
        self._graph = graph
        self._precision = precision
        self._words = {
            "f": "f" if precision == "float" else "",
            "p": prefix,
            "zero": self._literal(Fraction(0)),
            "one": self._literal(Fraction(1)),
            "two": self._literal(Fraction(2)),
        }
        nodes = graph.reachable(roots)
        self._roots = frozenset(id(root) for root in roots)
        self._named = frozenset(id(node) for node in named)
        self._uses = Counter(id(root) for root in roots)
        for node in nodes:
            for k, operand in enumerate(node.operands):
                self._uses[id(operand)] += _FORMS[node.operation].uses(k)
        self._printed: dict[int, _Text] = {}
        self._names = 0
        #: Functions of the package that the printed code calls.
        self.helpers = frozenset(_FORMS[n.operation].helper for n in nodes if n.operation in _FORMS) - {""}

    def stage(self, roots: Sequence[Node]) -> tuple[tuple[Statement, ...], tuple[str, ...]]:
        """The statements that compute what ``roots`` need and is not computed yet, and the text of each root."""
        statements: list[Statement] = []
        for node in self._graph.reachable(roots):
            if id(node) in self._printed:
                continue
            text = self._text(node)
            if node.operands and not self._is_inlined(node, text):
                statements.append(Statement(f"v{self._names}", text.text))
                text = _Text(f"v{self._names}", Level.ATOM)
                self._names += 1
            self._printed[id(node)] = text
        return tuple(statements), tuple(self._printed[id(root)].text for root in roots)

    def _is_inlined(self, node: Node, text: _Text) -> bool:
        if id(node) in self._named:
            return False
        return self._uses[id(node)] == 1 and (len(text.text) <= INLINE_LENGTH or id(node) in self._roots)

    def _text(self, node: Node) -> _Text:
        if node.value is not None:
            text = self._literal(node.value)
            return _Text(text, Level.SIGN if text.startswith("-") else Level.ATOM)
        if node.operation == "name":
            return _Text(node.text, Level.ATOM)
        form = _FORMS[node.operation]
        operands = [self._printed[id(operand)] for operand in node.operands]
        texts = [
            operand.condition_at(form.needs[k], self._words["zero"])
            if k in form.conditions
            else operand.at(form.needs[k])
            for k, operand in enumerate(operands)
        ]
        text = form.template.format(*texts, **self._words)
        if not form.is_condition:
            return _Text(text, form.level)
        selected = text if form.level == Level.ATOM else f"({text})"
        real = f"{selected} ? {self._words['one']} : {self._words['zero']}"
        return _Text(real, Level.SELECTION, text, form.level)

    def _literal(self, value: Fraction) -> str:
        return literal(nearest(value, self._precision))
