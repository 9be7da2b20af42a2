"""How the checks scale: all of `pbcgen check`, by the number of states or links.

    python benchmarks/proofs.py [family ...]

Families: references, ladder, chain, arm, black-box, lasalle, certificates, region; all if none is named. Prints the
seconds of processor time, the memory that was added, and between consecutive sizes the exponents of growth. Run it with
OPENBLAS_NUM_THREADS=1: more threads only add to the processor time.
"""

from __future__ import annotations

import json
import math
import resource
import sys
from collections import Counter
from collections.abc import Callable
from importlib import import_module
from multiprocessing import get_context
from time import process_time

import casadi as ca

from pbcgen import AffineSystem, Circuit, Design, DynamicExtension, Limits, Mechanical, Parameters
from pbcgen.certify.certificate import certificate
from pbcgen.control.attraction import region_of_attraction
from pbcgen.pipeline import Report, check
from pbcgen.verify.claims import examine

REFERENCES = ("coupling_device", "rlc", "pera", "pera_integral")


def ladder(n: int) -> Design:
    """n/2 sections of a series inductor with resistance and a capacitor with leakage."""
    p = Parameters(L="0.01", C="1e-4", r=1, G="0.1")
    k = n // 2
    i_L, v_C = ([ca.SX.sym(f"{name}{j}") for j in range(k)] for name in "iv")
    Gamma = ca.SX(k, k)
    for j in range(k):
        Gamma[j, j] = 1
        if j:
            Gamma[j, j - 1] = -1
    circuit = Circuit(
        i_L,
        v_C,
        L=[p.L] * k,
        C=[p.C] * k,
        Gamma=Gamma,
        v_R=[p.r * i for i in i_L],
        i_G=[p.G * v for v in v_C],
        g_L=ca.vertcat(-1, ca.SX(k - 1, 1)),
        inputs=["u"],
        parameters=p,
        name="RLC ladder",
    )
    law = DynamicExtension(alpha=10, beta=1, K_c=1, R_c=1)
    target = {"v0": "0.001"}
    return Design(circuit, target=target, law=law, limits=Limits.symmetric(10**3), sample_period="1e-6")


def chain(n: int) -> Design:
    """n/2 masses between springs, with friction; the last one is driven. No structure is given."""
    p = Parameters(m=1, k=10, d="0.5")
    k = n // 2
    q, momenta = ([ca.SX.sym(f"{name}{j}") for j in range(k)] for name in "qp")
    V = p.k * q[0] ** 2 / 2 + sum((p.k * (q[j] - q[j - 1]) ** 2 / 2 for j in range(1, k)), ca.SX(0))
    force = ca.vertsplit(ca.gradient(V, ca.vertcat(*q)))
    system = AffineSystem(
        [*q, *momenta],
        [ca.SX.sym("u")],
        [*(v / p.m for v in momenta), *(-f - p.d * v / p.m for f, v in zip(force, momenta, strict=True))],
        [0] * (n - 1) + [1],
        V + sum((v**2 for v in momenta), ca.SX(0)) / (2 * p.m),
        parameters=p,
        name="mass-spring chain",
    )
    law = DynamicExtension(alpha=10, beta=1, K_c=1, R_c=1)
    return Design(system, target={f"q{k - 1}": "0.1"}, law=law, limits=Limits.symmetric(100), sample_period="1e-3")


def _angles(n: int) -> tuple[ca.SX, list[ca.SX], Parameters]:
    """The joints of a planar arm, the positions of its point masses, and its parameters."""
    q = ca.vertcat(*[ca.SX.sym(f"q{k}") for k in range(n)])
    p = Parameters(m="0.7", l="0.4", g="9.81", J="0.05", d="2")
    positions, angle, at = [], ca.SX(0), ca.SX(2, 1)
    for k in range(n):
        angle = angle + q[k]
        at = at + p.l * ca.vertcat(ca.sin(angle), -ca.cos(angle))
        positions.append(at)
    return q, positions, p


def _arm(system: Mechanical, n: int) -> Design:
    law = DynamicExtension(alpha=[20] * n, beta=1, K_c=1, R_c=1)
    target = {f"q{k}": "0" for k in range(n)}
    return Design(system, target=target, law=law, limits=Limits.symmetric(100), sample_period="1e-3")


def arm(n: int) -> Design:
    """A planar arm of n links with ``M = sum J_i^T W_i J_i``."""
    q, positions, p = _angles(n)
    momenta = ca.vertcat(*[ca.SX.sym(f"p{k}") for k in range(n)])
    M = [(ca.SX.eye(n), p.J), *[(ca.jacobian(position, q), p.m) for position in positions]]
    V = p.m * p.g * sum((position[1] for position in positions), ca.SX(0))
    return _arm(Mechanical(q, momenta, M=M, V=V, G=ca.SX.eye(n), D=[p.d] * n, parameters=p, name="planar arm"), n)


def black_box(n: int) -> Design:
    """The same arm with its kinetic energy from the velocities of the masses: M is what comes out of that."""
    q, positions, p = _angles(n)
    v = ca.vertcat(*[ca.SX.sym(f"v{k}") for k in range(n)])
    velocities = [ca.mtimes(ca.jacobian(position, q), v) for position in positions]
    T = p.J * ca.dot(v, v) / 2 + p.m * sum((ca.dot(w, w) for w in velocities), ca.SX(0)) / 2
    V = p.m * p.g * sum((position[1] for position in positions), ca.SX(0))
    G, D = ca.SX.eye(n), [p.d] * n
    system = Mechanical.from_lagrangian(q, v, T=T, V=V, G=G, D=D, parameters=p, name="planar arm from velocities")
    return _arm(system, n)


