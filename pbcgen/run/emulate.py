"""The generated C on an emulated processor: exact instruction counts, sizes, stack, and its results.

The package is compiled with ``zig cc`` and run in unicorn; both come from PyPI (the extras ``zig`` and ``emulate``). A
GNU compiler for the target can take the place of zig.
Every executed instruction counts one, the call and its return included; a conditional instruction whose condition is
false does not count.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import struct
import sys
import tempfile
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pbcgen.emit.package import MANIFEST
from pbcgen.emit.step_cost import StepCost
from pbcgen.errors import ToolchainError
from pbcgen.run.simulate import simulate_sampled
from pbcgen.run.toolchain import run_tool
from pbcgen.run.wrapper import Interface

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pbcgen.law.closed_loop import ClosedLoop
    from pbcgen.law.law import ControlLaw
    from pbcgen.run.targets import Target

Floats = NDArray[np.floating[Any]]
CompilerName = Literal["zig", "gcc"]

#: The optimisation that costs are stated for. Contraction is off: results equal the host's to the last bit.
FLAGS: Final = ("-std=c99", "-O2", "-ffp-contract=off")

_STACK_TOP: Final = 0x7010_0000
_STACK_SIZE: Final = 0x10_0000
_ARGUMENTS: Final = 0x6000_0000
_RETURN: Final = 0x1F00_0000  # in the part of the memory map that may hold code
_PAINT: Final = 0xA5
_PAGE: Final = 0x1000


def missing_tools() -> str:
    """What must be installed before anything can be emulated; empty if nothing."""
    needed = {"ziglang": "zig", "unicorn": "emulate", "elftools": "emulate"}
    extras = sorted({extra for module, extra in needed.items() if importlib.util.find_spec(module) is None})
    return f"pip install 'pbcgen[{','.join(extras)}]'" if extras else ""


class Emulated:
    """One controller on an emulated processor."""

    def __init__(
        self,
        files: Mapping[str, str],
        target: Target,
        flags: Sequence[str] = FLAGS,
        compiler: CompilerName = "zig",
    ) -> None:
        """Compile the package and load it.

        Raises ToolchainError if a tool is missing, or the package does not compile or link for the target.
        """
        if instruction := missing_tools():
            raise ToolchainError(f"emulation needs more packages: {instruction}")
        self.interface = Interface.of_manifest(files[MANIFEST])
        self.target = target
        self.flags = tuple(flags)
        self.compiler = compiler
        self._image = Image.build(files, self.interface, target, self.flags, compiler)
        self._machine = Machine(self._image, target)
        size = self.interface.dtype.itemsize
        self._size = size
        self.state_bytes = self._image.state_bytes
        self._state = _ARGUMENTS
        self._input = _ARGUMENTS + 0x400
        self._output = _ARGUMENTS + 0x800
        #: Instructions of every step of :meth:`advance`.
        self.counts: list[int] = []
        self.reset()

    def reset(self) -> None:
        """Call ``<p>_init``."""
        self._machine.call(self._image.address(f"{self.interface.prefix}_init"), (self._state,))

    def step(self, measurement: Floats) -> tuple[Floats, int, int]:
        """One step: (u, status, instructions)."""
        dtype = self.interface.dtype
        self._machine.write(self._input, np.asarray(measurement, dtype).tobytes())
        entry = self._image.address(f"{self.interface.prefix}_step")
        status, count = self._machine.call(entry, (self._state, self._input, self._output))
        raw = self._machine.read(self._output, self._size * len(self.interface.outputs))
        return np.frombuffer(raw, dtype).copy(), status, count

    def set(self, group: str, values: ArrayLike) -> tuple[int, int]:
        """Call ``<p>_set_<group>``: (status, instructions). Raises ToolchainError if the package has none."""
        self._machine.write(self._input, np.asarray(values, self.interface.dtype).tobytes())
        return self._machine.call(
            self._image.address(f"{self.interface.prefix}_set_{group}"), (self._state, self._input)
        )

    @property
    def state(self) -> bytes:
        """The state struct."""
        return self._machine.read(self._state, self.state_bytes)

    @state.setter
    def state(self, value: bytes) -> None:
        self._machine.write(self._state, value)

    def advance(self, measurement: ArrayLike) -> Floats:
        """One step: u. The instructions that it took are added to ``counts``."""
        u, _, count = self.step(np.asarray(measurement))
        self.counts.append(count)
        return u

    @property
    def xi(self) -> Floats:
        """The controller's states and, behind them, held outputs."""
        return np.frombuffer(self.state, self.interface.dtype).copy()

    def run(self, measurements: Floats) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
        """Steps over measurements (N, nm) from the present state: u (N, m), status (N,), instructions (N,)."""
        rows = [self.step(row) for row in np.atleast_2d(measurements)]
        u = np.array([row[0] for row in rows])
        return u, np.array([row[1] for row in rows]), np.array([row[2] for row in rows])

    def stack_used(self) -> int:
        """Bytes of stack that the calls so far have used at the most."""
        return self._machine.stack_used()

    def cost(self) -> StepCost:
        """What the steps of :meth:`advance` cost. Raises ToolchainError if there were none."""
        if not self.counts:
            raise ToolchainError("no step was run on the target: there is nothing to measure")
        return StepCost(
            target=self.target.name,
            description=self.target.description,
            compiler=f"{_compiler_version(self.target, self.compiler)} {' '.join(self.flags)}",
            steps=len(self.counts),
            mean=float(np.mean(self.counts)),
            worst=max(self.counts),
            text=self._image.text,
            stack=self.stack_used(),
            state=self.state_bytes,
            static=self._image.static,
        )


