"""What a user can get wrong: each case gives one clear message, exit code 1 or 2, and writes nothing."""

import pytest

from pbcgen import cli, examples
from pbcgen.emit.templating import fill

STORAGE = """
import casadi as ca
from pbcgen import AffineSystem, Design, DynamicExtension
x, u = ca.SX.sym("x"), ca.SX.sym("u")
tank = AffineSystem([x], [u], f=[-x], g=[1], S=x**2 / 2 + u**2)
design = Design(tank, {"x": 0}, DynamicExtension(1, 1, 1, 1), sample_period="1e-3")
"""


@pytest.fixture
def generate(capsys, tmp_path, monkeypatch):
    """Run `generate` on a model text; returns exit code and message, and asserts what holds for every case."""
    monkeypatch.chdir(tmp_path)

    def _generate(text, *more):
        (tmp_path / "plant.py").write_text(text, encoding="utf-8")
        before = sorted(tmp_path.rglob("*"))
        code = cli.execute(["generate", "plant.py", "-o", "out", *more])
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("Error: ")
        assert "Traceback" not in captured.err
        assert "defect" not in captured.err
        assert sorted(tmp_path.rglob("*")) == before
        return code, captured.err

    return _generate


def model(old, new):
    """The text that `pbcgen new` writes, with one thing changed."""
    text = fill("model.py.j2", {"name": "plant"})
    assert text.count(old) == 1, old
    return text.replace(old, new)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("D=[p.d]", "D=[p.d, p.d]", "D"),
        ("q=[angle]", "q=[angle, ca.SX.sym('b')]", "q"),
        ('d="0.02"', "d=None", "the parameter `d` has no value"),
        ('m="0.2"', 'm=float("nan")', "the parameter `m` is nan"),
        ('m="0.2"', 'm="two"', "the parameter `m` is 'two'"),
        ("beta=5", "beta=-5", "beta"),
        ("K_c=4", "K_c=[[4, 0], [0, 4]]", "K_c"),
        ('measured=["angle"]', 'measured=["angel"]', "angel"),
        ('target={"angle": 2}', 'target={"angel": 2}', "did you mean `angle`?"),
        ('target={"angle": 2}', 'target={"angle": float("inf")}', "inf"),
        ("Limits.symmetric(1)", "Limits.symmetric(-1)", "positive"),
        ('sample_period="1e-3"', "sample_period=0", "the sample period is 0"),
        ('precision="float"', 'precision="half"', "half"),
        ("design = Design(", "controller = Design(", "defines no `design`"),
        ("import casadi as ca", "import casadi as ca, nothing_of_this_name", "nothing_of_this_name"),
    ],
)
def test_a_model_that_is_not_right_is_refused_with_exit_code_1(generate, old, new, message):
    code, printed = generate(model(old, new))
    assert code == 1
    assert message in printed


def test_a_message_names_the_line_of_the_users_file(generate):
    text = model("beta=5", "beta=-5")
    line = next(number for number, line in enumerate(text.splitlines(), 1) if "beta=-5" in line)
    assert f"plant.py:{line}: " in generate(text)[1]


def test_a_storage_that_depends_on_the_input_is_refused(generate):
    code, printed = generate(STORAGE)
    assert code == 1
    assert "input" in printed


def test_a_target_that_is_no_equilibrium_is_refused_with_the_nearest_one(generate):
    text = examples.path("elastic_pendulum").read_text(encoding="utf-8")
    assert 'target={"link": 0}' in text
    code, printed = generate(text.replace('target={"link": 0}', 'target={"link": 0, "motor": 1}'))
    assert code == 2
    assert "equilibrium" in printed
    assert "dlink_momentum/dt = 6 with the best u" in printed
    assert "nearest" in printed


def test_limits_that_no_alpha_can_meet_are_refused(generate):
    code, printed = generate(model("Limits.symmetric(1)", 'Limits.symmetric("0.1")'))
    assert code == 2
    assert "saturation" in printed


def test_gains_that_break_the_limits_are_refused_unless_allowed(generate, capsys, tmp_path):
    text = model('alpha="0.4"', "alpha=1")
    code, printed = generate(text)
    assert code == 2
    assert "saturation" in printed
    assert cli.execute(["generate", "plant.py", "-o", "out", "--allow", "saturation"]) == 0
    assert "NOT PROVED, allowed by you: saturation" in capsys.readouterr().out
    assert "NOT PROVED (saturation)" in (tmp_path / "out" / "plant.h").read_text(encoding="utf-8")


def test_a_directory_with_other_files_is_left_alone(generate, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("mine", encoding="utf-8")
    code, printed = generate(model("beta=5", "beta=6"))
    assert code == 1
    assert "thesis.tex" in printed
    assert (tmp_path / "out" / "thesis.tex").read_text(encoding="utf-8") == "mine"


def test_a_prefix_that_is_no_c_name_is_refused(generate):
    code, printed = generate(model("beta=5", "beta=6"), "--prefix", "2fast")
    assert code == 1
    assert "2fast" in printed
