"""How the checks scale: an RLC ladder and a mass-spring chain of n states, and the reference systems.

    python benchmarks/proofs.py [n ...]

Prints the seconds of each stage and, between consecutive sizes, the exponent of growth. Run it with
OPENBLAS_NUM_THREADS=1 where other programs use the cores too.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from importlib import import_module
from time import perf_counter

import casadi as ca
import numpy as np

from pbcgen import AffineSystem, Circuit, Design, DynamicExtension, Limits, Parameters
from pbcgen.passivity import passive_output
from pbcgen.passivity.equilibrium import complete
from pbcgen.passivity.plant import Plant
from pbcgen.passivity.storage import assumption_1
from pbcgen.pipeline import check
from pbcgen.proof.spectrum import hurwitz
from pbcgen.symbolic.tape import Tape

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
    law = DynamicExtension(alpha=1000, beta=1, K_c=1, R_c=1)
    return Design(circuit, target={f"v{k - 1}": "0.01"}, law=law, limits=Limits.symmetric(10**6), sample_period="1e-5")


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


def stages(design: Design) -> dict[str, float]:
    """Seconds of the stages that decide the claims of the open-loop system, and of a spectrum of its size."""
    plant = Plant(design.system)
    times = [perf_counter()]
    point = complete(plant, design).point
    times.append(perf_counter())
    storage = assumption_1(plant)
    times.append(perf_counter())
    passive_output.find(plant, storage.structure, storage.proved, storage.by_structure, storage.region, point)
    times.append(perf_counter())
    assert storage.proved
    assert point is not None
    (slope,) = plant.at(point, ca.densify(ca.jacobian(plant.system.xdot, plant.system.x)))
    hurwitz(slope)
    times.append(perf_counter())
    names = ("equilibrium", "assumption-1", "passive output", "hurwitz")
    return dict(zip(names, np.diff(times).tolist(), strict=True))


def growth(make: Callable[[int], Design], sizes: list[int]) -> None:
    """A line for each size, with the exponents against the size before."""
    print(f"\n{make(4).system.name}")
    before: tuple[int, dict[str, float]] | None = None
    for n in sizes:
        found = stages(make(n))
        found["total"] = sum(found.values())
        cells = []
        for name, seconds in found.items():
            exponent = ""
            if before is not None:
                ratio = seconds / max(before[1][name], 1e-6)
                exponent = f" (n^{math.log(ratio) / math.log(n / before[0]):.1f})"
            cells.append(f"{name} {seconds:.2f} s{exponent}")
        print(f"  n = {n:4d}  " + "  ".join(cells), flush=True)
        before = n, found


def main() -> None:
    """Print everything."""
    sizes = [int(a) for a in sys.argv[1:]] or [20, 50, 100, 200]
    Tape.of([ca.SX.sym("x")], [ca.SX(1)])  # the first call loads libraries
    print("reference systems, all checks")
    for name in REFERENCES:
        start = perf_counter()
        check(import_module(f"pbcgen.examples.{name}").design)
        print(f"  {name:16s} {perf_counter() - start:.2f} s", flush=True)
    growth(ladder, sizes)
    growth(chain, [n for n in sizes if n <= 200])


if __name__ == "__main__":
    main()
