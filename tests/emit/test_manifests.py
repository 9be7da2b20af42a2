"""The manifests for the build systems of others, against what these ask for; a broken one must not pass."""

from __future__ import annotations

import json
from dataclasses import replace

import hand_made_laws as laws
import jsonschema
import pytest
import yaml
from manifest_schemas import check_arduino, check_platformio, check_zephyr

from pbcgen.emit import render
from pbcgen.emit.identifiers import MAX_PREFIX
from pbcgen.errors import EmitError

#: Names that a model may have and that some build system reads as something else, or does not allow.
NAMES = ["rlc", "On", "no", "null", "yes", "Arduino loop", "x" * 200, "motor: drive, 1/2 <a@b>", "θ [rad]", "3", "1e5"]


@pytest.mark.parametrize("name", NAMES)
def test_manifests_are_valid_for_any_name(name, tmp_path):
    package = render(replace(laws.two_channels(), name=name), laws.PROVENANCE)
    package.write(tmp_path)
    check_platformio(package.files["library.json"])
    properties = check_arduino(package.files["library.properties"])
    module = check_zephyr(package.files["zephyr/module.yml"])
    assert module["name"] == properties["name"] == package.prefix
    assert (tmp_path / module["build"]["cmake"] / "CMakeLists.txt").is_file()
    assert (tmp_path / properties["includes"]).is_file()
    assert (tmp_path / json.loads(package.files["library.json"])["headers"]).is_file()
    (sketch,) = (tmp_path / "examples").rglob("*.ino")
    assert sketch.stem == sketch.parent.name  # a sketch is named like its folder
    assert len(sketch.stem) <= 63


BROKEN = [
    ("library.json", check_platformio, '"name": "two_channels"', '"name": "a/b"'),
    ("library.json", check_platformio, '"keywords": ["control"]', '"keywords": ["Control!"]'),
    ("library.json", check_platformio, '"srcFilter"', '"srcfilter"'),
    ("library.json", check_platformio, '"frameworks": "*",', '"frameworks": "*"'),
    ("library.properties", check_arduino, "category=Device Control", "category=Control"),
    ("library.properties", check_arduino, "name=two_channels", "name=Arduino_two"),
    ("library.properties", check_arduino, "architectures=*", "architectures="),
    ("library.properties", check_arduino, "author=pbcgen", "author=pbcgen\nauthor=others"),
    ("zephyr/module.yml", check_zephyr, '"two_channels"', "on"),
    ("zephyr/module.yml", check_zephyr, "cmake: zephyr", "cmake: 1"),
    ("zephyr/module.yml", check_zephyr, "cmake: zephyr", "make: zephyr"),
]


@pytest.mark.parametrize(("file", "check", "old", "new"), BROKEN)
def test_a_broken_manifest_is_seen(file, check, old, new):
    text = render(laws.two_channels(), laws.PROVENANCE).files[file]
    assert old in text
    check(text)
    with pytest.raises((jsonschema.ValidationError, ValueError, yaml.YAMLError)):
        check(text.replace(old, new))


def test_public_names_differ_in_the_characters_that_c_compares():
    """C99 need not tell external names apart beyond 31 characters."""
    package = render(replace(laws.adjustable(), name="x" * 99), laws.PROVENANCE, extras=laws.EXTRAS)
    assert len(package.prefix) == MAX_PREFIX
    header = package.files[f"{package.prefix}.h"]
    names = {word.split("(")[0] for word in header.split() if word.startswith(f"{package.prefix}_") and "(" in word}
    assert len(names) == 6
    assert len({name[:31] for name in names}) == len(names)


@pytest.mark.parametrize("prefix", ["Arduino_arm", "x" * (MAX_PREFIX + 1)])
def test_a_prefix_that_a_build_system_refuses_is_refused(prefix):
    with pytest.raises(EmitError, match="prefix"):
        render(laws.two_channels(), laws.PROVENANCE, prefix=prefix)