def measure(
    law: ControlLaw,
    files: Mapping[str, str],
    loop: ClosedLoop,
    target: Target,
    *,
    flags: Sequence[str] = FLAGS,
    compiler: CompilerName = "zig",
    steps: int = 600,
    seed: int = 0,
) -> StepCost:
    """The cost of a step over reachable inputs: the closed loop from its initial state, then random points around it.

    Args:
        law: the law that the package was rendered from.
        files: the package.
        loop: the plant.
        target: where to run.
        flags: of the compiler.
        compiler: clang from the package ``ziglang``, or the target's GNU compiler.
        steps: number of steps of the closed loop, and of random points.
        seed: of the random points.

    Raises:
        ToolchainError: a tool is missing, or the package does not build.
        SimulationError: the closed loop cannot be simulated.
    """
    with np.errstate(all="ignore"):
        controller = Emulated(files, target, flags, compiler)
        duration = float(min(Fraction(loop.duration), steps * law.sample_period))
        run = simulate_sampled(loop, controller, law.sample_period, duration)
        measured = np.array(loop.measure.map(len(run.times))(run.x.T)).reshape(len(law.inputs), -1).T
        middle = np.array(loop.measure(loop.x_star), dtype=float).ravel()
        span = np.abs(measured - middle).max(axis=0)
        for scale in np.random.default_rng(seed).uniform(-1, 1, (steps, len(middle))):
            controller.advance(middle + span * scale)
    return controller.cost()


@dataclass(frozen=True)
class Image:
    """A linked program and the package's own object file."""

    segments: tuple[tuple[int, bytes, int], ...]
    symbols: Mapping[str, int]
    text: int
    static: int
    state_bytes: int

    @staticmethod
    def build(
        files: Mapping[str, str], interface: Interface, target: Target, flags: Sequence[str], compiler: CompilerName
    ) -> Image:
        """Compile and link a package. Raises ToolchainError if that fails."""
        prefix = interface.prefix
        with tempfile.TemporaryDirectory(prefix="pbcgen-") as name:
            directory = Path(name)
            for file in (f"{prefix}.c", f"{prefix}.h"):
                (directory / file).write_text(files[file], encoding="utf-8")
            (directory / "main.c").write_text(_main(interface), encoding="utf-8")
            (directory / "include").mkdir()
            (directory / "include" / "math.h").write_text(_math_header(files[f"{prefix}.c"]), encoding="utf-8")
            compiling, linking = _commands(target, compiler, directory)
            own, linked = directory / "own.o", directory / "image"
            _run([*compiling, *flags, "-c", str(directory / f"{prefix}.c"), "-o", str(own)], target)
            _run([*linking[:-1], *flags, str(directory / "main.c"), str(own), linking[-1], "-o", str(linked)], target)
            return Image.read(own, linked)

    @staticmethod
    def read(own: Path, linked: Path) -> Image:
        """The linked program, with the sizes of the package's own object file."""
        from elftools.elf.elffile import ELFFile

        with linked.open("rb") as stream:
            elf = ELFFile(stream)
            segments = tuple(
                (s["p_vaddr"], s.data(), s["p_memsz"]) for s in elf.iter_segments() if s["p_type"] == "PT_LOAD"
            )
            table = [entry for entry in elf.get_section_by_name(".symtab").iter_symbols() if entry.name]
            symbols = {entry.name: entry["st_value"] for entry in table}
            state = next(entry["st_size"] for entry in table if entry.name == "the_state")
        with own.open("rb") as stream:
            sizes = _sections(ELFFile(stream))
        return Image(segments, symbols, sizes["text"], sizes["static"], state)

    def address(self, symbol: str) -> int:
        """Raises ToolchainError if the symbol is not in the image."""
        if symbol not in self.symbols:
            raise ToolchainError(f"`{symbol}` is not in the linked image")
        return self.symbols[symbol]


