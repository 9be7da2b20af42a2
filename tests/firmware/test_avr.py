"""The C on an 8-bit AVR under simavr: it builds without a warning and its self-test passes there."""

from __future__ import annotations

import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest

from pbcgen import pipeline
from pbcgen.emit import Extras
from pbcgen.models.loader import load

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [
    pytest.mark.system,
    *(
        pytest.mark.skipif(not shutil.which(tool), reason=f"{tool} is missing (apt: gcc-avr avr-libc simavr)")
        for tool in ("avr-gcc", "simavr")
    ),
]

#: Sends the result of the self-test over the serial line, then sleeps without interrupts, which ends the simulation.
MAIN = """
#include "{p}.h"
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>

static void say(char c)
{{
    while (!(UCSR0A & (1 << UDRE0))) {{}}
    UDR0 = (unsigned char)c;
}}

int main(void)
{{
    const int failed = {p}_selftest();

    UCSR0B = (1 << TXEN0);
    say(failed == 0 ? 'P' : 'F');
    say('\\n');
    while (!(UCSR0A & (1 << TXC0))) {{}}
    cli();
    sleep_enable();
    sleep_cpu();
    return 0;
}}
"""


@pytest.mark.parametrize(
    ("name", "wrong", "letter"), [("coupling_device", False, "P"), ("rlc", False, "P"), ("rlc", True, "F")]
)
def test_the_self_test_decides_on_an_8_bit_processor(name: str, wrong: bool, letter: str, tmp_path: Path) -> None:
    package = pipeline.package(pipeline.check(load(name)), extras=Extras(selftest=True))
    source = package.files[f"{name}.c"]
    (tmp_path / f"{name}.c").write_text(source.replace("0.0485f * t0", "0.0484f * t0") if wrong else source)
    (tmp_path / f"{name}.h").write_text(package.files[f"{name}.h"])
    (tmp_path / "main.c").write_text(MAIN.format(p=name))
    flags = ["-mmcu=atmega328p", "-DF_CPU=16000000UL", "-std=c99", "-Os", "-Wall", "-Wextra", "-Werror"]
    run(["avr-gcc", *flags, "main.c", f"{name}.c", "-lm", "-o", "image.elf"], tmp_path)
    printed = run(["simavr", "-m", "atmega328p", "-f", "16000000", "image.elf"], tmp_path)
    assert f"{letter}." in printed, printed


def run(command: list[str], directory: Path) -> str:
    result = subprocess.run(command, cwd=directory, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, f"{' '.join(command)}\n{result.stdout}{result.stderr}"
    return result.stdout + result.stderr
