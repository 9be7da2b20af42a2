"""What each claim says of the model up to the limits of the inputs, and how a certificate shows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from flint import arb, fmpq

from pbcgen.reading.inside import Inside
from pbcgen.reading.overall import GLOBAL
from pbcgen.reading.unseen import Unseen
from pbcgen.symbolic.plain.elimination import Elimination, put_in, slopes
from pbcgen.symbolic.plain.matrices import Matrix, blocks, diagonal, dot, is_definite, plus, product, transpose
from pbcgen.symbolic.plain.outcomes import NotCheckable, require
from pbcgen.symbolic.plain.spectra import inverse
from pbcgen.symbolic.plain.values import plain, sign, variables

_EVERYWHERE = {"assumption-1", "passive-output", "assumption-3", "theta", "gain-definiteness", "measurability", GLOBAL}
_ELSEWHERE = {"all x where the model is defined", "at x*", "near x*", "all inputs"}
_ELSEWHERE |= {"sampled loop", "sampled loop, all x"}


class Assumptions(Inside, Unseen):
    """One method for each claim and status; it raises Fails unless the certificate shows the claim."""

    def reaches(self, claim: str) -> bool:
        """Whether the domain that the certificate states for a claim is one that is checked."""
        text = self.domain[claim]
        constant = claim == "input-rank" and self.model.is_constant("g")
        if claim == "adjustable":
            return self.is_described(claim)
        return text in _ELSEWHERE or (text == "all x" and (claim in _EVERYWHERE or constant)) or self.on_box(claim)

    def once(self, check: Callable[[], None]) -> None:
        """Check what other claims have perhaps shown."""
        if check.__name__ not in self.passed:
            check()
            self.passed.add(check.__name__)

    def proved_equilibrium(self) -> None:
        """x* and u* exist, meet the target, and lie in the domain."""
        require(self.point, "there is no equilibrium")

    def refuted_equilibrium(self) -> None:
        """No real state of the domain meets the equations of a rest under the target."""
        self.nowhere(Elimination(self.field, [], self.equations({})), self.witness["equilibrium"])

    def proved_input_rank(self) -> None:
        """``g^T g > 0`` at x*."""
        require(is_definite(product(transpose(self.numbers("g")), self.numbers("g"))), "g may lose rank at x*")

    def refuted_input_rank(self) -> None:
        """``g v = 0`` at x*, or everywhere."""
        v = self.given("input-rank", "v")
        if any(v) and self.model.is_constant("g"):
            return self.zero([dot(row, v) for row in self.functions("g")], "g v is not zero")
        return require(any(v) and all(sign(dot(row, v)) == 0 for row in self.numbers("g")), "g v is not zero")

    def proved_assumption_1(self) -> None:
        """``-grad S^T f >= 0``."""
        self.nonnegative([[-self.rate("S")[0][0]]], "assumption-1")

    def refuted_assumption_1(self) -> None:
        """``grad S^T f > 0`` at a state of the domain."""
        growth = self.rates_at([*self.given("assumption-1", "x"), *[fmpq(0)] * self.m])("S")
        require(sign(growth[0]) == 1, "the storage does not grow at this state")

    def proved_passive_output(self) -> None:
        """``S' <= u^T gamma'`` for all x and u."""
        self.nonnegative(self.power, "passive-output")

    def refuted_passive_output(self) -> None:
        """``S' > u^T gamma'`` for the model's gamma, at a state and an input; or there is no gamma."""
        witness = self.witness["passive-output"]
        if "omega" in witness:
            return self.no_response(witness)
        if "gamma" not in self.model.formulas.outputs:
            return self.no_gradient(witness)
        return require(sign(self.power_there("passive-output")[0]) == -1, "the storage is passive here")

    def power_there(self, claim: str) -> tuple[Any, Callable[[str], list[Any]]]:
        """``u^T gamma' - S'`` at a state and an input of a witness, and other columns' derivatives in time there."""
        z = self.given(claim, "x")
        rate = self.rates_at(z)
        return dot(z[self.n :], rate("gamma")) - rate("S")[0], rate

    def rates_at(self, z: Sequence[Any]) -> Callable[[str], list[Any]]:
        """The derivative in time of a column by its name, at a state in the domain and an input."""
        require(self.inside(dict(zip([*self.states, *self.inputs], z, strict=True))), "the state is not in the domain")
        found = self.walk(variables(z[: self.n]))
        moved = [plain(v) for v in self.misfits(found, z[self.n :], {})]
        return lambda name: [dot(row, moved) for row in self.jacobian(found[name])]

    def proved_gradient_condition(self) -> None:
        """``grad S + grad gamma kappa = 0`` at x*: exactly, or because ``f + g u = 0`` leaves nothing else."""
        gradient = [arb(v) for v in self.shaped[0]]
        require(all(v.is_finite() and v.contains(0) for v in gradient), "the gradient is not zero")
        if all(sign(v) == 0 for v in self.shaped[0]):
            return
        if "rank" in self.witness["gradient-condition"]:
            require(not self.compensated, "another storage is shaped")
            self.once(self.proved_passive_output)
            self.reached()
            return
        drift_first = self.witness["gradient-condition"]["form"] == "F"
        f, g, M, rho = map(self.functions, ("f", "g", "matrix", "remainder"))
        e, psi = transpose(self.slope("S")), transpose(self.slope("gamma"))
        left, right, out, into = (f, e, g, psi) if drift_first else (e, f, psi, g)
        self.zero([row[0] for row in plus(plus(left, product(M, right), -1), rho)], "there is no such power structure")
        self.zero([v for row in plus(out, product(M, into)) for v in row], "grad gamma does not follow from it")
        require(all(sign(row[0]) == 0 for row in self.numbers("remainder")), "the remainder is not zero at x*")
        require(inverse(self.numbers("matrix")) if drift_first else self.are_finite("matrix"), "M is not regular at x*")

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
        Lambda = self.given("assumption-3", "Lambda_l") + self.given("assumption-3", "Lambda_c")
        eta, gamma = self.rate("eta"), self.rate("gamma")
        require(min(Lambda) > 0 and 1 <= len(eta) <= self.n - self.m, "Lambda or eta is not as it must be")
        coupling = product(self.slope("eta"), transpose(self.slope("gamma")))
        self.zero([v for row in coupling for v in row], "gamma and eta are coupled")
        self.damps("assumption-3", eta + gamma, diagonal(Lambda))

    def refuted_assumption_3(self) -> None:
        """At a state and an input power is gained, or none is lost although gamma or eta moves."""
        power, rate = self.power_there("assumption-3")
        rates = [v for name in ("gamma", "eta") if name in self.exact for v in rate(name)]
        moving = sign(power) == 0 and {1, -1} & {*map(sign, rates)}
        require(sign(power) == -1 or moving, "there may be as much damping as is asked for")

    def carried(self, Lambda: Matrix) -> Matrix:
        """Theta (Th) for (eta', y, R_l^-1 x_l'), where Lambda is what damps (eta', y)."""
        m, gains = self.m, self.model.gains
        half = [[v / 2 for v in row] for row in self.upsilon(len(Lambda) - m)]
        side = blocks([[half, diagonal([fmpq(-1, 2)] * m)]])
        return blocks([[Lambda, transpose(side)], [side, product(gains["K_l"], gains["R_l"])]])

    @property
    def theta(self) -> Matrix:
        """Theta with the constants of Assumption 3, or with a Lambda that is not diagonal."""
        self.proved_assumption_3()
        if "Lambda" in self.witness["theta"]:
            return self.carried(self.damps("theta", self.rate("eta") + self.rate("gamma"), self.matrix("theta")))
        return self.carried(diagonal(self.given("assumption-3", "Lambda_l") + self.given("assumption-3", "Lambda_c")))

    def damps(self, claim: str, rates: Matrix, Lambda: Matrix) -> Matrix:
        """Lambda, if it is symmetric and ``u^T gamma' - S' >= |rates|^2_Lambda``."""
        require(Lambda == transpose(Lambda), "Lambda is not symmetric")
        self.nonnegative(plus(self.power, product(transpose(rates), Lambda, rates), -1), claim)
        return Lambda

    def proved_theta(self) -> None:
        """``Theta >= 0``."""
        require(is_definite(self.theta, semi=True), "Theta is not positive semidefinite")

    def refuted_theta(self) -> None:
        """A state and an input at which no Lambda would do, by the Schur complement."""
        require(sign(self._spare()) == -1, "the damping suffices at this state")

    def _spare(self) -> Any:
        """``u^T gamma' - S' - |Upsilon eta' - y|^2_{(4 K_l R_l)^-1}`` at a state and an input."""
        power, rate = self.power_there("theta")
        eta, y = rate("eta"), rate("gamma")
        left = plus(product(self.upsilon(len(eta)), [[v] for v in eta]), [[v] for v in y], -1)
        gains = (self.model.gains["K_l"][i][i] * self.model.gains["R_l"][i][i] for i in range(self.m))
        return power - sum(v * v / (4 * k) for (v,), k in zip(left, gains, strict=True))

    def proved_measurability(self) -> None:
        """What the law reads is a function of what is measured, up to a constant."""
        values = self.readings.walk(self.field.lift, {"measured": self.column("measurement")})
        for name, wanted in self.signals.items():
            pairs = zip(wanted, self.readings.matrix(name, values), strict=True)
            require(all((a - b).number() is not None for a, (b,) in pairs), f"{name} is not what is read")
        self.zero([], "")

    def refuted_measurability(self) -> None:
        """A direction that no sensor sees, but the law does."""
        self.in_states()
        v, z = self.given("measurability", "v"), [*self.point[0], *self.point[1]]
        seen = self.jacobian(self.star["measurement"])
        require(all(sign(dot(row, v)) == 0 for row in seen), "the sensors see this direction")
        changes = (dot(slopes(self.field, w)[: self.n], v) for part in self.signals.values() for w in part)
        needed = {sign(put_in(self.field, self.field.lift(change), z)) for change in changes}
        require({1, -1} & needed, "the law does not need this direction")

    def proved_saturation(self) -> None:
        """Every input stays within its limits; that a force which is compensated does so is written in squares."""
        if not self.compensated:
            return require({*map(sign, self.rooms)} <= {0, 1}, "an input may leave its limits")
        steady = self.model.limits or all(map(self.field.bounded, self.force))
        require(steady, "grad V has no bound and the inputs no limits", NotCheckable)
        return self.fit(self.witness["saturation"]["limits"])

    def fit(self, limits: Sequence[Any]) -> None:
        """What is left to each limit of a force that is compensated has no negative values."""
        for room, squares in zip(self.rooms, limits, strict=True):
            self.nonnegative([[room]], "saturation", {"squares": squares})

    def refuted_saturation(self) -> None:
        """A limit is exceeded when the tanh terms are close to one, at some positions if a force is compensated."""
        rooms = self.rooms
        if self.compensated:
            x = [*self.given("saturation", "q"), *[fmpq(0)] * self.half]
            require(self.inside(dict(zip(self.states[: self.half], x, strict=False))), "the state is not in the domain")
            rooms = [put_in(self.field, room, [*x, *[fmpq(0)] * (len(self.field.symbols) - self.n)]) for room in rooms]
        require(-1 in map(sign, rooms), "no input certainly leaves its limits")
