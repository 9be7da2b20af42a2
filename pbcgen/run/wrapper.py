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
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from numpy.typing import ArrayLike, NDArray

from pbcgen.control.rounding import DTYPES
from pbcgen.emit.package import MANIFEST
from pbcgen.errors import ModelError, ToolchainError
from pbcgen.run.toolchain import STRICT_FLAGS, Compiler, find_compiler

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from types import TracebackType

    from pbcgen.control.law import Precision
    from pbcgen.emit.package import Package

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
    """

    prefix: str
    precision: Precision
    inputs: tuple[Member, ...]
    outputs: tuple[Member, ...]
    states: tuple[Member, ...]
    statuses: tuple[str, ...]

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
        except (ValueError, KeyError, TypeError) as error:
            raise ToolchainError(f"`{MANIFEST}` does not describe a package ({error!r}): generate it again") from error
        if precision not in DTYPES:
            raise ToolchainError(f"`{MANIFEST}` names the precision `{precision}`: generate the package again")
        return Interface(prefix, precision, inputs, outputs, states, statuses)

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
            self._ffi.cdef(_DECLARATIONS.format(real=interface.precision))
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

    @property
    def status(self) -> str:
        """The status of the last step: the C enumerator."""
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
    )


@cache
def _template() -> Template:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    return environment.get_template("driver.c.j2")


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
