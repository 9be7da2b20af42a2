"""The certificate of a design: what :mod:`pbcgen.verify` needs to check every verdict again without searching.

It holds the model as the text that its hash is the hash of, the formulas that were found (gamma, eta, a power
structure), what the controller reads, and a witness for each claim: a decomposition into squares, the centre of an
enclosure, a direction. The checker makes the statements themselves out of the model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
from flint import fmpq, fmpz

import pbcgen
from pbcgen.certify.dissipation_witness import natural_damping, passivity, storage, theta_damping
from pbcgen.certify.stability_witness import stability_witnesses
from pbcgen.certify.velocity_witness import SQUARES, coordinates
from pbcgen.certify.writing import Writing
from pbcgen.control.derive import Derivation
from pbcgen.errors import UnsupportedOperation
from pbcgen.law.compensation import compensated_force
from pbcgen.law.measure import Measurement, Reading, Unreadable
from pbcgen.models.identity import canonical_text, model_hash
from pbcgen.models.laws import NaturalDamping, PassiveOutput, PotentialCompensation, base_law, shaping
from pbcgen.models.laws import gains as gains_of
from pbcgen.passivity.assignable import greedy_rows, residual_of, scale_of
from pbcgen.passivity.equilibrium import combination, gram_of_inputs
from pbcgen.passivity.obstruction import obstruction
from pbcgen.passivity.plant import Point
from pbcgen.passivity.response import Response, negative_response
from pbcgen.passivity.shaping import BY_RANK, extended_hessian, shape_at
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import positive_definite
from pbcgen.symbolic.real import (
    BITS,
    Real,
    approximate,
    fraction,
    is_finite,
    lower,
    midpoint,
    precision,
    rational,
    sign,
    upper,
)
from pbcgen.symbolic.real_matrices import Rows, diagonal, exact_matrix
from pbcgen.symbolic.tape import Tape
from pbcgen.verify.files import FORMAT, digest

#: Half-width of the box of Krawczyk's test, and the digits of its centre.
_RADIUS = "1e-70"
_DIGITS = 80


def certificate(derivation: Derivation) -> dict[str, Any]:
    """The document; the same for the same derivation."""
    terms = Writing()
    claims: list[dict[str, Any]] = [
        {
            "claim": claim.claim,
            "status": str(claim.status),
            "domain": claim.domain,
            "method": claim.method,
            "witness": None,
        }
        for claim in derivation.claims
    ]
    document: dict[str, Any] = {
        "format": FORMAT,
        "generator": f"pbcgen {pbcgen.__version__}",
        "design": derivation.design.name,
        "model_hash": model_hash(derivation.design),
        "model": canonical_text(derivation.design).splitlines(),
        "formulas": _formulas(derivation).lines(),
        "readings": _readings(derivation).lines(),
        "terms": [],
        "claims": claims,
    }
    moving = coordinates(derivation, document)
    document |= moving
    for claim, entry in zip(derivation.claims, claims, strict=True):
        if not (moving and claim.claim in SQUARES and claim.status is Status.PROVED):
            entry["witness"] = _witness(derivation, claim, terms)
    found = stability_witnesses(derivation, document, terms)
    for entry in claims:
        entry["witness"] = found.get(str(entry["claim"]), entry["witness"])
    document["terms"] = terms.lines()
    return {**document, "digest": digest(document)}


def _formulas(derivation: Derivation) -> Writing:
    """gamma, eta and the power structure."""
    plant, structure = derivation.plant, derivation.structure
    named = {"gamma": derivation.gamma, "eta": derivation.eta}
    if structure is not None and _needs_structure(derivation):
        named |= {"matrix": structure.matrix, "remainder": structure.remainder}
    present = {name: ca.SX(e) for name, e in named.items() if e is not None and e.numel()}
    writing = Writing()
    constants = [*plant.parameter_values[len(plant.system.parameters.names) :]]
    found = writing.tape(plant.tape(*present.values()), ["state", "input", "parameter"], {2: constants})
    for name, matrix in zip(present, found, strict=True):
        writing.output(name, matrix.shape, matrix.entries)
    return writing


def _needs_structure(derivation: Derivation) -> bool:
    """Whether the gradient condition rests on the power structure, because x* is not written down exactly."""
    if isinstance(base_law(derivation.law), PotentialCompensation):
        return False
    try:
        witness = _rest(derivation)
    except (UnsupportedOperation, ZeroDivisionError):
        return True
    return witness is None or bool(witness["unknown"])


def _readings(derivation: Derivation) -> Writing:
    """What the law needs, as formulas in the measured signals; nothing where one of them cannot be read."""
    writing = Writing()
    plant, point = derivation.plant, derivation.point
    if point is None or derivation.gamma is None:
        return writing
    measurement = Measurement.of(plant, point)
    for name, signals in _signals(derivation, derivation.gamma):
        places = {}
        for k, signal in enumerate(ca.vertsplit(ca.vec(ca.densify(signals)))):
            reading = measurement.read(signal, name)
            if isinstance(reading, Unreadable) or not all(is_finite(v) for _, v in measurement.constants):
                return Writing()
            places[k, 0] = _place(writing, measurement, reading)
        writing.output(name, (len(places), 1), places)
    return writing


def _place(writing: Writing, measurement: Measurement, reading: Reading) -> int:
    """A signal in the measurement, up to a constant."""
    if reading.affine is not None:
        names = measurement.plant.system.measured_names
        return writing.combination({names.index(name): weight for name, weight in reading.affine.items()}, "measured")
    symbols, values = zip(*measurement.constants, strict=True) if measurement.constants else ((), ())
    inputs = [measurement.symbols, ca.vertcat(*symbols) if symbols else ca.SX(0, 1)]
    numbers = [midpoint(value) for value in values]
    (matrix,) = writing.tape(Tape.of(inputs, [reading.value]), ["measured", "constant"], {1: numbers})
    return matrix.entries.get((0, 0), writing.put("constant 0"))


def _signals(derivation: Derivation, gamma: ca.SX) -> Iterator[tuple[str, ca.SX]]:
    system, base = derivation.plant.system, base_law(derivation.law)
    yield "gamma", gamma
    if isinstance(base, NaturalDamping) and derivation.eta is not None:
        yield "eta", derivation.eta
    force = compensated_force(system, base)
    if force is not None:
        yield "potential", force
    if isinstance(base, PassiveOutput):
        slope = ca.jacobian(gamma, system.x)
        yield "drift", ca.mtimes(slope, system.f)
        yield "feedthrough", ca.mtimes(slope, system.g).T


# --- witnesses ---------------------------------------------------------------------------------------------------


def _witness(derivation: Derivation, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    """The data for one claim; None where the checker needs none, or there are none."""
    if claim.status is Status.UNDECIDED:
        return None
    make = (_PROVED if claim.status is Status.PROVED else _REFUTED).get(claim.claim)
    try:
        return None if make is None else make(derivation, claim, terms)
    except (UnsupportedOperation, ZeroDivisionError):
        return None


def _equilibrium(derivation: Derivation, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    return _rest(derivation)


def _rest(derivation: Derivation) -> dict[str, Any] | None:
    """Exact coordinates, a centre for the others, the equations that determine them, and how the rest follow.

    First with a short decimal for every coordinate that can only be that; then with these among the unknowns, where an
    equation would not hold exactly.
    """
    point, system = derivation.point, derivation.plant.system
    if point is None:
        return None
    values = dict(zip((*system.state_names, *system.input_names), (*point.x, *point.u), strict=True))
    conditions = [residual_of(c) for c in derivation.design.target.conditions]
    scales = [Fraction(1)] * system.n + [scale_of(c) for c in derivation.design.target.conditions]
    expressions = ca.vertcat(system.xdot, *conditions)
    guessed = {name: exact for name, value in values.items() if (exact := _exactly(value)) is not None}
    certain = {name: fraction(value) for name, value in values.items() if isinstance(value, fmpq)}
    for known in (guessed, certain):
        rows = _equations(derivation, point, expressions, [k for k, name in enumerate(values) if name not in known])
        entries = [rational(known[name]) if name in known else value for name, value in values.items()]
        sharp = Point(tuple(entries[: system.n]), tuple(entries[system.n :]))
        (residuals,) = derivation.plant.at(sharp, expressions)
        open_ = [k for k, row in enumerate(residuals) if k not in rows and sign(row[0]) != 0]
        follows = {}
        for k in open_:
            weights = combination(derivation.plant, expressions[k], expressions[rows], known)
            if weights is not None:
                follows[str(k)] = {
                    str(j): str(w * scales[j] / scales[k]) for j, w in zip(rows, weights, strict=True) if w
                }
        if len(rows) == len(values) - len(known) and len(follows) == len(open_):
            witness = {
                "known": {name: str(value) for name, value in known.items()},
                "unknown": {name: _decimal(midpoint(value)) for name, value in values.items() if name not in known},
                "radius": _RADIUS,
                "rows": rows,
            }
            return witness | ({"follows": follows} if follows else {})
    return None


def _equations(derivation: Derivation, point: Point, expressions: ca.SX, unknown: list[int]) -> list[int]:
    """As many equations as unknowns, with independent gradients at x*."""
    if not unknown:
        return []
    system = derivation.plant.system
    slope = ca.jacobian(expressions, ca.vertcat(system.x, system.u)[unknown])
    (matrix,) = derivation.plant.at(point, ca.densify(slope))
    return greedy_rows(np.array([[approximate(v) for v in row] for row in matrix]))


def _exactly(value: Real) -> Fraction | None:
    """The number, or zero or the short decimal in its enclosure, which it must then be; None for others."""
    if isinstance(value, fmpq):
        return fraction(value)
    candidates = (Fraction(0), Fraction(repr(approximate(value))))
    return next((v for v in candidates if lower(value) <= v <= upper(value)), None)


def _decimal(value: Fraction) -> str:
    """The number rounded to many digits."""
    if value == 0:
        return "0"
    exponent = len(str(fmpz(abs(value.numerator)))) - len(str(fmpz(value.denominator))) - _DIGITS
    return f"{round(value / Fraction(10) ** exponent)}e{exponent}"


def _gradient(derivation: Derivation, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    structure = derivation.structure
    if claim.method == BY_RANK:
        return {"rank": derivation.plant.system.n}
    by_structure = structure is not None and claim.method.startswith("structure") and _needs_structure(derivation)
    return {"form": structure.form} if structure is not None and by_structure else None


def _direction(matrix: Callable[[Derivation], Rows]) -> Callable[..., dict[str, Any] | None]:
    """The rational direction in which a matrix is not positive definite."""

    def make(derivation: Derivation, claim: Claim, terms: Writing) -> dict[str, Any] | None:
        with precision(BITS):
            witness = positive_definite(matrix(derivation)).witness
        return None if witness is None else {"v": [str(v) for v in witness]}

    return make


def _hessian(derivation: Derivation, extended: bool) -> Rows:
    base = base_law(derivation.law)
    assert derivation.point is not None
    assert derivation.gamma is not None
    assert base is not None
    term = shaping(base)
    stiffness = diagonal([rational(v) for v in term.stiffness])
    shape = shape_at(derivation.plant, derivation.point, derivation.gamma, base)
    if extended:
        return extended_hessian(shape, stiffness, exact_matrix(term.K_c or ()))
    return shape.hessian(stiffness)


def _gain(derivation: Derivation, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    name = str((claim.counterexample or {})["gain"])
    gain = gains_of(derivation.law)[name] if derivation.law is not None else ()
    found = _direction(lambda _: exact_matrix(gain))(derivation, claim, terms)  # type: ignore[arg-type]
    return None if found is None else {"gain": name} | found


def _supplied(derivation: Derivation, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    """A state and an input for the model's gamma, or why there is none."""
    found, plant = claim.counterexample or {}, derivation.plant
    if "omega" in found:
        response = None if derivation.point is None else negative_response(plant, derivation.point)
        return None if response is None else _negative(derivation, response)
    if plant.system.gamma is not None:
        return _state_and_input(derivation, claim, terms)
    shown = obstruction(plant)
    if shown is None or shown.by_jets:
        return None
    return {
        "input": shown.input,
        "set": {str(k): terms.put("constant 0") for k in shown.zero},
        "x": [shown.point[name] for name in plant.system.state_names],
        "vectors": [[j, [None if v.is_zero() else terms.quotient(v) for v in d]] for j, d in shown.directions],
    }


