"""Errors that a user can cause.

Every message names what the user wrote, says what is wrong with it and what to do. The command line prints it
without a traceback and exits with :attr:`PbcgenError.exit_code`.
"""


class PbcgenError(Exception):
    """Base class of all errors that pbcgen raises on purpose."""

    exit_code = 1


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
