"""Put the report of a built-in model beside the pages, as an example."""

from __future__ import annotations

from typing import Any

from mkdocs.structure.files import File, Files

from pbcgen import pipeline
from pbcgen.models.loader import load
from pbcgen.report.page import page


def on_files(files: Files, config: Any) -> Files:
    """Add reports/rlc.html."""
    report = pipeline.check(load("rlc"))
    files.append(File.generated(config, "reports/rlc.html", content=page(report, pipeline.package(report))))
    return files
