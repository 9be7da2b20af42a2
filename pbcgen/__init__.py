"""From a CasADi model of a physical system to a proved, saturated passivity-based controller in C."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

from pbcgen.errors import EmitError, ModelError, NotProved, PbcgenError, ToolchainError, UnsupportedOperation

if TYPE_CHECKING:
    from pbcgen.models.affine import AffineSystem
    from pbcgen.models.circuit import Circuit
    from pbcgen.models.design import Design
    from pbcgen.models.laws import DynamicExtension, Integral, NaturalDamping, PassiveOutput, PotentialCompensation
    from pbcgen.models.limits import Limits
    from pbcgen.models.loader import load
    from pbcgen.models.mechanical import Mechanical
    from pbcgen.models.parameters import Parameters
    from pbcgen.pipeline import check, for_all_parameters, generate, simulate, validate
    from pbcgen.tuning.tune import tune
    from pbcgen.tuning.tuning_problem import Wish

__version__ = "0.1.0"

__all__ = [
    "AffineSystem",
    "Circuit",
    "Design",
    "DynamicExtension",
    "EmitError",
    "Integral",
    "Limits",
    "Mechanical",
    "ModelError",
    "NaturalDamping",
    "NotProved",
    "Parameters",
    "PassiveOutput",
    "PbcgenError",
    "PotentialCompensation",
    "ToolchainError",
    "UnsupportedOperation",
    "Wish",
    "__version__",
    "check",
    "for_all_parameters",
    "generate",
    "load",
    "simulate",
    "tune",
    "validate",
]

#: Imported on first use: CasADi takes longer to load than `pbcgen --help` should take.
_HOMES = {
    "AffineSystem": "pbcgen.models.affine",
    "Circuit": "pbcgen.models.circuit",
    "Design": "pbcgen.models.design",
    "DynamicExtension": "pbcgen.models.laws",
    "Integral": "pbcgen.models.laws",
    "Limits": "pbcgen.models.limits",
    "Mechanical": "pbcgen.models.mechanical",
    "NaturalDamping": "pbcgen.models.laws",
    "Parameters": "pbcgen.models.parameters",
    "PassiveOutput": "pbcgen.models.laws",
    "PotentialCompensation": "pbcgen.models.laws",
    "Wish": "pbcgen.tuning.tuning_problem",
    "tune": "pbcgen.tuning.tune",
    "check": "pbcgen.pipeline",
    "for_all_parameters": "pbcgen.pipeline",
    "generate": "pbcgen.pipeline",
    "load": "pbcgen.models.loader",
    "simulate": "pbcgen.pipeline",
    "validate": "pbcgen.pipeline",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'pbcgen' has no attribute '{name}'")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def _register_notebook_formats() -> None:
    """Inside IPython, show designs, reports and derivations richly; nothing is imported before the first is shown."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    if shell is not None:
        load_ipython_extension(shell)


def load_ipython_extension(shell: Any) -> None:
    """``%load_ext pbcgen``; importing pbcgen in a notebook does the same."""

    def shown(kind: str, key: tuple[str, str]) -> Callable[[Any], Any]:
        def show(value: Any) -> Any:
            return import_module("pbcgen.report.notebook").FORMATS[key][kind](value)

        return show

    for module, name, kinds in (
        ("pbcgen.pipeline", "Report", ("text/html", "text/latex")),
        ("pbcgen.pipeline", "Simulation", ("image/png",)),
        ("pbcgen.proof.claim", "Claim", ("text/html",)),
        ("pbcgen.control.derive", "Derivation", ("text/html", "text/latex")),
        ("pbcgen.models.design", "Design", ("text/html", "text/latex")),
    ):
        for kind in kinds:
            formatter = shell.display_formatter.formatters[kind]
            formatter.for_type_by_name(module, name, shown(kind, (module, name)))


_register_notebook_formats()
