"""The checker is small, and shares nothing with what it checks."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from certificates import certificate_of

import pbcgen

PACKAGE = Path(pbcgen.__file__).parent
CHECKER = sorted((PACKAGE / "verify").glob("*.py"))
READING = sorted((PACKAGE / "reading").glob("*.py"))
ARITHMETIC = sorted((PACKAGE / "symbolic" / "plain").glob("*.py"))


def code_lines(path):
    """The lines that are not blank, comment or docstring."""
    text = path.read_text(encoding="utf-8")
    silent = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            silent |= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    lines = enumerate(text.splitlines(), 1)
    return sum(1 for k, line in lines if line.strip() and not line.lstrip().startswith("#") and k not in silent)


def test_the_checker_has_fewer_than_500_lines_of_code():
    assert sum(map(code_lines, CHECKER)) < 500


def test_all_that_must_be_trusted_stays_small():
    """The checker, the second reading of the model that it rests on, and the arithmetic of both."""
    assert sum(map(code_lines, [*CHECKER, *READING, *ARITHMETIC])) < 2450


@pytest.mark.parametrize("path", [*CHECKER, *READING, *ARITHMETIC], ids=lambda path: f"{path.parent.name}/{path.name}")
def test_it_imports_the_standard_library_and_python_flint_only(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) else []
        for name in names:
            own = name.startswith(("pbcgen.verify", "pbcgen.reading", "pbcgen.symbolic.plain"))
            assert own or name == "flint" or name.partition(".")[0] in sys.stdlib_module_names, name


def test_it_runs_where_casadi_is_not_installed(tmp_path):
    import json

    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(certificate_of("rlc")))
    blocked = "import sys; sys.modules.update(casadi=None, numpy=None, scipy=None); "
    script = blocked + f"import pbcgen.cli; sys.exit(pbcgen.cli.execute(['verify', {str(path)!r}]))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Accepted." in done.stdout
