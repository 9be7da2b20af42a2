"""The rooms of the package import in one direction; see docs/architecture.md."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import pbcgen

PACKAGE = Path(pbcgen.__file__).parent

#: A room imports only rooms before it.
ROOMS = (
    "errors",
    "symbolic",
    "reading",
    "verify",
    "models",
    "proof",
    "passivity",
    "law",
    "sampling",
    "control",
    "tuning",
    "parametric",
    "certify",
    "emit",
    "run",
    "examples",
    "pipeline",
    "report",
    "cli",
    "__main__",
)

#: What a room must not know although it stands before it.
CLOSED = {
    "proof": {"models"},
    "emit": {"models", "passivity", "sampling", "control", "tuning", "parametric", "certify"},
}

MODULES = sorted(PACKAGE.rglob("*.py"))


def imported(path):
    """The names of pbcgen that a module imports, as `room.module`, `room` or an export of the package."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.removeprefix("pbcgen.") for alias in node.names if alias.name.startswith("pbcgen."))
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "pbcgen":
                yield from (alias.name for alias in node.names)
            elif node.module is not None and node.module.startswith("pbcgen."):
                yield node.module.removeprefix("pbcgen.")


def room(name):
    """The room of an imported name; what the package itself exports lives in `models` or `errors`."""
    first = name.partition(".")[0]
    if first in ROOMS:
        return first
    home = getattr(pbcgen, first).__module__
    return home.split(".")[1]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_room_imports_only_rooms_before_it(path):
    here = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if here == "__init__":
        return
    for name in imported(path):
        there = room(name)
        assert ROOMS.index(there) <= ROOMS.index(here), f"{here} imports {name}"
        assert there not in CLOSED.get(here, set()), f"{here} must not know {there}, and imports {name}"


def test_every_folder_is_a_room():
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert folders <= set(ROOMS)


def test_no_modules_import_each_other_in_a_ring():
    names = {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in MODULES}
    graph = {}
    for name, path in names.items():
        if name.endswith("__init__"):
            continue
        found = [
            candidate
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom) and node.module is not None
            for base in [node.module.removeprefix("pbcgen").removeprefix(".")]
            for candidate in [base, *(f"{base}.{alias.name}" for alias in node.names)]
        ]
        graph[name] = {candidate for candidate in found if candidate in names}
    assert sum(map(len, graph.values())) > len(graph)
    TopologicalSorter(graph).prepare()  # CycleError names the ring