def _negative(derivation: Derivation, found: Response) -> dict[str, Any]:
    """A frequency, and the rest at which it counts if that is not x*."""
    system, witness = derivation.plant.system, {"omega": str(found.omega)}
    if found.point == derivation.point:
        return witness
    known = {name: str(midpoint(v)) for name, v in zip(system.input_names, found.point.u, strict=True)}
    unknown = {name: _decimal(midpoint(v)) for name, v in zip(system.state_names, found.point.x, strict=True)}
    return witness | {"rest": {"known": known, "unknown": unknown, "radius": _RADIUS, "rows": [*range(system.n)]}}


def _state(derivation: Derivation, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    point = (claim.counterexample or {})["x"]
    return {"x": [str(point[name]) for name in derivation.plant.system.state_names]}


def _state_and_input(derivation: Derivation, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    point, system = (claim.counterexample or {})["x"], derivation.plant.system
    return {"x": [str(point[name]) for name in (*system.state_names, *system.input_names)]}


def _blind(derivation: Derivation, claim: Claim, terms: Writing) -> dict[str, Any] | None:
    direction = (claim.counterexample or {})["direction"]
    return {"v": [str(direction[name]) for name in derivation.plant.system.state_names]}


_Maker = Callable[[Derivation, Claim, Writing], dict[str, Any] | None]

_PROVED: Mapping[str, _Maker] = {
    "equilibrium": _equilibrium,
    "assumption-1": lambda d, claim, terms: storage(d, claim.domain, terms),
    "passive-output": lambda d, claim, terms: passivity(d, claim.domain, terms),
    "assumption-3": lambda d, _, terms: natural_damping(d, terms),
    "theta": lambda d, _, terms: theta_damping(d, terms),
    "gradient-condition": _gradient,
}
_REFUTED: Mapping[str, _Maker] = {
    "input-rank": _direction(lambda d: gram_of_inputs(d.plant, d.point)),
    "assumption-1": _state,
    "passive-output": _supplied,
    "hessian-condition": _direction(lambda d: _hessian(d, False)),
    "kc-bound": _direction(lambda d: _hessian(d, True)),
    "gain-definiteness": _gain,
    "assumption-3": _state_and_input,
    "theta": _state_and_input,
    "measurability": _blind,
}
