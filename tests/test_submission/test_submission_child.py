"""The child process: what becomes of a child that waits, crashes, or fails for our own
reasons.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from submission_data import Bench, small

from lagbench.errors import WorkFailedError
from lagbench.submission import CHECKS, validation
from lagbench.submission.issues import quote
from lagbench.work.machine import LimitedChild, run_in_child

SECONDS = 5.0
WALL = 600.0

JOBS = """
import os, signal, sys, time

def process(_):
    return os.getpid()

def behave(how):
    if not isinstance(how, str):
        return how
    if how == "sleep":
        time.sleep(60)
    elif how == "burn":
        while True:
            pass
    elif how == "fill":
        bytearray(1 << 40)
    elif how == "exit":
        os._exit(5)
    elif how == "raise":
        raise ValueError("a bug")
    elif how == "print":
        print("a warning of a library", flush=True)
    elif how == "nest":
        print("[" * 100_000, flush=True)
    elif how:
        os.kill(os.getpid(), getattr(signal, how))
    return how
"""


bench = small


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module ``jobs`` that children can import."""
    (tmp_path / "jobs.py").write_text(JOBS)
    monkeypatch.setenv(
        "PYTHONPATH", f"{tmp_path}:{Path(validation.__file__).parents[2]}"
    )


@pytest.mark.usefixtures("jobs")
@pytest.mark.parametrize(
    ("how", "said"),
    [
        (
            "burn",
            "computing time",
        ),
        (
            "fill",
            "more than 768 MiB",
        ),
        (
            "exit",
            "exit code 0x5",
        ),
        (
            "SIGABRT",
            "crashed: Aborted",
        ),
        (
            "SIGSEGV",
            "crashed: Segmentation fault",
        ),
        (
            "print",
            "no JSON",
        ),
        (
            "nest",
            "no JSON",
        ),
    ],
)
def test_what_stops_a_child_leaves_the_answers_before(how: str, said: str) -> None:
    """Two answers, then it ends; the last request is never reached."""
    values, stopped, _ = run_in_child(
        "jobs.behave", ["", "", how, ""], seconds=1.0, wall=600.0
    )
    assert values == ["", ""]
    assert said in str(stopped)


UNDER_A_HARD_LIMIT = """
import resource, sys
from lagbench.errors import WorkFailedError
from lagbench.work.machine import run_in_child
limit = 500 << 20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
print(run_in_child("jobs.behave", [1, 2], seconds=5, wall=600).values)
try:
    run_in_child("jobs.behave", ["fill"], seconds=5, wall=600)
except WorkFailedError as error:
    print(error.expected, "|", error.got)
"""


@pytest.mark.usefixtures("jobs")
def test_a_hard_limit_of_memory_is_kept_and_named() -> None:
    """A child works below it; one that needs more fails for the machine's reason, and
    not for a fault of the file.
    """
    done = subprocess.run(
        [sys.executable, "-c", UNDER_A_HARD_LIMIT],
        capture_output=True,
        text=True,
        check=True,
    )
    answers, failure = done.stdout.splitlines()
    assert answers == "[1, 2]"
    needed, limit = failure.split(" | ")
    assert "768 MiB" in needed
    assert "500 MiB" in limit


@pytest.mark.slow
@pytest.mark.usefixtures("jobs")
def test_a_child_that_answers_waits_or_raises() -> None:
    """What JSON can hold goes there and back, in the order of requests.

    One that waits is stopped by the clock, since it computes nothing; an error is exit
    code 5 with its last line.
    """
    asked = [None, 1.5, {"a": ["é", "\u2028", "line\nbreak"]}, True]
    assert run_in_child("jobs.behave", asked, seconds=SECONDS, wall=WALL) == (
        asked,
        None,
        False,
    )
    values, stopped, _ = run_in_child(
        "jobs.behave", ["", "sleep", ""], seconds=5.0, wall=4.0
    )
    assert values in ([], [""])  # on a busy machine it may not even have begun
    assert stopped == "no end after 4 s"
    with pytest.raises(WorkFailedError) as caught:
        run_in_child("jobs.behave", ["raise"], seconds=SECONDS, wall=WALL)
    assert "ValueError: a bug" in str(caught.value.got)


@pytest.mark.usefixtures("jobs")
def test_one_process_answers_all_calls() -> None:
    """The second call finds what the first one left, so nothing is started twice."""
    with LimitedChild("jobs", seconds=SECONDS, wall=WALL) as child:
        assert child.call("process", None) == child.call("process", None)


@pytest.mark.usefixtures("jobs")
def test_the_encoding_of_the_user_does_not_reach_the_child(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Requests and answers are UTF-8, whatever the user's terminal shows."""
    monkeypatch.setenv("PYTHONIOENCODING", "utf-16")
    with LimitedChild("jobs", seconds=SECONDS, wall=WALL) as child:
        assert child.call("behave", ["äöü"]) == ["äöü"]


def test_a_stopped_child_is_an_issue(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The check is `readable`, the exit code 3, and no other check counts as passed. A
    sparse file of a terabyte gets far less than a day. A child may wait far longer than
    it may compute.
    """
    assert validation.WALL_SECONDS >= 100.0 * validation.CPU_SECONDS
    monkeypatch.setattr(validation, "WALL_SECONDS", 0.0)
    result = bench.validate(bench.valid, isolated=True)
    assert result.errors[0].check == "readable"
    assert result.exit_code == 3
    assert result.passed == ()
    assert set(result.skipped) == set(CHECKS) - {"readable"}
    path = bench.copy("sparse.nc")
    with path.open("r+b") as stream:
        stream.truncate(1 << 40)
    assert validation.seconds_for(path) < 1.0


def test_a_stray_module_in_the_current_folder_is_not_run(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Predictions may come with a numpy.py beside them."""
    (tmp_path / "numpy.py").write_text("raise SystemExit(9)")
    monkeypatch.chdir(tmp_path)
    assert bench.validate(bench.valid, isolated=True).exit_code == 0


def test_text_of_strangers_is_shown_escaped_and_short() -> None:
    """Control characters never reach the terminal."""
    assert quote("\x1b[2J\u202e") == r"'\x1b[2J\u202e'"
    assert len(quote("x" * 10**6)) == 80
    assert len(quote([16**5000])) < 80
    assert len(quote(np.arange(40.0).reshape(8, 5)).splitlines()) == 1


def test_the_document_names_every_check() -> None:
    """docs/predictions.md and the code do not drift apart."""
    text = (Path(__file__).parents[2] / "docs" / "predictions.md").read_text()
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| `")]
    severities = {"error", "warning", "error, warning"}
    assert [row[1].strip(" `") for row in rows if row[2].strip() in severities] == list(
        CHECKS
    )
