"""The examples in docstrings print what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import lagbench

PACKAGE = Path(lagbench.__file__).parent


def modules_with_examples() -> list[str]:
    """Names of the modules whose text holds an example."""
    paths = list(PACKAGE.rglob("*.py"))
    for linked in ("generators", "baselines"):
        paths += (PACKAGE / linked).rglob("*.py")
    names = []
    for path in sorted(set(paths)):
        if ">>> " not in path.read_text(encoding="utf-8"):
            continue
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        if parts[-1] == "__init__":
            parts = parts[:-1]
        names.append(".".join(parts))
    return names


def test_the_examples_in_docstrings_print_what_they_say() -> None:
    example_count = 0
    failed = []
    for name in modules_with_examples():
        results = doctest.testmod(importlib.import_module(name))
        example_count += results.attempted
        if results.failed:
            failed.append(name)
    assert not failed
    assert example_count > 50
