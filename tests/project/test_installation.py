"""The wheel and the editable install work outside the repository.

Each is installed without its dependencies into an empty environment that borrows those of the running one.
"""

import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[2]


def run(*command, cwd):
    """Run a command with nothing in the environment that leads back to the repository."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    words = [str(word) for word in command]
    result = subprocess.run(words, cwd=cwd, env=variables, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    directory = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", directory, ROOT, cwd=directory)
    (built,) = directory.glob("pbcgen-*.whl")
    return built


@pytest.fixture(params=["wheel", "editable"])
def environment(request, tmp_path):
    """The `bin` directory of a fresh environment with pbcgen in it."""
    home = tmp_path / "environment"
    run(sys.executable, "-m", "venv", "--without-pip", home, cwd=tmp_path)
    (packages,) = home.glob("lib/python*/site-packages")
    # A line in a .pth file adds a directory, but not what that directory's own .pth files add: not this repository.
    (packages / "borrowed.pth").write_text(f"{sysconfig.get_path('purelib')}\n", encoding="utf-8")
    what = [request.getfixturevalue("wheel")] if request.param == "wheel" else ["--no-build-isolation", "-e", ROOT]
    python = home / "bin" / "python"
    install = ("install", "--quiet", "--no-deps", "--no-index", "--ignore-installed")
    run(sys.executable, "-m", "pip", "--python", python, *install, *what, cwd=tmp_path)
    return request.param, home / "bin"


def test_the_wheel_holds_package_types_and_templates_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert "pbcgen/py.typed" in names
    templates = {path.relative_to(ROOT) for path in (ROOT / "templates").rglob("*") if path.is_file()}
    assert {f"pbcgen/{path.as_posix()}" for path in templates} <= set(names)
    assert all(name.startswith(("pbcgen/", "pbcgen-")) for name in names)
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_an_installed_pbcgen_goes_from_a_new_model_to_validated_c(environment, tmp_path):
    kind, scripts = environment
    work = tmp_path / "work"
    work.mkdir()
    place = run(scripts / "python", "-c", "import pbcgen; print(pbcgen.__file__)", cwd=work)
    assert (str(ROOT) in place) is (kind == "editable")
    pbcgen = scripts / "pbcgen"
    run(pbcgen, "new", "plant", cwd=work)
    run(pbcgen, "generate", "plant.py", "-o", "plant_c", cwd=work)
    assert (work / "plant_c" / "plant.c").is_file()
    assert "passed" in run(scripts / "python", "-m", "pbcgen", "validate", "plant.py", cwd=work)
    run(pbcgen, "examples", "rlc", "--copy", "models", cwd=work)
    assert (work / "models" / "rlc.py").is_file()
