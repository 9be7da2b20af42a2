"""The notebook of the documentation runs, and shows today what is saved in it."""

import importlib.util
import json
import sys

import pytest
from doc_pages import DOCS

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(importlib.util.find_spec("nbclient") is None, reason="needs the extra `docs`"),
    pytest.mark.skipif(importlib.util.find_spec("ipykernel") is None, reason="needs the extra `docs`"),
]


def kinds(cell):
    """The MIME types of a cell's outputs."""
    return [sorted(output.get("data", {"text": None})) for output in cell.get("outputs", [])]


def test_the_notebook_runs_and_shows_what_is_saved():
    sys.path.insert(0, str(DOCS))
    try:
        import make_notebook
    finally:
        sys.path.remove(str(DOCS))
    saved = json.loads((DOCS / "notebook.ipynb").read_text(encoding="utf-8"))
    fresh = make_notebook.build()
    assert [c["cell_type"] for c in saved["cells"]] == [c["cell_type"] for c in fresh.cells]
    for old, new in zip(saved["cells"], fresh.cells, strict=True):
        assert "".join(old["source"]) == new["source"]
        assert kinds(old) == kinds(new), "`python docs/make_notebook.py` writes it again"
        assert all(output["output_type"] != "error" for output in new.get("outputs", []))


def test_the_outputs_are_rich():
    saved = json.loads((DOCS / "notebook.ipynb").read_text(encoding="utf-8"))
    shown = [kind for cell in saved["cells"] for output in kinds(cell) for kind in output]
    assert shown.count("text/html") >= 3
    assert "text/latex" in shown
    assert "image/png" in shown