def _sections(elf: Any) -> dict[str, int]:
    """Bytes of code with constants, and of writable data, in an object file."""
    sizes = {"text": 0, "static": 0}
    for section in elf.iter_sections():
        flags = section["sh_flags"]
        if not flags & 2 or section.name.startswith((".ARM.", ".eh_frame")):  # not in memory, or for unwinding only
            continue
        sizes["static" if flags & 1 else "text"] += section["sh_size"]
    return sizes


def _main(interface: Interface) -> str:
    """A program that links every function of the package."""
    prefix = interface.prefix
    more = [
        f"    static {prefix}_{group}_t the_{group};\n    {prefix}_set_{group}(&the_state, &the_{group});\n"
        for group, _ in interface.settings
    ]
    return (
        f'#include "{prefix}.h"\n'
        f"{prefix}_state_t the_state;\n"
        f"static {prefix}_input_t the_input;\n"
        f"static {prefix}_output_t the_output;\n"
        "int main(void)\n{\n"
        f"    {prefix}_init(&the_state);\n{''.join(more)}"
        f"    return (int){prefix}_step(&the_state, &the_input, &the_output);\n}}\n"
    )


def _math_header(source: str) -> str:
    """Declarations of the functions of math.h that a source calls, for targets without a C library."""
    lines = ["#define HUGE_VAL __builtin_huge_val()", "#define HUGE_VALF __builtin_huge_valf()"]
    for name in sorted(set(re.findall(r"\b([a-z0-9]+)\(", source)) & _MATH):
        real = "float" if name.endswith("f") and name not in ("erf",) else "double"
        arguments = ", ".join([real] * (2 if name.rstrip("f") in _BINARY or name in _BINARY else 1))
        lines.append(f"{real} {name}({arguments});")
    return "\n".join(lines) + "\n"


_BINARY: Final = frozenset({"atan2", "pow", "hypot", "fmod", "fmin", "fmax", "remainder", "copysign"})
_UNARY: Final = frozenset(
    {
        *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
        *("exp", "expm1", "log", "log1p", "sqrt", "fabs", "floor", "ceil", "erf", "erfc"),
    }
)
_MATH: Final = frozenset(name + suffix for name in _BINARY | _UNARY for suffix in ("", "f"))


def _commands(target: Target, compiler: CompilerName, directory: Path) -> tuple[list[str], list[str]]:
    """How to compile, and how to link; the last word of the latter is the library."""
    if compiler == "gcc":
        if not target.gcc or shutil.which(target.gcc[0]) is None:
            raise ToolchainError(f"there is no GNU compiler for {target.name}: install gcc-arm-none-eabi")
        return [*target.gcc], [*target.gcc, "-nostartfiles", "-Wl,-e,main", "--specs=nosys.specs", "-lm"]
    zig = [sys.executable, "-m", "ziglang", "cc", *target.zig]
    if "-ffreestanding" not in target.zig:
        return [flag for flag in zig if flag != "-static"], [*zig, "-lm"]
    zig.append(f"-I{directory / 'include'}")
    runtime = "-lcompiler_rt"
    return [flag for flag in zig if flag != runtime], [
        *(flag for flag in zig if flag != runtime),
        "-Wl,-e,main",
        runtime,
    ]


def _run(command: list[str], target: Target) -> None:
    result = run_tool(command)
    if result.returncode != 0:
        lines = "\n".join(result.stderr.strip().splitlines()[:8])
        raise ToolchainError(f"the package does not build for {target.name}:\n{lines}")


