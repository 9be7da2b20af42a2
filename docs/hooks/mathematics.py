"""Turn $...$ and $$...$$ into MathML when the site is built: browsers draw it without a script."""

from __future__ import annotations

import re
from typing import Any

from pbcgen.report.mathematics import mathml

_PROTECTED = re.compile(r"(^```.*?^```|^~~~.*?^~~~|`[^`\n]+`|<div.*?</div>)", re.MULTILINE | re.DOTALL)
_DISPLAYED = re.compile(r"\$\$(.+?)\$\$", re.DOTALL)
_INLINE = re.compile(r"(?<![\\$\w])\$(?=\S)([^$]+?)(?<=\S)\$(?![\w$])")
_MARK = re.compile(r"<p>(mathmark(\d+)end)</p>|mathmark(\d+)end")

#: The formulas of the page that is being built; Markdown sees only marks in their place.
_formulas: list[tuple[str, bool]] = []


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put marks in the place of formulas, outside code."""
    _formulas.clear()
    parts = _PROTECTED.split(markdown)
    return "".join(part if k % 2 else _marked(part) for k, part in enumerate(parts))


def _marked(text: str) -> str:
    text = _DISPLAYED.sub(lambda m: _mark(m[1], block=True), text)
    return _INLINE.sub(lambda m: _mark(m[1], block=False), text)


def _mark(latex: str, *, block: bool) -> str:
    _formulas.append((" ".join(latex.split()), block))
    return f"mathmark{len(_formulas) - 1}end"


def on_page_content(html: str, **_: Any) -> str:
    """Put the formulas in the place of the marks."""

    def formula(match: re.Match[str]) -> str:
        latex, block = _formulas[int(match[2] or match[3])]
        text = mathml(latex, block=block)
        if not block:
            return f"<p>{text}</p>" if match[1] else text
        return f'<div class="formula" tabindex="0" role="region" aria-label="Formula">{text}</div>'

    return _MARK.sub(formula, html)
