"""What a command ends with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Outcome:
    """The result of a command, not yet printed.

    Attributes:
        show: prints the result for people.
        document: the result for programs; printed in place of `show` when there is one.
        exit_code: of the process.
    """

    show: Callable[[Console], None]
    document: Mapping[str, Any] | None = None
    exit_code: int = 0
