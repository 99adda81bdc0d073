"""The child process: what becomes of a child that waits, crashes, or fails for our own reasons."""

from __future__ import annotations

from pathlib import Path

import pytest
from submission_data import Bench, make_bench

from lagbench.errors import WorkFailedError
from lagbench.submission import CHECKS, sandbox
from lagbench.submission.findings import quoted


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A small data set and a valid submission."""
    return make_bench(tmp_path_factory.mktemp("bench"))


def use_child(monkeypatch: pytest.MonkeyPatch, folder: Path, program: str) -> None:
    """Put another program in place of the child's."""
    (folder / "other_child.py").write_text(program)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.setattr(sandbox, "CHILD", "other_child")
    monkeypatch.setattr(sandbox, "WALL_SECONDS", 1.0)


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("import time; time.sleep(60)", "no end after 1 s"),
        ("import os; os.abort()", "crashed: Aborted"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "crashed: Segmentation fault"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGXCPU)", "no end within the computing time"),
        (f"raise SystemExit({sandbox.OUT_OF_MEMORY})", "more than 768 MiB"),
    ],
)
def test_what_stops_the_child_is_a_finding(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, program: str, said: str
) -> None:
    """The check is `readable`, the exit code 3, and no other check counts as passed."""
    use_child(monkeypatch, tmp_path, program)
    if "sleep" not in program:
        monkeypatch.setattr(sandbox, "WALL_SECONDS", 30.0)
    result = bench.validate(bench.valid, isolated=True)
    assert said in result.errors[0].got
    assert (result.errors[0].check, result.exit_code, result.passed) == ("readable", 3, ())
    assert set(result.skipped) == set(CHECKS) - {"readable"}


def test_a_fault_of_ours_does_not_blame_the_file(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A child that raises is exit code 5 and repeats the last line."""
    use_child(monkeypatch, tmp_path, "raise ValueError('a bug')")
    monkeypatch.setattr(sandbox, "WALL_SECONDS", 30.0)
    with pytest.raises(WorkFailedError, match="ValueError: a bug"):
        bench.validate(bench.valid, isolated=True)


def test_a_sparse_file_gets_no_more_time(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A terabyte that takes no room is not granted a day."""
    path = bench.copy("sparse.nc")
    with path.open("r+b") as stream:
        stream.truncate(1 << 40)
    use_child(monkeypatch, tmp_path, "import sys; raise SystemExit('seconds ' + sys.argv[1])")
    monkeypatch.setattr(sandbox, "WALL_SECONDS", 30.0)
    with pytest.raises(WorkFailedError, match="seconds 3"):
        bench.validate(path, isolated=True)


def test_a_slow_start_costs_a_sound_file_nothing(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Computing time counts from the start of the work, wall time hardly: as on a busy machine."""
    burn = "import time\nwhile time.process_time() < 1.2: pass\n"
    use_child(monkeypatch, tmp_path, f"{burn}from lagbench.submission.child import main\nmain()")
    monkeypatch.setattr(sandbox, "WALL_SECONDS", 600.0)
    monkeypatch.setattr(sandbox, "CPU_SECONDS", 1.0)
    assert bench.validate(bench.valid, isolated=True).exit_code == 0


def test_waiting_is_granted_far_more_than_computing() -> None:
    """What computes is stopped by the kernel's count, so the clock need not be near."""
    assert sandbox.WALL_SECONDS >= 100.0 * sandbox.CPU_SECONDS


def test_a_stray_module_in_the_current_folder_is_not_run(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Predictions may come with a numpy.py beside them."""
    (tmp_path / "numpy.py").write_text("raise SystemExit(9)")
    monkeypatch.chdir(tmp_path)
    assert bench.validate(bench.valid, isolated=True).exit_code == 0


def test_text_of_strangers_is_shown_escaped_and_short() -> None:
    """Control characters never reach the terminal."""
    assert quoted("\x1b[2J\u202e") == r"'\x1b[2J\u202e'"
    assert len(quoted("x" * 10**6)) == 80


def test_the_document_names_every_check() -> None:
    """docs/predictions.md and the code do not drift apart."""
    text = (Path(__file__).parents[1] / "docs" / "predictions.md").read_text()
    assert [
        line.split("`")[1]
        for line in text.splitlines()
        if (line.startswith("| `") and " | error | " in line) or " | warning | " in line
    ] == list(CHECKS)
