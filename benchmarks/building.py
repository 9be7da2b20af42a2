"""How everything that is compared is compiled."""

from __future__ import annotations

import subprocess
from pathlib import Path

FLAGS = ("-std=gnu17", "-O2")


def run(command: list[str], directory: Path) -> str:
    """What a command prints. Raises SystemExit with the end of its messages if it fails."""
    result = subprocess.run(command, cwd=directory, capture_output=True, text=True, check=False)
    if result.returncode:
        raise SystemExit(f"{' '.join(command)}\n{result.stderr[-2000:]}")
    return result.stdout + result.stderr
