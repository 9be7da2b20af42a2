"""The C on its own: warnings, languages, optimisation levels, symbols, build systems."""

from __future__ import annotations

import re
import shutil
import subprocess
from typing import TYPE_CHECKING

import hand_made_laws as laws
import pytest
from compiled import WARNINGS, ZIG, compiler, run

from pbcgen.emit import render

pytestmark = pytest.mark.system

if TYPE_CHECKING:
    from pathlib import Path

LAWS = (laws.two_channels, laws.block, laws.mixed, laws.stateless, laws.adjustable, laws.steered)


@pytest.fixture(scope="module", params=["float", "double"])
def packages(request, tmp_path_factory) -> list[Path]:
    """Directories with one package each."""
    directories = []
    for make in LAWS:
        package = render(make(request.param), laws.PROVENANCE, extras=laws.EXTRAS)
        directory = tmp_path_factory.mktemp(package.prefix)
        package.write(directory)
        directories.append(directory)
    return directories


def sources(packages: list[Path]) -> list[str]:
    return [str(path) for directory in packages for path in sorted(directory.glob("*.c"))]


@pytest.mark.parametrize("language", ["-std=c99 -O0", "-std=c99 -O3", "-std=c11 -O1", "-std=c17 -O2", "-std=c2x -Os"])
def test_c_compiles_without_a_warning(packages, language, tmp_path):
    for source in sources(packages):
        run([*compiler(), *language.split(), *WARNINGS, "-c", source], cwd=tmp_path)


@pytest.mark.parametrize("language", ["-std=c++17 -O2", "-std=c++20 -O0"])
def test_cpp_compiles_without_a_warning(packages, language, tmp_path):
    warnings = [w for w in WARNINGS if w != "-Wmissing-prototypes"]
    for source in sources(packages):
        run([*compiler(), "-xc++", *language.split(), *warnings, "-c", source], cwd=tmp_path)


@pytest.mark.parametrize("language", ["-std=c99", "-std=c23", "-xc++ -std=c++17"])
def test_clang_compiles_without_a_warning(packages, language, tmp_path):
    pytest.importorskip("ziglang")
    warnings = [w for w in WARNINGS if w != "-Wmissing-prototypes" or "c++" not in language]
    unit = tmp_path / "all.c"  # one translation unit: starting zig takes longer than compiling
    bodies = [source for source in sources(packages) if not source.endswith("_example.c")]
    unit.write_text("".join(f'#include "{source}"\n' for source in [*bodies, sources(packages)[1]]))
    run([*ZIG, *language.split(), "-O2", *warnings, "-c", str(unit), "-o", str(tmp_path / "all.o")])


def test_fast_math_is_refused(packages, tmp_path):
    source = next(path for path in sources(packages) if not path.endswith("_example.c"))
    command = [*compiler(), "-ffast-math", "-c", source, "-o", str(tmp_path / "x.o")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode != 0
    assert "without -ffast-math" in result.stderr


def test_only_the_api_is_exported_and_only_libm_is_needed(packages, tmp_path):
    if not shutil.which("nm"):
        pytest.skip("nm is missing")
    for directory in packages:
        prefix = next(directory.glob("*.h")).stem
        out = tmp_path / "x.o"
        run([*compiler(), "-std=c99", "-O1", "-c", str(directory / f"{prefix}.c"), "-o", str(out)])
        symbols = [line.split()[-2:] for line in run(["nm", str(out)]).splitlines()]
        declared = set(re.findall(rf"\b({prefix}_\w+)\(", (directory / f"{prefix}.h").read_text()))
        assert {name for kind, name in symbols if kind == "T"} == declared
        assert {f"{prefix}_init", f"{prefix}_step", f"{prefix}_selftest"} <= declared
        assert not [name for kind, name in symbols if kind in "bBdDgGsSC"], "writable data"
        assert {name.rstrip("f") for kind, name in symbols if kind == "U"} <= {"tanh", "cos", "sin", "log"}


def test_float_code_needs_no_double(tmp_path):
    package = render(laws.two_channels("float"), laws.PROVENANCE)
    text = package.files["two_channels.c"]
    assert "double" not in text
    assert "tanhf(" in text


def test_the_makefile_builds_and_runs_the_example(packages):
    if not shutil.which("make"):
        pytest.skip("make is missing")
    for directory in packages[:1]:
        run(["make", "-s", f"CC={' '.join(compiler())}", "all", "example"], cwd=directory)
        assert list((directory / "build").glob("*.a"))
        run(["make", "-s", "clean"], cwd=directory)


@pytest.mark.parametrize("how", ["add_subdirectory", "find_package"])
def test_a_consumer_builds_with_cmake(how, tmp_path):
    if not shutil.which("cmake") or not shutil.which("cc"):
        pytest.skip("cmake or cc is missing")
    package = tmp_path / "package"
    render(laws.two_channels("float"), laws.PROVENANCE).write(package)
    build = tmp_path / "build"
    if how == "find_package":
        run(["cmake", "-S", str(package), "-B", str(build / "p"), f"-DCMAKE_INSTALL_PREFIX={tmp_path / 'root'}"])
        run(["cmake", "--build", str(build / "p"), "--target", "install"])
        line = "find_package(two_channels REQUIRED)"
    else:
        line = f"add_subdirectory({package} p)"
    consumer = tmp_path / "consumer"
    consumer.mkdir()
    (consumer / "main.c").write_text((package / "two_channels_example.c").read_text())
    (consumer / "CMakeLists.txt").write_text(
        f"cmake_minimum_required(VERSION 3.13)\nproject(consumer C)\n{line}\n"
        "add_executable(main main.c)\ntarget_link_libraries(main PRIVATE two_channels::two_channels)\n"
    )
    run(["cmake", "-S", str(consumer), "-B", str(build / "c"), f"-DCMAKE_PREFIX_PATH={tmp_path / 'root'}"])
    run(["cmake", "--build", str(build / "c")])
    run([str(build / "c" / "main")])


def test_the_makefile_fragment_builds_a_consumer(packages, tmp_path):
    if not shutil.which("make"):
        pytest.skip("make is missing")
    directory = packages[0]
    prefix = next(directory.glob("*.h")).stem
    (tmp_path / "main.c").write_text((directory / f"{prefix}_example.c").read_text())
    (tmp_path / "Makefile").write_text(
        f"include {directory}/{prefix}.mk\nU := {prefix.upper()}\n"
        "main: main.c\n\t$(CC) $($(U)_CFLAGS) main.c $($(U)_SOURCES) $($(U)_LIBS) -o main && ./main\n"
    )
    run(["make", "-s", f"CC={' '.join(compiler())} -std=c99"], cwd=tmp_path)


def test_the_arduino_sketch_compiles_as_cpp(packages, tmp_path):
    stub = "extern unsigned long micros();\nvoid setup();\nvoid loop();\n"
    for directory in packages:
        sketch = next((directory / "examples").rglob("*.ino"))
        (tmp_path / "sketch.cpp").write_text(stub + sketch.read_text())
        flags = ["-xc++", "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{directory}"]
        run([*compiler(), *flags, "-c", str(tmp_path / "sketch.cpp"), "-o", str(tmp_path / "sketch.o")])
        example = next(directory.glob("*_example.c"))
        run([*compiler(), "-std=c99", "-DARDUINO=1", "-pedantic", "-Werror", "-c", str(example), "-o", "/dev/null"])
