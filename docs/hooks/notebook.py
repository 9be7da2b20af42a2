"""Make a page of the executed notebook: its cells, and its outputs as they were saved."""

from __future__ import annotations

import base64
import json
from html import escape
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files


def on_files(files: Files, config: Any) -> Files:
    """Add notebook.md, and the pictures of its outputs."""
    notebook = json.loads((Path(config.docs_dir) / "notebook.ipynb").read_text(encoding="utf-8"))
    pictures: list[bytes] = []
    text = "\n\n".join(_cell(cell, pictures) for cell in notebook["cells"])
    files.append(File.generated(config, "notebook.md", content=text + "\n"))
    for k, picture in enumerate(pictures):
        files.append(File.generated(config, f"images/notebook_{k}.png", content=picture))
    return files


def _cell(cell: dict[str, Any], pictures: list[bytes]) -> str:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return source
    outputs = [_output(output, pictures) for output in cell["outputs"]]
    return "\n\n".join([f"```python\n{source}\n```", *filter(None, outputs)])


def _output(output: dict[str, Any], pictures: list[bytes]) -> str:
    data = output.get("data", {})
    if "text/html" in data:
        html = "".join(line for line in "".join(data["text/html"]).splitlines() if line.strip())
        return f'<div class="output">{html}</div>'
    if "image/png" in data:
        pictures.append(base64.b64decode("".join(data["image/png"])))
        return f"![Output of the cell above](images/notebook_{len(pictures) - 1}.png)"
    text = "".join(output.get("text", data.get("text/plain", "")))
    return f'<pre class="output">{escape(text)}</pre>' if text else ""
