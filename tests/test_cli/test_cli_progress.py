"""Progress that commands print on stderr."""

from __future__ import annotations

import re
import sys

import pytest

from lagbench.cli.output import progress_bar
from lagbench.work.run import Progress, watched


def training_progress(step: int) -> Progress:
    """Return the progress of a training of 240 steps, one a second."""
    return Progress(
        stage="loss 1",
        done=step,
        total=240,
        scenarios_done=step,
        scenarios=240,
        seconds=step,
    )


WRITING = Progress(
    stage="writing train",
    done=2,
    total=0,
    scenarios_done=2,
    scenarios=0,
    seconds=1.0,
)


def test_a_file_gets_lines_with_the_count_and_the_time_left(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with progress_bar(quiet=False, unit="steps", seconds_per_line=0.0) as listener:
        assert listener is not None
        listener(training_progress(60))
        listener(training_progress(200))
    output = capsys.readouterr()
    assert output.out == ""
    pattern = r"(\d+)/240 steps, 1.00/s, (.+) left"
    assert re.findall(pattern, output.err) == [("60", "3 min"), ("200", "40 s")]


def test_progress_without_scenarios_is_shown_in_per_cent(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The line names the stage and the share, and no scenarios."""
    timing = Progress(
        stage="costs", done=3, total=8, scenarios_done=0, scenarios=0, seconds=1.0
    )
    with progress_bar(quiet=False, seconds_per_line=0.0) as listener:
        assert listener is not None
        listener(timing)
    assert capsys.readouterr().err == "costs: 38%\n"


def test_an_unknown_total_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar(quiet=False, seconds_per_line=0.0) as listener:
        assert listener is not None
        listener(WRITING)
    assert capsys.readouterr().err == "writing train: 2 scenarios, 2.00/s\n"


def slow_scoring(done: int, seconds: float) -> Progress:
    """Return the progress of a scoring of 20 scenarios."""
    return Progress(
        stage="scoring",
        done=done,
        total=20,
        scenarios_done=done,
        scenarios=20,
        seconds=seconds,
    )


@pytest.mark.parametrize(
    ("done", "seconds", "told"),
    [
        (0, 12.0, "0%, 0/20 scenarios"),
        (2, 250.0, "10%, 2/20 scenarios, 2 min per scenario, 38 min left"),
        (2, 25.0, "10%, 2/20 scenarios, 12.5 s per scenario, 4 min left"),
        (5, 4.0, "25%, 5/20 scenarios, 1.25/s, 12 s left"),
    ],
)
def test_slow_progress_is_shown_in_seconds_per_scenario(
    done: int, seconds: float, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Below one a second the time of one is shown; before the first there is none."""
    with progress_bar(quiet=False, seconds_per_line=0.0) as listener:
        assert listener is not None
        listener(slow_scoring(done, seconds))
    line = capsys.readouterr().err
    assert line == f"scoring: {told}\n"


def test_quick_work_prints_no_line(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar(quiet=False, unit="steps", seconds_per_line=3600.0) as listener:
        assert listener is not None
        listener(training_progress(60))
        listener(WRITING)
    assert capsys.readouterr().err == ""


def test_quiet_work_has_no_listener() -> None:
    with progress_bar(quiet=True) as listener:
        assert listener is None


def test_work_goes_on_without_stderr(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where stderr is closed, Python has no such stream."""
    monkeypatch.setattr(sys, "stderr", None)
    assert not watched()
    with progress_bar(quiet=False) as listener:
        assert listener is not None
