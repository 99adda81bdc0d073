"""Errors that a user of the command line can meet have where, expected, got and fix."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import lagbench
from lagbench import errors
from lagbench.errors import LagbenchError
from lagbench.store import objects

PACKAGE = Path(lagbench.__file__).parent
PARTS = {"where", "expected", "got", "fix"}

ROOMS = (
    "baselines",
    "board",
    "cli",
    "data",
    "exchange",
    "figures",
    "make",
    "models",
    "scoring",
    "store",
    "submission",
    "work",
)
"""Folders of the package whose errors reach users of the command line."""

KINDS = {
    name
    for module in (errors, objects)
    for name, value in vars(module).items()
    if isinstance(value, type) and issubclass(value, LagbenchError)
}
"""Names of the errors that these folders raise."""

COMPLETED_ELSEWHERE = {
    # who catches them adds the file and how to mend it
    "data/hdf5.py": 3,
    "data/registry.py": 2,
    "data/scenario.py": 3,
    "make/inventory.py": 4,
    "store/fetch.py": 1,
    # the class itself adds the rest
    "scoring/package_metrics.py": 1,
}
"""Errors that lack a part where they are raised, by file."""

INTERNAL = {
    # arguments of functions that commands call with right ones
    "baselines/baseline.py": 1,
    "baselines/frame_model.py": 1,
    "baselines/graph.py": 3,
    "baselines/hybrid_projection.py": 1,
    "baselines/rollout.py": 1,
    "baselines/torch_grid.py": 1,
    "data/checksums.py": 4,
    "data/statistics.py": 1,
    "data/writer.py": 5,
    "submission/predictions.py": 1,
    # a tool of maintainers
    "scoring/measure_references.py": 3,
    # nobody is there to read them
    "work/cluster.py": 1,
    "work/machine.py": 1,
}
"""Errors that no user of the command line meets, by file."""


def incomplete_errors(path: Path) -> Iterator[str]:
    """Yield line and text of the errors of a module that lack a part."""
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            continue
        names = {keyword.arg for keyword in node.keywords}
        is_error = node.func.id in KINDS or node.func.id == "PackageMetricError"
        if is_error and None not in names and PARTS - names:
            yield f"{path.name}:{node.lineno}: {ast.unparse(node.args[0])}"


@pytest.mark.parametrize("room", ROOMS)
def test_errors_have_all_parts(room: str) -> None:
    """Where one lacks a part, another place adds it, or no user meets it."""
    allowed = COMPLETED_ELSEWHERE | INTERNAL
    for path in sorted((PACKAGE / room).rglob("*.py")):
        incomplete = list(incomplete_errors(path))
        name = path.relative_to(PACKAGE).as_posix()
        assert len(incomplete) == allowed.get(name, 0), incomplete
