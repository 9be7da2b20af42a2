"""Formulas as numbered lines of text."""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from flint import fmpq

from pbcgen.symbolic.plain.outcomes import Malformed, require
from pbcgen.symbolic.plain.values import apply

#: Instructions whose operand is a number or the position of an input.
_LEAVES = {"constant", "state", "input", "parameter", "measured", "setting", "solved"}
#: Operations whose values are 0 or 1; and of how many operands, from the first, others need that these are so.
_TRUTHS = {"lt", "le", "eq", "ne", "not_", "and_", "or_"}
_ASKING = {"not_": 1, "and_": 2, "or_": 2, "if_else_zero": 1}

#: What makes a value of a number; a sequence for each operation that reads one; values of instructions.
Lift = Callable[[fmpq], Any]
Inputs = Mapping[str, Any]
Known = Mapping[int, Any] | None


@lru_cache(1024)
def rational(text: str) -> fmpq:
    """An exact number written as ``-3``, ``2/7``, ``1.5`` or ``2e-70``."""
    top, _, bottom = text.partition("/")
    mantissa, _, exponent = top.partition("e")
    whole, _, decimals = mantissa.partition(".")
    return fmpq(int(whole + decimals), int(bottom or 1)) * fmpq(10) ** (int(exponent or 0) - len(decimals))


def combination(weights: Mapping[str, str], values: Sequence[Any]) -> Any:
    """The sum of some values with weights, which are given by the places of these values."""
    return sum((values[int(k)] * rational(c) for k, c in weights.items()), fmpq(0))


@dataclass(frozen=True)
class Formulas:
    """Numbered instructions, each naming earlier ones, and named matrices of their results."""

    instructions: list[list[str]]
    outputs: dict[str, tuple[int, int, dict[tuple[int, int], int]]]

    @staticmethod
    def parse(lines: Sequence[str]) -> Formulas:
        """Indented lines: ``number operation operands``. Others: ``name ROWSxCOLUMNS row,column:number ...``."""
        formulas = Formulas([], {})
        for line in lines:
            if line.startswith(" "):
                number, *instruction = line.split()
                negative = instruction[0] != "constant" and any(o.startswith("-") for o in instruction[1:])
                ordered = not negative and int(number) == len(formulas.instructions)
                require(ordered, "the instructions are not numbered in order", Malformed)
                asked = {formulas.instructions[int(o)][0] for o in instruction[1 : 1 + _ASKING.get(instruction[0], 0)]}
                require(asked <= _TRUTHS, "a condition is neither true nor false", Malformed)
                formulas.instructions.append(instruction)
            elif match := re.fullmatch(r"(.+) (\d+)x(\d+)((?: \d+,\d+:\d+)*)", line):
                places = re.findall(r"(\d+),(\d+):(\d+)", match[4])
                entries = {(int(i), int(j)): int(at) for i, j, at in places}
                formulas.outputs[match[1]] = (int(match[2]), int(match[3]), entries)
        return formulas

    def walk(self, lift: Lift, inputs: Inputs, known: Known = None, wanted: Iterable[int] | None = None) -> list[Any]:
        """The value of every instruction; ``inputs`` has a sequence for each operation that reads one.

        With ``wanted`` only of what these instructions need, where some are ``known``; the others are None.
        """
        values: list[Any] = []
        known, needed = known or {}, None if wanted is None else self.needed(wanted, known or {})
        for k, (name, *operands) in enumerate(self.instructions):
            if k in known:
                values.append(known[k])
            elif needed is not None and k not in needed:
                values.append(None)
            elif name == "constant":
                values.append(lift(rational(operands[0])))
            elif name in inputs:
                values.append(inputs[name][int(operands[0])])
            else:
                values.append(apply(name, *[values[int(o)] for o in operands]))
        return values

    def needed(self, wanted: Iterable[int], known: Container[int] = ()) -> set[int]:
        """The instructions that some of them need, apart from what is known."""
        needed = {*wanted}
        for k in range(max(needed, default=-1), -1, -1):
            if k in needed and k not in known and self.instructions[k][0] not in _LEAVES:
                needed |= {int(o) for o in self.instructions[k][1:]}
        return needed

    def matrix(self, name: str, values: Sequence[Any]) -> list[list[Any]]:
        """An output as rows, from the values of the instructions; structural zeros are exact."""
        rows, columns, entries = self.outputs[name]
        return [[values[entries[i, j]] if (i, j) in entries else fmpq(0) for j in range(columns)] for i in range(rows)]

    def column(self, name: str, values: Sequence[Any]) -> list[Any]:
        """The first column of an output."""
        return [row[0] for row in self.matrix(name, values)]
