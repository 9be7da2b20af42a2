"""Certificates of mechanical systems in positions and velocities, where M(q)^-1 is too large to be written out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca

from pbcgen.certify.attraction_witness import in_squares
from pbcgen.certify.dissipation_witness import carrying_damping
from pbcgen.certify.writing import Writing
from pbcgen.control.derive import Derivation
from pbcgen.passivity.dissipation import port_damping
from pbcgen.proof.claim import Claim, Status
from pbcgen.symbolic.plain.formulas import Formulas, rational
from pbcgen.symbolic.plain.matrices import Matrix, diagonal, plus, product, transpose
from pbcgen.symbolic.plain.outcomes import Fails, NotCheckable
from pbcgen.symbolic.plain.values import Grow
from pbcgen.symbolic.tape import Tape
from pbcgen.verify.stability import Stability

#: Claims that are shown by squares, which are then written in (q, v).
SQUARES = ("assumption-1", "passive-output", "assumption-3", "theta")

#: Refutations that are made in the states themselves.
_IN_STATES = ("measurability", "passive-output", "asymptotically-stable")


def coordinates(derivation: Derivation, document: Mapping[str, Any]) -> dict[str, Any]:
    """Where M stands in the model of a certificate that is to be read in (q, v); nothing for one in the states."""
    mechanics = derivation.plant.system.mechanical
    if mechanics is None or not ca.depends_on(mechanics.M, mechanics.q) or _refuted(derivation.claims):
        return {}
    rows = _places(derivation, Formulas.parse(document["model"]))
    for whole in (True, False) if rows else ():
        found = {"inertia": rows, "whole_angles": whole}
        try:
            system = Stability({**document, **found}, 64)
            if system.in_velocities and system.power:
                return found
        except (Fails, NotCheckable, Grow, LookupError, ArithmeticError):
            continue
    return {}


def _refuted(claims: Sequence[Claim]) -> bool:
    refuted = {c.claim for c in claims if c.status is Status.REFUTED}
    return bool(refuted & {*_IN_STATES} - ({"asymptotically-stable"} if "stable" in refuted else set()))


def _places(derivation: Derivation, formulas: Formulas) -> list[list[int | None]]:
    """The instruction in the model's text of each entry of M; nothing if one is not there."""
    system, writing = derivation.plant.system, Writing()
    assert system.mechanical is not None
    number: list[int] = []
    for name, *operands in formulas.instructions:
        named = name in ("constant", "state", "parameter")
        number.append(writing.put(" ".join([name, *(o if named else str(number[int(o)]) for o in operands)])))
    place = {at: k for k, at in enumerate(number)}
    tape = Tape.of([system.x, system.parameters.symbols], [system.mechanical.M])
    (M,) = writing.tape(tape, ["state", "parameter"], {})
    size = range(M.shape[0])
    found = [[place.get(M.entries.get((i, j), -1)) for j in size] for i in size]
    found = [[found[j][i] if found[i][j] is None else found[i][j] for j in size] for i in size]
    return [] if any(found[i][j] is None for i, j in M.entries) else found


def squares(derivation: Derivation, system: Stability, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    """The witness of a claim that is shown by squares, for a system that is read in (q, v)."""
    matrix, given = system.power, {}  # type: Matrix, dict[str, Any]
    if claim.claim == "assumption-1":
        matrix = [[-system.rate("S")[0][0]]]
    if claim.claim == "assumption-3":
        bounds = derivation.bounds
        if bounds is None or bounds.Lambda_l is None or bounds.Lambda_c is None:
            return None
        given = {name: [str(v) for v in getattr(bounds, name)] for name in ("Lambda_l", "Lambda_c")}
        matrix = beyond(system, diagonal([rational(v) for part in given.values() for v in part]), damped=True)
    if claim.claim == "theta":
        Lambda = carrying_damping(derivation)
        if Lambda is None:
            return None
        given = {"Lambda": [[str(v) for v in row] for row in Lambda]}
        matrix = beyond(system, [[rational(v) for v in row] for row in given["Lambda"]], damped=True)
    found = in_squares(system.field, matrix, terms)
    return given | ({} if found is None else {"squares": found})


def sampled_damping(derivation: Derivation, system: Stability, damped: bool, terms: Writing) -> dict[str, Any] | None:
    """For `sampled-stable` by the storage: the full Lambda, and what the dissipation has beyond it."""
    structure, gamma = derivation.structure, derivation.gamma
    if structure is None or gamma is None:
        return None
    Lambda = port_damping(derivation.plant, structure, gamma, derivation.eta if damped else None)
    if Lambda is None:
        return None
    rows = [[str(v) for v in row] for row in Lambda]
    found = in_squares(system.field, beyond(system, [[rational(v) for v in row] for row in rows], damped), terms)
    return None if found is None else {"Lambda": rows, "squares": found}


def beyond(system: Stability, Lambda: Matrix, damped: bool) -> Matrix:
    """``u^T y - S' - |(eta', y)|^2_Lambda`` as a form in (1, u)."""
    rates = (system.rate("eta") if damped else []) + system.rate("gamma")
    return plus(system.power, product(transpose(rates), Lambda, rates), -1)
