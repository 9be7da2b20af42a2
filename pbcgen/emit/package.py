"""The C package: render a law, write the files."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final

import pbcgen
from pbcgen.emit import wording
from pbcgen.emit.identifiers import package_prefix
from pbcgen.emit.lowering import Extras, program_of
from pbcgen.emit.program import Program
from pbcgen.emit.templating import fill
from pbcgen.errors import EmitError
from pbcgen.law.law import ControlLaw, ScalarSolve
from pbcgen.law.step import StepStatus

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from pbcgen.emit.step_cost import StepCost

MANIFEST: Final = "manifest.json"

#: What `make` and CMake leave behind in a package's directory.
BUILD_DIRECTORY: Final = "build"


@dataclass(frozen=True)
class Provenance:
    """Where a package comes from: what its header, README and manifest state beside the law.

    Attributes:
        model_hash: SHA-256 of the canonical text of the design.
        verdicts: (claim, status, domain) for each claim that was checked.
        allowed: the claims that were let pass without proof.
        notes: sentences that the user must read.
        derived: JSON-able facts (kappa, gamma as text, ...).
        delay: from measurement to actuation in the verdicts, in sample periods.
        jitter: the share by which periods vary in the verdicts.
    """

    model_hash: str
    verdicts: tuple[tuple[str, str, str], ...]
    allowed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    derived: Mapping[str, Any] = field(default_factory=dict)
    delay: Fraction = Fraction(0)
    jitter: Fraction = Fraction(0)


@dataclass(frozen=True)
class Package:
    """The files of one package.

    Attributes:
        prefix: ``<p>`` of all names.
        files: file name -> text, sorted by name; every text is ASCII with LF line ends.
        renamed: (name in Python, name in C) of the signals whose names could not stay.
    """

    prefix: str
    files: Mapping[str, str]
    renamed: tuple[tuple[str, str], ...]

    def write(self, directory: Path) -> None:
        """Write the files into ``directory``, which is made if it does not exist.

        Each file appears complete or not at all; the manifest comes last. Nothing is ever deleted.

        Raises EmitError, before anything is written, if ``directory`` holds anything but this package as
        it was generated before: other files, another package, or files that were changed by hand since.
        """
        _check_target(directory, self)
        directory.mkdir(parents=True, exist_ok=True)
        for name in sorted(self.files, key=lambda name: (name == MANIFEST, name)):
            path, temporary = directory / name, directory / _temporary(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(self.files[name].encode("utf-8"))
            os.replace(temporary, path)


def render(
    law: ControlLaw,
    provenance: Provenance,
    prefix: str | None = None,
    extra_files: Mapping[str, str] | None = None,
    costs: Sequence[StepCost] = (),
    extras: Extras | None = None,
) -> Package:
    """The package of ``law``. ``extra_files`` (name -> text) join it and its manifest: the certificate.

    ``costs``, if measured, go into README and manifest. ``extras`` are functions on demand.

    Raises EmitError for what cannot be written in C: a constant that the precision cannot hold, a prefix that is no
    identifier; UnsupportedOperation for an operation without a C form.
    """
    program = program_of(law, package_prefix(prefix, law.name), extras or Extras())
    context = _context(law, provenance, program) | {"costs": costs}
    names = {
        f"{program.prefix}.h": "header.h.j2",
        f"{program.prefix}.c": "source.c.j2",
        f"{program.prefix}_example.c": "example.c.j2",
        "CMakeLists.txt": "CMakeLists.txt.j2",
        "Makefile": "Makefile.j2",
        "README.md": "README.md.j2",
        f"{program.prefix}.mk": "fragment.mk.j2",
        "library.json": "library.json.j2",
        "library.properties": "library.properties.j2",
        f"examples/{program.prefix}_sketch/{program.prefix}_sketch.ino": "sketch.ino.j2",
        "zephyr/module.yml": "module.yml.j2",
        "zephyr/CMakeLists.txt": "zephyr.cmake.j2",
    }
    files = {name: fill(template, context) for name, template in names.items()}
    for name, text in (extra_files or {}).items():
        if name in files or name == MANIFEST or not _is_plain_name(name):
            raise EmitError(f"the extra file `{name}` cannot join the package: choose another name")
        files[name] = text
    files[MANIFEST] = _manifest(law, provenance, program, files, costs)
    return Package(program.prefix, dict(sorted(files.items())), program.renamed)


def _temporary(name: str) -> str:
    """The name of a file while it is written, in the package's directory."""
    return f".{name.replace('/', '-')}.new"


