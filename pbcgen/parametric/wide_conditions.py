"""What must hold of the parameters and the gains where it does not hold of all: as formulas for reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
from flint import fmpq_mpoly

from pbcgen.models.exact import decimal
from pbcgen.parametric.wide import AT_TARGET, FAR_REACHES, GIVE_UP, REACHES, Gain, Wide, pairs, refuted, undecided
from pbcgen.proof.claim import Claim
from pbcgen.proof.elimination import definite, positivity_conditions
from pbcgen.proof.nonnegative import positive
from pbcgen.symbolic.field import Quotient, TooLarge
from pbcgen.symbolic.real import text

#: Longer conditions are not shown, nor more of them.
_LONGEST = 200
_MOST = 4
_LARGEST_MINOR = 4
#: Conditions of more terms are not factored.
_MOST_TERMS = 200


@dataclass(frozen=True)
class Against:
    """Positive parameters at which a leading minor is negative, its order and its value."""

    values: dict[str, str]
    order: int
    value: str


@dataclass(frozen=True)
class Verdict:
    """A claim; where it fails for some parameters, when it holds as far as that is known, and what refutes it."""

    claim: Claim
    condition: str = ""
    against: Against | None = None


def decide_definite(
    wide: Wide,
    name: str,
    matrix: ca.SX,
    shown: str,
    symbolic: ca.SX | None = None,
    gains: Sequence[Gain] = (),
    block: Against | None = None,
    first: int = 1,
) -> Verdict:
    """Whether a symmetric matrix of functions of the parameters is positive definite for all of them.

    Args:
        wide: the design.
        name: of the claim.
        matrix: with the gains as numbers.
        shown: what the matrix is called.
        symbolic: with the gains as symbols, for the condition; the matrix itself if not given.
        gains: those that occur in it.
        block: what refutes a leading block of the matrix, if that is known.
        first: order of the first leading minor that was not looked at yet.
    """
    try:
        if definite(wide.entries(matrix)):
            evidence = f"{shown} by elimination, every pivot is positive"
            return Verdict(wide.proved(name, AT_TARGET, "exact algebra over Q(parameters)", evidence))
    except GIVE_UP:
        pass
    where = _condition_of(wide, matrix if symbolic is None else symbolic, gains)
    iff = f"{shown} iff {where}" if where else ""
    against = block or negative_minor(wide, matrix, FAR_REACHES if iff else REACHES, first)
    if against is None:
        why = f"{iff}: not proved for all" if iff else f"{shown} was not proved with symbolic parameters"
        return Verdict(undecided(name, AT_TARGET, why), where)
    why = f"{iff}; not so" if iff else f"the leading minor of order {against.order} is {against.value} < 0"
    hint = "keep to this condition" if iff else "raise the gains, or restrict the parameters"
    shown_against = {"parameters": against.values, f"minor {against.order}": against.value}
    claim = refuted(name, AT_TARGET, f"{why} with {pairs(against.values)}", hint, shown_against)
    return Verdict(claim, where, against)


def negative_minor(wide: Wide, matrix: ca.SX, reaches: Sequence[int] = REACHES, first: int = 1) -> Against | None:
    """A leading minor that is negative for some positive parameters."""
    for k in range(first, min(matrix.shape[0], _LARGEST_MINOR) + 1):
        found = wide.counterexample(ca.det(matrix[:k, :k]), ca.SX(0, 1), reaches=reaches)
        if found is not None:
            return Against(found[0], k, text(found[2], 6))
    return None


def _condition_of(wide: Wide, matrix: ca.SX, gains: Sequence[Gain]) -> str:
    """The condition for a matrix to be positive definite, or nothing if it cannot be shown."""
    try:
        return condition(wide, positivity_conditions(wide.entries(matrix)), gains)
    except GIVE_UP:
        return ""


def condition(wide: Wide, functions: Sequence[Quotient], gains: Sequence[Gain] = ()) -> str:
    """``functions > 0`` as text, with the gains' numbers; nothing if it is too long or could not be made."""
    if not functions or len(functions) > _MOST:
        return ""
    known: list[fmpq_mpoly] = []
    parts = []
    try:
        for function in functions:
            if len(function.numerator) * len(function.denominator) > _MOST_TERMS:
                return ""
            essential = _without_sign(function, known)
            sign = essential.constant()
            if sign is not None and sign > 0:
                continue
            known.append(essential.numerator)
            parts.append(_shown(wide, essential))
    except TooLarge:
        return ""
    whole = " and ".join(dict.fromkeys(parts))
    if len(whole) > _LONGEST:
        return ""
    numbers = [f"{gain.label} = {decimal(gain.value)}" for gain in gains if gain.label in whole]
    return f"{whole} (here {', '.join(numbers)})" if numbers else whole


def _without_sign(function: Quotient, known: Sequence[fmpq_mpoly]) -> Quotient:
    """A polynomial of the same sign without the factors that are positive, or so by an earlier condition."""
    field = function.field
    if function.is_zero():
        return function
    content, factors = (function.numerator * function.denominator).factor()
    rest = field.context.constant(1 if content > 0 else -1)
    for factor, power in factors:
        element = field.polynomial(factor)
        if positive(element) or factor in known:
            continue
        if positive(-element) or -factor in known:
            rest = -rest if power % 2 else rest
            continue
        rest *= factor if power % 2 else factor * factor
    return field.polynomial(rest)


def _shown(wide: Wide, function: Quotient) -> str:
    """``function > 0`` solved for a gain, or with positive terms on both sides."""
    field = function.field
    if function.constant() is not None:  # it is proved to be negative, or zero
        return "never"
    terms = function.numerator.to_dict()
    gains = [k for k, atom in field.atoms.items() if atom.kind == "exp" and _name(atom.argument) in wide.gain_names]
    for k in gains:
        if function.numerator.degrees()[k] != 1:
            continue
        slope = {(*e[:k], 0, *e[k + 1 :]): c for e, c in terms.items() if e[k]}
        coefficient = field.polynomial(field.context.from_dict(slope))
        rest = field.polynomial(field.context.from_dict({e: c for e, c in terms.items() if not e[k]}))
        label = wide.text(field.symbol(k))
        if positive(coefficient):
            return f"{label} > {wide.text(-rest / coefficient)}"
        if positive(-coefficient):
            return f"{label} < {wide.text(-rest / coefficient)}"
    sides = [
        field.polynomial(field.context.from_dict({e: c * s for e, c in terms.items() if c * s > 0})) for s in (1, -1)
    ]
    return " > ".join(_without_parentheses(wide.text(side)) for side in sides)


def _without_parentheses(shown: str) -> str:
    """The text without a pair of parentheses around all of it."""
    if not (shown.startswith("(") and shown.endswith(")")):
        return shown
    depth = [shown[: k + 1].count("(") - shown[: k + 1].count(")") for k in range(len(shown) - 1)]
    return shown[1:-1] if min(depth) > 0 else shown


def _name(argument: Quotient) -> str:
    found = argument.symbols()
    return argument.field.names[next(iter(found))] if len(found) == 1 else ""
