"""Errors that a user can cause.

Every message names what the user wrote, says what is wrong with it and what to do. The command line prints it
without a traceback and exits with :attr:`PbcgenError.exit_code`.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Place:
    """A line of the user's file: its path, its number from 1, and what it says."""

    file: str
    line: int
    text: str = ""

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


class PbcgenError(Exception):
    """Base class of all errors that pbcgen raises on purpose.

    Attributes:
        message: what is wrong and what to do, without the place.
        place: the line of the user's file that it is about, where it is known.
    """

    exit_code = 1

    def __init__(self, message: str = "", place: Place | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.place = place

    def __str__(self) -> str:
        return self.message if self.place is None else f"{self.place}: {self.message}"


class ModelError(PbcgenError):
    """A model, design or file that does not say what it must: wrong shapes, unknown names, missing values."""


class UnsupportedOperation(PbcgenError):
    """An SX operation that an interpreter of the tape has no sound meaning for."""


class EmitError(PbcgenError):
    """The C package cannot be written: an output directory in use, a name that cannot be a C identifier."""


class ToolchainError(PbcgenError):
    """No compiler was found, the generated code did not compile, or it did not validate."""

    exit_code = 3


class NotProved(PbcgenError):
    """Code was asked for, and a claim that it depends on is not PROVED."""

    exit_code = 2
