"""What each claim says of the model, and how a certificate shows it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from flint import ctx, fmpq

from pbcgen.symbolic.plain.formulas import Formulas, rational
from pbcgen.symbolic.plain.matrices import Matrix, blocks, diagonal, dot, is_definite, plus, product, stable, transpose
from pbcgen.symbolic.plain.values import INCREASING, NONNEGATIVE, Grow, NotCheckable, apply, plain, sign, variables
from pbcgen.verify.system import Fails, System, require

#: Bits of the balls, and more for each state: the characteristic polynomial of a large matrix loses many.
BITS, BITS_PER_STATE = 333, 48

_AMPLITUDES = ("alpha", "alpha_c", "alpha_l", "alpha_psi", "k_p")
#: Claims with verdicts that are recorded, and that nothing here re-checks.
_UNCOVERED = ("equilibrium", "passive-output", "assumption-3", "globally-asymptotically-stable")
_MISFITS = (ArithmeticError, LookupError, TypeError, ValueError, AttributeError)


@dataclass(frozen=True)
class Finding:
    """What became of one claim: ``checked``, ``fails``, ``recorded`` (not re-checkable) or ``open`` (UNDECIDED)."""

    claim: str
    status: str
    outcome: str
    reason: str = ""


def examine(document: Mapping[str, Any]) -> list[Finding]:
    """Check every claim of a certificate."""
    bits = ctx.prec
    settings: tuple[Any, ...] = (16,)
    try:
        for _ in range(100):
            try:
                claims = Claims(document, *settings)
                ctx.prec = BITS + BITS_PER_STATE * claims.n
                return [claims.find(entry["claim"], entry["status"]) for entry in document["claims"]]
            except Grow as larger:
                settings = larger.args
    finally:
        ctx.prec = bits
    return [Finding(entry["claim"], entry["status"], "recorded", "too many arguments") for entry in document["claims"]]


class Claims(System):
    """One method for each claim and status; it raises Fails unless the certificate shows the claim."""

    def __init__(self, document: Mapping[str, Any], *settings: Any) -> None:
        super().__init__(document, *settings)
        self.readings, self.terms = Formulas.parse(document["readings"]), Formulas.parse(document["terms"])
        self.values: list[Any] = []

    def find(self, claim: str, status: str) -> Finding:
        """Check one claim."""
        check: Callable[[], None] | None = getattr(self, f"{status.lower()}_{claim.replace('-', '_')}", None)
        if status == "UNDECIDED":
            return Finding(claim, status, "open")
        try:
            if check is None:
                require(claim in _UNCOVERED and status in ("PROVED", "REFUTED"), "there is no such claim")
                raise NotCheckable("there is no check for this claim")
            check()
        except NotCheckable as reason:
            return Finding(claim, status, "recorded", str(reason))
        except Fails as reason:
            return Finding(claim, status, "fails", str(reason))
        except _MISFITS as error:
            return Finding(claim, status, "fails", f"the data do not fit ({type(error).__name__}: {error})")
        return Finding(claim, status, "checked")

    def given(self, claim: str, name: str) -> list[fmpq]:
        """Numbers of a witness."""
        return [rational(v) for v in self.witness[claim][name]]

    def nonnegative(self, matrix: Matrix, claim: str) -> None:
        """The matrix is ``sum weight * factors * v v^T`` with positive weights and factors without negative values."""
        squares = self.witness[claim].get("squares")
        if squares is None:
            raise NotCheckable("the certificate holds no decomposition into squares")
        if self.exact and not self.values:
            lifted = [self.field.lift(p) for p in self.model.parameters]
            self.values = self.terms.walk(self.field.lift, {"state": self.field.symbols, "parameter": lifted})
        for weight, factors, places in squares:
            require(rational(weight) > 0, "a weight is not positive")
            scale = self.field.lift(rational(weight))
            for factor in factors:
                scale = scale * self._factor(*factor)
            vector = [self.field.lift(0) if place is None else self.values[place] for place in places]
            matrix = plus(matrix, [[scale * a * b for b in vector] for a in vector], -1)
        self.zero([v for row in matrix for v in row], "the squares do not add up to what they stand for")

    def _factor(self, kind: str, a: int, b: int | None, alone: bool) -> Any:
        """``(T(a) - T(b)) (a - b)`` with T increasing (b = None: zero), or T(a) alone."""
        require(kind in (NONNEGATIVE if alone else INCREASING), "a factor has no sign")
        left, right = self.values[a], self.field.lift(0) if b is None else self.values[b]
        return apply(kind, left) if alone else (apply(kind, left) - apply(kind, right)) * (left - right)

    def proved_equilibrium(self) -> None:
        """x* and u* exist, meet the target, and lie in the domain."""
        require(self.point, "there is no equilibrium")

    def proved_input_rank(self) -> None:
        """``g^T g > 0`` at x*."""
        require(is_definite(product(transpose(self.numbers("g")), self.numbers("g"))), "g may lose rank at x*")

    def refuted_input_rank(self) -> None:
        """``g v = 0`` at x*."""
        v = self.given("input-rank", "v")
        require(any(v) and all(sign(dot(row, v)) == 0 for row in self.numbers("g")), "g v is not zero")

    def proved_assumption_1(self) -> None:
        """``-grad S^T f >= 0``."""
        self.nonnegative([[-self.rate("S")[0][0]]], "assumption-1")

    def refuted_assumption_1(self) -> None:
        """``grad S^T f > 0`` at a state of the domain."""
        x = self.given("assumption-1", "x")
        require(self.inside(dict(zip(self.states, x, strict=True))), "the state is not in the domain")
        found = self.walk(variables(x))
        power = product(self.jacobian(found["S"]), [[plain(v) for v in row] for row in found["f"]])
        require(sign(power[0][0]) == 1, "the storage does not grow at this state")

    def proved_passive_output(self) -> None:
        """``S' <= u^T gamma'`` for all x and u."""
        self.nonnegative(self.power, "passive-output")

    def proved_gradient_condition(self) -> None:
        """``grad S + grad gamma kappa = 0`` at x*: exactly, or because ``f + g u = 0`` leaves nothing else."""
        if all(sign(v) == 0 for v in self.shaped[0]):
            return
        f, e, M, rho = (
            self.functions("f"),
            transpose(self.slope("S")),
            self.functions("matrix"),
            self.functions("remainder"),
        )
        g, psi = self.functions("g"), transpose(self.slope("gamma"))
        drift_first = self.witness["gradient-condition"]["form"] == "F"
        left, right, out, into = (f, e, g, psi) if drift_first else (e, f, psi, g)
        self.zero([row[0] for row in plus(plus(left, product(M, right), -1), rho)], "there is no such power structure")
        self.zero([v for row in plus(out, product(M, into)) for v in row], "grad gamma does not follow from it")
        require(all(sign(row[0]) == 0 for row in self.numbers("remainder")), "the remainder is not zero at x*")
        require(not drift_first or self.is_regular("matrix"), "F may be singular at x*")

    def refuted_gradient_condition(self) -> None:
        """An entry of the gradient is not zero."""
        require({1, -1} & {sign(v) for v in self.shaped[0]}, "the gradient may be zero")

    def proved_hessian_condition(self) -> None:
        """``hess S_d > 0`` at x*."""
        require(is_definite(self.hessian_d), "hess S_d may not be positive definite")

    def refuted_hessian_condition(self) -> None:
        """``v^T hess S_d v <= 0``."""
        self._not_definite(self.hessian_d, "hessian-condition")

    def _not_definite(self, matrix: Matrix, claim: str) -> None:
        v = self.given(claim, "v")
        require(any(v) and sign(dot(v, [dot(row, v) for row in matrix])) in (0, -1), "the direction does not show it")

    def proved_kc_bound(self) -> None:
        """``hess S_dc > 0`` at (x*, 0)."""
        require(is_definite(self.hessian_dc), "hess S_dc may not be positive definite")

    def refuted_kc_bound(self) -> None:
        """``v^T hess S_dc v <= 0``."""
        self._not_definite(self.hessian_dc, "kc-bound")

    def proved_gain_definiteness(self) -> None:
        """``K_c, R_c, K_l, R_l > 0``, those that the law has."""
        gains = [self.model.gains[name] for name in ("K_c", "R_c", "K_l", "R_l") if name in self.model.gains]
        require(all(is_definite(gain) for gain in gains), "a gain is not positive definite")

    def refuted_gain_definiteness(self) -> None:
        """``v^T K v <= 0`` for a gain."""
        self._not_definite(self.model.gains[self.witness["gain-definiteness"]["gain"]], "gain-definiteness")

    def proved_assumption_3(self) -> None:
        """``u^T y - S' >= |eta'|^2_{Lambda_l} + |y|^2_{Lambda_c}``, and gamma and eta are decoupled."""
        Lambda = [v for name in ("Lambda_l", "Lambda_c") for v in self.given("assumption-3", name)]
        eta, gamma = self.rate("eta"), self.rate("gamma")
        require(min(Lambda) > 0 and 1 <= len(eta) <= self.n - self.m, "Lambda or eta is not as it must be")
        slopes = product(self.slope("eta"), transpose(self.slope("gamma")))
        self.zero([v for row in slopes for v in row], "gamma and eta are coupled")
        rates = eta + gamma
        self.nonnegative(plus(self.power, product(transpose(rates), diagonal(Lambda), rates), -1), "assumption-3")

    @property
    def theta(self) -> Matrix:
        """Theta (Th), for (eta', y, x_l'), with the constants of Assumption 3."""
        self.proved_assumption_3()
        Ll, Lc = (self.given("assumption-3", name) for name in ("Lambda_l", "Lambda_c"))
        R, K = ([gain[i][i] for i, _ in enumerate(gain)] for gain in (self.model.gains["R_l"], self.model.gains["K_l"]))
        side = product(
            diagonal([1 / (2 * r) for r in R]), blocks([[self.upsilon(len(Ll)), diagonal([fmpq(-1)] * self.m)]])
        )
        corner = diagonal([k / r for k, r in zip(K, R, strict=True)])
        return blocks([[diagonal(Ll + Lc), transpose(side)], [side, corner]])

    def proved_theta(self) -> None:
        """``Theta >= 0``."""
        require(is_definite(self.theta, semi=True), "Theta is not positive semidefinite")

    def refuted_theta(self) -> None:
        """``v^T Theta v < 0``."""
        v = self.given("theta", "v")
        require(sign(dot(v, [dot(row, v) for row in self.theta])) == -1, "the direction does not show it")

    def proved_measurability(self) -> None:
        """What the law reads is a function of what is measured, up to a constant."""
        signals = {"gamma": self.column("gamma")}
        if "natural-damping" in self.law:
            signals["eta"] = self.column("eta")
        if self.compensated:
            signals["potential"] = self.force
        if "passive-output" in self.law:
            signals |= {
                "drift": [row[0] for row in self.rate("gamma")],
                "feedthrough": [v for row in self.rate("gamma") for v in row[1:]],
            }
        values = self.readings.walk(self.field.lift, {"measured": self.column("measurement")})
        for name, wanted in signals.items():
            pairs = zip(wanted, self.readings.matrix(name, values), strict=True)
            require(all((a - b).number() is not None for a, (b,) in pairs), f"{name} is not what is read")
        self.zero([], "")

    def refuted_measurability(self) -> None:
        """A direction that no sensor sees, but gamma or eta does."""
        v = self.given("measurability", "v")
        seen = self.jacobian(self.star["measurement"])
        needed = [row for name in ("gamma", "eta") if name in self.star for row in self.jacobian(self.star[name])]
        require(all(sign(dot(row, v)) == 0 for row in seen), "the sensors see this direction")
        require({1, -1} & {sign(dot(row, v)) for row in needed}, "the law does not need this direction")

    @property
    def slacks(self) -> list[int | None]:
        """Signs of what is left to each limit when every tanh is at its worst."""
        present = [self.model.gains[name][0] for name in _AMPLITUDES if name in self.model.gains]
        sizes, centres = [sum(column, fmpq(0)) for column in zip(*present, strict=True)], self.point[1]
        if self.compensated:
            ranges = [self.field.bound(force) for force in self.force]
            centres, sizes = [c for c, _ in ranges], [a + r for a, (_, r) in zip(sizes, ranges, strict=True)]
        return [sign(b - dot(row, centres) - dot([abs(a) for a in row], sizes)) for row, b in self.model.limits]

    def proved_saturation(self) -> None:
        """Every input stays within its limits."""
        require({0, 1} >= {*self.slacks}, "an input may leave its limits")

    def refuted_saturation(self) -> None:
        """A limit is exceeded when the tanh terms are close to one."""
        require(not self.compensated and -1 in self.slacks, "no input certainly leaves its limits")

    def proved_stable(self) -> None:
        """By the Lyapunov function of Prop. pro1, pro2 or pro4, or by linearisation."""
        if "integral" in self.law or self.is_hurwitz:
            return self.proved_asymptotically_stable()
        for check in (self.proved_assumption_1, self.proved_passive_output, self.proved_gradient_condition):
            check()
        self.proved_hessian_condition()
        if "passive-output" not in self.law:
            self.proved_gain_definiteness()
            self.proved_kc_bound()
        return self.proved_theta() if "natural-damping" in self.law else None

    @cached_property
    def is_hurwitz(self) -> bool | None:
        """Whether the linearised closed loop is Hurwitz; None if that is not certain."""
        return stable(self.continuous, False)

    def proved_asymptotically_stable(self) -> None:
        """The linearisation is Hurwitz."""
        require(self.is_hurwitz, "the linearisation is not certainly Hurwitz")

    def refuted_asymptotically_stable(self) -> None:
        """The linearisation has an eigenvalue with a positive real part."""
        require(self.is_hurwitz is False, "no eigenvalue certainly has a positive real part")

    refuted_stable = refuted_asymptotically_stable

    def proved_sampled_stable(self) -> None:
        """The linearised sampled loop is Schur."""
        require(stable(self.sampled, True), "the linearised sampled loop is not certainly Schur")

    def refuted_sampled_stable(self) -> None:
        """An eigenvalue of the linearised sampled loop lies outside the unit disc."""
        require(stable(self.sampled, True) is False, "no eigenvalue certainly lies outside the unit disc")
