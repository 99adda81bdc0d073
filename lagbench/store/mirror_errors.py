"""What a mirror can do wrong, an error of its own name for each.

What is the mirror's lie is a DataError, what is the line's fault a WorkFailedError.
"""

from __future__ import annotations

from lagbench.errors import DataError, WorkFailedError

__all__ = [
    "BrokenError",
    "ConnectionLostError",
    "MirrorUnreachableError",
    "NotDataError",
    "NotOnMirrorError",
    "TruncatedError",
    "WrongContentError",
    "WrongLengthError",
]


class NotOnMirrorError(DataError):
    """The mirror does not have the file."""


class MirrorUnreachableError(WorkFailedError):
    """No answer from the mirror, or none but that it is busy."""


class ConnectionLostError(WorkFailedError):
    """The connection broke, and went on breaking."""


class NotDataError(DataError):
    """The mirror sent something else than data: an error page, a login form."""


class TruncatedError(DataError):
    """The mirror's file ends before the length that it announces."""


class WrongLengthError(DataError):
    """The mirror announces or sends another length than the file has."""


class WrongContentError(DataError):
    """The file has other content than datasets.yaml means."""


class BrokenError(Exception):
    """An attempt that ended early; another may go on from there."""

    def __init__(self, error: WorkFailedError | DataError, *, stale: bool = False) -> None:
        super().__init__(str(error))
        self.error = error  # what to raise when no other attempt is made
        self.stale = stale  # whether what is there already has to go first
