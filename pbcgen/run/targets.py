"""Processors that the generated C is compiled for and run on in an emulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from pbcgen.errors import ToolchainError


@dataclass(frozen=True)
class Target:
    """One processor.

    Attributes:
        name: how a user asks for it.
        description: in words.
        architecture: the emulator's instruction set.
        cpu: the emulator's processor model.
        zig: flags of ``zig cc``; its run-time library provides what the processor lacks.
        gcc: the GNU compiler's name and flags, for the bare-metal image; empty if there is none.
        machine: the board that QEMU emulates for that image.
    """

    name: str
    description: str
    architecture: Literal["thumb", "riscv32"]
    cpu: str
    zig: tuple[str, ...]
    gcc: tuple[str, ...] = ()
    machine: str = ""


_TARGETS: Final = (
    Target(
        name="cortex-m4f",
        description="Arm Cortex-M4 with single-precision floating point",
        architecture="thumb",
        cpu="UC_CPU_ARM_CORTEX_M4",
        zig=("-target", "thumb-linux-musleabihf", "-mcpu=cortex_m4+vfp4d16sp", "-static"),
        gcc=("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
        machine="mps2-an386",
    ),
    Target(
        name="cortex-m0",
        description="Arm Cortex-M0, floating point in software",
        architecture="thumb",
        cpu="UC_CPU_ARM_CORTEX_M0",
        zig=("-target", "thumb-freestanding-eabi", "-mcpu=cortex_m0", "-ffreestanding", "-nostdlib", "-lcompiler_rt"),
        gcc=("arm-none-eabi-gcc", "-mcpu=cortex-m0", "-mthumb", "-mfloat-abi=soft"),
        machine="microbit",
    ),
    Target(
        name="rv32imafc",
        description="RISC-V RV32IMAFC with single-precision floating point",
        architecture="riscv32",
        cpu="UC_CPU_RISCV32_ANY",
        zig=(
            *("-target", "riscv32-freestanding", "-mcpu=generic_rv32+m+a+f+c"),
            *("-ffreestanding", "-nostdlib", "-lcompiler_rt"),
        ),
    ),
)

TARGETS: Final = {target.name: target for target in _TARGETS}


def target(name: str) -> Target:
    """The target of this name. Raises ToolchainError if there is none."""
    if name not in TARGETS:
        raise ToolchainError(f"there is no target `{name}`: the targets are {', '.join(sorted(TARGETS))}")
    return TARGETS[name]
