"""Witnesses of the stability claims for certificates, found with the checker's own reading of the model."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np
from flint import arb, arb_mat, ctx, fmpq

from pbcgen.certify import velocity_witness
from pbcgen.certify.alone_witness import Circuit, alone
from pbcgen.certify.attraction_witness import combined, read, steps_to_rest
from pbcgen.certify.dissipation_witness import sampled_damping
from pbcgen.certify.growth_witness import convex_growth, growth, inertia
from pbcgen.certify.inside_witness import is_closed, kept, on_domain, rising
from pbcgen.certify.limits_witness import what_is_left
from pbcgen.certify.no_rest_witness import nowhere
from pbcgen.certify.sectors_witness import in_sectors
from pbcgen.certify.settings_witness import adjustable
from pbcgen.certify.velocity_witness import SQUARES, squares
from pbcgen.certify.writing import Writing
from pbcgen.control.absolute import METHOD
from pbcgen.control.derive import Derivation
from pbcgen.control.leaves import conserved
from pbcgen.errors import UnsupportedOperation
from pbcgen.passivity.lasalle import InvariantSet
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.lyapunov import Kind, lyapunov
from pbcgen.proof.tree import cover
from pbcgen.reading.overall import GLOBAL
from pbcgen.symbolic.linear import Inconsistent, solve
from pbcgen.symbolic.plain.formulas import rational
from pbcgen.symbolic.plain.matrices import Matrix, product, transpose
from pbcgen.symbolic.plain.outcomes import Fails, NotCheckable
from pbcgen.symbolic.plain.spectra import krawczyk, stable
from pbcgen.symbolic.plain.values import Function, Grow, plain, sign, variables
from pbcgen.symbolic.plain.values import partial as slope_by
from pbcgen.symbolic.real import approximate, midpoint
from pbcgen.verify.claims import LARGEST_ROUTH, bits_for
from pbcgen.verify.stability import Stability

#: Parts of the range of periods.
_MOST_PERIODS = 600
_DIGITS = (5, 8, 12, 17)
_RADIUS, _ROUNDS, _PLACES = "1e-70", 12, 80
_MISFITS = (ArithmeticError, LookupError, TypeError, ValueError, AttributeError)
#: Why a witness is not found: it is left out, and the claim is recorded.
_GIVE_UP = (*_MISFITS, NotCheckable, Fails, UnsupportedOperation, Inconsistent)

Witness = dict[str, Any] | None


def stability_witnesses(derivation: Derivation, document: Mapping[str, Any], terms: Writing) -> dict[str, Witness]:
    """The witnesses by claim; what cannot be shown has none. ``terms`` takes their formulas."""
    wanted = {c.claim: c for c in derivation.claims if c.status is not Status.UNDECIDED}
    bits, settings = ctx.prec, (64 if "inertia" in document else 16,)  # type: int, tuple[Any, ...]
    try:
        for _ in range(100):
            found, writing = {}, copy.deepcopy(terms)
            ctx.prec = bits_for(derivation.plant.system.n)
            try:
                work = _Work(derivation, Stability({**document, "terms": writing.lines()}, *settings), writing)
                found = {name: work.witness(claim) for name, claim in wanted.items()}
            except Grow as larger:
                settings = larger.args
                continue
            terms.__dict__.update(writing.__dict__)
            return {name: witness for name, witness in found.items() if witness}
    finally:
        ctx.prec = bits
    return {}


class _Work:
    """One certificate in the making."""

    def __init__(self, derivation: Derivation, system: Stability, terms: Writing) -> None:
        self.derivation, self.system, self.terms = derivation, system, terms

    def witness(self, claim: Claim) -> Witness:
        """The data for one claim, or None."""
        try:
            if claim.claim in SQUARES and claim.status is Status.PROVED and self.system.inertia:
                return self._squares(claim)
            make = _MAKERS.get(claim.claim)
            return None if make is None else make(self, claim)
        except _GIVE_UP:
            return None

    def _squares(self, claim: Claim) -> Witness:
        """In (q, v); the claims that follow make use of it."""
        found = squares(self.derivation, self.system, claim, self.terms)
        if found is not None and claim.claim == "assumption-1" and claim.holds_everywhere:
            found["inertia"] = inertia(self.system, self.terms, self._factors())
        if found is not None:
            self.system.witness = {**self.system.witness, claim.claim: found}
            self.system.__dict__["placed"] = read(self.system, self.terms)
        return found

    def unassignable(self, claim: Claim) -> Witness:
        """`equilibrium` REFUTED."""
        return nowhere(self.system, self.terms) if claim.status is Status.REFUTED else None

    def limited(self, claim: Claim) -> Witness:
        """`saturation` where a force is compensated: what is left to each limit has no negative values."""
        system = self.system
        if not system.compensated:
            return None
        if claim.status is Status.REFUTED:
            return {"q": list((claim.counterexample or {})["x"].values())}
        limits = what_is_left(system, self.terms)
        return None if limits is None else {"limits": limits}

    def local(self, claim: Claim) -> Witness:
        """`stable` and `asymptotically-stable`."""
        system = self.system
        if claim.status is Status.REFUTED:
            return self._conserved() or self._undamped() or self._large(system.continuous, "hurwitz")
        if len(system.continuous) <= LARGEST_ROUTH:
            return None if stable(system.continuous, False) else self._globally() or self._by_steps()
        if (found := self._by_storage()) is not None:
            return found
        return self._large(system.continuous, "hurwitz")

    def _large(self, matrix: Matrix, kind: Kind) -> Witness:
        """P for a large loop."""
        storage = _storage(matrix, kind) if len(matrix) > LARGEST_ROUTH else None
        return None if storage is None else {"P": storage}

    def _by_steps(self) -> Witness:
        isolated = sign(arb_mat(self.system.continuous).det()) in (1, -1)
        return steps_to_rest(self.system, self.terms) if isolated else None

    def _globally(self) -> Witness:
        """That the global claim is proved, and checked."""
        overall = next(c for c in self.derivation.claims if c.claim == GLOBAL)
        proved = overall.status is Status.PROVED and self.everywhere(overall) is not None
        return {"globally": True} if proved else None

    def _by_storage(self) -> Witness:
        """The Lyapunov function's steps: those of the global claim, if that is proved."""
        if (found := self._globally()) is not None:
            return found
        try:
            self.system.lyapunov()
        except _GIVE_UP:
            return None
        return self._by_steps()

    def besides(self, claim: Claim) -> Witness:
        """`stable` where something is conserved; or not, where a motion is steady that the controller does not see."""
        if "rate" in (found := claim.counterexample or {}):
            rate: Any = found["rate"]
            return (self._undamped() or {}) | {"rate": [rate.get(name, "0") for name in self.system.states]}
        return dict(claim.certificate) if "conserved" in claim.certificate else None

    def _conserved(self) -> Witness:
        """A constant combination of the states that no input changes."""
        basis = conserved(self.derivation.plant)
        return {"conserved": [str(v) for v in basis[0]]} if basis else None

    def _undamped(self) -> Witness:
        """States as functions of free ones, with u = u* and gamma = gamma*."""
        situation, plant = self.derivation.situation, self.derivation.plant
        if situation is None:
            return None
        found = situation.undamped_plane or situation.undamped_set
        if found is None:
            return None
        solved = found.solved if isinstance(found, InvariantSet) else found.solved(plant, situation.point.x)
        values = ca.vertcat(ca.SX(0, 1), *solved.values())
        numbers = {2: [*plant.parameter_values]}
        (places,) = self.terms.tape(plant.tape(ca.densify(values)), ["state", "input", "parameter"], numbers)
        zero = self.terms.put("constant 0")
        return {"set": {str(k): places.entries.get((i, 0), zero) for i, k in enumerate(solved)}}

    def everywhere(self, claim: Claim) -> Witness:
        """`globally-asymptotically-stable`."""
        if claim.status is Status.REFUTED:
            return self._second(claim)
        return in_sectors(self.system) if claim.method == METHOD else self._attraction

    @cached_property
    def _attraction(self) -> Witness:
        return self.terms.first([self._attracted])

    def _attracted(self, terms: Writing) -> Witness:
        circuit, loop = self.derivation.plant.system.circuit, self.system
        if loop.model.domain:
            loop = on_domain(loop, terms)
        currents, weight = [], []  # type: list[Any], list[list[fmpq]]
        if circuit is not None:
            _, (w, Xi) = self.derivation.plant.exact(circuit.P_gradient, circuit.Xi)
            zero = w.entries[next(iter(w.entries))].field.const(0)
            weight = [[v.constant() or fmpq(0) for v in row] for row in Xi.dense(zero)]
            scratch = Writing()
            places = [scratch.quotient(v) for v in w.column(zero)]
            values = read(loop, scratch)
            currents = [values[place] for place in places]
        grown = self._grown(loop, terms, currents, weight)
        found = None if grown is None else steps_to_rest(loop, terms)
        if grown is None or found is None:
            return None
        by_itself = alone(loop, terms, self._power, self._as_circuit(currents))
        return None if by_itself is None else grown | found | {"alone": by_itself}

    def _grown(self, loop: Stability, terms: Writing, currents: list[Any], weight: list[list[fmpq]]) -> Witness:
        """That the storage grows; on a domain, that this is kept too, or the storage grows towards its ends."""
        kinetic = self._factors()
        ways = [partial(growth, loop, kinetic=kinetic)]
        ways += [partial(growth, loop, currents=currents, weight=weight)] if currents else []
        if loop.model.domain and not is_closed(loop):
            return rising(loop)
        ends = kept(loop, terms) if loop.model.domain else {}
        grown = terms.first([*ways, partial(convex_growth, loop, kinetic=kinetic)])
        return None if ends is None or grown is None else ends | grown

    def _as_circuit(self, currents: list[Any]) -> Circuit | None:
        """What is known of a circuit, where gamma is linear in its currents."""
        if not currents:
            return None
        rows, charges = [combined(g, currents, True) for g in self.system.column("gamma")], self._charges()
        if any(row is None for row in rows) or any(v is None for row in charges for v in row):
            return None
        return Circuit(currents, [row or {} for row in rows], charges)

    def _charges(self) -> list[list[Any]]:
        """Q of a circuit, with ``Q x' = grad P + g_tilde u``."""
        circuit, plant = self.derivation.plant.system.circuit, self.derivation.plant
        assert circuit is not None
        _, (Q,) = plant.exact(circuit.Q)
        zero = Q.entries[next(iter(Q.entries))].field.const(0)
        return [[v.constant() for v in row] for row in Q.dense(zero)]

    def _factors(self) -> list[tuple[Function, Function]]:
        """The kinetic energy as squares where M came as ``sum J^T W J`` with W diagonal, for systems read in (q, v)."""
        mechanics = self.derivation.plant.system.mechanical
        if mechanics is None or not self.system.inertia:
            return []
        found: list[tuple[ca.SX, ca.SX]] = []
        for J, W in mechanics.factors:
            if not W.sparsity().is_diag():
                return []
            found += zip(ca.vertsplit(ca.diag(W) / 2), ca.vertsplit(ca.mtimes(J, mechanics.p)), strict=True)
        scratch, both = Writing(), ca.vertcat(*[part for pair in found for part in pair])
        numbers = {2: [*self.derivation.plant.parameter_values]}
        (places,) = scratch.tape(self.derivation.plant.tape(ca.densify(both)), ["state", "input", "parameter"], numbers)
        values = read(self.system, scratch)
        parts = [values[places.entries[k, 0]] for k in range(both.numel())]
        return [*zip(parts[::2], parts[1::2], strict=True)]

    def _power(self, terms: Writing) -> list[list[int | None]]:
        """The places of N with ``grad S = N f``: A, or the inverse of F."""
        structure, plant = self.derivation.structure, self.derivation.plant
        if structure is None or structure.remainder.nnz():
            return []
        field, (M,) = plant.exact(structure.matrix)
        zero, size = field.const(0), range(plant.system.n)
        rows = M.dense(zero)
        if structure.form == "F":
            units = [[field.const(int(i == j)) for i in size] for j in size]
            columns = [solve([dict(enumerate(row)) for row in rows], unit, len(rows[0]), zero) for unit in units]
            if any(column is None for column in columns):
                return []
            rows = [[column[i] for column in columns if column is not None] for i in size]
        return [[None if v.is_zero() else terms.quotient(v) for v in row] for row in rows]

    def _second(self, claim: Claim) -> Witness:
        """The other equilibrium, to many digits."""
        system, plant = self.system, self.derivation.plant.system
        if system.status["asymptotically-stable"] == "REFUTED" or "period" in (claim.counterexample or {}):
            return None
        if "growth" in (claim.counterexample or {}):
            return {"growth": str((claim.counterexample or {})["growth"])}
        x = [float(str((claim.counterexample or {})["x"][name])) for name in plant.state_names]
        found = system.walk([fmpq(int(v * 2**60), 2**60) for v in x])
        f, g = (np.array([[approximate(v) for v in row] for row in found[name]]) for name in ("f", "g"))
        u = -np.linalg.lstsq(g, f, rcond=None)[0].ravel()
        if system.compensated:
            V = system.potential(variables([fmpq(int(v * 2**60), 2**60) for v in x[: system.half]]), fmpq)
            u = u - np.array([approximate(slope_by(V, k)) for k in range(system.half)])
        shown = (claim.counterexample or {}).get("psi", [])
        psi = [float(str(v)) for v in shown] if isinstance(shown, list) else []
        z = [fmpq(int(v * 2**60), 2**60) for v in (*x, *u, *psi)]
        left = system.left(system.along(system.standing), range(system.n))
        for _ in range(_ROUNDS):
            value = left(variables(z))
            slope = arb_mat([[slope_by(v, k) for k in range(len(z))] for v in value])
            step = slope.solve(arb_mat([[arb(plain(v))] for v in value]))
            z = [_rounded(v - step[k, 0], _PLACES) for k, v in enumerate(z)]
        if krawczyk(left, z, rational(_RADIUS)) is None:
            return None
        return {"centre": [_text(v, _PLACES) for v in z], "radius": _RADIUS}

    def settings(self, claim: Claim) -> Witness:
        """`adjustable`."""
        return adjustable(self.derivation, self.system, claim, self.terms)

    def sampled(self, claim: Claim) -> Witness:
        """`sampled-stable`."""
        if claim.status is Status.REFUTED:
            return self._large(self.system.sampled, "schur")
        if "storage" in claim.certificate:
            return self._varied(claim.certificate["storage"])
        large = len(self.system.continuous) > LARGEST_ROUTH
        decreases = large and rational(claim.certificate.get("lyapunov_period", "0")) > self.system.period
        needed = claim.domain == "sampled loop, all x" or decreases or self.system.jitter
        if needed or not (large or stable(self.system.sampled, True)):
            damped = "natural-damping" in self.system.law
            if self.system.inertia:
                found = velocity_witness.sampled_damping(self.derivation, self.system, damped, self.terms)
            else:
                found = sampled_damping(self.derivation, damped, self.terms)
            if found is not None:
                return found
        return self._large(self.system.sampled, "schur")

    def _varied(self, factor: list[list[float]]) -> Witness:
        """P = F^T F for periods that vary, and how their range is cut."""
        system = self.system
        F = [[rational(f"{v:.17g}") for v in row] for row in factor]
        rows = [[f"{approximate(v):.17g}" for v in row[: i + 1]] for i, row in enumerate(product(transpose(F), F))]
        P = [[rational(rows[max(i, j)][min(i, j)]) for j in range(len(rows))] for i in range(len(rows))]
        found = cover(system.periods, system.falling(P), ".", _MOST_PERIODS)
        return None if found is None else {"P": rows, "periods": found}


