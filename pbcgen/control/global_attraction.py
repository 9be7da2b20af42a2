"""The claim `globally-asymptotically-stable`: by a storage that grows everywhere, or refuted by another equilibrium."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction

import casadi as ca

from pbcgen.control.absolute import METHOD, absolutely_stable, far_oscillation, sectors
from pbcgen.control.escape import growth_rate
from pbcgen.control.kept_domain import is_kept, way_out
from pbcgen.control.limit_cycle import limit_cycle
from pbcgen.control.only_rest import only_rest, storage_is_convex
from pbcgen.control.other_rest import other_rest
from pbcgen.control.situation import Situation
from pbcgen.errors import UnsupportedOperation
from pbcgen.models.affine import AffineSystem
from pbcgen.models.laws import Integral, NaturalDamping
from pbcgen.passivity.passive_output import PassiveOutput, find
from pbcgen.passivity.plant import Plant, Point
from pbcgen.passivity.region import Region, why_undefined
from pbcgen.passivity.storage import assumption_1
from pbcgen.passivity.unbounded import Growth, radially_unbounded
from pbcgen.proof.claim import EVERYWHERE, Claim, Status
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, approximate, enclose, is_finite, precision, rational, text
from pbcgen.symbolic.tape import exact_decimal

#: From closed intervals to open ones, in words.
_OPEN = str.maketrans("[]", "()")


def globally(situation: Situation, by_lyapunov: bool, asymptotic: Claim, stored: Claim | None = None) -> Claim:
    """The claim `globally-asymptotically-stable`; ``stored`` is what :func:`by_storage` says, if it was asked."""
    if asymptotic.status is Status.REFUTED:
        return _verdict(
            Status.REFUTED, asymptotic.method, asymptotic.evidence, asymptotic.hint, asymptotic.counterexample
        )
    proved_or_open = stored or by_storage(situation, by_lyapunov)
    if proved_or_open.status is not Status.PROVED and by_lyapunov:
        proved_or_open = _inside(situation) or proved_or_open
    if proved_or_open.status is Status.PROVED:
        return proved_or_open
    found = other_rest(situation)
    if found is not None:
        return _second(situation, found)
    rate = growth_rate(situation)
    if rate is not None:
        return _escaping(rate)
    cycle = limit_cycle(situation)
    if isinstance(cycle, Claim):
        return replace(cycle, hint=f"the claim can only be local; {proved_or_open.hint}")
    loop = sectors(situation)
    why = None if loop is None else absolutely_stable(situation, loop)
    if why is not None:
        return _verdict(Status.PROVED, METHOD, why)
    doubt = cycle or ("" if loop is None else far_oscillation(loop))
    hint = f"simulate from far away; {proved_or_open.hint}" if doubt else proved_or_open.hint
    return replace(proved_or_open, evidence="; ".join(filter(None, [proved_or_open.evidence, doubt])), hint=hint)


def by_storage(situation: Situation, by_lyapunov: bool, bounded: frozenset[int] = frozenset()) -> Claim:
    """PROVED by the Lyapunov function, or what is missing for that; ``bounded`` are entries of gamma known to be."""
    if isinstance(situation.law, Integral):
        return _verdict(
            Status.UNDECIDED,
            "not available",
            "the linearisation of Prop. pro:int gives local stability only",
            "use the law without the integral term for a global claim",
        )
    kept = by_lyapunov and is_kept(situation)
    missing = _global_premises(situation, by_lyapunov, kept)
    if missing:
        return _verdict(Status.UNDECIDED, "Lyapunov function and LaSalle", missing[0], missing[1])
    growth = _growth(situation, bounded)
    if not growth.proved:
        return _verdict(
            Status.UNDECIDED,
            "radial unboundedness",
            growth.reason,
            _to_grow(situation),
        )
    unique = only_rest(situation)
    if unique is None:
        return _verdict(
            Status.UNDECIDED,
            "LaSalle's invariant set by elimination",
            "it was not proved that x* is the only point of the invariant set",
            "rely on the local claim; no other equilibrium was found",
        )
    proved = _verdict(
        Status.PROVED,
        "Lyapunov function, LaSalle's invariant set and radial unboundedness",
        f"{growth.reason}; {unique}",
    )
    inside = "at the ends of the domain the rates point inside, whatever the law asks for"
    stated = Region.stated(situation.plant).text
    return replace(proved, domain=stated, evidence=f"{inside}; {proved.evidence}") if kept else proved


def _verdict(
    status: Status, method: str, evidence: str, hint: str = "", counterexample: Mapping[str, object] | None = None
) -> Claim:
    return Claim("globally-asymptotically-stable", status, "all x", method, evidence, hint, counterexample)


def _global_premises(situation: Situation, by_lyapunov: bool, kept: bool) -> tuple[str, str] | None:
    if not by_lyapunov:
        return "the Lyapunov function is not available", "satisfy the claims that `stable` needs by the Lyapunov route"
    needed = ["assumption-1", "passive-output"]
    if isinstance(situation.base, NaturalDamping):
        needed.append("assumption-3")
    stated = {EVERYWHERE, Region.stated(situation.plant).text} if kept else {EVERYWHERE}
    for name in needed:
        if situation.found[name].domain not in stated:
            return f"{name} holds only on {situation.found[name].domain}", "extend the assumption to the whole space"
    if situation.plant.system.domain and not kept:
        return _not_kept(situation)
    undefined = "" if kept else why_undefined(situation.plant, Region.whole(situation.plant), 0, situation.gamma)
    if undefined:
        return undefined, "rely on the local claim"
    if not situation.branches or not all(part.resting for part in situation.branches):
        return situation.unreduced or "the invariant set was not reduced to equilibria", "rely on the local claim"
    return None


def _not_kept(situation: Situation) -> tuple[str, str]:
    """That the domain is not known to be kept, and what would help."""
    place = way_out(situation)
    stated = "the model is stated on a domain, not on the whole space"
    hint = "remove the domain if the model holds everywhere"
    if place:
        return f"{stated}, and {place} every input of the law leads out of it", f"{hint}, or start inside the region"
    return stated, hint


def _growth(situation: Situation, bounded: frozenset[int]) -> Growth:
    """Whether the storage grows in all directions: what ``kappa_i gamma_i`` adds for a bounded gamma_i is bounded."""
    if all(lo is not None and hi is not None for lo, hi in Region.stated(situation.plant).bounds):
        return Growth(True, "the domain bounds all states")
    alpha, _, _ = situation.gains
    kappa = [ZERO if i in bounded else -u for i, u in enumerate(situation.point.u)]
    grown = radially_unbounded(situation.plant, situation.gamma, alpha, kappa, situation.compensation is not None)
    if not grown.proved and storage_is_convex(situation):
        return Growth(True, "the storage is convex, and x* is a strict minimum of it")
    return grown


def _to_grow(situation: Situation) -> str:
    """What would make the storage radially unbounded, as far as that is known."""
    alpha, _, _ = situation.gains
    weak = [a for a, u in zip(alpha, situation.point.u, strict=True) if a <= abs(approximate(u))]
    rely = "rely on the local claim; `pbcgen region` finds states from where the loop certainly settles"
    return f"raise alpha above |kappa|, or {rely}" if weak and situation.compensation is None else rely


def _inside(situation: Situation) -> Claim | None:
    """PROVED for all states inside the domain, or None.

    ``x_k = a_k + exp(z_k)``, or ``b_k - exp(z_k)``, maps the whole space one-to-one on ``x_k > a_k``, or ``x_k < b_k``,
    smoothly both ways; so does ``x_k = a_k + (b_k - a_k) exp(z_k) / (1 + exp(z_k))`` on what is between a_k and b_k.
    The closed loop in z is the same one, with the same gamma, and z* is as critical a point of the storage as x* is. So
    what holds for all z holds for all x inside: no trajectory reaches the boundary, because the storage, being radially
    unbounded in z, grows without bound there.
    """
    inside = _in_logarithms(situation)
    if inside is None:
        return None
    try:
        claim = by_storage(inside, True, _bounded_outputs(situation))
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    if claim.status is not Status.PROVED:
        return None
    text_ = Region.stated(situation.plant).text.translate(_OPEN).replace(">=", ">").replace("<=", "<")
    maps = "x_k = a_k + exp(z_k), b_k - exp(z_k), or between a_k and b_k in proportion to exp(z_k) / (1 + exp(z_k))"
    evidence = f"in coordinates z with {maps}, where x_k is bounded: {claim.evidence}"
    return replace(claim, domain=text_, evidence=evidence)


def _in_logarithms(situation: Situation) -> Situation | None:
    """The situation in these coordinates, with Assumptions 1 and 2 proved for all z; or None."""
    plant, system, point = situation.plant, situation.plant.system, situation.point
    if not system.domain or isinstance(situation.base, NaturalDamping) or situation.compensation is not None:
        return None
    z, x, rates, star = [], [], [], []  # type: list[ca.SX], list[ca.SX], list[ca.SX], list[Real]
    for name, value in zip(system.state_names, point.x, strict=True):
        lo, hi = system.domain.get(name, (None, None))
        width = None if lo is None or hi is None else hi - lo
        if any(v is not None and exact_decimal(float(v)) != v for v in (lo, hi, width)):
            return None
        z.append(ca.SX.sym(name if lo is None and hi is None else f"ln_{name}"))
        place, rate = _opened(z[-1], lo, hi)
        x.append(place)
        rates.append(rate)
        with precision(BITS):
            star.append(_logarithm(value, lo, hi))
    gamma = _with_decimals(plant, situation.gamma)
    if gamma is None:
        return None
    f, g, S, gamma = (ca.substitute(e, system.x, ca.vertcat(*x)) for e in (system.f, system.g, system.S, gamma))
    by = ca.diag(ca.vertcat(*rates))
    inside = Plant(AffineSystem(z, system.u, by @ f, by @ g, S, parameters=system.parameters, gamma=gamma))
    storage = assumption_1(inside)
    output = find(inside, storage.structure, storage.proved, storage.by_structure) if storage.proved else None
    if not isinstance(output, PassiveOutput):
        return None
    found = {**situation.found, "assumption-1": storage.claim, "passive-output": output.claim}
    if any(claim.status is not Status.PROVED for claim in (storage.claim, output.claim)):
        return None
    structure = storage.structure if output.matched else None
    at = Point(tuple(star), point.u)
    return replace(situation, plant=inside, point=at, gamma=output.gamma, structure=structure, found=found)


def _bounded_outputs(situation: Situation) -> frozenset[int]:
    """The entries of gamma that depend only on states with two ends, and are finite on all of these intervals."""
    plant, system = situation.plant, situation.plant.system
    bounds = Region.stated(plant).bounds
    free = [x for x, (lo, hi) in zip(ca.vertsplit(system.x), bounds, strict=True) if lo is None or hi is None]
    x = [ZERO if lo is None or hi is None else enclose(lo, hi) for lo, hi in bounds]
    with precision(BITS):
        (values,) = plant.walk(plant.tape(situation.gamma), x, [ZERO] * system.m)
    own = [ca.depends_on(gamma, ca.vertcat(ca.SX(0, 1), *free)) for gamma in ca.vertsplit(situation.gamma)]
    return frozenset(i for i, row in enumerate(values) if not own[i] and is_finite(row[0]))


def _opened(z: ca.SX, lo: Fraction | None, hi: Fraction | None) -> tuple[ca.SX, ca.SX]:
    """x between its ends as a function of z on the whole line, and ``dz/dx``."""
    if lo is not None and hi is not None:
        width, power = ca.SX(float(hi - lo)), ca.exp(z)
        return ca.SX(float(lo)) + width * power / (1 + power), (1 + power) ** 2 / (width * power)
    if lo is not None:
        return ca.SX(float(lo)) + ca.exp(z), ca.exp(-z)
    return (z, ca.SX(1)) if hi is None else (ca.SX(float(hi)) - ca.exp(z), -ca.exp(-z))


def _logarithm(x: Real, lo: Fraction | None, hi: Fraction | None) -> Real:
    """z of x."""
    if lo is not None and hi is not None:
        return REAL.log((x - rational(lo)) / (rational(hi) - x))
    if lo is not None:
        return REAL.log(x - rational(lo))
    return x if hi is None else REAL.log(rational(hi) - x)


def _with_decimals(plant: Plant, expression: ca.SX) -> ca.SX | None:
    """The expression with decimals for the constants that the plant has made; None where one is none."""
    names = plant.parameter_names[len(plant.system.parameters) :]
    values = [plant.values[name] for name in names]
    if any(exact_decimal(float(v)) != v for v in values):
        return None if ca.depends_on(expression, plant.parameter_symbols) else expression
    made = plant.parameter_list[len(plant.parameter_list) - len(values) :]
    return (
        ca.substitute(expression, ca.vertcat(*made), ca.SX(ca.DM([float(v) for v in values]))) if made else expression
    )


def _escaping(rate: Fraction) -> Claim:
    return _verdict(
        Status.REFUTED,
        "a mode of the plant that grows faster than bounded inputs can hold; Routh array over the rationals",
        f"by itself a mode of the plant grows at more than {float(rate):.4g} 1/s, and the law's inputs are bounded: "
        "where this mode is large enough they never bring it back",
        "the claim can only be local; `pbcgen region` finds states from where the loop certainly settles",
        {"growth": str(rate)},
    )


def _second(situation: Situation, x: list[Real]) -> Claim:
    names, n = situation.plant.system.state_names, situation.plant.system.n
    shown = ", ".join(f"{name} = {text(v, 9)}" for name, v in zip(names, x, strict=False))
    filters = {"psi": [text(v, 15) for v in x[n:]]} if x[n:] else {}
    return _verdict(
        Status.REFUTED,
        "Krawczyk test in ball arithmetic",
        f"the closed loop has another equilibrium: {shown}",
        "the claim can only be local; start inside the region of attraction",
        {"x": dict(zip(names, [text(v, 15) for v in x[:n]], strict=True)), **filters},
    )