def _is_plain_name(name: str) -> bool:
    return bool(name) and not name.startswith(".") and not set(name) & set("/\\:\0")


def _context(law: ControlLaw, provenance: Provenance, program: Program) -> dict[str, Any]:
    """What the templates see: the fields of the program and of its constants, and prose."""
    return {
        **vars(program),
        **vars(program.constants),
        "upper": program.upper,
        "holds": program.holds,
        "moves": program.moves,
        "helpers": program.helpers,
        "channels": law.channels,
        "degree": len(program.fast_tanh.denominator) if program.fast_tanh else 0,
        "input_texts": [f"input->{member.c_name}" for member in program.inputs],
        "checks_finite": any("_is_finite(" in check for check in program.body.prepare_checks)
        or program.block_functions,
        "law": law,
        "provenance": provenance,
        "statuses": _statuses(law, program),
        "version": pbcgen.__version__,
        "words": wording,
        "header_text": header_text(law, provenance, program),
        "fallback_text": wording.fallback_text(law),
        "equilibrium_text": wording.EQUILIBRIUM_TEXT,
        "memory": _memory(law, program),
    }


@dataclass(frozen=True)
class StatusName:
    """One enumerator of ``<p>_status_t``."""

    c_name: str
    value: int
    meaning: str


def _statuses(law: ControlLaw, program: Program) -> tuple[StatusName, ...]:
    return tuple(
        StatusName(f"{program.upper}_{status.name}", int(status), wording.status_meaning(status, law))
        for status in StepStatus
        if law.setters or status is not StepStatus.INVALID_SETTING
    )


def _memory(law: ControlLaw, program: Program) -> dict[str, int]:
    """Sizes of the structs in bytes; members of one type have no padding."""
    size = 4 if law.precision == "float" else 8
    return {
        "input_bytes": size * len(program.inputs),
        "output_bytes": size * len(program.outputs),
        "state_bytes": size * max(1, len(program.states)),
        "writable_static_bytes": 0,
        "heap_bytes": 0,
    }


def header_text(law: ControlLaw, provenance: Provenance, program: Program) -> list[str]:
    """The comment at the top of the header."""
    period = wording.number(law.sample_period)
    lines = [
        *wording.wrap(f"{law.name}: saturated passivity-based controller, law `{law.law}`."),
        "",
        f"Generated by pbcgen {pbcgen.__version__}. Do not edit: change the model and generate again.",
        f"Model: SHA-256 {wording.plain(provenance.model_hash)}",
        f"Sample period: {period} s. Arithmetic: {wording.precision_text(law.precision)}.",
        "",
        "Inputs, read once a step, in the units below; the ranges are those of the model and are not checked:",
        *wording.table(
            (m.c_name, m.signal.unit, wording.interval(m.range), m.signal.description) for m in program.inputs
        ),
        "Outputs, always in these intervals:",
        *wording.table(
            (m.c_name, m.signal.unit, wording.interval(m.interval), m.signal.description) for m in program.outputs
        ),
        "",
        *wording.wrap(f"Timing in the verdicts: {wording.timing(provenance.delay, provenance.jitter)}."),
        "",
        "Verdicts on the model (in exact or certified arithmetic; the C rounds):",
        *wording.table(provenance.verdicts),
    ]
    for claim in provenance.allowed:
        lines += ["", *wording.wrap(f"NOT PROVED ({claim}): {wording.unproved(claim)}. The user allowed it.")]
    for note in provenance.notes:
        lines += ["", *wording.wrap(f"Note: {note}")]
    if program.renamed:
        lines += ["", "Names of the model that C does not allow here:"]
        lines += wording.table((c, f"is {wording.code_points(python)}") for python, c in program.renamed)
    return lines


