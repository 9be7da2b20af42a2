"""Why something is not shown."""

from __future__ import annotations


class Fails(Exception):
    """The certificate does not show the claim."""


class NotCheckable(Exception):
    """The checker has no means to decide this; nothing is said against the claim."""


class Malformed(Exception):
    """The text does not follow the format."""


def require(condition: object, otherwise: str, error: type[Exception] = Fails) -> None:
    """Raise the error unless the condition holds."""
    if not condition:
        raise error(otherwise)