_MAKERS = {
    "equilibrium": _Work.unassignable,
    "saturation": _Work.limited,
    "stable": _Work.besides,
    "asymptotically-stable": _Work.local,
    "globally-asymptotically-stable": _Work.everywhere,
    "sampled-stable": _Work.sampled,
    "adjustable": _Work.settings,
}


def _storage(matrix: Matrix, kind: Kind) -> list[list[str]] | None:
    """The lower triangle of a Lyapunov matrix with as few digits as suffice."""
    proof = lyapunov(matrix, kind)
    if proof.status is Status.UNDECIDED:
        return None
    P = [[proof.P[i][j] / proof.scale[i] / proof.scale[j] for j in range(i + 1)] for i in range(len(matrix))]
    for digits in _DIGITS:
        rows = [[f"{v:.{digits}g}" for v in row] for row in P]
        exact = [[rational(rows[max(i, j)][min(i, j)]) for j in range(len(rows))] for i in range(len(rows))]
        if stable(matrix, kind == "schur", exact) is (proof.status is Status.PROVED):
            return rows
    return None


def _rounded(value: Any, places: int) -> fmpq:
    return rational(_text(value, places))


def _text(value: Any, places: int) -> str:
    """A decimal close to a number."""
    exact = midpoint(value)
    if exact == 0:
        return "0"
    exponent = len(str(abs(exact.numerator))) - len(str(exact.denominator)) - places
    scaled = exact / 10**exponent if exponent >= 0 else exact * 10**-exponent
    return f"{round(scaled)}e{exponent}"
