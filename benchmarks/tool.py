"""How long the tool takes: `pbcgen generate` (which checks first), process start included, beside importing CasADi."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

SYSTEMS = ("coupling_device", "rlc", "pera", "pera_integral", "elastic_pendulum")
RESULT = Path(__file__).parent / "results" / "tool.md"
REPEATS = 3


def seconds(command: list[str]) -> float:
    """The best of a few runs."""
    best = float("inf")
    for _ in range(REPEATS):
        start = perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        best = min(best, perf_counter() - start)
    return best


def main() -> None:
    """Measure, print, and write the table."""
    reference = seconds([sys.executable, "-c", "import casadi, numpy"])
    rows = ["| command | seconds | x |", "|---|---|---|", f"| import casadi, numpy | {reference:.2f} | 1.0 |"]
    for system in SYSTEMS:
        with tempfile.TemporaryDirectory() as directory:
            time = seconds([sys.executable, "-m", "pbcgen", "generate", system, "-o", f"{directory}/{system}"])
        rows.append(f"| pbcgen generate {system} | {time:.2f} | {time / reference:.1f} |")
    heading = ["# The tool", "", "Check and generate, process start included; the best of three runs.", ""]
    text = "\n".join([*heading, *rows])
    RESULT.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
