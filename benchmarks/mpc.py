"""A model predictive controller for the coupling device in OSQP's generated C, counted like a step of ours.

Needs ``pip install osqp`` and arm-none-eabi-gcc. The task is the same regulation with the same bound on u. The
controller is given what ours does without: every state of the plant, and a linear model at the target. A solve
iterates until OSQP's default tolerances, so its time depends on the state.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from benchmarks.building import FLAGS, run
from pbcgen import pipeline
from pbcgen.models.loader import load
from pbcgen.run.emulate import Image, Machine
from pbcgen.run.targets import TARGETS

HORIZON, PERIOD, SOLVES = 10, 0.02, 12


def problem(loop) -> tuple:
    """The condensed tracking problem: P, the map from the state to q, and the bounds of u."""
    import casadi as ca

    x, u = ca.SX.sym("x", len(loop.x_star)), ca.SX.sym("u", len(loop.u_star))
    rate = loop.plant(x, u)
    slopes = ca.Function("slopes", [x, u], [ca.jacobian(rate, x), ca.jacobian(rate, u)])
    A, B = (np.array(matrix) for matrix in slopes(loop.x_star, loop.u_star))
    n, m = B.shape
    both = scipy.linalg.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * PERIOD)
    A, B = both[:n, :n], both[:n, n:]
    scale = np.diag(1 / np.maximum(np.abs(loop.initial - loop.x_star), 1e-3) ** 2)
    powers = [np.linalg.matrix_power(A, k) for k in range(HORIZON + 1)]
    free = np.vstack(powers[1:])
    forced = np.block(
        [[powers[i - j] @ B if j <= i else np.zeros((n, m)) for j in range(HORIZON)] for i in range(HORIZON)]
    )
    weight = np.kron(np.eye(HORIZON), scale)
    P = forced.T @ weight @ forced + 1e-2 * np.eye(HORIZON * m)
    return P, forced.T @ weight @ free


@dataclass(frozen=True)
class Solve:
    """What a solve of the quadratic program costs on the Cortex-M4F."""

    mean: float
    worst: int
    code: int
    static: int
    stack: int
    iterations: str

    def row(self, ours: float) -> str:
        """The row of the table of steps, beside a controller that takes ``ours`` instructions."""
        name = f"OSQP {self.iterations} iterations (MPC, horizon {HORIZON})"
        cells = ["coupling_device", name, f"{self.mean:.0f}", self.worst, self.code, self.stack]
        return "| " + " | ".join(map(str, [*cells, f"{self.mean / ours:.1f}", "-", "-"])) + " |"

    def notes(self) -> list[str]:
        """What the reader must know of that row."""
        import osqp

        return [
            f"OSQP {osqp.__version__}, generated C in float: horizon {HORIZON} of {PERIOD:g} s, |u| <= 5, {SOLVES} "
            "warm-started solves at random.",
            f"It keeps {self.static} bytes of writable static data. It is given what pbcgen's controller does without:",
            "all states of the plant and a linear model at the target. It plans ahead where a passivity-based law does",
            "not, and it proves nothing about the nonlinear loop.",
        ]


def measure() -> Solve:
    """Generate, compile and count. Raises ImportError without osqp, SystemExit if the C does not build."""
    import osqp

    report = pipeline.check(load("coupling_device"))
    loop = report.loop
    assert loop is not None
    P, gain = problem(loop)
    size = len(P)
    solver = osqp.OSQP()
    bound = 5.0 * np.ones(size)
    solver.setup(sp.csc_matrix(np.triu(P)), np.zeros(size), sp.eye(size).tocsc(), -bound, bound, verbose=False)
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        options = {"use_float": True, "printing_enable": False, "profiling_enable": False, "force_rewrite": True}
        solver.codegen(str(directory / "code"), parameters="vectors", **options)
        (directory / "step.c").write_text(
            '#include "osqp.h"\n#include "workspace.h"\nvoid step(const float *q, float *u);\n'
            "void step(const float *q, float *u)\n{\n    osqp_update_data_vec(&solver, q, 0, 0);\n"
            "    osqp_solve(&solver);\n    u[0] = solver.solution->x[0];\n    u[1] = (float)solver.info->iter;\n}\n"
            "float the_state[16];\nint main(void) { step(the_state, the_state); return 0; }\n"
        )
        code = directory / "code"
        target = TARGETS["cortex-m4f"]
        sources = [str(path) for path in sorted((code / "src").glob("*.c"))] + [str(code / "workspace.c")]
        include = [f"-I{code}", f"-I{code / 'inc' / 'public'}", f"-I{code / 'inc' / 'private'}"]
        flags = [*FLAGS, "-DOSQP_EMBEDDED_MODE=2", *include]
        linking = ["-nostartfiles", "-Wl,-e,main", "--specs=nosys.specs", "-Wl,--gc-sections", "-lm"]
        run([*target.gcc, *flags, "step.c", *sources, *linking, "-o", "image"], directory)
        run([*target.gcc, *flags, "-r", "-nostdlib", *sources, "-o", "own.o"], directory)
        image = Image.read(directory / "own.o", directory / "image")
    machine = Machine(image, target)
    rng = np.random.default_rng(0)
    counts, iterations = [], []
    for k in range(SOLVES):
        deviation = (loop.initial - loop.x_star) * (1.0 if k == 0 else rng.uniform(-1, 1))
        machine.write(0x6000_0400, (gain @ deviation).astype(np.float32).tobytes())
        counts.append(machine.call(image.address("step"), (0x6000_0400, 0x6000_0800))[1])
        u, count = np.frombuffer(machine.read(0x6000_0800, 8), np.float32)
        assert abs(u) <= 5.01, "the solve failed"
        iterations.append(int(count))
    span = f"{min(iterations)}" if min(iterations) == max(iterations) else f"{min(iterations)} to {max(iterations)}"
    return Solve(float(np.mean(counts)), max(counts), image.text, image.static, machine.stack_used(), span)
