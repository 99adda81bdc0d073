"""Imports go one way, without cycles, and light commands stay light."""

from __future__ import annotations

import functools
import graphlib
import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import pytest

import lagbench
from benchmarks.import_graph import (
    Graph,
    import_graph,
    imported_names,
    list_modules,
    longest_chains,
    package_modules,
)

PACKAGE = Path(lagbench.__file__).parent
STUDIES = PACKAGE.parent / "studies"

LAYERS = (
    ("addresses", "errors", "atomic"),
    ("work",),
    ("data",),
    ("store",),
    ("generators", "metrics", "figures", "tensors", "torch"),
    ("submission",),
    ("make",),
    ("references",),
    ("exchange", "scoring", "design"),
    ("figures.report", "baselines", "models"),
    ("board",),
    ("cli", "__main__"),
)
"""The folders of the package, lowest first: each may import its own layer and those
before it. A dotted name is a folder that stands above the rest of its room. The studies
stand above them all, outside the package.
"""

NEVER = {
    "baselines": {"generators", "make"},
    "generators": {"metrics", "figures"},
    "metrics": {"figures", "generators"},
}
"""What stays apart although a layer would allow it: models learn from files, the solver
knows no score.
"""

PRODUCT_FOLDERS = (
    "lagbench",
    "generators",
    "baselines",
    "benchmarks",
    "studies",
    "validation",
)
"""Folders in which a class name has one meaning."""

LONGEST_CHAIN = 15
"""Modules in the longest chain of imports, at most."""

DRAWN = {"matplotlib", "PIL", "xarray", "taichi", "quadrants", "torch"}
HEAVY = {
    "taichi",
    "quadrants",
    "torch",
    "matplotlib",
    "xarray",
    "pandas",
    "scipy",
    "dask",
    "netCDF4",
    "numpy",
}


# parsed by the test that asks first, not by every process that collects tests
@functools.cache
def edges(*, for_types: bool = False) -> Graph:
    """Return which module of the package and the studies imports which.

    No module of the package imports generators or baselines by the bare name, and none
    imports the studies, which are no part of the wheel.

    Args:
        for_types: whether imports for type checkers count too.
    """
    modules = package_modules(PACKAGE.parent)
    for name, path in modules.items():
        targets = imported_names(name, path, for_types=for_types)
        heads = {target.split(".")[0] for target in targets}
        hidden = {"generators", "baselines", "leaderboard", "studies"}
        assert not heads & hidden, name

    modules.update(list_modules(STUDIES, "studies"))
    return import_graph(modules, for_types=for_types)


@pytest.mark.slow
def test_imports_stay_below() -> None:
    """A module imports from its own layer and those below, and never from what stays
    apart.

    Relative imports across packages, and those in functions, are seen.
    """
    assert "lagbench.errors" in edges()["lagbench.data.registry"]
    assert {"lagbench.data.writer", "lagbench.generators.batch"} <= edges()[
        "lagbench.generators.simulate"
    ]
    assert "lagbench.make.generate" in edges()["lagbench.cli.generate"]
    layer_numbers = {
        folder: number for number, layer in enumerate(LAYERS) for folder in layer
    }

    def layer_of(module: str) -> int:
        parts = module.split(".")[1:]
        return layer_numbers.get(".".join(parts[:2]), layer_numbers[parts[0]])

    wrong = []
    for name, targets in edges().items():
        if name == "lagbench" or name.split(".")[0] == "studies":
            continue  # the studies are the top layer: they may import everything
        room = name.split(".")[1]
        for target in targets - {"lagbench"}:
            is_apart = target.split(".")[1] in NEVER.get(room, ())
            if is_apart or layer_of(target) > layer_of(name):
                wrong.append(f"{name} imports {target}")
    assert not wrong


def test_no_import_cycle() -> None:
    """Following imports never leads back: modules can be put in a line.

    This holds for imports of type checkers too: what is read first is read alone.
    """
    for for_types in (False, True):
        order = graphlib.TopologicalSorter(edges(for_types=for_types))
        order.prepare()


def test_no_chain_of_imports_is_long() -> None:
    """A reader who follows imports from any module of the package ends soon.

    Imports for type checkers count: a reader follows them too.
    """
    chains = longest_chains(edges(for_types=True))
    long_chains = []
    for module, chain in chains.items():
        if not module.startswith("studies") and len(chain) > LONGEST_CHAIN:
            long_chains.append(chain)
    assert len(chains["lagbench.data.registry"]) > 1
    assert not long_chains


