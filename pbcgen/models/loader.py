"""Loading a design from a user's Python file, or a built-in one by name."""

from __future__ import annotations

import contextlib
import inspect
import os
import re
import sys
import tokenize
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pbcgen
from pbcgen.errors import ModelError, PbcgenError, Place
from pbcgen.models.design import Design
from pbcgen.models.expressions import suggestion
from pbcgen.models.source import failing_call, located

#: Where the built-in models are. They are loaded like a user's files.
BUILT_IN_DIRECTORY = Path(__file__).resolve().parent.parent / "examples"


def load(spec: str | os.PathLike[str]) -> Design:
    """The design that ``spec`` names.

    A user's file says ``design = Design(...)`` or ``designs = {"name": Design(...), ...}``. Its directory can be
    imported from while it loads; what it prints goes to standard error. A design without a name gets that of the
    dict entry, of its variable, or, for the variable ``design``, of the file.

    Args:
        spec: ``path/to/file.py``, ``path/to/file.py:design_name``, or the name of a built-in model.

    Raises:
        ModelError: if there is no such file, name or design, or the file itself fails; then with file and line.
    """
    path, wanted = _parse(os.fspath(spec))
    return _choose(variables(path), path, wanted)


def built_in_names() -> tuple[str, ...]:
    """The names of the built-in models, sorted."""
    return tuple(sorted(path.stem for path in BUILT_IN_DIRECTORY.glob("*.py") if path.stem != "__init__"))


def _parse(spec: str) -> tuple[Path, str | None]:
    """The file and the name of the design in it, if one is given."""
    if spec in built_in_names():
        return BUILT_IN_DIRECTORY / f"{spec}.py", None
    file, separator, wanted = spec.rpartition(":")
    if not separator or not file.endswith(".py"):
        file, wanted = spec, ""
    path = Path(file)
    if path.suffix != ".py" and not path.is_file():
        raise ModelError(
            f"`{spec}` is neither a Python file nor a built-in model: built in are {', '.join(built_in_names())}"
        )
    if path.is_dir():
        raise ModelError(f"`{file}` is a directory: name the model file in it")
    if not path.is_file():
        raise ModelError(f"there is no file `{file}`")
    if separator and file != spec and not wanted:
        raise ModelError(f"`{spec}` ends with a colon: write `{file}` or `{file}:name`")
    return path, wanted or None


def variables(path: Path) -> dict[str, Any]:
    """The variables of a user's file after it has run. Raises ModelError with file and line if it fails."""
    module = ModuleType(f"pbcgen_model_{path.stem}")
    module.__file__ = str(path.resolve())
    with _importing_from(path.resolve().parent, module), contextlib.redirect_stdout(sys.stderr):
        try:
            with tokenize.open(path) as stream:
                source = stream.read()
            exec(compile(source, module.__file__, "exec", dont_inherit=True), module.__dict__)
        except (Exception, SystemExit) as error:
            raise _explained(error, path) from error
    return module.__dict__


@contextlib.contextmanager
def _importing_from(directory: Path, module: ModuleType) -> Iterator[None]:
    """Make a directory importable for a while; afterwards forget the modules that came from it."""
    search, known, writes_bytecode = list(sys.path), set(sys.modules), sys.dont_write_bytecode
    sys.path.insert(0, str(directory))
    sys.dont_write_bytecode = True
    sys.modules[module.__name__] = module
    try:
        yield
    finally:
        sys.path[:] = search
        sys.dont_write_bytecode = writes_bytecode
        sys.modules.pop(module.__name__, None)
        for name in set(sys.modules) - known:
            if directory in Path(getattr(sys.modules[name], "__file__", None) or os.devnull).parents:
                del sys.modules[name]


def _explained(error: BaseException, path: Path) -> PbcgenError:
    """The error in one sentence, with file and line."""
    if isinstance(error, SyntaxError) and Path(error.filename or path).resolve() == path.resolve():
        return ModelError(error.msg, Place(str(path), error.lineno or 1, (error.text or "").strip()))
    call = failing_call(error.__traceback__, path)
    if isinstance(error, PbcgenError):
        return located(error, call)
    if call is None:
        return ModelError(f"{path}: the file cannot be read: {error}")
    if isinstance(error, SystemExit):
        message = "the file ends the program (SystemExit): a model file only defines designs"
        return ModelError(message, call.place())
    last = (str(error).strip().splitlines() or ["no message"])[-1].strip()
    return ModelError(f"{type(error).__name__}: {last}{_what_it_takes(last)}", call.named_in(last))


def _what_it_takes(message: str) -> str:
    """The arguments of a class or function of pbcgen that was called with one it does not have, or without one."""
    called = re.match(r"(\w+)(?:\.(\w+))?\(\) (?:got an unexpected keyword|missing \d)", message)
    if called is None or called[1] not in pbcgen.__all__:
        return ""
    owner = getattr(pbcgen, called[1])
    function = owner if called[2] in {None, "__init__"} else getattr(owner, called[2])
    return f"; it takes {', '.join(inspect.signature(function).parameters)}"


def _choose(variables: Mapping[str, Any], path: Path, wanted: str | None) -> Design:
    """The wanted design, or the only one."""
    several = _several(variables, path)
    if wanted is not None:
        single = {name: value for name, value in variables.items() if isinstance(value, Design)}
        candidates = {**single, **several}
        if wanted not in candidates:
            raise ModelError(f"{path} has no design `{wanted}`: {suggestion(wanted, candidates)}")
        return _named(candidates[wanted], path.stem if wanted == "design" else wanted)
    if "design" in variables:
        if not isinstance(variables["design"], Design):
            raise ModelError(
                f"`design` in {path} is a {type(variables['design']).__name__}: a pbcgen.Design(...) was expected"
            )
        return _named(variables["design"], path.stem)
    if not several:
        raise ModelError(f"{path} defines no `design`: add `design = Design(...)`, or a dict `designs`")
    if len(several) > 1:
        raise ModelError(
            f"{path} has several designs: choose one of {', '.join(f'`{path}:{name}`' for name in several)}"
        )
    ((name, only),) = several.items()
    return _named(only, name)


def _several(variables: Mapping[str, Any], path: Path) -> dict[str, Design]:
    designs = variables.get("designs", {})
    if not isinstance(designs, Mapping):
        raise ModelError(f"`designs` in {path} is a {type(designs).__name__}: a dict of designs by name was expected")
    for name, value in designs.items():
        if not isinstance(name, str) or not isinstance(value, Design):
            raise ModelError(f"`designs` in {path} has the entry {name!r}, which is not a Design under a name")
    return dict(designs)


def _named(design: Design, name: str) -> Design:
    return design if design.name else design.with_(name=name)
