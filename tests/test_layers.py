"""Imports go one way, without cycles, and light commands stay light."""

from __future__ import annotations

import ast
import functools
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

import lagbench

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
    ("exchange", "scoring"),
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

DRAWN = {"matplotlib", "PIL", "xarray", "taichi", "torch"}
HEAVY = {
    "taichi",
    "torch",
    "matplotlib",
    "xarray",
    "pandas",
    "scipy",
    "dask",
    "netCDF4",
    "numpy",
}


def imports(name: str, path: Path) -> Iterator[str]:
    """Yield the dotted names that a module imports, those for type checkers left
    out.
    """
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            pending += node.orelse
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            here = (
                name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
            )
            above = here[: len(here) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{base}.{alias.name}" for alias in node.names)
        pending += ast.iter_child_nodes(node)


# parsed by the test that asks first, not by every process that collects tests
@functools.cache
def edges() -> dict[str, set[str]]:
    """Return which module of ours imports which.

    No module of the package imports generators or baselines by the bare name, and none
    imports the studies, which are no part of the wheel.
    """
    graph = {}
    # Path.rglob does not follow the links that hold generators and baselines.
    for folder in (PACKAGE, PACKAGE / "generators", PACKAGE / "baselines"):
        for path in folder.rglob("*.py"):
            parts = path.relative_to(PACKAGE).with_suffix("").parts
            name = ".".join(("lagbench", *parts)).removesuffix(".__init__")
            graph[name] = set(imports(name, path))
            heads = {target.split(".")[0] for target in graph[name]}
            hidden = {"generators", "baselines", "leaderboard", "studies"}
            assert not heads & hidden, name

    for path in STUDIES.rglob("*.py"):
        parts = path.relative_to(STUDIES.parent).with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        graph[name] = set(imports(name, path))

    def module(target: str) -> str:
        while target and target not in graph:
            target = target.rpartition(".")[0]
        return target

    return {
        name: {module(target) for target in targets} - {"", name}
        for name, targets in graph.items()
    }


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
    """Following imports never leads back: modules can be put in a line."""
    left = {name: set(targets) for name, targets in edges().items()}
    while left:
        free = [name for name, targets in left.items() if not targets & left.keys()]
        assert free, f"a cycle among {sorted(left)}"
        for name in free:
            del left[name]


def test_no_chain_of_imports_is_long() -> None:
    """A reader who follows imports from any module of the package ends soon."""
    graph = edges()

    @functools.cache
    def chain_length(module: str) -> int:
        lengths_below = [chain_length(imported) for imported in graph[module]]
        return 1 + max(lengths_below, default=0)

    chain_lengths = {}
    for module in graph:
        if not module.startswith("studies"):
            chain_lengths[module] = chain_length(module)
    long_chains = {}
    for module, length in chain_lengths.items():
        if length > LONGEST_CHAIN:
            long_chains[module] = length
    assert max(chain_lengths.values()) > 1
    assert not long_chains


def test_no_two_classes_have_one_name() -> None:
    """A reader who meets a class in two places is looking at one class."""
    modules_of = defaultdict(set)
    for folder in PRODUCT_FOLDERS:
        for path in (PACKAGE.parent / folder).rglob("*.py"):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef):
                    modules_of[node.name].add(path.resolve())
    twice = {}
    for name, modules in modules_of.items():
        if len(modules) > 1:
            twice[name] = sorted(modules)
    assert "Registry" in modules_of
    assert not twice


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


@pytest.mark.parametrize(
    ("code", "forbidden"),
    [
        ("import lagbench", HEAVY | {"h5py", "pydantic"}),
        ("--help; leaderboard --help; --version", HEAVY),
        ("import lagbench; lagbench.generate; lagbench.windows", HEAVY - {"numpy"}),
        (
            "generate --help; train --help; demo --help; cite cavity; list;"
            " info cavity; generate fluid --size tiny --dry-run",
            HEAVY - {"numpy"},
        ),
        (
            "import lagbench.data.writer",
            {"xarray", "pandas", "h5py", "pydantic", "scipy", "dask"},
        ),
        (
            "import lagbench.metrics",
            {"torch", "taichi", "xarray", "scipy", "netCDF4", "ot"},
        ),
        (
            "import lagbench.figures.report.report",
            {"matplotlib", "PIL", "taichi", "torch"},
        ),
        (
            "import lagbench.figures.plot, lagbench.figures.animate\n"
            "import lagbench.make.cards",
            DRAWN,
        ),
        ("import lagbench.figures.colours", HEAVY - {"numpy"}),
    ],
)
def test_light_things_stay_light(code: str, forbidden: set[str]) -> None:
    """Importing and asking for help load no numerical library, planning NumPy only, and
    so on.

    Code that does not import is commands, run one after the other.
    """
    if not code.startswith("import"):
        calls = [
            f"assert CliRunner().invoke(app, {line.split()}).exit_code == 0"
            for line in code.split("; ")
        ]
        code = "\n".join(
            [
                "from typer.testing import CliRunner",
                "from lagbench.__main__ import app",
                *calls,
            ]
        )
    command = [sys.executable, "-c", code + "\nimport sys\nprint(*sys.modules)"]
    # files that are there would be read
    empty = {
        **os.environ,
        "LAGBENCH_ROOT": str(PACKAGE / "none"),
    }
    done = subprocess.run(
        command, env=empty, capture_output=True, text=True, check=True
    )
    assert not set(done.stdout.splitlines()[-1].split()) & forbidden
