import re
import shutil
import sys
import tomllib
from pathlib import Path

import pytest

from pbcgen.errors import ToolchainError
from pbcgen.run.doctor import diagnose
from pbcgen.run.toolchain import Compiler, find_compiler, library_suffix

GOOD = "int twice(int x);\nint twice(int x) { return 2 * x; }\n"


def write(directory: Path, text: str) -> Path:
    path = directory / "twice.c"
    path.write_text(text)
    return path


def executable(directory: Path, name: str) -> Path:
    path = directory / name
    path.write_text("#!/bin/sh\necho fake 1.0\n")
    path.chmod(0o755)
    return path


def test_cc_of_the_environment_comes_first(tmp_path: Path) -> None:
    mine = executable(tmp_path, "mine")
    executable(tmp_path, "cc")
    compiler = find_compiler({"CC": f"{mine} -m64", "PATH": str(tmp_path)})
    assert compiler.arguments == (str(mine), "-m64")


def test_cc_on_the_path_comes_before_zig(tmp_path: Path) -> None:
    path = executable(tmp_path, "cc")
    assert find_compiler({"PATH": str(tmp_path)}).arguments == (str(path),)


def test_a_wrong_cc_is_named(tmp_path: Path) -> None:
    with pytest.raises(ToolchainError, match="no program `nonesuch`: correct or unset CC"):
        find_compiler({"CC": "nonesuch -O2", "PATH": str(tmp_path)})


def test_zig_is_the_last_resort(tmp_path: Path) -> None:
    pytest.importorskip("ziglang")
    assert find_compiler({"PATH": str(tmp_path)}).arguments == (sys.executable, "-m", "ziglang", "cc")


def test_no_compiler_at_all_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pbcgen.run.toolchain.find_zig", lambda: None)
    with pytest.raises(ToolchainError, match="pip install ziglang"):
        find_compiler({"PATH": str(tmp_path)})


def test_a_shared_library_is_built_and_named_for_the_system(tmp_path: Path) -> None:
    library = find_compiler().compile_shared([write(tmp_path, GOOD)], tmp_path)
    assert library == tmp_path / f"libtwice{library_suffix()}"
    assert library.exists()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("int twice(int x) { return 2 * y; }\n", "'y' undeclared|undeclared identifier"),
        ("float twice(double x);\nfloat twice(double x) { return x; }\n", "conversion|implicit"),
        ("double twice(float x);\ndouble twice(float x) { return 2.0 * x; }\n", "double-promotion|promot"),
    ],
)
def test_a_warning_or_error_of_the_compiler_is_quoted(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(ToolchainError, match=rf"(?s)`twice.c` did not compile with `cc`:.*({complaint})"):
        Compiler("cc", (shutil.which("cc") or "cc",)).compile_shared([write(tmp_path, text)], tmp_path)


def test_a_long_complaint_is_cut(tmp_path: Path) -> None:
    text = "".join(f"int f{k}(void) {{ return y{k}; }}\n" for k in range(50))
    with pytest.raises(ToolchainError, match=r"and \d+ more lines") as error:
        find_compiler().compile_shared([write(tmp_path, text)], tmp_path)
    assert len(str(error.value).splitlines()) < 20


def test_a_compiler_that_does_not_start_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ToolchainError, match="does not start"):
        Compiler("x", (str(tmp_path / "absent"),)).version()


def test_a_toolchain_error_exits_with_3() -> None:
    assert ToolchainError.exit_code == 3


def test_the_doctor_reports_what_is_missing_and_what_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "nonesuch")
    monkeypatch.setattr(shutil, "which", lambda name, path=None: None)
    checks = {check.name: check for check in diagnose()}
    assert checks["casadi"].found
    assert checks["casadi"].required
    assert not checks["C compiler"].found
    assert "nonesuch" in checks["C compiler"].detail
    assert not checks["valgrind"].found
    assert all(check.needed_for and check.detail for check in checks.values())
    assert [check.name for check in diagnose()] == list(checks)


def test_the_doctor_looks_for_every_dependency() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *(item for name in ("zig", "sos", "dask", "emulate") for item in extras[name])]
    names = {re.split(r"[<>=\[]", item)[0] for item in wanted}
    required = {re.split(r"[<>=\[]", item)[0] for item in project["dependencies"]}
    checks = {check.name: check for check in diagnose()}
    assert names <= checks.keys()
    assert {name for name in names if checks[name].required} == required
