import sys

import pytest

from pbcgen import ModelError
from pbcgen.models.loader import built_in_names, load

MODEL = """
import casadi as ca
from pbcgen import AffineSystem, Design, DynamicExtension, Limits, Parameters
x, u = ca.SX.sym("x"), ca.SX.sym("u")
system = AffineSystem(x, u, -x, 1, x**2 / 2)
def make(**more):
    return Design(system, {"x": 0}, DynamicExtension(1, 1, 1, 1), sample_period="1e-3", **more)
"""


@pytest.fixture
def write(tmp_path):
    def _write(text, name="tank.py"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    return _write


def test_a_file_with_one_design_gives_it_its_name(write):
    assert load(write(MODEL + "design = make()")).name == "tank"
    assert load(write(MODEL + "design = make(name='boiler')")).name == "boiler"
    assert load(write(MODEL + "designs = {'slow': make()}")).name == "slow"


def test_a_name_chooses_among_several(write):
    path = write(MODEL + "designs = {'slow': make(), 'fast': make()}\nspare = make()\ndesign = make()")
    assert [load(f"{path}:{name}").name for name in ("slow", "fast", "spare", "design")] == [
        "slow",
        "fast",
        "spare",
        "tank",
    ]
    assert load(path).name == "tank"


def test_every_built_in_model_loads_under_its_name():
    assert built_in_names() == ("coupling_device", "elastic_pendulum", "pera", "pera_integral", "rlc")
    assert [load(name).name for name in built_in_names()] == list(built_in_names())


def test_the_directory_of_the_file_is_importable_while_it_loads(write):
    write("GAIN = 7", "gain_table.py")
    path = write(MODEL + "from gain_table import GAIN\nassert __name__ != '__main__'\ndesign = make(duration=GAIN)")
    search, modules = list(sys.path), set(sys.modules)
    assert load(path).duration == 7
    assert sys.path == search
    assert set(sys.modules) - modules == set()
    write("GAIN = 8", "gain_table.py")
    assert load(path).duration == 8


def test_nothing_is_left_beside_the_file(write, tmp_path):
    write("GAIN = 7", "gain_table.py")
    load(write(MODEL + "import gain_table\ndesign = make()"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gain_table.py", "tank.py"]


def test_what_the_file_prints_does_not_reach_standard_output(write, capsys):
    load(write(MODEL + "print('hello')\ndesign = make()"))
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == "hello\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "defines no `design`"),
        ("", "defines no `design`"),
        ("design = 3", "`design` in .* is a int"),
        ("designs = [1]", "`designs` in .* is a list"),
        ("designs = {'a': 3}", "entry 'a', which is not a Design"),
        ("designs = {}", "defines no `design`"),
        ("1 +", r"tank\.py:1: invalid syntax"),
        ("a = 1\nb = a / 0", r"tank\.py:2: ZeroDivisionError: division by zero"),
        ("import nowhere_to_be_found", r"tank\.py:1: ModuleNotFoundError: No module named"),
        ("raise SystemExit(0)", r"tank\.py:1: the file ends the program"),
        ("import sys\n\nsys.exit('x')", r"tank\.py:3: the file ends the program"),
        ("raise ValueError", r"tank\.py:1: ValueError: no message"),
        (MODEL + "p = Parameters(R=None)", r"tank\.py:8: the parameter `R` has no value"),
        (MODEL + "p = Parameters(R1=1)\np.R2", r"tank\.py:9: AttributeError: there is no parameter `R2`"),
        (MODEL + "make(duration=0)", r"tank\.py:7: the duration is 0"),
        (MODEL + "make(initial={'y': 0})", r"tank\.py:7: the initial state names `y`"),
        (MODEL + "designs = {'slow': make(), 'fast': make()}", "several designs: choose one of .*tank.py:slow`"),
    ],
)
def test_a_file_that_gives_no_design_is_refused_with_its_line(write, text, message):
    with pytest.raises(ModelError, match=message):
        load(write(text))


def test_names_that_lead_nowhere_are_refused(write, tmp_path):
    path = write(MODEL + "designs = {'slow': make()}")
    for spec, message in (
        (str(tmp_path / "no.py"), "there is no file"),
        ("no_such_model", "neither a Python file nor a built-in model: built in are coupling_device"),
        (str(tmp_path), "neither a Python file|is a directory"),
        (f"{path}:", "ends with a colon"),
        (f"{path}:slo", "has no design `slo`: did you mean `slow`"),
        ("", "neither a Python file"),
    ):
        with pytest.raises(ModelError, match=message):
            load(spec)


def test_a_file_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "model.py"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ModelError, match=r"model\.py"):
        load(str(path))
