"""What `validate` and `simulate` print, told from results that are made up."""

import json

import fake_results
import pytest

from pbcgen import cli, pipeline


@pytest.fixture
def execute(monkeypatch, capsys):
    """Run a command at a width; returns exit code and standard output."""

    def _execute(*arguments, width=80):
        monkeypatch.setenv("COLUMNS", str(width))
        code = cli.execute(arguments)
        return code, capsys.readouterr().out

    return _execute


@pytest.fixture
def validation(monkeypatch):
    def _set(*, passed):
        result = fake_results.validation(passed=passed)
        monkeypatch.setattr(pipeline, "validate", lambda design, **options: result)

    return _set


@pytest.fixture(autouse=True)
def simulation(monkeypatch):
    result = fake_results.simulation()
    monkeypatch.setattr(pipeline, "simulate", lambda design, **options: result)


def test_validate_prints_each_test_and_the_next_command(execute, validation):
    validation(passed=True)
    code, text = execute("validate", "rlc", "--precision", "double")
    assert code == 0
    assert text.count("passed") == 3
    assert "error at h, h/2, h/4: 4.00e-03, 2.00e-03, 1.00e-03" in text
    assert "[3.003, 3.1]" in text
    assert text.endswith("Next: pbcgen simulate rlc --precision double --plot loop.png\n")


def test_a_validation_that_fails_exits_with_3_and_says_so(execute, validation):
    validation(passed=False)
    code, text = execute("validate", "rlc")
    assert code == 3
    assert text.count("FAILED  C against the Python step") == 1
    assert "do not use it" in text
    code, text = execute("validate", "rlc", "--json")
    assert code == 3
    assert json.loads(text)["passed"] is False


def test_simulate_prints_where_it_ends_and_the_inputs_it_used(execute):
    code, text = execute("simulate", "rlc")
    assert code == 0
    assert "x3 [V]" in text
    assert "[3.003, 3.1]" in text
    assert text.index("always in") < text.index("limits")
    assert "[0, 3.1]" in text
    assert "x* is not reached at the end: x1 by 8" in text
    assert "--plot loop.png" in text


def test_simulate_as_json(execute):
    code, text = execute("simulate", "rlc", "--json")
    assert code == 0
    document = json.loads(text)
    assert document["states"][2]["target"] == 3.0515
    assert document["inputs"][0]["interval"] == [3.003, 3.1]
    assert document["inputs"][0]["limits"] == [0, 3.1]
    assert document["reached"] is False
    assert document["plot"] is None


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_simulate_draws(execute, tmp_path, suffix):
    path = tmp_path / f"loop.{suffix}"
    code, text = execute("simulate", "rlc", "--plot", str(path))
    assert code == 0
    assert f"Picture: {path}" in text
    assert path.stat().st_size > 5000


@pytest.mark.parametrize("width", [80, 120])
def test_the_tables_fit_the_terminal(execute, validation, width):
    validation(passed=True)
    for command in ("validate", "simulate"):
        assert max(map(len, execute(command, "rlc", width=width)[1].splitlines())) <= width
