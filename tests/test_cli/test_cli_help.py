"""The help of the program and of its commands, which are loaded only when called."""

from __future__ import annotations

import importlib
import inspect
import re
import subprocess
import sys
from collections.abc import Callable

import pytest
from typer.testing import CliRunner, Result

from lagbench.cli.commands import (
    COMMANDS,
    LEADERBOARD_COMMANDS,
    CommandEntry,
)
from lagbench.cli.program import app

Run = Callable[..., Result]

ENTRIES = (*COMMANDS, *LEADERBOARD_COMMANDS)
LOADED_MODULES = """
import sys
from typer.testing import CliRunner
from lagbench.cli.program import app
for words in {calls}:
    assert CliRunner().invoke(app, words).exit_code == 0
print(*(name for name in sys.modules if name.startswith("lagbench.")))
"""


def entry_id(entry: CommandEntry) -> str:
    return entry.target


def path_of(entry: CommandEntry) -> tuple[str, ...]:
    """Return the words by which a command is called."""
    if entry in LEADERBOARD_COMMANDS:
        return ("leaderboard", entry.name)
    return (entry.name,)


def loaded_modules(calls: list[list[str]]) -> set[str]:
    """Return the modules of the package that a new process loads for some calls."""
    code = LOADED_MODULES.format(calls=calls)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_the_help_lists_all_commands_in_the_order_of_use(run: Run) -> None:
    text = run("--help").stdout
    names = [entry.name for entry in COMMANDS]
    names.append("leaderboard")
    starts = []
    for name in names:
        line = re.search(rf"^\W*{name} ", text, re.MULTILINE)
        assert line is not None, name
        starts.append(line.start())
    assert starts == sorted(starts)


def test_the_help_of_a_group_loads_no_command() -> None:
    modules = loaded_modules([["--help"], ["leaderboard", "--help"]])
    assert modules <= {
        "lagbench.cli.program",
        "lagbench.addresses",
        "lagbench.cli",
        "lagbench.cli.commands",
        "lagbench.cli.stderr",
        "lagbench.cli.typed_settings",
        "lagbench.errors",
    }


def test_a_command_loads_no_other() -> None:
    modules = loaded_modules([["cite", "cavity"]])
    targets = {entry.target.partition(":")[0] for entry in ENTRIES}
    loaded = {name.removeprefix("lagbench.cli.") for name in modules}
    assert targets & loaded == {"cite"}


@pytest.mark.parametrize("entry", ENTRIES, ids=entry_id)
def test_the_list_of_commands_says_what_their_docstrings_say(
    entry: CommandEntry,
) -> None:
    module_name, _, function_name = entry.target.partition(":")
    module = importlib.import_module(f"lagbench.cli.{module_name}")
    docstring = inspect.getdoc(getattr(module, function_name))
    assert docstring is not None
    assert docstring.split("\n\n")[0] == entry.summary


@pytest.mark.parametrize("entry", ENTRIES, ids=entry_id)
def test_the_help_of_a_command_ends_with_an_example_that_parses(
    entry: CommandEntry, run: Run
) -> None:
    path = path_of(entry)
    words = " ".join(run(*path, "--help").stdout.split())
    assert words.endswith(f"Example: lagbench {entry.example}")
    example = entry.example.split()
    assert tuple(example[: len(path)]) == path
    result = run(*example, "--help")
    assert result.exit_code == 0, result.output


def test_short_help_options_work_below_groups() -> None:
    for words in (["-h"], ["generate", "-h"], ["leaderboard", "show", "-h"]):
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, result.output
        assert "Usage:" in result.stdout
