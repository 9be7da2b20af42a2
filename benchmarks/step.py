"""What one control step costs: ours, CasADi's C, SymPy's C, OSQP's; on Cortex-M4F (emulated) and x86-64 (callgrind).

Run with ``make bench``. Everything that is compared is compiled with the same compiler and flags and steps through the
same measurements. What is missing on this machine is left out, and the table says so.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks import mpc
from benchmarks.building import FLAGS, run
from benchmarks.rivals import Rival, rivals
from pbcgen import pipeline
from pbcgen.law.closed_loop import ClosedLoop
from pbcgen.models.loader import load
from pbcgen.run.emulate import Image, Machine
from pbcgen.run.simulate import PythonStepper, simulate_sampled
from pbcgen.run.targets import TARGETS

if TYPE_CHECKING:
    from pbcgen.emit import Package
    from pbcgen.law.law import ControlLaw

SYSTEMS = ("coupling_device", "rlc", "pera", "pera_integral")
STEPS = 400
RESULT = Path(__file__).parent / "results" / "step.md"


def ours(package: Package) -> Rival:
    """Our package behind the interface of the rivals; its structs are arrays of floats."""
    p = package.prefix
    own = package.files[f"{p}.c"].replace(f'#include "{p}.h"', package.files[f"{p}.h"])
    wrapper = f"""
void step(float *xi, const float *m, float *u);
void step(float *xi, const float *m, float *u)
{{
    (void){p}_step(({p}_state_t *)xi, (const {p}_input_t *)m, ({p}_output_t *)u);
}}
"""
    return Rival("pbcgen", own + wrapper, "float")


def reachable(law: ControlLaw, loop: ClosedLoop) -> np.ndarray:
    """Measurements of the closed loop, then random ones around it."""
    duration = float(min(loop.duration, STEPS * float(law.sample_period)))
    with np.errstate(all="ignore"):
        run = simulate_sampled(loop, PythonStepper(law), law.sample_period, duration)
    measured = np.array(loop.measure.map(len(run.times))(run.x.T)).reshape(len(law.inputs), -1).T
    middle = np.array(loop.measure(loop.x_star), dtype=float).ravel()
    span = np.abs(measured - middle).max(axis=0)
    return np.vstack([measured, middle + span * np.random.default_rng(0).uniform(-1, 1, (STEPS, len(middle)))])


def on_target(rival: Rival, entry: str, law: ControlLaw, m: np.ndarray) -> tuple[float, int, int, int]:
    """(mean, worst, code bytes, stack bytes) on Cortex-M4F with gcc; the call is part of the count."""
    target = TARGETS["cortex-m4f"]
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        (directory / "own.c").write_text(rival.source)
        (directory / "main.c").write_text(
            f"char the_state[256];\nvoid step({rival.real} *, const {rival.real} *, {rival.real} *);\n"
            "int main(void) { step((void *)the_state, (void *)the_state, (void *)the_state); return 0; }\n"
        )
        run([*target.gcc, *FLAGS, "-c", "own.c", "-o", "own.o"], directory)
        linking = ["-nostartfiles", "-Wl,-e,main", "--specs=nosys.specs"]
        run([*target.gcc, *FLAGS, "main.c", "own.o", *linking, "-lm", "-o", "image"], directory)
        image = Image.read(directory / "own.o", directory / "image")
    machine = Machine(image, target)
    dtype = np.dtype(np.float32 if rival.real == "float" else np.float64)
    state, measured, output = 0x6000_0000, 0x6000_0400, 0x6000_0800
    machine.write(state, bytes(256))
    counts = []
    for row in m:
        machine.write(measured, row.astype(dtype).tobytes())
        counts.append(machine.call(image.address(entry), (state, measured, output))[1])
    return float(np.mean(counts)), max(counts), image.text, machine.stack_used()


def on_host(rival: Rival, law: ControlLaw, m: np.ndarray) -> float:
    """Mean instructions on x86-64 by callgrind, library functions included."""
    rows = ",\n".join("{" + ", ".join(float(v).hex() for v in row) + "}" for row in m)
    main = f"""
