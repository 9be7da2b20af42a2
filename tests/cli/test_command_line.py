"""Exit codes, error messages, terminals and pipes: what holds for every command."""

import json
import os
import pty
import re
import subprocess
import sys

import pytest

import pbcgen
from pbcgen import cli, errors, pipeline

ESCAPE = "\x1b"


def run(*arguments, **environment):
    """The command line in a process of its own, its output in pipes."""
    return subprocess.run(
        [sys.executable, "-m", "pbcgen", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        check=False,
    )


@pytest.fixture
def execute(capsys):
    def _execute(*arguments):
        code = cli.execute(arguments)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return _execute


def test_all_that_is_exported_exists():
    for name in pbcgen.__all__:
        assert getattr(pbcgen, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = pbcgen.Nothing


def test_help_names_every_command_and_loads_no_heavy_library():
    script = (
        "import sys, pbcgen.cli; pbcgen.cli.execute(['--help']); print(sorted({'casadi', 'numpy'} & set(sys.modules)))"
    )
    text = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    for command in ("new", "examples", "check", "generate", "validate", "simulate", "doctor"):
        assert re.search(rf"^  {command}  ", text, re.MULTILINE)
    assert text.endswith("[]\n")


def test_version_and_no_arguments(execute):
    assert execute("--version") == (0, f"pbcgen {pbcgen.__version__}\n", "")
    code, out, err = execute()
    assert (code, err) == (0, "")
    assert out.startswith("Usage: pbcgen")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["chek", "rlc"], "No such command 'chek'. Did you mean 'check'?"),
        (["check"], "Missing argument 'MODEL'"),
        (["check", "rlc", "--jason"], "No such option: --jason"),
        (["generate", "rlc"], "Missing option '-o'"),
        (["generate", "rlc", "-o", "out", "--precision", "half"], "half"),
        (["generate", "rlc", "-o", "out", "--allow", "satuation"], "did you mean `saturation`?"),
        (["generate", "rlc", "-o", "out", "--sample-period", "0"], "the sample period is 0"),
        (["generate", "rlc", "-o", "out", "--sample-period", "soon"], "the sample period is 'soon'"),
        (["check", "rlcc"], "neither a Python file nor a built-in model"),
        (["simulate", "rlc", "--plot", "loop.gif"], "choose one of them"),
        (["simulate", "rlc", "--plot", "nowhere/loop.png"], "there is no directory `nowhere`"),
        (["new", "my-pump"], "cannot be the name of a design"),
        (["new", "lambda"], "cannot be the name of a design"),
        (["examples", "perra"], "did you mean `pera`?"),
    ],
)
def test_a_usage_error_is_one_message_and_exit_code_1(execute, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, out, err = execute(*arguments)
    assert (code, out) == (1, "")
    assert err.startswith("Error: ")
    assert message in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_error_with_json_is_a_document_too(execute):
    code, out, err = execute("check", "nothing.py", "--json")
    assert code == 1
    assert json.loads(out) == {"error": "there is no file `nothing.py`", "exit_code": 1}
    assert err == "Error: there is no file `nothing.py`\n"


@pytest.mark.parametrize(
    ("error", "code"),
    [(errors.ModelError("m"), 1), (errors.NotProved("m"), 2), (errors.ToolchainError("m"), 3)],
)
def test_each_kind_of_error_has_its_exit_code(execute, monkeypatch, error, code):
    def failing(design, progress, scan):
        raise error

    monkeypatch.setattr(pipeline, "check", failing)
    assert execute("check", "rlc") == (code, "", "Error: m\n")


def test_a_defect_asks_for_a_report_and_shows_its_traceback_only_when_asked(execute, monkeypatch):
    def failing(design, progress, scan):
        raise RuntimeError("[bold]what?")

    monkeypatch.setattr(pipeline, "check", failing)
    code, out, err = execute("check", "rlc")
    assert (code, out) == (1, "")
    assert "defect in pbcgen, not in your model: RuntimeError: [bold]what?" in err
    assert "report it" in err
    assert "Traceback" not in err
    monkeypatch.setenv(cli.DEBUG_VARIABLE, "1")
    assert "Traceback" in execute("check", "rlc")[2]


def test_a_pipe_gets_no_escape_sequences():
    for arguments in (["examples"], ["doctor"], ["check", "nothing.py"]):
        result = run(*arguments)
        assert ESCAPE not in result.stdout + result.stderr


def test_a_reader_that_stops_reading_is_no_error():
    script = f"{sys.executable} -m pbcgen examples pera 2>&1 | head -1"
    result = subprocess.run(script, shell=True, capture_output=True, text=True, check=False)
    assert result.stdout.startswith('"""Robot arm')
    assert result.stderr == ""


def test_an_encoding_without_our_letters_is_no_error():
    result = run("examples", "coupling_device", PYTHONIOENCODING="ascii")
    assert result.returncode == 0


def _on_terminal(*arguments, **environment):
    """What the command line writes to a terminal."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "pbcgen", *arguments]
    variables = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "80", **environment}
    process = subprocess.Popen(command, stdout=theirs, stderr=theirs, stdin=theirs, env=variables)
    os.close(theirs)
    chunks = []
    while True:
        try:
            chunk = os.read(ours, 65536)
        except OSError:  # the other side is closed
            break
        if not chunk:
            break
        chunks.append(chunk)
    os.close(ours)
    process.wait()
    return b"".join(chunks).decode()


def test_a_terminal_gets_colour_unless_it_is_not_wanted():
    assert f"{ESCAPE}[32mfound" in _on_terminal("doctor")
    assert f"{ESCAPE}[32m" not in _on_terminal("doctor", NO_COLOR="1")
    assert ESCAPE not in _on_terminal("doctor", TERM="dumb")


@pytest.mark.parametrize("width", ["80", "120"])
def test_doctor_fits_the_terminal(width):
    lines = run("doctor", COLUMNS=width).stdout.splitlines()
    assert max(map(len, lines)) <= int(width)


def test_doctor_as_json(execute):
    code, out, _ = execute("doctor", "--json")
    document = json.loads(out)
    assert code == 0
    assert document["pbcgen"] == pbcgen.__version__
    assert all(set(check) == {"name", "found", "detail", "needed_for", "required"} for check in document["checks"])


def test_a_directory_that_cannot_be_made_is_no_defect(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert cli.execute(["generate", "rlc", "-o", str(tmp_path / "file" / "out")]) == 1
    printed = capsys.readouterr().err
    assert "cannot be" in printed
    assert "defect" not in printed
