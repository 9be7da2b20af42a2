"""What holds for all positive values of the parameters, not only at their values.

Every parameter is written as exp(s) with a free number s. What exact algebra proves of the system with s among its
symbols holds for all x and all positive parameters; no prover has to know of parameters. The gains of the law and the
numbers in the target stay what they are. Nothing here is a reason to generate code.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import casadi as ca

from pbcgen.control.derive import Derivation
from pbcgen.errors import ModelError
from pbcgen.models.laws import Integral, NaturalDamping, PassiveOutput
from pbcgen.parametric.resting_point import RestingPoint, resting_point
from pbcgen.parametric.wide import AT_TARGET, EVERYWHERE, GIVE_UP, Wide, pairs, refuted, undecided
from pbcgen.parametric.wide_conditions import Verdict, decide_definite
from pbcgen.parametric.wide_damping import assumption_3, theta
from pbcgen.parametric.wide_stability import Stability
from pbcgen.passivity import passive_output
from pbcgen.passivity.region import Region
from pbcgen.passivity.structure import PowerStructure, candidates, prove
from pbcgen.proof.claim import CLAIMS, Claim, Status
from pbcgen.proof.nonnegative import nonnegative
from pbcgen.symbolic.real import rational, text

#: Claims on what the controller reads and on its numbers, which have no meaning for all parameters.
_AT_VALUES_ONLY = frozenset({"measurability", "saturation", "sampled-stable", "adjustable"})


def for_all_parameters(derivation: Derivation) -> tuple[Claim, ...]:
    """The claims that make sense without values, decided for all positive parameters.

    Raises ModelError for a model without parameters.
    """
    wide = Wide(derivation)
    if not wide.values:
        raise ModelError(
            "the model has no parameters: name its constants with pbcgen.Parameters to check it for all positive values"
        )
    found = {verdict.claim.claim: verdict.claim for verdict in _verdicts(wide)}
    own = {claim.claim: claim for claim in derivation.claims}
    return tuple(_with_own_values(wide, found[name], own.get(name)) for name in CLAIMS if name in found)


def _with_own_values(wide: Wide, claim: Claim, own: Claim | None) -> Claim:
    """What is refuted at the model's own values does not hold for all; where only a condition is known, it fails."""
    if own is None or own.status is not Status.REFUTED or claim.status is not Status.UNDECIDED:
        return claim
    if any(value <= 0 for value in wide.values.values()):
        return claim
    values = wide.own_values()
    shown = {"parameters": values, **(own.counterexample or {})}
    why = f"not so at the model's own values: {own.evidence}"
    return replace(claim, status=Status.REFUTED, method=own.method, evidence=why, hint=own.hint, counterexample=shown)


@dataclass(frozen=True)
class _Passive:
    """What was found of the power balance."""

    structure: PowerStructure | None
    by_structure: bool
    proved: bool


def _verdicts(wide: Wide) -> Iterator[Verdict]:
    """One after the other, each with what it rests on."""
    if jump := wide.jump:
        why = f"the model, gamma or eta may jump by `{jump}`, at states that the parameters move"
        named = [claim.claim for claim in wide.derivation.claims if claim.claim not in _AT_VALUES_ONLY]
        yield from (Verdict(undecided(name, EVERYWHERE, why)) for name in named if name != "gain-definiteness")
        return
    passive, storage = _storage(wide)
    output = _output(wide, passive)
    point, equilibrium = _equilibrium(wide)
    matched = _matched(wide, passive)
    found = {claim.claim: Verdict(claim) for claim in (storage, output, equilibrium)}
    found |= {verdict.claim.claim: verdict for verdict in _at_target(wide, point)}
    strict = False
    kept = {claim.claim for claim in wide.derivation.claims}
    if isinstance(wide.base, NaturalDamping):
        damping = assumption_3(wide, matched)
        shaped = theta(wide, damping)
        strict = shaped.strict
        found |= {"assumption-3": damping.verdict, "theta": shaped.verdict}
    yield from found.values()
    if wide.law is not None:
        stability = Stability(wide, point, matched, found, strict)
        stable, attractive = stability.stable(), stability.attractive()
        if stable.status is Status.UNDECIDED and attractive.status is not Status.UNDECIDED and not stability.where:
            stable = replace(attractive, claim="stable")  # a loop that is Hurwitz, or has a growing mode
        yield Verdict(stable)
        yield Verdict(attractive)
        if "globally-asymptotically-stable" in kept:
            yield Verdict(stability.globally())


