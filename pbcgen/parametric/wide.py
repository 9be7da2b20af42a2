"""A design whose parameters have no values: exp(s) stands for each of them, with a free number s.

What exact algebra proves of functions with s among their symbols holds for all positive parameters; no prover has to
know of parameters. Gains are numbers, and stand beside as positive symbols too, for conditions that name them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pbcgen.control.derive import Derivation
from pbcgen.errors import UnsupportedOperation
from pbcgen.law.compensation import compensated_force
from pbcgen.models.affine import AffineSystem, Brayton, Mechanics, Structure
from pbcgen.models.exact import decimal
from pbcgen.models.gains import is_diagonal
from pbcgen.models.laws import BaseLaw, NaturalDamping, base_law, shaping
from pbcgen.models.parameters import Parameters
from pbcgen.passivity.inertia import missing_for_definiteness
from pbcgen.passivity.plant import Plant, SymbolicPlant
from pbcgen.passivity.region import undefined
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.nonnegative import Everywhere
from pbcgen.proof.refute import refute
from pbcgen.proof.seeker import Question
from pbcgen.symbolic.display import formula
from pbcgen.symbolic.field import Quotient
from pbcgen.symbolic.linear import Inconsistent
from pbcgen.symbolic.real import BITS, REAL, ZERO, Real, precision, rational, text
from pbcgen.symbolic.real_matrices import RealMatrix
from pbcgen.symbolic.tape import Tape

PARAMETERS = "all positive parameters"
EVERYWHERE = f"all x, {PARAMETERS}"
AT_TARGET = f"at x*, {PARAMETERS}"
NEAR_TARGET = f"near x*, {PARAMETERS}"

#: A counterexample is looked for where each parameter is within such a factor of its value.
REACHES = (100,)
#: The same where a formula shows that it fails for small or large values; the smallest first.
FAR_REACHES = (10, 10**6)

#: What exact functions may raise where they cannot be made.
GIVE_UP = (UnsupportedOperation, ZeroDivisionError, Inconsistent)


@dataclass(frozen=True)
class Gain:
    """A gain, or a product of gains, as a number and as a positive symbol."""

    label: str
    value: Fraction
    symbol: ca.SX


class Wide:
    """The design with exp(s) for every parameter that the user has named.

    Attributes:
        given: the system at the values.
        plant: the system without values. law, base: with and without the integral term.
        p, s: the parameters, and the logarithms in their place.
        gamma, eta: m x 1 and s x 1 expressions, or None.
        alpha_beta, K_c, K_l_R_l: gains by channel; none where the law has none, or no diagonal one.
        defined: whether f, g and grad S are certainly smooth for all x and all positive parameters.
    """

    def __init__(self, derivation: Derivation) -> None:
        self.derivation, self.law = derivation, derivation.law
        self.base = base_law(self.law)
        self.given: Plant = derivation.plant
        system, parameters = self.given.system, self.given.system.parameters
        chosen = [name for name in parameters.names if name not in parameters.numbers]
        self.values = {name: parameters.values[name] for name in chosen}
        self.p = ca.vertcat(ca.SX(0, 1), *[parameters[name] for name in chosen])
        gains = _gain_values(self.base)
        taken = {*system.state_names, *system.input_names}
        self.shown = {_fresh(f"ln_{name}", taken): name for name in chosen}
        hidden = {_fresh(f"ln_gain_{k}", taken): label for k, (_, label, _) in enumerate(gains)}
        fixed = {name: parameters.values[name] for name in sorted(parameters.numbers)}
        logarithms = Parameters(**dict.fromkeys([*self.shown, *hidden], 0)).joined(**fixed)
        self.s = ca.vertcat(ca.SX(0, 1), *[logarithms[name] for name in self.shown])
        self.gain_names = tuple(hidden)
        self.shown |= hidden
        found = [
            (kind, Gain(label, value, ca.exp(logarithms[name])))
            for (kind, label, value), name in zip(gains, hidden, strict=True)
        ]
        self.alpha_beta, self.K_c, self.K_l_R_l = (
            tuple(gain for kind, gain in found if kind == wanted) for wanted in ("alpha beta", "K_c", "K_l R_l")
        )
        self._old = ca.vertcat(self.p, *[parameters[name] for name in fixed])
        self._new = ca.vertcat(ca.exp(self.s), *[logarithms[name] for name in fixed])
        wide = AffineSystem(
            system.x,
            system.u,
            self.widened(system.f),
            self.widened(system.g),
            self.widened(system.S),
            parameters=logarithms,
            structure=self._structure(system.structure or Structure()),
        )
        self.plant: SymbolicPlant = self.given.symbolic(wide)
        self.gamma = None if derivation.gamma is None else self.widened(derivation.gamma)
        self.eta = None if derivation.eta is None else self.widened(derivation.eta)
        self.prover = Everywhere()
        self.defined = self._is_smooth()

    # --- expressions and functions --------------------------------------------------------------------------------

    def widened(self, expression: ca.SX) -> ca.SX:
        """The expression with exp(s) for the parameters; numbers that stand in the model stay numbers."""
        return ca.substitute(ca.SX(expression), self._old, self._new) if expression.numel() else ca.SX(expression)

    def _structure(self, own: Structure) -> Structure:
        """What the front end knows, with exp(s) for the parameters."""
        mechanics, circuit, w = own.mechanical, own.circuit, self.widened
        if mechanics is not None:
            parts = (mechanics.M, mechanics.M_inv, mechanics.V, mechanics.D, mechanics.G)
            rest = (mechanics.velocity, mechanics.energy_gradient)
            factors = tuple((w(J), w(W)) for J, W in mechanics.factors)
            M, M_inv, V, D, G, velocity, slope = map(w, (*parts, *rest))
            mechanics = Mechanics(mechanics.q, mechanics.p, M, M_inv, V, D, G, velocity, slope, factors)
        if circuit is not None:
            P = None if circuit.P is None else w(circuit.P)
            derived = (circuit.P_gradient, circuit.P_hessian, circuit.Xi, circuit.Q_tilde, circuit.g_tilde)
            slope, hessian, Xi, Q_tilde, g_tilde = map(w, derived)
            circuit = Brayton(w(circuit.Q), P, slope, hessian, Xi, Q_tilde, g_tilde, circuit.currents)
        F, A = (None if matrix is None else w(ca.SX(matrix)) for matrix in (own.F, own.A))
        return Structure(F, A, mechanics, circuit)

    def power_structure(self, own: PowerStructure) -> PowerStructure:
        """A power structure with exp(s) for the parameters."""
        matrix, rho = (self.plant.numbers_of(self.given, self.widened(e)) for e in (own.matrix, own.remainder))
        return PowerStructure(own.form, matrix, rho, own.origin, own.known)

    @property
    def compensation(self) -> ca.SX | None:
        """grad V under potential compensation, else None."""
        return compensated_force(self.plant.system, self.law)

    def exact(self, *expressions: ca.SX) -> list[list[list[Quotient]]]:
        """Matrices of exact functions of (x, u, s), of one field; see :data:`GIVE_UP`."""
        field, matrices = self.plant.exact(*map(ca.densify, expressions))
        return [matrix.dense(field.const(0)) for matrix in matrices]

    def entries(self, expression: ca.SX) -> list[list[Quotient]]:
        """A matrix of exact functions; see :data:`GIVE_UP`.

        Raises UnsupportedOperation too where it may not be defined for all positive parameters.
        """
        field, (matrix,) = self.plant.exact(ca.densify(expression))
        if undefined(field, self.prover, len(field.names)):
            raise UnsupportedOperation("it is not certainly defined for all positive parameters")
        return matrix.dense(field.const(0))

    def is_defined(self, *functions: ca.SX) -> bool:
        """Whether the functions are certainly defined and smooth for all x and all positive parameters."""
        try:
            field, _ = self.plant.exact(*functions)
            return not undefined(field, self.prover, len(field.names))
        except GIVE_UP:
            return False

    def _is_smooth(self) -> bool:
        """Whether f, g and grad S are; those of a mechanical system are where M, V, D and G are and M > 0."""
        system, mechanics = self.plant.system, self.plant.system.mechanical
        if mechanics is not None and self.plant.gradient_is_exact and not missing_for_definiteness(self.plant):
            return self.is_defined(mechanics.M, mechanics.V, mechanics.D, mechanics.G)
        return self.is_defined(system.f, system.g, self.plant.gradient)

    @property
    def jump(self) -> str:
        """An operation by which the model, gamma or eta may jump, or nothing; derivatives do not show it."""
        own, system, mechanics = self.derivation, self.given.system, self.given.system.mechanical
        parts = [system.f, system.g, system.S, *(e for e in (own.gamma, own.eta) if e is not None)]
        parts += [mechanics.M, mechanics.V, mechanics.D, mechanics.G] if mechanics is not None else []
        return self.given.jumps(*parts, *(c.expression for c in own.design.target.conditions))

    # --- gains ----------------------------------------------------------------------------------------------------

    def diagonal(self, gains: Iterable[Gain], symbolic: bool = False) -> ca.SX:
        """Gains as a diagonal matrix, of exact numbers or of symbols."""
        return ca.diag(
            ca.vertcat(*[g.symbol if symbolic and g.value > 0 else self.plant.number(g.value) for g in gains])
        )

    def matrix(self, rows: Sequence[Sequence[Fraction]]) -> ca.SX:
        """A gain as a matrix of exact numbers."""
        return ca.vertcat(*[ca.horzcat(*[self.plant.number(v) for v in row]) for row in rows])

    # --- words ----------------------------------------------------------------------------------------------------

    def text(self, function: Quotient) -> str:
        """An exact function of the parameters and the gains, by their names."""
        return self.named(formula(function, range(len(function.field.names))))

    def named(self, shown: str) -> str:
        """A text with the parameters in place of exp(s)."""

        def name(found: re.Match[str]) -> str:
            label = self.shown.get(found["name"])
            if label is None:
                return found[0]
            is_part = found["before"] or found["after"]
            return f"{found['before']}{f'({label})' if '*' in label and is_part else label}{found['after']}"

        return re.sub(r"(?P<before>/?)exp\((?P<name>\w+)\)(?P<after>\^?)", name, shown)

    def proved(self, name: str, domain: str, method: str, evidence: str) -> Claim:
        """A verdict; it says so when the model is not defined for all positive parameters."""
        where = domain if self.defined else f"{domain}, where the model is defined"
        others = [n for n, value in self.values.items() if value <= 0]
        note = f"; this does not speak of the model's own {', '.join(others)}, which is not positive" if others else ""
        return Claim(name, Status.PROVED, where, method, evidence + note)

    def own_values(self) -> dict[str, str]:
        """The parameters of the model itself, for a counterexample."""
        return {name: decimal(value) for name, value in self.values.items()}

    # --- counterexamples ------------------------------------------------------------------------------------------

    def at_parameters(self, expression: ca.SX) -> AtParameters:
        """A matrix of functions of s, to be evaluated at positive parameters."""
        at_values = ca.densify(ca.substitute(expression, self.s, ca.log(self.p)))
        numbers = self.plant.values
        places = [k for k, name in enumerate(self.plant.parameter_names) if name in numbers]
        extra = ca.vertcat(ca.SX(0, 1), *[self.plant.parameter_symbols[k] for k in places])
        return AtParameters(
            Tape.of([self.p, extra], [at_values]),
            ca.Function("at", [self.p, extra], [at_values]),
            tuple(numbers[self.plant.parameter_names[k]] for k in places),
        )

    def counterexample(
        self,
        value: ca.SX,
        x: ca.SX,
        bounds: Sequence[tuple[Fraction | None, Fraction | None]] = (),
        reaches: Sequence[int] = REACHES,
    ) -> tuple[dict[str, str], dict[str, str], Real] | None:
        """Positive rational parameters and a state with a certainly negative value, or None.

        Args:
            value: scalar expression of x and s.
            x: the states to search over, none for claims at x*.
            bounds: theirs.
            reaches: how far parameters may be from their values, as factors that are tried one after the other.
        """
        if any(v <= 0 for v in self.values.values()):
            return None
        at_values = ca.substitute(value, self.s, ca.log(self.p))
        symbols = ca.vertcat(x, self.p)
        numbers = self.plant.values
        places = [k for k, name in enumerate(self.plant.parameter_names) if name in numbers]
        extra = ca.vertcat(ca.SX(0, 1), *[self.plant.parameter_symbols[k] for k in places])
        fixed = [numbers[self.plant.parameter_names[k]] for k in places]
        tape = Tape.of([symbols, extra], [at_values])
        numeric = ca.substitute(at_values, extra, ca.DM([float(v) for v in fixed])) if fixed else at_values

        def exact(point: Sequence[Real]) -> Real:
            with precision(BITS):
                return tape.walk(REAL, [list(point), [rational(v) for v in fixed]])[0].dense(ZERO)[0][0]

        for reach in reaches:
            box = (*bounds, *((v / reach, v * reach) for v in self.values.values()))
            try:
                found = refute(Question(numeric, symbols, exact, box))
            except UnsupportedOperation:
                return None
            if found.point is not None and found.value is not None:
                n = x.numel()
                shown = [text(rational(v), 17) for v in found.point]
                states = dict(zip(self.given.system.state_names, shown[:n], strict=True)) if n else {}
                return dict(zip(self.values, shown[n:], strict=True)), states, found.value
        return None


@dataclass(frozen=True, eq=False)
class AtParameters:
    """A matrix of functions of the parameters, and of fixed numbers."""

    tape: Tape
    function: ca.Function
    fixed: tuple[Fraction, ...]

    def rounded(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """In double precision."""
        return np.array(self.function(values, [float(v) for v in self.fixed]))

    def exact(self, values: Sequence[Fraction]) -> RealMatrix:
        """In exact numbers or balls."""
        with precision(BITS):
            found = self.tape.walk(REAL, [[rational(v) for v in values], [rational(v) for v in self.fixed]])
            return found[0].dense(ZERO)


def _gain_values(base: BaseLaw | None) -> list[tuple[str, str, Fraction]]:
    """(kind, label, value) of the gains that conditions speak of, where they are diagonal."""
    if base is None:
        return []
    damped = isinstance(base, NaturalDamping)
    term = shaping(base)
    sub = "_c" if damped else ""
    m = len(term.alpha)
    ends = [""] if m == 1 else [f"_{i + 1}" for i in range(m)]
    found = [
        ("alpha beta", f"alpha{sub}{end}*beta{sub}{end}", value)
        for end, value in zip(ends, term.stiffness, strict=True)
    ]
    if term.K_c is not None and is_diagonal(term.K_c):
        found += [("K_c", f"K_c{end}", term.K_c[i][i]) for i, end in enumerate(ends)]
    if isinstance(base, NaturalDamping):
        found += [("K_l R_l", f"K_l{end}*R_l{end}", base.K_l[i][i] * base.R_l[i][i]) for i, end in enumerate(ends)]
    return found


def _fresh(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def pairs(values: Mapping[str, str]) -> str:
    """``a = 1, b = 2``."""
    return ", ".join(f"{name} = {value}" for name, value in values.items())


def undecided(name: str, domain: str, why: str) -> Claim:
    """An open claim."""
    return Claim(name, Status.UNDECIDED, domain, "symbolic parameters", why, "rely on the claim at the values")


def refuted(name: str, domain: str, why: str, hint: str, counterexample: Mapping[str, object]) -> Claim:
    """A claim that fails for some positive parameters."""
    method = "ball arithmetic at rational parameters"
    return Claim(name, Status.REFUTED, domain, method, why, hint, counterexample)
