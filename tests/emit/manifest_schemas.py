"""What the build systems ask of the manifests of a package, as JSON schemas in words of our own.

Sources: the library.json schema and the manifest checks of PlatformIO Core; the library specification of the Arduino
project and the rules of arduino-lint; the module schema in Zephyr's scripts/zephyr_module.py.
"""

from __future__ import annotations

from typing import Any

import jsonschema
import yaml

_SEMVER = r"^(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)(-[0-9A-Za-z.-]+)?(\+[0-9A-Za-z.-]+)?$"


def _text(most: int, pattern: str = "", least: int = 1) -> dict[str, Any]:
    return {"type": "string", "minLength": least, "maxLength": most} | ({"pattern": pattern} if pattern else {})


def _one_or_more(item: dict[str, Any]) -> dict[str, Any]:
    return {"anyOf": [item, {"type": "array", "items": item}]}


_PLATFORM = _text(50, r"^([a-z\d_-]+|\*)$")

PLATFORMIO: dict[str, Any] = {
    "type": "object",
    "required": ["name", "version", "description", "keywords"],
    "additionalProperties": False,
    "properties": {
        "$schema": {"type": "string"},
        "name": _text(50, r"^[^:;/,@<>]+$"),
        "version": _text(20, _SEMVER),
        "description": _text(255),
        "keywords": _one_or_more(_text(50, r"^[a-z\d+. -]+$")),
        "license": _text(255),
        "frameworks": _one_or_more(_PLATFORM),
        "platforms": _one_or_more(_PLATFORM),
        "headers": _one_or_more({"type": "string"}),
        "build": {
            "type": "object",
            "additionalProperties": False,
            "properties": {
                "flags": _one_or_more({"type": "string"}),
                "includeDir": {"type": "string"},
                "srcDir": {"type": "string"},
                "srcFilter": _one_or_more({"type": "string"}),
                "libArchive": {"type": "boolean"},
            },
        },
    },
}

_CATEGORIES = """
    Display; Communication; Signal Input/Output; Sensors; Device Control; Timing; Data Storage; Data Processing; Other
"""
_NOT_THEIRS = r"^(?![aA][rR][dD][uU][iI][nN][oO])"
_ARDUINO_NAME = _NOT_THEIRS + r"(?=.*[A-Za-z])[A-Za-z0-9][A-Za-z0-9 _.-]*$"

ARDUINO: dict[str, Any] = {
    "type": "object",
    "required": [
        *("name", "version", "author", "maintainer", "sentence", "paragraph", "category", "url", "architectures"),
    ],
    "additionalProperties": False,
    "properties": {
        "name": _text(63, _ARDUINO_NAME),
        "version": {"type": "string", "pattern": _SEMVER},
        "author": _text(255),
        "maintainer": _text(255, _NOT_THEIRS),
        "sentence": _text(255),
        "paragraph": {"type": "string"},
        "category": {"enum": [c.strip() for c in _CATEGORIES.split(";")]},
        "url": {"type": "string", "pattern": r"^https?://[^\s]+$"},
        "architectures": _text(255),
        "includes": _text(255),
        "depends": {"type": "string"},
        "dot_a_linkage": {"enum": ["true", "false"]},
        "precompiled": {"enum": ["true", "full", "false"]},
        "ldflags": {"type": "string"},
    },
}

_TEXTS = {"type": "array", "items": {"type": "string"}}

ZEPHYR: dict[str, Any] = {
    "type": "object",
    "additionalProperties": False,
    "properties": {
        "name": {"type": "string"},
        "build": {
            "type": "object",
            "additionalProperties": False,
            "properties": {
                **{key: {"type": "string"} for key in ("cmake", "kconfig", "sysbuild-cmake", "sysbuild-kconfig")},
                **{
                    key: {"type": "boolean"}
                    for key in ("cmake-ext", "kconfig-ext", "sysbuild-cmake-ext", "sysbuild-kconfig-ext")
                },
                "depends": _TEXTS,
                "settings": {"type": "object"},
            },
        },
        **dict.fromkeys(("tests", "samples", "boards"), _TEXTS),
        "blobs": {"type": "array"},
    },
}


def check_platformio(text: str) -> None:
    """Raises ValidationError or ValueError."""
    import json

    jsonschema.validate(json.loads(text), PLATFORMIO)


def check_arduino(text: str) -> dict[str, str]:
    """The properties. Raises ValidationError or ValueError."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    pairs = [line.split("=", 1) for line in lines]
    if any(len(pair) != 2 or pair[0] != pair[0].strip() for pair in pairs):
        raise ValueError("a line is no key=value")
    if len({key for key, _ in pairs}) != len(pairs):
        raise ValueError("a key stands twice")
    jsonschema.validate(dict(pairs), ARDUINO)
    return dict(pairs)


def check_zephyr(text: str) -> dict[str, Any]:
    """The module. Raises ValidationError or YAMLError."""
    module: dict[str, Any] = yaml.safe_load(text)
    jsonschema.validate(module, ZEPHYR)
    return module
