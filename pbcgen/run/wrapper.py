"""A generated controller as a Python object: compiled, loaded through cffi, stepped by name or in bulk."""

from __future__ import annotations

import hashlib
import json
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np
from cffi import FFI
from jinja2 import Template
from numpy.typing import ArrayLike, NDArray

from pbcgen.emit.package import MANIFEST
from pbcgen.emit.templating import templates_in
from pbcgen.errors import ModelError, ToolchainError
from pbcgen.law.rounding import DTYPES
from pbcgen.run.toolchain import STRICT_FLAGS, Compiler, find_compiler

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from types import TracebackType

    from pbcgen.emit.package import Package
    from pbcgen.law.arithmetic import Precision

Floats = NDArray[np.floating[Any]]
Integers = NDArray[np.intc]

_DECLARATIONS = """
size_t driver_state_size(void);
int driver_status(size_t index);
void driver_init(void *state);
void driver_get(const void *state, {real} *values);
void driver_set(void *state, const {real} *values);
int driver_step(void *state, const {real} *row, {real} *u);
void driver_run(void *state, const {real} *rows, size_t count, {real} *next, {real} *u, int *status);
void driver_map(const {real} *rows, const {real} *states, size_t count, {real} *next, {real} *u, int *status);
"""


def _declarations(interface: Interface) -> str:
    lines = [_DECLARATIONS.format(real=interface.precision)]
    lines += [f"int driver_set_{g}(void *state, const {interface.precision} *values);" for g, _ in interface.settings]
    if interface.bumpless:
        lines.append(f"int driver_start_at(void *state, const {interface.precision} *row);")
    if interface.selftest:
        lines.append("int driver_selftest(void);")
    return "\n".join(lines)


@dataclass(frozen=True)
class Member:
    """A signal as the user names it, and the C struct member that carries it."""

    name: str
    identifier: str


@dataclass(frozen=True)
class Interface:
    """What a caller must know of a package.

    Attributes:
        prefix: the C prefix ``<p>``.
        precision: the arithmetic; every member has this type.
        inputs, outputs, states: members of the three structs. Members of the state struct that are not listed are
            kept between the steps of one controller but cannot be read or written.
        statuses: the enumerators of ``<p>_status_t``; the first one means success.
        settings: the groups of numbers that can be set (``target``, ``gains``), with their members.
        bumpless, selftest: whether the package has ``<p>_start_at`` and ``<p>_selftest``.
    """

    prefix: str
    precision: Precision
    inputs: tuple[Member, ...]
    outputs: tuple[Member, ...]
    states: tuple[Member, ...]
    statuses: tuple[str, ...]
    settings: tuple[tuple[str, tuple[Member, ...]], ...] = ()
    bumpless: bool = False
    selftest: bool = False

    @staticmethod
    def of_manifest(text: str) -> Interface:
        """The interface that a package's ``manifest.json`` describes. Raises ToolchainError if it does not."""
        try:
            document = json.loads(text)
            inputs, outputs, states = (
                tuple(Member(str(entry["name"]), str(entry["c_name"])) for entry in document[key])
                for key in ("inputs", "outputs", "states")
            )
            statuses = tuple(str(entry["c_name"]) for entry in document["statuses"])
            prefix, precision = str(document["prefix"]), document["precision"]
            settings = tuple(
                (str(group), tuple(Member(str(e["name"]), str(e["c_name"])) for e in document["settings"][group]))
                for group in sorted(document.get("settings", {}))
            )
            more = ("bumpless_start" in document, "selftest" in document)
        except (ValueError, KeyError, TypeError) as error:
            raise ToolchainError(f"`{MANIFEST}` does not describe a package ({error!r}): generate it again") from error
        if precision not in DTYPES:
            raise ToolchainError(f"`{MANIFEST}` names the precision `{precision}`: generate the package again")
        return Interface(prefix, precision, inputs, outputs, states, statuses, settings, *more)

    @property
    def dtype(self) -> np.dtype[np.floating[Any]]:
        """The NumPy type of every signal."""
        return np.dtype(DTYPES[self.precision])


