"""Bit-reproducible particle data sets and benchmarks for neural surrogates.

>>> import lagbench
>>> lagbench.list_splits()[:3]
('cavity', 'cavity-3d', 'curl-noise')

Importing lagbench loads nothing else; each name below loads its module on first use.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lagbench.baselines.predict import predict
    from lagbench.baselines.train import train
    from lagbench.board.submit import submit
    from lagbench.exchange.adoption import adopt
    from lagbench.figures.animate import animate
    from lagbench.figures.pictures import plot
    from lagbench.make.generate import generate
    from lagbench.make.verify import verify
    from lagbench.scoring.compare import compare
    from lagbench.scoring.score import score
    from lagbench.store.dataset import list_splits, load_manifest, open_split
    from lagbench.store.windows import windows

    from . import errors, submission
    from .submission import template, validate

__all__ = [
    "__version__",
    "adopt",
    "animate",
    "compare",
    "errors",
    "generate",
    "list_splits",
    "load_manifest",
    "open_split",
    "plot",
    "predict",
    "score",
    "submission",
    "submit",
    "template",
    "train",
    "validate",
    "verify",
    "windows",
]

_MODULES = {
    "open_split": "store.dataset",
    "list_splits": "store.dataset",
    "load_manifest": "store.dataset",
    "windows": "store.windows",
    "generate": "make.generate",
    "verify": "make.verify",
    "template": "submission",
    "validate": "submission",
    "score": "scoring.score",
    "compare": "scoring.compare",
    "train": "baselines.train",
    "predict": "baselines.predict",
    "submit": "board.submit",
    "plot": "figures.pictures",
    "animate": "figures.animate",
    "adopt": "exchange.adoption",
}

_PACKAGES = ("errors", "exchange", "metrics", "submission", "torch")
"""Public modules; ``import lagbench`` is enough to use them."""

__version__: str


def __getattr__(name: str) -> object:
    """Load a public name from its module on first use (PEP 562)."""
    value: object
    if name == "__version__":
        from importlib.metadata import version

        value = version("lagbench")
    elif name in _PACKAGES:
        value = importlib.import_module(f".{name}", __name__)
    elif name in _MODULES:
        module = importlib.import_module(f".{_MODULES[name]}", __name__)
        value = getattr(module, name)
    else:
        message = f"module {__name__!r} has no attribute {name!r}"
        # with name and module Python asks "Did you mean ...?"
        raise AttributeError(message, name=name, obj=sys.modules[__name__])
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, also those that are not loaded yet, and no others."""
    special_names = [name for name in globals() if name.startswith("__")]
    return sorted({*special_names, *__all__, *_PACKAGES})
