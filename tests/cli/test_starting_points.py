"""`new` and `examples`: models to start from, and nothing overwritten."""

import pytest

from pbcgen import cli, examples
from pbcgen.models.loader import load


@pytest.fixture
def execute(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def _execute(*arguments):
        code = cli.execute(arguments)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return _execute


def test_new_writes_a_model_that_loads_under_its_name(execute, tmp_path):
    code, out, _ = execute("new", "my_pump")
    assert code == 0
    assert "Next: pbcgen check my_pump.py" in out
    assert load("my_pump.py").name == "my_pump"
    text = (tmp_path / "my_pump.py").read_text(encoding="utf-8")
    assert "pbcgen generate my_pump.py -o my_pump_c" in text
    assert "{{" not in text


def test_new_does_not_overwrite(execute, tmp_path):
    (tmp_path / "my_pump.py").write_text("mine", encoding="utf-8")
    code, out, err = execute("new", "my_pump")
    assert (code, out) == (1, "")
    assert "exists already" in err
    assert (tmp_path / "my_pump.py").read_text(encoding="utf-8") == "mine"


def test_examples_are_listed_with_a_line_each(execute):
    code, out, _ = execute("examples")
    assert code == 0
    for name in examples.names():
        assert f"{name} " in out


def test_an_example_is_printed_as_it_is(execute):
    assert execute("examples", "rlc") == (0, examples.path("rlc").read_text(encoding="utf-8"), "")


def test_examples_are_copied_and_load(execute, tmp_path):
    code, out, _ = execute("examples", "--copy", "models/mine")
    assert code == 0
    copied = sorted(path.stem for path in (tmp_path / "models/mine").iterdir())
    assert copied == list(examples.names())
    assert load("models/mine/rlc.py").name == "rlc"
    assert "Next: pbcgen check models/mine/coupling_device.py" in out


def test_one_example_is_copied(execute, tmp_path):
    assert execute("examples", "rlc", "--copy", ".")[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["rlc.py"]


def test_a_copy_overwrites_nothing_and_copies_all_or_nothing(execute, tmp_path):
    (tmp_path / "rlc.py").write_text("mine", encoding="utf-8")
    code, out, err = execute("examples", "--copy", ".")
    assert (code, out) == (1, "")
    assert "rlc.py exists already, nothing was copied" in err
    assert [path.name for path in tmp_path.iterdir()] == ["rlc.py"]
    assert (tmp_path / "rlc.py").read_text(encoding="utf-8") == "mine"


def test_a_copy_into_a_file_is_refused(execute, tmp_path):
    (tmp_path / "taken").write_text("mine", encoding="utf-8")
    code, _, err = execute("examples", "--copy", "taken")
    assert code == 1
    assert err.startswith("Error: ")
