"""What one step costs on a target, as README and manifest state it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class StepCost:
    """What one step costs on a target.

    Attributes:
        target: name of the target.
        description: the target in words.
        compiler: compiler and flags.
        steps: number of steps that were run.
        mean, worst: instructions of one step, call and return included.
        text: bytes of code and constants of the package, without library functions.
        stack: bytes of stack that the deepest step used, library functions included.
        state: bytes of the controller's state.
        static: bytes of writable static data of the package.
    """

    target: str
    description: str
    compiler: str
    steps: int
    mean: float
    worst: int
    text: int
    stack: int
    state: int
    static: int

    def as_json(self) -> dict[str, Any]:
        """The cost, ready for ``json.dumps``; the mean is rounded to a whole number."""
        return asdict(self) | {"mean": round(self.mean)}
