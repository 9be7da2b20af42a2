"""Formulas as numbered lines of text, each operation once: the form in which certificates keep them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction

import casadi as ca
from flint import fmpq_mpoly

from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.real import fraction
from pbcgen.symbolic.tape import Constant, Input, Tape


class Writing:
    """Instructions that are written once, and named outputs."""

    def __init__(self) -> None:
        self._instructions: list[str] = []
        self._place: dict[str, int] = {}
        self._outputs: list[str] = []

    def lines(self) -> list[str]:
        """Indented instructions, then the outputs with their shapes and entries."""
        return [f"  {k} {instruction}" for k, instruction in enumerate(self._instructions)] + self._outputs

    def put(self, instruction: str) -> int:
        """The place of an instruction, which is written if it is new."""
        if instruction not in self._place:
            self._place[instruction] = len(self._instructions)
            self._instructions.append(instruction)
        return self._place[instruction]

    def expressions(
        self,
        inputs: Sequence[ca.SX],
        named: Mapping[str, ca.SX],
        kinds: Sequence[str],
        constants: Mapping[int, Sequence[Fraction]],
    ) -> None:
        """SX expressions of ``inputs`` as outputs; see :meth:`tape`."""
        self.tape(Tape.of(inputs, list(named.values())), list(named), kinds, constants)

    def tape(
        self, tape: Tape, names: Sequence[str], kinds: Sequence[str], constants: Mapping[int, Sequence[Fraction]]
    ) -> None:
        """A tape with named outputs.

        Args:
            tape: the instructions.
            names: of its outputs.
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
        for name, matrix in zip(names, tape.outputs, strict=True):
            entries = " ".join(f"{row},{column}:{place[at]}" for (row, column), at in sorted(matrix.entries.items()))
            self._outputs.append(f"{name} {matrix.shape[0]}x{matrix.shape[1]} {entries}".rstrip())

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
            return self.put(f"state {k}")
        atom = field.atoms[k]
        return self.put(f"{atom.kind} {self.quotient(atom.argument)}")
