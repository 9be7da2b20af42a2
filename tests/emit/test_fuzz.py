"""libFuzzer on the step, with the sanitizers: whatever the bits, u in its interval and the state finite."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import hand_made_laws as laws
import pytest
from compiled import run
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from pbcgen.emit import render
from pbcgen.law.law import Fallback

#: Of each fuzzer; `make fuzz` takes 600.
SECONDS = int(os.environ.get("FUZZ_SECONDS", "3"))
GENERATED = Path(__file__).resolve().parents[2] / "generated"


def fuzzer_links() -> bool:
    """Whether there is a clang with libFuzzer and its sanitizers."""
    if not shutil.which("clang"):
        return False
    program = "int LLVMFuzzerTestOneInput(const char *d, long n) { return (int)n * (d == 0); }"
    command = ["clang", "-fsanitize=fuzzer,address", "-xc", "-", "-o", os.devnull]
    return subprocess.run(command, input=program, text=True, capture_output=True, check=False).returncode == 0


pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(not fuzzer_links(), reason="no libFuzzer (apt: clang libclang-rt-14-dev)"),
]

PACKAGES = {
    "coupling_device": None,
    "pera": None,
    "holding": lambda: laws.two_channels("double", Fallback.LAST_OUTPUT),
    "block": lambda: laws.block("float"),
    "adjustable": laws.adjustable,
    "steered": laws.steered,
}


@pytest.mark.parametrize("name", PACKAGES)
def test_fuzzing_finds_nothing(name, tmp_path):
    make = PACKAGES[name]
    if make is None:
        files = {path.name: path.read_text() for path in (GENERATED / name).iterdir() if path.is_file()}
    else:
        files = render(make(), laws.PROVENANCE, extras=laws.EXTRAS).files
    manifest = json.loads(files["manifest.json"])
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    prefix = manifest["prefix"]
    for file in (f"{prefix}.c", f"{prefix}.h"):
        (tmp_path / file).write_text(files[file])
    (tmp_path / "fuzz.c").write_text(
        environment.get_template("fuzz.c.j2").render(
            prefix=prefix,
            upper=prefix.upper(),
            real=manifest["precision"],
            outputs=manifest["outputs"],
            states=manifest["states"],
            settings=manifest.get("settings", {}),
            bumpless="bumpless_start" in manifest,
        )
    )
    sanitizers = "-fsanitize=fuzzer,address,undefined,float-cast-overflow"
    command = ["clang", "-std=c99", "-O1", "-g", sanitizers, "-fno-sanitize-recover=all", "fuzz.c", f"{prefix}.c"]
    run([*command, "-lm", "-o", "fuzz"], cwd=tmp_path)
    limits = [f"-max_total_time={SECONDS}", "-max_len=400", "-seed=1", "-print_final_stats=1"]
    result = subprocess.run(["./fuzz", *limits], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
    executed = [line for line in result.stderr.splitlines() if "number_of_executed_units" in line]
    print(f"\n{name}: {executed[0].split()[-1] if executed else '?'} runs in {SECONDS} s")
