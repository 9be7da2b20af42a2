"""What a certificate speaks of: the model as exact functions of the state, at x* in balls, and its closed loop."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from operator import truediv
from typing import Any

from flint import arb, fmpq, fmpq_mat

from pbcgen.reading.model import Model
from pbcgen.reading.velocity import solves
from pbcgen.symbolic.plain.formulas import Formulas, Known, Lift, combination, rational
from pbcgen.symbolic.plain.matrices import Matrix, blocks, diagonal, dot, negative, plus, product, symmetric, transpose
from pbcgen.symbolic.plain.outcomes import NotCheckable, require
from pbcgen.symbolic.plain.spectra import inverse, krawczyk, zero_order_hold
from pbcgen.symbolic.plain.values import Dual, Field, Function, apply, between, partial, plain, sign, variables

#: How the names of what an equilibrium asks for begin.
RESTING = "[fg]$|target "


class Witness(dict[str, Any]):
    """What a certificate holds for a claim."""

    def __missing__(self, name: str) -> Any:
        raise NotCheckable(f"the certificate does not hold `{name}`")


class System:
    """The model, the formulas beside it, and the target of a certificate."""

    def __init__(self, document: Mapping[str, Any], *settings: Any) -> None:
        self.model = Model.parse("\n".join(document["model"]))
        self.formulas, self.terms = (Formulas.parse(document[name]) for name in ("formulas", "terms"))
        self.witness: Mapping[str, Any] = {c["claim"]: Witness(c["witness"] or {}) for c in document["claims"]}
        self.states, self.inputs, self.law = (self.model.words[name] for name in ("states", "inputs", "law"))
        self.n, self.m, self.half = len(self.states), len(self.inputs), len(self.states) // 2
        self.moves: dict[int, list[Any]] = {}  # the slopes of x* by the settings, where these are looked at
        self.document = document
        self.opened: dict[int, tuple[Any, Any]] = {}  # the ends of states that are written by exp(z)
        self.compensated = "potential-compensation" in self.law
        self.inertia = document.get("inertia", [])  # of a system that is read in positions and velocities
        # The inputs are symbols too, and so are the accelerations.
        self.field = Field(self.n + self.m + len(self.inertia), *settings)
        self.field.whole = bool(document.get("whole_angles", False))

    def walk(self, state: Sequence[Any], lift: Lift = fmpq, known: Known = None, wanted: str = "") -> dict[str, Matrix]:
        """The named matrices of the model and of the formulas at a state of any kind; ``wanted`` is how names begin."""
        found: dict[str, Matrix] = {}
        inputs = {"state": state, "parameter": [lift(p) for p in self.model.parameters]}
        for formulas in (self.formulas, self.model.formulas):  # what the model states comes last, and stands
            own = known if formulas is self.model.formulas else None
            names = [name for name in formulas.outputs if re.match(wanted, name)]
            needed = [place for name in names for place in formulas.outputs[name][2].values()]
            values = formulas.walk(lift, inputs, own, needed)
            found |= {name: formulas.matrix(name, values) for name in names}
        return found

    # --- in positions and velocities -------------------------------------------------------------------------------

    @cached_property
    def velocities(self) -> list[int]:
        """The instructions that are M^-1 p, for systems that are read in (q, v)."""
        entries = self.model.formulas.outputs["f"][2]
        return [entries[k, 0] for k in range(len(self.inertia))]

    @cached_property
    def in_velocities(self) -> bool:
        """Whether it is read in (q, v); these instructions are then defined wherever M > 0."""
        if not self.inertia:
            return False
        M = self.mass(self.field.symbols, self.field.lift)
        self.zero([v for row in plus(M, transpose(M), -1) for v in row], "M is not symmetric")
        found = solves(self.model.formulas, self.inertia, self.velocities)
        require(found and 2 * len(self.inertia) == self.n, "the velocities are not M^-1 p")
        require(not {*self.states[self.half :]} & {*self.model.domain}, "the momenta are restricted")
        return True

    def in_states(self) -> None:
        """Raise NotCheckable for what is not said of systems in (q, v)."""
        require(not self.inertia, "this is not known in positions and velocities", NotCheckable)

    def state_at(self, z: Sequence[Any], lift: Lift) -> list[Any]:
        """The state with these coordinates: (q, M v) for (q, v), else z itself or what stands between ends."""
        opened = {k: truediv(*between(*ends, apply("exp", z[k]))) for k, ends in self.opened.items()}
        z = [opened.get(k, v) for k, v in enumerate(z)]
        rows = self.mass(z, lift)
        return [*z[: self.half], *(dot(row, z[self.half :]) for row in rows)] if rows else list(z)

    def mass(self, z: Sequence[Any], lift: Lift) -> Matrix:
        """M at these positions."""
        inputs = {"state": z[: self.half], "parameter": [lift(p) for p in self.model.parameters]}
        places = [place for row in self.inertia for place in row if place is not None]
        values = self.model.formulas.walk(lift, inputs, None, places) if places else []
        return [[fmpq(0) if place is None else values[place] for place in row] for row in self.inertia]

    def moving(self, z: Sequence[Any], lift: Lift, wanted: str = "") -> dict[str, Matrix]:
        """All named matrices in these coordinates."""
        known = dict(zip(self.velocities, z[self.half :], strict=True)) if self.in_velocities else {}
        return self.walk(self.state_at(z, lift), lift, known, wanted)

    # --- as exact functions of the state ---------------------------------------------------------------------------

    def still(self, value: Any) -> Dual:
        """A constant among duals of functions."""
        return Dual(self.field.lift(value), {})

    @cached_property
    def exact(self) -> dict[str, Matrix]:
        """Model and formulas with first derivatives. After it, no function of a bounded domain can join the field.

        Conditions of the target are left out: nothing asks that they are defined elsewhere than at x*.
        """
        found = self.moving(variables(self.field.symbols[: self.n]), self.still, "(?!target )")
        self.field.closed, self.defined = True, self.field.entire(moduli=True)
        return found

    def is_defined(self, wanted: str, ends: Mapping[int, Any]) -> bool:
        """Whether matrices are certainly defined and smooth, apart from moduli, between the ends; in a new field."""
        field = Field(len(self.field.symbols), self.field.pool, self.field.units)
        field.whole, field.ends = self.field.whole, {**ends}
        self.moving(variables(field.symbols[: self.n]), lambda v: Dual(field.lift(v), {}), wanted)
        return field.entire(moduli=True)

    @cached_property
    def placed(self) -> list[Any]:
        """The terms of the witnesses as exact functions of state and input."""
        return self.terms.walk(self.field.lift, {"state": self.field.symbols}) if self.exact else []

    def functions(self, name: str) -> Matrix:
        """A matrix of exact functions that do not jump."""
        return [self.field.continued(row) for row in self.written(name)]

    def written(self, name: str) -> Matrix:
        """A matrix of exact functions."""
        return [[self.field.lift(plain(v)) for v in row] for row in self.exact[name]]

    def column(self, name: str) -> list[Function]:
        """A column of exact functions, which may jump; :func:`slopes` of them may not be asked for then."""
        return [v for (v,) in self.written(name)]

    def slope(self, name: str) -> Matrix:
        """The exact Jacobian of a column that does not jump, rows over the state."""
        found = [[self.field.lift(partial(v, k)) for k in range(self.n)] for (v,) in self.exact[name]]
        self.functions(name)
        rows = [self.field.continued(row) for row in found]
        return [self._by_momenta(row) for row in rows] if self.inertia else rows

    def _by_momenta(self, row: list[Function]) -> list[Function]:
        """The slope h_x from that by (q, v), with p = M v: ``M h_p = h_v`` and ``h_q + (M v)_q^T h_p`` is given.

        Known for functions of the positions, and for those with the slope of the kinetic energy, where h_p = v.
        """
        by_q, by_v, v = row[: self.half], row[self.half :], self.field.symbols[self.half : self.n]
        if not any(a.top for a in by_v):
            return row
        kinetic = not any((a - plain(p)).top for a, p in zip(by_v, self.momenta, strict=True))
        require(kinetic, "a function of the momenta is not the kinetic energy", NotCheckable)
        return [a - dot([partial(p, k) for p in self.momenta], v) for k, a in enumerate(by_q)] + v

    @cached_property
    def momenta(self) -> list[Dual]:
        """p = M(q) v as exact functions with slopes in (q, v)."""
        p: list[Dual] = self.state_at(variables(self.field.symbols[: self.n]), self.still)[self.half :]
        return p if self.inertia else []

    def rate(self, name: str) -> Matrix:
        """The derivative in time of each entry of a column, as coefficients of (1, u)."""
        return product(self.slope(name), blocks([[self.functions("f"), self.functions("g")]]))

    @cached_property
    def power(self) -> Matrix:
        """``u^T y - S'`` with y = gamma' as a quadratic form in (1, u): the matrix Z of Hill and Moylan."""
        ((drift, *storage),), y = self.rate("S"), self.rate("gamma")
        require(len(y) == self.m, "gamma has not one entry for each input")
        gained = [[drift, *[0] * self.m]] + [[v, *[0] * self.m] for v in storage]
        given = [[fmpq(0)] * (self.m + 1), *y]
        return symmetric(plus(given, gained, -1))

    def potential(self, q: Sequence[Any], lift: Lift) -> Any:
        """The potential energy S(q, 0)."""
        return self.moving([*q, *[lift(fmpq(0))] * self.half], lift)["S"][0][0]

    @cached_property
    def force(self) -> list[Function]:
        """grad V as exact functions."""
        V = self.potential(variables(self.field.symbols[: self.half]), self.still)
        return [self.field.lift(partial(V, k)) for k in range(self.half)]

    def zero(self, functions: Sequence[Any], otherwise: str) -> None:
        """Every function is the zero function, and no divisor so far is."""
        require(all(self.field.lift(v).top.is_zero() for v in functions), otherwise)
        size = [fmpq(1117 * k + 313, 719 * k + 1021) for k in range(len(self.field.symbols))]
        sides = [(c, c * a, c * b, c * a * b) for a in (1, -1) for b in (1, -1) for c in (1, -1)]
        points = [[self.field.within(k, v * side[k % 4]) for k, v in enumerate(size)] for side in sides]
        for divisor in self.field.divisors.values():
            values = [arb(self.field.at(divisor, point)) for point in points]
            nonzero = [sign(v) in (1, -1) for v in values if v.is_finite()]
            require(nonzero and all(nonzero), "a divisor may be the zero function")
        self.field.divisors.clear()

    # --- at x* -----------------------------------------------------------------------------------------------------

    @cached_property
    def point(self) -> tuple[list[Any], list[Any]]:
        """x* and u*, which exist: by Krawczyk's test, or because all equations hold exactly."""
        witness, names = self.witness["equilibrium"], [*self.states, *self.inputs]
        known, unknown = ({name: rational(v) for name, v in witness[part].items()} for part in ("known", "unknown"))
        rows, centre = witness["rows"], [*unknown.values()]
        require(sorted([*known, *unknown]) == sorted(names), "x* and u* are not complete")
        require(len({*rows}) == len(rows) == len(centre), "as many equations as unknowns are needed")

        def at(values: Sequence[Any]) -> dict[str, Any]:
            return known | dict(zip(unknown, values, strict=True))

        radius = rational(witness["radius"])
        box = krawczyk(lambda values: [self._residuals(at(values))[k] for k in rows], centre, radius) if rows else []
        require(box is not None, "Krawczyk's test does not hold")
        values, follows = self._residuals(at(box or [])), witness.get("follows", {})
        for k, value in enumerate(values):
            if str(k) in follows:
                self._follows(k, follows[str(k)], rows, known)
            require(k in rows or str(k) in follows or sign(value) == 0, "an equation does not hold exactly")
        z = at(box or [])
        require(self.inside(z, {1}), "x* is not in the interior of the domain")
        return [z[name] for name in self.states], [z[name] for name in self.inputs]

    def _residuals(self, z: Mapping[str, Any], lift: Lift = fmpq, moving: bool = False) -> list[Any]:
        """``f + g u``, and the differences of the target's expressions from their values."""
        state = [z[name] for name in self.states]
        found = self.moving(state, lift, RESTING) if moving else self.walk(state, lift, None, RESTING)
        return self.misfits(found, [z[name] for name in self.inputs], self.model.target)

    def misfits(self, found: Mapping[str, Matrix], u: Sequence[Any], wanted: Mapping[str, Any]) -> list[Any]:
        """``f + g u``, and the differences of the target's expressions from what is wanted."""
        rates = plus(found["f"], product(found["g"], [[v] for v in u]))
        return [v for (v,) in rates] + [found[f"target {name}"][0][0] - value for name, value in wanted.items()]

    def equations(self, known: Mapping[str, fmpq]) -> list[Function]:
        """The same as exact functions of (x, u), some of which are known; zero at an equilibrium that is asked for."""
        names = [*self.states, *self.inputs]
        z = {name: self.field.lift(known.get(name, v)) for name, v in zip(names, self.field.symbols, strict=False)}
        moving = [z[name].number() for name in self.states[self.n - len(self.inertia) :]]
        require(all(p in (None, 0) for p in moving), "momenta are known that are no velocities")
        return [self.field.lift(v) for v in self._residuals(z, self.field.lift, True)] if self.exact else []

    def _follows(self, k: int, weights: Mapping[str, str], rows: Sequence[int], known: Mapping[str, fmpq]) -> None:
        """Equation k is a combination of others that hold."""
        require({*map(int, weights)} <= {*rows}, "an equation follows from others that are not shown")
        found = self.equations(known)
        self.zero([found[k] - combination(weights, found)], "an equation does not follow from the others")

    def inside(self, z: Mapping[str, Any], slack: Collection[int] = (0, 1)) -> bool:
        """Whether these states are in the domain for sure; by default the edge is part of it."""
        bounds = [(z[name], *interval) for name, interval in self.model.domain.items() if name in z]
        return all((a is None or sign(v - a) in slack) and (b is None or sign(b - v) in slack) for v, a, b in bounds)

    @cached_property
    def star(self) -> dict[str, Matrix]:
        """Model and formulas at x* with first and second derivatives."""
        return self.walk(variables(self.point[0], 2))

    def numbers(self, name: str) -> Matrix:
        """A matrix at x*."""
        return [[self.number(v) for v in row] for row in self.star[name]]

    def are_finite(self, name: str) -> bool:
        """Whether a matrix has certain values at x*."""
        return all(arb(plain(v)).is_finite() for row in self.numbers(name) for v in row)

    def number(self, value: Any) -> Any:
        """A value at x* without its slopes by the state; with those by the settings that x* moves with."""
        if not self.moves:
            return plain(value)
        rates = {k: dot([plain(partial(value, j)) for j in range(self.n)], x) for k, x in self.moves.items()}
        return Dual(plain(value), rates)

    def jacobian(self, column: Matrix) -> Matrix:
        """The Jacobian of a column of duals."""
        return [[self.number(partial(v, k)) for k in range(self.n)] for (v,) in column]

    def hessian(self, value: Any) -> Matrix:
        """The Hessian of a dual of duals."""
        return [[self.number(partial(partial(value, i), k)) for k in range(self.n)] for i in range(self.n)]

    @cached_property
    def gamma(self) -> Matrix:
        """The Jacobian of gamma at x*, m x n."""
        return self.jacobian(self.star["gamma"])

    @cached_property
    def stiffness(self) -> Matrix:
        """diag(alpha beta)."""
        return diagonal([a * b for a, b in zip(self.model.vector("alpha"), self.model.vector("beta"), strict=True)])

    @cached_property
    def shaped(self) -> tuple[list[Any], Matrix]:
        """Gradient and Hessian at x* of the storage with u = u*: of S + gamma^T kappa, or of the kinetic energy."""
        S, half = self.star["S"][0][0], self.half
        H = self.hessian(S)
        if self.compensated:
            # p^T dS/dp = 2 (S - V): the kinetic energy is a quadratic form in p, and flat in q at p = 0.
            q, e = self.field.symbols[:half], self.slope("S")[0]
            p = [plain(v) for v in self.state_at(self.field.symbols[: self.n], self.field.lift)[half:]]
            V = plain(self.potential([self.still(s) for s in q], self.still))
            self.zero([dot(p, e[half:]) - (self.column("S")[0] - V) * 2], "S is not kinetic plus potential")
            self.zero([a - b for a, b in zip(self.column("gamma"), q, strict=True)], "gamma is not q")
            require(all(sign(v) == 0 for v in self.point[0][half:]), "the momenta at x* are not zero")
            flat, corner = diagonal([fmpq(0)] * half), [row[half:] for row in H[half:]]
            return [fmpq(0)] * self.n, blocks([[flat, flat], [flat, corner]])
        for row, u in zip(self.star["gamma"], self.point[1], strict=True):
            H = plus(H, self.hessian(row[0]), -u)
        return plus(self.jacobian(self.star["S"]), product([self.point[1]], self.gamma), -1)[0], H

    @cached_property
    def hessian_d(self) -> Matrix:
        """hess S_d at x* (hesscond)."""
        return plus(self.shaped[1], product(transpose(self.gamma), self.stiffness, self.gamma))

    @cached_property
    def hessian_dc(self) -> Matrix:
        """hess S_dc at (x*, 0) (hessSdc)."""
        side = product(self.stiffness, self.gamma)
        return blocks([[self.hessian_d, transpose(side)], [side, plus(self.stiffness, self.model.gains["K_c"])]])

    @property
    def signals(self) -> dict[str, list[Any]]:
        """What the law reads, as functions of the state."""
        names = ["gamma", "eta"] if "natural-damping" in self.law else ["gamma"]
        signals = {name: self.column(name) for name in names}
        if self.compensated:
            signals["potential"] = self.force
        if "passive-output" in self.law:
            signals["drift"] = [row[0] for row in self.rate("gamma")]
            signals["feedthrough"] = [v for row in self.rate("gamma") for v in row[1:]]
        return signals

    def smooth(self) -> None:
        """No divisor is zero at x*."""
        divisors = self.field.all_divisors.values()
        require({sign(self.field.at(v, self.rest_point)) for v in divisors} <= {1, -1}, "a divisor may be zero at x*")

    # --- the closed loop -------------------------------------------------------------------------------------------

    @cached_property
    def plant(self) -> tuple[Matrix, Matrix]:
        """(A, B) of the plant at (x*, u*)."""
        A = self.jacobian(self.star["f"])
        for column, u in zip(transpose(self.star["g"]), self.point[1], strict=True):
            A = plus(A, self.jacobian([[v] for v in column]), u)
        return A, self.numbers("g")

    @cached_property
    def controller(self) -> tuple[Matrix, ...]:
        """(k, H, Y, G, L, Z, V): ``w = k (H xi + Y dx)``, ``xi' = -(G w + L xi + Z dx)``, ``du = V dx`` less all w.

        tanh has slope one at the target, and w are its saturated terms.
        """
        gains, gamma, k = self.model.gains, self.gamma, self.stiffness
        one, zero = diagonal([fmpq(1)] * self.m), diagonal([fmpq(0)] * self.m)
        none = product(zero, gamma)
        if "passive-output" in self.law:
            friction, (A, B) = product(diagonal(gains["k_p"][0]), gamma), self.plant
            D = product(inverse(plus(one, product(friction, B))), plus(product(k, gamma), product(friction, A)))
            return [], [], [], [], [], [], negative(D)
        parts = [(k, one, gamma, gains["R_c"], product(gains["R_c"], gains["K_c"]), none)]
        if "natural-damping" in self.law:
            k = diagonal([a * b for a, b in zip(gains["alpha_l"][0], gains["beta_l"][0], strict=True)])
            read = product(self.upsilon(len(self.star["eta"])), self.jacobian(self.star["eta"]))
            parts.append((k, gains["K_l"], read, gains["R_l"], zero, none))
        if "integral" in self.law:
            k = diagonal([a * b for a, b in zip(gains["alpha_psi"][0], gains["beta_psi"][0], strict=True)])
            parts.append((k, one, none, zero, gains["R_psi"], negative(product(k, gamma))))
        V = none
        if self.compensated:
            q = variables(self.point[0], 3 if self.moves else 2)[: self.half]
            V = self.hessian(self.potential(q, fmpq))[: self.m]
        k, H, G, L = (
            blocks([[part[i] if part is other else zero for other in parts] for part in parts]) for i in (0, 1, 3, 4)
        )
        Y, Z = (blocks([[part[i]] for part in parts]) for i in (2, 5))
        return k, H, Y, G, L, Z, V

    def upsilon(self, s: int) -> Matrix:
        """The gain Upsilon, m x s."""
        return self.model.gains.get("Upsilon", diagonal([fmpq(1)] * self.m, s))

    @cached_property
    def continuous(self) -> Matrix:
        """The Jacobian of the closed loop in (x, xi)."""
        (A, B), (k, H, Y, G, L, Z, V) = self.plant, self.controller
        if not k:
            return plus(A, product(B, V))
        kY, kH, added = product(k, Y), product(k, H), self._added
        rows = [plus(A, product(B, plus(V, product(added, kY), -1))), negative(product(B, added, kH))]
        return blocks([rows, [negative(plus(Z, product(G, kY))), negative(plus(L, product(G, kH)))]])

    @property
    def _added(self) -> Matrix:
        """The matrix that adds up what the saturated terms give to each input."""
        return blocks([[diagonal([fmpq(1)] * self.m)] * (len(self.controller[0]) // self.m)])

    @property
    def period(self) -> fmpq:
        """The sample period, seconds."""
        return rational(self.model.words["sample"][1])

    @cached_property
    def sampled(self) -> Matrix:
        """The transition over one period."""
        return self.transition(self.period)

    @property
    def step(self) -> tuple[Matrix, Matrix, Matrix]:
        """``xi+ = x dx + xi xi`` by backward Euler, and u in (dx, xi) with the updated xi.

        u follows from w, for which ``(I + N) w = c``: so what is large in a stiff filter is added and not subtracted.
        """
        k, H, Y, G, L, Z, V = self.controller
        if not k:
            return [], [], V
        h, one = self.period, diagonal([fmpq(1)] * len(k))
        own = inverse(plus(one, plus(L, product(G, k, H)), h))
        x = product(own, plus(Z, product(G, k, Y)), diagonal([-h] * self.n))
        try:
            held = product(k, H, inverse(plus(one, L, h)))
            c = blocks([[plus(product(k, Y), product(held, Z), -h), held]])
            w = product(inverse(plus(one, product(held, G), h)), c)
        except ZeroDivisionError:  # a filter that takes no step by itself
            w = product(k, blocks([[plus(Y, product(H, x)), product(H, own)]]))
        return x, own, plus(blocks([[V, diagonal([fmpq(0)] * self.m, len(k))]]), product(self._added, w), -1)

    def transition(self, time: Any) -> Matrix:
        """The transition over some time, for which the controller takes its period.

        u is held. With a delay the past inputs that still act are
        states too, the latest first, and two inputs share a period.
        """
        (A, B), (x, xi, u) = self.plant, self.step
        k, m = self.n + len(xi), self.m
        delay = rational(self.model.words.get("delay", ["0"])[0])
        whole = int(delay.p // delay.q)
        early = delay - whole
        past = whole + (early > 0)
        unit, later = diagonal([fmpq(1)] * (k + past * m)), [fmpq(0)] * (past * m)
        inputs = [*([*row, *later] for row in u), *unit[k:]]
        moved = unit[: self.n]
        for share, ago in [(early, past)] * (early > 0) + [(1 - early, whole)]:
            held, push = zero_order_hold(A, B, time * share)
            moved = plus(product(held, moved), product(push, inputs[ago * m : ago * m + m]))
        return [*moved, *([*a, *b, *later] for a, b in zip(x, xi, strict=True)), *inputs[: past * m]]

    # --- where the filters rest ------------------------------------------------------------------------------------

    @property
    def constants(self) -> list[Function]:
        """The inputs as symbols."""
        return self.field.symbols[self.n : self.n + self.m]

    @property
    def push(self) -> list[Any]:
        """The input where the filters rest: a constant, beside the force that is compensated."""
        constant = self.constants
        return [a + b for a, b in zip(constant, self.force, strict=True)] if self.compensated else constant

    @property
    def rates(self) -> list[Any]:
        """``x' = f + g u`` there, and the constants do not change; in (q, v) the accelerations are symbols."""
        if self.inertia:
            moving = [*self.field.symbols[self.half : self.n], *self.field.symbols[self.n + self.m :]]
            return moving + [self.field.lift(0)] * self.m
        return [self.field.lift(v) for (v,) in self.moved] + [self.field.lift(0)] * self.m

    @property
    def moved(self) -> Matrix:
        """``f + g u`` there, which may jump; what is concluded from derivatives along it needs that it does not."""
        return plus(self.written("f"), product(self.written("g"), [[u] for u in self.push]))

    @property
    def balance(self) -> list[Any]:
        """``(M v)' - p'``, zero along the motions of a system that is read in (q, v); none for others."""
        gone = [dot([partial(p, k) for k in range(self.n)], self.rates[: self.n]) for p in self.momenta]
        return [self.field.lift(a - b) for a, (b,) in zip(gone, self.moved[self.half :], strict=False)]

    @property
    def resting_input(self) -> list[Any]:
        """This constant at x*."""
        return [fmpq(0)] * self.m if self.compensated else self.point[1]

    @cached_property
    def softness(self) -> Matrix:
        """``K_c^-1``; zero for a law without filters."""
        K_c = self.model.gains.get("K_c")
        return diagonal([fmpq(0)] * self.m) if K_c is None else fmpq_mat(K_c).inv().tolist()

    @property
    def rest_point(self) -> list[Any]:
        """What the symbols are at x*, where nothing moves."""
        x = [*self.point[0][: self.half], *[fmpq(0)] * self.half] if self.inertia else self.point[0]
        return [*x, *self.resting_input, *[fmpq(0)] * len(self.inertia)]