class BuildOptions(TypedDict, total=False):
    """How a controller is built: see :class:`Controller`."""

    directory: Path | None
    compiler: Compiler | None
    flags: Sequence[str]


class Controller:
    """One instance of a compiled controller.

    The library stays loaded until :meth:`close`, or the end of a ``with`` block. The C runs through a driver that
    is compiled against the package's own header, so the layout of the structs is the compiler's business alone.
    """

    def __init__(
        self,
        files: Mapping[str, str],
        interface: Interface,
        *,
        directory: Path | None = None,
        compiler: Compiler | None = None,
        flags: Sequence[str] = STRICT_FLAGS,
    ) -> None:
        """Compile and load.

        Args:
            files: file name to text; ``<p>.c`` and ``<p>.h`` are used.
            interface: names and precision.
            directory: where to build; a temporary directory by default.
            compiler: :func:`find_compiler` by default.
            flags: compiler flags.

        Raises:
            ToolchainError: there is no compiler, or the package does not compile.
        """
        self.interface = interface
        self._temporary = tempfile.TemporaryDirectory(prefix="pbcgen-") if directory is None else None
        build = Path(self._temporary.name) if self._temporary is not None else Path(directory or ".")
        try:
            library = _build(files, interface, build, compiler or find_compiler(), tuple(flags))
            self._ffi = FFI()
            self._ffi.cdef(_declarations(interface))
            self._library: Any = _load(self._ffi, library)
        except BaseException:
            self._clean()
            raise
        self._real = f"{interface.precision}[]"
        words = (int(self._library.driver_state_size()) + 7) // 8
        self._state: Any = self._ffi.new("double[]", max(words, 1))  # double: aligned for every member
        self._statuses = {int(self._library.driver_status(k)): name for k, name in enumerate(interface.statuses)}
        self._status = interface.statuses[0]
        self.reset()

    @classmethod
    def of_package(cls, package: Package, **options: Unpack[BuildOptions]) -> Controller:
        """Compile and load a package that was just rendered. Options and errors are those of the constructor."""
        return cls(package.files, Interface.of_manifest(package.files[MANIFEST]), **options)

    @classmethod
    def of_directory(cls, path: Path, **options: Unpack[BuildOptions]) -> Controller:
        """Compile and load a package that was written to ``path``; nothing is written there.

        Raises ToolchainError if a file is missing, and what the constructor raises.
        """
        try:
            interface = Interface.of_manifest((path / MANIFEST).read_text(encoding="utf-8"))
            names = (f"{interface.prefix}.c", f"{interface.prefix}.h")
            files = {name: (path / name).read_text(encoding="utf-8") for name in names}
        except OSError as error:
            raise ToolchainError(f"`{path}` holds no package: {error.filename}: {error.strerror}") from error
        return cls(files, interface, **options)

    def __enter__(self) -> Controller:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Unload the library and remove the temporary build directory. The controller cannot be used afterwards."""
        if self._library is not None:
            self._ffi.dlclose(self._library)
            self._library = None
        self._clean()

    def reset(self) -> None:
        """Start again: call ``<p>_init``."""
        self._open().driver_init(self._state)
        self._status = self.interface.statuses[0]

    def step(self, **inputs: float) -> dict[str, float]:
        """One sample period.

        Args:
            **inputs: the value of every measured signal, by name.

        Returns:
            The value of every output, by name.

        Raises:
            ModelError: an input is missing or unknown.
        """
        row = _ordered(self.interface.inputs, inputs, "input")
        u = self.advance(np.array(row, dtype=self.interface.dtype))
        return {member.name: float(value) for member, value in zip(self.interface.outputs, u, strict=True)}

    def set_target(self, **values: float) -> str:
        """Another target: call ``<p>_set_target``. Returns the status, which :attr:`status` keeps too.

        Raises ModelError if the target of the package is fixed, or a value is missing or unknown.
        """
        return self._set("target", values)

    def set_gains(self, **values: float) -> str:
        """Other gains: call ``<p>_set_gains``. Returns the status; errors are those of :meth:`set_target`."""
        return self._set("gains", values)

    def start_at(self, **inputs: float) -> str:
        """Start without a jump from these measurements: call ``<p>_start_at``. Returns the status.

        Raises ModelError if the package has no such function, or an input is missing or unknown.
        """
        if not self.interface.bumpless:
            raise ModelError("this package has no start without a jump: generate it with --bumpless")
        row = np.array(_ordered(self.interface.inputs, inputs, "input"), dtype=self.interface.dtype)
        self._status = self.status_name(self._open().driver_start_at(self._state, self._read(row)))
        return self._status

    def selftest(self) -> int:
        """Run ``<p>_selftest``: 0, or the number of the first step that differs. Raises ModelError if there is none."""
        if not self.interface.selftest:
            raise ModelError("this package has no self-test: generate it with --selftest")
        return int(self._open().driver_selftest())

    def _set(self, group: str, values: Mapping[str, float]) -> str:
        members = dict(self.interface.settings).get(group)
        if members is None:
            option = "target_box" if group == "target" else "gain_ranges"
            raise ModelError(f"the {group} of this package cannot be changed: give the design `{option}`")
        with np.errstate(over="ignore"):
            row = np.array(_ordered(members, values, "setting"), dtype=self.interface.dtype)
        set_group = getattr(self._open(), f"driver_set_{group}")
        self._status = self.status_name(set_group(self._state, self._read(row)))
        return self._status

    @property
    def status(self) -> str:
        """The status of the last step or setting: the C enumerator."""
        return self._status

    @property
    def state(self) -> dict[str, float]:
        """The controller state by name. Assign a complete mapping to change it."""
        return {m.name: float(v) for m, v in zip(self.interface.states, self.xi, strict=True)}

    @state.setter
    def state(self, values: Mapping[str, float]) -> None:
        row = _ordered(self.interface.states, values, "state")
        self._open().driver_set(self._state, self._read(np.array(row, dtype=self.interface.dtype)))

    @property
    def xi(self) -> Floats:
        """The controller state as an array, in the order of the interface."""
        values = np.zeros(len(self.interface.states), dtype=self.interface.dtype)
        self._open().driver_get(self._state, self._write(values))
        return values

    def advance(self, measurement: ArrayLike) -> Floats:
        """One sample period with the measurement as an array (nm,); returns u (m,)."""
        row = _table(measurement, (len(self.interface.inputs),), self.interface.dtype, "the measurement")
        u = np.zeros(len(self.interface.outputs), dtype=self.interface.dtype)
        code = self._open().driver_step(self._state, self._read(row), self._write(u))
        self._status = self.status_name(code)
        return u

    def run(self, measurements: ArrayLike) -> Floats:
        """Steps of this controller over measurements (N, nm), from its present state; returns u (N, m)."""
        return self.trace(measurements)[1]

    def trace(self, measurements: ArrayLike) -> tuple[Floats, Floats, Integers]:
        """Like :meth:`run`; returns the states after each step (N, nxi), u (N, m) and the status codes (N,)."""
        rows = _table(measurements, (-1, len(self.interface.inputs)), self.interface.dtype, "the measurements")
        xi, u, status = self._results(len(rows))
        self._open().driver_run(
            self._state, self._read(rows), len(rows), self._write(xi), self._write(u), self._codes(status)
        )
        if len(rows):
            self._status = self.status_name(int(status[-1]))
        return xi, u, status

    def step_many(self, measurements: ArrayLike, states: ArrayLike) -> tuple[Floats, Floats, Integers]:
        """One step of N independent, freshly initialised controllers.

        Args:
            measurements: (N, nm).
            states: (N, nxi), the states before the step.

        Returns:
            The states after the step (N, nxi), u (N, m) and the status codes (N,). This controller is unchanged.
        """
        rows = _table(measurements, (-1, len(self.interface.inputs)), self.interface.dtype, "the measurements")
        before = _table(states, (len(rows), len(self.interface.states)), self.interface.dtype, "the states")
        xi, u, status = self._results(len(rows))
        self._open().driver_map(
            self._read(rows), self._read(before), len(rows), self._write(xi), self._write(u), self._codes(status)
        )
        return xi, u, status

    def status_name(self, code: int) -> str:
        """The enumerator with this value. Raises ToolchainError for a value that the interface does not list."""
        if code not in self._statuses:
            raise ToolchainError(f"`{self.interface.prefix}_step` returned {code}, which is none of its statuses")
        return self._statuses[code]

    def _open(self) -> Any:
        if self._library is None:
            raise ToolchainError(f"the controller `{self.interface.prefix}` is closed")
        return self._library

    def _results(self, count: int) -> tuple[Floats, Floats, Integers]:
        xi = np.zeros((count, len(self.interface.states)), dtype=self.interface.dtype)
        u = np.zeros((count, len(self.interface.outputs)), dtype=self.interface.dtype)
        return xi, u, np.zeros(count, dtype=np.intc)

    def _read(self, array: Floats) -> Any:
        return self._ffi.from_buffer(self._real, array)

    def _write(self, array: Floats) -> Any:
        return self._ffi.from_buffer(self._real, array, require_writable=True)

    def _codes(self, array: Integers) -> Any:
        return self._ffi.from_buffer("int[]", array, require_writable=True)

    def _clean(self) -> None:
        if self._temporary is not None:
            self._temporary.cleanup()
            self._temporary = None


def _build(
    files: Mapping[str, str], interface: Interface, directory: Path, compiler: Compiler, flags: tuple[str, ...]
) -> Path:
    """Compile package and driver. The library's name carries a hash, so that changed code is never mistaken for old."""
    source, header = f"{interface.prefix}.c", f"{interface.prefix}.h"
    missing = [name for name in (source, header) if name not in files]
    if missing:
        raise ToolchainError(f"the package `{interface.prefix}` has no file `{missing[0]}`")
    driver = f"{interface.prefix}_driver.c"
    texts = {source: files[source], header: files[header], driver: _driver(interface)}
    directory.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (directory / name).write_text(text, encoding="utf-8")
    digest = hashlib.sha256(repr((texts, compiler, flags)).encode()).hexdigest()[:12]
    sources = [directory / source, directory / driver]
    return compiler.compile_shared(sources, directory, flags, f"{interface.prefix}-{digest}")


