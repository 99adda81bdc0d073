"""Ctrl-C ends a command with one line, from the first module that is imported."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import IO

import pytest

CONSOLE_COMMAND = "from lagbench.__main__ import app; sys.exit(app())"
MODULE_COMMAND = "runpy.run_module('lagbench', run_name='__main__', alter_sys=True)"

SEND_AT_IMPORT = """
import os, runpy, signal, sys

# The background jobs of a shell ignore the signal.
signal.signal(signal.SIGINT, signal.default_int_handler)

def interrupt(event, details):
    if event == "import" and details[0] == {module!r}:
        os.kill(os.getpid(), signal.SIGINT)

sys.addaudithook(interrupt)
{call}
"""
"""A program that gets SIGINT as it begins to import a module."""


def interrupt_import(
    call: str, module: str, *, stderr: int | IO[str] = subprocess.PIPE
) -> subprocess.CompletedProcess[str]:
    """Run `lagbench list`, with a Ctrl-C at the import of a module."""
    return subprocess.run(
        [sys.executable, "-c", SEND_AT_IMPORT.format(call=call, module=module), "list"],
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        check=False,
        timeout=60,
    )


@pytest.mark.parametrize("call", [CONSOLE_COMMAND, MODULE_COMMAND])
@pytest.mark.parametrize(
    "module",
    [
        "lagbench.cli.program",
        "importlib.metadata",
        "typer",
        "lagbench.errors",
        "typer.completion",
        "lagbench.data.layout",
        "rich",
    ],
)
def test_an_interrupt_of_the_first_imports_ends_with_one_line(
    call: str, module: str
) -> None:
    done = interrupt_import(call, module)
    assert done.returncode == 130, done.stderr
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("lagbench: interrupted")


def test_an_interrupt_ends_with_its_code_where_stderr_is_full() -> None:
    with Path("/dev/full").open("w") as full:
        done = interrupt_import(CONSOLE_COMMAND, "typer", stderr=full)
    assert done.returncode == 130


IN_A_THREAD = """
import sys, threading
from lagbench.__main__ import app

sys.argv = ["lagbench", "--version"]
thread = threading.Thread(target=app)
thread.start()
thread.join()
"""


WITHOUT_DESCRIPTORS = """
import os, socket, subprocess, sys
from lagbench.__main__ import app

sys.argv = ["lagbench", "--version"]
for standard in range(3):
    os.close(standard)
try:
    app()
except SystemExit:
    pass
one, other = socket.socketpair()
assert min(one.fileno(), other.fileno()) > 2
program = "import os; [os.fstat(standard) for standard in range(3)]"
subprocess.run([sys.executable, "-c", program], check=True)
"""


def test_no_socket_takes_the_place_of_a_closed_standard_descriptor() -> None:
    """A socket with such a number would be lost in the processes that we start. They
    have all three descriptors too.
    """
    subprocess.run(
        [sys.executable, "-c", WITHOUT_DESCRIPTORS],
        check=True,
        timeout=60,
    )


def test_the_program_runs_in_any_thread() -> None:
    """Only the main thread may set what Ctrl-C does."""
    done = subprocess.run(
        [sys.executable, "-c", IN_A_THREAD],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout.strip() == version("lagbench")
    assert done.stderr == ""