# --- on the whole space --------------------------------------------------------------------------------------------


def _storage(wide: Wide) -> tuple[_Passive, Claim]:
    """`assumption-1`."""
    own = wide.derivation.structure
    known = None
    method = "with exp(s) for every parameter"
    for structure in chain([] if own is None else [own], candidates(wide.given)):
        widened = wide.power_structure(structure)
        proof = prove(wide.plant, widened)
        if proof.complete:
            claim = wide.proved("assumption-1", EVERYWHERE, f"structure: {structure.origin}", method)
            return _Passive(widened, True, True), claim
        known = known or (widened if proof.identity else None)
    system = wide.plant.system
    loss = -ca.dot(wide.plant.gradient, system.f)
    try:
        if nonnegative(wide.entries(loss)[0][0]):
            claim = wide.proved("assumption-1", EVERYWHERE, "exact algebra: terms of known sign", method)
            return _Passive(known, False, True), claim
    except GIVE_UP:
        pass
    passive = _Passive(known, False, False)
    found = wide.counterexample(loss, system.x, Region.stated(wide.given).bounds)
    if found is None:
        why = "no proof of grad S^T f <= 0 with symbolic parameters"
        return passive, undecided("assumption-1", EVERYWHERE, why)
    values, x, value = found
    shown = {"parameters": values, "x": x, "grad S^T f": text(-value, 9)}
    why = f"grad S^T f = {text(-value, 6)} > 0 with {pairs(values)}"
    return passive, refuted("assumption-1", EVERYWHERE, why, "restrict the parameters by their meaning", shown)


def _output(wide: Wide, passive: _Passive) -> Claim:
    """`passive-output`, for the gamma that was found at the values."""
    if wide.gamma is None:
        return undecided("passive-output", EVERYWHERE, "no gamma was found at the values of the parameters")
    method = passive_output.prove(
        wide.plant, passive.structure, wide.gamma, passive.proved, passive.by_structure, Region.whole(wide.plant)
    )
    if method is not None and wide.is_defined(ca.jacobian(wide.gamma, wide.plant.system.x)):
        shown = ", ".join(wide.derivation.derived.get("gamma") or [])
        return wide.proved("passive-output", EVERYWHERE, method, f"gamma = {shown}")
    return undecided("passive-output", EVERYWHERE, "Z(x) >= 0 was not proved with symbolic parameters")


def _matched(wide: Wide, passive: _Passive) -> PowerStructure | None:
    """The structure that proves Assumption 1 and gives gamma, or None."""
    if wide.gamma is None or passive.structure is None or not passive.by_structure:
        return None
    psi = ca.jacobian(wide.gamma, wide.plant.system.x).T
    return passive.structure if passive_output.gives_output(wide.plant, passive.structure, psi) else None


# --- at x* -----------------------------------------------------------------------------------------------------------


