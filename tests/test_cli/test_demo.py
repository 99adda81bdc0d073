"""The demo: data, model, scores and a leaderboard page from nothing, and once more."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import Result
from conftest import SPLIT
from turns import PROGRAMS

from lagbench.cli import demo
from lagbench.errors import NotInstalledError

Run = Callable[..., Result]


@pytest.fixture
def small_demo(monkeypatch: pytest.MonkeyPatch) -> None:
    """A demo of one split, whose model trains for two steps."""
    monkeypatch.setattr(demo, "SPLITS", (SPLIT,))
    monkeypatch.setattr(demo, "MODEL_SPLIT", SPLIT)
    monkeypatch.setattr(demo, "SETTINGS", ("training.steps=2", "model.width=4"))


def run_demo(root: Path, run: Run) -> Any:
    """Return what the demo prints with --json."""
    result = run("demo", "--root", root, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.mark.usefixtures("small_demo")
def test_without_torch_the_demo_makes_data_only(
    run: Run, copied: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: object) -> None:
        raise NotInstalledError("torch is not installed; pip install it")

    monkeypatch.setattr(demo, "require_libraries", refuse)
    root = copied()
    data = run_demo(root, run)
    assert data["model"] is None
    assert "torch" in data["model_left_out"]
    assert data["splits"][SPLIT]["generation"]["kept"] == [0, 1, 2, 3, 4]
    assert Path(data["splits"][SPLIT]["picture"]).is_file()
    assert not (root / "leaderboard").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("small_demo")
def test_a_second_demo_gives_the_same_entry(
    run: Run, copied: Callable[[], Path]
) -> None:
    """Also where the training that is there is damaged."""
    root = copied()
    first = run_demo(root, run)["model"]
    assert (root / "leaderboard" / "index.html").is_file()
    (root / "runs" / f"{SPLIT}-neuralmpm" / "checkpoint.safetensors").write_bytes(b"x")
    second = run_demo(root, run)["model"]
    assert second["card"]["rows"] == first["card"]["rows"]
    assert second["page"]["rows"] == 1


def test_another_leaderboard_is_refused_before_the_work(
    run: Run, tmp_path: Path
) -> None:
    entry = tmp_path / "leaderboard" / "submissions" / "cavity" / "mini" / "mine.yaml"
    entry.parent.mkdir(parents=True)
    entry.touch()
    assert run("demo", "--root", tmp_path).exit_code == 2
    assert not (tmp_path / "cavity").exists()


@pytest.mark.slow
@pytest.mark.skipif("demo" not in PROGRAMS, reason="not in this turn")
def test_the_whole_demo_from_nothing(run: Run, tmp_path: Path) -> None:
    """It gives four verified data sets, and a model that beats the naive baselines."""
    data = run_demo(tmp_path / "demo", run)
    splits = data["splits"]
    assert list(splits) == ["cavity", "curl-noise", "fluid", "multimaterial"]
    for split in splits.values():
        assert split["verification"]["problems"] == []
    assert data["model"]["card"]["skill"]["value"] > 0.2