def _driver(interface: Interface) -> str:
    return _template().render(
        prefix=interface.prefix,
        scalar=interface.precision,
        inputs=interface.inputs,
        outputs=interface.outputs,
        states=interface.states,
        statuses=interface.statuses,
        settings=interface.settings,
        bumpless=interface.bumpless,
        selftest=interface.selftest,
    )


@cache
def _template() -> Template:
    return templates_in(Path(__file__).parent).get_template("driver.c.j2")


def _load(ffi: FFI, library: Path) -> Any:
    try:
        return ffi.dlopen(str(library.resolve()))
    except OSError as error:
        raise ToolchainError(f"`{library.name}` was compiled but cannot be loaded: {error}") from error


def _ordered(members: Sequence[Member], values: Mapping[str, float], kind: str) -> list[float]:
    """The values in the order of the members. Raises ModelError unless the names are exactly those."""
    names = [member.name for member in members]
    known = ", ".join(f"`{name}`" for name in names) or "none"
    unknown = sorted(set(values) - set(names))
    if unknown:
        raise ModelError(f"there is no {kind} `{unknown[0]}`: the {kind}s are {known}")
    missing = [name for name in names if name not in values]
    if missing:
        raise ModelError(f"the {kind} `{missing[0]}` is missing: the {kind}s are {known}")
    return [float(values[name]) for name in names]


def _table(values: ArrayLike, shape: tuple[int, ...], dtype: np.dtype[np.floating[Any]], name: str) -> Floats:
    """``values`` as a contiguous array. Raises ModelError unless it has ``shape`` (-1 is any length)."""
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(values, dtype=dtype)
    if array.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True)):
        wanted = " x ".join("N" if size == -1 else str(size) for size in shape)
        raise ModelError(f"{name} must have the shape {wanted}, got {' x '.join(map(str, array.shape)) or 'a number'}")
    return array
