"""The demo: data, model, scores and a leaderboard page from nothing, and once more."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from conftest import SIZE, SPLIT
from typer.testing import Result

from lagbench.cli import demo
from lagbench.cli.machine import SolverBench
from lagbench.data.registry import Registry, load
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import UsageError, WorkFailedError
from lagbench.references import references_of

Run = Callable[..., Result]

REFERENCES = [floor.name for floor in references_of(load().size(SPLIT, SIZE))]


@pytest.fixture
def run(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """A function that runs lagbench in an empty folder, with our splits and no recorded
    hashes.
    """
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    return run


@pytest.fixture
def only_one(
    run: Run, monkeypatch: pytest.MonkeyPatch, unmeasured_path: Path, tmp_path: Path
) -> Registry:
    """A registry of two splits, of which one has a size tiny; the demo's model, quickly
    trained, is its.
    """
    file = read_yaml(unmeasured_path)
    small = file["splits"][SPLIT]
    large = {**small, "sizes": {"full": small["sizes"]["full"]}}
    path = tmp_path / "datasets.yaml"
    # JSON is YAML
    path.write_text(json.dumps({**file, "splits": {"large": large, SPLIT: small}}))
    monkeypatch.setenv("LAGBENCH_REGISTRY", str(path))
    monkeypatch.setattr(demo, "MODEL_SPLIT", SPLIT)
    monkeypatch.setattr(demo, "SETTINGS", ("training.steps=2", "model.width=4"))
    timed = SolverBench(
        split=SPLIT, size=SIZE, particles=1, substeps=1, frames=1, seconds_per_frame=0.5
    )
    monkeypatch.setattr("lagbench.cli.machine.bench_apart", lambda *_: timed)
    return load(path)


def made_in(root: Path, run: Run) -> Any:
    """Return what the demo prints with --json."""
    result = run("demo", "--root", root, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_without_the_extra_the_data_are_made_and_one_line_says_how_to_get_the_rest(
    run: Run,
    only_one: Registry,
    copied: Callable[[], Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It says how to install it; no leaderboard, null in JSON; a split without a tiny
    size is left out.
    """

    def no_torch(name: str, *, extra: str) -> None:
        raise UsageError(
            f"{name} is not installed", fix=f"pip install 'lagbench[{extra}]'"
        )

    def no_solver(*_: str) -> SolverBench:
        raise WorkFailedError("the solver could not be timed")

    monkeypatch.setattr("lagbench.cli.machine.bench_apart", no_solver)
    assert demo._solver_time() is None  # then the page shows no speed-up
    assert demo.model_left_out(only_one) is None
    without = demo.model_left_out(Registry({"large": only_one.split("large")}, {}))
    assert without == f"the registry has no {SPLIT} {SIZE}"
    monkeypatch.setattr(demo, "check_installed", no_torch)
    root = copied()
    assert demo.demo_splits(only_one) == [SPLIT]
    result = run("demo", "--root", root)
    assert result.exit_code == 0, result.output
    assert "1 data sets, verified and drawn, in" in result.stdout
    assert "pip install 'lagbench[baselines]'" in result.stdout
    assert not (root / "leaderboard").exists()
    made = made_in(root, run)
    assert made["model"] is None
    assert made["model_left_out"] in result.stdout
    assert list(made["splits"]) == [SPLIT]
    assert made["splits"][SPLIT]["generation"]["kept"] == [0, 1, 2, 3, 4]
    assert Path(made["splits"][SPLIT]["picture"]).is_file()


@pytest.mark.usefixtures("only_one")
@pytest.mark.slow
def test_the_demo_ends_with_a_leaderboard_of_its_own(
    run: Run, copied: Callable[[], Path]
) -> None:
    """Model and floors are on its page, nothing in the current folder; a second run
    gives the same entry.
    """
    root = copied()
    first = made_in(root, run)["model"]
    result = run("demo", "--root", root)
    assert result.exit_code == 0, result.output
    page = root / "leaderboard" / "index.html"
    assert f"leaderboard page: {page}" in result.stdout.splitlines()
    assert all(name in page.read_text() for name in (*REFERENCES, "NeuralMPM, 2 steps"))
    assert list(Path.cwd().iterdir()) == []
    entry = yaml.safe_load(
        (root / f"leaderboard/submissions/{SPLIT}/{SIZE}/neuralmpm.yaml").read_text()
    )
    assert entry["cost"]["solver_seconds_per_frame"] == 0.5
    checked = run("leaderboard", "check", "--board", root / "leaderboard", "--page")
    assert checked.exit_code == 0, checked.output
    second = made_in(root, run)["model"]
    assert second["training"] == {
        **first["training"],
        "first_step": first["training"]["step"],
    }
    assert second["card"]["predictions_sha256"] == first["card"]["predictions_sha256"]
    assert second["card"]["rows"] == first["card"]["rows"]
    assert second["page"]["rows"] == 1
    assert second["page"]["tabs"] == 1
    ranked = second["card"]["rows"]["submission"][second["card"]["ranking_metric"]]
    assert second["entry"]["mean"] == pytest.approx(ranked["mean"], rel=1e-5)


@pytest.mark.usefixtures("only_one")
@pytest.mark.slow
def test_what_another_version_left_is_trained_anew(
    copied: Callable[[], Path], run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A damaged checkpoint, and one of another recipe, cost a training and no error."""
    root = copied()
    made_in(root, run)
    (root / "runs" / f"{SPLIT}-neuralmpm" / "checkpoint.pt").write_bytes(b"damaged")
    assert demo.demo_model(root=root).training.state == "finished"
    monkeypatch.setattr(demo, "SETTINGS", ("training.steps=3", "model.width=4"))
    again = demo.demo_model(root=root).training
    assert again.state == "finished"
    assert again.step == 3
    assert again.steps == 3
    assert torch.load(again.weights, weights_only=True)


def test_anothers_leaderboard_is_refused_before_the_work(
    run: Run, tmp_path: Path
) -> None:
    """A folder with entries of another size is left alone: exit code 2, and nothing
    generated.
    """
    entry = tmp_path / "leaderboard" / "submissions" / "cavity" / "mini" / "mine.yaml"
    entry.parent.mkdir(parents=True)
    entry.touch()
    result = run("demo", "--root", tmp_path)
    assert result.exit_code == 2, result.output
    assert "submissions/cavity/mini/mine.yaml" in result.stderr
    assert not (tmp_path / "cavity").exists()


@pytest.mark.slow
def test_the_whole_demo_from_nothing(run: Run, tmp_path: Path) -> None:
    """Four verified data sets, and a model that beats what costs no learning."""
    made = made_in(tmp_path / "demo", run)
    assert list(made["splits"]) == ["cavity", "curl-noise", "fluid", "multimaterial"]
    assert [one["verification"]["problems"] for one in made["splits"].values()] == [
        [],
        [],
        [],
        [],
    ]
    model = made["model"]
    assert model["training"]["split"] == "cavity"
    assert model["solver"]["seconds_per_frame"] > 0
    assert (
        model["card"]["skill"]["value"] > 0.2
    )  # better than anything that costs no learning
    assert model["page"]["rows"] == 1
    assert model["page"]["tabs"] == 1
    assert Path(model["page"]["page"]).stat().st_size == model["page"]["bytes"]