def lasalle(n: int) -> Design:
    """A chain of (n - 1)/2 masses with friction at the last one only, and a motor: LaSalle needs every step."""
    p = Parameters(m=1, k=10, d="0.5", L="0.1", r=1, b=2)
    k = (n - 1) // 2
    q, momenta = ([ca.SX.sym(f"{name}{j}") for j in range(k)] for name in "qp")
    flux = ca.SX.sym("flux")
    V = p.k * q[0] ** 2 / 2 + sum((p.k * (q[j] - q[j - 1]) ** 2 / 2 for j in range(1, k)), ca.SX(0))
    force = ca.vertsplit(ca.gradient(V, ca.vertcat(*q)))
    damping = [p.d * momenta[j] / p.m if j == k - 1 else ca.SX(0) for j in range(k)]
    motor = [p.b * flux / p.L if j == 0 else ca.SX(0) for j in range(k)]
    system = AffineSystem(
        [*q, *momenta, flux],
        [ca.SX.sym("u")],
        [
            *(v / p.m for v in momenta),
            *(-f - d + t for f, d, t in zip(force, damping, motor, strict=True)),
            -p.r * flux / p.L - p.b * momenta[0] / p.m,
        ],
        [0] * (n - 1) + [1],
        V + sum((v**2 for v in momenta), ca.SX(0)) / (2 * p.m) + flux**2 / (2 * p.L),
        parameters=p,
        name="masses behind a motor",
    )
    law = DynamicExtension(alpha=10, beta=1, K_c=1, R_c=1)
    return Design(system, target={f"q{k - 1}": "0.01"}, law=law, limits=Limits.symmetric(100), sample_period="1e-3")


FAMILIES: dict[str, tuple[Callable[[int], Design], tuple[int, ...]]] = {
    "ladder": (ladder, (50, 100, 200, 400, 800)),
    "chain": (chain, (20, 50, 100, 200, 400, 800)),
    "arm": (arm, (2, 3, 5, 7, 10)),
    "black-box": (black_box, (2, 3, 4, 5)),
    "lasalle": (lasalle, (3, 5, 7)),
}


def memory() -> float:
    """The largest resident set so far, in megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def proved(report: Report) -> str:
    """How many claims are proved, and which are not."""
    others = [f"{c.claim} {c.status}" for c in report.claims if str(c.status) != "PROVED"]
    return f"{len(report.claims) - len(others)} of {len(report.claims)} proved" + "".join(f", {o}" for o in others)


def measured(make: Callable[[int], Design], n: int) -> tuple[float, float, str]:
    """Seconds of processor time, megabytes that were added, and the verdicts."""
    design, used, start = make(n), memory(), process_time()
    report = check(design)
    return process_time() - start, memory() - used, proved(report)


def growth(make: Callable[[int], Design], sizes: tuple[int, ...]) -> None:
    """A line for each size, in a process of its own, with the exponents against the size before."""
    print(f"\n{make(sizes[0]).system.name}, all checks")
    before: tuple[int, float, float] | None = None
    for n in sizes:
        with get_context("fork").Pool(1) as alone:
            seconds, added, verdicts = alone.apply(measured, (make, n))
        exponents = ""
        if before is not None:
            step = math.log(n / before[0])
            exponents = f"  n^{math.log(seconds / before[1]) / step:.1f}"
            if min(added, before[2]) >= 1:
                exponents += f", memory n^{math.log(added / before[2]) / step:.1f}"
        print(f"  n = {n:4d}  {seconds:.2f} s  +{added:.0f} MB{exponents}; {verdicts}", flush=True)
        before = n, seconds, added


def references() -> None:
    """The built-in models."""
    print("reference systems, all checks")
    for name in REFERENCES:
        start = process_time()
        report = check(import_module(f"pbcgen.examples.{name}").design)
        print(f"  {name:16s} {process_time() - start:.2f} s; {proved(report)}", flush=True)


def regions() -> None:
    """Regions of attraction by branch and bound: of the nonlinear circuit, and of the pendulum behind a spring.

    Both are globally stable, which is not made use of here.
    """
    print("\nregion of attraction, as if nothing global were known")
    for name in ("rlc", "elastic_pendulum"):
        situation = check(import_module(f"pbcgen.examples.{name}").design).derivation.situation
        assert situation is not None
        start = process_time()
        found = region_of_attraction(situation, by_lyapunov=True, everywhere=False)
        print(f"  {name:16s} {process_time() - start:.2f} s; {found.status}, {found.evidence}", flush=True)


def certificates() -> None:
    """Making a certificate and checking it again, for large systems."""
    print("\ncertificates")
    for make in (ladder, chain):
        for n in (50, 100, 200):
            derivation, start = check(make(n)).derivation, process_time()
            text = json.dumps(certificate(derivation))
            made, start = process_time() - start, process_time()
            outcomes = Counter(finding.outcome for finding in examine(json.loads(text)))
            found = ", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items()))
            size, spent = len(text) / 1e3, process_time() - start
            print(
                f"  {make.__name__:8s} n = {n:4d}  made in {made:.2f} s, {size:.0f} kB; {found} in {spent:.2f} s",
                flush=True,
            )


def main() -> None:
    """Print everything that is asked for."""
    wanted = sys.argv[1:] or ["references", *FAMILIES, "certificates", "region"]
    for first in (import_module("pbcgen.examples.rlc").design, arm(5), chain(160)):
        check(first)  # loads the libraries that small and large models need
    for name in wanted:
        if name == "references":
            references()
        elif name == "certificates":
            certificates()
        elif name == "region":
            regions()
        else:
            growth(*FAMILIES[name])


if __name__ == "__main__":
    main()
