"""Static and dynamic analysers on the emitted C: cppcheck with MISRA, the sanitizers, valgrind, gcc's stack usage."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import hand_made_laws as laws
import pytest
from compiled import run

from pbcgen.emit import render
from pbcgen.emit.wording import DEVIATIONS
from pbcgen.law.law import Fallback
from pbcgen.law.solves import with_tanh

pytestmark = pytest.mark.system

MAKERS = {
    "two_channels": lambda: laws.two_channels("float", Fallback.LAST_OUTPUT),
    "fast": lambda: with_tanh(laws.two_channels("double"), "fast"),
    "constant_channels": laws.constant_channels,
    "block": lambda: laws.block("float"),
    "stateless": laws.stateless,
    "adjustable": laws.adjustable,
    "steered": laws.steered,
}

DRIVER = """
#include "{p}.h"
#include <string.h>

int main(void)
{{
    {p}_state_t state;
    unsigned seed = 1u;
    int worst = 0;

    {p}_init(&state);
    for (int k = 0; k < 20000; ++k)
    {{
        {p}_input_t input;
        {p}_output_t output;
        unsigned char bytes[sizeof input];

        for (unsigned i = 0; i < sizeof bytes; ++i)
        {{
            seed = seed * 1664525u + 1013904223u;
            bytes[i] = (unsigned char)(seed >> 24);
        }}
        memcpy(&input, bytes, sizeof input);
        if (k % 3 == 0)
        {{
            memset(&input, 0, sizeof input);
        }}
        if (k % 1000 == 999)
        {{
            memcpy(&state, bytes, sizeof bytes < sizeof state ? sizeof bytes : sizeof state);
        }}
        worst |= (int){p}_step(&state, &input, &output);
    }}
    return worst > 7;
}}
"""


@pytest.fixture(scope="module", params=MAKERS)
def package(request, tmp_path_factory):
    """(prefix, directory) of a written package with a driver that steps it with random bits."""
    made = render(MAKERS[request.param](), laws.PROVENANCE, extras=laws.EXTRAS)
    directory = tmp_path_factory.mktemp(request.param)
    made.write(directory)
    (directory / "driver.c").write_text(DRIVER.format(p=made.prefix))
    return made.prefix, directory


def needs(*tools: str) -> pytest.MarkDecorator:
    missing = [tool for tool in tools if not shutil.which(tool)]
    return pytest.mark.skipif(bool(missing), reason=f"{', '.join(missing)} is missing")


@needs("cppcheck")
def test_cppcheck_and_misra_find_the_listed_deviations_only(package):
    prefix, directory = package
    options = ["--addon=misra", "--std=c99", "--enable=all", "--suppress=missingIncludeSystem", "--quiet"]
    result = subprocess.run(
        ["cppcheck", *options, f"{prefix}.c"], cwd=directory, capture_output=True, text=True, check=False
    )
    found = set(re.findall(r"\[([\w.-]+)\]$", result.stderr, re.MULTILINE))
    # the interface is for others to call, and the same for a law without memory
    allowed = {f"misra-c2012-{rule}" for rule in DEVIATIONS} | {"unusedFunction", "constParameter"}
    assert found <= allowed, result.stderr


@needs("cc")
def test_the_sanitizers_find_nothing_for_random_bits(package):
    prefix, directory = package
    flags = ["-std=c99", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    run(["cc", *flags, "driver.c", f"{prefix}.c", "-lm", "-o", "sanitized"], cwd=directory)
    run(["./sanitized"], cwd=directory)


@needs("cc", "valgrind")
def test_valgrind_finds_nothing(package):
    prefix, directory = package
    run(["cc", "-std=c99", "-O2", "-g", "driver.c", f"{prefix}.c", "-lm", "-o", "plain"], cwd=directory)
    run(["valgrind", "--quiet", "--error-exitcode=9", "--leak-check=full", "./plain"], cwd=directory)


@needs("gcc")
def test_no_function_needs_a_stack_that_grows(package):
    prefix, directory = package
    run(["gcc", "-std=c99", "-O2", "-fstack-usage", "-c", f"{prefix}.c", "-o", "su.o"], cwd=directory)
    usage = [line.split("\t") for line in Path(directory, "su.su").read_text().splitlines()]
    assert usage
    assert all(kind == "static" for _, _, kind in usage)
    assert sum(int(size) for _, size, _ in usage) <= (800 if "block" in prefix else 400)


@needs("gcc")
@pytest.mark.parametrize("language", ["-std=c99 -O2", "-std=c17 -O3"])
def test_a_32_bit_build_has_no_warning(package, language):
    prefix, directory = package
    probe = ["gcc", "-m32", "-xc", "-c", "-", "-o", "probe.o"]
    if subprocess.run(
        probe, input="#include <math.h>\n", text=True, capture_output=True, cwd=directory, check=False
    ).returncode:
        pytest.skip("gcc has no 32-bit headers (apt: gcc-multilib)")
    warnings = ["-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror"]
    run(["gcc", "-m32", *language.split(), *warnings, "-c", f"{prefix}.c", "-o", "m32.o"], cwd=directory)
