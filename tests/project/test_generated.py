"""The packages in `generated/` are what the generator writes today, byte for byte."""

import difflib
from pathlib import Path

import pytest

from pbcgen import pipeline
from pbcgen.models.loader import load

GENERATED = Path(__file__).resolve().parents[2] / "generated"
SYSTEMS = ("coupling_device", "pera", "rlc")


def texts(directory):
    files = sorted(path for path in directory.rglob("*") if path.is_file())
    return {path.relative_to(directory).as_posix(): path.read_bytes().decode("utf-8") for path in files}


def test_there_is_one_package_for_each_reference_system():
    assert sorted(path.name for path in GENERATED.iterdir() if path.is_dir()) == list(SYSTEMS)


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_reference_package_is_what_the_generator_writes(system, tmp_path):
    pipeline.generate(load(system), tmp_path / system)
    expected, written = texts(GENERATED / system), texts(tmp_path / system)
    changes = [
        line
        for name in sorted({*expected, *written})
        for line in difflib.unified_diff(
            expected.get(name, "").splitlines(),
            written.get(name, "").splitlines(),
            f"generated/{system}/{name}",
            "what the generator writes",
            lineterm="",
        )
    ]
    shown = "\n".join([*changes[:60], *(["..."] if len(changes) > 60 else [])])
    assert expected == written, f"if the change is wanted, run `make generated-{system}` and commit:\n{shown}"
