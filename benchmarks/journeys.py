"""How many rooms lie between a command and its effect.

    python benchmarks/journeys.py

Runs each command in this process on a made-up root and prints in how many files of ours
a function ran, and how many functions: class bodies, imports and child processes are
left out. Then what the source says: files, lines, comments, the longest chain of
imports. Its table stands in CONTRIBUTING.md.
"""

from __future__ import annotations

import ast
import io
import os
import sys
import tempfile
import tokenize
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import FrameType

import lagbench
from lagbench.__main__ import app

PACKAGE = Path(lagbench.__file__).parent
ROOTS = {
    PACKAGE: "lagbench",
    PACKAGE / "generators": "lagbench.generators",
    PACKAGE / "baselines": "lagbench.baselines",
}
"""Folders of modules; rglob does not follow the links inside the package."""

MOST_FILES = {"generate": 40, "score": 42, "verify": 26}
"""Files that a newcomer should at most have to open, by command."""

OWN_LOCALS = 0x02  # flag of code objects of functions; class bodies lack it


def module_paths() -> dict[str, Path]:
    """Return the file of every module by its dotted name."""
    paths = {}
    for folder, name in ROOTS.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            paths[".".join((name, *parts))] = path
    return paths


def trace_command(words: list[str]) -> tuple[int, int]:
    """Run a command; return how many files and functions of the package ran."""
    package_files = {str(path.resolve()) for path in module_paths().values()}
    real_paths: dict[str, str] = {}
    functions: set[tuple[str, int]] = set()

    def watch(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        is_named = not code.co_name.startswith("<")  # as <module> and <lambda>
        if event != "call" or not is_named:
            return
        if code.co_filename not in real_paths:
            real_paths[code.co_filename] = os.path.realpath(code.co_filename)
        file = real_paths[code.co_filename]
        if file in package_files and code.co_flags & OWN_LOCALS:
            functions.add((file, code.co_firstlineno))

    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        sys.setprofile(watch)
        try:
            app(words, standalone_mode=False)
        except SystemExit as done:
            if done.code:
                raise
        finally:
            sys.setprofile(None)
    return len({file for file, _ in functions}), len(functions)


def imported_modules(name: str, path: Path, paths: dict[str, Path]) -> set[str]:
    """Return the package's modules that a module imports, for type checkers too."""
    package = name.rpartition(".")[0]
    if path.name == "__init__.py":
        package = name.removesuffix(".__init__")

    modules = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if not isinstance(node, ast.ImportFrom):
            continue
        base_parts = []
        if node.level:
            package_parts = package.split(".")
            base_parts = package_parts[: len(package_parts) - node.level + 1]
        if node.module:
            base_parts.append(node.module)
        base = ".".join(base_parts)
        for alias in node.names:
            for candidate in (f"{base}.{alias.name}", base, f"{base}.__init__"):
                if candidate in paths and candidate != name:
                    modules.add(candidate)
                    break
    return modules


def longest_chain(paths: dict[str, Path]) -> int:
    """Return the number of modules in the longest chain of imports."""
    graph = {}
    for name, path in paths.items():
        graph[name] = imported_modules(name, path, paths)
    depths: dict[str, int] = {}

    def depth(name: str) -> int:
        if name not in depths:
            depths[name] = 1  # a cycle, were there one, would end here
            below = [depth(imported) for imported in graph[name]]
            depths[name] = 1 + max(below, default=0)
        return depths[name]

    return max(depth(name) for name in graph)


def count_comments(text: str) -> int:
    """Return the number of comments in the text of a module."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(token.type == tokenize.COMMENT for token in tokens)


def main() -> int:
    """Print the files behind each command, and the size of the package."""
    too_long = []
    with tempfile.TemporaryDirectory() as folder:
        # a generation notes its speed there
        os.environ["LAGBENCH_CACHE"] = folder
        root = str(Path(folder, "data"))
        predictions = str(Path(folder, "p.nc"))
        data_set = ["--split", "cavity", "--size", "tiny", "--root", root]
        commands = {
            "generate": ["generate", *data_set],
            "verify": ["verify", *data_set],
            "template": ["template", *data_set, "-o", predictions],
            "validate": ["validate", predictions, "--root", root],
            "score": ["score", predictions, "--root", root],
            "info": ["info", "cavity"],
        }
        print("| command | files | functions | at most |\n|---|---:|---:|---:|")
        for name, words in commands.items():
            files, functions = trace_command(words)
            print(f"| `{name}` | {files} | {functions} | {MOST_FILES.get(name, '')} |")
            if files > MOST_FILES.get(name, files):
                too_long.append(name)

    paths = module_paths()
    line_count = 0
    comment_count = 0
    for path in paths.values():
        text = path.read_text(encoding="utf-8")
        line_count += text.count("\n")
        comment_count += count_comments(text)
    comments_per_100 = 100 * comment_count / line_count
    print(
        f"\n{len(paths)} files, {line_count} lines, {comments_per_100:.1f} comments "
        f"per 100 lines; longest chain of imports {longest_chain(paths)}"
    )
    return 1 if too_long else 0


if __name__ == "__main__":
    raise SystemExit(main())
