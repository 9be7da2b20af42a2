"""``pbcgen report`` writes one page, and says what is in it."""

import json

import pytest

from pbcgen.cli import execute

pytestmark = pytest.mark.system


def test_a_page_of_a_built_in_model(tmp_path, capsys):
    target = tmp_path / "page.html"
    assert execute(["report", "rlc", "-o", str(target)]) == 0
    shown = capsys.readouterr().out
    assert f"Wrote {target}" in shown
    assert shown.rstrip().splitlines()[-1].startswith("Next: ")
    assert "Nonlinear RLC circuit" in target.read_text(encoding="utf-8")


def test_the_law_that_tune_wrote_is_compared_with_the_model_s_own(tmp_path, capsys):
    law = tmp_path / "gains.py"
    law.write_text(
        "from pbcgen import DynamicExtension\n\nlaw = DynamicExtension('0.04', 1, 20, 10)\n", encoding="utf-8"
    )
    target = tmp_path / "page.html"
    assert execute(["report", "rlc", "-o", str(target), "--law", str(law), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["bytes"] == len(target.read_bytes())
    text = target.read_text(encoding="utf-8")
    assert "Before and after" in text
    assert ">0.0485</td><td>0.04<" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-o", "page.pdf"], "does not end in .html"),
        (["-o", "nowhere/page.html"], "there is no directory `nowhere`"),
        (["-o", "page.html", "--law", "missing.py"], "there is no file `missing.py`"),
        (["-o", "page.html", "--law", "empty.py"], "has no `law`"),
    ],
)
def test_wrong_arguments_are_told_before_the_work(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.py").touch()
    assert execute(["report", "rlc", *arguments]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("*.html"))


@pytest.mark.parametrize(
    ("text", "message"),
    [("law = = 3", "gains.py:1: invalid syntax"), ("law = 1 / 0", "ZeroDivisionError"), ("x = 1", "has no `law`")],
)
def test_a_file_of_gains_that_is_not_right_is_refused_with_its_line(capsys, tmp_path, text, message):
    gains = tmp_path / "gains.py"
    gains.write_text(text)
    assert execute(["report", "rlc", "--law", str(gains), "-o", str(tmp_path / "page.html")]) == 1
    assert message in capsys.readouterr().err
