"""Errors that a user of the command line can meet have where, expected, got and fix."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

import lagbench
from lagbench import errors
from lagbench.errors import LagbenchError
from lagbench.store import objects

PACKAGE = Path(lagbench.__file__).parent
PARTS = {"where", "expected", "got", "fix"}

KINDS = {
    name
    for module in (errors, objects)
    for name, value in vars(module).items()
    if isinstance(value, type) and issubclass(value, LagbenchError)
}
"""Names of the errors that the package raises."""

COMPLETED_ELSEWHERE = {
    # each of several mistakes in one message has its own
    "errors.py": 1,
    # who catches them adds the file and how to mend it
    "data/hdf5.py": 4,
    "data/registry.py": 2,
    "data/scenario.py": 5,
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
    "baselines/hybrid.py": 1,
    "baselines/rollout.py": 1,
    "baselines/torch_grid.py": 1,
    "data/checksums.py": 3,
    "data/statistics.py": 1,
    "data/writer.py": 3,
    "generators/driver.py": 1,
    "metrics/aggregate.py": 4,
    "metrics/significance.py": 5,
    "submission/predictions.py": 1,
    # a tool of maintainers
    "scoring/measure_references.py": 3,
    # nobody is there to read them
    "work/cluster.py": 1,
    "work/machine.py": 1,
}
"""Errors that no user of the command line meets, by file."""


def find_modules() -> Iterator[Path]:
    """Yield the modules of the package; some of its folders are links."""
    for folder, _, names in os.walk(PACKAGE, followlinks=True):
        for name in sorted(names):
            if name.endswith(".py"):
                yield Path(folder, name)


MODULES = {path.relative_to(PACKAGE).as_posix(): path for path in find_modules()}


def name_of_call(call: ast.Call) -> str:
    """Return the last name of what is called: that of errors.UsageError(...) too."""
    if isinstance(call.func, ast.Attribute):
        return call.func.attr
    if isinstance(call.func, ast.Name):
        return call.func.id
    return ""


def incomplete_errors(path: Path) -> Iterator[str]:
    """Yield line and text of the errors of a module that lack a part."""
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call):
            continue
        kind = name_of_call(node)
        names = {keyword.arg for keyword in node.keywords}
        is_error = kind in KINDS or kind == "PackageMetricError"
        if is_error and None not in names and PARTS - names:
            yield f"{path.name}:{node.lineno}: {ast.unparse(node.args[0])}"


@pytest.mark.parametrize("name", sorted(MODULES))
def test_errors_have_all_parts(name: str) -> None:
    """Where one lacks a part, another place adds it, or no user meets it."""
    allowed = COMPLETED_ELSEWHERE | INTERNAL
    incomplete = list(incomplete_errors(MODULES[name]))
    assert len(incomplete) == allowed.get(name, 0), incomplete


def test_listed_modules_exist() -> None:
    """A list that names a module of another day would hide nothing, but mislead."""
    assert COMPLETED_ELSEWHERE.keys() | INTERNAL.keys() <= MODULES.keys()
    assert {"cli/program.py", "generators/multimaterial.py"} <= MODULES.keys()


def test_errors_named_by_their_module_are_found(tmp_path: Path) -> None:
    """Both ways of naming a class are."""
    path = tmp_path / "module.py"
    path.write_text("raise errors.UsageError('no')\nraise UsageError('no')\n")
    assert len(list(incomplete_errors(path))) == 2


def test_a_hint_of_many_names_is_short() -> None:
    """Above thirty names, the nearest are listed, or else the first and a count."""
    names = [f"name{number:03d}" for number in range(200)]
    hint = errors.suggest_name("zzzqqq", names)
    assert hint.endswith("name004 and 195 more")
    assert "did you mean 'name001'?" in errors.suggest_name("name01", ["name001"])
    for name in ("zzzqqq", "name01"):
        assert len(errors.suggest_name(name, names)) < 120
    assert errors.suggest_name("zzzqqq", names[:30]).count("name") == 30