def test_imports_for_type_checkers_count_separately(tmp_path: Path) -> None:
    """A chain over an import for type checkers is longer by it; a cycle is refused."""
    top = tmp_path / "top.py"
    top.write_text("from . import middle\n", encoding="utf-8")
    middle = tmp_path / "middle.py"
    middle.write_text(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n"
        "    from .bottom import Name\n",
        encoding="utf-8",
    )
    bottom = tmp_path / "bottom.py"
    bottom.write_text("Name = int\n", encoding="utf-8")

    modules = list_modules(tmp_path, "room")
    running = longest_chains(import_graph(modules, for_types=False))
    reading = longest_chains(import_graph(modules, for_types=True))
    assert running["room.top"] == ["room.top", "room.middle"]
    assert reading["room.top"] == ["room.top", "room.middle", "room.bottom"]

    bottom.write_text("def work():\n    from . import top\n", encoding="utf-8")
    with pytest.raises(graphlib.CycleError):
        longest_chains(import_graph(modules, for_types=True))


def test_no_two_classes_have_one_name() -> None:
    """A reader who meets a class in two places is looking at one class."""
    modules_of = defaultdict(set)
    for folder in PRODUCT_FOLDERS:
        for path in (PACKAGE.parent / folder).rglob("*.py"):
            source = path.read_text(encoding="utf-8")
            for name in re.findall(r"^class (\w+)", source, re.MULTILINE):
                modules_of[name].add(path.resolve())
    twice = {}
    for name, modules in modules_of.items():
        if len(modules) > 1:
            twice[name] = sorted(modules)
    assert "Registry" in modules_of
    assert not twice


@pytest.mark.slow
def test_a_script_beside_the_clone_imports_the_package(tmp_path: Path) -> None:
    """A folder named lagbench beside a script, the clone, does not hide the installed
    package.
    """
    # the clone: no package by itself
    (tmp_path / "lagbench" / "docs").mkdir(parents=True)
    script = tmp_path / "script.py"
    script.write_text(
        "import lagbench; print(lagbench.list_splits()[0])", encoding="utf-8"
    )
    # With and without -e an install comes to a path entry after the script's own
    # folder.
    where = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run(
        [sys.executable, str(script)],
        env=where,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout.strip() == "cavity"


WRITING = ("import lagbench.data.writer",)
READING = (
    "import lagbench",
    "--help; leaderboard --help; --version",
    "import lagbench.figures.colours",
    "import lagbench; lagbench.generate; lagbench.windows",
    "generate --help; train --help; demo --help; cite cavity; list;"
    " info cavity; generate fluid --size tiny --dry-run",
    "import lagbench.metrics",
    "import lagbench.figures.plot, lagbench.figures.animate, lagbench.make.cards",
    "import lagbench.figures.report.report",
)
"""What one process does step by step: a later step may load what an earlier one may."""

DO_STEPS = """
import json, sys
loaded = []
for step in json.loads(sys.argv[1]):
    if step.startswith("import"):
        exec(step)
    else:
        from lagbench.cli.program import app
        for line in step.split("; "):
            assert app(line.split()) == 0, line
    loaded.append(sorted(sys.modules))
print(json.dumps(loaded))
"""
"""A step that does not import is commands, run one after the other."""


@pytest.fixture(scope="module")
def loaded_after() -> Callable[[str], set[str]]:
    """A function that returns the modules loaded after a step and those before it.

    A process does all steps that may follow each other: most of its time is the start.
    """
    # files that are there would be read
    empty = {
        **os.environ,
        "LAGBENCH_ROOT": str(PACKAGE / "none"),
    }

    @functools.cache
    def do_steps(steps: tuple[str, ...]) -> dict[str, set[str]]:
        command = [sys.executable, "-c", DO_STEPS, json.dumps(steps)]
        done = subprocess.run(
            command, env=empty, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        module_lists = json.loads(done.stdout.splitlines()[-1])
        loaded = {}
        for step, modules in zip(steps, module_lists, strict=True):
            loaded[step] = set(modules)
        return loaded

    def find_loaded(step: str) -> set[str]:
        steps = WRITING if step in WRITING else READING
        return do_steps(steps)[step]

    return find_loaded


@pytest.mark.parametrize(
    ("step", "forbidden"),
    [
        (READING[0], HEAVY | {"h5py", "pydantic"}),
        (READING[1], HEAVY),
        (READING[2], HEAVY - {"numpy"}),
        (READING[3], HEAVY - {"numpy"}),
        (READING[4], HEAVY - {"numpy"}),
        (READING[5], {"torch", "taichi", "xarray", "scipy", "netCDF4", "ot"}),
        (READING[6], DRAWN),
        (READING[7], {"matplotlib", "PIL", "taichi", "torch"}),
        (WRITING[0], {"xarray", "pandas", "netCDF4", "pydantic", "scipy", "dask"}),
    ],
)
def test_light_things_stay_light(
    step: str, forbidden: set[str], loaded_after: Callable[[str], set[str]]
) -> None:
    """Importing and asking for help load no numerical library, planning NumPy only, and
    so on.
    """
    assert loaded_after(step) & forbidden == set()
