"""The demo: data, model, scores and a leaderboard page from nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import Result
from turns import PROGRAMS


@pytest.mark.slow
@pytest.mark.skipif("demo" not in PROGRAMS, reason="not in this turn")
def test_the_demo_trains_a_model_that_beats_the_naive_baselines(
    run: Callable[..., Result], tmp_path: Path
) -> None:
    root = tmp_path / "demo"
    result = run("demo", "--root", root)
    assert result.exit_code == 0, result.output
    for split in ("cavity", "curl-noise", "fluid", "multimaterial"):
        assert (root / "pictures" / f"{split}.png").is_file()
    scores = root / "runs" / "cavity-neuralmpm" / "predictions" / "scores.json"
    assert json.loads(scores.read_text())["skill"]["value"] > 0.2
    assert "neuralmpm" in (root / "leaderboard" / "index.html").read_text()
