"""How many rooms lie between a command and its effect.

    python benchmarks/journeys.py [--files]

Runs each command in this process on a made-up root and prints in how many files of ours
a function ran, and how many functions: class bodies, child processes and what runs
while a module is imported are left out. Then what the source says: files, lines,
comments, the longest chain of imports. With --files it also lists the files of each
command and the modules of the chain.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
import tempfile
import tokenize
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import FrameType

from import_graph import import_graph, longest_chains, package_modules

import lagbench
from lagbench.cli.program import app

CLONE = Path(lagbench.__file__).parents[1]
MODULES = package_modules(CLONE)

MOST_FILES = {"generate": 37, "score": 43, "verify": 23}
"""Files that a newcomer should at most have to open, by command."""

OWN_LOCALS = 0x02  # flag of code objects of functions; class bodies lack it


def trace_command(words: list[str]) -> Counter[Path]:
    """Run a command; return how many functions ran in each file of the package."""
    package_files = set()
    for path in MODULES.values():
        package_files.add(path.resolve())
    real_paths: dict[str, Path] = {}
    functions: set[tuple[Path, int]] = set()
    modules_at_import = 0  # modules that are being imported, each by the one before

    def watch(frame: FrameType, event: str, _: object) -> None:
        """Note a named function of the package; `sys.setprofile` calls this."""
        nonlocal modules_at_import
        code = frame.f_code
        if code.co_name == "<module>":
            if event == "call":
                modules_at_import += 1
            elif event == "return":
                modules_at_import -= 1
        is_named = not code.co_name.startswith("<")  # as <module> and <lambda>
        if event != "call" or not is_named or modules_at_import:
            return
        path = code.co_filename
        if path not in real_paths:
            real_path = os.path.realpath(path)
            real_paths[path] = Path(real_path)
        file = real_paths[path]
        if file in package_files and code.co_flags & OWN_LOCALS:
            function = (file, code.co_firstlineno)
            functions.add(function)

    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        sys.setprofile(watch)
        try:
            exit_code = app(words)
        finally:
            sys.setprofile(None)
    if exit_code:
        raise SystemExit(output.getvalue())
    return Counter(file for file, _ in functions)


def count_comments(text: str) -> int:
    """Return the number of comments in the text of a module."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(token.type == tokenize.COMMENT for token in tokens)


def print_files(name: str, functions: Counter[Path]) -> None:
    """Print the files of a command, each with the number of functions that ran."""
    print(f"\n{name}")
    clone = CLONE.resolve()
    for file in sorted(functions):
        inner_path = file.relative_to(clone)
        print(f"  {functions[file]:4d}  {inner_path}")


def main() -> int:
    """Print the files behind each command, and the size of the package."""
    parser = argparse.ArgumentParser(description="Count the files behind each command.")
    parser.add_argument("--files", action="store_true", help="list the files too")
    options = parser.parse_args()

    traces = {}
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
        for name, words in commands.items():
            traces[name] = trace_command(words)

    too_long = []
    print("| command | files | functions | at most |\n|---|---:|---:|---:|")
    for name, functions in traces.items():
        file_count = len(functions)
        most_files = MOST_FILES.get(name, "")
        print(f"| `{name}` | {file_count} | {functions.total()} | {most_files} |")
        if file_count > MOST_FILES.get(name, file_count):
            too_long.append(name)

    line_count = 0
    comment_count = 0
    for path in MODULES.values():
        text = path.read_text(encoding="utf-8")
        line_count += text.count("\n")
        comment_count += count_comments(text)
    comments_per_100 = 100 * comment_count / line_count
    graph = import_graph(MODULES, for_types=True)
    chains = longest_chains(graph)
    chain = max(chains.values(), key=len)
    print(
        f"\n{len(MODULES)} files, {line_count} lines, {comments_per_100:.1f} comments "
        f"per 100 lines; longest chain of imports {len(chain)}"
    )
    if options.files:
        for name, functions in traces.items():
            print_files(name, functions)
        print("\nlongest chain of imports", *chain, sep="\n  ")
    return 1 if too_long else 0


if __name__ == "__main__":
    raise SystemExit(main())
