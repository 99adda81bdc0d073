"""How commands are found and how they end: exit codes, short messages, no traceback."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import pytest
from command_line import Result

from lagbench.cli import inventory
from lagbench.cli.commands import COMMANDS, Command
from lagbench.cli.output import format_bytes, print_table

Run = Callable[..., Result]

MOST_LINES = 8
"""Lines of a message, those of a validator's report included."""


def test_the_help_imports_no_command() -> None:
    code = (
        "import sys; from lagbench.cli.program import app\n"
        "assert app(['--help']) == app(['leaderboard', '--help']) == 0\n"
        "print(*(name for name in sys.modules if name.startswith('lagbench.')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.splitlines()[-1].split())
    assert loaded <= {
        "lagbench.cli",
        "lagbench.cli.commands",
        "lagbench.cli.program",
        "lagbench.cli.stderr",
        "lagbench.errors",
    }


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_the_help_of_a_command_ends_with_an_example_that_parses(
    command: Command, run: Run
) -> None:
    words = command.name.split()
    shown = run(*words, "--help")
    assert shown.exit_code == 0
    assert shown.stdout.rstrip().endswith(f"Example: lagbench {command.example}")
    assert command.example.split()[: len(words)] == words
    assert run(*command.example.split(), "--help").exit_code == 0


@pytest.mark.parametrize(
    ("line", "exit_code"),
    [
        ("scor predictions.nc", 2),
        ("help", 2),
        ("score", 2),
        ("score nothere.nc", 3),
        ("score .", 3),
        ("validate", 2),
        ("validate nothere.nc", 3),
        ("generate", 2),
        ("generate cavty", 2),
        ("generate cavity --size huge", 2),
        ("generate cavity tiny", 2),
        ("generate cavity --sise tiny", 2),
        ("generate cavity -size tiny", 2),
        ("generate cavity --size", 2),
        ("generate cavity --size --json", 2),
        ("generate cavity --workers 0", 2),
        ("generate cavity --workers two", 2),
        ("generate cavity --size tiny --scenarios 99", 2),
        ("generate cavity --split fluid", 2),
        ("train cavity", 2),
        ("train cavity gns", 2),
        ("predict nothere.pt", 3),
        ("plot cavity --size full", 4),
        ("compare a.nc", 2),
        ("submit nothere.nc --method m", 2),
        ("leaderboard shw", 2),
        ("leaderboard show cavity --size huge", 2),
        ("list --root ", 2),
    ],
)
def test_a_mistake_has_a_short_answer_and_an_exit_code(
    line: str, exit_code: int, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = run(*line.split(" "))
    assert result.exit_code == exit_code, result.output
    assert "Traceback" not in result.output
    assert 1 <= len(result.output.splitlines()) <= MOST_LINES


@pytest.mark.parametrize(
    ("error", "exit_code"),
    [
        (KeyboardInterrupt(), 130),
        (ZeroDivisionError(), 5),
        (PermissionError(13, "Permission denied", "file"), 5),
        (OSError(28, "No space left on device", "file"), 5),
        (MemoryError(), 5),
    ],
)
def test_what_a_command_raises_ends_in_a_message(
    error: BaseException, exit_code: int, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(inventory, "resolve_root", fail)
    result = run("list")
    assert result.exit_code == exit_code
    assert "Traceback" not in result.stderr
    assert 1 <= len(result.stderr.splitlines()) <= 2


def test_the_whole_trace_of_an_unexpected_error_is_there_on_request(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inventory, "resolve_root", None)
    monkeypatch.setenv("LAGBENCH_DEBUG", "1")
    with pytest.raises(TypeError):
        run("list")


@pytest.mark.parametrize("words", ["list", "--help", "info cavity --json"])
def test_a_closed_pipe_ends_in_silence(words: str) -> None:
    """As in ``lagbench list | head -1``."""
    command = f"{sys.executable} -m lagbench {words} | head -1"
    done = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""


def test_one_split_may_be_named_in_two_ways(run: Run) -> None:
    assert run("cite", "cavity").stdout == run("cite", "--split", "cavity").stdout


@pytest.mark.parametrize(
    ("count", "text"),
    [(999, "999 B"), (999_999, "1.0 MB"), (99_960, "100 kB"), (4.7e12, "4700 GB")],
)
def test_bytes_are_rounded_before_their_unit_is_chosen(count: float, text: str) -> None:
    assert format_bytes(count) == text


def test_a_table_cuts_no_number_and_reads_no_markup(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    rows = [("[red]a", "123456789012345678901234567890", "a text that wraps")]
    print_table("a title that is longer than its table", ("x", "y", "z"), rows)
    printed = capsys.readouterr().out
    assert "[red]a" in printed
    assert "123456789012345678901234567890" in printed
    assert "a title that is longer than its table" in printed
