"""Run a command of lagbench in this process and return what it printed."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass

from cyclopts import Parameter

from lagbench.cli.program import build_program


@dataclass(frozen=True)
class Result:
    """Exit code and output of a command."""

    exit_code: int
    stdout: str
    stderr: str

    @property
    def output(self) -> str:
        """What was printed on stdout, then on stderr."""
        return self.stdout + self.stderr


class CliRunner:
    """Runs commands."""

    def invoke(
        self, app: Callable[[Sequence[str]], int], words: Sequence[object]
    ) -> Result:
        """Return the result of the words of a command line, without ``lagbench``."""
        with (
            redirect_stdout(io.StringIO()) as stdout,
            redirect_stderr(io.StringIO()) as stderr,
        ):
            try:
                exit_code = app([str(word) for word in words])
            except SystemExit as error:
                exit_code = int(error.code or 0)
        return Result(exit_code, stdout.getvalue(), stderr.getvalue())


def options_of(*words: str) -> set[str]:
    """Return the options of a command, as in ``options_of("leaderboard", "show")``."""
    command = build_program()
    for word in words:
        command = command[word]
    options: set[str] = set()
    for argument in command.assemble_argument_collection(
        default_parameter=Parameter(negative=())
    ):
        options.update(name for name in argument.names if name.startswith("-"))
    return options
