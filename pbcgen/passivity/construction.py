"""What holds of a mechanical system by the way it was written, without expanding anything.

The front end :class:`pbcgen.models.mechanical.Mechanical` writes ``f = F e`` with ``e`` the gradient of
``H = p^T v / 2 + V``, ``v = M^-1 p``, by formulas that are right for every symmetric M. Here the same formulas are
written again from the parts, and the two must be the same instructions, up to the order of factors and summands. That
takes a time linear in the size of the formulas, where the expansion of M^-1 into rational functions may take hours.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache

import casadi as ca

from pbcgen.errors import UnsupportedOperation
from pbcgen.models.affine import AffineSystem, Mechanics
from pbcgen.models.mechanical import energy_slope
from pbcgen.symbolic.exact_walk import evaluate
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, is_finite, precision, rational, reals, sign
from pbcgen.symbolic.tape import Operation, Tape

#: Places of states in their domains, without special meaning.
WEIGHTS = (Fraction(3, 7), Fraction(5, 11), Fraction(2, 9), Fraction(7, 13), Fraction(4, 17))
_POINTS = 3
#: Of a difference quotient; its square is far below the last digit of a double.
_STEP = rational(Fraction(1, 2**100))


def gradient_by_construction(system: AffineSystem) -> bool:
    """Whether ``energy_gradient`` is grad S because S = p^T M^-1 p / 2 + V, M is symmetric and it is written so."""
    mechanics = system.mechanical
    if mechanics is None:
        return False
    storage = ca.dot(mechanics.p, mechanics.velocity) / 2 + mechanics.V
    for inertia in (mechanics.M, None):
        velocity, gradient = energy_slope(mechanics.q, mechanics.p, mechanics.V, inertia, mechanics.M_inv)
        written = ca.vertcat(system.S, mechanics.velocity, mechanics.energy_gradient)
        if same_formulas(system, written, ca.vertcat(storage, velocity, gradient)):
            given = mechanics.M_inv if inertia is None else inertia
            return _symmetric(system, given) and not _rounded(system, mechanics)
    return False


@lru_cache(maxsize=2)
def drift_by_construction(system: AffineSystem) -> bool:
    """Whether f is written as F times ``energy_gradient``."""
    mechanics, structure = system.mechanical, system.structure
    if mechanics is None or structure is None or structure.F is None:
        return False
    return same_formulas(system, system.f, ca.mtimes(structure.F, mechanics.energy_gradient))


def _tape(system: AffineSystem, *outputs: ca.SX) -> Tape:
    return Tape.of([system.x, system.u, ca.SX(system.parameters.symbols)], outputs)


def same_formulas(system: AffineSystem, left: ca.SX, right: ca.SX) -> bool:
    """Whether two matrices are computed by the same instructions, up to the order of factors and summands."""
    if left.shape != right.shape:
        return False
    a, b = _numbered(_tape(system, left, right))
    return a == b


def _numbered(tape: Tape) -> list[dict[tuple[int, int], int]]:
    """The entries of the outputs as numbers: equal ones are computed alike, up to the order of factors and summands."""
    known: dict[object, int] = {}
    number: list[int] = []
    for instruction in tape.instructions:
        key: object = instruction
        if isinstance(instruction, Operation):
            operands = [number[o] for o in instruction.operands]
            key = instruction.name, *(sorted(operands) if instruction.name in ("add", "mul") else operands)
        number.append(known.setdefault(key, len(known)))
    return [{at: number[k] for at, k in output.entries.items()} for output in tape.outputs]


def _symmetric(system: AffineSystem, matrix: ca.SX) -> bool:
    """Whether a matrix is symmetric: as written, or as exact functions."""
    (numbers,) = _numbered(_tape(system, matrix))
    if all(numbers.get((j, i)) == k for (i, j), k in numbers.items()):
        return True
    names = (*system.state_names, *system.input_names, *system.parameters.names)
    try:
        field, (skew,) = evaluate(_tape(system, matrix - matrix.T), names)
    except (UnsupportedOperation, ZeroDivisionError):
        return False
    return all(entry.is_zero() for row in skew.dense(field.const(0)) for entry in row)


def _rounded(system: AffineSystem, mechanics: Mechanics) -> bool:
    """Whether CasADi has rounded a constant on the way: then the formulas differ, at points in general position."""
    difference = mechanics.energy_gradient - ca.gradient(system.S, system.x)
    tape = _tape(system, difference)
    seen = False
    for shift in range(_POINTS):
        point = [general_position(system, k, shift) for k in range(system.n)]
        parameters = reals([system.parameters.values[name] for name in system.parameters.names])
        with precision(BITS):
            values = tape.walk(REAL, [point, [ZERO] * system.m, parameters])[0].column(ZERO)
        if all(is_finite(v) for v in values):
            seen = True
            if any(sign(v) in (1, -1) for v in values):
                return True
    return not seen


def derivative_is_rounded(system: AffineSystem) -> bool:
    """Whether CasADi's derivative of S holds a number that is rounded, as 2/sqrt(pi) in that of erf.

    S itself is compared with it, along a line through a point in general position and to many more digits than a double
    has; what is not defined there is not judged.
    """
    tape = _tape(system, system.S, ca.gradient(system.S, system.x))
    parameters = reals([system.parameters.values[name] for name in system.parameters.names])
    x = [general_position(system, k) for k in range(system.n)]
    d = [general_position(system, k, 1) - general_position(system, k, 2) for k in range(system.n)]
    with precision(BITS):
        walks = [
            tape.walk(REAL, [[a + s * b for a, b in zip(x, d, strict=True)], [ZERO] * system.m, parameters])
            for s in (_STEP, -_STEP, ZERO)
        ]
        above, below = (walk[0].scalar(ZERO) for walk in walks[:2])
        parts = [a * b for a, b in zip(walks[2][1].column(ZERO), d, strict=True)]
        gap, size = (above - below) / (2 * _STEP) - sum(parts, ZERO), sum(map(abs, parts), ZERO)
        return is_finite(gap) and is_finite(size) and sign(abs(gap) - size * _STEP) == 1


def general_position(system: AffineSystem, k: int, shift: int = 0) -> Real:
    """A number for state k without special meaning, inside the domain."""
    lo, hi = system.domain.get(system.state_names[k], (None, None))
    low = lo if lo is not None else (hi - 1 if hi is not None else Fraction(0))
    high = hi if hi is not None else low + 1
    return rational(low + (high - low) * WEIGHTS[(k + shift) % len(WEIGHTS)])
