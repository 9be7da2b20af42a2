from __future__ import annotations

import keyword
import re

import pytest
from compiled import compiler, run
from hypothesis import given
from hypothesis import strategies as st

from pbcgen.emit.identifiers import RESERVED, Scope, is_reserved, legal, package_prefix
from pbcgen.errors import EmitError

IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}")


@given(st.text())
def test_any_name_becomes_a_legal_unreserved_identifier(name):
    result = legal(name)
    assert IDENTIFIER.fullmatch(result)
    assert "__" not in result
    assert not is_reserved(result)


@given(st.lists(st.text(alphabet="ab _θ1é", max_size=4)))
def test_names_in_one_scope_never_collide(names):
    scope = Scope()
    claimed = [scope.claim(name) for name in names]
    assert len(set(claimed)) == len(names)


@given(st.from_regex(r"[a-z][a-zA-Z0-9]{2,20}(_[a-z]{1,20})?", fullmatch=True))
def test_a_legal_name_stays(name):
    if not is_reserved(name):
        assert Scope().claim(name) == name


@pytest.mark.parametrize(
    "name", ["class", "int", "M_PI", "NAN", "xor", "errno", "linux", "INT8_MAX", "int8_t", "bool", "I"]
)
def test_keywords_and_macros_are_renamed(name):
    assert legal(name) == f"{name}_"


@pytest.mark.parametrize("name", ["gamma", "y1", "j0", "lambda_c", "step", "state", "t0", "sin", "E", "log", "u"])
def test_names_that_only_functions_have_stay(name):
    assert legal(name) == name


def test_every_legal_name_compiles_as_a_member_in_c_and_cpp(tmp_path):
    names = sorted(
        {legal(name) for name in [*RESERVED, *keyword.kwlist, "gamma", "y1", "sin", "θ", "1", "", "_x", "E1"]}
    )
    headers = "math stdint stdio stdlib string errno float limits complex signal assert".split()  # noqa: SIM905
    text = "".join(f"#include <{header}.h>\n" for header in headers)
    text += "typedef struct {\n" + "".join(f"    double {name};\n" for name in names) + "} everything;\n"
    text += "double total(everything *e);\ndouble total(everything *e)\n{\n    double sum = 0.0;\n"
    text += "".join(f"    sum += e->{name};\n" for name in names) + "    return sum;\n}\n"
    source = tmp_path / "names.c"
    source.write_text(text)
    for language in ("-xc -std=c99", "-xc -std=gnu11", "-xc++ -std=c++17", "-xc++ -std=gnu++20"):
        command = [*compiler(), *language.split(), "-Wall", "-Wextra", "-Werror", "-c", str(source)]
        if "c++" in language:
            (tmp_path / "names.cc").write_text(text.replace("#include <complex.h>\n", ""))
            command[-1] = str(tmp_path / "names.cc")
        run([*command, "-o", str(tmp_path / "names.o")])


def test_prefixes():
    assert package_prefix(None, "Coupling Device") == "coupling_device"
    assert package_prefix(None, "math") == "math_control"
    assert package_prefix(None, "int") == "int_control"
    assert package_prefix("RLC", "x") == "RLC"


@pytest.mark.parametrize(
    "prefix", ["", "1st", "a-b", "math", "class", "test", "m", "_x", "a__b", "x" * 41, "../x", "a_"]
)
def test_a_prefix_that_cannot_name_a_library_is_refused_with_a_suggestion(prefix):
    with pytest.raises(EmitError, match="prefix"):
        package_prefix(prefix, "design")
