"""Which module imports which: the graph that journeys.py measures and tests walk.

It is read from the source; nothing is imported. Imports in functions count, and so do,
if asked, those that only a type checker sees.
"""

from __future__ import annotations

import ast
import functools
import graphlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypeGuard

Graph = Mapping[str, set[str]]
"""The modules that each module imports, by dotted name."""

ImportStatement = ast.Import | ast.ImportFrom

Modules = dict[str, Path]
"""The file of each module, by its dotted name."""


def package_modules(root: Path) -> Modules:
    """Return the file of every module of lagbench, by its dotted name.

    A package has the name of its folder.

    Args:
        root: folder of the clone.
    """
    # Path.rglob does not follow the links that hold generators and baselines.
    folders = {
        "lagbench": root / "lagbench",
        "lagbench.generators": root / "generators",
        "lagbench.baselines": root / "baselines",
    }
    paths = {}
    for prefix, folder in folders.items():
        paths.update(list_modules(folder, prefix))
    return paths


def list_modules(folder: Path, prefix: str) -> Modules:
    """Return the file of every module below a folder, by its dotted name."""
    paths = {}
    for path in folder.rglob("*.py"):
        inner_path = path.relative_to(folder)
        parts = inner_path.with_suffix("").parts
        name = ".".join((prefix, *parts))
        paths[name.removesuffix(".__init__")] = path
    return paths


def imported_names(name: str, path: Path, *, for_types: bool) -> Iterator[str]:
    """Yield the dotted names that a module imports.

    Args:
        name: dotted name of the module.
        path: its file.
        for_types: whether imports under ``if TYPE_CHECKING`` count.
    """
    package_parts = name.split(".")
    if path.name != "__init__.py":
        package_parts.pop()
    source = path.read_text(encoding="utf-8")
    for statement, is_for_types in _import_statements(source):
        if is_for_types and not for_types:
            continue
        if isinstance(statement, ast.Import):
            for alias in statement.names:
                yield alias.name
        else:
            base = _base_of(statement, package_parts)
            for alias in statement.names:
                yield f"{base}.{alias.name}"


# Parsing takes most of the time, and both graphs need it.
@functools.cache
def _import_statements(source: str) -> list[tuple[ImportStatement, bool]]:
    """Return the imports of a source, and whether only a type checker sees them."""
    module = ast.parse(source)
    statements: list[tuple[ImportStatement, bool]] = []
    pending: list[tuple[ast.AST, bool]] = [(module, False)]
    while pending:
        node, is_for_types = pending.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            statements.append((node, is_for_types))
        elif _is_for_types(node):
            for statement in node.body:
                pending.append((statement, True))
            for statement in node.orelse:
                pending.append((statement, is_for_types))
        elif not isinstance(node, ast.expr):  # no expression holds a statement
            for child in ast.iter_child_nodes(node):
                pending.append((child, is_for_types))
    return statements


def _is_for_types(node: ast.AST) -> TypeGuard[ast.If]:
    """Tell whether a statement is ``if TYPE_CHECKING``."""
    if not isinstance(node, ast.If):
        return False
    return ast.unparse(node.test) in {"TYPE_CHECKING", "typing.TYPE_CHECKING"}


def _base_of(node: ast.ImportFrom, package_parts: list[str]) -> str:
    """Return the dotted name between ``from`` and ``import``, made absolute."""
    parts = []
    if node.level:
        # One dot names the package itself, each further one its parent.
        part_count = len(package_parts) - node.level + 1
        parts += package_parts[:part_count]
    if node.module:
        parts.append(node.module)
    return ".".join(parts)


def import_graph(paths: Mapping[str, Path], *, for_types: bool) -> Graph:
    """Return which of some modules imports which others of them."""
    graph = {}
    for name, path in paths.items():
        modules = set()
        for target in imported_names(name, path, for_types=for_types):
            module = target
            # The last words of a target may name what the module holds.
            while module and module not in paths:
                module = module.rpartition(".")[0]
            modules.add(module)
        graph[name] = modules - {"", name}
    return graph


def longest_chains(graph: Graph) -> dict[str, list[str]]:
    """Return the longest chain of imports that begins with each module.

    Raises:
        graphlib.CycleError: following imports leads back to a module.
    """
    # sorted, so that of two chains of one length always the same is told
    imports = {}
    for name in graph:
        imports[name] = sorted(graph[name])
    chains: dict[str, list[str]] = {}
    order = graphlib.TopologicalSorter(imports)
    for name in order.static_order():
        longest: list[str] = []
        for imported in imports[name]:
            chain = chains[imported]
            if len(chain) > len(longest):
                longest = chain
        chains[name] = [name, *longest]
    return chains
