"""What holds for all positive values of the parameters, not only at their values.

Every parameter is written as exp(s) with a free number s. What exact algebra proves of the system with s among its
symbols holds for all x and all positive parameters; no prover has to know of parameters. The gains of the law and the
numbers in the target stay what they are. Nothing here is a reason to generate code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain

import casadi as ca

from pbcgen.control.derive import Derivation
from pbcgen.control.resting_point import RestingPoint, resting_point
from pbcgen.control.stability import lyapunov_premises
from pbcgen.errors import ModelError, UnsupportedOperation
from pbcgen.models.affine import AffineSystem
from pbcgen.models.laws import DynamicExtension, Integral, Law, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.models.parameters import Parameters
from pbcgen.passivity import passive_output
from pbcgen.passivity.lasalle import flow, invariant_set
from pbcgen.passivity.plant import Plant, SymbolicPlant
from pbcgen.passivity.region import Region, undefined
from pbcgen.passivity.structure import PowerStructure, candidates, prove
from pbcgen.proof.claim import CLAIMS, Claim, Status
from pbcgen.proof.elimination import definite
from pbcgen.proof.nonnegative import Everywhere, nonnegative, positive
from pbcgen.proof.refute import refute
from pbcgen.proof.seeker import Question
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import Inconsistent
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, precision, rational, text
from pbcgen.symbolic.tape import Tape

PARAMETERS = "all positive parameters"
EVERYWHERE = f"all x, {PARAMETERS}"
AT_TARGET = f"at x*, {PARAMETERS}"
NEAR_TARGET = f"near x*, {PARAMETERS}"

#: A counterexample is looked for where each parameter is within this factor of its value.
_REACH = 1000
#: Closed loops with more states are not decided by Routh's array in functions.
_LARGEST_ROUTH = 6

_GIVE_UP = (UnsupportedOperation, ZeroDivisionError, Inconsistent)


def for_all_parameters(derivation: Derivation) -> tuple[Claim, ...]:
    """The claims that make sense without values, decided for all positive parameters.

    Raises ModelError for a model without parameters.
    """
    names = derivation.plant.system.parameters.names
    if not names:
        raise ModelError(
            "the model has no parameters: name its constants with pbcgen.Parameters to check it for all positive values"
        )
    return tuple(_Wide(derivation).claims())


@dataclass(frozen=True)
class _Passive:
    """What was found of the power balance."""

    structure: PowerStructure | None
    by_structure: bool
    proved: bool


class _Wide:
    """The design with exp(s) for every parameter."""

    def __init__(self, derivation: Derivation) -> None:
        self.derivation, self.law = derivation, derivation.law
        self.given: Plant = derivation.plant
        system = self.given.system
        self.p = ca.SX(system.parameters.symbols)
        taken = {*system.state_names, *system.input_names}
        self.names = {_fresh(f"ln_{name}", taken): name for name in system.parameters.names}
        self.logarithms = Parameters(**dict.fromkeys(self.names, 0))
        self.s = ca.SX(self.logarithms.symbols)
        wide = AffineSystem(
            system.x,
            system.u,
            self.widened(system.f),
            self.widened(system.g),
            self.widened(system.S),
            parameters=self.logarithms,
        )
        self.plant: SymbolicPlant = self.given.symbolic(wide)
        self.gamma = None if derivation.gamma is None else self.widened(derivation.gamma)
        self.prover = Everywhere()
        self.defined = self.is_defined(wide.f, wide.g, self.plant.gradient)

    def widened(self, expression: ca.SX) -> ca.SX:
        """The expression with exp(s) for the parameters."""
        return ca.substitute(ca.SX(expression), self.p, ca.exp(self.s)) if expression.numel() else ca.SX(expression)

    def entries(self, expression: ca.SX) -> list[list[Quotient]]:
        """A matrix of exact functions; UnsupportedOperation or ZeroDivisionError if it is none.

        Raises UnsupportedOperation too where it may not be defined for all positive parameters.
        """
        field, (matrix,) = self.plant.exact(ca.densify(expression))
        if undefined(field, self.prover, len(field.names)):
            raise UnsupportedOperation("it is not certainly defined for all positive parameters")
        return matrix.dense(field.const(0))

    # --- claims ---------------------------------------------------------------------------------------------------

    def claims(self) -> Iterator[Claim]:
        """One after the other, each with what it rests on."""
        passive, storage = self.storage()
        output = self.output(passive)
        point, equilibrium = self.equilibrium()
        found = {claim.claim: claim for claim in (storage, output, equilibrium)}
        found |= {claim.claim: claim for claim in self.at_target(point, passive)}
        law = self.law
        if law is not None:
            missing = [name for name in lyapunov_premises(law) if not _is_proved(found.get(name))]
            premises = bool(lyapunov_premises(law)) and not missing
            found["stable"] = self.stable(premises, missing)
            found["asymptotically-stable"] = self.attractive(point, passive, premises)
        yield from (found[name] for name in CLAIMS if name in found)

    def storage(self) -> tuple[_Passive, Claim]:
        """`assumption-1`."""
        own = self.derivation.structure
        known = None
        for structure in chain([] if own is None else [own], candidates(self.given)):
            wide = PowerStructure(
                structure.form, self.widened(structure.matrix), self.widened(structure.remainder), structure.origin
            )
            proof = prove(self.plant, wide)
            if proof.complete:
                return _Passive(wide, True, True), self._passive_claim(f"structure: {structure.origin}")
            known = known or (wide if proof.identity else None)
        rate = ca.dot(self.plant.gradient, self.plant.system.f)
        try:
            power = self.entries(-rate)[0][0]
            if nonnegative(power):
                return _Passive(known, False, True), self._passive_claim("exact algebra: terms of known sign")
        except _GIVE_UP:
            pass
        system = self.given.system
        loss = -ca.dot(ca.gradient(system.S, system.x), system.f)
        found = self.counterexample(loss, system.x, Region.stated(self.given).bounds)
        if found is not None:
            values, x, value = found
            shown = {"parameters": values, "x": x, "grad S^T f": text(-value, 9)}
            why = f"grad S^T f = {text(-value, 6)} > 0 with {_pairs(values)}"
            claim = _refuted("assumption-1", EVERYWHERE, why, "restrict the parameters by their meaning", shown)
            return _Passive(known, False, False), claim
        claim = _open("assumption-1", EVERYWHERE, "no proof of grad S^T f <= 0 with symbolic parameters")
        return _Passive(known, False, False), claim

    def _passive_claim(self, method: str) -> Claim:
        return self.proved("assumption-1", EVERYWHERE, method, "with exp(s) for every parameter")

    def proved(self, name: str, domain: str, method: str, evidence: str) -> Claim:
        """A verdict; it says so when the model is not defined for all positive parameters."""
        where = domain if self.defined else f"{domain}, where the model is defined"
        others = [n for n, value in self.given.system.parameters.values.items() if value <= 0]
        note = f"; this does not speak of the model's own {', '.join(others)}, which is not positive" if others else ""
        return Claim(name, Status.PROVED, where, method, evidence + note)

    def is_defined(self, *functions: ca.SX) -> bool:
        """Whether the functions are certainly defined and smooth for all x and all positive parameters."""
        try:
            field, _ = self.plant.exact(*functions)
            return not undefined(field, self.prover, len(field.names))
        except _GIVE_UP:
            return False

    def output(self, passive: _Passive) -> Claim:
        """`passive-output`, for the gamma that was found at the values."""
        if self.gamma is None:
            return _open("passive-output", EVERYWHERE, "no gamma was found at the values of the parameters")
        method = passive_output.prove(
            self.plant, passive.structure, self.gamma, passive.proved, passive.by_structure, Region.whole(self.plant)
        )
        if method is not None and self.is_defined(ca.jacobian(self.gamma, self.plant.system.x)):
            shown = ", ".join(self.derivation.derived.get("gamma") or [])
            return self.proved("passive-output", EVERYWHERE, method, f"gamma = {shown}")
        return _open("passive-output", EVERYWHERE, "Z(x) >= 0 was not proved with symbolic parameters")

    def equilibrium(self) -> tuple[RestingPoint | None, Claim]:
        """`equilibrium`: x* and u* as functions of the parameters, where the equations give them one by one."""
        system = self.given.system
        conditions = [
            (self.widened(c.expression), self.plant.number(c.value)) for c in self.derivation.design.target.conditions
        ]
        # q' = M^-1 p vanishes with p only.
        still = [] if system.mechanical is None else [system.mechanical.p]
        equations = [*still, self.plant.system.xdot, *(expression - value for expression, value in conditions)]
        point = resting_point(self.plant, ca.vertcat(*equations))
        if point is None:
            why = "the equations of x* are not solved one by one with coefficients that never vanish"
            return None, _open("equilibrium", AT_TARGET, why)
        for name, (lo, hi) in system.domain.items():
            value = point.values[system.state_names.index(name)].constant()
            if value is None or (lo is not None and value < rational(lo)) or (hi is not None and value > rational(hi)):
                return None, _open("equilibrium", AT_TARGET, f"{name} may leave the domain for other parameters")
        method = "elimination over Q(parameters)"
        evidence = "x* and u* are functions of the parameters, defined for all positive ones"
        return point, self.proved("equilibrium", AT_TARGET, method, evidence)

    # --- at x* ----------------------------------------------------------------------------------------------------

    def at_target(self, point: RestingPoint | None, passive: _Passive) -> Iterator[Claim]:
        """The claims on matrices at x*."""
        law, base = self.law, _base(self.law)
        g = self.plant.system.g
        gram = ca.mtimes(g.T, g)
        if point is not None or not ca.depends_on(gram, self.plant.system.x):
            yield self.is_definite("input-rank", gram if point is None else point.put_in(gram), "rank g = m")
        kept = {c.claim: c for c in self.derivation.claims}
        if "gain-definiteness" in kept:  # gains have no parameters
            own = kept["gain-definiteness"]
            yield Claim(own.claim, own.status, EVERYWHERE, own.method, own.evidence, own.hint, own.counterexample)
        for name in ("assumption-3", "theta"):
            if name in kept:
                yield _open(name, EVERYWHERE, "Lambda is computed at the values of the parameters only")
        if point is None or self.gamma is None or law is None:
            names = ("gradient-condition", "hessian-condition", "kc-bound")
            yield from (
                _open(n, AT_TARGET, "x* is not known as a function of the parameters") for n in names if n in kept
            )
            return
        system = self.plant.system
        energy = self.energy(base)
        yield self.gradient(point.put_in(ca.gradient(energy, system.x)))
        N = ca.jacobian(self.gamma, system.x)
        A, K_c = self.stiffness(base), self.filter(base)
        H = ca.hessian(energy, system.x)[0] + ca.mtimes([N.T, A, N])
        yield self.is_definite("hessian-condition", point.put_in(H), "hess S_d > 0")
        if K_c is not None:
            side = ca.mtimes(A, N)
            full = ca.vertcat(ca.horzcat(H, side.T), ca.horzcat(side, A + K_c))
            yield self.is_definite("kc-bound", point.put_in(full), "hess S_dc > 0")

    def energy(self, base: Law | None) -> ca.SX:
        """``S - gamma^T u`` with u held, or the kinetic energy where grad V is compensated."""
        system, mechanics = self.plant.system, self.given.system.mechanical
        if isinstance(base, PotentialCompensation) and mechanics is not None:
            return system.S - self.widened(mechanics.V)
        assert self.gamma is not None
        return system.S - ca.dot(self.gamma, system.u)

    def gradient(self, value: ca.SX) -> Claim:
        """`gradient-condition`."""
        try:
            if all(entry.is_zero() for row in self.entries(value) for entry in row):
                evidence = "grad S + grad gamma kappa = 0 at x*, as functions of the parameters"
                return self.proved("gradient-condition", AT_TARGET, "exact identities", evidence)
        except _GIVE_UP:
            pass
        return _open("gradient-condition", AT_TARGET, "the gradient was not proved to vanish")

    def is_definite(self, name: str, matrix: ca.SX, shown: str) -> Claim:
        """A claim that a symmetric matrix of functions of the parameters is positive definite."""
        try:
            if definite(self.entries(matrix)):
                evidence = f"{shown} by elimination, every pivot is positive"
                return self.proved(name, AT_TARGET, "exact algebra over Q(parameters)", evidence)
        except _GIVE_UP:
            pass
        at_values = ca.substitute(matrix, self.s, ca.log(self.p))
        for k in range(1, matrix.shape[0] + 1):
            minor = ca.det(at_values[:k, :k])
            found = self.counterexample(minor, ca.SX(0, 1), ())
            if found is not None:
                values, _, value = found
                why = f"the leading minor of order {k} is {text(value, 6)} < 0 with {_pairs(values)}"
                return _refuted(
                    name, AT_TARGET, why, "raise the gains, or restrict the parameters", {"parameters": values}
                )
        return _open(name, AT_TARGET, f"{shown} was not proved with symbolic parameters")

    # --- stability ------------------------------------------------------------------------------------------------

    def stable(self, premises: bool, missing: Sequence[str]) -> Claim:
        """`stable`, by the Lyapunov function only."""
        if premises:
            evidence = "its premises hold for all positive parameters"
            return self.proved("stable", NEAR_TARGET, "Lyapunov function", evidence)
        why = "open for " + ", ".join(missing) if missing else "there is no Lyapunov function for this law"
        return _open("stable", NEAR_TARGET, why)

    def attractive(self, point: RestingPoint | None, passive: _Passive, premises: bool) -> Claim:
        """`asymptotically-stable`: LaSalle's set consists of isolated equilibria, or Routh's array in functions."""
        name, tried = "asymptotically-stable", "LaSalle's set and Routh's array were tried with symbolic parameters"
        if point is None or self.gamma is None:
            return _open(name, NEAR_TARGET, "x* is not known as a function of the parameters")
        try:
            loop = self.entries(point.put_in(self.closed_loop()))
            if premises and passive.structure is not None and passive.by_structure:
                steps = self.resting(passive.structure)
                if steps is not None and _is_regular(loop):
                    evidence = f"where the Lyapunov function rests: {'; '.join(steps)}; and x* is isolated"
                    return self.proved(name, NEAR_TARGET, "Lyapunov function and LaSalle's set", evidence)
            if len(loop) <= _LARGEST_ROUTH and _is_hurwitz(loop):
                evidence = "every entry of the first column is positive"
                return self.proved(name, NEAR_TARGET, "linearisation: Routh's array over Q(parameters)", evidence)
        except _GIVE_UP as reason:
            return _open(name, NEAR_TARGET, f"{tried}; {reason}")
        return _open(name, NEAR_TARGET, tried)

    def resting(self, structure: PowerStructure) -> tuple[str, ...] | None:
        """The chain of implications after which nothing moves, or None."""
        base, mechanics = _base(self.law), self.given.system.mechanical
        if isinstance(base, NaturalDamping) or self.gamma is None:
            return None
        comp = None
        if isinstance(base, PotentialCompensation) and mechanics is not None:
            comp = self.widened(ca.gradient(mechanics.V, mechanics.q))
        try:
            found = invariant_set(flow(self.plant, structure, self.gamma, comp))
        except _GIVE_UP:
            return None
        return tuple(map(self._named, found.steps)) if found.resting else None

    def _named(self, step: str) -> str:
        """A step with the parameters in place of exp(s)."""
        for fresh, name in self.names.items():
            step = step.replace(f"exp({fresh})", name)
        return step

    def closed_loop(self) -> ca.SX:
        """The Jacobian of the closed loop in (x, x_c, x_l) at rest: tanh has slope one there."""
        base, system, mechanics = _base(self.law), self.plant.system, self.given.system.mechanical
        if isinstance(self.law, Integral) or base is None or self.gamma is None:
            raise UnsupportedOperation("the closed loop of this law is not written with symbolic parameters")
        N, A, K_c = ca.jacobian(self.gamma, system.x), self.stiffness(base), self.filter(base)
        open_loop = ca.jacobian(system.xdot, system.x)
        if isinstance(base, PassiveOutput):
            k_p = self.numbers(base.k_p)
            loop = ca.SX.eye(system.m) + ca.mtimes([k_p, N, system.g])
            pull = ca.solve(loop, ca.mtimes(A, N) + ca.mtimes([k_p, N, open_loop]))
            return open_loop - ca.mtimes(system.g, pull)
        assert isinstance(base, DynamicExtension | PotentialCompensation | NaturalDamping)
        assert K_c is not None
        R_c, zero = self.matrix(base.R_c), ca.SX(system.m, system.m)
        # u = u* + held - (sum of pulls), and xi' = -(gain) (pull of the own term), with pulls linear in (x, x_c, x_l).
        terms = [(R_c, ca.mtimes(A, N), A, A + K_c)]
        if isinstance(base, NaturalDamping):
            if self.derivation.eta is None or base.Upsilon is None:
                raise UnsupportedOperation("there is no eta")
            B = self.numbers([a * b for a, b in zip(base.alpha_l, base.beta_l, strict=True)])
            read = ca.mtimes([B, self.matrix(base.Upsilon), ca.jacobian(self.widened(self.derivation.eta), system.x)])
            soft = ca.mtimes(B, self.matrix(base.K_l))
            terms.append((self.matrix(base.R_l), read, soft, soft))
        held = ca.SX(system.m, system.n)
        if isinstance(base, PotentialCompensation) and mechanics is not None:
            held = ca.jacobian(self.widened(ca.gradient(mechanics.V, mechanics.q)), system.x)
        driven = held - sum((read for _, read, _, _ in terms), ca.SX(system.m, system.n))
        pulls = ca.horzcat(*[own for _, _, own, _ in terms])
        rows = [ca.horzcat(open_loop + ca.mtimes(system.g, driven), -ca.mtimes(system.g, pulls))]
        for i, (gain, read, _, own) in enumerate(terms):
            beside = [-ca.mtimes(gain, own) if i == j else zero for j in range(len(terms))]
            rows.append(ca.horzcat(-ca.mtimes(gain, read), *beside))
        return ca.vertcat(*rows)

    def numbers(self, values: Sequence[Fraction]) -> ca.SX:
        """Gains as a diagonal matrix of exact numbers."""
        return ca.diag(ca.vertcat(*[self.given.number(v) for v in values]))

    def matrix(self, rows: Sequence[Sequence[Fraction]]) -> ca.SX:
        """A gain as a matrix of exact numbers."""
        return ca.vertcat(*[ca.horzcat(*[self.given.number(v) for v in row]) for row in rows])

    def stiffness(self, base: Law | None) -> ca.SX:
        """diag(alpha beta)."""
        alpha, beta = (
            (base.alpha_c, base.beta_c) if isinstance(base, NaturalDamping) else (base.alpha, base.beta)  # type: ignore[union-attr]
        )
        return self.numbers([a * b for a, b in zip(alpha, beta, strict=True)])

    def filter(self, base: Law | None) -> ca.SX | None:
        """K_c, or None for a law without it."""
        return None if base is None or isinstance(base, PassiveOutput | Integral) else self.matrix(base.K_c)

    # --- counterexamples ------------------------------------------------------------------------------------------

    def counterexample(
        self, value: ca.SX, x: ca.SX, bounds: Sequence[tuple[Fraction | None, Fraction | None]]
    ) -> tuple[dict[str, str], dict[str, str], Real] | None:
        """Positive rational parameters and a state with a certainly negative value, or None.

        Args:
            value: scalar expression of x and the parameters.
            x: the states to search over.
            bounds: theirs.
        """
        values = self.given.system.parameters.values
        if any(v <= 0 for v in values.values()):
            return None
        symbols = ca.vertcat(x, self.p)
        # The constants of the plant are symbols too, with values of their own.
        extra = self.given.parameter_symbols[len(values) :]
        numbers = [self.given.values[name] for name in self.given.parameter_names[len(values) :]]
        tape = Tape.of([symbols, extra], [value])
        numeric = ca.substitute(value, extra, ca.DM([float(v) for v in numbers])) if numbers else value

        def exact(point: Sequence[Real]) -> Real:
            with precision(BITS):
                return tape.walk(REAL, [list(point), [rational(v) for v in numbers]])[0].dense(ZERO)[0][0]

        box = (*bounds, *((v / _REACH, v * _REACH) for v in values.values()))
        try:
            found = refute(Question(numeric, symbols, exact, box))
        except UnsupportedOperation:
            return None
        if found.point is None or found.value is None:
            return None
        n = x.numel()
        shown = [text(rational(v), 17) for v in found.point]
        states = dict(zip(self.given.system.state_names, shown[:n], strict=True)) if n else {}
        return dict(zip(values, shown[n:], strict=True)), states, found.value


def _fresh(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _base(law: Law | None) -> Law | None:
    return law.base if isinstance(law, Integral) else law


def _is_proved(claim: Claim | None) -> bool:
    return claim is not None and claim.status is Status.PROVED


def _is_regular(matrix: Sequence[Sequence[Quotient]]) -> bool:
    """Whether the determinant has one sign."""
    last = _characteristic(matrix)[-1]
    return positive(last) or positive(-last)


def _characteristic(matrix: Sequence[Sequence[Quotient]]) -> list[Quotient]:
    """Coefficients of det(s I - A), leading one first (Faddeev and LeVerrier)."""
    size = range(len(matrix))
    field = matrix[0][0].field
    zero, one = field.const(0), field.const(1)
    M = [[zero for _ in size] for _ in size]
    coefficients = [one]
    for k in range(1, len(matrix) + 1):
        product = [[sum((matrix[i][j] * M[j][c] for j in size), zero) for c in size] for i in size]
        M = [[product[i][c] + (coefficients[-1] if i == c else zero) for c in size] for i in size]
        trace = sum((matrix[i][j] * M[j][i] for i in size for j in size), zero)
        coefficients.append(-trace * field.const(Fraction(1, k)))
    return coefficients


def _is_hurwitz(matrix: Sequence[Sequence[Quotient]]) -> bool:
    """Whether every entry of the first column of Routh's array is proved positive."""
    coefficients = _characteristic(matrix)
    upper, lower = coefficients[0::2], coefficients[1::2]
    zero = coefficients[0].field.const(0)
    while lower:
        if not positive(lower[0]):
            return False
        padded = [*lower, *[zero] * (len(upper) - len(lower))]
        upper, lower = lower, [a - upper[0] / lower[0] * b for a, b in zip(upper[1:], padded[1:], strict=True)]
    return True


def _pairs(values: Mapping[str, str]) -> str:
    return ", ".join(f"{name} = {value}" for name, value in values.items())


def _open(name: str, domain: str, why: str) -> Claim:
    return Claim(name, Status.UNDECIDED, domain, "symbolic parameters", why, "rely on the claim at the values")


def _refuted(name: str, domain: str, why: str, hint: str, counterexample: Mapping[str, object]) -> Claim:
    method = "ball arithmetic at rational parameters"
    return Claim(name, Status.REFUTED, domain, method, why, hint, counterexample)
