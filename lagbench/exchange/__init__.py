"""Data sets in other formats and from elsewhere: export, import, adopt, download.

>>> from lagbench import exchange
>>> exchange.__all__
['adopt', 'download', 'export', 'import_split']

Each name loads its module on first use. docs/exchange.md has the formats.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .adoption import adopt, import_split
    from .downloading import download
    from .exporting import export

__all__ = ["adopt", "download", "export", "import_split"]

_HOMES = {
    "adopt": "adoption",
    "download": "downloading",
    "export": "exporting",
    "import_split": "adoption",
}


def __getattr__(name: str) -> object:
    """Load a public name from its module on first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
