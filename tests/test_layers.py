"""Imports go one way, without cycles, and light commands stay light."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import lagbench

PACKAGES = {"lagbench": Path(lagbench.__file__).parent}
for _name in ("generators", "baselines"):
    try:
        _file = importlib.import_module(f"lagbench.{_name}").__file__
    except ModuleNotFoundError:
        continue
    PACKAGES[f"lagbench.{_name}"] = Path(str(_file)).parent

HEAVY = ("taichi", "torch", "matplotlib", "xarray", "pandas", "scipy", "dask", "netCDF4", "numpy")

FILES = (
    "errors",
    "atomic",
    "working_copy",
    "layout",
    "checksums",
    "scenario_ids",
    "yamlfile",
    "limits",
    "variables",
    "identity",
    "scenario_file",
    "format",
    "grid",
)
"""Modules below everything else, which know files and arrays but no split."""

REGISTRY = (
    *FILES,
    "registry",
    "remedy",
    "locating",
    "locking",
    "statistics",
    "manifest",
    "extras",
    "store",
    "plugins",
    "progress",
    "pool",
)
"""The next layer, which knows splits; it may use the first."""

ABOVE_SCORES = (
    *REGISTRY,
    "metrics",
    "submission",
    "baselines",
    *("scoring", "exam", "score_card", "score_file", "score_tables", "published", "floors", "comparison"),
    *("markdown", "recording", "palette", "canvas", "panels"),
)
"""What scripts that regenerate tables and figures may use: the scorer and the plots too, never the solver."""

ALLOWED = {
    "lagbench.errors": (),
    **{f"lagbench.{name}": FILES for name in FILES[1:]},
    **{f"lagbench.{name}": REGISTRY for name in REGISTRY[len(FILES) :]},
    "lagbench.generators": (*REGISTRY, "generators"),
    "lagbench.metrics": (*REGISTRY, "metrics"),
    "lagbench.baselines": (*REGISTRY, "metrics", "submission", "baselines"),
    "lagbench.baselines.reproduce": ABOVE_SCORES,
}
"""What a module or package may import of lagbench, by first name; others may import all but the CLI."""


def modules() -> dict[str, Path]:
    """Return the dotted name and file of every module of ours."""
    found = {}
    for package, folder in PACKAGES.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            name = ".".join((package, *parts)).removesuffix(".__init__")
            if package == "lagbench" and name.split(".")[1:2] in (["generators"], ["baselines"]):
                continue  # a wheel holds them inside; they are listed once
            found[name] = path
    return found


def imports(name: str, path: Path) -> Iterator[str]:
    """Yield the dotted names that a module imports, those for type checkers left out."""
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            pending += node.orelse
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from _targets(name, path, node)
        pending += ast.iter_child_nodes(node)


def _targets(name: str, path: Path, node: ast.ImportFrom) -> Iterator[str]:
    base = (node.module or "").split(".") if node.module else []
    if node.level:
        here = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
        base = here[: len(here) - node.level + 1] + base
    for alias in node.names:
        yield ".".join((*base, alias.name))


GRAPH = {name: set(imports(name, path)) for name, path in modules().items()}


def ours(target: str) -> str | None:
    """Return the module of ours that an imported name lives in, if it is one."""
    parts = target.split(".")
    for length in range(len(parts), 0, -1):
        candidate = ".".join(parts[:length])
        if candidate in GRAPH:
            return candidate
    return None


def edges() -> dict[str, set[str]]:
    """Return which module of ours imports which."""
    return {
        name: {found for target in targets if (found := ours(target)) and found != name}
        for name, targets in GRAPH.items()
    }


def test_the_graph_sees_the_package() -> None:
    """The reader finds modules, relative imports across packages and lazy imports in functions."""
    found = edges()
    assert "lagbench.errors" in found["lagbench.data.registry"]
    assert "lagbench.data.writer" in found["lagbench.generators.simulate"]
    assert "lagbench.generators.batch" in found["lagbench.generators.simulate"]
    assert "lagbench.make.generate" in found["lagbench.cli.data"]


@pytest.mark.parametrize("name", sorted(GRAPH))
def test_imports_stay_below(name: str) -> None:
    """A module imports from its own layer and those below, as ALLOWED states them."""
    parts = name.split(".")
    rule = next((ALLOWED[key] for k in (3, 2) if (key := ".".join(parts[:k])) in ALLOWED), None)
    targets = edges()[name] - {"lagbench"}
    if not name.startswith(("lagbench.cli", "lagbench.__main__")):
        assert not [target for target in targets if target.startswith("lagbench.cli")]
    if rule is not None:
        assert not [target for target in targets if target.split(".")[1] not in rule]


def test_no_import_cycle() -> None:
    """Following imports never leads back: modules can be put in a line."""
    left = {name: set(targets) for name, targets in edges().items()}
    while left:
        free = [name for name, targets in left.items() if not targets & left.keys()]
        assert free, f"a cycle among {sorted(left)}"
        for name in free:
            del left[name]


def test_nobody_imports_the_bare_folders() -> None:
    """The folders are lagbench.generators and lagbench.baselines; the bare names belong to others on PyPI."""
    for name, targets in GRAPH.items():
        bare = [t for t in targets if t.split(".")[0] in {"generators", "baselines", "leaderboard"}]
        assert not bare, name


def loaded_by(code: str) -> set[str]:
    """Return the heavy modules that a piece of code loads in a fresh interpreter."""
    tail = f"\nimport sys\nprint(*sorted(set({HEAVY!r}) & sys.modules.keys()))"
    command = [sys.executable, "-c", code + tail]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return set(done.stdout.splitlines()[-1].split())


RUN = """
from typer.testing import CliRunner
from lagbench.cli.app import app
assert CliRunner().invoke(app, {}).exit_code == 0
"""


@pytest.mark.parametrize(
    ("code", "allowed"),
    [
        ("import lagbench", set()),
        ("import lagbench; lagbench.generate", {"numpy"}),
        ("import lagbench.cli.app", set()),
        (RUN.format(["--help"]), set()),
        (RUN.format(["generate", "--help"]), set()),
        (RUN.format(["--version"]), set()),
        (RUN.format(["cite", "cavity"]), set()),
        (RUN.format(["list"]), {"numpy"}),
        (RUN.format(["info", "cavity"]), {"numpy"}),
        (RUN.format(["generate", "fluid", "--size", "tiny", "--dry-run"]), {"numpy"}),
    ],
)
def test_light_things_stay_light(code: str, allowed: set[str]) -> None:
    """Importing lagbench and asking for help load no numerical library; planning loads NumPy only."""
    assert loaded_by(code) <= allowed
