"""The C as a bare-metal image under QEMU: start-up code, linker script and the GNU tool chain, no operating system."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from pbcgen import pipeline
from pbcgen.models.loader import load
from pbcgen.run.emulate import FLAGS, Emulated, missing_tools
from pbcgen.run.targets import TARGETS
from pbcgen.run.wrapper import Controller

HERE = Path(__file__).parent
BOARDS = [name for name, target in TARGETS.items() if target.machine]

#: With `-icount shift=10` an instruction takes 1024 ns; SysTick runs at 25 MHz or 16 MHz.
TICKS = {"mps2-an386": 25.6, "microbit": 16.384}

pytestmark = [
    pytest.mark.system,
    *(
        pytest.mark.skipif(not shutil.which(tool), reason=f"{tool} is missing: `make firmware` says what to install")
        for tool in ("arm-none-eabi-gcc", "qemu-system-arm")
    ),
]


@pytest.fixture(scope="module", params=["coupling_device", "rlc"])
def package(request):
    report = pipeline.check(load(request.param))
    return pipeline.package(report, allow=tuple(claim.claim for claim in report.blocking()))


def trajectory(inputs: int) -> np.ndarray:
    rng = np.random.default_rng(6)
    m = 10 ** rng.uniform(-4, 0.7, (60, inputs)) * rng.choice([-1, 1], (60, inputs))
    m[::13] = rng.choice([np.nan, np.inf, 3e38, 0], m[::13].shape)
    return m.astype(np.float32)


def build(package, target, m: np.ndarray, directory: Path) -> Path:
    """The image of the test program."""
    environment = Environment(
        loader=FileSystemLoader(HERE), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    prefix = package.prefix
    (directory / "main.c").write_text(
        environment.get_template("main.c.j2").render(
            prefix=prefix,
            upper=prefix.upper(),
            inputs=m.shape[1],
            outputs=1,
            rows=[[f"0x{bits:08x}u" for bits in row] for row in m.view(np.uint32)],
        )
    )
    for name in (f"{prefix}.c", f"{prefix}.h"):
        (directory / name).write_text(package.files[name])
    image = directory / "firmware.elf"
    warnings = ["-Wall", "-Wextra", "-Wconversion", "-Werror"]
    sources = [str(directory / "main.c"), str(directory / f"{prefix}.c"), str(HERE / "startup.c")]
    linking = ["-nostartfiles", "-T", str(HERE / "link.ld"), "--specs=nosys.specs", "-Wl,--gc-sections", "-lm"]
    include = [f"-I{HERE}", f"-I{directory}"]
    run([*target.gcc, *FLAGS, *warnings, *include, *sources, *linking, "-o", str(image)])
    return image


def run(command: list[str]) -> str:
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, f"{' '.join(command)}\n{result.stdout}{result.stderr}"
    return result.stdout + result.stderr


@pytest.mark.parametrize("name", BOARDS)
def test_the_image_computes_the_bits_of_the_host_and_counts_like_the_emulator(package, name, tmp_path):
    target = TARGETS[name]
    with Controller.of_package(package) as controller:
        m = trajectory(len(controller.interface.inputs))
        _, u, status = controller.trace(m)
    image = build(package, target, m, tmp_path)
    machine = ["-M", target.machine, "-nographic", "-monitor", "none", "-serial", "none", "-icount", "shift=10"]
    printed = run(
        ["qemu-system-arm", *machine, "-semihosting-config", "enable=on,target=native", "-kernel", str(image)]
    )
    lines = [line.split() for line in printed.splitlines()]
    found = np.array([[int(word, 16) for word in line] for line in lines if len(line) == 3], np.uint32)
    assert len(found) == len(m), printed
    np.testing.assert_array_equal(found[:, 0], u[:, 0].view(np.uint32))
    np.testing.assert_array_equal(found[:, 1], status)
    counts = found[:, 2] / TICKS[target.machine] + 3  # what the empty function takes: call, value, return
    assert np.max(np.abs(counts - np.round(counts))) < 0.1
    print(f"\n{package.prefix} on {name}: mean {np.mean(counts):.1f}, worst {np.max(counts):.0f} instructions")
    if not missing_tools():
        emulated = Emulated(package.files, target, compiler="gcc").run(m)
        np.testing.assert_array_equal(emulated[0], u)
        # QEMU also counts the instructions of an IT block whose condition is false
        skipped = np.round(counts) - emulated[2]
        assert np.min(skipped) >= -1
        assert np.max(skipped) <= 5
