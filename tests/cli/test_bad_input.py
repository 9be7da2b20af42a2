"""What a user can get wrong: each case gives one clear message, exit code 1 or 2, and writes nothing."""

import pytest

from pbcgen import cli, examples
from pbcgen.cli import terminal
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
        ("D=[p.d]", "D=[p.d, p.d]", "the damping D must be 1x1"),
        ("D=[p.d]", "D=['0.02']", "the damping D contains the text '0.02'"),
        ("M=[p.J]", "M=[-p.J]", "the inertia matrix M is not positive definite"),
        ("V=p.m *", "V=p.mass *", "there is no parameter `mass`"),
        ("V=p.m *", "V=float('nan') *", "the potential energy V contains a constant that is not a finite number"),
        ("V=p.m *", "V=1 / 0 *", "ZeroDivisionError"),
        ("G=[1]", "GG=[1]", "unexpected keyword argument 'GG'; it takes q, p, V, G, M,"),
        ("V=p.m *", "W=p.m *", "it takes q, p, V, G, M,"),
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
        ("import casadi as ca", "import casadi as ca, nothing_of_this_name", "nothing_of_this_name"),
        ("pendulum = Mechanical(", "pendulum = = Mechanical(", "invalid syntax"),
    ],
)
def test_a_model_that_is_not_right_is_refused_with_its_line(generate, old, new, message):
    text = model(old, new)
    code, printed = generate(text)
    assert code == 1
    assert message in printed
    number, line = next((k, line) for k, line in enumerate(text.splitlines(), 1) if new in line)
    assert printed.startswith(f"Error: plant.py:{number}: ")
    assert printed.splitlines()[-1] == f"{number:>6} | {line.strip()}"


def test_a_model_without_a_design_is_refused(generate):
    code, printed = generate(model("design = Design(", "controller = Design("))
    assert code == 1
    assert "defines no `design`" in printed


def test_an_error_in_a_file_beside_the_model_names_that_file(generate, tmp_path):
    (tmp_path / "values.py").write_text("from pbcgen import Parameters\n\np = Parameters(\n    m='two',\n)\n")
    printed = generate("from values import p\n")[1]
    assert printed.startswith("Error: values.py:4: the parameter `m` is 'two'")


def test_an_error_that_is_found_later_names_the_line_of_the_argument(generate):
    text = model("law=DynamicExtension(", "law=PotentialCompensation(")
    text = text.replace("import Design,", "import PotentialCompensation, Design,").replace("G=[1]", "G=[2]")
    line = next(k for k, line in enumerate(text.splitlines(), 1) if "G=[2]" in line)
    assert generate(text)[1].startswith(f"Error: plant.py:{line}: potential-compensation needs G = I")


def test_a_verdict_names_the_line_of_what_it_speaks_of(generate, capsys, tmp_path):
    text = model('measured=["angle"]', 'measured=["momentum"]')
    generate(text)
    line = next(k for k, line in enumerate(text.splitlines(), 1) if "measured=" in line)
    cli.execute(["check", str(tmp_path / "plant.py")])
    assert f'plant.py:{line}: measured=["momentum"]\n' in capsys.readouterr().out


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


def test_a_refusal_gives_the_hint_that_others_send_to(generate):
    printed = generate(model("beta=5", 'beta="0.5"'))[1]
    assert "hint: alpha*beta must exceed 0.204120" in printed
    assert "hint: satisfy" not in printed


def test_a_storage_that_grows_through_negative_friction_says_so(generate, capsys):
    generate(model('d="0.02"', 'd="-0.02"'))
    cli.execute(["check", "plant.py"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "hint: the friction of `angle` is -0.02 there: friction must not be negative" in printed
    assert "D=[p.d]" in printed


def test_dry_friction_without_a_derivative_gets_a_smooth_form(generate, capsys):
    generate(model("D=[p.d]", "D=[ca.sign(momentum) / momentum]"))
    cli.execute(["check", "plant.py"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "write tanh(v / 0.01) for sign(v)" in printed
    assert printed.count("not reached") <= 1


def test_natural_damping_without_a_coordinate_that_is_left_to_nature(generate, capsys):
    text = model("DynamicExtension(alpha=", "NaturalDamping(alpha_l=1, beta_l=1, K_l=1, R_l=1, alpha_c=")
    generate(text.replace("beta=5", "beta_c=5").replace("import Design,", "import Design, NaturalDamping,"))
    cli.execute(["check", "plant.py"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "every coordinate has an actuator" in printed
    assert "hint: use DynamicExtension" in printed


def test_a_target_with_too_many_entries_says_how_many_to_leave_open(generate):
    printed = generate(model('target={"angle": 2}', "target=[2, 1]"))[1]
    assert "the target gives `angle`, `momentum`, and there is 1 input: leave 1 open" in printed


def test_long_messages_are_folded_on_a_terminal():
    folded = terminal._folded("plant.py:1: " + "word " * 30 + "\n  hint: " + "sampled-stable " * 10, 60)
    assert max(map(len, folded.splitlines())) <= 60
    assert folded.startswith("plant.py:1: word")
    assert "\n  hint: sampled-stable" in folded
    assert "sampled-\n" not in folded


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
