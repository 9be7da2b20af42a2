"""A self-test for the package: a run from the initial state, with the outputs that the reference step gives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pbcgen.emit.literals import literal
from pbcgen.emit.program import SelfTest
from pbcgen.errors import EmitError
from pbcgen.law.rounding import DTYPES
from pbcgen.law.step import ReferenceStep, StepStatus

if TYPE_CHECKING:
    from pbcgen.law.law import ControlLaw

#: Number of steps.
_STEPS: Final = 16

#: Multiple of the machine epsilon that an output may be off, relative to half the width of its interval. Libraries and
#: contraction differ by a few units in the last place; filters amplify them.
_ULPS: Final = 256.0


def self_test(law: ControlLaw) -> SelfTest:
    """Measurements that excite every channel from far off to near the target, and the outputs of the reference step.

    Raises EmitError if the reference step does not compute them.
    """
    step, dtype = ReferenceStep(law), DTYPES[law.precision]
    state: Any = step.initial
    rows, outputs = [], []
    held = None
    for k in range(_STEPS):
        m = np.array(_measurement(law, k), dtype)
        state, u, status = step(m, state, held)
        if int(status) != StepStatus.OK:
            raise EmitError(
                f"the self-test of `{law.name}` cannot be made: the step reports {StepStatus(int(status)).name}"
            )
        held = u
        rows.append(tuple(literal(v) for v in m))
        outputs.append(tuple(literal(v) for v in u))
    epsilon = float(np.finfo(dtype).eps)
    tolerances = tuple(literal(dtype(_ULPS * epsilon * float(hi - lo) / 2)) for lo, hi in law.intervals)
    return SelfTest(tuple(rows), tuple(outputs), tolerances)


def _measurement(law: ControlLaw, k: int) -> list[float]:
    """Around the measurements at the target, by less and less of the declared range or of their size."""
    values = []
    for j, (signal, rest) in enumerate(zip(law.inputs, law.rest or (0.0,) * len(law.inputs), strict=True)):
        lo, hi = law.ranges.get(signal.name, (None, None))
        size = float(hi - lo) / 2 if lo is not None and hi is not None else abs(rest) or 1.0
        wave = ((7 * k + 3 * j) % 11 - 5) / 5.0
        values.append(rest + size * wave * 0.5**k)
    return values
