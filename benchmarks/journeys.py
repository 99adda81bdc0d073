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

PACKAGE = Path(lagbench.__file__).parent
ROOTS = {
    PACKAGE: "lagbench",
    PACKAGE / "generators": "lagbench.generators",
    PACKAGE / "baselines": "lagbench.baselines",
}
MOST = {"generate": 40, "score": 42, "verify": 26}
"""What a newcomer should at most have to open (issue: fewer rooms)."""


def sources() -> dict[str, Path]:
    """Return the dotted name and file of every module; rglob does not follow the links
    inside the package.
    """
    found = {}
    for folder, name in ROOTS.items():
        for path in folder.rglob("*.py"):
            found[".".join((name, *path.relative_to(folder).with_suffix("").parts))] = (
                path
            )
    return found


def journey(words: list[str]) -> tuple[int, int]:
    """Run a command; return the files whose functions ran, and the functions."""
    from lagbench.__main__ import app

    ours = {str(path.resolve()) for path in sources().values()}
    known: dict[str, str] = {}
    ran: set[tuple[str, int]] = set()

    def watch(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if (
            event != "call"
            or code.co_name in {"<module>", "<lambda>"}
            or code.co_name.startswith("<")
        ):
            return
        file = known.setdefault(code.co_filename, os.path.realpath(code.co_filename))
        # Class bodies are code objects too; functions have local variables of their
        # own.
        if file in ours and code.co_flags & 0x02:
            ran.add((file, code.co_firstlineno))

    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        sys.setprofile(watch)
        try:
            app(words, standalone_mode=False)
        except SystemExit as done:
            if done.code:
                raise
        finally:
            sys.setprofile(None)
    return len({file for file, _ in ran}), len(ran)


def imported(name: str, path: Path, known: dict[str, Path]) -> set[str]:
    """Return the modules of ours that a module imports, for type checkers too."""
    if path.name == "__init__.py":
        package = name
    else:
        package = name.rpartition(".")[0]
    package = package.removesuffix(".__init__")
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
            else:
                above = []
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                for candidate in (f"{base}.{alias.name}", base, f"{base}.__init__"):
                    if candidate in known and candidate != name:
                        found.add(candidate)
                        break
    return found


def longest_chain(known: dict[str, Path]) -> int:
    """Return the number of modules in the longest chain of imports."""
    graph = {name: imported(name, path, known) for name, path in known.items()}
    depth: dict[str, int] = {}

    def measure(name: str) -> int:
        if name not in depth:
            depth[name] = 1  # a cycle, were there one, would end here
            depth[name] = 1 + max((measure(other) for other in graph[name]), default=0)
        return depth[name]

    return max(measure(name) for name in graph)


def main() -> int:
    """Print both tables."""
    with tempfile.TemporaryDirectory() as folder:
        root = str(Path(folder, "data"))
        # a generation notes there how fast it was
        os.environ["LAGBENCH_CACHE"] = folder
        predictions = str(Path(folder, "p.nc"))
        where = ["--split", "cavity", "--size", "tiny", "--root", root]
        commands = {
            "generate": ["generate", *where],
            "verify": ["verify", *where],
            "template": ["template", *where, "-o", predictions],
            "validate": ["validate", predictions, "--root", root],
            "score": ["score", predictions, "--root", root],
            "info": ["info", "cavity"],
        }
        print("| command | files | functions | at most |\n|---|---:|---:|---:|")
        over = []
        for name, words in commands.items():
            files, functions = journey(words)
            print(f"| `{name}` | {files} | {functions} | {MOST.get(name, '')} |")
            if files > MOST.get(name, files):
                over.append(name)
    known = sources()
    text = [path.read_text(encoding="utf-8") for path in known.values()]
    lines = sum(part.count("\n") for part in text)
    comments = sum(
        token.type == tokenize.COMMENT
        for part in text
        for token in tokenize.generate_tokens(io.StringIO(part).readline)
    )
    print(
        f"\n{len(text)} files, {lines} lines, {100 * comments / lines:.1f} comments "
        f"per 100 lines;",
        end=" ",
    )
    print(f"longest chain of imports {longest_chain(known)}")
    if over:
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
