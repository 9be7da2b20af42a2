"""The claim `sampled-stable`: which sample periods keep the proof, by which route, and what to change when none does.

Two routes. The *Lyapunov route* takes the storage of the continuous proof at the samples: sampling consumes damping,
and what is left must do. With the held input, backward Euler in x_c and x_l, and constants of Assumption 3
``|l + w u|^2 >= |(eta', y)|^2_Lambda`` it holds when

    2 Lambda_c - h (diag(alpha beta) + L) >= 0                              (uc), (umec): L >= -hess V, zero for (uc)
    Theta >= 0 with Lambda_c - h/2 (diag(alpha_c beta_c) + diag(alpha_l beta_l)) for Lambda_c     (ulc)

for any positive definite K_c, R_c; the derivation is in docs/theory-sampled.md. The *spectral route* linearises and is
local: the exact zero-order hold of the plant and the implicit step have all eigenvalues inside the unit circle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
from flint import acb_mat, arb, fmpq
from numpy.typing import NDArray

from pbcgen.control.attractivity import Situation
from pbcgen.control.family import LoopFamily
from pbcgen.control.scan import SCAN_BITS, LinearLoop, Scan, Transition, scan
from pbcgen.errors import ModelError, UnsupportedOperation
from pbcgen.models.exact import decimal
from pbcgen.models.laws import DynamicExtension, Integral, Law, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.passivity.dissipation import port_damping
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.shaping import diagonal, exact_matrix, multiply, transpose
from pbcgen.passivity.structure import PowerStructure
from pbcgen.proof.claim import Claim, Status
from pbcgen.proof.definite import RealMatrix, positive_definite, positive_semidefinite
from pbcgen.proof.extrema import term_bounds
from pbcgen.proof.spectrum import Stability, hurwitz, schur
from pbcgen.symbolic.real import BITS, Real, ball, enclose, midpoint, precision, rational

#: How far the scan goes, as a multiple of the design's period, and how many cells a quick one may try.
_REACH = 10**4
_TRIES = 60
#: Work of the scan in `check`: cells times the cube of the number of states.
_WORK = 60_000
#: For larger loops a refusal names no other period and no gain change.
_LARGEST_SEARCH = 20

#: The Lyapunov bound on h is given as a rational below the true one by at most this factor.
_SHARP = Fraction(1, 10**9)

_SPECTRAL = "exact zero-order hold, linearised implicit step, Routh array after a Moebius map, in ball arithmetic"
_LYAPUNOV = "storage at the samples, Loewner order over the rationals"


@dataclass(frozen=True)
class Sampling:
    """How the firmware samples, beside its period, and how much to prove of it.

    Attributes:
        delay: from measurement to actuation, in samples: 0 to 2, whole or not.
        jitter: the periods vary within ``h (1 - jitter)`` and ``h (1 + jitter)`` from step to step.
        scan: prove the range of all stable periods to its end, however many cells it takes.
    """

    delay: Fraction = Fraction(0)
    jitter: Fraction = Fraction(0)
    scan: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.delay <= 2:
            raise ModelError(f"the delay is {float(self.delay):g} samples: 0 to 2 samples were expected")
        if not 0 <= self.jitter < 1:
            raise ModelError(f"the jitter is {float(self.jitter):g}: a share of the sample period below 1 was expected")

    @property
    def ideal(self) -> bool:
        """Whether the loop is sampled evenly and without delay."""
        return self.delay == 0 and self.jitter == 0


@dataclass(frozen=True)
class LyapunovPeriods:
    """The Lyapunov route for one set of gains.

    Attributes:
        largest: a rational h up to which the storage does not grow, closely below the best one, or None if this
            route has no bound to offer; then ``reason`` says why.
        Lambda: the constant damping matrix over (eta', y) that was used.
        any_sequence: whether periods may vary below ``largest`` while the controller steps by a fixed one.
    """

    largest: Fraction | None
    reason: str
    Lambda: RealMatrix | None = None
    any_sequence: bool = True


def lyapunov_periods(
    plant: Plant, structure: PowerStructure | None, gamma: ca.SX, eta: ca.SX | None, law: Law, missing: Sequence[str]
) -> LyapunovPeriods:
    """The largest period of the Lyapunov route.

    Args:
        plant: the system.
        structure: a power structure that proves Assumption 1 and matches gamma, or None.
        gamma: m x 1.
        eta: s x 1, or None.
        law: with resolved gains.
        missing: premises of the continuous proof that are not proved.
    """
    if isinstance(law, Integral | PassiveOutput):
        return LyapunovPeriods(None, f"there is no storage argument for a held {law.name} law")
    if missing:
        return LyapunovPeriods(None, "open for " + ", ".join(missing))
    if structure is None:
        return LyapunovPeriods(None, "it needs the power structure of the system")
    signals = eta if isinstance(law, NaturalDamping) else None
    Lambda = port_damping(plant, structure, gamma, signals)
    if Lambda is None:
        return LyapunovPeriods(None, "the output is not damped by a constant (Lambda_c)")
    consumed = _consumed(plant, law)
    if consumed is None:
        return LyapunovPeriods(None, "hess V is not bounded below by a constant diagonal")
    largest = _largest(_budget(Lambda, consumed, law, False), _budget(Lambda, consumed, law, True))
    if largest is None:
        return LyapunovPeriods(None, "no h > 0 leaves enough damping", Lambda)
    return LyapunovPeriods(largest, "", Lambda, not isinstance(law, NaturalDamping))


def _consumed(plant: Plant, law: Law) -> RealMatrix | None:
    """C with ``h C / 2`` the damping of y that a period h consumes."""
    if isinstance(law, NaturalDamping):
        pairs = zip(law.alpha_c, law.beta_c, law.alpha_l, law.beta_l, strict=True)
        return diagonal([rational(a * b + c * d) for a, b, c, d in pairs])
    assert isinstance(law, DynamicExtension | PotentialCompensation)
    entries = [rational(a * b) for a, b in zip(law.alpha, law.beta, strict=True)]
    if isinstance(law, PotentialCompensation):
        softening = _softening(plant)
        if softening is None:
            return None
        entries = [e + rational(s) for e, s in zip(entries, softening, strict=True)]
    return diagonal(entries)


def _softening(plant: Plant) -> list[Fraction] | None:
    """A diagonal L with ``hess V(q) >= -L`` for every q of the domain, by Gershgorin's discs."""
    mechanics = plant.system.mechanical
    if mechanics is None:
        return None
    hessian = ca.densify(ca.jacobian(ca.gradient(mechanics.V, mechanics.q), mechanics.q))
    try:
        field, (matrix,) = plant.exact(hessian)
    except (UnsupportedOperation, ZeroDivisionError):
        return None
    domain = {k: plant.system.domain.get(name, (None, None)) for k, name in enumerate(plant.system.state_names)}
    result = []
    for i, row in enumerate(matrix.dense(field.const(0))):
        total = Fraction(0)
        for j, entry in enumerate(row):
            if entry.is_zero():
                continue
            bounds = term_bounds(entry, domain)
            if bounds.lo is None or (i != j and bounds.hi is None):
                return None
            total += -bounds.lo if i == j else max(abs(bounds.lo), abs(bounds.hi or Fraction(0)))
        result.append(max(total, Fraction(0)))
    return result


def _budget(Lambda: RealMatrix, consumed: RealMatrix, law: Law, touching: bool) -> Callable[[Fraction], bool]:
    """The test of a period: whether damping is left in every direction (touching zero counts only if ``touching``)."""
    m = len(consumed)
    s = len(Lambda) - m
    decide = positive_semidefinite if touching else positive_definite

    def left(h: Fraction) -> RealMatrix:
        half = rational(h / 2)
        rest = [list(row) for row in Lambda]
        for i in range(m):
            for j in range(m):
                rest[s + i][s + j] = rest[s + i][s + j] - half * consumed[i][j]
        return rest

    if not isinstance(law, NaturalDamping):
        return lambda h: decide(left(h)).status is Status.PROVED
    upsilon = exact_matrix(law.Upsilon or ())
    coupling = [[*(-v / 2 for v in row), *(fmpq(int(i == j), 2) for j in range(m))] for i, row in enumerate(upsilon)]
    filters = diagonal([rational(law.K_l[i][i] * law.R_l[i][i]) for i in range(m)])

    def theta(h: Fraction) -> bool:
        top = [[*a, *b] for a, b in zip(left(h), transpose(coupling), strict=True)]
        bottom = [[*a, *b] for a, b in zip(coupling, filters, strict=True)]
        return decide([*top, *bottom]).status is Status.PROVED

    return theta


def _largest(test: Callable[[Fraction], bool], touching: Callable[[Fraction], bool]) -> Fraction | None:
    """The end of the interval (0, h) that passes a test, exactly where it is a simple fraction, else closely below."""
    lo, hi = Fraction(0), Fraction(1)
    while test(hi):
        lo, hi = hi, hi * 16
        if hi > 10**9:
            return lo
    while lo == 0:
        middle = hi / 16
        lo, hi = (middle, hi) if test(middle) else (lo, middle)
        if hi < Fraction(1, 10**15):
            return None
    while hi - lo > lo * _SHARP:
        middle = _between(lo, hi)
        lo, hi = (middle, hi) if test(middle) else (lo, middle)
    simple = hi.limit_denominator(10**6)
    return simple if lo < simple and touching(simple) else lo


def _between(lo: Fraction, hi: Fraction) -> Fraction:
    middle = (lo + hi) / 2
    short = middle.limit_denominator(max(10**6, round(10**12 / float(hi))))
    return short if lo < short < hi else middle


# --- jitter ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Jitter:
    """Sample periods that change from step to step within [shortest, longest].

    Attributes:
        status: PROVED when one quadratic storage decreases for every period of the interval, else UNDECIDED.
        storage: that storage P in modal coordinates (real and imaginary parts), for display and certificates.
    """

    shortest: Fraction
    longest: Fraction
    status: Status
    storage: NDArray[np.float64] | None


def jitter(loop: LinearLoop, shortest: Fraction, longest: Fraction, delay: Fraction = Fraction(0)) -> Jitter:
    """Look for one P > 0 with ``P - M(h)^T P M(h) > 0`` for every h in the interval, verified on cells of balls.

    The controller steps by the middle of the interval: its code knows only the nominal period.
    """
    undecided = Jitter(shortest, longest, Status.UNDECIDED, None)
    with precision(SCAN_BITS):
        transition = Transition(loop, delay, steps=(shortest + longest) / 2)
        try:
            basis = _modal_basis(transition.jet(ball(rational((shortest + longest) / 2))).c0)
        except (ValueError, ZeroDivisionError):
            return undecided
        samples = []
        for h in _spread(shortest, longest, 9):
            M = basis[0] * transition.jet(ball(rational(h))).c0 * basis[1]
            samples.append(np.array([[float(v.mid()) for v in row] for row in _embedded(M)]))
        P = _candidate(samples)
        if P is None or positive_definite(_rationals(P)).status is not Status.PROVED:
            return undecided
        if not _decreases(_rationals(P), transition, basis, shortest, longest, 8):
            return undecided
        return Jitter(shortest, longest, Status.PROVED, P)


def _modal_basis(M: acb_mat) -> tuple[acb_mat, acb_mat]:
    """(V^{-1}, V) of eigenvectors."""
    _, V = M.eig(right=True, algorithm="approx")
    V = acb_mat(V.nrows(), V.ncols(), [V[i, j].mid() for i in range(V.nrows()) for j in range(V.ncols())])
    return V.inv(), V


def _spread(lo: Fraction, hi: Fraction, count: int) -> list[Fraction]:
    return [lo + (hi - lo) * k / (count - 1) for k in range(count)]


def _embedded(matrix: acb_mat) -> list[list[arb]]:
    """A complex matrix as a real one of twice the size."""
    n = matrix.nrows()
    rows = [[*(matrix[i, j].real for j in range(n)), *(-matrix[i, j].imag for j in range(n))] for i in range(n)]
    return rows + [[*(matrix[i, j].imag for j in range(n)), *(matrix[i, j].real for j in range(n))] for i in range(n)]


def _candidate(samples: list[NDArray[np.float64]]) -> NDArray[np.float64] | None:
    """P > 0 that decreases along every sample, or None: ``P = Q + sum_k w_k M_k^T P M_k`` with weights that learn."""
    size = samples[0].shape[0]
    if size > _LARGEST_STORAGE:
        return None
    scale = _balance(samples)
    balanced = [m * scale[None, :] / scale[:, None] for m in samples]
    operators = [np.kron(m.T, m.T) for m in balanced]
    weights = np.full(len(samples), 1 / len(samples))
    for _ in range(_LESSONS):
        total = np.eye(size * size) - sum(w * o for w, o in zip(weights, operators, strict=True))
        try:
            P = np.linalg.solve(total, np.eye(size).ravel()).reshape(size, size)
        except np.linalg.LinAlgError:
            return None
        P = (P + P.T) / 2
        margins = np.array([np.linalg.eigvalsh(P - m.T @ P @ m)[0] for m in balanced])
        if np.all(margins > 0) and np.linalg.eigvalsh(P)[0] > 0:
            return np.asarray(P / scale[:, None] / scale[None, :])
        weights = weights * np.exp(-margins / max(1e-9, float(np.max(np.abs(margins)))))
        weights /= weights.sum()
    return None


#: Limits of the search for a common storage: order of the embedded matrices, rounds of the weights.
_LARGEST_STORAGE = 32
_LESSONS = 25


def _balance(samples: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Scales of the coordinates that make the coupling of each row and its column alike."""
    coupling = np.max([np.abs(m - np.diag(np.diag(m))) for m in samples], axis=0)
    scale = np.ones(len(coupling))
    for _ in range(30):
        rows, columns = (coupling @ scale) / scale, scale * (coupling.T @ (1 / scale))
        ratio = np.sqrt((rows + 1e-300) / (columns + 1e-300))
        scale = scale * np.clip(ratio, 0.5, 2.0)
    return np.exp2(np.round(np.log2(scale)))


def _rationals(P: NDArray[np.float64]) -> RealMatrix:
    return [[rational(Fraction(float(v))) for v in row] for row in P]


def _decreases(
    P: RealMatrix, transition: Transition, basis: tuple[acb_mat, acb_mat], lo: Fraction, hi: Fraction, depth: int
) -> bool:
    """Whether P decreases for every h in [lo, hi], else on its halves.

    With ``M(h) = M0 + d M1 + d^2 M2``, tight at the centre and M2 enclosed: the terms of first order in d are summed
    before d is made a ball, so that they cancel as they do in truth.
    """
    inverse, V = basis
    centre = ball(rational((lo + hi) / 2))
    here, curve = transition.jet(centre), transition.jet(enclose(lo, hi)).c2
    M0, M1, M2 = (_embedded(inverse * part * V) for part in (here.c0, here.c1, curve))
    d = enclose((lo - hi) / 2, (hi - lo) / 2)
    PM0, PM1, PM2 = (multiply(P, M) for M in (M0, M1, M2))
    zeroth = multiply(transpose(M0), PM0)
    first = multiply(transpose(M0), PM1)
    bent = multiply(transpose(M0), PM2)
    steep = multiply(transpose(M1), PM1)
    mixed = multiply(transpose(M1), PM2)
    last = multiply(transpose(M2), PM2)
    size = range(len(P))

    def left(i: int, j: int) -> Real:
        second = bent[i][j] + bent[j][i] + steep[i][j] + d * (mixed[i][j] + mixed[j][i]) + d * d * last[i][j]
        return P[i][j] - zeroth[i][j] - d * (first[i][j] + first[j][i]) - d * d * second

    if positive_definite([[left(max(i, j), min(i, j)) for j in size] for i in size]).status is Status.PROVED:
        return True
    if depth == 0 or hi == lo:
        return False
    middle = (lo + hi) / 2
    return all(_decreases(P, transition, basis, a, b, depth - 1) for a, b in ((lo, middle), (middle, hi)))


# --- what to change ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GainChange:
    """Gains that the wished period allows, proved by the spectral route: each named gain times its factor."""

    factors: Mapping[str, Fraction]
    law: Law

    def __str__(self) -> str:
        return " and ".join(f"{gain} by {_plain(factor)}" for gain, factor in self.factors.items())


#: Ways to make a loop slower, as powers of one factor t < 1 for each gain. Amplitudes alpha stay, so do input ranges.
_MOVES: tuple[Mapping[str, int], ...] = (
    {"alpha*beta": 1},
    {"R_c": 1},
    {"R_c": -1},
    {"alpha*beta": 1, "R_c": -1},
    {"alpha*beta": 1, "K_c": -1},
)


def scaled(law: Law, factors: Mapping[str, Fraction]) -> Law:
    """The law with gains multiplied: ``alpha*beta`` stands for every beta of the base law, others for themselves."""
    if isinstance(law, Integral):
        return Integral(scaled(law.base, factors), law.alpha_psi, law.beta_psi, law.R_psi)  # type: ignore[arg-type]
    given = {**factors, **dict.fromkeys(("beta", "beta_c", "beta_l"), factors.get("alpha*beta", Fraction(1)))}
    copy = object.__new__(type(law))
    for key, value in law.__dict__.items():
        factor = given.get(key)
        object.__setattr__(copy, key, value if factor is None else _times(value, factor))
    return copy


def _times(value: Any, factor: Fraction) -> Any:
    return tuple(_times(v, factor) for v in value) if isinstance(value, tuple) else value * factor


def gain_change(
    family: LoopFamily,
    law: Law,
    h: Fraction,
    acceptable: Callable[[Law], bool] = lambda law: True,
    delay: Fraction = Fraction(0),
) -> GainChange | None:
    """The mildest change of alpha*beta, R_c or K_c by a common factor that is proved to allow the period h.

    Each factor that is tried is decided by the certified spectral test; ``acceptable`` may veto gains that break
    another claim.
    """
    best: tuple[Fraction, GainChange] | None = None
    for move in _MOVES:
        if isinstance(law, PassiveOutput) and set(move) != {"alpha*beta"}:
            continue

        def factors(t: Fraction, move: Mapping[str, int] = move) -> dict[str, Fraction]:
            return {gain: t**power for gain, power in move.items()}

        def good(t: Fraction, factors: Callable[[Fraction], dict[str, Fraction]] = factors) -> bool:
            candidate = scaled(law, factors(t))
            if not acceptable(candidate):
                return False
            return schur(transition_matrix(family.loop(candidate), h, delay)).status is Status.PROVED

        t = _mildest(good)
        if t is not None and (best is None or t > best[0]):
            best = t, GainChange(factors(t), scaled(law, factors(t)))
    return None if best is None else best[1]


def _plain(value: Fraction) -> str:
    return decimal(value) if Fraction(f"{float(value):.6g}") == value else str(value)


def transition_matrix(loop: LinearLoop, h: Fraction, delay: Fraction = Fraction(0)) -> RealMatrix:
    """M(h) with enclosed entries; in modal coordinates of plant and filter, whose imaginary parts are embedded."""
    with precision(BITS):
        M = Transition(loop, delay).jet(ball(rational(h))).c0
        return [list(row) for row in _embedded(M)]


#: Factors that are tried: 1/2 to 1/500 in short decimals, mildest first.
_FACTORS = tuple(Fraction(n, 10**k) for k in (1, 2, 3) for n in ((8, 5, 4, 2) if k == 1 else (10, 8, 5, 4, 2)))


def _mildest(good: Callable[[Fraction], bool]) -> Fraction | None:
    """The largest factor of the list that is good; each is tested, since the good ones need not be an interval."""
    return next((t for t in _FACTORS if good(t)), None)


# --- the claim ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Routes:
    """The two routes for one sample period.

    Attributes:
        h: seconds. lyapunov: of the continuous storage. spectral: of the linearised sampled loop.
        scan: the certified scan of the spectral route.
        estimate: of its end in double precision, where the scan did not reach it.
        jitter: the common storage for varying periods, where they vary.
    """

    h: Fraction
    lyapunov: LyapunovPeriods
    spectral: Stability
    scan: Scan
    estimate: float | None
    jitter: Jitter | None = None

    @property
    def by_lyapunov(self) -> bool:
        """Whether the storage argument covers h, with damping to spare."""
        if self.lyapunov.largest is None or (self.jitter is not None and not self.lyapunov.any_sequence):
            return False
        return (self.h if self.jitter is None else self.jitter.longest) < self.lyapunov.largest

    @property
    def by_spectrum(self) -> bool:
        """Whether the linearised loop is proved stable, with jitter by a common storage."""
        varied = self.jitter is None or self.jitter.status is Status.PROVED
        return varied and self.spectral.status is Status.PROVED

    @property
    def largest(self) -> float | None:
        """The largest period up to which the linearised loop is proved stable, or its estimate; None if unlimited."""
        if self.scan.exhausted:
            return self.estimate
        return None if self.scan.complete else float(self.scan.stable_to)

    @property
    def figures(self) -> dict[str, object]:
        """For JSON: seconds, null where a route gives nothing."""
        found, storage = self.scan, self.lyapunov.largest
        return {
            "spectral_stable_to": float(found.stable_to),
            "spectral_unstable_at": None if found.unstable_at is None else float(found.unstable_at),
            "spectral_scan_complete": not found.exhausted,
            "lyapunov_stable_to": None if storage is None else float(storage),
        }

    @property
    def proved_to(self) -> float:
        """Every period below this one is proved, by one of the routes."""
        return float(max(self.scan.stable_to, self.lyapunov.largest or 0))


def verdict(routes: Routes, asymptotic: Claim, overall: Claim, change: GainChange | None) -> Claim:
    """The verdict `sampled-stable`.

    Args:
        routes: what each route says.
        asymptotic: the verdict on the continuous loop.
        overall: the verdict `globally-asymptotically-stable`, for the domain of the Lyapunov route.
        change: gains that would allow the period, for the hint.
    """
    spectral = routes.by_spectrum
    lyapunov = routes.by_lyapunov and asymptotic.status is Status.PROVED
    whole = lyapunov and overall.status is Status.PROVED
    domain = "sampled loop, all x" if whole else "sampled loop"
    evidence = "; ".join(_evidence(routes))
    if spectral or lyapunov:
        methods = ([_LYAPUNOV] if lyapunov else []) + ([_SPECTRAL] if spectral else [])
        return Claim(
            "sampled-stable", Status.PROVED, domain, " and ".join(methods), evidence, certificate=_certificate(routes)
        )
    refuted = routes.spectral.status is Status.REFUTED
    status = Status.REFUTED if refuted else Status.UNDECIDED
    counterexample = {"spectral_radius": f"{routes.spectral.extreme:.9g}"} if refuted else None
    return Claim(
        "sampled-stable", status, domain, _SPECTRAL, evidence, _hint(routes, asymptotic, change), counterexample
    )


def _evidence(routes: Routes) -> list[str]:
    h = float(routes.h)
    delayed = f" and a delay of {float(routes.scan.delay):g} samples" if routes.scan.delay else ""
    lines = [f"h = {h:.6g} s{delayed}: spectral radius {routes.spectral.extreme:.9g} (local)"]
    if routes.jitter is not None:
        serves = (
            "one quadratic storage serves" if routes.jitter.status is Status.PROVED else "no common storage found for"
        )
        lines.append(f"{serves} all h in [{float(routes.jitter.shortest):.6g}, {float(routes.jitter.longest):.6g}] s")
    if routes.lyapunov.largest is not None:
        verdict = "holds" if routes.by_lyapunov else "does not hold"
        lines.append(f"the Lyapunov route {verdict}: it needs h < {float(routes.lyapunov.largest):.4g} s")
    else:
        lines.append(f"no Lyapunov route: {routes.lyapunov.reason}")
    found = routes.scan
    end = f", proved unstable at {float(found.unstable_at):.9g} s" if found.unstable_at is not None else ""
    since = f"from {float(found.start):.3g} s " if found.start else ""
    lines.append(f"the linearised loop is stable for every h {since}up to {float(found.stable_to):.9g} s{end}")
    if found.exhausted and routes.estimate is not None:
        lines.append(f"about {routes.estimate:.4g} s is the limit (estimate; --sampled-scan proves it)")
    return lines


def _certificate(routes: Routes) -> dict[str, object]:
    result: dict[str, object] = {"routh": [f"{float(midpoint(v)):.17g}" for v in routes.spectral.routh]}
    if routes.lyapunov.largest is not None:
        result["lyapunov_period"] = str(routes.lyapunov.largest)
    result["cells"] = [[str(a), str(b)] for a, b in routes.scan.cells]
    return result


def _hint(routes: Routes, asymptotic: Claim, change: GainChange | None) -> str:
    if asymptotic.status is not Status.PROVED:
        return "satisfy asymptotically-stable first"
    largest = routes.proved_to
    parts = [f"sample at h = {_below(largest)} s or faster, which is proved"] if largest else []
    if change is not None:
        parts.append(f"or multiply {change}, which is proved to allow this h (local)")
    else:
        parts.append("or lower alpha*beta and R_c")
    parts.append("or model the friction that the plant has")
    return ", ".join(parts).removeprefix("or ")


def _below(value: float) -> str:
    """The value rounded down to three digits."""
    exponent = math.floor(math.log10(value)) - 2
    return f"{math.floor(value / 10.0**exponent) * 10.0**exponent:.3g}"


def decide(
    situation: Situation,
    h: Fraction,
    missing: Sequence[str],
    asymptotic: Claim,
    overall: Claim,
    sampling: Sampling,
) -> tuple[Claim, Routes]:
    """The verdict `sampled-stable` on a law at its target, with what it rests on.

    Args:
        situation: plant, target, law and the claims so far.
        h: sample period, seconds.
        missing: premises of the continuous Lyapunov proof that are not proved.
        asymptotic: the local verdict on the continuous loop.
        overall: the global one.
        sampling: delay and jitter, and how much to prove.
    """
    loop, linear, delay = situation.loop, situation.loop.linear(), sampling.delay
    if delay:
        storage = LyapunovPeriods(None, "the input is delayed")
        spectral = schur(transition_matrix(linear, h, delay))
    else:
        storage = lyapunov_periods(
            situation.plant, situation.structure, situation.gamma, situation.eta, situation.law, missing
        )
        spectral = schur(loop.sampled(h))
    start = h / 1000 if delay else Fraction(0)
    size = situation.plant.system.n + situation.loop.graph.xi.numel()
    tries = min(_TRIES, max(_WORK // size**3, 1))
    found = scan(linear, h * _REACH, delay=delay, start=start, tries=None if sampling.scan else tries)
    refused = spectral.status is not Status.PROVED and size <= _LARGEST_SEARCH
    if found.exhausted and refused:
        found = scan(linear, h, delay=delay, start=start)  # a refusal names the largest period that is proved
    small = size <= _LARGEST_SEARCH
    estimate = loop.scan(h, float(found.stable_to)) if found.exhausted and not delay and small else None
    varied = jitter(linear, h * (1 - sampling.jitter), h * (1 + sampling.jitter), delay) if sampling.jitter else None
    routes = Routes(h, storage, spectral, found, estimate, varied)
    change = None
    if refused and asymptotic.status is Status.PROVED:
        family = LoopFamily.of(situation.plant, situation.point, situation.gamma, situation.eta)
        change = gain_change(family, situation.law, h, lambda law: _hurwitz(family, law), delay)
    return verdict(routes, asymptotic, overall, change), routes


def _hurwitz(family: LoopFamily, law: Law) -> bool:
    return hurwitz(family.loop(law).continuous()).status is Status.PROVED