void step({rival.real} *xi, const {rival.real} *m, {rival.real} *u);
static const double rows[{len(m)}][{m.shape[1]}] = {{ {rows} }};
int main(void)
{{
    static {rival.real} xi[64], u[64], m[{m.shape[1]}];
    for (int k = 0; k < {len(m)}; ++k) {{
        for (int i = 0; i < {m.shape[1]}; ++i) m[i] = ({rival.real})rows[k][i];
        step(xi, m, u);
    }}
    return 0;
}}
"""
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        (directory / "own.c").write_text(rival.source)
        (directory / "main.c").write_text(main)
        run(["cc", *FLAGS, "main.c", "own.c", "-lm", "-o", "main"], directory)
        tool = ["valgrind", "--tool=callgrind", "--callgrind-out-file=out", "--toggle-collect=step", "./main"]
        printed = run(tool, directory)
    collected = re.search(r"Collected : (\d+)", printed)
    assert collected is not None, printed
    return int(collected[1]) / len(m)


def table(system: str) -> list[str]:
    """The rows of one system."""
    report = pipeline.check(load(system))
    law, loop = report.control, report.loop
    assert law is not None
    assert loop is not None
    package = pipeline.package(report, allow=tuple(claim.claim for claim in report.blocking()))
    m = reachable(law, loop)
    rows: list[str] = []
    base: dict[str, float] = {}
    for rival in (ours(package), *rivals(law)):
        cells: list[Any] = [system, rival.name]
        if shutil.which("arm-none-eabi-gcc"):
            entry = f"{package.prefix}_step" if rival.name == "pbcgen" else "step"
            mean, worst, text, stack = on_target(rival, entry, law, m)
            base.setdefault("target", mean)
            cells += [f"{mean:.0f}", worst, text, stack, f"{mean / base['target']:.1f}"]
        else:
            cells += ["-"] * 5
        if shutil.which("valgrind") and shutil.which("cc"):
            mean = on_host(rival, law, m)
            base.setdefault("host", mean)
            cells += [f"{mean:.0f}", f"{mean / base['host']:.1f}"]
        else:
            cells += ["-"] * 2
        rows.append("| " + " | ".join(map(str, cells)) + " |")
        print(rows[-1], flush=True)
    return rows


def version(command: str) -> str:
    if not shutil.which(command):
        return f"{command}: not installed, its columns are empty"
    return subprocess.run([command, "--version"], capture_output=True, text=True, check=False).stdout.splitlines()[0]


def predictive(rows: list[str]) -> tuple[list[str], list[str]]:
    """The row of the predictive controller, and what must be known of it; a note alone where it cannot be made."""
    try:
        solve = mpc.measure()
    except ImportError:
        return [], ["OSQP is not installed (pip install osqp): its row is left out"]
    except (SystemExit, FileNotFoundError) as error:
        return [], [f"OSQP's C was not built ({str(error).splitlines()[0]}): its row is left out"]
    ours = next(row for row in rows if row.startswith("| coupling_device | pbcgen |"))
    return [solve.row(float(ours.split("|")[3]))], solve.notes()


def main() -> None:
    rows = [row for system in SYSTEMS for row in table(system)]
    more, notes = predictive(rows)
    rows += more
    lines = [
        "# One control step",
        "",
        "Instructions of one step, the call included, over a run of the closed loop and random points around it.",
        f"Flags: `{' '.join(FLAGS)}`. Code, constants included, is without library functions,",
        "stack with them; `x` is relative to pbcgen.",
        "Only pbcgen checks its inputs and clamps its outputs. The rivals use the math library's tanh and as many",
        "Newton steps as the accuracy of the precision needs; CasADi's code as generated is in double, which",
        "Cortex-M4F computes in software.",
        "",
        "| system | generator | Cortex-M4F: mean | worst | code, bytes | stack, bytes | x | x86-64: mean | x |",
        "|---|---|---|---|---|---|---|---|---|",
        *rows,
        "",
        *([*notes, ""] if notes else []),
        "pbcgen's own memory: no heap, no writable static data; the state is in the package's README.",
        "",
        f"- {version('arm-none-eabi-gcc')}, emulated by unicorn",
        f"- {version('cc')}, counted by {version('valgrind')}",
        "",
    ]
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text("\n".join(lines))


if __name__ == "__main__":
    main()
