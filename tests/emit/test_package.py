"""Rendering and writing: contents, reproducibility, refusals."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import hand_made_laws as laws
import numpy as np
import pytest

from pbcgen.emit import render
from pbcgen.errors import EmitError
from pbcgen.law.law import Signal


@pytest.fixture
def package():
    return render(laws.two_channels("float"), laws.PROVENANCE, extra_files={"certificate.json": "{}\n"})


def test_the_package_has_the_files_of_the_design(package):
    sources = ["two_channels.h", "two_channels.c", "two_channels_example.c"]
    others = ["CMakeLists.txt", "Makefile", "README.md", "manifest.json", "certificate.json"]
    arduino = ["library.properties", "examples/two_channels_sketch/two_channels_sketch.ino"]
    builds = ["two_channels.mk", "library.json", "zephyr/module.yml", "zephyr/CMakeLists.txt"]
    assert list(package.files) == sorted([*sources, *others, *arduino, *builds])


def test_every_file_is_ascii_with_unix_line_ends_and_no_loose_blanks(package):
    for name, text in package.files.items():
        assert text.isascii(), name
        assert text.endswith("\n")
        assert not text.endswith("\n\n")
        assert "\r" not in text
        assert all(line == line.rstrip() for line in text.splitlines()), name
        assert "\n\n\n" not in text, name


def test_the_manifest_lists_every_file_with_its_digest(package):
    manifest = json.loads(package.files["manifest.json"])
    assert set(manifest["files"]) == set(package.files) - {"manifest.json"}
    for name, entry in manifest["files"].items():
        data = package.files[name].encode()
        assert entry == {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    assert manifest["memory"]["state_bytes"] == 8
    assert manifest["renamed"] == [{"c": "class_", "python": "class"}, {"c": "theta", "python": "θ"}]
    assert manifest["outputs"][1]["emitted_bounds"] == ["-0.3333333f", "0.3333333f"]
    assert manifest["derived"] == {"gamma": ["q"], "kappa": [0.25]}


def test_header_and_readme_state_units_bounds_verdicts_and_what_is_not_proved(package):
    header, readme = package.files["two_channels.h"], package.files["README.md"]
    for text in (header, readme):
        assert laws.PROVENANCE.model_hash in text
        assert "[-2.75, 2.25]" in text
        assert "[0, 10]" in text
        assert "the loop was not proved to be stable at this sample period" in text
        assert "Joint friction" in text
        assert "0.001 s" in text
    assert "UNDECIDED" in header
    assert "belongs to you" in readme


def test_a_prefix_names_everything():
    package = render(laws.stateless(), laws.PROVENANCE, prefix="Gov")
    assert {"Gov.h", "Gov.c", "Gov_example.c"} <= set(package.files)
    assert "Gov_status_t Gov_step(Gov_state_t *state" in package.files["Gov.h"]
    assert "GOV_INVALID_INPUT" in package.files["Gov.h"]
    assert "stateless" not in package.files["Gov.c"]


def test_hostile_text_stays_inside_comments_and_tables():
    law = laws.stateless()
    evil = Signal("v", "m/s */ #error\n", 'speed | `x` ??/ \\ "\t\x00')
    package = render(
        replace(law, name="a */ int b; /*", inputs=(evil,)), replace(laws.PROVENANCE, notes=("*/ #error",)), prefix="p"
    )
    code = package.files["p.h"].split("*/", 1)[1]
    assert "#error" not in code.replace("* / #error", "")
    assert all(text.isascii() for text in package.files.values())


def test_interval_bounds_are_rounded_inward():
    tight = Fraction(3, 10), Fraction(7, 10)  # the floats nearest to them lie outside
    package = render(replace(laws.stateless("float"), intervals=(tight,)), laws.PROVENANCE)
    texts = json.loads(package.files["manifest.json"])["outputs"][0]["emitted_bounds"]
    low, high = (Fraction(float(np.float32(text.rstrip("f")))) for text in texts)
    assert tight[0] <= low < high <= tight[1]
    assert low - tight[0] < Fraction(1, 10**7)
    assert tight[1] - high < Fraction(1, 10**7)


@pytest.mark.parametrize(
    "interval",
    [(Fraction(1, 3), Fraction(1, 3)), (Fraction(0), Fraction(10) ** 39), (Fraction(1, 10**40), Fraction(1))],
)
def test_an_interval_that_float_cannot_hold_is_refused(interval):
    with pytest.raises(EmitError, match="interval of `F`"):
        render(replace(laws.stateless("float"), intervals=(interval,)), laws.PROVENANCE)


def test_derived_facts_that_json_cannot_hold_are_refused():
    for value in (float("nan"), object()):
        with pytest.raises(EmitError, match="manifest"):
            render(laws.stateless(), replace(laws.PROVENANCE, derived={"x": value}))


@pytest.mark.parametrize("name", ["two_channels.c", "manifest.json", "../evil", ".hidden", ""])
def test_an_extra_file_cannot_replace_or_escape(name):
    with pytest.raises(EmitError, match="extra file"):
        render(laws.two_channels(), laws.PROVENANCE, extra_files={name: ""})


def test_writing_twice_is_the_same_and_nothing_else_appears(package, tmp_path):
    for _ in range(2):
        package.write(tmp_path / "new" / "out")
    out = tmp_path / "new" / "out"
    found = {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert found == {name: text.encode() for name, text in package.files.items()}


def test_a_new_version_replaces_an_old_one_and_leaves_build_products(package, tmp_path):
    render(laws.two_channels("double"), laws.PROVENANCE).write(tmp_path)
    (tmp_path / "build").mkdir()
    (tmp_path / "build" / "x.o").write_text("object")
    package.write(tmp_path)
    assert "float" in (tmp_path / "two_channels.h").read_text()
    assert (tmp_path / "build" / "x.o").exists()


@pytest.mark.parametrize("name", ["notes.txt", "README.md", "Makefile", "two_channels.c", "manifest.json", "src/x.c"])
def test_a_directory_with_files_of_the_user_is_refused_untouched(package, tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    with pytest.raises(EmitError, match=str(tmp_path)):
        package.write(tmp_path)
    assert path.read_text() == "mine"
    assert len(list(tmp_path.rglob("*"))) == 1 + (path.parent != tmp_path)


def test_a_generated_file_that_was_edited_is_not_overwritten(package, tmp_path):
    package.write(tmp_path)
    (tmp_path / "Makefile").write_text("edited")
    with pytest.raises(EmitError, match=r"Makefile .* changed"):
        render(laws.two_channels("double"), laws.PROVENANCE).write(tmp_path)
    assert (tmp_path / "Makefile").read_text() == "edited"


def test_another_package_in_the_directory_is_refused(package, tmp_path):
    package.write(tmp_path)
    with pytest.raises(EmitError, match="two_channels"):
        render(laws.stateless(), laws.PROVENANCE).write(tmp_path)


def test_a_file_in_place_of_the_directory_is_refused(package, tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(EmitError, match="is a file"):
        package.write(tmp_path / "out")


def test_an_interrupted_write_can_be_repeated(package, tmp_path):
    package.write(tmp_path)
    (tmp_path / "manifest.json").rename(tmp_path / ".manifest.json.new")
    (tmp_path / "Makefile").unlink()
    package.write(tmp_path)
    assert (tmp_path / "Makefile").exists()


@pytest.mark.system
def test_the_bytes_depend_on_neither_hash_seed_nor_locale():
    program = (
        "import hashlib, json, hand_made_laws as laws\nfrom pbcgen.emit import render\n"
        "for law in (laws.two_channels('float'), laws.block(), laws.mixed()):\n"
        "    print(hashlib.sha256(json.dumps(list(render(law, laws.PROVENANCE).files.items())).encode()).hexdigest())\n"
    )
    root = Path(__file__).parents[2]
    outputs = set()
    for seed, locale in (("0", "C"), ("1", "C.UTF-8"), ("4242", "POSIX")):
        environment = os.environ | {"PYTHONHASHSEED": seed, "LC_ALL": locale}
        environment["PYTHONPATH"] = os.pathsep.join([str(root), str(Path(__file__).parent)])
        command = [sys.executable, "-c", program]
        outputs.add(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)
    assert len(outputs) == 1
