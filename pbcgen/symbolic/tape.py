"""The instruction tape of a CasADi SX function, in static single assignment form.

CasADi stores an SX function as a list of scalar instructions on reusable registers. :class:`Tape` renames the
registers so that every value is written once, reads the constants as exact rationals, and can then be walked
with any :class:`Algebra`: exact rationals, balls, NumPy arrays, SymPy expressions, C text.

Shared subexpressions stay shared: walking is linear in the number of instructions, where an expression tree may
be exponentially larger.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import accumulate
from typing import Any, Generic, Protocol, TypeVar

import casadi as ca

from pbcgen.errors import ModelError, UnsupportedOperation

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

#: Scalar operations of SX, by CasADi operation code: (name, number of operands). The name is the method that
#: an :class:`Algebra` provides. Operations with the same meaning share a name.
OPERATIONS: Mapping[int, tuple[str, int]] = {
    ca.OP_ASSIGN: ("assign", 1),
    ca.OP_ADD: ("add", 2),
    ca.OP_SUB: ("sub", 2),
    ca.OP_MUL: ("mul", 2),
    ca.OP_DIV: ("div", 2),
    ca.OP_NEG: ("neg", 1),
    ca.OP_EXP: ("exp", 1),
    ca.OP_LOG: ("log", 1),
    ca.OP_POW: ("pow", 2),
    ca.OP_CONSTPOW: ("pow", 2),
    ca.OP_SQRT: ("sqrt", 1),
    ca.OP_SQ: ("sq", 1),
    ca.OP_TWICE: ("twice", 1),
    ca.OP_SIN: ("sin", 1),
    ca.OP_COS: ("cos", 1),
    ca.OP_TAN: ("tan", 1),
    ca.OP_ASIN: ("asin", 1),
    ca.OP_ACOS: ("acos", 1),
    ca.OP_ATAN: ("atan", 1),
    ca.OP_LT: ("lt", 2),
    ca.OP_LE: ("le", 2),
    ca.OP_EQ: ("eq", 2),
    ca.OP_NE: ("ne", 2),
    ca.OP_NOT: ("not_", 1),
    ca.OP_AND: ("and_", 2),
    ca.OP_OR: ("or_", 2),
    ca.OP_FLOOR: ("floor", 1),
    ca.OP_CEIL: ("ceil", 1),
    ca.OP_FMOD: ("fmod", 2),
    ca.OP_REMAINDER: ("remainder", 2),
    ca.OP_FABS: ("fabs", 1),
    ca.OP_SIGN: ("sign", 1),
    ca.OP_COPYSIGN: ("copysign", 2),
    ca.OP_IF_ELSE_ZERO: ("if_else_zero", 2),
    ca.OP_ERF: ("erf", 1),
    ca.OP_ERFINV: ("erfinv", 1),
    ca.OP_FMIN: ("fmin", 2),
    ca.OP_FMAX: ("fmax", 2),
    ca.OP_INV: ("inv", 1),
    ca.OP_SINH: ("sinh", 1),
    ca.OP_COSH: ("cosh", 1),
    ca.OP_TANH: ("tanh", 1),
    ca.OP_ASINH: ("asinh", 1),
    ca.OP_ACOSH: ("acosh", 1),
    ca.OP_ATANH: ("atanh", 1),
    ca.OP_ATAN2: ("atan2", 2),
    ca.OP_LOG1P: ("log1p", 1),
    ca.OP_EXPM1: ("expm1", 1),
    ca.OP_HYPOT: ("hypot", 2),
    ca.OP_LIFT: ("assign_first", 2),
    ca.OP_PRINTME: ("assign_first", 2),
}

#: Operations that are defined and smooth for all operands.
_ENTIRE = frozenset(
    {"assign", "add", "sub", "mul", "neg", "twice", "sq", "sin", "cos"}
    | {"sinh", "cosh", "exp", "expm1", "tanh", "atan", "asinh", "erf"}
)

#: Operations whose values may jump; CasADi's derivatives do not show it.
_JUMPING = frozenset(
    {"floor", "ceil", "fmod", "remainder", "sign", "copysign", "atan2"}
    | {"lt", "le", "eq", "ne", "not_", "and_", "or_", "if_else_zero"}
)

#: Operations whose values are 0 or 1; and of how many operands, from the first, others ask whether they are zero.
_TRUTHS = frozenset({"lt", "le", "eq", "ne", "not_", "and_", "or_"})
_ASKING = {"not_": 1, "and_": 2, "or_": 2, "if_else_zero": 1}

_NAME_OF_CODE = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}


@dataclass(frozen=True, slots=True)
class Constant:
    """A literal of the graph, read as the shortest decimal that denotes the stored double (0.1 is 1/10)."""

    value: Fraction


@dataclass(frozen=True, slots=True)
class Input:
    """Nonzero number ``index`` of input number ``argument``."""

    argument: int
    index: int


@dataclass(frozen=True, slots=True)
class Operation:
    """``name`` applied to earlier values of the tape, given by their positions."""

    name: str
    operands: tuple[int, ...]


Instruction = Constant | Input | Operation


class Algebra(Protocol[T_co]):
    """What a tape is walked with: a meaning for constants, and a method named like each operation."""

    def const(self, value: Fraction) -> T_co:
        """The meaning of a literal."""
        ...


@dataclass(frozen=True)
class Matrix(Generic[T]):
    """A sparse matrix of values: the result of walking one output."""

    shape: tuple[int, int]
    entries: Mapping[tuple[int, int], T]

    def dense(self, zero: T) -> list[list[T]]:
        """Rows, with ``zero`` at the structural zeros."""
        rows, columns = self.shape
        return [[self.entries.get((i, j), zero) for j in range(columns)] for i in range(rows)]

    def rows(self) -> list[dict[int, T]]:
        """The entries by row and column, without the structural zeros."""
        found: list[dict[int, T]] = [{} for _ in range(self.shape[0])]
        for (i, j), entry in sorted(self.entries.items(), key=lambda item: item[0]):
            found[i][j] = entry
        return found

    def columns(self) -> list[dict[int, T]]:
        """The entries by column and row, without the structural zeros."""
        found: list[dict[int, T]] = [{} for _ in range(self.shape[1])]
        for (i, j), entry in sorted(self.entries.items(), key=lambda item: item[0]):
            found[j][i] = entry
        return found

    def column(self, zero: T) -> list[T]:
        """The entries of a one-column matrix (ValueError for other shapes)."""
        if self.shape[1] != 1:
            raise ValueError(f"a column was expected, the shape is {self.shape}")
        return [self.entries.get((i, 0), zero) for i in range(self.shape[0])]

    def scalar(self, zero: T) -> T:
        """The only entry of a 1x1 matrix (ValueError for other shapes)."""
        if self.shape != (1, 1):
            raise ValueError(f"a scalar was expected, the shape is {self.shape}")
        return self.entries.get((0, 0), zero)


@dataclass(frozen=True)
class Tape:
    """An SX function as a list of instructions, each naming earlier ones.

    ``outputs[k]`` maps (row, column) to the position of the instruction that computes this entry.
    """

    instructions: tuple[Instruction, ...]
    input_sizes: tuple[int, ...]
    outputs: tuple[Matrix[int], ...]

    @staticmethod
    def of(inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> Tape:
        """The tape of ``outputs`` as functions of the symbols ``inputs``; equal subexpressions are computed once.

        Raises ModelError if an output depends on a symbol that is not among the inputs.
        """
        inputs = [ca.densify(ca.vec(symbol)) for symbol in inputs]
        shared = [ca.sparsify(o) for o in _share([ca.sparsify(ca.SX(output)) for output in outputs])]
        names = [f"i{k}" for k in range(len(inputs))]
        results = [f"o{k}" for k in range(len(shared))]
        function = ca.Function("tape", inputs, shared, names, results, {"allow_free": True})
        if function.has_free():
            free = ", ".join(f"`{name}`" for name in function.get_free())
            raise ModelError(f"the symbols {free} have no meaning here: declare them as states, inputs or parameters")
        return Tape.of_function(function)

    @staticmethod
    def of_function(function: ca.Function) -> Tape:
        """The tape of an SX function. Raises UnsupportedOperation for an instruction that is not scalar SX."""
        if not function.is_a("SXFunction"):
            raise UnsupportedOperation(f"`{function.name()}` is not an SX function: build it from SX expressions")
        positions = [list(zip(*function.sparsity_out(k).get_triplet(), strict=True)) for k in range(function.n_out())]
        entries: list[dict[tuple[int, int], int]] = [{} for _ in positions]
        register: dict[int, int] = {}
        instructions: list[Instruction] = []

        def asked(position: int) -> int:
            """What is 0 or 1 in place of a condition: a number that is compared with zero jumps where it is zero."""
            instruction = instructions[position]
            if isinstance(instruction, Operation) and instruction.name in _TRUTHS:
                return position
            instructions.extend((Constant(Fraction(0)), Operation("ne", (position, len(instructions)))))
            return len(instructions) - 1

        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            operands = function.instruction_input(k)
            if code == ca.OP_OUTPUT:
                output, nonzero = function.instruction_output(k)
                entries[output][positions[output][nonzero]] = register[operands[0]]
                continue
            if code == ca.OP_CONST:
                number = function.instruction_constant(k)
                if not math.isfinite(number):
                    raise UnsupportedOperation("a formula that was derived is not defined at the numbers put into it")
                instruction: Instruction = Constant(exact_decimal(number))
            elif code == ca.OP_INPUT:
                instruction = Input(operands[0], operands[1])
            elif code in OPERATIONS:
                name, arity = OPERATIONS[code]
                places = [register[o] for o in operands[:arity]]
                conditions = _ASKING.get(name, 0)
                instruction = Operation(name, (*map(asked, places[:conditions]), *places[conditions:]))
            else:
                raise UnsupportedOperation(f"the SX operation {_NAME_OF_CODE.get(code, code)} is not supported")
            register[function.instruction_output(k)[0]] = len(instructions)
            instructions.append(instruction)
        return Tape(
            tuple(instructions),
            tuple(function.nnz_in(k) for k in range(function.n_in())),
            tuple(Matrix((function.size1_out(k), function.size2_out(k)), entries[k]) for k in range(function.n_out())),
        )

    def walk(self, algebra: Algebra[T], inputs: Sequence[Sequence[T]]) -> list[Matrix[T]]:
        """The outputs, computed in ``algebra`` from the values ``inputs``.

        Raises UnsupportedOperation if the algebra has no method for an operation that occurs.
        """
        if tuple(len(argument) for argument in inputs) != self.input_sizes:
            raise ValueError(f"inputs of sizes {self.input_sizes} were expected")
        values: list[Any] = []
        methods: dict[str, Any] = {}
        for name, first, second, spent in self._program:
            if name == "const":
                values.append(algebra.const(first))
            elif name == "input":
                values.append(inputs[first][second])
            else:
                method = methods.get(name) or methods.setdefault(name, _method(algebra, name))
                values.append(method(values[first]) if second is None else method(values[first], values[second]))
            for position in spent:
                values[position] = None
        return [Matrix(m.shape, {at: values[v] for at, v in m.entries.items()}) for m in self.outputs]

    def given(self, algebra: Algebra[T], known: Mapping[int, Sequence[T]]) -> tuple[Tape, list[T]]:
        """The tape with what depends on some inputs alone as one input more, in place of them, and its values.

        Args:
            algebra: in which these values are computed.
            known: the values of inputs by their numbers; they are empty in the tape.
        """
        fixed: list[bool] = []
        for instruction in self.instructions:
            match instruction:
                case Constant():
                    fixed.append(True)
                case Input(argument, _):
                    fixed.append(argument in known)
                case Operation(_, operands):
                    fixed.append(all(fixed[o] for o in operands))
        used = {
            o for k, i in enumerate(self.instructions) if isinstance(i, Operation) and not fixed[k] for o in i.operands
        }
        used |= {v for matrix in self.outputs for v in matrix.entries.values()}
        kept = [k for k in range(len(fixed)) if not fixed[k] or k in used]
        place, held = {k: new for new, k in enumerate(kept)}, [k for k in kept if fixed[k]]
        instructions: list[Instruction] = []
        for k in kept:
            instruction = self.instructions[k]
            if fixed[k]:
                instructions.append(Input(len(self.input_sizes), held.index(k)))
            elif isinstance(instruction, Operation):
                instructions.append(Operation(instruction.name, tuple(place[o] for o in instruction.operands)))
            else:
                instructions.append(instruction)
        inputs = [[*known.get(k, [algebra.const(Fraction(0))] * size)] for k, size in enumerate(self.input_sizes)]
        column = Matrix((len(held), 1), {(row, 0): k for row, k in enumerate(held)})
        values = [*Tape(self.instructions, self.input_sizes, (column,)).walk(algebra, inputs)[0].entries.values()]
        sizes = (*(0 if k in known else size for k, size in enumerate(self.input_sizes)), len(held))
        outputs = tuple(Matrix(m.shape, {at: place[v] for at, v in m.entries.items()}) for m in self.outputs)
        return Tape(tuple(instructions), sizes, outputs), values

    @cached_property
    def _program(self) -> tuple[tuple[str, Any, Any, tuple[int, ...]], ...]:
        """The instructions as :meth:`walk` reads them: what to do, with what, and the values that are spent then."""
        steps: list[tuple[str, Any, Any]] = []
        for instruction in self.instructions:
            match instruction:
                case Constant(value):
                    steps.append(("const", value, None))
                case Input(argument, index):
                    steps.append(("input", argument, index))
                case Operation(name, operands):
                    steps.append((name, operands[0], operands[1] if len(operands) > 1 else None))
        return tuple((*step, spent) for step, spent in zip(steps, self._spent(), strict=True))

    def is_entire(self) -> bool:
        """Whether nothing occurs but what is defined and smooth for all arguments: no quotients, roots or switches."""
        return all(i.name in _ENTIRE or self._by_number(i) for i in self.instructions if isinstance(i, Operation))

    def jumps(self) -> str:
        """The first operation that occurs whose value may jump, or the empty text."""
        names = (i.name for i in self.instructions if isinstance(i, Operation))
        return next((name.rstrip("_") for name in names if name in _JUMPING), "")

    def _by_number(self, operation: Operation) -> bool:
        """Whether this is a division by a number."""
        if operation.name != "div":
            return False
        divisor = self.instructions[operation.operands[1]]
        return isinstance(divisor, Constant) and divisor.value != 0

    def _spent(self) -> tuple[tuple[int, ...], ...]:
        """For each instruction the values that nothing after it needs: the partial sums of a long sum are as long."""
        last: dict[int, int] = {}
        for k, instruction in enumerate(self.instructions):
            last.update(dict.fromkeys(instruction.operands if isinstance(instruction, Operation) else (), k))
        last.update({v: len(self.instructions) for matrix in self.outputs for v in matrix.entries.values()})
        spent: list[list[int]] = [[] for _ in self.instructions]
        for position, k in last.items():
            if k < len(spent):
                spent[k].append(position)
        return tuple(map(tuple, spent))

    def uses(self, name: str) -> bool:
        """Whether the operation ``name`` occurs."""
        return any(isinstance(i, Operation) and i.name == name for i in self.instructions)


def _method(algebra: Algebra[Any], name: str) -> Any:
    """What an operation means. Raises UnsupportedOperation if that is nothing."""
    method = getattr(algebra, name, None)
    if method is None:
        where = getattr(algebra, "title", type(algebra).__name__)
        raise UnsupportedOperation(f"the operation `{name.rstrip('_')}` has no meaning in {where}")
    return method


def exact_decimal(value: float) -> Fraction:
    """The shortest decimal that denotes ``value`` as a fraction. Raises ModelError for NaN and infinity."""
    if not math.isfinite(value):
        raise ModelError(f"the model contains the constant {value}: every constant must be a finite number")
    return Fraction(repr(float(value)))


def _share(outputs: Sequence[ca.SX]) -> list[ca.SX]:
    """The expressions with equal subexpressions made one; CasADi's rewriting keeps the values unchanged."""
    ends = [0, *accumulate(output.nnz() for output in outputs)]
    if not ends[-1]:
        return [*outputs]
    nonzeros = ca.vertsplit(ca.cse(ca.vertcat(*[ca.vec(output).nz[:] for output in outputs if output.nnz()])), ends)
    return [ca.SX(output.sparsity(), block) for output, block in zip(outputs, nonzeros, strict=True)]
