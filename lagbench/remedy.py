"""What makes a data set whole again, in words for the user."""

from __future__ import annotations

from pathlib import Path

from .registry import Size
from .working_copy import url_of

__all__ = ["remedy"]


def remedy(size: Size, *options: str, root: Path | None = None) -> str:
    """Return what makes a data set whole again.

    Args:
        size: the data set.
        options: what narrows down what is simulated.
        root: folder of all data sets; of a working copy its store is named.

    >>> from lagbench.registry import load
    >>> remedy(load().size("cavity", "tiny"), "--subset test")
    'lagbench generate --split cavity --size tiny --subset test'
    """
    if size.simulated:
        place = [] if root is None else [f"--root {url_of(root) or root}"]
        return " ".join((f"lagbench generate --split {size.split} --size {size.name}", *options, *place))
    return "remove the folder and make the local split again: lagbench adopt, or lagbench import"
