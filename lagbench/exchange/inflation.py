"""Files that unpack to far more than they hold: refused before they fill the memory.

Positions of particles that move compress by a factor of two or so, of particles at rest by a
hundred. A file that promises more than that, and much of it, was made to do harm, or is damaged.
"""

from __future__ import annotations

from lagbench.errors import UnreadableFileError

__all__ = ["check_inflation"]

HARMLESS = 1 << 28
"""Bytes that may come of anything."""

MOST = 200
"""Times its own length that a larger array may unpack to."""


def check_inflation(where: str, *, packed: int, unpacked: int) -> None:
    """Refuse an array that is far larger than what a file holds of it."""
    if unpacked > max(HARMLESS, MOST * packed):
        raise UnreadableFileError(
            "the file would unpack to far more than it holds",
            where=where,
            expected=f"at most {MOST} times {packed} bytes",
            got=f"{unpacked} bytes",
        )