def _equilibrium(wide: Wide) -> tuple[RestingPoint | None, Claim]:
    """`equilibrium`: x* and u* as functions of the parameters, where the equations give them one by one."""
    system = wide.given.system
    conditions = [
        (wide.widened(c.expression), wide.plant.number(c.value)) for c in wide.derivation.design.target.conditions
    ]
    # q' = M^-1 p vanishes with p only; then p' = G u - grad V.
    mechanics = wide.plant.system.mechanical
    rates = [wide.plant.system.xdot]
    if mechanics is not None and wide.plant.gradient_is_exact and wide.defined:
        rates = [mechanics.p, ca.mtimes(mechanics.G, wide.plant.system.u) - ca.gradient(mechanics.V, mechanics.q)]
    elif mechanics is not None:
        rates = [mechanics.p, *rates]
    equations = [*rates, *(expression - value for expression, value in conditions)]
    point = resting_point(wide.plant, ca.vertcat(*equations))
    if point is None:
        why = "the equations of x* are not solved one by one with coefficients that never vanish"
        return None, undecided("equilibrium", AT_TARGET, why)
    for name, (lo, hi) in system.domain.items():
        value = point.values[system.state_names.index(name)].constant()
        if value is None or (lo is not None and value <= rational(lo)) or (hi is not None and value >= rational(hi)):
            return None, undecided("equilibrium", AT_TARGET, f"{name} may leave the inside of the domain")
    shown = [
        f"{name} = {wide.text(value)}"
        for name, value in zip((*system.state_names, *system.input_names), point.values, strict=True)
        if not value.is_zero()
    ]
    evidence = f"x* and u* are functions of the parameters: {', '.join(shown)}" if shown else "x* = 0 and u* = 0"
    return point, wide.proved("equilibrium", AT_TARGET, "elimination over Q(parameters)", evidence)


def _at_target(wide: Wide, point: RestingPoint | None) -> Iterator[Verdict]:
    """The claims on matrices at x*."""
    law, base, system = wide.law, wide.base, wide.plant.system
    gram = ca.mtimes(system.g.T, system.g)
    if point is not None or not ca.depends_on(gram, system.x):
        yield decide_definite(wide, "input-rank", gram if point is None else point.put_in(gram), "g^T g > 0")
    kept = {c.claim: c for c in wide.derivation.claims}
    if "gain-definiteness" in kept:  # gains have no parameters
        yield Verdict(replace(kept["gain-definiteness"], domain=EVERYWHERE))
    if point is None or wide.gamma is None or law is None:
        names = ("gradient-condition", "hessian-condition", "kc-bound")
        unknown = "x* is not known as a function of the parameters"
        yield from (Verdict(undecided(n, AT_TARGET, unknown)) for n in names if n in kept)
        return
    energy = _energy(wide)
    yield Verdict(_gradient(wide, point.put_in(ca.gradient(energy, system.x))))
    N = ca.jacobian(wide.gamma, system.x)
    curvature = ca.hessian(energy, system.x)[0]

    def hessian(A: ca.SX) -> ca.SX:
        return point.put_in(curvature + ca.mtimes([N.T, A, N]))

    A, symbols = (wide.diagonal(wide.alpha_beta, symbolic) for symbolic in (False, True))
    gains = wide.alpha_beta
    shaped = decide_definite(wide, "hessian-condition", hessian(A), "hess S_d > 0", hessian(symbols), gains)
    yield shaped
    if base is None or isinstance(base, PassiveOutput | Integral):
        return

    def extended(A: ca.SX, K_c: ca.SX) -> ca.SX:
        side = point.put_in(ca.mtimes(A, N))
        return ca.vertcat(ca.horzcat(hessian(A), side.T), ca.horzcat(side, A + K_c))

    K_c = wide.matrix(base.K_c)
    named = extended(symbols, wide.diagonal(wide.K_c, symbolic=True) if wide.K_c else K_c)
    both = (*gains, *wide.K_c)
    yield decide_definite(
        wide, "kc-bound", extended(A, K_c), "hess S_dc > 0", named, both, shaped.against, system.n + 1
    )


def _energy(wide: Wide) -> ca.SX:
    """``S - gamma^T u`` with u held, or the kinetic energy where grad V is compensated."""
    system = wide.plant.system
    if wide.compensation is not None and system.mechanical is not None:
        return system.S - system.mechanical.V
    assert wide.gamma is not None
    return system.S - ca.dot(wide.gamma, system.u)


def _gradient(wide: Wide, value: ca.SX) -> Claim:
    """`gradient-condition`."""
    name = "gradient-condition"
    try:
        if all(entry.is_zero() for row in wide.entries(value) for entry in row):
            evidence = "grad S + grad gamma kappa = 0 at x*, as functions of the parameters"
            return wide.proved(name, AT_TARGET, "exact identities", evidence)
    except GIVE_UP:
        pass
    return undecided(name, AT_TARGET, "the gradient was not proved to vanish")