def _manifest(
    law: ControlLaw,
    provenance: Provenance,
    program: Program,
    files: Mapping[str, str],
    costs: Sequence[StepCost],
) -> str:
    """The machine-readable description; it lists every file but itself."""
    document = {
        "generator": {"name": "pbcgen", "version": pbcgen.__version__},
        "prefix": program.prefix,
        "design": law.name,
        "law": law.law,
        "precision": law.precision,
        "sample_period": {"exact": str(law.sample_period), "seconds": float(law.sample_period)},
        "delay": {"exact": str(provenance.delay), "samples": float(provenance.delay)},
        "jitter": {"exact": str(provenance.jitter), "share": float(provenance.jitter)},
        "model_hash": provenance.model_hash,
        "inputs": [_signal(m) | {"range": _bounds(m.range)} for m in program.inputs],
        "outputs": [
            _signal(m)
            | {
                "interval": _bounds(m.interval),
                "emitted_bounds": [m.low, m.high],
                "equilibrium": m.equilibrium,
                "macros": [f"{program.upper}_{m.macro}_MIN", f"{program.upper}_{m.macro}_MAX"],
            }
            for m in program.outputs
        ],
        "states": [_signal(m) | {"initial": m.initial, "role": m.role} for m in program.states],
        **_functions(program),
        "fallback": wording.fallback_text(law),
        "statuses": [asdict(status) for status in _statuses(law, program)],
        "solves": [_solve(solve) for solve in law.solves],
        "constants": {"state_limit": program.constants.state_limit},
        "memory": _memory(law, program),
        "figures": [cost.as_json() for cost in costs],
        "tanh": law.tanh,
        "verdicts": [{"claim": c, "status": s, "domain": d} for c, s, d in provenance.verdicts],
        "allowed": [{"claim": claim, "meaning": wording.unproved(claim)} for claim in provenance.allowed],
        "notes": list(provenance.notes),
        "derived": dict(provenance.derived),
        "renamed": [{"python": python, "c": c} for python, c in program.renamed],
        "files": {name: {"sha256": _digest(text), "bytes": len(text.encode())} for name, text in files.items()},
    }
    try:
        return json.dumps(document, indent=2, sort_keys=True, allow_nan=False) + "\n"
    except (TypeError, ValueError) as error:
        raise EmitError(f"the manifest cannot hold the derived facts: {error}") from error


def _functions(program: Program) -> dict[str, Any]:
    """The functions beside init and step; nothing where there are none."""
    result: dict[str, Any] = {}
    if program.setters:
        result["settings"] = {
            setter.group: [
                _signal(m) | {"range": _bounds(m.interval), "emitted_bounds": [m.low, m.high], "start": m.start}
                for m in setter.inputs
            ]
            for setter in program.setters
        }
    if program.start:
        result["bumpless_start"] = f"{program.prefix}_start_at"
    if program.selftest:
        result["selftest"] = f"{program.prefix}_selftest"
    return result


def _signal(member: Any) -> dict[str, Any]:
    signal = member.signal
    return {"name": signal.name, "c_name": member.c_name, "unit": signal.unit, "description": signal.description}


def _bounds(bounds: Any) -> list[str] | None:
    return None if bounds is None else [str(bounds[0]), str(bounds[1])]


def _solve(solve: Any) -> dict[str, Any]:
    kind = "scalar" if isinstance(solve, ScalarSolve) else "block"
    given = {name: value for name, value in asdict(solve).items() if value is not None}
    return {"kind": kind, **given}


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def _check_target(directory: Path, package: Package) -> None:
    """Raise EmitError unless everything in ``directory`` is this package, unchanged since it was generated."""
    if not directory.exists():
        return
    if not directory.is_dir():
        raise EmitError(f"{directory} is a file: choose a directory for the package")
    recorded = _recorded(directory / MANIFEST, package.prefix)
    hashes: dict[str, set[str]] = {name: {digest} for name, digest in recorded.items()}
    for name, text in package.files.items():
        hashes.setdefault(name, set()).add(_digest(text))
    folders = {parent for name in hashes for parent in PurePosixPath(name).parents}
    passed = {_temporary(name) for name in package.files} | ({MANIFEST} if recorded else set())
    for entry in sorted(directory.rglob("*")):
        path = PurePosixPath(entry.relative_to(directory).as_posix())
        name = str(path)
        built = bool(recorded) and path.parts[0] == BUILD_DIRECTORY and (directory / BUILD_DIRECTORY).is_dir()
        if built or name in passed or (entry.is_dir() and path in folders):
            continue
        if name not in hashes or not entry.is_file():
            raise EmitError(f"{directory} holds `{name}`, which is not part of the package: choose an empty directory")
        if hashlib.sha256(entry.read_bytes()).hexdigest() not in hashes[name]:
            raise EmitError(f"{entry} was not generated by pbcgen or was changed since: move it away first")


def _recorded(manifest: Path, prefix: str) -> dict[str, str]:
    """File name -> SHA-256 as an existing manifest of the same package records them; empty if there is none."""
    try:
        document = json.loads(manifest.read_text(encoding="utf-8"))
        if document["generator"]["name"] != "pbcgen":
            return {}
        files = {name: entry["sha256"] for name, entry in document["files"].items()}
        found = document["prefix"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    if found != prefix:
        raise EmitError(f"{manifest.parent} holds the package `{found}`: choose another directory for `{prefix}`")
    return files
