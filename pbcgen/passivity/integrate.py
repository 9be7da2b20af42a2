"""Closed-form potentials: gamma with a given gradient, if one exists among the functions that this suggests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
from flint import fmpq

from pbcgen.passivity.plant import Plant, columns
from pbcgen.symbolic.coefficients import Coefficients, Monomial, common_denominator
from pbcgen.symbolic.field import Field, Quotient
from pbcgen.symbolic.linear import CONSTANT, Inconsistent, Row, particular_solution, reduce_rows

#: How the derivative of one kind of atom brings in another.
_PARTNER = {"sin": "cos", "cos": "sin"}
_MOST_CANDIDATES = 400


@dataclass(frozen=True)
class Curl:
    """Two coordinates i < j with ``d psi_i/dx_j != d psi_j/dx_i``, and the difference."""

    i: int
    j: int
    difference: Quotient


def curl(plant: Plant, psi: ca.SX) -> Curl | None:
    """The first nonzero entry of the skew part of the Jacobian of ``psi`` (n x 1), or None if psi is a gradient.

    Raises UnsupportedOperation for operations that are not analytic.
    """
    jacobian = ca.jacobian(psi, plant.system.x)
    _, (skew,) = plant.exact(jacobian - jacobian.T)
    for (i, j), entry in sorted(skew.entries.items()):
        if i < j and not entry.is_zero():
            return Curl(i, j, entry)
    return None


def potential(plant: Plant, psi: ca.SX) -> ca.SX | None:
    """A function with gradient ``psi`` (n x 1), as SX without constant term, or None if none was found.

    Constant gradients give linear functions. Otherwise the candidates are the monomials of psi raised by one
    coordinate or with their atoms replaced by antiderivative partners, closed under this twice; the coefficients
    follow from linear equations over the field of the parameters, so the result is exact.
    """
    field, (values,) = plant.exact(psi, symbolic=True)
    parameters = plant.parameter_positions()
    psi_values = values.column(field.const(0))
    coefficients = Coefficients(field, parameters)
    monomials: set[Monomial] = set()
    for value in psi_values:
        split = coefficients.split(value)
        if split is None:
            return None
        monomials |= set(split)
    states = plant.system.n
    if all(not any(m) for m in monomials):
        return _linear(plant, field, psi_values)
    candidates = _candidates(field, monomials, states)
    if len(candidates) > _MOST_CANDIDATES:
        return None
    functions = [plant.expression(field.polynomial(field.context.from_dict({m: fmpq(1)}))) for m in candidates]
    return _match(plant, psi, functions)


def _linear(plant: Plant, field: Field, gradient: Sequence[Quotient]) -> ca.SX:
    terms = [plant.expression(entry) * plant.system.x[j] for j, entry in enumerate(gradient) if not entry.is_zero()]
    return sum(terms[1:], terms[0]) if terms else ca.SX(0)


def _candidates(field: Field, monomials: set[Monomial], states: int) -> list[Monomial]:
    """Monomials whose derivatives may add up to ``monomials``."""
    partner = _partners(field)
    found: set[Monomial] = set()
    frontier = set(monomials)
    for _ in range(2):
        for monomial in list(frontier):
            for raised in [monomial, *(_changed(monomial, {j: 1}) for j in range(states))]:
                found.add(raised)
                for k, other in partner.items():
                    if raised[k] > 0:
                        found.add(_changed(raised, {k: -1, other: 1}))
            found |= {_changed(monomial, {k: 1}) for k in field.atoms}
        frontier = set(found)
        if len(found) > _MOST_CANDIDATES // 4:
            break
    return sorted(m for m in found if any(m))


def _partners(field: Field) -> dict[int, int]:
    by_argument = {(a.kind, str(a.argument.numerator), str(a.argument.denominator)): k for k, a in field.atoms.items()}
    result = {}
    for (kind, numerator, denominator), k in by_argument.items():
        other = by_argument.get((_PARTNER.get(kind, ""), numerator, denominator))
        if other is not None:
            result[k] = other
    return result


def _changed(monomial: Monomial, change: dict[int, int]) -> Monomial:
    return tuple(e + change.get(k, 0) for k, e in enumerate(monomial))


def _match(plant: Plant, psi: ca.SX, functions: Sequence[ca.SX]) -> ca.SX | None:
    """Coefficients c with ``sum c_k grad phi_k = psi``, over the field of the parameters."""
    gradients = ca.jacobian(ca.vertcat(*functions), plant.system.x).T
    field, (wanted, available) = plant.exact(psi, gradients, symbolic=True)
    zero = field.const(0)
    coefficients = Coefficients(field, plant.parameter_positions())
    needed, given = wanted.column(zero), columns(available, zero)
    cleared = [common_denominator(field, [value, *(column[i] for column in given)]) for i, value in enumerate(needed)]
    target = [coefficients.split(entry * by) for entry, by in zip(needed, cleared, strict=True)]
    offered = [[coefficients.split(entry * by) for entry, by in zip(column, cleared, strict=True)] for column in given]
    rows: list[Row] = []
    for i, split in enumerate(target):
        if split is None:
            return None
        present = {m for column in offered if (terms := column[i]) is not None for m in terms} | set(split)
        for monomial in sorted(present):
            row: Row = {}
            for k, column in enumerate(offered):
                entry = column[i]
                if entry is not None and monomial in entry:
                    row[k] = entry[monomial]
            if monomial in split:
                row[CONSTANT] = -split[monomial]
            rows.append(row)
    usable = {k for k, column in enumerate(offered) if all(entry is not None for entry in column)}
    rows = [{key: value for key, value in row.items() if key == CONSTANT or key in usable} for row in rows]
    try:
        solution = particular_solution(reduce_rows(rows), zero)
    except Inconsistent:
        return None
    total = ca.SX(0)
    for k, function in enumerate(functions):
        value = solution.get(k)
        if value is not None and not value.is_zero():
            total = total + plant.expression(value) * function
    return total
