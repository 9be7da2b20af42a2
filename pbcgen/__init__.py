"""From a CasADi model of a physical system to a proved, saturated passivity-based controller in C."""

from pbcgen.errors import EmitError, ModelError, NotProved, PbcgenError, ToolchainError, UnsupportedOperation
from pbcgen.models.affine import AffineSystem
from pbcgen.models.circuit import Circuit
from pbcgen.models.design import Design
from pbcgen.models.laws import DynamicExtension, Integral, NaturalDamping, PassiveOutput, PotentialCompensation
from pbcgen.models.limits import Limits
from pbcgen.models.mechanical import Mechanical
from pbcgen.models.parameters import Parameters

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
    "__version__",
]
