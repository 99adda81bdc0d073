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


def test_work_goes_on_without_stderr(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where stderr is closed, Python has no such stream."""
    monkeypatch.setattr(sys, "stderr", None)
    assert not watched()
    with progress_bar(quiet=False) as listener:
        assert listener is not None
