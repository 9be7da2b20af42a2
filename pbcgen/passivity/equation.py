"""What follows from one equation ``value = 0`` of exact functions: its parts, its factors, what it is linear in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
from flint import fmpq

from pbcgen.passivity.construction import WEIGHTS
from pbcgen.passivity.plant import Plant
from pbcgen.proof.known import ENTIRE_KINDS, SECTOR_KINDS
from pbcgen.proof.nonnegative import nonnegative, positive
from pbcgen.symbolic.display import formula
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, reduce_rows
from pbcgen.symbolic.real import BITS, REAL, ZERO, is_finite, precision, rational, reals, sign
from pbcgen.symbolic.tape import Tape
from pbcgen.symbolic.terms import terms

#: Equations with more terms are not factored.
_MOST_FACTORED = 100

#: Characters of a formula that is shown as such.
_SHORT = 60

Exponents = tuple[int, ...]


def parts(value: Quotient) -> list[Quotient]:
    """``value = 0`` as several equations: a sum of terms of one sign vanishes only if each does."""
    field_ = value.field
    monomials = value.numerator.to_dict()
    for side in (1, -1):
        if len(monomials) > 1 and all(
            nonnegative(field_.polynomial(field_.context.from_dict({e: c * side}))) for e, c in monomials.items()
        ):
            return [field_.polynomial(field_.context.from_dict({e: c})) for e, c in monomials.items()]
    return [field_.polynomial(value.numerator)]


def essential(value: Quotient) -> Quotient | None:
    """The factor that must vanish, or None when there is none or more than one to choose from."""
    if len(value.numerator) > _MOST_FACTORED:
        return value
    found = essentials(value)
    return found[0] if len(found) == 1 else None


def essentials(value: Quotient) -> list[Quotient]:
    """The factors that may vanish, each once; none for a function that is too large to be factored."""
    if len(value.numerator) > _MOST_FACTORED:
        return []
    _, factors = value.numerator.factor()
    elements = [_through_monotone(value.field.polynomial(factor)) for factor, _ in factors]
    return list({str(e.numerator): e for e in elements if not never_zero(e)}.values())


def _through_monotone(element: Quotient) -> Quotient:
    """An atom T(xi) of an odd increasing function vanishes where xi does, and so does |xi|."""
    monomials = element.numerator.to_dict()
    if len(monomials) != 1:
        return element
    ((exponents, _),) = monomials.items()
    used = [k for k, e in enumerate(exponents) if e]
    if len(used) != 1 or exponents[used[0]] != 1:
        return element
    atom = element.field.atoms.get(used[0])
    through = atom is not None and atom.kind in SECTOR_KINDS | {"fabs"}
    return element.field.polynomial(atom.argument.numerator) if atom is not None and through else element


def never_zero(element: Quotient) -> bool:
    """Whether the function is proved to vanish nowhere."""
    if element.constant() is not None:
        return not element.is_zero()
    return positive(element) or positive(-element)


def linear_in(element: Quotient, k: int, variables: int | None = None, units: bool = False) -> Quotient | None:
    """The rest of ``element = c (v_k + rest)`` with v_k nowhere else and c never zero, or None.

    c is a number, or a function of the symbols after the first ``variables`` where these are parameters; with ``units``
    a number times powers of exponentials, too.
    """
    field_ = element.field
    slope: dict[Exponents, fmpq] = {}
    rest: dict[Exponents, fmpq] = {}
    inside = {a for a, atom in field_.atoms.items() if k in atom.argument.symbols()}
    for raw, value in element.numerator.to_dict().items():
        exponents = tuple(map(int, raw))
        if exponents[k] > 1 or any(exponents[a] for a in inside):
            return None
        if exponents[k]:
            slope[(*exponents[:k], 0, *exponents[k + 1 :])] = value
        else:
            rest[exponents] = value
    coefficient = field_.polynomial(field_.context.from_dict(slope))
    known = coefficient.constant()
    if known is not None:
        return None if known == 0 else field_.polynomial(field_.context.from_dict(rest) / known)
    if units and _is_unit(coefficient):
        return field_.polynomial(field_.context.from_dict(rest)) / coefficient
    if variables is None or any(j < variables for j in coefficient.symbols()) or not never_zero(coefficient):
        return None
    return field_.polynomial(field_.context.from_dict(rest)) / coefficient


def _is_unit(value: Quotient) -> bool:
    """Whether this is a number times powers of exponentials."""
    monomials = value.numerator.to_dict()
    used = {k for exponents in monomials for k, e in enumerate(exponents) if e}
    return len(monomials) == 1 and all(k in value.field.atoms and value.field.atoms[k].kind == "exp" for k in used)


def affine(value: Quotient, count: int) -> Row | None:
    """The coefficients of a function that is affine in the first ``count`` symbols, or None."""
    if not value.is_polynomial():
        return None
    row: Row = {}
    for powers, coefficient in terms(value.numerator):
        if len(powers) > 1 or (powers and (powers[0][1] != 1 or powers[0][0] >= count)):
            return None
        row[powers[0][0] if powers else CONSTANT] = coefficient
    return row


def eliminated(row: Row, solved: Mapping[int, Row]) -> Row:
    """The row with ``v_k = -solved[k]`` inserted."""
    result = {key: c for key, c in row.items() if key not in solved}
    for key, weight in row.items():
        for other, c in solved.get(key, {}).items():  # type: ignore[call-overload]
            result[other] = result.get(other, fmpq(0)) - weight * c
    return {key: c for key, c in result.items() if c != 0}


def combination(field_: Field, row: Row) -> Quotient:
    """``-row`` as a function."""
    size = max(field_.symbol_count + field_.pool, 1)
    monomials: dict[Exponents, fmpq] = {}
    for key, c in row.items():
        exponents = [0] * size
        if isinstance(key, int):
            exponents[key] = 1
        monomials[tuple(exponents)] = -c
    return field_.polynomial(field_.context.from_dict(monomials))


def is_combination(target: Mapping[Exponents, fmpq], zeros: Sequence[Mapping[Exponents, fmpq]]) -> bool:
    """Whether a polynomial is a combination of others with rational coefficients."""
    rows: dict[Exponents, Row] = {}
    for key, coefficient in target.items():
        rows.setdefault(key, {})[CONSTANT] = -coefficient
    for k, zero in enumerate(zeros):
        for key, coefficient in zero.items():
            rows.setdefault(key, {})[k] = coefficient
    try:
        reduce_rows(rows.values())
    except Inconsistent:
        return False
    return True


def short(value: Quotient) -> str:
    """The function as a formula, if that is short."""
    long = value.is_polynomial() and len(value.numerator) > _SHORT // 4 + 1  # a term and a sign take four characters
    text = "" if long else formula(value)
    return text if 0 < len(text) <= _SHORT else "an expression of the others"


def is_entire(value: Quotient) -> bool:
    """Whether the function is certainly analytic on the whole space, and so determined by its values near a point."""
    atoms = value.field.atoms.values()
    return value.is_polynomial() and all(a.kind in ENTIRE_KINDS and a.argument.is_polynomial() for a in atoms)


def certainly_varies(plant: Plant, expression: ca.SX, symbols: ca.SX) -> bool:
    """Whether the expression is certainly not zero at some rational point: then it is not zero in disguise.

    Args:
        plant: gives the parameters their values.
        expression: a scalar of the symbols and the parameters.
        symbols: a column.
    """
    tape = Tape.of([symbols, plant.parameter_symbols], [expression])
    parameters = reals(plant.parameter_values)
    for start in range(len(WEIGHTS)):
        point = [rational(WEIGHTS[(start + k) % len(WEIGHTS)]) for k in range(symbols.numel())]
        with precision(BITS):
            value = tape.walk(REAL, [point, parameters])[0].scalar(ZERO)
        if is_finite(value) and sign(value) in (1, -1):
            return True
    return False
