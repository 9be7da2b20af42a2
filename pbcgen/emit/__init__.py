"""From a control law to a package of C files.

    identifiers   which names C allows
    literals      machine numbers as C literals
    expressions   tape instructions as C expressions
    program       the typed tree that the templates loop over
    lowering      from a law to that tree
    solves        the equations of the loop in that tree
    selftest      a run with expected outputs in that tree
    step_cost     what a step was measured to take
    templating    where the templates are
    wording       prose of header, README and manifest
    package       render and write

The algorithm of a step is specified in :mod:`pbcgen.law.step`.
"""

from pbcgen.emit.lowering import Extras
from pbcgen.emit.package import Package, Provenance, render

__all__ = ["Extras", "Package", "Provenance", "render"]
