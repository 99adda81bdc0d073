"""Where lagbench is published: all addresses, in one place.

An empty one is not set yet. Texts that need it then say so.
"""

from __future__ import annotations

REPOSITORY = ""
"""The repository, which is cloned and where faults are reported."""

ARCHIVES = ""
"""Folder of the released archives of data sets; LAGBENCH_RELEASES names another."""

DOCUMENTATION = ""
"""The site that is made of docs/."""

SETTINGS = "lagbench/addresses.py"
"""This file, for texts."""


def describe(address: str) -> str:
    """Return an address, or that it is not set.

    >>> describe("")
    'not set in lagbench/addresses.py'
    """
    return address or f"not set in {SETTINGS}"
