"""Write and execute docs/notebook.ipynb: ``python docs/make_notebook.py``."""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

PLACE = Path(__file__).with_name("notebook.ipynb")

CELLS = (
    (
        "markdown",
        "# In a notebook\n\nInside IPython and Jupyter, `import pbcgen` makes designs, reports, derivations and "
        "simulations "
        "show themselves as formulas, tables and plots. This page is an executed notebook.",
    ),
    (
        "code",
        "from pbcgen import DynamicExtension, pipeline\nfrom pbcgen.models.loader import load\n\n"
        'design = load("rlc")\ndesign',
    ),
    ("markdown", "A check shows its verdicts; the derivation unfolds below the table."),
    ("code", "report = pipeline.check(design)\nreport"),
    ("markdown", "A single claim, here of a design whose stiffness is below the threshold:"),
    (
        "code",
        'soft = load("elastic_pendulum").with_(law=DynamicExtension(alpha=3, beta="0.6", K_c=12, R_c=1))\n'
        'next(claim for claim in pipeline.check(soft).claims if claim.claim == "hessian-condition")',
    ),
    ("markdown", "Numbers are in `derived`, for plots and scans of your own:"),
    (
        "code",
        "for beta in (1, 10, 100):\n"
        '    law = DynamicExtension(alpha="0.0485", beta=beta, K_c=10, R_c=10)\n'
        '    period = pipeline.check(design.with_(law=law)).derived["max_sample_period"]\n'
        '    print(f"beta = {beta:3}: stable up to h = {period:.3g} s")',
    ),
    ("markdown", "A simulation is a picture: the law in continuous time as a pale band, the generated C as a line."),
    ("code", 'pipeline.simulate(design.with_(duration="0.04"))'),
)


def build() -> nbformat.NotebookNode:
    """The notebook with its outputs, without anything that differs between two runs."""
    book = nbformat.v4.new_notebook()
    for number, (kind, source) in enumerate(CELLS):
        make = nbformat.v4.new_markdown_cell if kind == "markdown" else nbformat.v4.new_code_cell
        cell = make(source)
        cell["id"] = f"cell-{number}"
        book.cells.append(cell)
    NotebookClient(book, timeout=300, kernel_name="python3", record_timing=False, coalesce_streams=True).execute()
    book.metadata = nbformat.from_dict(
        {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        }
    )
    return book


if __name__ == "__main__":
    nbformat.write(build(), PLACE)
    print(PLACE, file=sys.stderr)
