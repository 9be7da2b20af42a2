"""Formulas as numbered lines of text, each operation once: the form in which certificates keep them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Any, TypeVar

from flint import fmpq_mpoly

from pbcgen.proof.squares import Square
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.plain.values import Function
from pbcgen.symbolic.real import fraction
from pbcgen.symbolic.tape import Constant, Input, Matrix, Tape

T = TypeVar("T")


class Writing:
    """Instructions that are written once, and named outputs."""

    def __init__(self) -> None:
        self._instructions: list[str] = []
        self._place: dict[str, int] = {}
        self._outputs: list[str] = []
        self._symbols: dict[int, int] = {}

    def first(self, ways: Iterable[Callable[[Writing], T | None]]) -> T | None:
        """What the first way finds that finds something; nothing is written by those that do not."""
        for way in ways:
            trial = copy.deepcopy(self)
            found = way(trial)
            if found is not None:
                self.__dict__.update(trial.__dict__)
                return found
        return None

    def lines(self) -> list[str]:
        """Indented instructions, then the outputs with their shapes and entries."""
        return [f"  {k} {instruction}" for k, instruction in enumerate(self._instructions)] + self._outputs

    def put(self, instruction: str) -> int:
        """The place of an instruction, which is written if it is new."""
        if instruction not in self._place:
            self._place[instruction] = len(self._instructions)
            self._instructions.append(instruction)
        return self._place[instruction]

    def output(self, name: str, shape: tuple[int, int], places: Mapping[tuple[int, int], int]) -> None:
        """Name a matrix of results, by their places."""
        entries = " ".join(f"{row},{column}:{at}" for (row, column), at in sorted(places.items()))
        self._outputs.append(f"{name} {shape[0]}x{shape[1]} {entries}".rstrip())

    def combination(self, weights: Mapping[int, Fraction], kind: str) -> int:
        """The place of ``sum weight * input`` over the inputs of a kind."""
        total = self.put("constant 0") if not weights else -1
        for index, weight in sorted(weights.items()):
            term = self.put(f"{kind} {index}")
            if weight != 1:
                term = self.put(f"mul {self.put(f'constant {weight}')} {term}")
            total = term if total < 0 else self.put(f"add {total} {term}")
        return total

    def tape(self, tape: Tape, kinds: Sequence[str], constants: Mapping[int, Sequence[Fraction]]) -> list[Matrix[int]]:
        """The places of the outputs of a tape.

        Args:
            tape: the instructions.
            kinds: of its inputs, as the word that reads one.
            constants: for an input the values of its last entries, which are written as numbers.
        """
        place: list[int] = []
        for instruction in tape.instructions:
            match instruction:
                case Constant(value):
                    place.append(self.put(f"constant {value}"))
                case Input(argument, index):
                    values = constants.get(argument, ())
                    start = tape.input_sizes[argument] - len(values)
                    known = index >= start
                    place.append(
                        self.put(f"constant {values[index - start]}" if known else f"{kinds[argument]} {index}")
                    )
                case operation:
                    operands = " ".join(str(place[o]) for o in operation.operands)
                    place.append(self.put(f"{operation.name} {operands}"))
        return [Matrix(m.shape, {at: place[k] for at, k in m.entries.items()}) for m in tape.outputs]

    def quotient(self, value: Quotient) -> int:
        """The place of an exact function of the state."""
        top = self._polynomial(value.field, value.numerator)
        if value.is_polynomial() and value.denominator == 1:
            return top
        return self.put(f"div {top} {self._polynomial(value.field, value.denominator)}")

    def _polynomial(self, field: Field, polynomial: fmpq_mpoly) -> int:
        total: int | None = None
        for exponents, coefficient in sorted(polynomial.to_dict().items()):
            term = None if coefficient == 1 and any(exponents) else self.put(f"constant {fraction(coefficient)}")
            for k, exponent in enumerate(exponents):
                for _ in range(int(exponent)):
                    generator = self._generator(field, k)
                    term = generator if term is None else self.put(f"mul {term} {generator}")
            assert term is not None
            total = term if total is None else self.put(f"add {total} {term}")
        return self.put("constant 0") if total is None else total

    def _generator(self, field: Field, k: int) -> int:
        if k < field.symbol_count:
            return self._symbols[k] if k in self._symbols else self.put(f"state {k}")
        atom = field.atoms[k]
        return self.put(f"{atom.kind} {self.quotient(atom.argument)}")

    def squares(self, squares: Sequence[Square], symbols: Mapping[int, Function] | None = None) -> list[list[Any]]:
        """Squares by weight, factors and the places of the vector; ``symbols`` stand for functions."""
        self._symbols = {k: self.function(a) for k, a in (symbols or {}).items()}
        return [
            [
                str(square.weight),
                [factor.written(self.quotient) for factor in square.factors],
                [None if entry.is_zero() else self.quotient(entry) for entry in square.vector],
            ]
            for square in squares
        ]

    def function(self, value: Function) -> int:
        """The place of an exact function of the checker's own reading, in state and input."""
        top = self._plain(value, value.top)
        return top if value.bottom == 1 else self.put(f"div {top} {self._plain(value, value.bottom)}")

    def _plain(self, value: Function, polynomial: fmpq_mpoly) -> int:
        field, total = value.field, None
        atoms = list(field.atoms.items())
        for exponents, coefficient in sorted(polynomial.to_dict().items()):
            term = None if coefficient == 1 and any(exponents) else self.put(f"constant {fraction(coefficient)}")
            for k, exponent in enumerate(exponents):
                for _ in range(int(exponent)):
                    if k >= field.pool:
                        generator = self.put(f"state {k - field.pool}")
                    else:
                        (kind, _, _), argument = atoms[field.pool - 1 - k]
                        generator = self.put(f"{kind} {self.function(argument)}")
                    term = generator if term is None else self.put(f"mul {term} {generator}")
            total = term if total is None else self.put(f"add {total} {term}")
        return self.put("constant 0") if total is None else total
