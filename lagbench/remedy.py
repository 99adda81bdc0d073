"""What makes a data set whole again, in words for the user."""

from __future__ import annotations

from .registry import Size

__all__ = ["remedy"]


def remedy(size: Size, *options: str) -> str:
    """Return what makes a data set whole again; options narrow down what is simulated.

    >>> from lagbench.registry import load
    >>> remedy(load().size("cavity", "tiny"), "--subset test")
    'lagbench generate --split cavity --size tiny --subset test'
    """
    if size.simulated:
        return " ".join((f"lagbench generate --split {size.split} --size {size.name}", *options))
    return "remove the folder and make the local split again: lagbench adopt, or lagbench import"
