"""What the documentation shows is what happens; see doc_pages.py for the rules."""

import importlib.util
import os
import re
import subprocess
import sys

import pytest
from doc_pages import DOCS, PAGES, ROOT, Page


@pytest.mark.system
@pytest.mark.parametrize("name", PAGES)
def test_the_code_of_a_page_runs_and_prints_what_it_shows(name, tmp_path):
    page = Page(name, tmp_path)
    page.run()
    for command in page.commands:
        hint = f"`python tests/docs/doc_pages.py {name}` writes it into the page"
        assert command.as_documented, f"$ {command.line}\n{command.printed}\n{hint}"


@pytest.mark.parametrize("name", PAGES)
def test_links_and_pictures_exist(name):
    text = (DOCS / name).read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", text):
        if target not in {"notebook.md", "reports/rlc.html"}:  # made when the site is built
            assert (DOCS / target).exists(), target


@pytest.mark.system
@pytest.mark.skipif(importlib.util.find_spec("material") is None, reason="needs the extra `docs`")
def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}  # an announcement, not about this site
    built = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    index = (tmp_path / "theory.html").read_text(encoding="utf-8")
    assert "<math " in index
    outside = re.compile(r'(?:src|href)="https?://(?!github\.com|squidfunk)[^"]*\.(?:js|css|woff2?)"')
    for page in tmp_path.glob("*.html"):
        assert not outside.search(page.read_text(encoding="utf-8")), page.name