def _compiler_version(target: Target, compiler: CompilerName) -> str:
    """The compiler and its version; for zig, that of the clang inside."""
    command = [target.gcc[0]] if compiler == "gcc" else [sys.executable, "-m", "ziglang", "cc"]
    lines = run_tool([*command, "--version"]).stdout.splitlines() or [compiler]
    version = re.search(r"\d+\.\d+\.\d+", lines[0])
    return f"{'gcc' if compiler == 'gcc' else 'clang'} {version.group() if version else ''}".strip()


class Machine:
    """The processor with the image loaded, a painted stack, and an instruction counter."""

    def __init__(self, image: Image, target: Target) -> None:
        import unicorn
        from unicorn import arm_const, riscv_const

        self._unicorn = unicorn
        if target.architecture == "thumb":
            mode = unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS
            self._uc = unicorn.Uc(unicorn.UC_ARCH_ARM, mode)
            self._uc.ctl_set_cpu_model(getattr(arm_const, target.cpu))
            arguments = [arm_const.UC_ARM_REG_R0, arm_const.UC_ARM_REG_R1, arm_const.UC_ARM_REG_R2]
            self._sp, self._link = arm_const.UC_ARM_REG_SP, arm_const.UC_ARM_REG_LR
        else:
            self._uc = unicorn.Uc(unicorn.UC_ARCH_RISCV, unicorn.UC_MODE_RISCV32)
            arguments = [riscv_const.UC_RISCV_REG_A0, riscv_const.UC_RISCV_REG_A1, riscv_const.UC_RISCV_REG_A2]
            self._sp, self._link = riscv_const.UC_RISCV_REG_SP, riscv_const.UC_RISCV_REG_RA
        self._arguments = arguments
        self._thumb = target.architecture == "thumb"
        self._load(image)
        if self._thumb and target.cpu != "UC_CPU_ARM_CORTEX_M0":
            self._uc.mem_map(0xE000_E000, _PAGE)
            self._uc.mem_write(0xE000_ED88, struct.pack("<I", 0xF << 20))  # CPACR: enable the floating-point unit
        elif not self._thumb:
            status = self._uc.reg_read(riscv_const.UC_RISCV_REG_MSTATUS)
            self._uc.reg_write(riscv_const.UC_RISCV_REG_MSTATUS, status | 0x2000)  # FS: initial
        self._count = 0
        self._uc.hook_add(unicorn.UC_HOOK_CODE, self._counted)

    def _load(self, image: Image) -> None:
        pages: set[int] = set()
        for address, _, size in image.segments:
            pages |= set(range(address // _PAGE, (address + size - 1) // _PAGE + 1))
        for page in sorted(pages):
            self._uc.mem_map(page * _PAGE, _PAGE)
        for address, data, _ in image.segments:
            self._uc.mem_write(address, data)
        self._uc.mem_map(_ARGUMENTS, _PAGE)
        self._uc.mem_map(_RETURN, _PAGE)
        self._uc.mem_map(_STACK_TOP - _STACK_SIZE, _STACK_SIZE)
        self._uc.mem_write(_STACK_TOP - _STACK_SIZE, bytes([_PAINT]) * _STACK_SIZE)

    def _counted(self, *_: Any) -> None:
        self._count += 1

    def call(self, address: int, arguments: Sequence[int]) -> tuple[int, int]:
        """Call a function: (the integer it returns, instructions with the call)."""
        for register, value in zip(self._arguments, arguments, strict=False):
            self._uc.reg_write(register, value)
        self._uc.reg_write(self._sp, _STACK_TOP)
        self._uc.reg_write(self._link, _RETURN | 1 if self._thumb else _RETURN)
        self._count = 1
        self._uc.emu_start(address | 1 if self._thumb else address, _RETURN)
        return int(self._uc.reg_read(self._arguments[0])), self._count

    def read(self, address: int, size: int) -> bytes:
        """Bytes of memory."""
        return bytes(self._uc.mem_read(address, size))

    def write(self, address: int, data: bytes) -> None:
        """Change bytes of memory."""
        self._uc.mem_write(address, data)

    def stack_used(self) -> int:
        """Bytes of stack that the deepest call has overwritten."""
        memory = self.read(_STACK_TOP - _STACK_SIZE, _STACK_SIZE)
        untouched = len(memory) - len(memory.lstrip(bytes([_PAINT])))
        return _STACK_SIZE - untouched
